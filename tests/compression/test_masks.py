"""Models of a Sample with a mask."""

import json

import numpy as np
import pytest

from btfpipe import store
from btfpipe.compression import compress, open_appearance
from btfpipe.errors import InputError
from btfpipe.sample.resample import Resampled

METHODS = {
    "coded": {"ratio": 8},
    "svd": {"components": 3},
    "factored": {"channel_components": (3, 2, 2)},
    "view-pca": {"components": 2},
    "local-pca": {"components": 2, "clusters": 2},
    "harmonics": {"view_harmonics": 4, "light_harmonics": 9},
}


@pytest.fixture
def masked(make_sample, rng):
    """A Sample a third of which is invalid, and its mask; what invalid texels hold is wrong."""
    mask = rng.random((16, 20)) < 0.67
    sample = make_sample(mask=mask)
    sample.codes = np.where(mask[..., None], sample.codes, np.float32(0.5))
    return sample


@pytest.mark.parametrize("method", METHODS)
def test_a_model_keeps_the_mask_and_its_error_is_that_of_valid_texels(masked, tmp_path, method):
    made = compress([masked], method, **METHODS[method])
    made.save(tmp_path / "m.npz")
    model = open_appearance(tmp_path / "m.npz")
    for one in (made, model):
        np.testing.assert_array_equal(one.mask, masked.mask)
    everything = slice(0, masked.n_pairs)
    truth = masked.pictures(everything)[:, masked.mask].astype(float)
    error = truth - model.pictures(everything)[:, masked.mask]
    about = model.about
    assert about["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-3)
    relative = np.sqrt(np.sum(error**2) / np.sum(truth**2))
    assert about["relative_error"] == pytest.approx(relative, rel=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_a_file_without_a_mask_is_of_a_sample_without_one(make_sample, tmp_path, method):
    compress([make_sample()], method, **METHODS[method]).save(tmp_path / "m.npz")
    assert "mask" not in store.read(tmp_path / "m.npz")
    model = open_appearance(tmp_path / "m.npz")
    assert model.mask is None
    assert model.n_invalid == 0


def test_each_material_of_a_database_has_its_own_mask(masked, make_sample, tmp_path):
    other = make_sample(8, 12, seed=2)
    database = compress([other, masked], "local-pca", components=2, clusters=3)
    database.save(tmp_path / "m.npz")
    assert open_appearance(tmp_path / "m.npz", 0).mask.all()
    second = open_appearance(tmp_path / "m.npz", 1)
    np.testing.assert_array_equal(second.mask, masked.mask)
    assert second.about["materials"][1]["invalid_texels"] == masked.n_invalid


def test_a_resampled_sample_keeps_its_mask(masked, make_sample):
    np.testing.assert_array_equal(Resampled(masked, make_sample()).mask, masked.mask)


@pytest.mark.parametrize("mask", [np.ones((3, 3), bool), np.ones((16, 20), np.float32)])
def test_a_mask_that_does_not_fit_is_refused(make_sample, tmp_path, mask):
    model = compress([make_sample()], "svd", components=2)
    model.mask = mask
    model.save(tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"m.npz: mask is .* expected bool"):
        open_appearance(tmp_path / "m.npz")


def test_info_and_export_count_invalid_texels(btfpipe, masked, tmp_path):
    masked.save(tmp_path / "s.npz")
    btfpipe("compress", tmp_path / "s.npz", "-o", tmp_path / "m.npz")
    told = json.loads(btfpipe("info", tmp_path / "m.npz", "--json").stdout)
    assert told["invalid_texels"] == masked.n_invalid
    done = btfpipe("export", tmp_path / "m.npz", "-o", tmp_path / "set.zip")
    assert f"Warning: {masked.n_invalid} of 320 texels are invalid" in done.stderr
    quiet = btfpipe("export", tmp_path / "m.npz", "-o", tmp_path / "set2.zip", "--json", "-q")
    assert f"Warning: {masked.n_invalid} of 320 texels" in quiet.stderr
    assert json.loads(quiet.stdout)["invalid_texels"] == masked.n_invalid


def test_export_of_a_sample_without_a_mask_does_not_warn(btfpipe, make_sample, tmp_path):
    make_sample().save(tmp_path / "s.npz")
    assert "invalid" not in btfpipe("export", tmp_path / "s.npz", "-o", tmp_path / "set.zip").stderr
