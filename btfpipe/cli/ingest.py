"""`btfpipe ingest`: foreign pictures in, a Sample out."""

import re
from pathlib import Path

import click

from btfpipe import store
from btfpipe.cli.options import FiniteFloat, flag, input_file, progress, stage, warn
from btfpipe.errors import InputError, naming

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
# As in btfpipe.formats.sources, which is not imported for --help.
_FORMATS = ("btf", "ptm", "rti", "pairs", "utia", "ubo", "curet", "picture")


@click.command()
@click.argument("source", type=input_file())
@click.option(
    "--format",
    "format_",
    type=click.Choice(_FORMATS),
    help="Take SOURCE for this format.  [default: told by looking]",
)
@click.option(
    "--pairs", is_flag=True, help="Keep pairs that are no product of views and lights, as a list."
)
@click.option(
    "--frontal",
    is_flag=True,
    help="Keep only the pair whose light and view are nearest the normal.",
)
@click.option(
    "--directions",
    type=input_file(dir_okay=False),
    help="UTIA's list of directions, with the shifted lights of coincident pairs.",
)
@click.option(
    "--colour",
    type=click.Choice(["xyz", "rgb"]),
    help="Of floating-point pictures in UTIA's layout.  [default: xyz]",
)
@click.option("--listing", help="Which list of directions to take, where SOURCE holds several.")
@click.option(
    "--patch-cm",
    type=_POSITIVE,
    nargs=2,
    metavar="HEIGHT WIDTH",
    help="Size of the patch, for lists of lamp and camera positions.",
)
@click.option(
    "--sample-number",
    type=click.IntRange(1, 61),
    help="Of a CUReT set, for its radiometry.  [default: from names]",
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
@click.option(
    "--cosine",
    type=click.Choice(["inside", "divided"]),
    help="Whether values are reflected light, or were divided by the light's cosine.  [default: what SOURCE says, else inside]",
)
@click.option("--flatten", is_flag=True, help="Remove slow drift of brightness over the patch.")
@click.option(
    "--toroidal/--not-toroidal",
    default=None,
    help="Whether the patch continues at the opposite border. By default what SOURCE says, else no.",
)
@click.option("--texels-per-mm", type=_POSITIVE, help="Of the pictures in SOURCE.")
@stage()
def ingest(source, format_, out, threads, quiet, **options):
    """Bring a measurement in: make a Sample of SOURCE, or a Model if it is compressed already.

    SOURCE is a zip or folder of pictures: in the layout of Bonn's UBO2003 and ATRIUM sets or of UTIA's (angles in the names),
    CUReT's, an RTI set with its .lp, or any with a CSV or JSON list of directions; one plain picture, which becomes a BTF of
    one view and one light; or a file of Bonn's .btf family, a .ptm or a .rti.

    \b
    Example:
        btfpipe ingest UBO_CORDUROY256.zip --crop 0 0 128 128 -o corduroy.sample.npz
        btfpipe ingest bricks.png --toroidal -o bricks.sample.npz
        btfpipe ingest carpet01_W400xH400_L151xV151.btf -o carpet.model.npz
    """
    from btfpipe.compression.model import Model
    from btfpipe.formats import sources
    from btfpipe.sample import measurement as measurements
    from btfpipe.sample.ingest import ingest as ingest_measurement

    if (options["grey_card"] is None) != (options["grey_card_reflectance"] is None):
        raise click.UsageError("--grey-card and --grey-card-reflectance go together.")
    if options["grey_card"] is not None and options["white"] is not None:
        raise click.UsageError("--grey-card and --white are two ways to say the same; give one.")
    if not source.is_dir() and store.is_ours(source):
        raise InputError(
            f"{source}: already a {store.read(source).kind} of btfpipe's; expected a foreign measurement or a"
            f" picture. `btfpipe info {source}` describes it."
        )
    name, reason = (format_, "--format says so") if format_ else sources.recognise(source)
    own = {key: options.pop(key) for key in _OF_FORMATS}
    takes = sources.FORMATS[name].options
    if "transfer" in takes:
        own["transfer"] = options.pop("transfer")
    own = {key: value for key, value in own.items() if value not in (None, False)}
    # pictures of any format may say
    cosine = None if "cosine" in takes else own.pop("cosine", None)
    frontal = options.pop("frontal")
    if frontal and "pairs" in takes:
        own["pairs"] = True  # one pair is a product, whatever the set lacks
    for key in own:
        if key not in takes:
            raise click.UsageError(
                f"{flag(key)} is not for {name}, which {source} is taken for ({reason})."
            )
    about = {"name": Path(source).name, "digest": store.digest(source)}
    told = {"inputs": [source], "taken_for": name, "because": reason}
    opened = sources.open_source(source, name, **own)
    if isinstance(opened, Model):
        given = [
            key
            for key, value in (options | {"frontal": frontal, "cosine": cosine}).items()
            if value not in (None, False) or (key == "toroidal" and value is False)
        ]
        if given:
            raise click.UsageError(
                f"{source} is compressed already and is kept as it is; {flag(given[0])} is for pictures."
            )
        opened.about |= about
        opened.save(out)
        return told | _facts_of(opened)
    with opened as measurement, progress("pictures", quiet) as report:
        if cosine == "divided":
            measurement = measurements.with_cosine(measurement)
        if frontal:
            measurement = measurements.frontal(measurement)
        with naming(source):
            facts = ingest_measurement(
                measurement, out, threads=threads, report=report, about=about, **options
            )
    warn(*facts.get("warnings", []))
    return told | facts


# Options that some formats take and others do not.
_OF_FORMATS = (
    "pairs", "directions", "colour", "listing", "patch_cm", "sample_number", "cosine",
)  # fmt: skip


def _facts_of(model):
    """What a summary says of a Model that came from a file."""
    source = model.about.get("source", {})
    return {key: source[key] for key in ("cosine",) if key in source} | {
        "kind": "model",
        "method": model.method,
        "rows": model.shape[0],
        "cols": model.shape[1],
        "pairs": model.n_pairs,
        "views": len(model.view_directions),
        "lights": len(model.light_directions),
        "product": model.is_product,
        "toroidal": model.toroidal,
        "texels_per_mm": model.texels_per_mm,
        "absolute": model.absolute,
        "nbytes": model.nbytes,
    }
