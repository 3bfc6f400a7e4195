"""`btfpipe export`: a Sample or a Model in a format that others read."""

import re

import click

from btfpipe.cli.options import (
    flag,
    input_file,
    material_option,
    material_taken,
    progress,
    stage,
    warn,
)
from btfpipe.errors import naming

# As in btfpipe.formats.targets, which is not imported for --help.
_FORMATS = ("ubo", "utia", "curet", "rti", "pairs", "btf")
# Endings that nobody gives to a folder.
_OF_FILES = re.compile(
    r"\.(btf|npz|npy|exr|hdr|png|jpe?g|bmp|tiff?|ptm|rti|lp|csv|json|ya?ml|7z|rar|tar|t?gz|z)"
)


@click.command()
@click.argument("source", type=input_file())
@click.option(
    "--format",
    "format_",
    type=click.Choice(_FORMATS),
    help="What to write.  [default: btf if the name ends so, else ubo]",
)
@click.option(
    "--suffix",
    type=click.Choice([".jpg", ".png", ".exr", ".bmp", ".bmp.Z"]),
    help="Kind of the pictures.  [default: .jpg for ubo and rti, .png for utia, .exr for pairs, .bmp.Z for curet]",
)
@click.option(
    "--sample-number",
    type=click.IntRange(1, 61),
    help="Of a CUReT set: names its files, and decides on the lamp.  [default: 1]",
)
@click.option(
    "--channel-components",
    type=click.IntRange(min=1),
    nargs=3,
    metavar="Y U V",
    help="Terms of luminance and of each chroma of a .btf; a Model of method factored is written as it is.  [default: 32 16 16]",
)
@material_option
@stage(folder=True)
def export(
    source, format_, suffix, sample_number, channel_components, material, out, seed, threads, memory, quiet
):  # fmt: skip
    """Write SOURCE, a Sample or a Model, in a format that other programs read.

    Sets of pictures become a zip if the name ends in .zip, else a folder: ubo (Bonn's layout), utia, pairs (any pairs, with a CSV
    of directions), rti (one view, with an .lp), curet (the 205 views that CUReT's robot would show, unrectified). btf is Bonn's
    factorised file.

    \b
    Example:
      btfpipe export wool.sample.npz --format utia -o wool_utia.zip
      btfpipe export wool.model.npz -o wool.btf
    """
    from btfpipe.compression import open_appearance
    from btfpipe.formats import targets

    format_ = format_ or ("btf" if out.suffix.lower() == ".btf" else "ubo")
    _check_ending(out, format_)
    options = {
        "suffix": suffix,
        "sample_number": sample_number,
        "channel_components": channel_components,
    }
    options = {name: value for name, value in options.items() if value is not None}
    for name in options:
        if name not in targets.WRITERS[format_].options:
            raise click.UsageError(f"{flag(name)} is not for {format_}.")
    if format_ == "btf":  # factorised on the way
        options |= {"seed": seed, "memory": memory}
    taken = material_taken(source, material)
    appearance = open_appearance(source, material)
    if appearance.n_invalid:
        rows, cols = appearance.shape
        warn(
            f"{appearance.n_invalid} of {rows * cols} texels are invalid, which {format_} has no way to say: they are"
            " written as they are"
        )
    with naming(source), progress("export: pictures", quiet) as report:
        facts = targets.write(
            out, format_, appearance, threads=threads, on_progress=report, **options
        )
    warn(*facts.get("warnings", []))
    invalid = {"invalid_texels": appearance.n_invalid} if appearance.n_invalid else {}
    return {"inputs": [source], "format": format_, **taken, **facts, **invalid}


def _check_ending(out, format_):
    """Refuse a name whose ending says something else than what the format writes."""
    ending = out.suffix.lower()
    if format_ == "btf":
        if ending != ".btf":
            raise click.UsageError(f"{out}: btf writes one file; call it NAME.btf.")
    elif _OF_FILES.fullmatch(ending):
        raise click.UsageError(
            f"{out}: {format_} writes a folder of pictures, or NAME.zip with them; call it so."
        )
