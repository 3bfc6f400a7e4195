"""`btfpipe simulate`: a specification in, a measurement in Bonn's layout out."""

from types import SimpleNamespace

import click

from btfpipe.cli.options import input_file, progress, refuse_inputs, stage
from btfpipe.errors import naming

_SUFFIXES = {"jpeg": ".jpg", "png": ".png", "exr": ".exr"}


@click.command()
@click.argument("spec", type=input_file(dir_okay=False))
@click.option(
    "--directions",
    "pairs",
    type=input_file(dir_okay=False),
    help="Table of pairs in place of the specification's directions: a CSV with the columns theta_i_deg,"
    " phi_i_deg, theta_v_deg, phi_v_deg.",
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(list(_SUFFIXES)),
    default="jpeg",
    help="jpeg and png hold sRGB; exr holds linear half floats, unclipped.",
)
@click.option(
    "--quality",
    type=click.IntRange(1, 100),
    default=92,
    help="Of JPEG, in per cent.",
)
@stage(folder=True)
def simulate(spec, out, seed, threads, memory, quiet, pairs, file_format, quality):
    """Ray-trace the meso-structure of SPEC (YAML) into a measurement.

    OUT is a zip if its name ends in .zip, else a folder; `ingest` reads either. Pictures hold masking, parallax, cast
    shadows and inter-reflection; the scale is absolute. The structure is drawn from the specification's own seed,
    --seed draws the paths of the light.

    \b
    Example:
        btfpipe simulate data-sample/weave.yaml -o weave.zip
        btfpipe simulate data-sample/weave.yaml --directions truth.csv --format exr -o truth.zip
    """
    from btfpipe.formats.images import encode_picture, read_picture
    from btfpipe.formats.obj_parts import read_parts
    from btfpipe.formats.ubo_writing import create_measurement
    from btfpipe.simulation import campaign, materials
    from btfpipe.simulation.goniometer import Goniometer
    from btfpipe.simulation.spec import plan, read_spec, vectors_of

    wanted = read_spec(spec)
    with naming(pairs or spec):
        lights, views, index = plan(wanted, pairs)

    def beside(name):
        refuse_inputs(out, [spec.parent / name])
        return spec.parent / name

    files = SimpleNamespace(
        picture=lambda name: read_picture(beside(name)),
        mesh=lambda name: read_parts(beside(name)),
    )
    with naming(spec):
        patch = materials.build_patch(wanted, files)
        memory -= campaign.require_memory(patch, wanted["inter_reflection"]["rays"], memory)
    goniometer = Goniometer(
        patch, wanted["samples"], **wanted["inter_reflection"], seed=seed, threads=threads
    )
    suffix = _SUFFIXES[file_format]
    display = campaign.display(file_format, wanted["largest_value"])

    def finish(picture):
        codes, clipped = display.encode(picture)
        return encode_picture(codes, suffix, quality=quality), clipped

    clipped = 0
    settings = display.settings | {
        "toroidal": True,
        "texels_per_mm": wanted["texels_per_mm"],
        "title": wanted.get("title", spec.stem),
    }
    with create_measurement(out, settings) as put, progress("pictures", quiet) as report:
        captured = campaign.capture(
            goniometer, vectors_of(lights), vectors_of(views), index, finish, threads, memory
        )
        for done, (view, light, (data, n)) in enumerate(captured, 1):
            put(light * len(views) + view, lights[light], views[view], suffix, data)
            clipped += n
            report(done, len(index))
    texels = patch.shape[0] * patch.shape[1]
    return {
        "inputs": [spec] + ([pairs] if pairs else []),
        "pictures": len(index),
        "lights": len(lights),
        "views": len(views),
        "rows": patch.shape[0],
        "cols": patch.shape[1],
        "triangles": len(patch.faces),
        "clipped_share": clipped / (3 * texels * len(index)),
    }
