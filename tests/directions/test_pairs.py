import numpy as np
import pytest

from btfpipe.directions import from_angles
from btfpipe.directions.pairs import NearestPairs
from btfpipe.errors import InputError


def scattered(n, seed, most_deg=80):
    """Unit vectors (n, 3) scattered over the upper hemisphere."""
    rng = np.random.default_rng(seed)
    theta = np.radians(most_deg) * np.sqrt(rng.random(n))
    return from_angles(theta, 2 * np.pi * rng.random(n))


def weights(near, w_i, w_o, most=9):
    pair, weight = np.empty((len(w_i), most), np.int32), np.empty((len(w_i), most), np.float32)
    near.find(np.asarray(w_i, np.float32), np.asarray(w_o, np.float32), pair, weight)
    return pair, weight


def naive(lights, views, w_i, w_o, count):
    """Weight of every pair for one query, straight from the definition."""
    d = np.sqrt(((lights - w_i) ** 2).sum(axis=1) + ((views - w_o) ** 2).sum(axis=1))
    order = np.argsort(d)
    radius = d[order[count]] if count < len(d) else 2 * np.sqrt(2)
    out = np.zeros(len(d))
    out[order[:count]] = (1 / d[order[:count]] - 1 / radius) ** 2
    return out / out.sum()


@pytest.mark.parametrize("count", [1, 4, 9])
def test_weights_are_those_of_the_definition(count):
    lights, views, w_i, w_o = scattered(60, 1), scattered(60, 2), scattered(50, 3), scattered(50, 4)
    pair, weight = weights(NearestPairs(lights, views, count), w_i, w_o)
    for q in range(50):
        found = np.bincount(pair[q], weight[q], 60)
        np.testing.assert_allclose(found, naive(lights, views, w_i[q], w_o[q], count), atol=2e-5)


def test_a_measured_pair_is_itself():
    lights, views = scattered(30, 1), scattered(30, 2)
    pair, weight = weights(NearestPairs(lights, views, 9), lights, views)
    np.testing.assert_array_equal(pair[:, 0], np.arange(30))
    np.testing.assert_array_equal(weight[:, 0], 1)
    assert not weight[:, 1:].any()


def test_values_change_continuously_along_a_path():
    lights, views, values = scattered(40, 1), scattered(40, 2), np.random.default_rng(3).random(40)
    theta = np.linspace(0, 1.2, 4001)
    w_i, w_o = from_angles(theta, 0.3 + theta), from_angles(1.2 - theta, 2.0)
    pair, weight = weights(NearestPairs(lights, views, 9), w_i, w_o)
    path = (values[pair] * weight).sum(axis=1)
    assert np.ptp(path) > 0.05
    assert np.abs(np.diff(path)).max() < 0.01


def test_fewer_pairs_than_wanted_all_share():
    lights, views = scattered(3, 1), scattered(3, 2)
    w_i, w_o = scattered(8, 3), scattered(8, 4)
    pair, weight = weights(NearestPairs(lights, views, 9), w_i, w_o)
    for q in range(8):
        found = np.bincount(pair[q], weight[q], 3)
        np.testing.assert_allclose(found, naive(lights, views, w_i[q], w_o[q], 3), atol=2e-5)


def test_reciprocal_pairs_answer_for_exchanged_directions():
    lights, views = scattered(30, 1), scattered(30, 2)
    pair, weight = weights(NearestPairs(lights, views, 9, reciprocal=True), views, lights)
    np.testing.assert_array_equal(pair[:, 0], np.arange(30))
    np.testing.assert_array_equal(weight[:, 0], 1)


def test_exchanged_pairs_give_way_to_measured_ones():
    """A product has both (a, b) and (b, a), whose pictures differ by parallax."""
    directions = scattered(9, 1)
    lights, views = np.tile(directions, (9, 1)), np.repeat(directions, 9, axis=0)
    near = NearestPairs(lights, views, 9, reciprocal=True)
    pair, weight = weights(near, lights, views)
    np.testing.assert_array_equal(pair[:, 0], np.arange(81))
    np.testing.assert_array_equal(weight[:, 0], 1)
    aside = lights + np.array([1e-5, 0, 0])  # next to a pair, its value
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    values = np.random.default_rng(3).random(81)
    pair, weight = weights(near, aside, views)
    np.testing.assert_allclose((values[pair] * weight).sum(axis=1), values, atol=1e-3)


def test_directions_below_the_surface_are_taken_at_the_horizon():
    near = NearestPairs(scattered(30, 1), scattered(30, 2), 9)
    below, level = from_angles([np.pi / 2 + 0.2], [0.7]), from_angles([np.pi / 2], [0.7])
    for a, b in zip(
        weights(near, below, scattered(1, 3)), weights(near, level, scattered(1, 3)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_measured_pair_below_the_surface_is_refused():
    with pytest.raises(InputError, match="below the surface"):
        NearestPairs(-scattered(3, 1), scattered(3, 2), 4)
