"""The full-matrix SVD against LAPACK, and its promises about bytes, memory and bad input."""

import itertools

import numpy as np
import pytest

from btfpipe.compression import open_appearance
from btfpipe.compression.svd import SvdModel, compress_svd, planar_pictures
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.sample import Sample


def matrix(appearance):
    """Texels x (pairs and channels), float64."""
    pictures = appearance.pictures(slice(0, appearance.n_pairs)).astype(np.float64)
    return pictures.transpose(1, 2, 0, 3).reshape(-1, 3 * appearance.n_pairs)


@pytest.fixture
def spectrum_sample(rng):
    """Make a Sample whose singular values fall like a measured material's: a knee, then a long tail."""

    def make(rows=24, cols=20, n_lights=19, n_views=13, power=0.75):
        texels, columns = rows * cols, 3 * n_lights * n_views
        n = min(texels, columns)
        left = np.linalg.qr(rng.standard_normal((texels, n)))[0]
        right = np.linalg.qr(rng.standard_normal((columns, n)))[0]
        values = 30.0 / np.arange(1, n + 1) ** power
        pictures = (left * values) @ right.T
        pictures = pictures.reshape(rows, cols, -1, 3).transpose(2, 0, 1, 3).astype(np.float32)
        pair = np.arange(n_lights * n_views)
        lights, views = bonn81()[:n_lights], bonn81()[:n_views]
        return Sample(pictures, lights, views, pair % n_lights, pair // n_lights)

    return make


@pytest.mark.parametrize("n_terms", [5, 40])
def test_the_error_is_within_one_per_cent_of_lapacks(spectrum_sample, n_terms):
    sample = spectrum_sample()
    whole = matrix(sample)
    values = np.linalg.svd(whole, compute_uv=False)
    best = np.sqrt((values[n_terms:] ** 2).sum())
    model = compress_svd(sample, n_terms, precision="single")
    error = np.linalg.norm(matrix(model) - whole)
    assert best <= error * (1 + 1e-5)
    assert error <= 1.01 * best
    assert model.about["excess"] == pytest.approx(error / best - 1, rel=0.5)
    np.testing.assert_allclose(model.about["singular_values"], values[:n_terms], rtol=0.05)
    np.testing.assert_allclose(model.about["singular_values"][:5], values[:5], rtol=1e-3)


def test_a_slow_tail_needs_and_gets_more_passes(spectrum_sample):
    sample = spectrum_sample(power=0.15)
    whole = matrix(sample)
    best = np.sqrt((np.linalg.svd(whole, compute_uv=False)[10:] ** 2).sum())
    once = compress_svd(sample, 10, iterations=0, precision="single")
    enough = compress_svd(sample, 10, precision="single")
    assert np.linalg.norm(matrix(enough) - whole) <= 1.01 * best
    assert enough.about["iterations"] >= 1
    assert once.about["excess"] > 0.005 >= enough.about["excess"]
    assert enough.about["rmse"] < once.about["rmse"]


def test_eight_bit_codes_give_what_their_linear_values_give(make_sample):
    coded = make_sample(dtype=np.uint8, transfer="srgb", scale=1.7)
    pictures = coded.pictures(slice(0, coded.n_pairs))
    plain = Sample(
        pictures, coded.light_directions, coded.view_directions, coded.light_index, coded.view_index
    )
    np.testing.assert_array_equal(
        planar_pictures(coded, slice(3, 9)), planar_pictures(plain, slice(3, 9))
    )
    models = [compress_svd(sample, 12, precision="single") for sample in (coded, plain)]
    np.testing.assert_array_equal(models[0].texture_factors, models[1].texture_factors)
    np.testing.assert_array_equal(models[0].angular_factors, models[1].angular_factors)


def test_the_gain_of_each_texel_is_inside_the_values(make_sample, rng):
    gain = (0.5 + rng.random((16, 20, 3))).astype(np.float32)
    sample = make_sample(dtype=np.uint8, transfer="gamma2.2", gain=gain)
    model = compress_svd(sample, 30, precision="single")
    assert model.about["relative_error"] < 0.03
    np.testing.assert_allclose(
        np.linalg.norm(matrix(model) - matrix(sample)) / np.linalg.norm(matrix(sample)),
        model.about["relative_error"],
        rtol=1e-4,
    )


def test_the_stated_error_is_that_of_the_stored_factors(spectrum_sample):
    sample = spectrum_sample()
    for precision in ("half", "single"):
        model = compress_svd(sample, 40, precision=precision)
        difference = matrix(model) - matrix(sample)
        assert model.about["rmse"] == pytest.approx(np.sqrt((difference**2).mean()), rel=1e-5)
        assert model.about["relative_error"] == pytest.approx(
            np.linalg.norm(difference) / np.linalg.norm(matrix(sample)), rel=1e-5
        )


def test_more_terms_are_never_worse(spectrum_sample):
    sample = spectrum_sample()
    errors = [compress_svd(sample, n).about["rmse"] for n in (1, 2, 4, 8, 16, 32, 64)]
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))


