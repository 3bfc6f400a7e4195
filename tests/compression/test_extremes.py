"""Values at both ends of single precision, for every method: errors are the true ones, or a sentence says what is wrong."""

import numpy as np
import pytest

from btfpipe.compression import compress
from btfpipe.errors import InputError
from btfpipe.metrics.comparison import compare

METHODS = {
    "coded": {},
    "svd": {"components": 6, "precision": "single"},
    "factored": {"channel_components": (6, 4, 4), "space": "rgb", "precision": "single"},
    "view-pca": {"components": 3, "precision": "single"},
    "local-pca": {"clusters": 2, "components": 3, "precision": "single"},
    "harmonics": {"view_harmonics": 4, "light_harmonics": 9},
}


def whole(appearance):
    """All values in double precision."""
    return appearance.pictures(slice(0, appearance.n_pairs)).astype(np.float64)


@pytest.fixture
def scaled_sample(make_sample):
    """A Sample whose values are multiplied by a factor, and whose texels are noise: no Model is exact."""

    def make(factor):
        sample = make_sample(8, 8)
        noise = np.random.default_rng(3).random(sample.codes.shape, np.float32)
        sample.codes = (sample.codes + noise) * np.float32(factor)
        return sample

    return make


@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1.0, 1e10])
@pytest.mark.parametrize("method", METHODS)
def test_errors_are_true_at_any_scale(scaled_sample, method, factor):
    sample = scaled_sample(factor)
    model = compress([sample], method, **METHODS[method])
    error, energy = (np.square(a).sum() for a in (whole(model) - whole(sample), whole(sample)))
    rmse = np.sqrt(error / whole(sample).size)
    assert model.about["rmse"] == pytest.approx(rmse, rel=1e-3, abs=0)
    assert model.about["relative_error"] == pytest.approx(np.sqrt(error / energy), rel=1e-3)
    figures = compare(model, sample).overall()["linear"]
    assert figures["rmse"] == pytest.approx(rmse, rel=1e-6, abs=0)
    assert figures["relative_error"] == pytest.approx(np.sqrt(error / energy), rel=1e-6)


@pytest.mark.parametrize("factor", [1e37, 1e38])
@pytest.mark.parametrize("method", METHODS)
def test_values_too_large_for_their_sums_are_called_that(scaled_sample, method, factor):
    with pytest.raises(InputError, match="too large for single precision"):
        compress([scaled_sample(factor)], method, **METHODS[method])


def test_a_model_that_leaves_single_precision_is_refused(scaled_sample):
    with pytest.raises(InputError, match="what the model makes of them leaves single precision"):
        compress([scaled_sample(1.5e38)], "factored", space="log_y_uv_over_y")
    sample = scaled_sample(1.0)
    model = compress([sample], "svd", precision="single")
    model.texture_factors = model.texture_factors * np.float32(1e38)
    model.angular_factors = model.angular_factors * np.float32(1e38)
    with pytest.raises(InputError, match="of the model are not finite"):
        compare(model, sample)
