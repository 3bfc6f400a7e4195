"""How far shadow rays must start from a surface whose shading normals are smoother than its facets."""

import numpy as np

from btfpipe.compiled import njit

_ITERATIONS = (
    100  # reaches about ten edges far: the facets of an input mesh seen in a dense resampling of it
)
_SCREENING = 0.02  # pull towards the surface, a share of an edge
_RINGS = 6
_FACTOR = 2.0


def clearance(vertices, faces, normals):
    """Distance from each vertex to the smooth surface that the shading normals describe, on the safe side.

    Facets of a coarse input mesh stay flat when it is resampled densely, while the shading normals of the
    input turn smoothly across them. Where light grazes, such a facet lies in its own or its neighbours' shadow though
    the smooth surface does not. The heights over the vertices along their normals that make every edge
    orthogonal to the normals at its ends, in the least squares sense and pulled gently to zero, say how far the
    smooth surface lies off; shadow rays that start that far up clear the facets.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    normals : (n, 3) float32
        Unit shading normals.

    Returns
    -------
    (n,) float64
        Twice the largest height within six edges.
    """
    corner = np.argsort(faces.ravel(), kind="stable")
    first = np.searchsorted(faces.ravel()[corner], np.arange(len(vertices) + 1)).astype(np.int64)
    after = faces[:, [1, 2, 0]].ravel()[
        corner
    ]  # one of the two other ends of each corner: each neighbour once
    step = np.zeros(len(vertices))
    _steps(vertices, normals, first, after, step)
    height, other = np.zeros(len(vertices)), np.zeros(len(vertices))
    for _ in range(_ITERATIONS):
        _relax(step, first, after, height, other)
        height, other = other, height
    height = np.abs(height)
    for _ in range(_RINGS):
        _widen(first, after, height, other)
        height, other = other, height
    return _FACTOR * height


@njit(cache=True, nogil=True)
def _steps(vertices, normals, first, after, step):
    """Sum over the neighbours of how far they lie above the vertex along the edge's mean normal."""
    for i in range(len(vertices)):
        total = 0.0
        for e in range(first[i], first[i + 1]):
            j = after[e]
            for c in range(3):
                total += (vertices[j, c] - vertices[i, c]) * (normals[i, c] + normals[j, c]) * 0.5
        step[i] = total


@njit(cache=True, nogil=True)
def _relax(step, first, after, height, out):
    """One Jacobi iteration of the heights."""
    for i in range(len(height)):
        total = step[i]
        for e in range(first[i], first[i + 1]):
            total += height[after[e]]
        out[i] = total / (first[i + 1] - first[i] + _SCREENING)


@njit(cache=True, nogil=True)
def _widen(first, after, height, out):
    """The largest height of a vertex and its neighbours."""
    for i in range(len(height)):
        most = height[i]
        for e in range(first[i], first[i + 1]):
            most = max(most, height[after[e]])
        out[i] = most
