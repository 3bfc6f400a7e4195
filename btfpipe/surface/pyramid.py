"""From each vertex to its place on the next coarser level."""

import numpy as np

from btfpipe.surface.smooth_input import barycentric


def parents(vertices, normals, coarse_vertices, coarse_faces):
    """Where the normal through each vertex meets the coarser mesh (Tong et al. 2002, section 5.1).

    Parameters
    ----------
    vertices : (n, 3) float64
    normals : (n, 3) float32
    coarse_vertices : (k, 3) float64
    coarse_faces : (m, 3) int32

    Returns
    -------
    face : (n,) int32
    weights : (n, 3) float32
        Barycentric coordinates in the face.
    n_closest : int
        How many vertices took the closest point instead, because no face that looks the same way lies on their
        normal within two coarse edges: at sharp ridges and rims.
    """
    import igl
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    # Embree works in single precision: bring the mesh to the middle and to size 1
    middle = coarse_vertices.mean(axis=0)
    size = np.ptp(coarse_vertices, axis=0).max()
    near = ((coarse_vertices - middle) / size).astype(np.float32)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, near, np.ascontiguousarray(coarse_faces, np.int32))
    corners = coarse_vertices[coarse_faces]
    area_vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    reach = 2 * np.sqrt(np.linalg.norm(area_vector, axis=1).mean()) / size
    origin = ((vertices - middle) / size).astype(np.float32)
    face = np.full(len(vertices), -1, np.int64)
    step = np.full(len(vertices), np.inf)
    for sign in (1, -1):
        hit = scene.run(
            origin, np.ascontiguousarray(sign * normals, np.float32), query="INTERSECT", output=True
        )
        there, distance = hit["primID"], hit["tfar"].astype(np.float64)
        good = (there >= 0) & (distance < np.minimum(np.abs(step), reach))
        good &= np.einsum("kx,kx->k", area_vector[there], normals) > 0
        face[good], step[good] = there[good], sign * distance[good]
    step[face < 0] = 0
    place = vertices + (step * size)[:, None] * normals
    missed = np.flatnonzero(face < 0)
    if len(missed):
        _, face[missed], place[missed] = igl.point_mesh_squared_distance(
            np.ascontiguousarray(vertices[missed]),
            np.ascontiguousarray(coarse_vertices),
            coarse_faces.astype(np.int64),
        )
    weights = barycentric(place, corners[face])
    return face.astype(np.int32), weights.astype(np.float32), len(missed)
