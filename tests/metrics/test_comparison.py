"""Comparisons of BTFs against whole-array numpy, and their choice of pairs."""

import numpy as np
import pytest

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.metrics import psnr, relative_error, rmse, ssim, to_display
from btfpipe.metrics.comparison import compare, matching_pairs, white_level
from btfpipe.metrics.sheet import error_sheet, pair_matrix, ramp
from btfpipe.sample import Sample

LUMA = np.array([0.2126, 0.7152, 0.0722])


def everything(appearance):
    return appearance.pictures(slice(0, appearance.n_pairs)).astype(np.float64)


def subset(sample, pairs):
    """The Sample of some pairs, as a list."""
    return Sample(
        sample.codes[pairs],
        sample.light_directions,
        sample.view_directions,
        sample.light_index[pairs],
        sample.view_index[pairs],
        transfer=sample.transfer,
        scale=sample.scale,
        absolute=sample.absolute,
    )


@pytest.fixture
def pair_of(make_sample):
    sample = make_sample(16, 20, dtype=np.uint8, transfer="srgb", scale=1.5)
    return compress_svd(sample, 6), sample


def test_streamed_figures_are_those_of_whole_arrays(pair_of):
    model, sample = pair_of
    found = compare(model, sample)
    mine, theirs = everything(model), everything(sample)
    display = [to_display(p, 1.5) for p in (theirs, mine)]
    figures = found.overall()
    assert figures["linear"]["rmse"] == pytest.approx(rmse(theirs, mine), rel=1e-5)
    assert figures["linear"]["psnr_db"] == pytest.approx(psnr(rmse(theirs, mine), 1.5), abs=1e-4)
    assert figures["linear"]["relative_error"] == pytest.approx(
        relative_error(theirs, mine), rel=1e-5
    )
    assert figures["display"]["rmse"] == pytest.approx(rmse(*display), rel=1e-4)
    assert figures["display"]["psnr_db"] == pytest.approx(psnr(rmse(*display)), abs=1e-3)
    for pair in (0, 57, 132):
        assert found.rmse[pair] == pytest.approx(rmse(theirs[pair], mine[pair]), rel=1e-4)
        lumas = [p[pair] @ LUMA for p in display]
        assert found.ssim[pair] == pytest.approx(ssim(*lumas), abs=1e-5)
    assert figures["display"]["ssim"] == pytest.approx(found.ssim.mean())


def test_the_figure_of_compress_is_the_figure_of_compare(pair_of):
    model, sample = pair_of
    assert compare(model, sample).overall()["linear"]["rmse"] == pytest.approx(
        model.about["rmse"], rel=1e-4
    )


def test_threads_never_show(make_sample):
    sample = make_sample(64, 80, dtype=np.uint8, transfer="srgb")
    model = compress_svd(sample, 6)
    one, two = compare(model, sample), compare(model, sample, threads=2)
    np.testing.assert_array_equal(one.rmse, two.rmse)
    np.testing.assert_array_equal(one.ssim, two.ssim)
    assert one.overall() == two.overall()


def test_a_sample_is_itself(make_sample):
    sample = make_sample()
    figures = compare(sample, sample).overall()
    assert figures["linear"]["rmse"] == 0
    assert figures["linear"]["psnr_db"] is None
    assert figures["display"]["ssim"] == pytest.approx(1, abs=1e-6)


def test_a_known_offset_has_its_known_error(make_sample):
    sample = make_sample(absolute=True)
    brighter = subset(sample, slice(0, sample.n_pairs))
    brighter.codes = sample.codes + np.float32(0.01)
    figures = compare(brighter, sample).overall()
    assert figures["linear"]["rmse"] == pytest.approx(0.01, rel=1e-4)
    assert figures["linear"]["psnr_db"] == pytest.approx(40, abs=1e-3)


