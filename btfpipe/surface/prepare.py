"""From a raw mesh to a Surface: clean, resample, give frames, stack levels."""

import itertools
import math
import os

import numpy as np

from btfpipe.errors import InputError, naming, too_little
from btfpipe.surface import field
from btfpipe.surface.cleaning import clean
from btfpipe.surface.consistency import consistent_positions, fair_normals
from btfpipe.surface.curl import curl_facts
from btfpipe.surface.deviation import (
    MOST_SPACINGS,
    MOST_SPACINGS_AT_TIPS,
    farthest_beyond,
    measure,
    most_area_error,
    sharp_tips,
)
from btfpipe.surface.pyramid import parents
from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import PHONG_ALPHA, smooth_input
from btfpipe.surface.surface import Level, Surface
from btfpipe.surface.topology import describe, edge_lengths, mesh_area

_TOLERANCE = 0.05
_MORE_VERTICES, _MOST_MORE = 1.25, 3.0  # growth from one trial to the next
_MOST_TRIED = 100_000  # vertices, or twice those asked for
_FIELD_ROUNDS = 10
_MOST_RELAXED = 20_000  # vertices; factorising takes a second, and a minute for three times as many
_FEWEST = 20  # vertices of the coarsest level
# measured as peaks of the whole process, 20,000 to 500,000 vertices, kernels to compile and some room included
_PROCESS_BYTES = 300 << 20
_BYTES_A_VERTEX = 2400


