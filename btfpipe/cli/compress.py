"""`btfpipe compress`: Samples to a Model."""

import click

from btfpipe.cli.options import FiniteFloat, Memory, flag, input_file, progress, stage, warn
from btfpipe.errors import naming

# As in btfpipe.compression.METHODS, which is not imported for --help.
_METHODS = ("coded", "svd", "view-pca", "local-pca", "harmonics", "factored")
_SPACES = {"linear": "ycocg", "log": "log_y_uv_over_y"}


@click.command()
@click.argument("samples", nargs=-1, required=True, type=input_file())
@click.option(
    "--method",
    type=click.Choice(_METHODS),
    default="coded",
    help="coded: square roots of the values factorised, quantised and entropy-coded to a wanted size; best by far for its bytes. svd: full-matrix singular value decomposition (Zhou et al. 2005). view-pca: principal pictures of each view (Wang et"
    " al. 2009). local-pca: clusters of texels with a PCA each (Müller et al. 2007); several samples make a database. harmonics:"
    " spherical harmonics over views and lights (Leung et al. 2007). factored: channel by channel, as in Bonn's .btf files.",
)
@click.option(
    "--components",
    type=click.IntRange(min=1),
    help="Terms of the sum: of coded and svd, of each view, of each cluster.  [default: coded as the size asks, svd 40, view-pca 5,"
    " local-pca 8]",
)
@click.option(
    "--ratio",
    type=FiniteFloat(min=1),
    help="Bytes of the pictures over those of the file, for coded.  [default: 100, less for samples under some MB]",
)
@click.option(
    "--space",
    type=click.Choice(_SPACES),
    help="Factorise luminance and chroma for themselves, of values or of their logarithm (svd, factored).",
)
@click.option(
    "--channel-components",
    type=click.IntRange(min=1),
    nargs=3,
    metavar="Y U V",
    help="Terms of luminance and of each chroma (svd, factored).  [default: 32 16 16]",
)
@click.option(
    "--clusters",
    type=click.IntRange(min=1),
    help="Of texels, for local-pca.  [default: as many as --target-bytes holds]",
)
@click.option(
    "--target-bytes",
    type=Memory(),
    help="Size of the file, for coded and local-pca, such as 800K.",
)
@click.option(
    "--view-harmonics",
    type=click.IntRange(min=1),
    help="Harmonics over the views: a square number.  [default: 25]",
)
@click.option(
    "--light-harmonics",
    type=click.IntRange(min=1),
    help="Harmonics over the lights: a square number.  [default: 25]",
)
@click.option(
    "--equal-views",
    is_flag=True,
    help="Weigh all views alike in the fit of harmonics, rather than by their squared cosines.",
)
@click.option(
    "--precision",
    type=click.Choice(["half", "single", "byte"]),
    help="Numbers in the file: 2, 4 or 1 bytes each; byte for view-pca and local-pca.  [default: half]",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    help="Power iterations of svd; by default as many as the error needs.",
)
@click.option(
    "--resample",
    is_flag=True,
    help="Interpolate samples of other directions than the first at its directions, for a database.",
)
@stage()
def compress(samples, method, out, seed, threads, memory, quiet, **options):
    """Make a Model that stands for a Sample, in a fraction of its bytes.

    The Model's error is measured on the file's own numbers, over all linear values.

    \b
    Example:
      btfpipe compress corduroy.sample.npz -o corduroy.model.npz
      btfpipe compress corduroy.sample.npz --method svd --components 40 -o corduroy.model.npz
      btfpipe compress wool.sample.npz felt.sample.npz --method local-pca -o cloth.model.npz
    """
    from btfpipe import store
    from btfpipe.compression import DATABASES, METHODS
    from btfpipe.compression import compress as compress_samples
    from btfpipe.metrics import raw_bytes
    from btfpipe.sample import Sample

    for name in ("resample", "equal_views"):
        options[name] = options[name] or None  # as the others: None if not given
    if options["space"] is not None:
        options["space"] = _SPACES[options["space"]]
    apart = options["space"] is not None or options["channel_components"] is not None
    takes = METHODS["factored" if method == "svd" and apart else method].options
    for name in ("ratio", "clusters"):
        if options[name] is not None and options["target_bytes"] is not None:
            raise click.UsageError(
                f"{flag(name)} and --target-bytes are two ways to say the same; give one."
            )
    if options["precision"] == "byte" and method not in ("view-pca", "local-pca"):
        raise click.UsageError(f"method {method} has no --precision byte; expected half or single.")
    for name, value in options.items():
        if value is not None and name not in takes:
            how = " channel by channel" if method == "svd" and apart else ""
            raise click.UsageError(
                f"method {method}{how} has no {flag(name)}; it takes {', '.join(map(flag, takes))}."
            )
    if len(samples) > 1 and method not in DATABASES:
        raise click.UsageError(
            f"method {method} takes one sample; {len(samples)} are given. Methods that make a database of several:"
            f" {', '.join(DATABASES)}."
        )
    if options["resample"] and len(samples) == 1:
        raise click.UsageError("--resample is for a database of several samples; 1 is given.")
    opened = [Sample.open(path) for path in samples]
    names = _names(samples) if len(samples) > 1 else None
    with naming(samples[0]), progress("compress: pictures", quiet) as report:
        model = compress_samples(
            opened,
            method,
            names=names,
            seed=seed,
            threads=threads,
            memory=memory,
            on_progress=report,
            **options,
        )
    model.about.setdefault("n_terms", getattr(model, "n_terms", None))
    raw = sum(raw_bytes(sample) for sample in opened)
    warnings = model.about.pop("warnings", [])
    model.about |= {
        "seed": seed,
        "sample": store.digest(samples[0]),
        "sample_bytes": raw,
        "source": opened[0].about.get("source"),
    }
    model.save(out)
    size = out.stat().st_size
    warn(*warnings)
    own = ("seed", "sample", "sample_bytes", "source", "singular_values")
    return {
        "inputs": list(samples),
        **{name: value for name, value in model.about.items() if name not in own},
        "bytes": size,
        "sample_bytes": raw,
        "ratio": raw / size,
        "warnings": warnings,
    }


def _names(samples):
    """Names of a database's materials: those of the files, as far as the first dot."""
    names = [path.name.partition(".")[0] for path in samples]
    if len(set(names)) < len(names):
        raise click.UsageError(
            f"the materials of a database take the names of their files, and {names} are not all different; rename one."
        )
    return names
