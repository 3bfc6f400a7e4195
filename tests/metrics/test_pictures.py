"""Errors of pictures against hand-computed values and an independent SSIM."""

import math

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.metrics import psnr, relative_error, rmse, ssim, to_display


def naive_ssim(x, y):
    """Wang et al. 2004 window by window, in double precision."""
    place = np.arange(11) - 5
    weights = np.exp(-(place[:, None] ** 2 + place[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    values = []
    for i in range(x.shape[0] - 10):
        for j in range(x.shape[1] - 10):
            a, b = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            ma, mb = (weights * a).sum(), (weights * b).sum()
            va, vb = (weights * (a - ma) ** 2).sum(), (weights * (b - mb) ** 2).sum()
            vab = (weights * (a - ma) * (b - mb)).sum()
            values.append(
                (2 * ma * mb + 1e-4) * (2 * vab + 9e-4)
                / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
            )  # fmt: skip
    return np.mean(values)


def test_rmse_and_relative_error_by_hand():
    reference = np.array([[3.0, 0.0], [0.0, 4.0]])
    picture = np.array([[3.0, 1.0], [0.0, 2.0]])
    assert rmse(reference, picture) == pytest.approx(math.sqrt(5 / 4))
    assert relative_error(reference, picture) == pytest.approx(math.sqrt(5) / 5)


def test_psnr_by_hand():
    assert psnr(0.1) == pytest.approx(20)
    assert psnr(0.02, peak=2.0) == pytest.approx(40)
    assert psnr(0.0) == math.inf


def test_relative_error_of_a_black_reference():
    black = np.zeros((2, 2))
    assert relative_error(black, black) == 0
    assert relative_error(black, black + 1) == math.inf


def test_eight_bit_differences_do_not_wrap():
    assert rmse(np.array([250], np.uint8), np.array([5], np.uint8)) == 245


def test_display_values_clip_at_white_and_follow_srgb():
    np.testing.assert_allclose(
        to_display([-1, 0, 0.0031308 * 2, 0.5, 2, 9], white=2),
        [0, 0, 0.04045, 0.537099, 1, 1],
        atol=1e-5,
    )  # 0.25 linear is 0.5371 display


def test_ssim_of_a_picture_with_itself_is_one(rng):
    picture = rng.random((20, 31))
    assert ssim(picture, picture) == pytest.approx(1, abs=1e-6)


def test_ssim_of_two_greys_has_only_the_luminance_term():
    a, b = np.full((12, 12), 0.2), np.full((12, 12), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_ssim_never_exceeds_one(rng):
    levels = rng.random((40, 2))
    pictures = [[np.full((11, 11), level) for level in pair] for pair in levels]
    assert max(ssim(a, a + 1e-4 * b) for a, b in pictures) <= 1


def test_ssim_of_a_negative_is_negative(rng):
    picture = rng.random((30, 30))
    assert ssim(picture, 1 - picture) < -0.5


@pytest.mark.parametrize("shape", [(11, 11), (17, 23)])
def test_ssim_matches_the_naive_window_by_window(rng, shape):
    picture = rng.random(shape)
    other = np.clip(picture + 0.2 * rng.standard_normal(shape), 0, 1)
    assert ssim(picture, other) == pytest.approx(naive_ssim(picture, other), abs=1e-5)


def test_small_and_mismatched_pictures_are_refused(rng):
    with pytest.raises(InputError, match="at least 11 x 11"):
        ssim(np.zeros((10, 40)), np.zeros((10, 40)))
    with pytest.raises(InputError, match="expected equal ones"):
        rmse(np.zeros((3, 3)), np.zeros((3, 4)))
