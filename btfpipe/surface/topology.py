"""Connectivity of triangle meshes: half-edges, components, boundaries, Euler characteristic."""

import numpy as np


def half_edges(faces):
    """Start and end vertices of the half-edges, (3 m,) each; half-edge 3 f + k leaves corner k of face f."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def edge_keys(faces):
    """One integer per half-edge, (3 m,) int64, equal for all half-edges between the same two vertices."""
    start, end = (side.astype(np.int64) for side in half_edges(faces))
    return np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)


def opposite_half_edges(faces):
    """The half-edge on the other side of each, (3 m,) int32, -1 on a boundary.

    The mesh must be an oriented manifold; an edge of more than two faces counts as boundary.
    """
    keys = edge_keys(faces)
    order = np.argsort(keys, kind="stable")
    first, counts = np.unique(keys[order], return_index=True, return_counts=True)[1:]
    pairs = first[counts == 2]
    opposite = np.full(len(keys), -1, np.int32)
    opposite[order[pairs]] = order[pairs + 1]
    opposite[order[pairs + 1]] = order[pairs]
    return opposite


def edges(faces):
    """The undirected edges, (e, 2) int64, sorted."""
    keys = np.unique(edge_keys(faces))
    base = int(faces.max(initial=0)) + 1
    return np.stack([keys // base, keys % base], axis=1)


def edge_lengths(vertices, faces):
    """Length of each undirected edge, (e,) float64, in the order of `edges`."""
    a, b = edges(faces).T
    return np.linalg.norm(vertices[a] - vertices[b], axis=1)


def mean_edge(vertices, faces):
    """Mean length of the undirected edges: the spacing of an even mesh."""
    return float(edge_lengths(vertices, faces).mean())


def edge_normals_angle(vertices, faces, opposite):
    """Angle between the normals of the two faces at each half-edge, (3 m,) float64; 0 on a boundary."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    here = np.repeat(normal, 3, axis=0)
    there = normal[opposite // 3]
    angle = np.arctan2(
        np.linalg.norm(np.cross(here, there), axis=1), np.einsum("hx,hx->h", here, there)
    )
    return np.where(opposite < 0, 0.0, angle)


def face_normals(vertices, faces):
    """Unit normals of the faces, (m, 3) float64; 0 where a face has no area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return np.divide(across, length, out=np.zeros_like(across), where=length > 0)


def mesh_area(vertices, faces):
    """Area of all faces together."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(across, axis=1).sum())


def face_components(faces, n_vertices):
    """Number of connected components and the component of each vertex, (n_vertices,) int32."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start, end = half_edges(faces)
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), shape=(n_vertices,) * 2)
    return connected_components(graph, directed=False)


def describe(faces, n_vertices):
    """Topology of each component of an oriented manifold without unreferenced vertices.

    Returns
    -------
    euler : (c,) int64
        Vertices - edges + faces.
    loops : (c,) int64
        Boundary loops; the genus is (2 - loops - euler) / 2.
    component : (n_vertices,) int32
    """
    count, component = face_components(faces, n_vertices)
    edge = edges(faces)
    euler = (
        np.bincount(component, minlength=count)
        - np.bincount(component[edge[:, 0]], minlength=count)
        + np.bincount(component[faces[:, 0]], minlength=count)
    )
    start, end = half_edges(faces)
    rim = np.flatnonzero(opposite_half_edges(faces) < 0)
    loops = np.zeros(count, np.int64)
    if len(rim):
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        graph = coo_matrix((np.ones(len(rim), bool), (start[rim], end[rim])), (n_vertices,) * 2)
        _, loop = connected_components(graph, directed=False)
        _, one = np.unique(loop[start[rim]], return_index=True)
        loops = np.bincount(component[start[rim[one]]], minlength=count)
    return euler, loops, component
