"""A sample at the directions of another: analytic laws, the shaders, and that it is read in bounded memory."""

import numpy as np
import pytest

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.sample import Sample, resample
from btfpipe.sample.resample import Resampled


def sample_of(function, lights, views, index=None, **kwargs):
    """A Sample of values ``function(w_i, w_o)`` (n,), brighter from texel to texel; a product, or the pairs of `index`."""
    pair = np.arange(len(lights) * len(views))
    light, view = (pair % len(lights), pair // len(lights)) if index is None else index
    texture = np.linspace(0.1, 0.9, 18).reshape(2, 3, 3)
    values = function(lights[light], views[view])[:, None, None, None] * texture
    return Sample(values.astype(np.float32), lights, views, light, view, **kwargs)


def some_directions(rng, count, steepest=1.2):
    return from_angles(rng.uniform(0.05, steepest, count), rng.uniform(0, 6.28, count))


def some_pairs(rng, count, lights, views):
    return rng.integers(0, lights, count), rng.integers(0, views, count)


@pytest.fixture
def shapes(rng):
    """A product and a list of pairs of other directions, to resample from or to."""
    lights, views = some_directions(rng, 9), some_directions(rng, 5)

    def make(kind, function=lambda w_i, w_o: w_i[:, 2]):
        if kind == "product":
            return sample_of(function, lights, views)
        return sample_of(function, lights[::-1], views, some_pairs(rng, 30, 9, 5))

    return make


@pytest.mark.parametrize("target", ["product", "list"])
@pytest.mark.parametrize("source", ["product", "list"])
def test_a_lambertian_sample_stays_the_cosine(rng, shapes, source, target):
    lights, views = bonn81()[:37], bonn81()[:13]
    index = None if source == "product" else some_pairs(rng, 200, 37, 13)
    white = sample_of(lambda w_i, w_o: w_i[:, 2], lights, views, index)
    target = shapes(target)
    resampled = Resampled(white, target)
    assert resampled.is_product == target.is_product
    np.testing.assert_allclose(
        resampled.pictures(slice(None)), target.pictures(slice(None)), rtol=2e-6, atol=1e-7
    )


def test_what_is_linear_between_the_directions_is_kept(rng, shapes):
    """Weights are barycentric in the stereographic plane: value / cos linear there, in light and in view, is exact."""

    def law(w_i, w_o):
        x, y = (w[:, :2] / (1 + w[:, 2:]) for w in (w_i, w_o))
        return w_i[:, 2] * (2 + x @ [1.0, -0.5]) * (3 + y @ [-1.5, 0.7])

    source, target = sample_of(law, bonn81(), bonn81()), shapes("list", law)
    found = Resampled(source, target).pictures(slice(None))
    np.testing.assert_allclose(found, target.pictures(slice(None)), rtol=1e-5)


@pytest.mark.parametrize("kind", ["product", "list"])
def test_at_its_own_directions_a_sample_is_itself(shapes, make_sample, kind):
    source = make_sample(5, 6, dtype=np.uint8, transfer="srgb", gain=np.full((5, 6, 3), 0.5, "f4"))
    if kind == "list":
        pairs = np.random.default_rng(3).permutation(source.n_pairs)[:50]
        source = Sample(
            source.codes[pairs], source.light_directions, source.view_directions,
            source.light_index[pairs], source.view_index[pairs], transfer="srgb", gain=source.gain,
        )  # fmt: skip
    found = Resampled(source, source)
    np.testing.assert_allclose(
        found.pictures(slice(None)), source.pictures(slice(None)), rtol=1e-6, atol=1e-9
    )
    backwards = Sample(
        source.codes[::-1], source.light_directions, source.view_directions, source.light_index[::-1],
        source.view_index[::-1],
    )  # fmt: skip
    np.testing.assert_allclose(
        Resampled(source, backwards).pictures(slice(0, 9)),
        source.pictures(slice(None))[::-1][:9],
        rtol=1e-6,
        atol=1e-9,
    )


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("target", ["product", "list"])
@pytest.mark.parametrize("stored", ["sample", "model"])
def test_pictures_are_what_the_source_evaluates_there(
    make_sample, shapes, stored, target, interpolation
):
    source = make_sample(5, 6, dtype=np.uint8, transfer="srgb", toroidal=True)
    if stored == "model":
        source = compress_svd(source, 6)
    target = shapes(target)
    found = Resampled(source, target, interpolation)
    assert (found.shape, found.toroidal) == ((5, 6), True)
    pictures = found.pictures(slice(None))
    w_i = target.light_directions[target.light_index]
    w_o = target.view_directions[target.view_index]
    for row, col in ((0, 0), (3, 4)):
        expected = source.evaluate(row, col, w_i, w_o, interpolation=interpolation)
        np.testing.assert_allclose(pictures[:, row, col], expected, atol=2e-6)
        again = found.evaluate(row, col, w_i, w_o, interpolation=interpolation)
        np.testing.assert_array_equal(again, expected)


def test_texels_and_some_pictures_are_those_of_all_pictures(make_sample, shapes):
    found = Resampled(make_sample(5, 6), shapes("list"))
    pictures = found.pictures(slice(None))
    rows, cols = np.array([0, 3, 4]), np.array([1, 5, 2])
    np.testing.assert_array_equal(found.texels(rows, cols), pictures[:, rows, cols].swapaxes(0, 1))
    some = np.array([7, 2, 2, 21])
    np.testing.assert_array_equal(found.pictures(some), pictures[some])


class Watched(Sample):
    """A Sample that remembers which pictures were read at a time."""

    def pictures(self, pairs):
        self.read.append(np.arange(self.n_pairs)[pairs])
        return super().pictures(pairs)


def watched(sample):
    source = Watched(
        sample.codes, sample.light_directions, sample.view_directions, sample.light_index, sample.view_index
    )  # fmt: skip
    source.read = []
    return source


def test_pictures_are_read_once_a_block_and_few_at_a_time(make_sample, shapes, monkeypatch):
    source = watched(make_sample(5, 6))
    found = Resampled(source, shapes("product"))
    assert source.read == []
    at_once = found.pictures(slice(0, 40))
    monkeypatch.setattr(resample, "_SOURCE_BYTES", 4 * 5 * 6 * 3 * 7)
    source.read = []
    np.testing.assert_array_equal(found.pictures(slice(0, 40)), at_once)
    assert max(map(len, source.read)) == 7
    read = np.concatenate(source.read)
    assert len(np.unique(read)) == len(read) < source.n_pairs
    source.codes[np.setdiff1d(np.arange(source.n_pairs), read)] = np.nan  # of no concern here
    np.testing.assert_array_equal(found.pictures(slice(0, 40)), at_once)


def test_where_directions_are_equal_only_the_same_pictures_are_read(make_sample):
    source = watched(make_sample(5, 6))
    Resampled(source, source).pictures(slice(17, 40))
    np.testing.assert_array_equal(np.concatenate(source.read), np.arange(17, 40))


def test_a_light_at_the_horizon_is_black(make_sample):
    target = sample_of(
        lambda w_i, w_o: w_i[:, 0], np.array([[1.0, 0, 0], [0, 0, 1]]), np.array([[0.0, 0, 1]])
    )
    found = Resampled(make_sample(4, 4), target).pictures(slice(None))
    assert not found[0].any()
    assert found[1].min() > 0


def test_bytes_count_what_is_kept(make_sample, shapes):
    source = make_sample(5, 6)
    found = Resampled(source, shapes("product"))
    tables = 9 * found.n_pairs * 8 + 8 * 3 * (9 + 5)
    assert found.nbytes == source.nbytes + tables


def test_a_source_lit_from_below_is_refused(make_sample, shapes):
    source = make_sample(4, 4)
    source.light_directions[3, 2] = -0.5
    source.light_directions[3] /= np.linalg.norm(source.light_directions[3])
    with pytest.raises(InputError, match="direction 3 points below the surface"):
        Resampled(source, shapes("product"))
