"""What a field is told about a material, on a sphere combed around its axis: parallels are even, meridians are not."""

import re

import numpy as np
import pytest

from btfpipe.analysis.pyramid import plain_features
from btfpipe.synthesis.field_fit import judge_field

QUARTER = np.pi / 2


def stripes(angle, period=8.0, size=48):
    """Features of stripes that run at `angle` from s towards t."""
    row, col = np.mgrid[:size, :size]
    across = -col * np.sin(angle) - row * np.cos(angle)
    image = np.sin(2 * np.pi * across / period)[..., None]
    return plain_features(image.astype(np.float32), False, 1)


@pytest.mark.parametrize(("angle", "turn"), [(0.0, 0.0), (QUARTER, -QUARTER), (0.6, -0.6)])
def test_cords_that_run_around_a_sphere_are_fine_and_those_that_run_to_its_poles_are_told(
    sphere, angle, turn
):
    level, scale = sphere(3000), 20.0
    facts, warnings = judge_field(stripes(angle), level, scale, turn)
    assert warnings == []
    # the summed curl of parallels is 4 pi, of meridians none
    assert facts["one_directional"] > 0.9
    assert facts["period_texels"] == pytest.approx(8, rel=0.1)
    expected = 4 * np.pi * scale / facts["period_texels"]
    assert facts["dislocations_turned_90"] == pytest.approx(expected, rel=0.05)
    assert facts["dislocations"] < 0.2 * expected
    for across in (turn + QUARTER, turn - QUARTER):
        facts, (warning,) = judge_field(stripes(angle), level, scale, across)
        assert facts["dislocations"] == pytest.approx(expected, rel=0.05)
        assert f"in about {facts['dislocations']:.0f} places" in warning
        # the angle that it advises is one that it does not warn of
        advised = np.radians(float(re.search(r"--turn-deg (\S+) here", warning)[1]))
        assert judge_field(stripes(angle), level, scale, advised)[1] == []


@pytest.mark.parametrize("turn", [0.0, 0.7, QUARTER])
def test_a_material_without_a_direction_is_never_warned_of(sphere, rng, turn):
    both = stripes(0.0).levels[0].vectors + stripes(QUARTER).levels[0].vectors
    image = both[stripes(0.0).levels[0].labels]
    for features in (
        plain_features(image, False, 1),
        plain_features(rng.random((32, 32, 3)).astype(np.float32)),
    ):
        facts, warnings = judge_field(features, sphere(1000), 20.0, turn)
        assert warnings == []
        assert set(facts) == {"one_directional"}


def test_neither_direction_far_better_is_no_warning(sphere, grid):
    """Half-way between parallels and meridians both are as bad; on a plane both are good; on a small sphere it is not worth it."""
    for level, scale, turn in (
        (sphere(1000), 20.0, np.pi / 4),
        (grid(20, 20), 1.0, QUARTER),
        (sphere(1000), 2.0, QUARTER),
    ):
        assert judge_field(stripes(0.0), level, scale, turn)[1] == []
