"""Weights between measured directions of one hemisphere.

The hemisphere is projected stereographically, (x, y) / (1 + z): circles stay circles, so the plane's Delaunay
triangulation is the sphere's. Inside the hull the weights are barycentric (Wang et al. 2009); outside,
those of the nearest point of the hull.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from btfpipe.errors import InputError

# What a compiled kernel needs of a Hemisphere. Angles of the hull's edges and triangles are in the stereographic plane.
HemisphereTables = namedtuple(
    "HemisphereTables", "vectors points triangles neighbours edges start nearest_four"
)

_GRID = 64
_EPSILON = 1e-9


class Hemisphere:
    """Interpolates over a set of directions.

    Parameters
    ----------
    directions : (n, 3) array
        Distinct unit vectors with n >= 0.
    method : str
        ``"barycentric"``: three weights from the Delaunay triangle. ``"four"``: the four nearest
        directions (Tong et al. 2002, section 6), weighted so that the weights are continuous and a measured
        direction returns itself. ``"nearest"``: one.

    Attributes
    ----------
    tables : HemisphereTables
        Flat arrays for kernels; see `find`.
    """

    def __init__(self, directions, method="barycentric"):
        vectors = np.ascontiguousarray(directions, dtype=np.float64)
        if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) == 0:
            raise InputError(f"directions have shape {vectors.shape}; expected (n, 3), n >= 1.")
        if not np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-4):
            raise InputError("directions must be unit vectors.")
        if vectors[:, 2].min() < -1e-6:
            raise InputError(
                f"direction {int(vectors[:, 2].argmin())} points below the surface; only the upper"
                " hemisphere can be interpolated."
            )
        if method not in ("barycentric", "four", "nearest"):
            raise InputError(f"interpolation {method!r}; expected barycentric, four or nearest.")
        self.directions = vectors
        self.method = method
        points = vectors[:, :2] / (1 + vectors[:, 2:])
        triangles, neighbours, edges = _triangulate(points)
        start = np.zeros((_GRID, _GRID), np.int32)
        if len(triangles):
            # the triangle whose centre is nearest to the cell's is a good place to start walking from
            centres = points[triangles].mean(axis=1)
            cell = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
            x, y = np.meshgrid(cell, cell, indexing="ij")
            grid = np.stack([x.ravel(), y.ravel()], axis=1)
            distance = ((grid[:, None] - centres[None]) ** 2).sum(axis=2)
            start = distance.argmin(axis=1).astype(np.int32).reshape(_GRID, _GRID)
        mode = {"barycentric": 0, "four": 4, "nearest": 1}[method]
        self.tables = HemisphereTables(
            vectors, points, triangles, neighbours, edges, start, np.int32(mode)
        )

    def weights(self, directions):
        """Indices (m, 4) and weights (m, 4), summing to 1, for query directions (m, 3)."""
        queries = np.ascontiguousarray(directions, dtype=np.float64)
        index = np.zeros((len(queries), 4), np.int32)
        weight = np.zeros((len(queries), 4))
        _find_all(self.tables, queries, index, weight)
        return index, weight


def _triangulate(points):
    """Delaunay triangles, their neighbours and the hull's edges; degenerate sets have edges only."""
    from scipy.spatial import Delaunay, QhullError

    none = np.zeros((0, 3), np.int32)
    if len(points) >= 3:
        try:
            mesh = Delaunay(points)
            return (
                np.ascontiguousarray(mesh.simplices, np.int32),
                np.ascontiguousarray(mesh.neighbors, np.int32),
                np.ascontiguousarray(mesh.convex_hull, np.int32),
            )
        except QhullError:
            pass  # all on one line
    axis = points - points.mean(axis=0)
    order = np.argsort(axis @ np.linalg.svd(axis)[2][0], kind="stable").astype(np.int32)
    if len(order) == 1:
        return none, none, np.array([[0, 0]], np.int32)
    return none, none, np.ascontiguousarray(np.stack([order[:-1], order[1:]], axis=1))


