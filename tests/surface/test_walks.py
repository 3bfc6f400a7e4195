"""Walks over a mesh and the lines they keep to."""

import numpy as np
import pytest
from shared_shapes import boxes

from btfpipe.surface.feature_lines import feature_lines
from btfpipe.surface.projection import closest_in_triangle, walk_faces, walk_lines
from btfpipe.surface.topology import half_edges, opposite_half_edges


def walk(vertices, faces, points, start, across=None):
    points = np.asarray(points, float)
    across = opposite_half_edges(faces) if across is None else across
    face, weights = np.array(start, np.int32), np.empty((len(points), 3))
    nearest, blocked = np.empty((len(points), 3)), np.zeros(len(points), np.uint8)
    walk_faces(vertices, faces, across, points, face, weights, nearest, blocked)
    np.testing.assert_allclose(
        nearest, np.einsum("kc,kcx->kx", weights, vertices[faces[face]]), atol=1e-12
    )
    return face, nearest, blocked


def test_the_closest_point_of_a_triangle_is_that_of_a_dense_grid():
    random = np.random.default_rng(1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(201), np.arange(201)))
    keep = i + j <= 200
    grid = np.stack([200 - i - j, i, j], axis=1)[keep] / 200
    for _ in range(60):
        a, b, c, p = random.normal(size=(4, 3))
        found = closest_in_triangle(tuple(p), tuple(a), tuple(b), tuple(c))
        least = np.linalg.norm(grid @ np.array([a, b, c]) - p, axis=1).min()
        assert np.sqrt(found[3]) == pytest.approx(least, abs=0.01)
        assert np.sqrt(found[3]) <= least + 1e-12
        assert min(found[:3]) >= 0
        assert sum(found[:3]) == pytest.approx(1)


def test_walks_on_a_sphere_end_at_the_closest_point_of_all(shapes):
    import igl

    vertices, faces = shapes.sphere(3)
    random = np.random.default_rng(2)
    points = random.normal(size=(300, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    # anywhere but behind: the far point of a sphere is as far from all around it
    ahead = vertices[faces].sum(axis=1) @ points.T > 0
    start = np.array([random.choice(np.flatnonzero(near)) for near in ahead.T])
    _, nearest, blocked = walk(vertices, faces, points, start)
    best = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))[0])
    # from wherever it starts: a convex surface has no other local minimum on its outside
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), best, atol=1e-9)
    assert not blocked.any()


def test_a_walk_stays_on_its_side_of_a_thin_wall():
    vertices, faces = boxes(np.ones((1, 1, 1), bool))
    vertices = (vertices - 1) * (4, 4, 0.1)
    top = np.flatnonzero((vertices[faces][:, :, 2] == 0.1).all(axis=1))
    # nearer to the other side
    _, nearest, _ = walk(vertices, faces, [(2, 2, 0.02)], top[:1])
    np.testing.assert_allclose(nearest, [(2, 2, 0.1)], atol=1e-12)


def test_a_walk_does_not_cross_a_line_and_says_so():
    vertices, faces = boxes(np.ones((1, 1, 1), bool))
    vertices = vertices - 1
    opposite = opposite_half_edges(faces)
    lines = feature_lines(vertices, faces, opposite, np.zeros(len(opposite), bool), 0.01)
    across = opposite.copy()
    across[lines.half] = -1
    across[opposite[lines.half]] = -1
    top = np.flatnonzero((vertices[faces][:, :, 2] == 1).all(axis=1))
    beyond = [(1.5, 0.4, 0.3)]
    _, nearest, blocked = walk(vertices, faces, beyond, top[:1], across)
    np.testing.assert_allclose(nearest, [(1, 0.4, 1)], atol=1e-12)
    assert blocked[0]
    _, nearest, blocked = walk(vertices, faces, beyond, top[:1])
    np.testing.assert_allclose(nearest, [(1, 0.4, 0.3)], atol=1e-12)
    assert not blocked[0]


def test_a_walk_along_a_line_turns_no_corner():
    vertices, faces = boxes(np.ones((3, 1, 1), bool))
    vertices = vertices - 1
    opposite = opposite_half_edges(faces)
    lines = feature_lines(vertices, faces, opposite, np.zeros(len(opposite), bool), 0.1)
    # the edge of the box along x, from its first third
    first = np.flatnonzero(
        (vertices[lines.ends][:, :, 1:] == 0).all(axis=(1, 2))
        & (vertices[lines.ends][:, :, 0].min(axis=1) == 0)
    )
    for wanted, reached in (((2.4, 0.2, 0.1), 2.4), ((3.7, 0, 0), 3), ((-1, 0, 0), 0)):
        edge, part = first.astype(np.int32).copy(), np.empty(1)
        nearest = np.empty((1, 3))
        walk_lines(
            vertices, lines.ends, lines.after, np.array([wanted], float), edge, part, nearest
        )
        np.testing.assert_allclose(nearest, [(reached, 0, 0)], atol=1e-12)


def test_the_lines_of_a_box_are_its_edges_and_its_corners_are_fixed():
    vertices, faces = boxes(np.ones((3, 2, 1), bool))
    opposite = opposite_half_edges(faces)
    lines = feature_lines(vertices, faces, opposite, np.zeros(len(opposite), bool), 0.1)
    length = np.linalg.norm(np.diff(vertices[lines.ends], axis=1), axis=2).sum()
    assert length == pytest.approx(4 * (3 + 2 + 1))
    corner = ((vertices == vertices.min(axis=0)) | (vertices == vertices.max(axis=0))).all(axis=1)
    assert (lines.kind[corner] == 2).all()
    assert np.bincount(lines.kind, minlength=3).tolist()[2] == 8
    start, end = half_edges(faces)
    np.testing.assert_array_equal(start[lines.half], lines.ends[:, 0])
    np.testing.assert_array_equal(end[lines.half], lines.ends[:, 1])


def test_roughness_makes_no_lines_and_flat_folds_neither(shapes):
    vertices, faces = shapes.sphere(4)
    random = np.random.default_rng(3)
    rough = vertices * (1 + 0.03 * random.normal(size=(len(vertices), 1)))
    opposite = opposite_half_edges(faces)
    none = np.zeros(len(opposite), bool)
    fine = feature_lines(rough, faces, opposite, none, 0.002)
    coarse = feature_lines(rough, faces, opposite, none, 0.3)
    assert len(fine.half) > 100
    assert len(coarse.half) < 0.1 * len(fine.half)
    assert not len(feature_lines(vertices, faces, opposite, none, 0.01).half)


def test_a_zigzag_within_a_quarter_of_a_spacing_is_no_row_of_corners(shapes):
    vertices, faces = shapes.grid(3, 41, 4.0, 0.2)
    rim = vertices[:, 2] == 0.2
    vertices[rim, 2] += 0.06 * (np.arange(rim.sum()) % 2)
    opposite = opposite_half_edges(faces)
    none = np.zeros(len(opposite), bool)
    inner = rim & (vertices[:, 0] > 0.5) & (vertices[:, 0] < 3.5)
    assert (feature_lines(vertices, faces, opposite, none, 1.0).kind[inner] == 1).all()
    assert (feature_lines(vertices, faces, opposite, none, 0.05).kind[inner] == 2).all()
