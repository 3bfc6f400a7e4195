"""How much of a coordinate map is made of whole pieces of the sample."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.sample.orientation import step_to_texels
from btfpipe.surface.flatten import turned

TOLERANCE = 0.25  # texels, by which a coherent step may differ from the vertices' own


@njit(cache=True, nogil=True)
def find_coherent(
    vertices, faces, normals, axis, row, col, texels_per_unit, rows, cols, toroidal, coherent
):
    """Mark the faces whose vertices come from one patch of the sample; the renderer interpolates coordinates inside them.

    An edge, seen in the frame half-way between its ends, is a step in texels; the coordinates at the ends must differ by
    that step, and the frames' turn against each other must move no end of it by more than the tolerance.

    Parameters
    ----------
    vertices, normals, axis : (n, 3) float
        `axis` holds the sample's s axis at each vertex.
    faces : (m, 3) int32
    row, col : (n,) float32
    texels_per_unit : float
    rows, cols, toroidal
        Of the sample.
    coherent : (m,) bool
        Filled in.
    """
    for f in range(len(faces)):
        good = True
        for k in range(3):
            a = faces[f, k]
            b = faces[f, (k + 1) % 3]
            ex = (vertices[b, 0] - vertices[a, 0]) * texels_per_unit
            ey = (vertices[b, 1] - vertices[a, 1]) * texels_per_unit
            ez = (vertices[b, 2] - vertices[a, 2]) * texels_per_unit
            length = np.sqrt(ex * ex + ey * ey + ez * ez)
            s = 0.0
            t = 0.0
            for v in (a, b):
                sx, sy, sz = axis[v, 0], axis[v, 1], axis[v, 2]
                nx, ny, nz = normals[v, 0], normals[v, 1], normals[v, 2]
                s += ex * sx + ey * sy + ez * sz
                t += ex * (ny * sz - nz * sy) + ey * (nz * sx - nx * sz) + ez * (nx * sy - ny * sx)
            flat = length / max(np.sqrt(s * s + t * t), 1e-12)  # the step keeps the edge's length
            drow, dcol = step_to_texels(s * flat, t * flat, 0.0)
            drow -= row[b] - row[a]
            dcol -= col[b] - col[a]
            if toroidal:
                drow -= np.round(drow / rows) * rows
                dcol -= np.round(dcol / cols) * cols
            sx, sy, sz = axis[a, 0], axis[a, 1], axis[a, 2]
            nx, ny, nz = normals[a, 0], normals[a, 1], normals[a, 2]
            cosine = axis[b, 0] * sx + axis[b, 1] * sy + axis[b, 2] * sz
            sine = (
                axis[b, 0] * (ny * sz - nz * sy)
                + axis[b, 1] * (nz * sx - nx * sz)
                + axis[b, 2] * (nx * sy - ny * sx)
            )
            turn = np.arctan2(sine, cosine) * length
            if drow * drow + dcol * dcol > TOLERANCE**2 or abs(turn) > TOLERANCE:
                good = False
        coherent[f] = good


def coherent_triangles(level, row, col, texels_per_unit, shape, toroidal, turn=0.0):
    """Triangles whose three coordinates differ as the vertices themselves do, to a quarter of a texel on each edge.

    Parameters
    ----------
    level : btfpipe.surface.Level
    row, col : (n,) float32
        Coordinates of the vertices in the sample.
    texels_per_unit : float
    shape : (int, int)
        Rows and cols of the sample.
    toroidal : bool
    turn : float
        Angle of the sample's s axis against the frames, radians.

    Returns
    -------
    (m,) bool
    """
    whole = np.zeros(len(level.faces), np.bool_)
    arrays = (level.vertices, level.faces, level.normals, turned(level, turn), row, col)
    find_coherent(
        *map(np.ascontiguousarray, arrays), float(texels_per_unit), *shape, bool(toroidal), whole
    )
    return whole


def coherence_facts(grown, surface, shape, toroidal):
    """Share of coherent triangles (or of a plane's steps), and the texels of the patch that a texel lies in, on average.

    Parameters
    ----------
    grown : CoordinateMap
    surface : Surface or None
        None for a plane.
    shape, toroidal
        Of the sample.

    Returns
    -------
    dict
        ``coherent_share`` of the domain, ``patch_texels``: mean size of the patches, each counted once a texel of it.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = grown.row.shape[1]
    if surface is not None:
        level = surface.levels[0]
        whole = coherent_triangles(
            level, grown.row[0], grown.col[0], grown.texels_per_unit, shape, toroidal,
            float(grown.angle[0, 0]),
        )  # fmt: skip
        faces = np.asarray(level.faces)[whole]
        first, second = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
        share = whole.mean()
        corners = np.asarray(level.vertices)[np.asarray(level.faces)]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        texels = 0.5 * area.sum() * grown.texels_per_unit**2 / n
    else:
        rows, cols = grown.domain["plane"]
        row, col = (a.reshape(rows, cols) for a in (grown.row[0], grown.col[0]))
        place = np.arange(n).reshape(rows, cols)
        first, second, steps = [], [], 0
        for axis in (0, 1):
            drow = np.roll(row, -1, axis) - row - (axis == 0)
            dcol = np.roll(col, -1, axis) - col - (axis == 1)
            if toroidal:
                drow, dcol = drow % shape[0], dcol % shape[1]
            whole = (drow == 0) & (dcol == 0)
            first.append(place[whole])
            second.append(np.roll(place, -1, axis)[whole])
            steps += whole.mean() / 2
        first, second, share, texels = np.concatenate(first), np.concatenate(second), steps, 1.0
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n))
    size = np.bincount(connected_components(graph, directed=False)[1]).astype(float)
    return {
        "coherent_share": float(share),
        "patch_texels": float((size**2).sum() / n * texels),
    }
