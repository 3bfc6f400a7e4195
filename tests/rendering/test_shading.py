"""Shaders against the formula written out, at any texel, light and view."""

import numpy as np
import pytest

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import Hemisphere, from_angles
from btfpipe.errors import InputError
from btfpipe.sample import light_cosines
from btfpipe.sample.shading import RawShader

INTERPOLATIONS = ("barycentric", "four", "nearest")


def naive(appearance, row, col, w_i, w_o, interpolation):
    """Blend whole pictures over view, and value / cos over light; then blend four texels."""
    light = Hemisphere(appearance.light_directions, interpolation).weights(w_i)
    view = Hemisphere(appearance.view_directions, interpolation).weights(w_o)
    cosines = light_cosines(appearance.light_directions)
    n_lights = len(cosines)
    rows, cols = appearance.shape
    out = np.zeros((len(row), 3))
    for q in range(len(row)):
        if w_i[q, 2] <= 0:
            continue
        picture = 0
        for i, a in zip(light[0][q], light[1][q], strict=True):
            for o, b in zip(view[0][q], view[1][q], strict=True):
                pair = o * n_lights + i
                picture = picture + a * b * appearance.pictures([pair])[0] / cosines[i] * w_i[q, 2]
        top, left = int(np.floor(row[q])), int(np.floor(col[q]))
        for di in (0, 1):
            for dj in (0, 1):
                y, x = top + di, left + dj
                share = (1 - abs(row[q] - y)) * (1 - abs(col[q] - x))
                if appearance.toroidal:
                    y, x = y % rows, x % cols
                else:
                    y, x = np.clip(y, 0, rows - 1), np.clip(x, 0, cols - 1)
                out[q] += share * picture[y, x]
    return out


def queries(rng, n=60):
    row, col = rng.uniform(-25, 45, (2, n))
    w_i, w_o = (from_angles(rng.uniform(0, 1.7, n), rng.uniform(0, 6.3, n)) for _ in range(2))
    return row, col, w_i, w_o


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_raw_shader_is_the_formula(make_sample, rng, dtype, toroidal, interpolation):
    gain = rng.random((6, 9, 3)).astype(np.float32) + 0.5
    transfer = "linear" if dtype == np.float32 else "srgb"
    sample = make_sample(
        rows=6, cols=9, dtype=dtype, toroidal=toroidal, gain=gain, transfer=transfer, scale=2.0
    )
    row, col, w_i, w_o = queries(rng)
    found = sample.evaluate(row, col, w_i, w_o, interpolation=interpolation)
    expected = naive(sample, row, col, w_i, w_o, interpolation)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_svd_shader_is_the_formula(make_sample, rng, interpolation):
    model = compress_svd(make_sample(rows=6, cols=9, toroidal=True), 7)
    row, col, w_i, w_o = queries(rng)
    found = model.evaluate(row, col, w_i, w_o, interpolation=interpolation)
    np.testing.assert_allclose(found, naive(model, row, col, w_i, w_o, interpolation), atol=2e-5)


def test_many_queries_are_shaded_as_one_by_one(make_sample, rng):
    """More than a block of them, which are cut differently."""
    sample = make_sample(rows=6, cols=9, toroidal=True)
    row, col, w_i, w_o = queries(rng, 20_000)
    found = sample.evaluate(row, col, w_i, w_o)
    some = [0, 8191, 8192, 19_999]
    np.testing.assert_array_equal(
        found[some], sample.evaluate(row[some], col[some], w_i[some], w_o[some])
    )


def test_an_unknown_interpolation_is_refused(make_sample):
    with pytest.raises(InputError, match="expected barycentric, four, nearest or reciprocal"):
        RawShader(make_sample(), "cubic")


def test_float32_codes_with_a_curve_are_refused(make_sample):
    with pytest.raises(InputError, match="ingest it as linear"):
        make_sample(transfer="srgb").shader()


def test_sample_larger_than_the_machine_is_refused(make_sample, monkeypatch):
    import os

    monkeypatch.setattr(os, "sysconf", lambda name: 1000)
    with pytest.raises(InputError, match="btfpipe compress"):
        make_sample().shader()
