"""Weights between measured directions of one hemisphere.

The hemisphere is projected stereographically, (x, y) / (1 + z): circles stay circles, so the plane's Delaunay
triangulation is the sphere's. Inside the hull the weights are barycentric (Wang et al. 2009); outside,
those of the nearest point of the hull.
"""

from collections import namedtuple

import numpy as np

from btfpipe.compiled import njit
from btfpipe.errors import InputError

# What a compiled kernel needs of a Hemisphere; all in the stereographic plane but `vectors`.
#   vectors      (n, 3)      the directions
#   triangles    (m, 3)      corners
#   neighbours   (m, 3)      triangle across the edge that faces each corner, -1 outside
#   inverse      (m, 6)      origin x, y (the first corner), and the matrix that gives the two other weights
#   edges        (k, 6)      of the hull: first end x, y, the vector to the second, and that over its length squared
#   ends         (k, 2)      directions at their ends
#   border       (g*g+1,), (*,)  edges that can be the nearest of a point in each cell of the grid, as lists
#   start        (g*g,)      triangle under the middle of each cell of a grid over [-1, 1]^2, or near it
#   first, near  (g*g+1,), (*,)  directions that can be among the nearest five of a point in each cell of the grid
#   mode         0 barycentric, else the number of nearest directions
HemisphereTables = namedtuple(
    "HemisphereTables",
    "vectors triangles neighbours inverse edges ends border_first border start first near mode",
)

_GRID = 128
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
        vectors = np.array(directions, dtype=np.float64)
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
        mode = {"barycentric": 0, "four": 4, "nearest": 1}[method]
        cell = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
        grid = np.stack(np.meshgrid(cell, cell, indexing="ij"), axis=-1).reshape(-1, 2)
        triangles, neighbours, edges, start = _triangulate(points, grid)
        first, near = _candidates(vectors, grid) if mode else (np.zeros(1, np.int32),) * 2
        self.tables = HemisphereTables(
            vectors, triangles, neighbours, _inverses(points, triangles),
            *_border(points, edges, grid), start, first, near, np.int32(mode),
        )  # fmt: skip

    def weights(self, directions):
        """Indices (m, 4) and weights (m, 4), summing to 1, for query directions (m, 3)."""
        queries = np.ascontiguousarray(directions, dtype=np.float64)
        index = np.zeros((len(queries), 4), np.int32)
        weight = np.zeros((len(queries), 4))
        find(self.tables, queries, index, weight)
        return index, weight


def _triangulate(points, grid):
    """Delaunay triangles, their neighbours, the hull's edges, and where a walk to each cell of the grid starts.

    Degenerate sets have edges only.
    """
    from scipy.spatial import Delaunay, QhullError, cKDTree

    none = np.zeros((0, 3), np.int32)
    if len(points) >= 3:
        try:
            mesh = Delaunay(points)
        except QhullError:
            pass  # all on one line
        else:
            # under the cell's middle, or outside the hull the triangle with the nearest centre
            start = mesh.find_simplex(grid)
            nearest = cKDTree(points[mesh.simplices].mean(axis=1)).query(grid)[1]
            start = np.where(start >= 0, start, nearest)
            parts = (mesh.simplices, mesh.neighbors, mesh.convex_hull, start)
            return tuple(np.ascontiguousarray(part, np.int32) for part in parts)
    axis = points - points.mean(axis=0)
    order = np.argsort(axis @ np.linalg.svd(axis)[2][0], kind="stable").astype(np.int32)
    edges = np.array([[0, 0]]) if len(order) == 1 else np.stack([order[:-1], order[1:]], axis=1)
    return none, none, np.ascontiguousarray(edges, np.int32), np.zeros(len(grid), np.int32)


def _inverses(points, triangles):
    """First corner and inverse of the edges' matrix of each triangle, (m, 6)."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])[:, None]
    rows = np.concatenate([v[:, 1:], -v[:, :1], -u[:, 1:], u[:, :1]], axis=1)
    return np.ascontiguousarray(np.concatenate([a, rows / area], axis=1))


def _border(points, edges, grid):
    """The hull's edges as (edges, ends), and the lists (first, border) of those near each cell."""
    origin = points[edges[:, 0]]
    along = points[edges[:, 1]] - origin
    squared = np.maximum((along**2).sum(axis=1, keepdims=True), 1e-300)
    share = ((grid[:, None] - origin) * (along / squared)).sum(axis=2)[..., None]
    nearest = origin + np.clip(share, 0, 1) * along
    distance = np.linalg.norm(nearest - grid[:, None], axis=2)
    # twice the way from the cell's middle to its corner
    close = distance <= distance.min(axis=1, keepdims=True) + 2 * np.sqrt(2) / _GRID + 1e-9
    first = np.concatenate([[0], np.cumsum(close.sum(axis=1))]).astype(np.int32)
    border = np.nonzero(close)[1].astype(np.int32)
    return np.concatenate([origin, along, along / squared], axis=1), edges, first, border


