"""Compiled moves of a triangle mesh's vertices, which leave its connectivity as it is; tables as in `_edges`."""

import numpy as np
from numba import prange

from btfpipe.compiled import njit
from btfpipe.surface._edges import cosine, cross, next_of, previous_of

_DAMPING = 0.5  # all vertices move at once: whole steps would overshoot and oscillate
_TURNED = 0.5  # cosine of the turn of a normal that makes a fold
_BESIDE = 0.4  # weight of a line's neighbours beside it, against 1 on it


@njit(cache=True, nogil=True, parallel=True)
def relax(corner, opposite, feature, leave, kind, points, n_vertices, step):
    """Fill `step` with each vertex's move towards the middle of its neighbours, within the tangent plane.

    Neighbours are weighted by the areas around the edge to them, so that crowded vertices spread.
    Vertices of kind 1 move along their line, towards the middle of its two neighbours and a little towards that
    of all others, so that vertices on lines close to each other interleave. Those of kind 2 stay.
    """
    for v in prange(n_vertices):
        step[v, 0] = step[v, 1] = step[v, 2] = 0.0
        h = leave[v]
        if h < 0 or kind[v] == 2:
            continue
        x, y, z = points[v, 0], points[v, 1], points[v, 2]
        nx = ny = nz = cx = cy = cz = total = 0.0
        # of a line: where it goes on either way
        fx = fy = fz = gx = gy = gz = 0.0
        while True:
            b, c = corner[next_of(h)], corner[previous_of(h)]
            if kind[v] == 1:
                weight = _BESIDE
                if feature[h]:
                    weight = 1.0
                    gx, gy, gz = fx, fy, fz
                    fx, fy, fz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
                cx += weight * points[b, 0]
                cy += weight * points[b, 1]
                cz += weight * points[b, 2]
                total += weight
            else:
                ex, ey, ez = cross(
                    x, y, z,
                    points[b, 0], points[b, 1], points[b, 2],
                    points[c, 0], points[c, 1], points[c, 2],
                )  # fmt: skip
                nx += ex
                ny += ey
                nz += ez
                area = np.sqrt(ex * ex + ey * ey + ez * ez)
                total += 2.0 * area
                cx += area * (points[b, 0] + points[c, 0])
                cy += area * (points[b, 1] + points[c, 1])
                cz += area * (points[b, 2] + points[c, 2])
            p = previous_of(h)
            h = opposite[p]
            if h < 0:
                if kind[v] == 1:
                    b = corner[p]
                    gx, gy, gz = fx, fy, fz
                    fx, fy, fz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
                    cx += points[b, 0]
                    cy += points[b, 1]
                    cz += points[b, 2]
                    total += 1.0
                break
            if h == leave[v]:
                break
        if total <= 0.0:
            continue
        dx, dy, dz = cx / total - x, cy / total - y, cz / total - z
        if kind[v] == 0:
            n2 = nx * nx + ny * ny + nz * nz
            if n2 > 0.0:
                k = (dx * nx + dy * ny + dz * nz) / n2
                dx, dy, dz = dx - k * nx, dy - k * ny, dz - k * nz
        else:
            fx, fy, fz = fx - gx, fy - gy, fz - gz
            f2 = fx * fx + fy * fy + fz * fz
            k = (dx * fx + dy * fy + dz * fz) / f2 if f2 > 0.0 else 0.0
            dx, dy, dz = k * fx, k * fy, k * fz
        step[v, 0], step[v, 1], step[v, 2] = _DAMPING * dx, _DAMPING * dy, _DAMPING * dz


@njit(cache=True, nogil=True)
def folded(corner, n_faces, points, place, moved, moved_place, normals, keep):
    """Mark the vertices of faces that a move of all vertices turns over; returns whether there are any.

    A face is turned over if its normal turns by more than 60 degrees and then agrees less than
    before with the normals of the input where its corners lie.

    Parameters
    ----------
    corner : (3 m,) int32
    n_faces : int
    points, moved : (n, 3) float64
        Before and after the move.
    place, moved_place : (n,) int32
        Faces of the input, before and after.
    normals : (faces of the input, 3) float64
    keep : (n,) uint8
        Set to 1 for what should stay.
    """
    found = False
    for f in range(n_faces):
        a, b, c = corner[3 * f], corner[3 * f + 1], corner[3 * f + 2]
        ox, oy, oz = cross(
            points[a, 0], points[a, 1], points[a, 2],
            points[b, 0], points[b, 1], points[b, 2],
            points[c, 0], points[c, 1], points[c, 2],
        )  # fmt: skip
        nx, ny, nz = cross(
            moved[a, 0], moved[a, 1], moved[a, 2],
            moved[b, 0], moved[b, 1], moved[b, 2],
            moved[c, 0], moved[c, 1], moved[c, 2],
        )  # fmt: skip
        if cosine(ox, oy, oz, nx, ny, nz) >= _TURNED:
            continue
        before = _agreement(normals, place[a], place[b], place[c], ox, oy, oz)
        if _agreement(normals, moved_place[a], moved_place[b], moved_place[c], nx, ny, nz) < before:
            found = True
            keep[a] = keep[b] = keep[c] = 1
    return found


@njit(cache=True, nogil=True, inline="always")
def _agreement(normals, i, j, k, x, y, z):
    """Cosine of the angle between a vector and the sum of three normals."""
    return cosine(
        normals[i, 0] + normals[j, 0] + normals[k, 0],
        normals[i, 1] + normals[j, 1] + normals[k, 1],
        normals[i, 2] + normals[j, 2] + normals[k, 2],
        x, y, z,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def name_origins(corner, n_faces, kind, place, origin):
    """Set the origin of each face to the place of one of its free vertices, if it has one."""
    for f in range(n_faces):
        for k in range(3):
            v = corner[3 * f + k]
            if kind[v] == 0:
                origin[f] = place[v]
