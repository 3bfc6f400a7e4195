"""Positions that agree with shading normals."""

import numpy as np
import pytest

from btfpipe.surface.consistency import consistent_positions, fair_normals
from btfpipe.surface.topology import edges


def consistent_heights(vertices, faces, normals):
    """How far vertices move along their normals; nothing moves across them."""
    step = consistent_positions(vertices, faces, normals, 6) - vertices
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
    """A large flat square with the normals of a ball moves by less than the ten edges into the ball."""
    vertices, faces, normals, _ = _bumpy_plane(side=60)
    middle = vertices - [29.5, 29.5, -40]
    normals = (middle / np.linalg.norm(middle, axis=1, keepdims=True)).astype(np.float32)
    heights = consistent_heights(vertices, faces, normals)
    assert np.isfinite(heights).all()
    assert 1 < np.abs(heights).max() <= 6


def test_heights_follow_normals_as_far_as_facets_are_wide():
    """Waves of 24 edges: a pull of the width of 6 holds them back, one of 40 hardly does."""
    vertices, faces, normals, z = _bumpy_plane(side=80, height=0.02, wave=24)
    inside = (np.abs(vertices[:, :2] - 39.5) < 24).all(axis=1)
    share = {}
    for width in (6, 40):
        step = consistent_positions(vertices, faces, normals, width) - vertices
        heights = (step * normals).sum(axis=1)
        share[width] = (heights * z)[inside].sum() / (z**2)[inside].sum()
    assert share[6] < 0.9 < 0.97 < share[40] < 1.03


def _lattice(side=61):
    """A flat sheet of equilateral triangles with edges of 1, and which vertices lie far inside."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    places = np.stack([j + 0.5 * (i % 2), i * np.sqrt(0.75), 0.0 * i], axis=1)
    k = np.arange(side * side).reshape(side, side)
    faces = []
    for row in range(side - 1):
        a, b, c, d = k[row, :-1], k[row, 1:], k[row + 1, :-1], k[row + 1, 1:]
        if row % 2:
            faces += [np.stack([a, b, d], 1), np.stack([a, d, c], 1)]
        else:
            faces += [np.stack([a, b, c], 1), np.stack([b, d, c], 1)]
    inside = (np.abs(places - places.mean(axis=0)) < side / 4).all(axis=1)
    return places, np.concatenate(faces).astype(np.int32), inside


@pytest.mark.parametrize(("waves", "kept"), [(8, 0.998), (2, 5 / 6), (1, 1 / 4.2)])
@pytest.mark.parametrize("across", [False, True])
def test_fair_normals_keep_waves_of_two_facets_and_lose_those_of_one(waves, kept, across):
    """The filter's law, 1 / (1 + 0.2 (k w / pi)^4), for waves along and across the edges."""
    width = 12.0
    places, faces, inside = _lattice(121)
    k = 2 * np.pi / (waves * width)
    tilt = 0.02 * np.sin(k * places[:, int(across)])
    normals = np.stack([tilt, 0 * tilt, np.ones_like(tilt)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fair = fair_normals(faces, normals, np.full(len(places), width))
    share = (fair[:, 0] * tilt)[inside].sum() / (tilt**2)[inside].sum()
    assert share == pytest.approx(kept, rel=0.06)


def test_fair_normals_are_those_of_a_dense_solution():
    """The same minimum, written out in loops and solved at once."""
    from shared_meshes import even_sphere

    level = even_sphere(150)
    rng = np.random.default_rng(4)
    normals = level.vertices + rng.normal(scale=0.1, size=level.vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    width = rng.uniform(0.5, 5, 150)
    umbrella = np.zeros((150, 150))
    for a, b in edges(level.faces):
        for i, j in ((a, b), (b, a)):
            umbrella[i, i] += 1 / 1.5
            umbrella[i, j] -= 1 / 1.5
    apart = [(normals[i] * normals[j]).sum() <= 0.8 for i, j in edges(level.faces)]
    for i, j in edges(level.faces)[apart]:
        umbrella[i] = umbrella[j] = 0
    assert 0 < sum(apart) < 40
    system = np.eye(150) + umbrella.T @ np.diag(0.2 * (width / np.pi) ** 4) @ umbrella
    expected = np.linalg.solve(system, normals)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    fair = fair_normals(level.faces, normals, width)
    assert np.linalg.norm(expected - normals, axis=1).max() > 0.05
    np.testing.assert_allclose(fair, expected, atol=2e-3)


def test_creases_and_boundaries_keep_their_normals():
    places, faces, _ = _lattice(21)
    left = places[:, 0] < 10
    slope = np.where(left, 0.0, 1.0)  # two half planes that meet at 45 degrees
    normals = np.stack([-slope, 0 * slope, np.ones_like(slope)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fair = fair_normals(faces, normals, np.full(len(places), 8.0))
    np.testing.assert_allclose(fair, normals, atol=1e-6)
    tilt = 0.003 * places[:, 0]  # an even bend stays even up to the border
    normals = np.stack([tilt, 0 * tilt, np.ones_like(tilt)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fair = fair_normals(faces, normals, np.full(len(places), 8.0))
    np.testing.assert_allclose(fair, normals, atol=1e-4)
