"""Flattening against planes and spheres, where the answer is known."""

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.surface import Level
from btfpipe.surface.flatten import Flattener, frame_angle
from btfpipe.synthesis.growth import breadth_first


def resampled(level, vertex, weight):
    """Positions (pixels, 3) that the weights blend."""
    return np.einsum("pj,pjd->pd", weight, level.vertices[vertex])


def test_a_flat_grid_is_resampled_at_whole_texels(grid):
    level = grid(12, 14)
    centre = 5 * 14 + 6
    patches = Flattener(level, 1.0).squares([centre], 5)
    found = resampled(level, patches.pixel_vertex[0], patches.pixel_weight[0])
    found -= level.vertices[centre]
    drow, dcol = np.mgrid[-2:3, -2:3]
    expected = np.stack([dcol.ravel(), -drow.ravel(), 0 * drow.ravel()], axis=1)  # row runs down
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_steps_of_a_flat_grid_lead_from_each_vertex_to_the_centre(grid):
    level = grid(12, 14)
    patches = Flattener(level, 1.0).squares([5 * 14 + 6], 5)
    own = patches.patch_vertex[0] >= 0
    row, col = np.divmod(patches.patch_vertex[0][own], 14)
    expected = np.stack([5 - row, 6 - col], axis=1)
    np.testing.assert_allclose(patches.patch_step[0][own], expected, atol=1e-5)
    assert own.sum() == 25
    assert (patches.patch_vertex[0][~own] == -1).all()


def test_a_turn_lays_the_square_along_the_turned_frame(grid):
    level = grid(12, 14)
    centre = 5 * 14 + 6
    patches = Flattener(level, 1.0, turn=np.pi / 2).squares([centre], 5)
    found = resampled(level, patches.pixel_vertex[0], patches.pixel_weight[0])
    found -= level.vertices[centre]
    right, top = found.reshape(5, 5, 3)[2, 4], found.reshape(5, 5, 3)[0, 2]
    np.testing.assert_allclose(right, [0, 2, 0], atol=1e-5)  # the sample's s points up
    np.testing.assert_allclose(top, [-2, 0, 0], atol=1e-5)


def test_texels_beyond_the_border_have_no_triangle(grid):
    patches = Flattener(grid(6, 6), 1.0).squares([0], 5)  # the top left corner
    covered = patches.pixel_vertex[0, :, 0].reshape(5, 5) >= 0
    expected = np.zeros((5, 5), bool)
    expected[2:, 2:] = True
    np.testing.assert_array_equal(covered, expected)


def test_scale_sets_the_size_of_texels(grid):
    level = grid(12, 14)
    patches = Flattener(level, 2.0).squares([5 * 14 + 6], 5)
    found = resampled(level, patches.pixel_vertex[0], patches.pixel_weight[0])
    assert np.ptp(found[:, 0]) == pytest.approx(2)


def test_a_square_at_a_place_is_centred_there_and_turned(grid):
    level = grid(12, 12)
    face = np.flatnonzero((level.faces == 5 * 12 + 5).any(axis=1))[:1]
    weights = np.array([[0.2, 0.5, 0.3]])
    angle = 0.3
    tangent = np.array([[np.cos(angle), np.sin(angle), 0]])
    vertex, weight = Flattener(level, 1.0).squares_at(
        face, weights, np.array([[0, 0, 1]]), tangent, 3
    )
    found = resampled(level, vertex[0], weight[0])
    place = weights[0] @ level.vertices[level.faces[face[0]]]
    np.testing.assert_allclose(found[4], place, atol=1e-5)
    np.testing.assert_allclose(found[5] - place, tangent[0], atol=1e-5)
    np.testing.assert_allclose(
        found[1] - place, [-np.sin(angle), np.cos(angle), 0], atol=1e-5
    )  # up


def test_distances_from_the_centre_are_kept_on_a_sphere(sphere):
    level = sphere(4000)
    scale = 18.0  # texels a radius: about one a vertex
    centres = np.flatnonzero(np.abs(level.vertices[:, 2]) < 0.6)[::97]
    patches = Flattener(level, scale).squares(centres, 5)
    for centre, own, steps in zip(centres, patches.patch_vertex, patches.patch_step, strict=True):
        inside = own >= 0
        cosine = level.vertices[own[inside]] @ level.vertices[centre]
        expected = scale * np.arccos(np.minimum(cosine, 1))
        np.testing.assert_allclose(
            np.linalg.norm(steps[inside], axis=1), expected, rtol=0.02, atol=0.02
        )


def test_steps_on_a_sphere_point_along_the_frames(sphere):
    level = sphere(4000)
    centre = np.flatnonzero(np.abs(level.vertices[:, 2]) < 0.02)[3]
    patches = Flattener(level, 18.0).squares([centre], 5)
    own = patches.patch_vertex[0]
    own = own[own >= 0]
    latitude = np.arcsin(level.vertices[:, 2])
    longitude = np.unwrap(np.arctan2(level.vertices[own, 1], level.vertices[own, 0]))
    # Towards the centre: south is along rows, east along cols; frames turn little near the equator.
    south = 18.0 * (latitude[own] - latitude[centre])
    east = -18.0 * (longitude - longitude[0])
    np.testing.assert_allclose(patches.patch_step[0, : len(own), 0], south, atol=0.05)
    np.testing.assert_allclose(patches.patch_step[0, : len(own), 1], east, atol=0.05)


def test_frame_angle_is_counter_clockwise():
    up = np.float32([0, 0, 1])
    s = np.float32([1, 0, 0])
    turned = np.float32([np.cos(0.4), np.sin(0.4), 0])
    assert frame_angle(up, s, up, turned) == pytest.approx(0.4, abs=1e-6)
    tilted = np.float32([np.sin(0.5), 0, np.cos(0.5)])  # the plane tilted about y: s follows
    assert frame_angle(up, s, tilted, np.float32([np.cos(0.5), 0, -np.sin(0.5)])) == pytest.approx(
        0, abs=1e-6
    )


def test_an_edge_of_three_faces_is_refused():
    vertices = np.random.default_rng(0).random((5, 3))
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.int32)
    frames = np.zeros((5, 3), np.float32)
    with pytest.raises(InputError, match=r"edge \(1, 0\).*more than two"):
        Flattener(Level(vertices, faces, frames, frames), 1.0)


def test_faces_wound_against_each_other_are_refused():
    vertices = np.random.default_rng(0).random((4, 3))
    faces = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    frames = np.zeros((4, 3), np.float32)
    with pytest.raises(InputError, match="opposite senses"):
        Flattener(Level(vertices, faces, frames, frames), 1.0)


def test_a_front_reaches_every_vertex_of_every_part_by_neighbours(grid):
    one = grid(5, 6)
    level = Level(
        np.concatenate([one.vertices, one.vertices + np.array([20, 0, 0])]),
        np.concatenate([one.faces, one.faces + 30]),
        np.tile(one.normals, (2, 1)),
        np.tile(one.tangents, (2, 1)),
    )
    order = breadth_first(Flattener(level, 1.0), 17)
    assert sorted(order) == list(range(60))
    assert order[0] == 17
    edges = np.concatenate([level.faces, level.faces[:, [1, 2, 0]], level.faces[:, [2, 0, 1]]])
    time = np.empty(60, int)
    time[order] = np.arange(60)
    alone = 0
    for v in order:
        near = np.unique(edges[(edges == v).any(axis=1)])
        alone += not (time[near] < time[v]).any()
    assert alone == 2
