"""Small surfaces and features, made in code."""

import numpy as np
import pytest
from shared_meshes import even_sphere

from btfpipe.surface import Level, Surface


def _grid(rows, cols, step=1.0):
    """A flat grid, row 0 at the top (largest y), s to the right and t up."""
    i, j = np.mgrid[0:rows, 0:cols]
    vertices = step * np.stack([j.ravel(), -i.ravel(), 0 * i.ravel()], axis=1).astype(float)
    place = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = (
        x.ravel() for x in (place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]).astype(np.int32)
    normals = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    tangents = np.tile(np.float32([1, 0, 0]), (len(vertices), 1))
    return Level(vertices, faces, normals, tangents)


def _link(fine, coarse):
    """Give `fine` its places on `coarse`: the nearest ones."""
    import igl

    found = igl.point_mesh_squared_distance(
        np.asarray(fine.vertices), np.asarray(coarse.vertices), coarse.faces.astype(np.int64)
    )
    face, point = np.asarray(found[1]).ravel(), np.asarray(found[2])
    weights = np.empty((len(face), 3))
    corners = coarse.vertices[coarse.faces[face]]
    for k in range(len(face)):  # barycentric coordinates, from their definition
        system = np.vstack([corners[k].T, np.ones(3)])
        weights[k] = np.linalg.lstsq(system, np.append(point[k], 1), rcond=None)[0]
    weights = np.clip(weights, 0, None)
    fine.parent_face = face.astype(np.int32)
    fine.parent_weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def grid():
    """Make a grid level of rows x cols vertices, one unit apart by default."""
    return _grid


@pytest.fixture
def link():
    """Give a level its places on a coarser one."""
    return _link


@pytest.fixture
def sphere():
    """Make a sphere level of n vertices."""
    return even_sphere


@pytest.fixture(scope="session")
def sphere_surface():
    """A sphere of two levels, 3000 and 750 vertices."""
    fine, coarse = even_sphere(3000), even_sphere(750)
    _link(fine, coarse)
    return Surface([fine, coarse], digest="sphere")


@pytest.fixture(scope="session")
def grid_surface():
    """A flat square of two levels, 41 x 41 and 21 x 21 vertices: one and two units apart."""
    fine, coarse = _grid(41, 41), _grid(21, 21, 2.0)
    _link(fine, coarse)
    return Surface([fine, coarse], digest="grid")


@pytest.fixture
def make_features():
    """Make plain features of random texels, with neighbour lists of `k`."""
    from btfpipe.analysis.neighbours import add_neighbour_lists
    from btfpipe.analysis.pyramid import plain_features

    def make(rows=16, cols=20, depth=3, k=5, levels=1, toroidal=True, seed=3, smooth=True):
        image = np.random.default_rng(seed).random((rows, cols, depth))
        if smooth:
            for axis in (0, 1):
                image = (
                    image + np.roll(image, 1, axis) + np.roll(image, -1, axis)
                )  # neighbours are alike, as in a texture
        features = plain_features(image.astype(np.float32), toroidal, levels)
        if k:
            add_neighbour_lists(features, k)
        return features

    return make
