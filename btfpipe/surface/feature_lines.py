"""Lines of a mesh that a resampling must keep: boundaries, creases and sharp edges, seen at the resampling's scale."""

from dataclasses import dataclass

import numpy as np

from btfpipe.surface.topology import edge_normals_angle, half_edges

SHARP_DEG = 40  # between the normals of two faces; below, a triangle across the edge is off by a fifth of its side
_SHORTEST = 2.0  # spacings; shorter lines of sharp edges are roughness at this scale
_CORNER = np.cos(np.deg2rad(45))


@dataclass
class FeatureLines:
    """Feature edges of a mesh and how they continue each other.

    Attributes
    ----------
    ends : (e, 2) int64
        Vertices of each feature edge.
    half : (e,) int64
        A half-edge that runs along it, from its first vertex to its second.
    after : (e, 2) int32
        The feature edge that goes on beyond each end, or -1 at an end, a branching or a corner.
    kind : (n,) uint8
        Of each vertex: 0 on no line, 1 on one, 2 at an end, a branching or a corner of lines.
    """

    ends: np.ndarray
    half: np.ndarray
    after: np.ndarray
    kind: np.ndarray


def feature_lines(vertices, faces, opposite, crease, spacing):
    """Find the feature lines of a mesh.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    opposite : (3 m,) int32
    crease : (3 m,) bool
        Half-edges that are features whatever their angle.
    spacing : float
        Distance between the vertices of the resampling to come. Sharp edges that make lines of less than
        two spacings are left out.
    """
    start, end = half_edges(faces)
    h = np.arange(len(opposite))
    once = h > opposite  # boundaries, and one half-edge of all others
    must = once & ((opposite < 0) | crease)
    sharp = once & ~must & (
        edge_normals_angle(vertices, faces, opposite) > np.deg2rad(SHARP_DEG)
    )
    half = np.flatnonzero(must | sharp)
    ends = np.stack([start[half], end[half]], axis=1).astype(np.int64)
    keep = must[half] | _long_enough(vertices, ends, _SHORTEST * spacing)
    half, ends = half[keep], ends[keep]
    kind, after = _continuations(vertices, ends)
    return FeatureLines(ends, half, after, kind)


def _long_enough(vertices, ends, shortest):
    """Which edges belong to connected lines that are longer than `shortest` together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(vertices)
    graph = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), (n, n))
    _, line = connected_components(graph, directed=False)
    length = np.linalg.norm(vertices[ends[:, 1]] - vertices[ends[:, 0]], axis=1)
    return np.bincount(line[ends[:, 0]], length)[line[ends[:, 0]]] > shortest if len(ends) else []


def _continuations(vertices, ends):
    """Kinds of the vertices and, for each end of each edge, the edge that goes on there."""
    n, e = len(vertices), len(ends)
    degree = np.bincount(ends.ravel(), minlength=n)
    kind = np.minimum(degree, 1).astype(np.uint8)
    kind[(degree > 0) & (degree != 2)] = 2
    after = np.full((e, 2), -1, np.int32)
    # the two sides (edge, end) that meet at each vertex of degree 2
    side = np.argsort(ends.ravel(), kind="stable")
    side = side[degree[ends.ravel()[side]] == 2].reshape(-1, 2)
    at = ends.ravel()[side[:, 0]]
    away = vertices[ends.ravel()[side ^ 1]] - vertices[at][:, None]
    away /= np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-300)
    straight = np.einsum("kx,kx->k", away[:, 0], away[:, 1]) < -_CORNER
    kind[at[~straight]] = 2
    here, there = side[straight].T
    after.ravel()[here] = there // 2
    after.ravel()[there] = here // 2
    return kind, after
