"""Look-ups under many lights against the same values shaded one light after the other."""

import numpy as np
import pytest

from btfpipe.compression.coded import compress_coded
from btfpipe.compression.harmonics import compress_harmonics
from btfpipe.compression.light_slices import LightSlices
from btfpipe.parallel import single_threaded_blas


@pytest.fixture
def model(make_sample):
    return compress_coded(make_sample(rows=11, cols=13, toroidal=True), 6)


@pytest.fixture
def harmonics(make_sample):
    return compress_harmonics(make_sample(rows=11, cols=13, toroidal=True), 4, 9)


def directions(rng, n, lowest=0.0):
    """Unit vectors (n, 3) float32 above a height."""
    z = rng.uniform(lowest, 1, n)
    azimuth = rng.uniform(0, 2 * np.pi, n)
    across = np.sqrt(np.maximum(1 - z**2, 0))
    w = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
    return np.ascontiguousarray(w, np.float32)


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("toroidal", [True, False])
def test_slices_show_what_the_model_shows_light_by_light(model, rng, interpolation, toroidal):
    """Look-ups beyond the borders, views and lights at the horizon, lights below it."""
    model.toroidal = toroidal
    n = 3000
    row, col = (rng.uniform(-4, 18, n).astype(np.float32) for _ in range(2))
    w_o = directions(rng, n)
    with single_threaded_blas():
        slices = LightSlices(model.shader(interpolation), row, col, w_o)
    for _ in range(3):
        chosen = np.flatnonzero(rng.random(n) < 0.5)
        w_i = directions(rng, len(chosen), -0.2)
        found = np.full((len(chosen), 3), np.nan, np.float32)
        slices.shade(chosen, w_i, found)
        expected = model.evaluate(
            row[chosen], col[chosen], w_i, w_o[chosen], interpolation=interpolation
        )
        np.testing.assert_allclose(found, expected, atol=2e-5)
        assert expected.max() > 0.2
        assert (found[w_i[:, 2] <= 0] == 0).all()


def test_slices_of_harmonics_show_what_the_model_evaluates(harmonics, rng):
    n = 500
    row, col = (rng.uniform(-4, 18, n).astype(np.float32) for _ in range(2))
    w_o = directions(rng, n)
    slices = harmonics.shader().slices(row, col, w_o)
    chosen = np.flatnonzero(rng.random(n) < 0.5)
    w_i = directions(rng, len(chosen), -0.2)
    found = np.full((len(chosen), 3), np.nan, np.float32)
    slices.shade(chosen, w_i, found)
    expected = harmonics.evaluate(row[chosen], col[chosen], w_i, w_o[chosen])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert expected.max() > 0.2


def test_nothing_to_look_up_is_no_error(model):
    none = np.zeros(0, np.float32)
    slices = LightSlices(model.shader(), none, none, np.zeros((0, 3), np.float32))
    slices.shade(np.zeros(0, np.int64), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))


@pytest.fixture(params=["model", "harmonics"])
def under(request, sphere, scene_file, render_file, tmp_path):
    """Render two spheres, one before the other, of a Model under some lights."""
    request.getfixturevalue(request.param).save(tmp_path / "m.model.npz")
    entry = sphere(lambda lat, lon: (7 * lat, 9 * lon), rings=24, segments=48)
    entry["model"] = "m.model.npz"
    behind = entry | {"transform": {"translate": [0.7, 0.5, -1.5]}}

    def run(lights, **options):
        film = {"width": 96, "height": 80, "samples": 4, "filter": "box"}
        path = scene_file([entry, behind], lights=lights, film=film)
        return render_file(path, **options)

    return run


def some_lights(count):
    rng = np.random.default_rng(8)
    w = directions(rng, count, 0.1)
    return [
        {"type": "directional", "direction": list(d), "irradiance": list(e)}
        for d, e in zip(w.astype(float), rng.uniform(0.2, 2, (count, 3)), strict=True)
    ] + [{"type": "point", "position": [1, 2, 3], "intensity": [4.0, 5.0, 6.0]}]


def test_picture_under_many_lights_is_the_sum_of_those_under_each(under):
    """Light adds up; one light alone is shaded without slices."""
    lights = some_lights(6)
    together = under(lights)[..., :3]
    expected = sum(under([light])[..., :3] for light in lights)
    np.testing.assert_allclose(together, expected, atol=1e-4)
    assert together.max() > 0.5


def test_threads_never_show(under):
    lights = some_lights(4)
    np.testing.assert_array_equal(under(lights, threads=1), under(lights, threads=3))
