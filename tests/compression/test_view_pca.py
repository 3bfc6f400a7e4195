"""Per-view PCA against LAPACK's SVD of each view, and its promises about bytes, memory and bad input."""

import errno
import itertools
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.compression import open_appearance, view_pca
from btfpipe.compression.view_pca import ViewPcaModel, compress_view_pca
from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.sample import Sample


def views_of(appearance):
    """Lights x (texels and channels) of each view, float64."""
    pictures = appearance.pictures(slice(0, appearance.n_pairs)).astype(np.float64)
    return pictures.reshape(len(appearance.view_directions), len(appearance.light_directions), -1)


def naive(sample, components):
    """Each view's best approximation by its mean and principal components, by LAPACK."""
    out = []
    for view in views_of(sample):
        mean = view.mean(axis=0)
        left, values, right = np.linalg.svd(view - mean, full_matrices=False)
        out.append(mean + (left[:, :components] * values[:components]) @ right[:components])
    return np.stack(out)


@pytest.fixture
def noisy_sample(rng):
    """Make a product Sample of random pictures, brightness and noise falling with the light's height."""

    def make(rows=9, cols=7, n_lights=13, n_views=4, dtype=np.float32, **kwargs):
        pair = np.arange(n_lights * n_views)
        lights, views = bonn81()[:n_lights], bonn81()[:n_views]
        rank = rng.random((n_views, n_lights, 4)) @ rng.random((n_views, 4, rows * cols * 3))
        values = 0.2 * rank + 0.2 * rng.random(rank.shape)
        codes = values.reshape(-1, rows, cols, 3)
        if dtype == np.uint8:
            codes = np.round(255 * np.clip(codes, 0, 1))
        return Sample(
            codes.astype(dtype), lights, views, pair % n_lights, pair // n_lights, **kwargs
        )

    return make


@pytest.mark.parametrize("components", [1, 5, 11])
def test_each_view_is_its_best_approximation_of_that_rank(noisy_sample, components):
    sample = noisy_sample()
    model = compress_view_pca(sample, components, precision="single")
    np.testing.assert_allclose(views_of(model), naive(sample, components), atol=2e-6)


@settings(max_examples=15, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    n_lights=st.integers(2, 9),
    n_views=st.integers(1, 4),
    components=st.integers(1, 10),
    seed=st.integers(0, 1000),
)
def test_any_small_sample_is_approximated_as_by_lapack(shape, n_lights, n_views, components, seed):
    codes = np.random.default_rng(seed).random((n_lights * n_views, *shape, 3), np.float32)
    pair = np.arange(len(codes))
    sample = Sample(
        codes, bonn81()[:n_lights], bonn81()[:n_views], pair % n_lights, pair // n_lights
    )
    model = compress_view_pca(sample, components, precision="single")
    assert model.n_terms == min(components, n_lights - 1, 3 * shape[0] * shape[1])
    np.testing.assert_allclose(views_of(model), naive(sample, components), atol=1e-5)


def test_all_terms_give_the_sample_back(noisy_sample):
    sample = noisy_sample()
    model = compress_view_pca(sample, 12, precision="single")
    np.testing.assert_allclose(views_of(model), views_of(sample), atol=1e-6)
    assert model.about["warnings"] == []
    half = compress_view_pca(sample, 12)
    np.testing.assert_allclose(views_of(half), views_of(sample), atol=2e-3)


def test_more_terms_are_never_worse(noisy_sample):
    sample = noisy_sample()
    errors = [compress_view_pca(sample, n).about["rmse"] for n in (1, 2, 3, 5, 8, 11)]
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))


