"""The pairs of the CUReT database."""

import numpy as np
import pytest

from btfpipe.directions import from_angles
from btfpipe.directions.curet import curet205


def test_the_angle_between_light_and_view_is_a_multiple_of_a_sixteenth_turn():
    pairs = curet205()
    angle = np.arctan2(
        np.linalg.norm(np.cross(pairs.light, pairs.view), axis=1),
        (pairs.light * pairs.view).sum(axis=1),
    )
    np.testing.assert_allclose(np.degrees(angle), 22.5 * pairs.camera, atol=1e-9)


def test_there_are_as_many_pairs_a_camera_as_published():
    pairs = curet205()
    assert np.bincount(pairs.camera).tolist() == [0, 55, 48, 39, 28, 19, 12, 4]
    assert len(pairs.light) == len(pairs.view) == 205
    assert (np.diff(pairs.camera) >= 0).all()


def test_all_lights_and_views_are_distinct_pairs_of_unit_vectors_within_85_degrees():
    pairs = curet205()
    for directions in (pairs.light, pairs.view):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
        assert directions[:, 2].min() > np.cos(np.radians(85))
    both = np.round(np.hstack([pairs.light, pairs.view]), 6)
    assert len(np.unique(both, axis=0)) == 205


def test_lamp_and_cameras_stand_still_in_the_world():
    pairs = curet205()

    def turn(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        if axis == "x":
            return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    for row in range(205):
        robot = turn("y", pairs.alpha[row]) @ turn("x", -pairs.beta[row])
        np.testing.assert_allclose(robot @ pairs.light[row], [0, 0, 1], atol=1e-12)
        camera = turn("y", -np.radians(22.5) * pairs.camera[row])
        np.testing.assert_allclose(robot @ pairs.view[row], camera @ [0, 0, 1], atol=1e-12)
        right_up = pairs.projection[row] @ robot.T
        np.testing.assert_allclose(right_up, (camera @ np.eye(3)[:, :2]).T, atol=1e-12)


def test_the_picture_of_the_plane_shrinks_by_the_cosine_and_is_never_mirrored():
    pairs = curet205()
    areas = np.linalg.det(pairs.projection[:, :, :2])
    np.testing.assert_allclose(areas, pairs.view[:, 2], atol=1e-12)
    assert areas.min() > 0


@pytest.mark.measured
def test_the_rule_gives_the_published_table_in_its_order(measured_data):
    number, theta_v, phi_v, theta_i, phi_i = np.loadtxt(
        measured_data / "btf/curet_tables/table.txt"
    ).T
    pairs = curet205()
    np.testing.assert_array_equal(number, np.arange(1, 206))
    # as vectors: near the pole the table's azimuth says nothing
    np.testing.assert_allclose(pairs.view, from_angles(theta_v, phi_v), atol=2e-6)
    np.testing.assert_allclose(pairs.light, from_angles(theta_i, phi_i), atol=2e-6)
