"""Pyramids and plain features."""

import numpy as np
import pytest

from btfpipe.analysis.pyramid import halve, plain_features
from btfpipe.errors import InputError


def test_halving_keeps_coordinates():
    """A picture of its own coordinates: texel x of the fine level is at (x + 0.5) / 2 - 0.5 of the coarse one."""
    fine = np.stack(np.mgrid[:16, :20], axis=-1).astype(float)
    coarse = halve(fine, toroidal=False)
    expected = 2 * (np.stack(np.mgrid[:8, :10], axis=-1) + 0.5) - 0.5
    assert coarse.shape == (8, 10, 2)
    assert np.allclose(coarse[1:-1, 1:-1], expected[1:-1, 1:-1])


def test_halving_a_toroidal_image_commutes_with_shifts_by_two(rng):
    image = rng.random((12, 16, 3)).astype(np.float32)
    shifted = halve(np.roll(image, (4, -6), (0, 1)), toroidal=True)
    assert np.array_equal(shifted, np.roll(halve(image, toroidal=True), (2, -3), (0, 1)))
    assert shifted.dtype == np.float32


def test_halving_damps_the_finest_checkerboard():
    board = np.indices((16, 16)).sum(axis=0) % 2.0
    assert np.allclose(halve(board, toroidal=True), 0.5)


def test_plain_features_hold_the_image_and_its_mean(rng):
    image = rng.random((24, 32, 4))
    features = plain_features(image, toroidal=True, levels=2)
    level = features.levels[0]
    assert np.array_equal(level.vectors[level.labels], image.astype(np.float32))
    assert np.allclose(level.vectors[-1], image.mean(axis=(0, 1)))
    assert features.levels[1].shape == (12, 16)
    assert features.toroidal


def test_not_a_number_is_refused_with_its_place(rng):
    image = rng.random((24, 24, 3))
    image[7, 11, 2] = np.nan
    with pytest.raises(InputError, match="1 NaN or infinite values, the first at row 7, col 11"):
        plain_features(image)


def test_an_image_without_features_is_refused(rng):
    with pytest.raises(InputError, match="expected \\(rows, cols, features\\)"):
        plain_features(rng.random((24, 24)))


def test_a_sample_smaller_than_its_neighbourhood_is_refused_at_every_level(rng):
    with pytest.raises(InputError, match="4 x 12 texels on level 0"):
        plain_features(rng.random((4, 12, 3)), levels=1)
    with pytest.raises(InputError, match="4 x 6 texels on level 2"):
        plain_features(rng.random((16, 24, 3)), levels=3)


def test_sides_that_cannot_be_halved_are_refused_with_a_crop_that_can(rng):
    with pytest.raises(InputError, match="crop it to 40 x 44"):
        plain_features(rng.random((42, 47, 3)), levels=3)


def test_an_even_neighbourhood_is_refused(rng):
    with pytest.raises(InputError, match="expected an odd number"):
        plain_features(rng.random((24, 24, 3)), neighbourhood=4)


def test_values_up_to_the_limit_have_finite_distances_and_beyond_it_are_refused(rng):
    image = np.where(rng.random((16, 16, 3)) < 0.5, -1.0, 1.0)
    with pytest.raises(InputError, match=r"reaches 1e.25; squared distances overflow") as refused:
        plain_features(image * 1e25)
    limit = float(str(refused.value).split("beyond ")[1].split(". ")[0])
    vectors = plain_features(image * 0.99 * limit, levels=2).levels[0].vectors
    farthest = np.square(vectors.max(axis=0) - vectors.min(axis=0)).sum()
    assert np.isfinite(np.float32(farthest * (5**2 + 3**2)))
    with pytest.raises(InputError, match="overflow"):
        plain_features(image * 1.01 * limit)


def test_doubles_beyond_single_precision_are_too_large_and_not_infinite():
    with pytest.raises(InputError, match=r"reaches 1e.300"):
        plain_features(np.full((16, 16, 1), 1e300))