def test_another_exposure_shows_in_the_best_scale_only(make_sample):
    sample = make_sample()
    darker = subset(sample, slice(0, sample.n_pairs))
    darker.codes = sample.codes * np.float32(0.5)
    linear = compare(darker, sample).overall()["linear"]
    assert linear["best_scale"] == pytest.approx(2, rel=1e-5)
    assert linear["rmse_after_best_scale"] < 1e-3 * linear["rmse"]


def test_invalid_texels_do_not_count(make_sample):
    mask = np.zeros((16, 20), bool)
    mask[2:12, 3:18] = True
    sample = make_sample(mask=mask)
    other = make_sample()
    other.codes = other.codes + np.where(mask, 0.0, 9.0).astype(np.float32)[..., None]
    assert compare(other, sample).overall()["linear"]["rmse"] == 0
    other.codes = other.codes + np.float32(0.02)
    assert compare(other, sample).overall()["linear"]["rmse"] == pytest.approx(0.02, rel=1e-3)


def masked(sample, mask):
    """The same Sample with another mask."""
    other = subset(sample, slice(0, sample.n_pairs))
    other.mask = mask
    return other


def test_ssim_reads_no_invalid_texel(make_sample):
    mask = np.ones((16, 20), bool)
    mask[:, 15:] = mask[0] = False
    sample = masked(make_sample(), mask)
    model = masked(sample, None)
    # as ingest leaves them: black on one side
    model.codes = np.where(mask[..., None], sample.codes + np.float32(0.02), 0)
    inside = slice(1, 16), slice(0, 15)
    found = compare(model, sample)
    white = white_level(sample)[0]
    for pair in (0, 57):
        lumas = [to_display(everything(a)[pair], white)[inside] @ LUMA for a in (sample, model)]
        assert found.ssim[pair] == pytest.approx(ssim(*lumas), abs=1e-6)
    mask[:, 10] = False  # no window is left
    assert compare(model, sample).overall()["display"]["ssim"] is None


def test_texels_count_that_are_valid_in_both(make_sample):
    sample = make_sample()
    left, top = np.ones((2, 16, 20), bool)
    left[:, 17:] = top[12:] = False
    reference, other = masked(sample, left), masked(sample, top)
    other.codes = sample.codes + np.where(left & top, 0.01, 9).astype(np.float32)[..., None]
    both = compare(other, reference).overall()
    assert both["linear"]["rmse"] == pytest.approx(0.01, rel=1e-4)
    assert both["display"]["ssim"] > 0.9
    # nor does the first one's mask alone go unheard
    reference.mask, other.mask = None, left & top
    assert compare(other, reference).overall() == both
    reference.mask = ~other.mask
    with pytest.raises(InputError, match="no texel is valid in both"):
        compare(other, reference)


def test_pairs_are_found_by_direction_not_by_number(make_sample, rng):
    sample = make_sample()
    chosen = rng.permutation(sample.n_pairs)[:30]
    turned = rng.permutation(19)
    shuffled = subset(sample, chosen)
    shuffled.light_directions = sample.light_directions[turned]
    shuffled.light_index = np.argsort(turned)[sample.light_index[chosen]]
    np.testing.assert_array_equal(matching_pairs(sample, shuffled), chosen)
    assert compare(sample, shuffled).overall()["linear"]["rmse"] == 0


def test_pairs_of_a_long_list_are_found_in_little_memory(rng, peak_bytes):
    count = 1500
    w_i, w_o = (from_angles(rng.uniform(0, 1.4, count), rng.uniform(0, 6, count)) for _ in range(2))
    w_o[7] = w_o[3]  # a view that two pairs share and that is there twice
    index = np.arange(count)
    sample = Sample(np.zeros((count, 1, 1, 3), np.uint8), w_i, w_o, index, index)
    turned = subset(sample, index[::-1])
    matching_pairs(sample, sample)  # imports
    with peak_bytes() as peak:
        np.testing.assert_array_equal(matching_pairs(sample, turned), index[::-1])
    assert peak[0] < 4 << 20