@pytest.mark.parametrize(("rows", "cols"), [(6, 5), (40, 30)])
def test_full_rank_gives_the_sample_back_to_rounding(spectrum_sample, rows, cols):
    sample = spectrum_sample(rows, cols, n_lights=13, n_views=7)
    full = min(rows * cols, 3 * 13 * 7)
    model = compress_svd(sample, full, precision="single")
    assert np.linalg.norm(matrix(model) - matrix(sample)) < 2e-5 * np.linalg.norm(matrix(sample))
    half = compress_svd(sample, full, precision="half")
    assert half.about["relative_error"] < 1e-3


def test_texture_factors_are_orthogonal_and_balanced(spectrum_sample):
    model = compress_svd(spectrum_sample(), 20, precision="single")
    texture = model.texture_factors.reshape(-1, 20).astype(float)
    angular = model.angular_factors.reshape(-1, 20).astype(float)
    values = np.array(model.about["singular_values"])
    np.testing.assert_allclose(texture.T @ texture, np.diag(values), atol=1e-3 * values[0])
    np.testing.assert_allclose(angular.T @ angular, np.diag(values), atol=1e-3 * values[0])


def test_threads_and_memory_never_show(spectrum_sample):
    sample = spectrum_sample(32, 30)
    models = [
        compress_svd(sample, 20, threads=threads, memory=memory)
        for threads, memory in ((1, 2 << 30), (2, 2 << 30), (3, 109 << 20))
    ]
    for model in models[1:]:
        assert model.texture_factors.tobytes() == models[0].texture_factors.tobytes()
        assert model.angular_factors.tobytes() == models[0].angular_factors.tobytes()
        assert model.about == models[0].about


def test_directions_and_facts_are_carried_through_a_file(make_sample, tmp_path):
    sample = make_sample(toroidal=True, texels_per_mm=7.5, absolute=True)
    model = compress_svd(sample, 10)
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    assert isinstance(back, SvdModel)
    assert (back.toroidal, back.texels_per_mm, back.absolute) == (True, 7.5, True)
    for name in ("light_directions", "view_directions", "light_index", "view_index"):
        np.testing.assert_array_equal(getattr(back, name), getattr(sample, name))
    np.testing.assert_array_equal(
        back.pictures(slice(0, back.n_pairs)), model.pictures(slice(0, model.n_pairs))
    )
    assert back.about["rmse"] == model.about["rmse"]
    assert back.is_product


def test_a_list_of_pairs_is_compressed_as_a_list(make_sample):
    whole = make_sample()
    some = np.array([5, 99, 7, 60, 61, 62, 130])
    sample = Sample(
        whole.codes[some], whole.light_directions, whole.view_directions,
        whole.light_index[some], whole.view_index[some],
    )  # fmt: skip
    model = compress_svd(sample, 21, precision="single")
    assert not model.is_product
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-5)


def test_texels_and_pictures_agree(make_sample):
    model = compress_svd(make_sample(), 10)
    rows, cols = np.array([0, 3, 15]), np.array([1, 19, 7])
    pictures = model.pictures(slice(0, model.n_pairs))
    np.testing.assert_allclose(
        model.texels(rows, cols), pictures[:, rows, cols].swapaxes(0, 1), atol=1e-6
    )


