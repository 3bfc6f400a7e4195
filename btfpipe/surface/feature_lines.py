"""Lines of a mesh that a resampling must keep: boundaries, creases and sharp edges, seen at the resampling's scale."""

from dataclasses import dataclass

import numpy as np

from btfpipe.surface.topology import edge_normals_angle, half_edges

# between the normals of two faces that make a sharp edge, of edges longer and shorter than a spacing: a triangle across
# an edge of 40 degrees is off by a fifth of its side; short ones are roughness more often than shape
SHARP_DEG, SHORT_SHARP_DEG = 40, 60
_SHORTEST = 6.0  # spacings; shorter lines of sharp edges are roughness at this scale
_KNIFE_DEG, _SHORTEST_KNIFE = 75, 1.5  # unless so much of one is sharper than this
_BRANCH = 1.0  # spacings; shorter dead ends are roughness, too
_STRAY = 0.25  # spacings that a line may stray from a straight one without turning a corner
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
    angle = edge_normals_angle(vertices, faces, opposite)
    long = np.linalg.norm(vertices[end] - vertices[start], axis=1) > spacing
    sharp = once & ~must & (angle > np.deg2rad(np.where(long, SHARP_DEG, SHORT_SHARP_DEG)))
    half = np.flatnonzero(must | sharp)
    ends = np.stack([start[half], end[half]], axis=1).astype(np.int64)
    length = np.linalg.norm(vertices[ends[:, 1]] - vertices[ends[:, 0]], axis=1)
    keep = _without_branches(ends, length, must[half], _BRANCH * spacing)
    line = _lines(ends[keep])
    long = np.bincount(line, length[keep])[line] > _SHORTEST * spacing
    knife = np.bincount(line, length[keep] * (angle[half[keep]] > np.deg2rad(_KNIFE_DEG)))[line]
    keep[keep] &= must[half[keep]] | long | (knife > _SHORTEST_KNIFE * spacing)
    half, ends = half[keep], ends[keep]
    kind, after = _continuations(vertices, ends, _STRAY * spacing)
    return FeatureLines(ends, half, after, kind)


def _lines(ends):
    """Number of the connected line that each edge belongs to."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = int(ends.max(initial=0)) + 1
    graph = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), (n, n))
    return connected_components(graph, directed=False)[1][ends[:, 0]]


def _without_branches(ends, length, must, shortest):
    """Which edges are left when dead ends shorter than `shortest` are cut off from lines, (e,) bool."""
    keep = np.ones(len(ends), bool)
    n = int(ends.max(initial=0)) + 1
    for _ in range(2):
        degree = np.bincount(ends[keep].ravel(), minlength=n)
        _, after = _sides(ends, np.where(keep[:, None], degree[ends], 0))
        drop = np.zeros(len(ends), bool)
        for e in np.flatnonzero(keep & (degree[ends] == 1).any(axis=1)):
            path, total = [e], length[e]
            side = 0 if degree[ends[e, 0]] == 1 else 1
            # from the dead end inwards to a branching
            here, side = e, 1 - side
            while degree[ends[here, side]] == 2 and total < shortest:
                other = after[here, side]
                side = 1 if ends[other, 0] == ends[here, side] else 0
                here = other
                path.append(here)
                total += length[here]
            if total < shortest and degree[ends[here, side]] > 2 and not must[path].any():
                drop[path] = True
        keep &= ~drop
        if not drop.any():
            break
    return keep


def _sides(ends, degree):
    """Pairs (k, 2) of sides 2 e + end that meet where the degree is 2, and the edge (e, 2) beyond each side."""
    flat = ends.ravel()
    joined = np.flatnonzero(degree.ravel() == 2)
    joined = joined[np.argsort(flat[joined], kind="stable")].reshape(-1, 2)
    after = np.full(len(flat), -1, np.int32)
    after[joined[:, 0]], after[joined[:, 1]] = joined[:, 1] // 2, joined[:, 0] // 2
    return joined, after.reshape(-1, 2)


def _continuations(vertices, ends, stray):
    """Kinds of the vertices and, for each end of each edge, the edge that goes on there."""
    n = len(vertices)
    degree = np.bincount(ends.ravel(), minlength=n)
    kind = np.minimum(degree, 1).astype(np.uint8)
    kind[(degree > 0) & (degree != 2)] = 2
    joined, after = _sides(ends, degree[ends])
    neighbours = np.full((n, 2), -1, np.int64)
    neighbours[ends.ravel()[joined[:, 0]]] = ends.ravel()[joined ^ 1]
    for a in ends.ravel()[joined[:, 0]]:
        if kind[a] == 1 and _turns(vertices, neighbours, a, stray):
            kind[a] = 2
    after[kind[ends] == 2] = -1
    return kind, after


def _turns(vertices, neighbours, a, stray):
    """Whether a line turns by over 45 degrees at a, seen over more than `stray` to both sides."""
    away = []
    for side in range(2):
        before, here = a, neighbours[a, side]
        gap = vertices[here] - vertices[a]
        while gap @ gap < stray**2 and neighbours[here, 0] >= 0 and here != a:
            first, second = neighbours[here]
            before, here = here, second if first == before else first
            gap = vertices[here] - vertices[a]
        away.append(gap / max(np.sqrt(gap @ gap), 1e-300))
    return away[0] @ away[1] > -_CORNER
