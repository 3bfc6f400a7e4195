"""`btfpipe synthesize`: Features and a Surface to a CoordinateMap."""

import math

import click

from btfpipe.cli.options import (
    FiniteFloat,
    input_file,
    material_option,
    material_taken,
    progress,
    stage,
    warn,
)
from btfpipe.errors import naming

_MOST_TEXELS = 16384  # a side


class _Plane(click.ParamType):
    """Sides of a plane, such as 256x384."""

    name = "rowsxcols"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        sides = value.lower().split("x")
        if len(sides) != 2 or not all(
            s.isdecimal() and 0 < int(s[:9]) <= _MOST_TEXELS for s in sides
        ):
            self.fail(
                f"{value!r} is not a plane; write 256x384 for 256 rows and 384 cols, at most {_MOST_TEXELS}"
                " a side.",
                param,
                ctx,
            )
        return tuple(int(s) for s in sides)


@click.command()
@click.argument("features", type=input_file())
@click.argument("surface", type=input_file(), required=False)
@click.option(
    "--plane",
    type=_Plane(),
    help="Grow over a plane of texels instead, which continues at its opposite borders.",
)
@click.option(
    "--search",
    type=click.Choice(["k-coherent", "full"]),
    default="k-coherent",
    help="Candidates for each vertex: those that its surroundings suggest, or all texels.",
)
@click.option(
    "-k",
    "k",
    type=click.IntRange(min=1),
    default=11,
    help="Texels tried for each suggestion; 1 (Ashikhmin) suits natural textures of small objects.",
)
@click.option(
    "--levels",
    type=click.IntRange(1, 6),
    default=3,
    help="Levels of the pyramids to use.",
)
@click.option(
    "--texels-per-unit",
    type=FiniteFloat(min=0, min_open=True),
    help="Scale of the sample, texels per unit of length of the surface. [default: one texel per mean edge]",
)
@click.option(
    "--repeats",
    type=FiniteFloat(min=0, min_open=True),
    help="Scale of the sample, as its widths across the longest side of the surface's bounding box.",
)
@click.option(
    "--turn-deg",
    type=FiniteFloat(),
    default=0.0,
    help="Angle of the sample's right-hand axis from the vector field, counter-clockwise, degrees.",
)
@click.option(
    "--coherence",
    type=FiniteFloat(min=0),
    default=0.4,
    help="By how much nearer a texel must be that breaks a run; 0: not at all, as published.",
)
@click.option(
    "--sweeps",
    type=(click.IntRange(min=1), click.IntRange(min=1)),
    default=(16, 3),
    help="Walks over the coarsest level, and over each other level.",
)
@click.option(
    "--distance",
    type=click.Choice(["gram", "vectors"]),
    help="Distances by the dot-product matrix or by feature vectors: the same choice, at another speed. [default: the faster]",
)
@click.option(
    "--toroidal",
    is_flag=True,
    help="An array or picture given as FEATURES continues at its opposite borders.",
)
@material_option
@stage()
def synthesize(
    features, surface, plane, search, k, levels, texels_per_unit, repeats, turn_deg, coherence, sweeps, distance,
    toroidal, material, out, seed, threads, memory, quiet,
):  # fmt: skip
    """Grow a Sample over a Surface, or over a plane (Tong et al. 2002).

    FEATURES is what `btfpipe textons` made; or a feature image (.npy or a picture), a Sample or a Model, whose texels are
    then compared without textons. The result says which texel of the sample goes to each vertex. A
    material that runs in one direction, such as cords, is warned of where the field would break its pattern and the field
    turned by 90 degrees would not.

    \b
    Examples:
      btfpipe synthesize corduroy.features.npz bunny.surface.npz -o corduroy-bunny.map.npz
      btfpipe synthesize corduroy.features.npz --plane 512x512 -o plane.map.npz
    """
    from btfpipe import store
    from btfpipe.surface import Surface
    from btfpipe.synthesis.coherence import coherence_facts
    from btfpipe.synthesis.field_fit import judge_field
    from btfpipe.synthesis.growth import grow_over_surface, scale_for
    from btfpipe.synthesis.plane import grow_over_plane
    from btfpipe.synthesis.sources import read_features

    if (surface is None) == (plane is None):
        raise click.UsageError("give either a SURFACE or --plane ROWSxCOLS.")
    if texels_per_unit and repeats:
        raise click.UsageError("give either --texels-per-unit or --repeats.")
    if plane and (texels_per_unit or repeats or turn_deg):
        raise click.UsageError("--texels-per-unit, --repeats and --turn-deg are for surfaces.")
    full = search == "full"
    taken = material_taken(features, material)
    target = None if plane else Surface.open(surface)
    with naming(features):
        sample = read_features(
            features, None if full else k, levels, toroidal=toroidal, material=material, seed=seed, threads=threads,
            memory=memory,
        )  # fmt: skip
    common = {
        "full": full, "k": k, "levels": levels, "sweeps": sweeps, "coherence": coherence, "seed": seed,
        "distance": distance,
    }  # fmt: skip
    fit, doubts = {}, []
    both = f"{features} on {surface or 'a plane'}"
    with naming(both), progress("synthesize", quiet) as report:
        if plane:
            grown = grow_over_plane(sample, plane, on_progress=report, **common)
        else:
            scale = scale_for(target, sample.levels[0].shape, texels_per_unit, repeats)
            fit, doubts = judge_field(sample, target.levels[0], scale, math.radians(turn_deg))
            warn(*doubts)
            grown = grow_over_surface(
                sample, target, scale, turn=math.radians(turn_deg), threads=threads,
                memory=memory, on_progress=report, **common,
            )  # fmt: skip
    steps = grown.about.pop("synthesis")
    facts = coherence_facts(grown, target, sample.levels[0].shape, sample.toroidal)
    grown.about |= {
        "method": search,
        **{name: value for name, value in common.items() if name != "full"},
        "features": store.digest(features),
        "sample_digest": sample.about.get("sample_digest"),
        "sample_shape": list(sample.levels[0].shape),
        "toroidal_sample": sample.toroidal,
    }
    grown.save(out)
    return {
        "inputs": [path for path in (features, surface) if path is not None],
        **taken,
        "elements": grown.row.shape[1],
        "texels_per_unit": grown.texels_per_unit,
        **facts,
        **fit,
        "warnings": doubts,
        "candidates": steps[-1]["candidates"],
        "mean_distance": steps[-1]["mean_distance"],
        "fallbacks": sum(step["fallbacks"] for step in steps),
        "search_seconds": sum(step["search_seconds"] for step in steps),
        "steps": steps,
    }