def test_terms_beyond_the_rank_are_left_out(rng):
    texture, angular = rng.random((12, 12, 3)), rng.random((91, 3, 3))
    pictures = np.einsum("rcn,pkn->prck", texture, angular).astype(np.float32)
    pair = np.arange(91)
    sample = Sample(pictures, bonn81()[:13], bonn81()[:7], pair % 13, pair // 13)
    model = compress_svd(sample, 20, precision="single")
    assert model.n_terms == 3
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-5)


def test_a_black_sample_becomes_a_black_model(make_sample):
    sample = make_sample()
    sample.codes = np.zeros_like(sample.codes)
    model = compress_svd(sample, 4)
    assert not model.pictures(slice(0, 5)).any()
    assert model.about["rmse"] == 0


@pytest.mark.parametrize("lit", [1, 2, 3])
def test_a_sample_black_but_for_a_few_texels_keeps_them(make_sample, lit):
    sample = make_sample()
    sample.codes = np.zeros_like(sample.codes)
    for k in range(lit):  # each in another picture, so that few of the start's pictures show one
        sample.codes[10 + 40 * k, 5 + k, 7 * k, k] = 0.7 + 0.1 * k
    for seed in range(3):
        model = compress_svd(sample, 4, precision="single", seed=seed)
        assert model.n_terms == lit
        np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-6)


def test_texels_that_are_black_in_the_start_are_not_lost(make_sample, rng):
    sample = make_sample(24, 24, views=bonn81()[:19])
    values = np.zeros_like(sample.codes)
    values[:, :, :12] = rng.random((len(values), 1, 1, 1)) * rng.random((24, 12, 3))
    values[200, :, 12:] = 5 * rng.random((24, 12, 3))
    sample.codes = values
    for seed in range(4):  # a fifth of the pictures for the start
        model = compress_svd(sample, 20, precision="single", seed=seed)
        assert model.about["relative_error"] < 1e-5


def test_half_precision_holds_high_dynamic_range_that_its_values_would_leave(make_sample):
    sample = make_sample()
    sample.codes = sample.codes * np.float32(1e6)
    model = compress_svd(sample, 30)
    assert model.texture_factors.dtype == np.float16
    assert model.about["relative_error"] < 0.01
    sample.codes = sample.codes * np.float32(1e8)
    with pytest.raises(InputError, match="--precision single"):
        compress_svd(sample, 30)
    assert compress_svd(sample, 30, precision="single").about["relative_error"] < 0.01


@pytest.mark.parametrize("n_terms", [0, -3])
def test_fewer_terms_than_one_are_refused(make_sample, n_terms):
    with pytest.raises(InputError, match=f"{n_terms} terms asked for; expected at least 1"):
        compress_svd(make_sample(), n_terms)


@pytest.mark.parametrize(("rows", "n_lights", "most"), [(4, 19, 16), (16, 2, 6)])
def test_more_terms_than_can_exist_are_all_there_are(make_sample, rows, n_lights, most):
    sample = make_sample(rows, 4, lights=bonn81()[:n_lights], views=bonn81()[:1])
    model = compress_svd(sample, 40, precision="single")
    assert model.about["n_terms"] == model.n_terms <= most
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-5)


def test_unknown_precision_is_refused(make_sample):
    with pytest.raises(InputError, match="expected half or single"):
        compress_svd(make_sample(), 4, precision="quarter")


def test_non_finite_values_are_refused(make_sample):
    sample = make_sample()
    sample.codes[7, 3, 4, 1] = np.nan
    with pytest.raises(InputError, match="non-finite"):
        compress_svd(sample, 4)


def test_a_budget_too_small_for_one_block_is_refused_with_the_need(make_sample):
    with pytest.raises(InputError, match=r"need 10\d MB; --memory allows 32 MB"):
        compress_svd(make_sample(), 4, memory=32 << 20)


def test_progress_ends_at_its_total(make_sample):
    seen = []
    compress_svd(make_sample(), 4, on_progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert len({total for _, total in seen}) == 1
    assert seen[-1][0] == seen[-1][1]
