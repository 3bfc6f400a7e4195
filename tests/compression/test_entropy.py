"""The range coder: nothing is lost, few bytes are needed, damage is found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from btfpipe.compression.entropy import decode_planes, encode_planes
from btfpipe.errors import InputError


@settings(max_examples=40, deadline=None)
@given(
    arrays(
        np.int32,
        array_shapes(min_dims=3, max_dims=3, max_side=9),
        elements=st.one_of(st.integers(-2, 2), st.integers(-(2**29), 2**29)),
    )
)
def test_every_integer_comes_back(planes):
    np.testing.assert_array_equal(decode_planes(encode_planes(planes), planes.shape), planes)


def test_carries_through_long_runs_come_back(rng):
    for spread in (0.02, 0.3, 3, 40, 4000):
        planes = np.round(rng.laplace(scale=spread, size=(7, 60, 50))).astype(np.int32)
        np.testing.assert_array_equal(decode_planes(encode_planes(planes), planes.shape), planes)


def test_numbers_without_structure_take_their_entropy(rng):
    planes = np.round(rng.laplace(scale=1.0, size=(20, 60, 60))).astype(np.int32)
    share = np.unique(planes, return_counts=True)[1] / planes.size
    entropy = -(share * np.log2(share)).sum() * planes.size / 8
    assert len(encode_planes(planes)) < 1.03 * entropy


def test_numbers_that_stand_together_take_less_than_their_entropy(rng):
    decay = 8 / (1 + np.add.outer(np.arange(60) ** 2, np.arange(60) ** 2) / 40)
    planes = np.round(rng.laplace(size=(20, 60, 60)) * decay).astype(np.int32)
    share = np.unique(planes, return_counts=True)[1] / planes.size
    entropy = -(share * np.log2(share)).sum() * planes.size / 8
    assert len(encode_planes(planes)) < 0.85 * entropy


def test_zeros_are_nearly_free():
    assert len(encode_planes(np.zeros((10, 100, 100), np.int32))) < 200


@pytest.mark.parametrize("value", [1 << 30, -(1 << 31)])
def test_numbers_beyond_thirty_bits_are_refused(value):
    planes = np.zeros((1, 4, 4), np.int32)
    planes[0, 2, 2] = value
    with pytest.raises(ValueError, match="less than 2"):
        encode_planes(planes)


@pytest.mark.parametrize("keep", [0, 5, 9, 200, -1])
def test_cut_off_bytes_are_refused(rng, keep):
    planes = rng.integers(-3, 4, (2, 30, 30)).astype(np.int32)
    with pytest.raises(InputError, match=r"cut off"):
        decode_planes(encode_planes(planes)[:keep], planes.shape)


def test_a_changed_byte_is_refused(rng):
    planes = rng.integers(-3, 4, (2, 30, 30)).astype(np.int32)
    coded = encode_planes(planes).copy()
    for at in (0, 8, 100, len(coded) - 1):
        spoilt = coded.copy()
        spoilt[at] ^= 4
        with pytest.raises(InputError, match="damaged"):
            decode_planes(spoilt, planes.shape)


def test_more_numbers_than_the_bytes_can_hold_are_refused(rng):
    coded = encode_planes(rng.integers(-3, 4, (2, 30, 30)).astype(np.int32))
    for shape in ((20, 30, 30), (1 << 20, 1 << 20, 1 << 20)):
        with pytest.raises(InputError, match="damaged"):
            decode_planes(coded, shape)
