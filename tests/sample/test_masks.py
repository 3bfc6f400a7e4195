"""Masks of a measurement on their way into a Sample."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.sample import Sample
from btfpipe.sample.ingest import drift_gain
from btfpipe.sample.ingest import ingest as ingest_measurement
from btfpipe.sample.measurement import Measurement
from btfpipe.sample.resize import resize_mask


def sources(before, after, toroidal):
    """Inputs that each output texel is made of along one axis, in exact fractions."""
    scale = Fraction(before, after)
    for x in range(after):
        if scale >= 1:
            low, high = x * scale, (x + 1) * scale
            yield {i for i in range(before) if i < high and i + 1 > low}
        else:
            centre = (x + Fraction(1, 2)) * scale - Fraction(1, 2)
            near = {i for i in range(-1, before + 1) if abs(i - centre) < 1}
            yield {i % before if toroidal else min(max(i, 0), before - 1) for i in near}


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.integers(1, 12), st.integers(1, 12)),
    st.tuples(st.integers(1, 14), st.integers(1, 14)),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_a_resized_texel_is_valid_if_all_its_sources_are(shape, texels, toroidal, seed):
    mask = np.random.default_rng(seed).random(shape) < 0.8
    resized = resize_mask(mask, texels, toroidal)
    assert resized.shape == texels
    for i, rows in enumerate(sources(shape[0], texels[0], toroidal)):
        for j, cols in enumerate(sources(shape[1], texels[1], toroidal)):
            assert resized[i, j] == all(mask[r, c] for r in rows for c in cols)


@pytest.fixture
def ingest(tmp_path, rng):
    """Ingest random pictures with a mask; gives the Sample, the facts and the pictures."""

    def run(mask, dtype=np.float32, **options):
        codes = rng.random((3, *mask.shape, 3)) + 0.5
        codes = (codes * 100).astype(np.uint8) if dtype == np.uint8 else codes.astype(dtype)
        lights = from_angles(np.array([0, 0.5, 1]), np.zeros(3))
        measurement = Measurement(
            "pictures", lights, lights[:1], np.arange(3), np.zeros(3, int), list("abc"),
            codes.__getitem__, lambda picture: "linear", mask=mask,
        )  # fmt: skip
        facts = ingest_measurement(measurement, tmp_path / "s.npz", **options)
        return Sample.open(tmp_path / "s.npz"), facts, codes

    return run


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_invalid_texels_are_counted_and_black(ingest, rng, dtype):
    mask = rng.random((6, 8)) < 0.7
    sample, facts, codes = ingest(mask, dtype)
    np.testing.assert_array_equal(sample.mask, mask)
    assert facts["invalid_texels"] == sample.n_invalid == (~mask).sum()
    assert sample.about["source"]["invalid_texels"] == sample.n_invalid
    np.testing.assert_array_equal(sample.codes, codes * mask[..., None])


def test_crop_and_size_take_the_mask_along(ingest):
    mask = np.ones((6, 8), bool)
    mask[2, 3] = mask[0, 0] = False
    sample, facts, codes = ingest(mask, crop=(1, 2, 4, 6), size=(2, 3))
    expected = np.ones((2, 3), bool)
    expected[0, 0] = False  # of rows 1 and 2, cols 2 and 3
    np.testing.assert_array_equal(sample.mask, expected)
    assert facts["invalid_texels"] == 1
    means = codes[:, 1:5, 2:].reshape(3, 2, 2, 3, 2, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(sample.codes, means * expected[..., None], rtol=1e-5)


def test_a_crop_without_invalid_texels_has_no_mask(ingest):
    mask = np.ones((6, 8), bool)
    mask[0] = False
    sample, facts, _ = ingest(mask, crop=(1, 0, 5, 8))
    assert sample.mask is None
    assert "invalid_texels" not in facts


def test_a_crop_without_valid_texels_is_refused(ingest):
    with pytest.raises(InputError, match=r"no valid texel is left; choose another --crop"):
        ingest(np.arange(48).reshape(6, 8) > 15, crop=(0, 0, 2, 8))


def test_drift_is_that_of_the_valid_texels():
    y, x = np.mgrid[-1:1:12j, -1:1:16j]
    drift = np.repeat((1 + 0.2 * x - 0.1 * y * y)[..., None], 3, axis=2)
    mask = (x < 0.4) | (y > 0)
    gain = drift_gain(np.where(mask[..., None], drift, 0), mask)
    np.testing.assert_allclose((gain * drift)[mask], drift[mask].mean(), rtol=1e-5)
    assert np.isfinite(gain).all()