def test_a_missing_direction_or_pair_is_noticed(make_sample):
    sample = make_sample()
    without = subset(sample, np.arange(5, sample.n_pairs))
    assert matching_pairs(without, sample) is None
    other = make_sample(lights=bonn81()[:25])
    assert matching_pairs(sample, other) is None
    with pytest.raises(InputError, match="--interpolation"):
        compare(sample, other)


@pytest.mark.parametrize("way", ["barycentric", "four", "nearest"])
def test_interpolation_at_measured_directions_changes_nothing(pair_of, way):
    model, sample = pair_of
    own = compare(model, sample)
    between = compare(model, sample, interpolation=way)
    np.testing.assert_allclose(between.rmse, own.rmse, atol=2e-5)


def test_interpolation_between_directions_is_worse_than_at_them_but_not_wild(make_sample):
    lights = bonn81()[:37]
    coarse = make_sample(lights=lights[:19])
    fine = make_sample(lights=lights)
    found = compare(coarse, fine, interpolation="barycentric")
    known = fine.light_index < 19
    assert found.rmse[known].max() < 1e-5
    assert 1e-4 < found.rmse[~known].mean() < 0.2


def test_different_sizes_are_refused(make_sample):
    with pytest.raises(InputError, match="16 x 20 texels, the sample 16 x 24"):
        compare(make_sample(), make_sample(16, 24))


def test_non_finite_pictures_are_refused(make_sample):
    sample = make_sample()
    broken = make_sample()
    broken.codes[3, 0, 0, 0] = np.inf
    with pytest.raises(InputError, match="1 pictures hold non-finite"):
        compare(broken, sample)


def test_white_is_a_diffuser_if_the_scale_is_known_else_the_brightest(make_sample):
    assert white_level(make_sample(absolute=True))[0] == 1
    assert white_level(make_sample(dtype=np.uint8, scale=2.5))[0] == 2.5
    high = make_sample()
    high.codes = high.codes * np.float32(50)
    assert 20 < white_level(high)[0] < high.codes.max()


def test_pictures_under_eleven_texels_have_no_ssim(make_sample):
    sample = make_sample(8, 8)
    figures = compare(compress_svd(sample, 3), sample).overall()
    assert figures["display"]["ssim"] is None
    assert figures["linear"]["psnr_db"] > 10


def test_pair_matrix_has_views_down_and_lights_across(make_sample):
    sample = make_sample()
    matrix = pair_matrix(np.arange(sample.n_pairs), sample)
    assert matrix.shape == (7, 19)
    assert matrix[2, 5] == 2 * 19 + 5
    listed = pair_matrix(np.arange(10.0), subset(sample, np.arange(10)))
    assert listed.shape == (3, 4)
    assert np.isnan(listed[2, 2:]).all()


def test_the_ramp_grows_lighter():
    lightness = ramp(np.linspace(0, 1, 50)).astype(float) @ LUMA
    assert (np.diff(lightness) > -1).all()
    assert lightness[-1] - lightness[0] > 200


def test_the_sheet_shows_sample_and_model(pair_of):
    model, sample = pair_of
    found = compare(model, sample)
    sheet = error_sheet(sample, {"own pairs": found}, model.pictures)
    assert sheet.dtype == np.uint8
    assert sheet.shape[2] == 3
    worst = int(found.order()[-1])
    shown = np.round(to_display(everything(sample)[worst], 1.5) * 255).astype(np.uint8)
    zoom = 192 // 20
    corners = shown.repeat(zoom, 0).repeat(zoom, 1)
    rows = np.flatnonzero((sheet[:, 0] == corners[0, 0]).all(axis=1))
    found_at = [
        r for r in rows if np.array_equal(sheet[r : r + len(corners), : corners.shape[1]], corners)
    ]
    assert len(found_at) == 1
