"""``btfpipe render``: a picture of a scene."""

from pathlib import Path

import click

from btfpipe.cli.options import input_file, progress, refuse_inputs, stage, warn
from btfpipe.errors import InputError

# As in the scene's schema, which is not read for --help.
MOST_PIXELS = 16384  # a side
MOST_SAMPLES = 4096


def _bindings(context, parameter, values):
    found = {}
    for value in values:
        name, equals, file = value.partition("=")
        if not equals or not name or not file:
            raise click.BadParameter(f"{value!r}; write NAME=PATH.")
        found[name.removeprefix("$")] = file
    return found


@click.command()
@click.argument("scene", type=input_file(dir_okay=False))
@click.option(
    "--bind",
    "bindings",
    metavar="NAME=PATH",
    multiple=True,
    callback=_bindings,
    help="File for the placeholder $NAME of the scene; may be given several times.",
)
@click.option(
    "--width", type=click.IntRange(1, MOST_PIXELS), help="Pixels across, instead of the scene's."
)
@click.option(
    "--height", type=click.IntRange(1, MOST_PIXELS), help="Pixels down, instead of the scene's."
)
@click.option(
    "--samples", type=click.IntRange(1, MOST_SAMPLES), help="Rays a pixel, instead of the scene's."
)
@click.option(
    "--texture-filter/--no-texture-filter",
    default=None,
    help="Whether Samples and Models are averaged over what a ray covers of them, instead of as the scene says (by default they are).",
)
@click.option(
    "--float",
    "full",
    is_flag=True,
    help="Store all layers as 32-bit floats; otherwise colours, alpha and normals are 16-bit, unless radiance exceeds those.",
)
@stage()
def render(
    scene, bindings, width, height, samples, texture_filter, full, out, seed, threads, memory, quiet
):  # fmt: skip
    """Make a picture of a scene: dressed surfaces under lights, as OpenEXR.

    SCENE is a YAML file with camera, film, lights and objects. Layers of the picture: colour and alpha (R G B A,
    linear Rec. 709), depth (Z), shading normal (N.X N.Y N.Z) and the sample's coordinates (texel.row texel.col).

    \b
    Example:
      btfpipe render bunny.yaml -o bunny.exr
      btfpipe render turntable.yaml --bind model=wool.model.npz --bind map=wool.map.npz -o wool.exr
    """
    import functools
    import time

    import numpy as np

    from btfpipe.formats.images import colours, open_picture, write_picture
    from btfpipe.formats.meshes import read_mesh
    from btfpipe.rendering.renderer import LAYERS
    from btfpipe.rendering.renderer import render as render_scene
    from btfpipe.rendering.scene import load_scene, pyramids, texture_filter_facts

    if Path(out).suffix.lower() != ".exr":
        raise InputError(f"{out}: pictures are written as OpenEXR; end the name in .exr.")
    film = {"width": width, "height": height, "samples": samples, "texture_filter": texture_filter}
    start = time.perf_counter()
    loaded = load_scene(
        scene,
        bindings,
        film=film,
        read_mesh=read_mesh,
        read_picture=lambda path: colours(open_picture(path), path),
        memory=memory,
        threads=threads,
        seed=seed,
    )
    refuse_inputs(out, loaded.files)
    for pyramid in pyramids(loaded):
        pyramid.progress = functools.partial(progress, "levels of detail", quiet)
    load_seconds = time.perf_counter() - start
    start = time.perf_counter()
    with progress("render", quiet) as report:
        picture = render_scene(loaded, seed=seed, threads=loaded.threads, on_progress=report)
    render_seconds = time.perf_counter() - start
    colour = picture[..., :3]
    largest = float(max(colour.max(), -colour.min()))  # no copy: a film may be large
    if not np.isfinite(largest):
        raise InputError(f"{scene}: radiance exceeds 32-bit floats; lower the power of its lights.")
    warnings, short = [], "RGBAN"
    if largest > float(np.finfo(np.float16).max) and not full:
        short = "AN"
        warnings.append(
            f"radiance reaches {largest:.3g}, beyond 16-bit floats (65504): R, G and B are stored in 32 bits"
        )
    half = [not full and name[0] in short for name in LAYERS]
    write_picture(out, picture, names=list(LAYERS), half=half)
    levels = texture_filter_facts(loaded)
    warnings += levels.pop("warnings", [])
    warn(*warnings)
    return {
        "inputs": [scene, *loaded.files],
        "width": loaded.film.width,
        "height": loaded.film.height,
        "samples": loaded.film.samples,
        "load_seconds": round(load_seconds, 3),
        "render_seconds": round(render_seconds, 3),
        "texture_filter": loaded.film.texture_filter and levels,
        "covered": float((picture[..., 3] > 0).mean()),
        "warnings": warnings,
    }
