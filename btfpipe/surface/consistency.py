"""Geometry that agrees with shading normals: what shadows are cast by and received on."""

import numpy as np

from btfpipe.compiled import njit

# Edges that leave the normals' tangent plane by more (a sine, 20 degrees) cross creases and corners.
_STEEPEST = 0.35
# Pull towards the given surface, in the equation of one vertex. Heights follow normals up to some seven edges
# far, the facets of an input mesh seen in a dense resampling of it, and not farther.
_SCREENING = 0.03
_MOST_ITERATIONS = 100
_TOLERANCE = 1e-3


def consistent_positions(vertices, faces, normals, most):
    """Move vertices along their shading normals so that the triangles agree with these.

    A coarse mesh that is resampled densely keeps its facets, while shading normals turn smoothly across them.
    Where light grazes, such facets lie in their own or each other's shadow, though the surface that the normals
    describe does not; Phong tessellation makes them flatter, not smooth. No offset of single points mends that,
    as the facets are wider than a face. Positions and normals are brought together as in Nehab, Rusinkiewicz,
    Davis and Ramamoorthi 2005 (Efficiently combining positions and normals for precise 3D geometry): the heights
    h make edges orthogonal to the mean normal of their ends in the least squares sense,

        sum over edges ((x_j - x_i) . (n_i + n_j) / 2 + h_j - h_i)^2 + e sum over vertices h_i^2 -> min.

    Edges that cross creases are left out. Triangles that agree with their normals to second order, on whatever
    coarse mesh, stay where they are.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    normals : (n, 3) float64 or float32
        Unit shading normals.
    most : float or (n,) float64
        How far each vertex may move.

    Returns
    -------
    (n, 3) float64
    """
    heights = np.clip(_heights(vertices, faces, np.asarray(normals, np.float64)), -most, most)
    return vertices + heights[:, None] * normals


def _heights(vertices, faces, normals):
    """Heights (n,) float64 of the vertices over themselves, in units of the scene."""
    first, after = _neighbours(faces, len(vertices))
    weight = np.empty(len(after))
    degree, wanted, edge = (np.empty(len(vertices)) for _ in range(3))
    _equations(vertices, normals, first, after, weight, degree, wanted, edge)
    return _solve(first, after, weight, degree, wanted)


def _neighbours(faces, count):
    """All neighbours of each vertex, once: where its list begins, and the lists."""
    from scipy.sparse import coo_matrix

    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    rows, columns = np.concatenate([start, end]), np.concatenate([end, start])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (count, count)).tocsr()
    return graph.indptr.astype(np.int64), graph.indices


@njit(cache=True, nogil=True)
def _equations(vertices, normals, first, after, weight, degree, wanted, length):
    """Weights of all edges, 0 across creases, their sums, the right-hand side, and mean lengths of edges."""
    for i in range(len(vertices)):
        degree[i] = 0.0
        wanted[i] = 0.0
        length[i] = 0.0
        for e in range(first[i], first[i + 1]):
            j = after[e]
            rise = 0.0
            edge = 0.0
            mean = 0.0
            for c in range(3):
                along = vertices[j, c] - vertices[i, c]
                normal = (normals[i, c] + normals[j, c]) * 0.5
                rise += along * normal
                edge += along * along
                mean += normal * normal
            smooth = mean > 0.5 and rise * rise <= _STEEPEST * _STEEPEST * edge * mean
            weight[e] = 1.0 if smooth else 0.0
            degree[i] += weight[e]
            wanted[i] += weight[e] * rise
            length[i] += np.sqrt(edge) / (first[i + 1] - first[i])


@njit(cache=True, nogil=True)
def _solve(first, after, weight, degree, wanted):
    """Conjugate gradients with the diagonal as preconditioner, in one fixed order."""
    n = len(wanted)
    height = np.zeros(n)
    residual = wanted.copy()
    search = np.empty(n)
    image = np.empty(n)
    size = 0.0
    for i in range(n):
        search[i] = residual[i] / (degree[i] + _SCREENING)
        size += residual[i] * search[i]
    enough = _TOLERANCE * _TOLERANCE * size
    for _ in range(_MOST_ITERATIONS):
        if size <= enough:
            break
        curvature = 0.0
        for i in range(n):
            total = (degree[i] + _SCREENING) * search[i]
            for e in range(first[i], first[i + 1]):
                total -= weight[e] * search[after[e]]
            image[i] = total
            curvature += total * search[i]
        step = size / curvature
        before = size
        size = 0.0
        for i in range(n):
            height[i] += step * search[i]
            residual[i] -= step * image[i]
            size += residual[i] * residual[i] / (degree[i] + _SCREENING)
        for i in range(n):
            search[i] = residual[i] / (degree[i] + _SCREENING) + size / before * search[i]
    return height
