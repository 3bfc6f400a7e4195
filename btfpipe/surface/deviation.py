"""How far a resampled mesh lies from its input, and how far it may."""

from dataclasses import dataclass

import numpy as np

from btfpipe.surface.topology import (
    edge_normals_angle,
    half_edges,
    mesh_area,
    opposite_half_edges,
)

MOST_SPACINGS = 0.5  # between the resampled mesh and its input
MOST_SPACINGS_AT_TIPS = 1.0  # within a spacing of corners sharper than `TIP_DEG`
TIP_DEG = 60
_MOST_PARTS = 400  # of one edge
_BENT_DEG = 10  # between faces; along flatter edges fewer points do


@dataclass
class Deviation:
    """Distances between a mesh and its input, both ways.

    Attributes
    ----------
    from_input, to_input : (k,) float64
        Of points on the input to the mesh, and of points on the mesh to the input.
    points : (k, 3) float64
        The points on the input; of points on the mesh the closest on the input.
    place : (k,) int64
        Faces of the input that hold them.
    face : (k,) int64
        Faces of the mesh that they are closest to.
    mean_from_input, mean_to_input : float
        Means over the area.
    area_ratio : float
        Area of the mesh over that of its input.
    """

    from_input: np.ndarray
    to_input: np.ndarray
    points: np.ndarray
    place: np.ndarray
    face: np.ndarray
    mean_from_input: float
    mean_to_input: float
    area_ratio: float

    @property
    def distances(self):
        """Both, from the input first, in the order of `points`."""
        return np.concatenate([self.from_input, self.to_input])

    def summary(self, spacing, extent):
        """The largest and the mean distances, in the mesh's unit, in spacings and as a fraction of the extent."""
        both = {
            "input_to_result": (self.from_input.max(), self.mean_from_input),
            "result_to_input": (self.to_input.max(), self.mean_to_input),
        }
        return {
            way: {
                "max": float(most),
                "mean": float(mean),
                "max_spacings": float(most / spacing),
                "mean_spacings": float(mean / spacing),
                "max_of_extent": float(most / extent),
                "mean_of_extent": float(mean / extent),
            }
            for way, (most, mean) in both.items()
        }


