# Validation, wildcards and targets; no rules.

import shlex
from pathlib import Path

from snakemake.utils import validate

from btfpipe.provenance import source_digest

validate(config, "../schemas/config.schema.yaml")

RESULTS = Path(config["results"]).as_posix().rstrip("/")
LOOKS = config["looks"]
EXPORTS = config["exports"]
PLAIN_LOOKS = [name for name, look in LOOKS.items() if look.get("plain")]
TRUE_SAMPLES = [name for name, sample in config["samples"].items() if "truth" in sample]


def check_names():
    """Refuse a look whose sample or surface the config does not define."""
    for name, look in LOOKS.items():
        for key in ("sample", "surface"):
            if look[key] not in config[f"{key}s"]:
                raise WorkflowError(
                    f"looks.{name}.{key} is {look[key]!r}; expected one of"
                    f" {', '.join(config[f'{key}s'])}."
                )

    for name in EXPORTS:
        if name not in config["samples"]:
            raise WorkflowError(
                f"exports.{name} is no sample; expected one of {', '.join(config['samples'])}."
            )


def one_of(names):
    """A pattern of any of some names, of nothing if there are none."""
    return "|".join(map(re.escape, names)) or "(?!)"


check_names()


wildcard_constraints:
    sample=one_of(config["samples"]),
    surface=one_of(config["surfaces"]),
    look=one_of(LOOKS),
    scene=one_of(config["scenes"]),
    format="ubo|utia|curet|rti|pairs|btf",


def code(*parts):
    """Digest of the code that a stage leans on; a change of it makes the stage run again."""
    common = (
        "store.py",
        "files.py",
        "compiled.py",
        "parallel.py",
        "hashing.py",
        "directions",
        "sample",
        "formats",
    )
    return source_digest("cli/options.py", *common, *parts)


def at(pattern):
    """Path of a result."""
    return f"{RESULTS}/{pattern}"


def option(flag, value):
    """A command-line option, or nothing where the config leaves it out."""
    if value is None:
        return ""
    values = value if isinstance(value, (list, tuple)) else [value]
    return " ".join([flag, *(shlex.quote(str(value)) for value in values)])


# A resource, not a parameter: results do not hang on it, so that a change of it makes nothing run again.
MEMORY = option("--memory", config.get("memory"))


def mem_mb(usual):
    """Memory of a rule's jobs (MB): what the config allows and pages of mapped files, or the usual."""
    if "memory" not in config:
        return usual
    amount, unit = config["memory"][:-1], config["memory"][-1]
    return 500 + int(float(amount) * 1024 ** (2 + "MGT".index(unit)) / 1e6)


def sample_options(wildcards):
    """Options of `btfpipe ingest` for a sample."""
    sample = config["samples"][wildcards.sample]
    keys = ("transfer", "crop", "size", "white")
    flags = [option(f"--{key}", sample.get(key)) for key in keys]
    if "toroidal" in sample:
        flags.append("--toroidal" if sample["toroidal"] else "--not-toroidal")
    if sample.get("flatten"):
        flags.append("--flatten")
    return " ".join(filter(None, flags))


def of_look(key):
    """A function that gives a look's entry."""
    return lambda wildcards: LOOKS[wildcards.look].get(key)


def look_file(pattern):
    """A function that gives the file of a look's sample or surface."""
    return lambda wildcards: at(pattern).format(**LOOKS[wildcards.look])


def all_pictures():
    """Every look in every scene, and the looks that are compared with a plain texture."""
    return expand(
        at("pictures/{look}.{scene}.png"), look=LOOKS, scene=config["scenes"]
    ) + expand(
        at("pictures/{look}.{scene}.btf-and-texture.png"),
        look=PLAIN_LOOKS,
        scene=list(config["scenes"])[:1],
    )


def all_fidelity():
    """The table of errors, and the pictures of errors of each Model."""
    return [at("fidelity.md")] + expand(
        at("fidelity/{sample}.model.png"), sample=config["samples"]
    )


def exported(wildcards):
    """The file that a sample is written to in a format."""
    ending = "btf" if wildcards.format == "btf" else "zip"
    return at(f"exports/{wildcards.sample}.{wildcards.format}.{ending}")


def all_exports():
    """The sheets of what was written in every format and read back."""
    return expand(at("formats/{sample}.png"), sample=EXPORTS)