def _candidates(vectors, grid):
    """For each cell the directions that can be among the five nearest of any point in it, as (first, near).

    A chord is at most twice as long as its projection, so no point of a cell is farther than `reach` from the
    cell's middle, and no chord changes by more than that across it.
    """
    from scipy.spatial import cKDTree

    reach = 2 * np.sqrt(2) / _GRID
    squared = (grid**2).sum(axis=1, keepdims=True)
    middle = np.concatenate([2 * grid, 1 - squared], axis=1) / (1 + squared)
    tree = cKDTree(vectors)
    count = min(5, len(vectors))
    fifth = tree.query(middle, k=[count])[0][:, 0]
    lists = tree.query_ball_point(middle, fifth + 2 * reach + 1e-9, return_sorted=True)
    first = np.concatenate([[0], np.cumsum([len(a) for a in lists])]).astype(np.int32)
    return first, np.concatenate(lists).astype(np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def find(tables, directions, index, weight):
    """Weights of many directions over the measured ones.

    The tables are unpacked once for all queries: passing them to a call for each one costs as much as finding it.

    Parameters
    ----------
    tables : HemisphereTables
    directions : (m, 3) float32 or float64
        Unit vectors; those below the surface are taken at the horizon.
    index, weight : (m, 4) int32, (m, 4) float64
        Filled in place; entries of weight 0 name some direction.
    """
    vectors, triangles, neighbours = tables.vectors, tables.triangles, tables.neighbours
    inverse, start, mode = tables.inverse, tables.start, tables.mode
    edges, ends, border_first, border = (
        tables.edges, tables.ends, tables.border_first, tables.border,
    )  # fmt: skip
    first, near = tables.first, tables.near
    steps = triangles.shape[0]
    for q in range(len(directions)):
        x = float(directions[q, 0])
        y = float(directions[q, 1])
        z = float(directions[q, 2])
        if z < 0.0:
            length = np.sqrt(x * x + y * y) + 1e-30
            x /= length
            y /= length
            z = 0.0
        scale = 1.0 / (1.0 + z)
        px = x * scale
        py = y * scale
        i = min(max(int((px + 1.0) * (0.5 * _GRID)), 0), _GRID - 1)
        j = min(max(int((py + 1.0) * (0.5 * _GRID)), 0), _GRID - 1)
        cell = i * _GRID + j
        if mode > 0:
            _nearest(vectors, first, near, cell, x, y, z, mode, index, weight, q)
            continue
        triangle = start[cell] if steps > 0 else -1
        while triangle >= 0:
            qx = px - inverse[triangle, 0]
            qy = py - inverse[triangle, 1]
            wb = inverse[triangle, 2] * qx + inverse[triangle, 3] * qy
            wc = inverse[triangle, 4] * qx + inverse[triangle, 5] * qy
            wa = 1.0 - wb - wc
            if wa >= -_EPSILON and wb >= -_EPSILON and wc >= -_EPSILON:
                index[q, 0] = triangles[triangle, 0]
                index[q, 1] = triangles[triangle, 1]
                index[q, 2] = triangles[triangle, 2]
                weight[q, 0] = wa
                weight[q, 1] = wb
                weight[q, 2] = wc
                break
            # on across the edge that is farthest behind; a Delaunay triangulation has no loops for this walk
            least = 0
            low = wa
            if wb < low:
                least = 1
                low = wb
            if wc < low:
                least = 2
            triangle = neighbours[triangle, least]
        if triangle < 0:
            best = np.inf
            for at in range(border_first[cell], border_first[cell + 1]):
                e = border[at]
                qx = px - edges[e, 0]
                qy = py - edges[e, 1]
                along = min(max(qx * edges[e, 4] + qy * edges[e, 5], 0.0), 1.0)
                qx -= along * edges[e, 2]
                qy -= along * edges[e, 3]
                distance = qx * qx + qy * qy
                if distance < best:
                    best = distance
                    index[q, 0] = ends[e, 0]
                    index[q, 1] = ends[e, 1]
                    weight[q, 0] = 1.0 - along
                    weight[q, 1] = along
            index[q, 2] = 0
            weight[q, 2] = 0.0
        index[q, 3] = 0
        weight[q, 3] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(vectors, first, near, cell, x, y, z, count, indices, weights, q):
    """The nearest directions; weights fall to zero at the distance of the next one (Shepard, Franke-Little)."""
    index = indices[q]
    weight = weights[q]
    for k in range(4):
        index[k] = 0
        weight[k] = 0.0
    n = vectors.shape[0]
    used = min(count, n)
    for k in range(used):
        weight[k] = np.inf
    beyond = np.inf  # distance of the nearest one that is left out
    for at in range(first[cell], first[cell + 1]):
        k = near[at]
        dx = vectors[k, 0] - x
        dy = vectors[k, 1] - y
        dz = vectors[k, 2] - z
        chord = dx * dx + dy * dy + dz * dz
        if chord < weight[used - 1]:
            beyond = weight[used - 1]
            place = used - 1
            while place > 0 and weight[place - 1] > chord:
                weight[place] = weight[place - 1]
                index[place] = index[place - 1]
                place -= 1
            weight[place] = chord
            index[place] = k
        elif chord < beyond:
            beyond = chord
    if used == 1:
        weight[0] = 1.0
        return
    radius = np.sqrt(beyond) if n > used else 2.0
    total = 0.0
    if weight[0] < 1e-18:
        weight[0] = 1.0
        for k in range(1, used):
            weight[k] = 0.0
        return
    for k in range(used):
        w = (1.0 / np.sqrt(weight[k]) - 1.0 / radius) ** 2
        weight[k] = w
        total += w
    if total <= 0.0:
        for k in range(used):
            weight[k] = 1.0 / used
        return
    for k in range(used):
        weight[k] /= total