def measure(vertices, faces, source_vertices, source_faces, spacing, seed=0):
    """Measure a mesh against its input by points on both.

    Those on the input are its vertices, random points on its faces, half a spacing from each other, and points along its
    edges, as near, or twice as near on bent edges. Those on the mesh are the middles of its faces and of its bent
    edges, and its vertices.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    source_vertices : (k, 3) float64
    source_faces : (l, 3) int32
    spacing : float
        Distance between the vertices of the mesh.
    seed : int
        Of the random points.

    Returns
    -------
    Deviation
    """
    start, end = half_edges(source_faces)
    first = np.empty(len(source_vertices), np.int64)
    first[start] = np.arange(len(start)) // 3
    on_edges, edge = _along_edges(source_vertices, source_faces, spacing)
    inside, face = _on_faces(source_vertices, source_faces, 4 * len(vertices), seed)
    theirs = np.concatenate([source_vertices, on_edges, inside])
    from_input, nearest, _ = closest(theirs, vertices, faces)
    corners = vertices[faces]
    h = _bent(vertices, faces)
    start, end = half_edges(faces)
    ours = np.concatenate(
        [corners.mean(axis=1), 0.5 * (vertices[start[h]] + vertices[end[h]]), vertices]
    )
    around = np.empty(len(vertices), np.int64)
    around[start] = np.arange(len(start)) // 3
    to_input, place, on_input = closest(ours, source_vertices, source_faces)
    twice = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return Deviation(
        from_input,
        to_input,
        np.concatenate([theirs, on_input]),
        np.concatenate([first, edge // 3, face, place]),
        np.concatenate([nearest, np.arange(len(faces)), h // 3, around]),
        float(from_input[-len(inside) :].mean()),
        float(np.average(_face_means(to_input, faces, len(vertices)), weights=twice)),
        mesh_area(vertices, faces) / mesh_area(source_vertices, source_faces),
    )


def closest(points, vertices, faces):
    """Distance (k,), face (k,) and place (k, 3) of the point of a mesh that is closest to each point (k, 3)."""
    import igl

    squared, face, place = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(vertices), faces.astype(np.int64)
    )
    return np.sqrt(np.maximum(squared, 0)), face, place


def farthest_beyond(deviation, spacing, tips):
    """The largest distance beyond what is allowed and where, or None.

    Parameters
    ----------
    deviation : Deviation
    spacing : float
    tips : (t, 3) float64
        Points of the input within a spacing of which `MOST_SPACINGS_AT_TIPS` holds.

    Returns
    -------
    (float, (3,) float64) or None
    """
    from scipy.spatial import cKDTree

    distance = deviation.distances
    off = np.flatnonzero(distance > MOST_SPACINGS * spacing)
    if len(off) and len(tips):
        gap, _ = cKDTree(tips).query(deviation.points[off])
        allowed = (gap < spacing) & (distance[off] <= MOST_SPACINGS_AT_TIPS * spacing)
        off = off[~allowed]
    if not len(off):
        return None
    worst = off[distance[off].argmax()]
    return float(distance[worst]), deviation.points[worst]


def sharp_tips(vertices, faces, spacing):
    """Points (t, 3) on corners of a mesh that are sharper than `TIP_DEG`: edges between faces, and tips of cones."""
    opposite = opposite_half_edges(faces)
    start, end = half_edges(faces)
    knife = (edge_normals_angle(vertices, faces, opposite) > np.deg2rad(180 - TIP_DEG)) & (
        np.arange(len(opposite)) > opposite
    )
    corners = vertices[faces]
    u = np.roll(corners, -1, axis=1) - corners
    w = np.roll(corners, 1, axis=1) - corners
    angle = np.arctan2(np.linalg.norm(np.cross(u, w), axis=2), np.einsum("mkx,mkx->mk", u, w))
    around = np.bincount(faces.ravel(), angle.ravel(), len(vertices))
    around[start[opposite < 0]] = np.inf
    # a cone that opens by an angle a unrolls to 2 pi sin(a / 2)
    tip = around < 2 * np.pi * np.sin(np.deg2rad(TIP_DEG) / 2)
    a, b = vertices[start[knife]], vertices[end[knife]]
    return np.concatenate([vertices[tip], a, b, points_between(a, b, spacing)[0]])


def points_between(a, b, step):
    """Points between the ends of edges, at most `step` apart, without the ends; and the edge of each."""
    parts = np.ceil(np.linalg.norm(b - a, axis=1) / step).astype(int).clip(1, _MOST_PARTS)
    edge = np.repeat(np.arange(len(a)), parts - 1)
    first = np.cumsum(parts - 1) - (parts - 1)
    fraction = ((np.arange(len(edge)) - first[edge] + 1) / parts[edge])[:, None]
    return (1 - fraction) * a[edge] + fraction * b[edge], edge


def _face_means(distance, faces, n):
    """Mean over each face, exact for quadratic distances, from those of its middle and its corners."""
    corners = distance[len(distance) - n :][faces]
    return 0.75 * distance[: len(faces)] + 0.25 * corners.mean(axis=1)


def _along_edges(vertices, faces, spacing):
    """Points along the edges of a mesh and the half-edge of each."""
    start, end = half_edges(faces)
    opposite = opposite_half_edges(faces)
    angle = edge_normals_angle(vertices, faces, opposite)
    once = np.arange(len(start)) > opposite
    points, edges = [], []
    bent = (opposite < 0) | (angle > np.deg2rad(_BENT_DEG))
    for chosen, step in ((bent, spacing / 4), (~bent, spacing / 2)):
        half = np.flatnonzero(once & chosen)
        found, edge = points_between(vertices[start[half]], vertices[end[half]], step)
        points.append(found)
        edges.append(half[edge])
    return np.concatenate(points), np.concatenate(edges)


def _on_faces(vertices, faces, count, seed):
    """Random points, as many a unit of area everywhere, (count, 3), and the face of each."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    share = np.cumsum(np.linalg.norm(across, axis=1))
    random = np.random.default_rng(seed)
    even = (np.arange(count) + random.random(count)) / count
    face = np.minimum(np.searchsorted(share, even * share[-1]), len(faces) - 1)
    r, s = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - r, r * (1 - s), r * s], axis=1)
    return np.einsum("kc,kcx->kx", weights, corners[face]), face


def _bent(vertices, faces):
    """Half-edges, one an edge, where faces of the mesh meet at an angle, and boundaries."""
    opposite = opposite_half_edges(faces)
    angle = edge_normals_angle(vertices, faces, opposite)
    return np.flatnonzero(
        (opposite < 0) | ((angle > np.deg2rad(_BENT_DEG)) & (np.arange(len(opposite)) > opposite))
    )


def most_area_error(n_vertices):
    """By how much the area may be off without smoothing, a fraction: 3 % at 3,000 vertices, 1 % from 30,000 on."""
    if n_vertices <= 3000:
        return 0.03 * 3000 / max(n_vertices, 1)
    return max(0.01, 0.03 * (3000 / n_vertices) ** np.log10(3))
