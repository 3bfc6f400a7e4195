"""btfpipe surface: prepare a mesh for synthesis."""

import math

import click

from btfpipe.cli.options import FiniteFloat, input_file, progress, stage


@click.command()
@click.argument("mesh", type=input_file(dir_okay=False))
@click.option(
    "--vertices",
    type=click.IntRange(100, 20_000_000),
    default=250_000,
    help="Vertices to resample to, met within 5 %.",
)
@click.option(
    "--levels",
    type=click.IntRange(1, 8),
    default=3,
    help="Levels of the pyramid; each has a quarter of the vertices of the one before.",
)
@click.option(
    "--field",
    type=input_file(dir_okay=False),
    help="YAML file of directions: strokes: [{point: [x, y, z], vector: [x, y, z]}].",
)
@click.option(
    "--turn-deg",
    type=FiniteFloat(),
    default=0.0,
    help="Turn the whole field counter-clockwise, degrees.",
)
@click.option(
    "--crease-deg",
    type=FiniteFloat(0, 180),
    default=None,
    help="Keep edges sharp where faces meet at more than this angle between their normals, degrees."
    "  [default: all edges are smooth]",
)
@click.option(
    "--smooth/--no-smooth",
    default=True,
    help="Round coarse facets off (Phong tessellation), or stay on the faces of the input.",
)
@stage()
def surface(
    mesh, vertices, levels, field, turn_deg, crease_deg, smooth, out, threads, memory, quiet
):
    """Prepare a mesh for synthesis: clean it, resample it evenly, lay a vector field over it.

    MESH is an OBJ, PLY, OFF or STL file. Normals stored in it are not used: shading normals are
    interpolated from its faces. A file of strokes says where the sample's right-hand direction
    should point; without one the field is the smoothest there is, the sample's up pointing along
    the y axis where that makes no difference.

    \b
    Example:
      btfpipe surface bunny.obj --vertices 250000 -o bunny.surface.npz
    """
    from btfpipe.formats.meshes import read_mesh
    from btfpipe.surface.prepare import prepare
    from btfpipe.surface.strokes import read_strokes

    strokes = read_strokes(field) if field else None
    with progress(f"preparing {mesh.name}", quiet) as report:
        made, facts = prepare(
            *read_mesh(mesh),
            vertices,
            levels,
            strokes=strokes,
            crease_deg=crease_deg,
            smooth=smooth,
            turn=math.radians(turn_deg),
            threads=threads,
            memory=memory,
            name=str(mesh),
            report=lambda done, total: report(round(100 * done / total), 100),
        )
    made.save(out)
    return {"inputs": [mesh, *([field] if field else [])], **facts}
