"""From a raw mesh to a Surface: clean, resample, give frames, stack levels."""

import itertools
import os

import numpy as np

from btfpipe.errors import InputError, naming, too_little
from btfpipe.surface import field
from btfpipe.surface.cleaning import clean
from btfpipe.surface.curl import curl_facts
from btfpipe.surface.pyramid import parents
from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import PHONG_ALPHA, smooth_input
from btfpipe.surface.surface import Level, Surface
from btfpipe.surface.topology import describe, edges

_TOLERANCE = 0.05
_FIELD_ROUNDS = 10
_FEWEST = 20  # vertices of the coarsest level
# measured as peaks of the whole process, 60,000 to 500,000 vertices, with some room
_PROCESS_BYTES = 200 << 20
_BYTES_A_VERTEX = 1500


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
        See `clean`; also if the finest level cannot have `n_vertices` within 5 %, if the coarsest would have
        hardly any, or if `memory` does not suffice.
    """
    _check_levels(name, n_vertices, n_levels)
    if memory is not None:
        _check_memory(name, n_vertices, memory)
    # libigl reads it at its first call
    os.environ.setdefault("IGL_NUM_THREADS", str(threads))
    vertices, faces, repairs = clean(vertices, faces, name)
    source = smooth_input(vertices, faces, crease_deg, PHONG_ALPHA if smooth else 0.0)
    euler, loops, _ = describe(faces, len(vertices))
    levels = []
    for i in range(n_levels):
        wanted = max(n_vertices // 4**i, 4)
        with naming(name):
            fine, place, weights = resample(
                source, wanted, lambda done, total, i=i: report(i + done / total, n_levels + 1)
            )
        if i == 0:
            _check_count(name, len(place), wanted, len(euler))
        normals = source.normals(place, weights)
        levels.append(
            Level(
                source.lift(place, weights), fine,
                normals.astype(np.float32), np.zeros_like(normals, np.float32),
            )
        )  # fmt: skip
    fallbacks = []
    for level, coarser in itertools.pairwise(levels):
        level.parent_face, level.parent_weights, missed = parents(
            level.vertices, level.normals, coarser.vertices, coarser.faces
        )
        fallbacks.append(missed)
    report(n_levels, n_levels + 1)
    with naming(name):
        _lay_field(levels, strokes, turn)
    finest = levels[0]
    index = field.singularities(finest.faces, finest.normals, finest.tangents)
    pair = edges(finest.faces)
    lengths = np.linalg.norm(finest.vertices[pair[:, 0]] - finest.vertices[pair[:, 1]], axis=1)
    genus = (2 - loops - euler) // 2
    facts = {
        "vertices": len(finest.vertices),
        "faces": len(finest.faces),
        "level_vertices": [len(level.vertices) for level in levels],
        "area": float(_area(finest.vertices, finest.faces)),
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


def _check_memory(name, n_vertices, memory):
    need = _PROCESS_BYTES + _BYTES_A_VERTEX * n_vertices
    if need > memory:
        fits = max(0, (memory - _PROCESS_BYTES) // _BYTES_A_VERTEX)
        advice = f", or ask for at most {fits} with --vertices" if fits >= 100 else ""
        raise InputError(
            f"{name}: {n_vertices} vertices need about {too_little(need, memory)}{advice}."
        )


def _check_count(name, found, wanted, n_components):
    if abs(found - wanted) > _TOLERANCE * wanted:
        raise InputError(
            f"{name}: {wanted} vertices asked for, {found} is as near as its {n_components} components and its"
            f" boundaries allow. Ask for {found} or more with --vertices."
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


def _area(vertices, faces):
    corners = vertices[faces]
    return (
        0.5
        * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ).sum()
    )