@njit(cache=True, nogil=True)
def find(tables, x, y, z, index, weight):
    """Weights of direction (x, y, z) over the measured ones.

    Parameters
    ----------
    tables : HemisphereTables
    x, y, z : float
        Unit vector; below the surface it is taken at the horizon.
    index, weight : (4,) int32, (4,) float64
        Filled in place.

    Returns
    -------
    int
        How many entries are used: 1, 3 or 4.
    """
    if z < 0.0:
        length = np.sqrt(x * x + y * y) + 1e-30
        x /= length
        y /= length
        z = 0.0
    if tables.nearest_four > 0:
        return _nearest(tables.vectors, x, y, z, tables.nearest_four, index, weight)
    px = x / (1.0 + z)
    py = y / (1.0 + z)
    points = tables.points
    triangles = tables.triangles
    if triangles.shape[0] > 0:
        i = min(max(int((px + 1.0) * 0.5 * _GRID), 0), _GRID - 1)
        j = min(max(int((py + 1.0) * 0.5 * _GRID), 0), _GRID - 1)
        triangle = tables.start[i, j]
        for _ in range(triangles.shape[0]):
            a = triangles[triangle, 0]
            b = triangles[triangle, 1]
            c = triangles[triangle, 2]
            ux = points[b, 0] - points[a, 0]
            uy = points[b, 1] - points[a, 1]
            vx = points[c, 0] - points[a, 0]
            vy = points[c, 1] - points[a, 1]
            qx = px - points[a, 0]
            qy = py - points[a, 1]
            area = ux * vy - uy * vx
            wb = (qx * vy - qy * vx) / area
            wc = (ux * qy - uy * qx) / area
            wa = 1.0 - wb - wc
            least = 0
            low = wa
            if wb < low:
                least = 1
                low = wb
            if wc < low:
                least = 2
                low = wc
            if low >= -_EPSILON:
                index[0] = a
                index[1] = b
                index[2] = c
                weight[0] = wa
                weight[1] = wb
                weight[2] = wc
                return 3
            following = tables.neighbours[triangle, least]
            if following < 0:
                break
            triangle = following
    best = np.inf
    index[2] = 0
    weight[2] = 0.0
    for e in range(tables.edges.shape[0]):
        a = tables.edges[e, 0]
        b = tables.edges[e, 1]
        ux = points[b, 0] - points[a, 0]
        uy = points[b, 1] - points[a, 1]
        length = ux * ux + uy * uy
        along = 0.0
        if length > 0.0:
            along = ((px - points[a, 0]) * ux + (py - points[a, 1]) * uy) / length
            along = min(max(along, 0.0), 1.0)
        dx = points[a, 0] + along * ux - px
        dy = points[a, 1] + along * uy - py
        distance = dx * dx + dy * dy
        if distance < best:
            best = distance
            index[0] = a
            index[1] = b
            weight[0] = 1.0 - along
            weight[1] = along
    return 3


@njit(cache=True, nogil=True)
def _nearest(vectors, x, y, z, count, index, weight):
    """The nearest directions; weights fall to zero at the distance of the next one (Shepard, Franke-Little)."""
    n = vectors.shape[0]
    used = min(count, n)
    distance = np.full(5, np.inf)
    order = np.zeros(5, np.int32)
    for k in range(n):
        dx = vectors[k, 0] - x
        dy = vectors[k, 1] - y
        dz = vectors[k, 2] - z
        chord = np.sqrt(dx * dx + dy * dy + dz * dz)
        if chord < distance[used]:
            place = used
            while place > 0 and distance[place - 1] > chord:
                distance[place] = distance[place - 1]
                order[place] = order[place - 1]
                place -= 1
            distance[place] = chord
            order[place] = k
    if used == 1:
        index[0] = order[0]
        weight[0] = 1.0
        return 1
    radius = distance[used] if n > used else 2.0
    total = 0.0
    for k in range(used):
        index[k] = order[k]
        if distance[k] < 1e-9:
            for other in range(used):
                weight[other] = 0.0
            weight[k] = 1.0
            for other in range(k + 1, used):
                index[other] = order[other]
            return used
        w = (1.0 / distance[k] - 1.0 / radius) ** 2
        weight[k] = w
        total += w
    if total <= 0.0:
        for k in range(used):
            weight[k] = 1.0 / used
        return used
    for k in range(used):
        weight[k] /= total
    return used


@njit(cache=True, nogil=True)
def _find_all(tables, queries, index, weight):
    for q in range(queries.shape[0]):
        find(tables, queries[q, 0], queries[q, 1], queries[q, 2], index[q], weight[q])
