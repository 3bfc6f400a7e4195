"""Geometry that agrees with shading normals: what shadows are cast by and received on."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.parallel import single_threaded_blas
from btfpipe.surface.topology import half_edges, opposite_half_edges

# Edges that leave the normals' tangent plane by more (a sine, 37 degrees) cross creases and corners: faces meet at 75.
_STEEPEST = 0.6
# Heights follow normals at least so many edges far.
_NEAREST = 1.0
_MOST_ITERATIONS = 400
_TOLERANCE = 1e-3
_ONE_SIDE = 0.8  # cosine between normals of neighbours that no crease parts
_LOST = 0.2  # of waves of two facets, against one part that is kept
_EVEN_ENOUGH = 0.002  # residual, against that of the given normals


def fair_normals(faces, normals, width):
    """Normals without the facets of the input.

    Normals that are interpolated over a coarse facet turn evenly inside it, and bend at its edges: terminators are
    scalloped. Bends, shorter than two facets, are taken out by a filter of the fourth order,

        sum over vertices |m_i - n_i|^2 + 0.2 (w_i / pi)^4 |(L m)_i|^2 -> min,

    with the umbrella operator L in units of edges (Taubin 1995, A signal processing approach to fair surface design):
    waves of two facets keep five sixths of their height, waves of one facet a quarter. Creases and boundaries stay.

    Parameters
    ----------
    faces : (m, 3) int32
    normals : (n, 3) float64
        Unit normals.
    width : (n,) float64
        Widths of the input's facets in edges of this mesh.

    Returns
    -------
    (n, 3) float64
        Unit normals.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import LinearOperator, cg

    joined = _neighbour_matrix(faces, len(normals))
    row = np.repeat(np.arange(len(normals)), np.diff(joined.indptr))
    near = np.einsum("kx,kx->k", normals[row], normals[joined.indices]) > _ONE_SIDE
    whole = np.bincount(row, ~near, len(normals)) == 0
    opposite = opposite_half_edges(faces)
    start, end = half_edges(faces)
    whole[start[opposite < 0]] = whole[end[opposite < 0]] = False
    degree = np.diff(joined.indptr)
    # six neighbours at one edge's distance make 3/2 of the second derivatives' sum
    umbrella = (diags_array(degree.astype(float)) - joined) / 1.5
    stiffness = np.where(whole, _LOST * (width / np.pi) ** 4, 0.0)
    diagonal = 1 + umbrella.multiply(umbrella) @ stiffness
    size = (len(normals),) * 2
    # not multiplied out, which takes four times the memory
    system = LinearOperator(
        size, lambda x: x + umbrella @ (stiffness * (umbrella @ x)), dtype=float
    )
    inverse = LinearOperator(size, lambda x: x / diagonal, dtype=float)
    fair = np.empty_like(normals)
    with single_threaded_blas():
        for c in range(3):
            uneven = np.linalg.norm(system.matvec(normals[:, c]) - normals[:, c])
            fair[:, c], _ = cg(
                system, normals[:, c], normals[:, c], rtol=1e-9, atol=_EVEN_ENOUGH * uneven,
                maxiter=_MOST_ITERATIONS, M=inverse,
            )  # fmt: skip
    return fair / np.linalg.norm(fair, axis=1, keepdims=True)


def consistent_positions(vertices, faces, normals, width):
    """Move vertices along their shading normals so that the triangles agree with these.

    A coarse mesh that is resampled densely keeps its facets, while shading normals turn smoothly across them.
    Where light grazes, such facets lie in their own or each other's shadow, though the surface that the normals
    describe does not; Phong tessellation makes them smooth only where the normals at their corners are those of one
    quadric. No offset of single points mends that, as the facets are wider than a face. Positions and normals are
    brought together as in Nehab, Rusinkiewicz, Davis and Ramamoorthi 2005 (Efficiently combining positions and normals
    for precise 3D geometry): the heights h make edges orthogonal to the mean normal of their ends in the least
    squares sense,

        sum over edges ((x_j - x_i) . (n_i + n_j) / 2 + h_j - h_i)^2 + sum over vertices (h_i / w_i)^2 -> min.

    Heights follow the normals as far as facets are wide, w edges, and not farther. Edges that cross creases are left
    out. Triangles that agree with their normals to second order, on whatever coarse mesh, stay where they are.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    normals : (n, 3) float64 or float32
        Unit shading normals.
    width : float or (n,) float64
        Widths of the input's facets in edges of this mesh.

    Returns
    -------
    (n, 3) float64
    """
    normals = np.asarray(normals, np.float64)
    joined = _neighbour_matrix(faces, len(vertices))
    first, after = joined.indptr, joined.indices
    weight = np.empty(len(after))
    degree, wanted = np.empty((2, len(vertices)))
    _equations(vertices, normals, first, after, weight, degree, wanted)
    pull = 1 / np.maximum(np.broadcast_to(width, len(vertices)), _NEAREST) ** 2
    heights = _solve(first, after, weight, degree + pull, wanted)
    return vertices + heights[:, None] * normals


def _neighbour_matrix(faces, count):
    """A sparse (count, count) matrix with a 1 for each pair of neighbours, float64."""
    from scipy.sparse import coo_array

    start, end = half_edges(faces)
    rows, columns = np.concatenate([start, end]), np.concatenate([end, start])
    joined = coo_array((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
    joined.data[:] = 1
    return joined


@njit(cache=True, nogil=True)
def _equations(vertices, normals, first, after, weight, degree, wanted):
    """Weights of all edges, 0 across creases, their sums, and the right-hand side."""
    for i in range(len(vertices)):
        degree[i] = 0.0
        wanted[i] = 0.0
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


@njit(cache=True, nogil=True)
def _solve(first, after, weight, diagonal, wanted):
    """Conjugate gradients with the diagonal as preconditioner, in one fixed order."""
    n = len(wanted)
    height = np.zeros(n)
    residual = wanted.copy()
    search = np.empty(n)
    image = np.empty(n)
    size = 0.0
    for i in range(n):
        search[i] = residual[i] / diagonal[i]
        size += residual[i] * search[i]
    enough = _TOLERANCE * _TOLERANCE * size
    for _ in range(_MOST_ITERATIONS):
        if size <= enough:
            break
        curvature = 0.0
        for i in range(n):
            total = diagonal[i] * search[i]
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
            size += residual[i] * residual[i] / diagonal[i]
        for i in range(n):
            search[i] = residual[i] / diagonal[i] + size / before * search[i]
    return height
