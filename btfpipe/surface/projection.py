"""Closest points near a known one: points walk over the input mesh, face by face.

A global search for the closest point may land on the other side of a thin wall. A walk cannot: it goes
from a face to its neighbours for as long as that brings it nearer, and it does not cross feature lines.
"""

from numba import prange

from btfpipe.compiled import njit

_MOST_STEPS = 10_000  # faces that one walk may cross; distances fall, so it ends anyway
_NEARER = 1 - 1e-9  # of the squared distance: less is rounding


@njit(cache=True, nogil=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, inline="always")
def _from(a, b):
    return (b[0] - a[0], b[1] - a[1], b[2] - a[2])


@njit(cache=True, nogil=True)
def closest_in_triangle(p, a, b, c):
    """Barycentric coordinates (u, v, w) of the point of a triangle that is closest to p, and their squared distance.

    Decided by the Voronoi regions of corners, edges and face, as in Ericson 2005 (section 5.1.5).
    Triangles without area give a point on their border.
    """
    ab, ac, ap = _from(a, b), _from(a, c), _from(a, p)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    bp = _from(b, p)
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    cp = _from(c, p)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        u, v, w = 1.0, 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        u, v, w = 0.0, 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        u, v, w = 0.0, 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3) if d1 > d3 else 0.0
        u, w = 1.0 - v, 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6) if d2 > d6 else 0.0
        u, v = 1.0 - w, 0.0
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        span = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / span if span > 0.0 else 0.0
        u, v = 0.0, 1.0 - w
    else:
        total = va + vb + vc
        v, w = vb / total, vc / total
        u = 1.0 - v - w
    x = u * a[0] + v * b[0] + w * c[0] - p[0]
    y = u * a[1] + v * b[1] + w * c[1] - p[1]
    z = u * a[2] + v * b[2] + w * c[2] - p[2]
    return u, v, w, x * x + y * y + z * z


@njit(cache=True, nogil=True, inline="always")
def _row(array, i):
    return (array[i, 0], array[i, 1], array[i, 2])


@njit(cache=True, nogil=True, inline="always")
def _on_face(vertices, faces, f, p):
    return closest_in_triangle(
        p, _row(vertices, faces[f, 0]), _row(vertices, faces[f, 1]), _row(vertices, faces[f, 2])
    )


@njit(cache=True, nogil=True)
def _best_around(vertices, faces, across, f, k, p, best):
    """The face around corner k of face f that comes nearest to p, and the squared distance; f and `best` if none does."""
    found, least = f, best * _NEARER
    for side in range(2):
        h = 3 * f + k
        for _ in range(_MOST_STEPS):
            # turn about the corner: across the edge before it, or across the edge after it
            g = across[h - 1 if h % 3 > 0 else h + 2] if side == 0 else across[h]
            if g < 0:
                break
            h = g if side == 0 else (g + 1 if g % 3 < 2 else g - 2)
            if h // 3 == f:
                return found, least
            d = _on_face(vertices, faces, h // 3, p)[3]
            if d < least:
                found, least = h // 3, d
    return found, least


@njit(cache=True, nogil=True)
def _walk(vertices, faces, across, f, p):
    """Face and barycentric coordinates of the locally closest point to p, walking from face f."""
    u, v, w, best = _on_face(vertices, faces, f, p)
    for _ in range(_MOST_STEPS):
        outside = (u == 0.0) + (v == 0.0) + (w == 0.0)
        if outside == 0:
            break
        if outside == 1:
            # on the edge across from the corner without weight
            h = 3 * f + (1 if u == 0.0 else (2 if v == 0.0 else 0))
            g = across[h]
            if g < 0 or not _on_face(vertices, faces, g // 3, p)[3] < best * _NEARER:
                break
            f = g // 3
        else:
            k = 0 if u > 0.0 else (1 if v > 0.0 else 2)
            g = f
            f, _ = _best_around(vertices, faces, across, f, k, p, best)
            if f == g:
                break
        u, v, w, best = _on_face(vertices, faces, f, p)
    return f, u, v, w


@njit(cache=True, nogil=True, parallel=True)
def walk_faces(vertices, faces, across, points, face, weights, nearest, blocked):
    """Bring points to the locally closest ones of a mesh, walking from given faces.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    across : (3 m,) int32
        The half-edge on the other side of each, -1 where walks end: on boundaries and feature lines.
    points : (k, 3) float64
    face : (k,) int32
        Where each walk starts; filled with where it ends.
    weights : (k, 3) float64
        Filled with barycentric coordinates there.
    nearest : (k, 3) float64
        Filled with the closest points.
    blocked : (k,) uint8
        Filled: 1 where a walk ended on a boundary or a feature line.
    """
    for i in prange(len(points)):
        f, u, v, w = _walk(vertices, faces, across, face[i], _row(points, i))
        face[i] = f
        blocked[i] = (
            (w == 0.0 and across[3 * f] < 0)
            or (u == 0.0 and across[3 * f + 1] < 0)
            or (v == 0.0 and across[3 * f + 2] < 0)
        )
        weights[i, 0], weights[i, 1], weights[i, 2] = u, v, w
        for x in range(3):
            nearest[i, x] = (
                u * vertices[faces[f, 0], x]
                + v * vertices[faces[f, 1], x]
                + w * vertices[faces[f, 2], x]
            )


@njit(cache=True, nogil=True, inline="always")
def _on_segment(vertices, ends, e, p):
    """Fraction from the first end of the closest point to p on an edge, and the squared distance."""
    a, b = _row(vertices, ends[e, 0]), _row(vertices, ends[e, 1])
    ab, ap = _from(a, b), _from(a, p)
    long = _dot(ab, ab)
    s = min(max(_dot(ab, ap) / long, 0.0), 1.0) if long > 0.0 else 0.0
    d = (ap[0] - s * ab[0], ap[1] - s * ab[1], ap[2] - s * ab[2])
    return s, _dot(d, d)


@njit(cache=True, nogil=True)
def walk_lines(vertices, ends, after, points, edge, fraction, nearest):
    """Bring points to the locally closest ones of feature lines, walking from given edges.

    Parameters
    ----------
    vertices : (n, 3) float64
    ends : (e, 2) int64
        Vertices of the edges.
    after : (e, 2) int32
        The edge that goes on beyond each end, or -1 where the line ends.
    points : (k, 3) float64
    edge : (k,) int32
        Where each walk starts; filled with where it ends.
    fraction : (k,) float64
        Filled: 0 at the edge's first vertex, 1 at its second.
    nearest : (k, 3) float64
        Filled with the closest points.
    """
    for i in range(len(points)):
        p = _row(points, i)
        e = edge[i]
        s, best = _on_segment(vertices, ends, e, p)
        for _ in range(_MOST_STEPS):
            if 0.0 < s < 1.0:
                break
            other = after[e, 0 if s == 0.0 else 1]
            if other < 0:
                break
            t, d = _on_segment(vertices, ends, other, p)
            if not d < best * _NEARER:
                break
            e, s, best = other, t, d
        edge[i], fraction[i] = e, s
        for x in range(3):
            nearest[i, x] = (1 - s) * vertices[ends[e, 0], x] + s * vertices[ends[e, 1], x]
