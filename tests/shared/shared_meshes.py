"""Meshes made in code, for tests and benchmarks alike."""

import numpy as np

from btfpipe.surface import Level


def even_sphere(n):
    """A unit sphere, as a level, of n even points, s to the east and t to the north."""
    from scipy.spatial import ConvexHull

    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    v = np.stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1
    )
    faces = ConvexHull(v).simplices
    corners = v[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("nd,nd->n", normal, corners.mean(axis=1)) < 0
    faces[inward] = faces[inward][:, ::-1]
    east = np.cross([0, 0, 1], v)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    return Level(v, faces.astype(np.int32), v.astype(np.float32), east.astype(np.float32))


def torus(around=24, across=12, outer=1.0, inner=0.4, bumps=0.0):
    """Vertices and faces of a torus about the y axis; `bumps` is how far its skin goes in and out."""
    u, w = np.meshgrid(
        2 * np.pi * np.arange(around) / around,
        2 * np.pi * np.arange(across) / across,
        indexing="ij",
    )
    inner = inner + bumps * np.cos(5 * u) * np.sin(3 * w)
    reach = outer + inner * np.cos(w)
    vertices = np.stack([reach * np.cos(u), inner * np.sin(w), -reach * np.sin(u)], 2).reshape(
        -1, 3
    )
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    k, m = (i + 1) % around, (j + 1) % across
    a, b, c, d = (
        x.ravel() for x in (i * across + j, k * across + j, k * across + m, i * across + m)
    )
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(
        np.int32
    )
