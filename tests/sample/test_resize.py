import numpy as np
import pytest

from btfpipe.sample.resize import Resizer


def test_shrinking_by_a_whole_factor_is_the_mean_of_blocks(rng):
    picture = rng.random((12, 20, 3)).astype(np.float32)
    expected = picture.reshape(4, 3, 5, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(Resizer((12, 20), (4, 5))(picture), expected, atol=1e-6)


@pytest.mark.parametrize("texels", [(5, 7), (12, 3), (1, 1), (11, 19)])
def test_shrinking_keeps_the_mean(rng, texels):
    picture = rng.random((12, 20, 3)).astype(np.float32)
    resized = Resizer((12, 20), texels)(picture)
    np.testing.assert_allclose(resized.mean(axis=(0, 1)), picture.mean(axis=(0, 1)), atol=1e-6)


def test_a_fraction_of_a_texel_counts_as_that_fraction():
    picture = np.zeros((1, 3, 3), np.float32)
    picture[0, 1] = 1
    # two texels, each covering one and a half: half of the middle one belongs to either
    np.testing.assert_allclose(Resizer((1, 3), (1, 2))(picture)[0, :, 0], [1 / 3, 1 / 3])


def test_growing_a_ramp_gives_a_ramp():
    ramp = np.repeat(np.arange(8, dtype=np.float32)[None, :, None], 3, axis=2)
    grown = Resizer((1, 8), (1, 32))(ramp)[0, :, 0]
    centres = (np.arange(32) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(grown, np.clip(centres, 0, 7), atol=1e-6)


def test_growing_a_toroidal_picture_wraps():
    picture = np.zeros((1, 4, 3), np.float32)
    picture[0, 0] = 1
    grown = Resizer((1, 4), (1, 8), toroidal=True)(picture)[0, :, 0]
    np.testing.assert_allclose(grown, [0.75, 0.75, 0.25, 0, 0, 0, 0, 0.25])


def test_the_same_size_changes_nothing(rng):
    picture = rng.random((6, 7, 3)).astype(np.float32)
    np.testing.assert_array_equal(Resizer((6, 7), (6, 7))(picture), picture)
