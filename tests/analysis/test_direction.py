"""The direction of a material: of stripes drawn at known angles, and of materials without one."""

import numpy as np
import pytest

from btfpipe.analysis.direction import dominant_direction
from btfpipe.analysis.pyramid import plain_features


def direction_of(image, toroidal=True):
    return dominant_direction(
        plain_features(np.asarray(image, np.float32), toroidal, 1).levels[0], toroidal
    )


def waves(right, up, size=64):
    """A wave of so many periods to the right and up a picture, whose row 0 is its top."""
    row, col = np.mgrid[:size, :size]
    return np.sin(2 * np.pi * (right * col - up * row) / size)[..., None]


@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize(("right", "up"), [(5, 0), (0, 5), (4, 2), (4, -2), (-3, 6), (-3, -6)])
def test_stripes_change_across_themselves_at_their_period(rng, right, up, toroidal):
    noise = 0.3 * rng.standard_normal((64, 64, 1))
    found = direction_of(waves(right, up) + noise, toroidal)
    difference = found.angle - np.arctan2(up, right)
    assert abs(np.sin(difference)) < np.sin(np.radians(2))  # a direction has no sense
    assert found.share > 0.5
    assert found.period == pytest.approx(64 / np.hypot(right, up), rel=0.02 if toroidal else 0.15)


def test_materials_without_a_direction_have_none(rng):
    both = waves(4, 0) + waves(0, 4) + 0.1 * rng.standard_normal((64, 64, 1))
    assert direction_of(both).share < 0.1
    assert direction_of(rng.random((48, 64, 3)), toroidal=False).share < 0.1
    assert direction_of(np.ones((16, 16, 2))).share == 0


def test_finer_stripes_of_the_same_direction_do_not_hide_the_main_ones():
    found = direction_of(waves(0, 5) + 0.5 * waves(0, 25))
    assert found.period == pytest.approx(12.8)
    assert np.sin(found.angle) ** 2 == pytest.approx(1)