def test_the_stated_errors_are_those_of_the_stored_factors(noisy_sample):
    sample = noisy_sample(dtype=np.uint8, transfer="srgb", scale=1.5)
    about = compress_view_pca(sample, 3).about
    model = views_of(compress_view_pca(sample, 3))
    error, values = model - views_of(sample), views_of(sample)
    assert about["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-5)
    assert about["energy_error"] == pytest.approx((error**2).sum() / (values**2).sum(), rel=1e-5)
    assert about["relative_error"] == pytest.approx(np.sqrt(about["energy_error"]), rel=1e-5)


def test_threads_and_memory_never_show(noisy_sample):
    sample = noisy_sample(30, 31)
    models = [
        compress_view_pca(sample, 4, threads=threads, memory=memory)
        for threads, memory in ((1, 2 << 30), (2, 2 << 30), (3, 108 << 20))
    ]
    for model in models[1:]:
        for name, array in model.arrays().items():
            assert array.tobytes() == models[0].arrays()[name].tobytes(), name
        assert model.about == models[0].about


def test_a_model_too_large_for_the_memory_waits_in_a_file(noisy_sample, tmp_path, monkeypatch):
    sample = noisy_sample(60, 61, dtype=np.uint8, transfer="srgb", n_views=70)
    small = 188 << 20  # the work takes 82 MB beside the process, the Model 9
    models = [compress_view_pca(sample, 5, memory=memory) for memory in (2 << 30, small)]
    assert not isinstance(models[0].textures, np.memmap)
    assert isinstance(models[1].textures, np.memmap)
    for name, model in zip("ab", models, strict=True):
        model.save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    monkeypatch.setattr(os, "posix_fallocate", no_room)
    with pytest.raises(InputError, match=r"no room for a temporary file of \d+ MB.*TMPDIR"):
        compress_view_pca(sample, 5, memory=small)


def no_room(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("gain", [False, True])
def test_scan_lines_read_in_parts_are_those_of_the_pictures(noisy_sample, monkeypatch, rng, gain):
    sample = noisy_sample(9, 7, dtype=np.uint8, transfer="srgb")
    if gain:
        sample.gain = rng.uniform(0.5, 1.5, (9, 7, 3)).astype(np.float32)
    monkeypatch.setattr(view_pca, "_DECODED_BYTES", 12 * 13 * 7 * 2)  # two lines
    model = compress_view_pca(sample, 3, precision="single")
    np.testing.assert_allclose(views_of(model), naive(sample, 3), atol=2e-6)
    # an appearance that has no codes gives whole pictures
    again = compress_view_pca(model, 3, precision="single")
    np.testing.assert_allclose(views_of(again), views_of(model), atol=2e-6)


def test_terms_beyond_the_lights_are_left_out_with_a_warning(noisy_sample):
    model = compress_view_pca(noisy_sample(n_lights=4), 5)
    assert model.n_terms == 3
    assert model.about["warnings"] == [
        "the views have at most 3 terms beside their mean: 2 of the 5 components left out"
    ]


def test_terms_that_are_only_rounding_are_left_out(rng):
    weights, textures = rng.random((3, 10, 2)), rng.random((3, 2, 40 * 3))
    pair = np.arange(30)
    sample = Sample(
        (weights @ textures).reshape(30, 8, 5, 3).astype(np.float32),
        bonn81()[:10], bonn81()[:3], pair % 10, pair // 10,
    )  # fmt: skip
    model = compress_view_pca(sample, 6, precision="single")
    assert model.n_terms == 2
    np.testing.assert_allclose(views_of(model), views_of(sample), atol=1e-6)


def test_bytes_take_less_and_cost_little_more_than_their_rounding(noisy_sample):
    sample = noisy_sample(30, 31)
    half, byte = (compress_view_pca(sample, 5, precision=p) for p in ("half", "byte"))
    assert byte.textures.nbytes == half.textures.nbytes / 2
    # each texture is off by up to half a step of 1 / 127 of its largest magnitude, evenly spread
    steps = np.abs(half.weights[..., 1:].astype(float)) / 127
    rounding = (steps**2).mean(axis=(0, 1)).sum() / 12
    expected = np.sqrt(half.about["rmse"] ** 2 + rounding)
    assert byte.about["rmse"] == pytest.approx(expected, rel=0.002)
    assert byte.about["rmse"] > half.about["rmse"]
    back = compress_view_pca(sample, 12, precision="byte")
    bound = 0.5 * np.abs(back.weights[..., 1:]).sum(axis=2).reshape(-1, 1) + 2e-3
    error = np.abs(views_of(back) - views_of(sample)).reshape(sample.n_pairs, -1)
    assert (error <= bound).all()


def test_half_precision_holds_values_beyond_its_range(noisy_sample):
    sample = noisy_sample()
    sample.codes = sample.codes * np.float32(1e9)
    model = compress_view_pca(sample, 12)
    assert model.textures.dtype == np.float16
    assert model.about["relative_error"] < 1e-3


def test_a_black_sample_becomes_a_black_model(noisy_sample):
    sample = noisy_sample()
    sample.codes = np.zeros_like(sample.codes)
    model = compress_view_pca(sample, 4)
    assert not model.pictures(slice(0, 5)).any()
    assert model.about["rmse"] == 0


def test_texels_pictures_and_file_agree(noisy_sample, tmp_path):
    model = compress_view_pca(noisy_sample(toroidal=True, texels_per_mm=7.5, absolute=True), 4)
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    assert isinstance(back, ViewPcaModel)
    assert (back.toroidal, back.texels_per_mm, back.absolute) == (True, 7.5, True)
    assert back.about["rmse"] == model.about["rmse"]
    pictures = model.pictures(slice(0, model.n_pairs))
    np.testing.assert_array_equal(back.pictures(slice(0, back.n_pairs)), pictures)
    some = np.array([50, 3, 17, 16])
    np.testing.assert_allclose(back.pictures(some), pictures[some], atol=1e-6)
    rows, cols = np.array([0, 3, 8]), np.array([1, 6, 2])
    np.testing.assert_allclose(
        back.texels(rows, cols), pictures[:, rows, cols].swapaxes(0, 1), atol=1e-6
    )
    stored = sum(array.nbytes for array in (back.means, back.textures, back.weights))
    assert stored <= back.nbytes <= (tmp_path / "m.npz").stat().st_size


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("toroidal", [True, False])
def test_the_shader_is_the_formula(noisy_sample, blended_pictures, rng, toroidal, interpolation):
    precision = "byte" if toroidal else "half"
    sample = noisy_sample(n_views=7, toroidal=toroidal)
    model = compress_view_pca(sample, 3, precision=precision)
    n = 50
    row, col = rng.uniform(-12, 20, (2, n))
    w_i, w_o = (from_angles(rng.uniform(0, 1.7, n), rng.uniform(0, 6.3, n)) for _ in range(2))
    found = model.evaluate(row, col, w_i, w_o, interpolation=interpolation)
    expected = blended_pictures(model, row, col, w_i, w_o, interpolation)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("components", [0, -2])
def test_fewer_components_than_one_are_refused(noisy_sample, components):
    with pytest.raises(InputError, match=f"{components} components asked for; expected at least 1"):
        compress_view_pca(noisy_sample(), components)


def test_bad_input_is_refused_by_name(noisy_sample):
    sample = noisy_sample()
    with pytest.raises(InputError, match="expected half, single or byte"):
        compress_view_pca(sample, precision="quarter")
    with pytest.raises(InputError, match=r"need \d+ MB; --memory allows 32 MB"):
        compress_view_pca(sample, memory=32 << 20)
    some = Sample(
        sample.codes[:-1], sample.light_directions, sample.view_directions,
        sample.light_index[:-1], sample.view_index[:-1],
    )  # fmt: skip
    with pytest.raises(InputError, match="per-view PCA needs every view under every light"):
        compress_view_pca(some)
    sample.codes[7, 3, 4, 1] = np.nan
    with pytest.raises(InputError, match="non-finite"):
        compress_view_pca(sample)


def test_progress_ends_at_its_total(noisy_sample):
    seen = []
    compress_view_pca(noisy_sample(), on_progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert {total for _, total in seen} == {seen[-1][0]}


def test_bytes_are_the_nearest_to_the_textures(noisy_sample):
    """Not those below: every texture would be darker by half a step."""
    sample = noisy_sample(24, 20)
    exact = compress_view_pca(sample, 3, precision="single").textures
    stored = compress_view_pca(sample, 3, precision="byte").textures
    assert stored.dtype == np.int8
    off = stored / 127 - exact
    assert np.abs(off).max() < 0.501 / 127
    assert abs(off.mean()) < 0.01 / 127