def prepare(
    vertices,
    faces,
    n_vertices=250_000,
    n_levels=3,
    *,
    strokes=None,
    crease_deg=None,
    smooth=True,
    turn=0.0,
    threads=1,
    memory=None,
    name="mesh",
    report=lambda done, total: None,
):
    """Prepare a mesh for synthesis.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    n_vertices : int
        Wanted vertices of the finest level; each coarser level has a quarter.
    n_levels : int
    strokes : list of (point, vector), optional
        Directions of s at points; without them the field is the smoothest one.
    crease_deg : float, optional
        See `smooth_input`.
    smooth : bool
        Move vertices onto the Phong tessellation of the input, so that facets do not show in silhouettes and
        shadows either.
    turn : float
        Turns the field counter-clockwise, radians.
    threads : int
        Never changes the result.
    memory : int, optional
        Bytes to stay within, by an estimate made before the work.
    name : str
        What messages call the mesh.
    report : callable
        Called with (steps done, steps in all).

    Returns
    -------
    surface : Surface
    facts : dict
        What was found, repaired and made.

    Raises
    ------
    InputError
        See `clean`; also if the finest level cannot have `n_vertices` within 5 %, if it would, without smoothing,
        lie farther from the input than `deviation` allows, or have another area; if the coarsest would have
        hardly any vertices, or if `memory` does not suffice.
    """
    _check_levels(name, n_vertices, n_levels)
    if memory is not None:
        _check_memory(name, n_vertices, memory)
    # libigl reads it at its first call
    os.environ.setdefault("IGL_NUM_THREADS", str(threads))
    vertices, faces, repairs = clean(vertices, faces, name)
    source = smooth_input(vertices, faces, crease_deg, PHONG_ALPHA if smooth else 0.0)
    euler, loops, _ = describe(faces, len(vertices))
    levels, level_distances = [], []
    for i in range(n_levels):
        wanted = max(n_vertices // 4**i, 4)
        with naming(name):
            level, made = _level(
                source, wanted, lambda done, total, i=i: report(i + done / total, n_levels + 1)
            )
        levels.append(level)
        off = made.deviation
        if i == 0:
            problem = _problem(source, made, wanted)
            if problem:
                said = _refusal(
                    name, source, wanted, problem, _most_vertices(wanted, memory),
                    lambda share: report(1 + n_levels * share, n_levels + 1),
                )  # fmt: skip
                raise InputError(said)
            deviation = off
        level_distances.append(float(off.distances.max() / made.spacing))
        if i == 0 and smooth:
            flat = source.flat(made.place_face, made.place_weights)
            moved = np.linalg.norm(level.vertices - flat, axis=1)
            deviation = measure(level.vertices, level.faces, vertices, faces, made.spacing)
    report(n_levels, n_levels + 1)
    with naming(name):
        for wanted in _field_vertices(n_vertices, n_levels):
            levels.append(_level(source, wanted)[0])
        fallbacks = _set_parents(levels)[: n_levels - 1]
        _lay_field(levels, strokes, turn)
    levels = levels[:n_levels]
    levels[-1].parent_face = levels[-1].parent_weights = None
    finest = levels[0]
    index = field.singularities(finest.faces, finest.normals, finest.tangents)
    lengths = edge_lengths(finest.vertices, finest.faces)
    extent = float(np.ptp(vertices, axis=0).max())
    genus = (2 - loops - euler) // 2
    facts = {
        "vertices": len(finest.vertices),
        "faces": len(finest.faces),
        "level_vertices": [len(level.vertices) for level in levels],
        "area": mesh_area(finest.vertices, finest.faces),
        "area_ratio": deviation.area_ratio,
        "distance": deviation.summary(float(lengths.mean()), extent),
        "smoothing_moved": {"max": float(moved.max()), "mean": float(moved.mean())}
        if smooth
        else None,
        "level_distances_spacings": level_distances,
        "spacing": float(lengths.mean()),
        "spacing_variation": float(lengths.std() / lengths.mean()),
        "components": len(euler),
        "genus": int(genus.sum()),
        "boundaries": int(loops.sum()),
        "singularities": int((index != 0).sum()),
        "index_sum": int(index.sum()),
        **curl_facts(finest),
        "euler_characteristic": int(euler.sum()),
        "repairs": sum(repairs.values()),
        "repaired": {key: count for key, count in repairs.items() if count},
        "closest_point_parents": fallbacks,
    }
    return Surface(levels, dict(facts)), facts


def _check_levels(name, n_vertices, n_levels):
    fitting = 1
    while n_vertices // 4**fitting >= _FEWEST:
        fitting += 1
    if n_levels > fitting:
        raise InputError(
            f"{name}: {n_levels} levels of {n_vertices} vertices leave {n_vertices // 4 ** (n_levels - 1)} on the coarsest;"
            f" expected at least {_FEWEST}. Ask for at most {fitting} with --levels, or for more vertices."
        )


def _field_vertices(n_vertices, n_levels):
    """Numbers of vertices of the levels beyond the last, which only the field is laid on: the last may be dense."""
    n, found = n_vertices // 4 ** (n_levels - 1), []
    while n > _MOST_RELAXED:
        n //= 4
        found.append(n)
    return found


def _level(source, wanted, report=lambda done, total: None):
    """A level of about `wanted` vertices without tangents, and the Resampling that it shows."""
    made = resample(source, wanted, report)
    normals, positions = _smoothed(source, made)
    level = Level(
        positions, made.faces,
        normals.astype(np.float32), np.zeros_like(normals, np.float32),
    )  # fmt: skip
    return level, made


def _set_parents(levels):
    """Set each level's places on the next; returns how many vertices of each took the closest point."""
    missed = []
    for level, coarser in itertools.pairwise(levels):
        level.parent_face, level.parent_weights, closest = parents(
            level.vertices, level.normals, coarser.vertices, coarser.faces
        )
        missed.append(closest)
    return missed


def _smoothed(source, made):
    """Normals and positions of the vertices as if the input had no facets; without smoothing as they are.

    Positions lie on the Phong tessellation, moved so that triangles agree with their normals. None lies farther from
    the input than the Phong tessellation of its paper does at most: what would go beyond is eased.
    """
    faces, place, weights = made
    normals = source.normals(place, weights)
    lifted = source.lift(place, weights)
    if source.alpha == 0:
        return normals, lifted
    width = source.widths(place, weights) / made.spacing
    normals = fair_normals(faces, normals, width)
    move = consistent_positions(lifted, faces, normals, width) - lifted
    length = np.linalg.norm(move, axis=1)
    left = source.largest_move() - np.linalg.norm(lifted - source.flat(place, weights), axis=1)
    share = source.agreeing(place, weights) * _eased(length, left) / np.maximum(length, 1e-300)
    return normals, lifted + share[:, None] * move


def _eased(length, most):
    """Lengths up to half of `most` as they are, longer ones smoothly shortened to below `most`."""
    beyond = 2 * length / np.maximum(most, 1e-300) - 1
    return np.where(beyond > 0, most * (1 + np.tanh(beyond)) / 2, length)


def _most_vertices(wanted, memory):
    """How many vertices are tried when those asked for do not suffice."""
    most = max(_MOST_TRIED, 2 * wanted)
    if memory is None:
        return most
    return min(most, (memory - _PROCESS_BYTES) // _BYTES_A_VERTEX)


def _check_memory(name, n_vertices, memory):
    need = _PROCESS_BYTES + _BYTES_A_VERTEX * n_vertices
    if need > memory:
        fits = max(0, (memory - _PROCESS_BYTES) // _BYTES_A_VERTEX)
        advice = f", or ask for at most {fits} with --vertices" if fits >= 100 else ""
        raise InputError(
            f"{name}: {n_vertices} vertices need about {too_little(need, memory)}{advice}."
        )


def _problem(source, made, wanted):
    """What a resampling without smoothing does wrong, as words, and how many times too wrong; nothing if nothing is."""
    spacing, deviation = made.spacing, made.deviation
    found = len(made.place_face)
    if abs(found - wanted) > _TOLERANCE * wanted:
        return (
            f"{found} is as near as its edges, boundaries and components allow"
            f" ({len(describe(source.faces, len(source.vertices))[0])} components)"
        ), found / wanted
    beyond = farthest_beyond(deviation, spacing, sharp_tips(source.vertices, source.faces, spacing))
    if beyond:
        where = ", ".join(f"{x:.4g}" for x in beyond[1])
        return (
            f"they would lie {beyond[0] / spacing:.2f} spacings from it, at ({where}), and at most"
            f" {MOST_SPACINGS:g} are allowed ({MOST_SPACINGS_AT_TIPS:g} at tips)"
        ), 1.0
    error, most = abs(deviation.area_ratio - 1), most_area_error(wanted)
    if error > most:
        return (
            f"its area would change by {100 * error:.1f} %, and at most {100 * most:.1f} % are allowed:"
            " detail finer than their spacing is lost"
        ), error / most
    return None


def _refusal(name, source, wanted, problem, most, report):
    """The sentence that says what is wrong and how many vertices do, of at most `most`.

    That many are tried. Steps grow, so that a shape that none suffice for is known after a few of them.
    """
    said, excess = problem
    start = f"{name}: {wanted} vertices asked for are too few for its shape: {said}."
    n, least = wanted, 1.0
    while n < most:
        least = min(least * _MORE_VERTICES, _MOST_MORE)
        n = min(math.ceil(n * min(max(excess, least), _MOST_MORE) / 100) * 100, most)
        report(n / most)
        problem = _problem(source, resample(source, n), n)
        if not problem:
            return f"{start} Ask for {n} with --vertices."
        excess = problem[1]
    return (
        f"{start} Up to {n} were tried, and do not suffice. Ask for more, or leave out what is too fine to show, for example"
        " with MeshLab's filter `Simplification: Quadric Edge Collapse Decimation`."
    )


def _lay_field(levels, strokes, turn):
    """Fill the tangents of all levels, from the coarsest up."""
    coarsest = levels[-1]
    geometry = coarsest.vertices, coarsest.faces, coarsest.normals
    if strokes:
        vectors = field.stroke_field(*geometry, strokes)
    else:
        vectors = field.relaxed_field(*geometry)
    for i in range(len(levels) - 1, -1, -1):
        level = levels[i]
        if level is not coarsest:
            above = levels[i + 1]
            vectors = np.einsum(
                "kc,kcx->kx", level.parent_weights, vectors[above.faces[level.parent_face]]
            )
        tangents = field.unit_field(vectors, level.faces, level.normals, _FIELD_ROUNDS)
        normals = np.asarray(level.normals, np.float64)
        level.tangents = field.turned(tangents, normals, turn).astype(np.float32)
