"""Positions that agree with shading normals."""

import numpy as np
import pytest

from btfpipe.surface.consistency import consistent_positions


def consistent_heights(vertices, faces, normals):
    """How far vertices move along their normals; nothing moves across them."""
    step = consistent_positions(vertices, faces, normals, 2.4) - vertices
    heights = (step * normals).sum(axis=1)
    np.testing.assert_allclose(step, heights[:, None] * normals, atol=1e-6)
    return heights


def _bumpy_plane(side=40, height=0.05, wave=12):
    """A flat grid of unit steps with the normals of z = height wave cos(2 pi x / wave), and those z."""
    x, y = (a.ravel().astype(float) for a in np.meshgrid(np.arange(side), np.arange(side)))
    i = np.arange(side * side).reshape(side, side)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    phase = 2 * np.pi * x / wave
    z = height * wave * np.cos(phase)
    normals = np.stack([2 * np.pi * height * np.sin(phase), 0 * x, 1 + 0 * x], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([x, y, 0 * x], axis=1), faces, normals.astype(np.float32), z


def test_normals_of_waves_raise_a_plane_into_these_waves():
    vertices, faces, normals, z = _bumpy_plane(height=0.02)
    heights = consistent_heights(vertices, faces, normals)
    inside = (np.abs(vertices[:, :2] - 19.5) < 12).all(axis=1)
    assert np.corrcoef(heights[inside], z[inside])[0, 1] > 0.99
    # the pull towards the given surface keeps some of the amplitude back
    slope = (heights * z)[inside].sum() / (z**2)[inside].sum()
    assert 0.75 < slope < 1.02


def test_turned_scaled_and_flipped_input_moves_alike():
    vertices, faces, normals, _ = _bumpy_plane(side=20)
    heights = consistent_heights(vertices, faces, normals)
    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    moved = consistent_heights(3 * vertices @ turn.T + 7, faces, (normals @ turn.T).astype("f4"))
    np.testing.assert_allclose(moved, 3 * heights, atol=1e-4)
    flipped = consistent_heights(vertices, faces[:, ::-1], -normals)
    np.testing.assert_allclose(flipped, -heights, atol=1e-9)


@pytest.mark.parametrize("rings", [6, 24])
def test_spheres_of_any_coarseness_stay(rings):
    """Chords of a circle make equal angles with the normals at both ends: nothing to mend."""
    from shared_meshes import even_sphere

    level = even_sphere(rings**2)
    assert np.abs(consistent_heights(level.vertices, level.faces, level.normals)).max() < 1e-6


def test_corners_of_a_cube_with_normals_of_one_side_stay():
    """Edges across a crease say nothing of the surface on either side."""
    side = np.linspace(-1, 1, 9)
    u, v = (a.ravel() for a in np.meshgrid(side, side))
    up = np.stack([u, v, 1 + 0 * u], axis=1)
    front = np.stack([u, 1 + 0 * u, v], axis=1)
    vertices = np.concatenate([up, front])
    vertices, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    i = np.arange(81).reshape(9, 9)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    one = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = index.ravel()[np.concatenate([one, 81 + one[:, ::-1]])].astype(np.int32)
    normals = np.where(vertices[:, 2:] == 1, [0, 0, 1], [0, 1, 0]).astype(np.float32)
    assert np.abs(consistent_heights(vertices, faces, normals)).max() < 1e-9


def test_far_disagreement_does_not_blow_a_mesh_up():
    """A large flat square with the normals of a ball moves by two edges, not the ten into the ball."""
    vertices, faces, normals, _ = _bumpy_plane(side=60)
    middle = vertices - [29.5, 29.5, -40]
    normals = (middle / np.linalg.norm(middle, axis=1, keepdims=True)).astype(np.float32)
    heights = consistent_heights(vertices, faces, normals)
    assert np.isfinite(heights).all()
    assert 1 < np.abs(heights).max() <= 2.4


def test_no_vertex_moves_farther_than_it_may():
    vertices, faces, normals, _ = _bumpy_plane(side=20)
    most = np.linspace(0, 0.1, 400)
    free = consistent_heights(vertices, faces, normals)
    held = consistent_positions(vertices, faces, normals, most) - vertices
    np.testing.assert_allclose((held * normals).sum(axis=1), np.clip(free, -most, most), atol=1e-9)
