"""`btfpipe ingest`: foreign pictures in, a Sample out."""

import re
from pathlib import Path

import click

from btfpipe import store
from btfpipe.cli.options import FiniteFloat, input_file, progress, stage
from btfpipe.errors import InputError

MOST_TEXELS = 16384  # a side


class Size(click.ParamType):
    """A size such as 128x128, rows first."""

    name = "ROWSxCOLS"

    def convert(self, value, param, ctx):
        found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", value) if isinstance(value, str) else None
        if not found:
            self.fail(f"{value!r} is not a size; write ROWSxCOLS, such as 128x128.", param, ctx)
        size = tuple(int(side[:9]) for side in found.groups())
        if max(size) > MOST_TEXELS:
            self.fail(f"{value!r} is too large; at most {MOST_TEXELS} a side.", param, ctx)
        return size


_POSITIVE = FiniteFloat(min=0, min_open=True)


@click.command()
@click.argument("source", type=input_file())
@click.option(
    "--pairs", is_flag=True, help="Keep pairs that are no product of views and lights, as a list."
)
@click.option(
    "--frontal",
    is_flag=True,
    help="Keep only the pair whose light and view are nearest the normal.",
)
@click.option(
    "--crop",
    type=int,
    nargs=4,
    metavar="ROW COL ROWS COLS",
    help="Part of the pictures to keep, in pixels, row 0 at the top.",
)
@click.option("--size", type=Size(), help="Resize to this many texels, in linear light.")
@click.option(
    "--transfer",
    type=click.Choice(["srgb", "gamma2.2", "linear"]),
    help="Curve of the pictures. By default: linear for EXR, gamma2.2 for JPEGs in Bonn's layout,"
    " else srgb.",
)
@click.option(
    "--white",
    type=_POSITIVE,
    metavar="VALUE",
    help="Linear value, 1 for the largest code, of a perfect white diffuser lit along the normal; makes the"
    " scale absolute.",
)
@click.option(
    "--grey-card",
    type=int,
    nargs=4,
    metavar="ROW COL ROWS COLS",
    help="Part of the uncropped pictures with a grey card, in place of --white.",
)
@click.option(
    "--grey-card-reflectance",
    type=FiniteFloat(0, 1, min_open=True),
    help="Reflectance of the grey card, 0 to 1.",
)
@click.option("--flatten", is_flag=True, help="Remove slow drift of brightness over the patch.")
@click.option(
    "--toroidal/--not-toroidal",
    default=None,
    help="Whether the patch continues at the opposite border. By default what SOURCE says, else no.",
)
@click.option("--texels-per-mm", type=_POSITIVE, help="Of the pictures in SOURCE.")
@stage()
def ingest(
    source,
    out,
    threads,
    quiet,
    pairs,
    frontal,
    crop,
    size,
    transfer,
    white,
    grey_card,
    grey_card_reflectance,
    flatten,
    toroidal,
    texels_per_mm,
):
    """Bring a measurement in: make a Sample of SOURCE.

    SOURCE is a zip or folder in the layout of Bonn's UBO2003 sets (one picture a pair of light and view, angles in the
    names), or one plain picture, which becomes a BTF of one view and one light.

    \b
    Example:
        btfpipe ingest UBO_CORDUROY256.zip --crop 0 0 128 128 -o corduroy.sample.npz
        btfpipe ingest bricks.png --toroidal -o bricks.sample.npz
    """  # fmt: skip
    from btfpipe.sample.ingest import ingest as ingest_measurement

    if (grey_card is None) != (grey_card_reflectance is None):
        raise click.UsageError("--grey-card and --grey-card-reflectance go together.")
    if grey_card is not None and white is not None:
        raise click.UsageError("--grey-card and --white are two ways to say the same; give one.")
    with _open(source, pairs, frontal) as measurement, progress("pictures", quiet) as report:
        facts = ingest_measurement(
            measurement,
            out,
            crop=crop,
            size=size,
            transfer=transfer,
            white=white,
            grey_card=grey_card,
            grey_card_reflectance=grey_card_reflectance,
            flatten=flatten,
            toroidal=toroidal,
            texels_per_mm=texels_per_mm,
            threads=threads,
            report=report,
            about={"name": Path(source).name, "digest": store.digest(source)},
        )
    return {"inputs": [source], **facts}


def _open(source, pairs, frontal):
    """The reader for a source: a set of pictures, or one."""
    from btfpipe.formats import pictures, ubo
    from btfpipe.formats.archive import is_zip

    if not source.is_dir() and store.is_ours(source):
        raise InputError(
            f"{source}: already a {store.read(source).kind} of btfpipe's; expected a foreign measurement or a"
            f" picture. `btfpipe info {source}` describes it."
        )
    if source.is_dir() or is_zip(source):
        return ubo.open_measurement(source, pairs=pairs, frontal=frontal)
    return pictures.open_measurement(source)
