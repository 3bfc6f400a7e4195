"""``btfpipe preview``: pictures for people."""

import math
from pathlib import Path

import click

from btfpipe.cli.options import input_file, material_option, material_taken, stage
from btfpipe.errors import InputError


def _not_nan(context, parameter, value):
    if value is not None and math.isnan(value):  # which no range keeps out
        raise click.BadParameter("nan is not a finite number.")
    return value


@click.command()
@click.argument("files", nargs=-1, required=True, type=input_file(dir_okay=False))
@click.option(
    "--columns", type=click.IntRange(1), help="Pictures across the sheet.", show_default="square"
)
@click.option(
    "--exposure",
    type=click.FloatRange(-60, 60),
    callback=_not_nan,
    metavar="EV",
    show_default="automatic",
    help="Brighten by this many doublings, the same for all pictures.",
)
@click.option("--filmic", is_flag=True, help="Bend highlights to white instead of clipping them.")
@click.option(
    "--layer",
    type=click.Choice(["colour", "alpha", "depth", "normal", "texel"]),
    default="colour",
    help="Layer of rendered pictures to show.",
)
@click.option(
    "--labels", is_flag=True, help="Write file names, or directions in degrees, below the pictures."
)
@material_option
@stage()
def preview(files, columns, exposure, filmic, layer, labels, material, out):
    """Tone-map rendered pictures into one PNG, or show a Sample or Model under many lights and views.

    Several pictures make a contact sheet with one exposure for all; of a Sample or Model the sheet has views
    down and lights across.

    \b
    Example:
      btfpipe preview bunny.exr -o bunny.png
      btfpipe preview dressed.exr textured.exr --columns 2 -o both.png
      btfpipe preview wool.model.npz --labels -o wool.png
    """
    from btfpipe.formats.images import write_picture
    from btfpipe.rendering.preview import preview as make_preview

    if Path(out).suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{out}: previews are PNG or JPEG; end the name in .png or .jpg.")
    taken = material_taken(files[0], material)
    picture, stops = make_preview(
        files,
        columns=columns,
        exposure=exposure,
        filmic=filmic,
        layer=layer,
        labels=labels,
        material=material,
    )
    write_picture(out, picture)
    return {
        "inputs": list(files),
        **taken,
        "width": picture.shape[1],
        "height": picture.shape[0],
        "exposure": stops,
    }
