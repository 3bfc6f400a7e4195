"""Prefiltered look-ups: 16 rays a pixel against pictures of many unfiltered ones, which no level of detail has a part in."""

import contextlib

import numpy as np
import pytest
import yaml

from btfpipe.compression import compress, open_appearance
from btfpipe.directions import bonn81
from btfpipe.rendering.pyramid import Halving, Pyramid
from btfpipe.rendering.renderer import render
from btfpipe.rendering.scene import load_scene, pyramids
from btfpipe.sample import Sample
from btfpipe.sample.shading import RawShader


def weave(rows=48, cols=48, dtype=np.float16, toroidal=True, **more):
    """Two-coloured threads, eight texels wide over and under each other, with grain: lit and seen from a few directions."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:rows, :cols]
    over = ((y // 8 + x // 8) % 2).astype(bool)
    across = np.where(over, np.sin(np.pi * (y % 8 + 0.5) / 8), np.sin(np.pi * (x % 8 + 0.5) / 8))
    colour = np.where(over[..., None], [0.12, 0.4, 0.5], [0.85, 0.65, 0.4])
    texture = colour * across[..., None] * rng.uniform(0.6, 1.4, (rows, cols, 1))
    lights, views = bonn81()[:19], bonn81()[:7]
    tilt = np.where(over, 0.5, -0.5)[..., None] * np.cos(np.pi * (x % 8 + 0.5) / 8)[..., None]
    value = np.clip(lights[:, 2, None, None, None] + lights[:, 0, None, None, None] * tilt, 0, None)
    shift = 1 + 0.4 * views[:, 0, None, None, None] * tilt
    codes = (value[None] * shift[:, None] * texture).astype(dtype).reshape(-1, rows, cols, 3)
    pair = np.arange(len(codes))
    return Sample(codes, lights, views, pair % 19, pair // 19, toroidal=toroidal, **more)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filter")
    weave().save(folder / "sample.npz")
    compress([weave()], "svd", components=30).save(folder / "svd.npz")
    compress([weave()], "coded", ratio=10).save(folder / "coded.npz")
    return folder


def plane(folder, model, texels_a_pixel, size=16, camera=None, **extra):
    """A scene of a plane that fills the film, by default so that a pixel covers so many texels."""
    scene = {
        "camera": camera or {
            "type": "orthographic", "position": [0.013, 0.027, 5], "target": [0.013, 0.027, 0],
            "height": size * texels_a_pixel / 100,
        },
        "film": {"width": size, "height": size, "samples": 16},
        "lights": [{"type": "directional", "direction": [0.4, 0.5, 1], "irradiance": [3, 3, 3]}],
        "objects": [{
            "plane": {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [20, 20]},
            "model": str(folder / model), "texels_per_unit": 100,
        } | extra],
    }  # fmt: skip
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(scene))
    return path


def picture(path, samples, filtered, seed=0, threads=1):
    loaded = load_scene(path, film={"samples": samples, "texture_filter": filtered})
    return render(loaded, seed=seed, threads=threads)


def error(found, truth, inside=None):
    """RMS over mean, of pixels that are covered whole."""
    inside = truth[..., 3] == 1 if inside is None else inside
    found, truth = found[inside][:, :3], truth[inside][:, :3]
    return np.sqrt(((found - truth) ** 2).mean()) / truth.mean()


@pytest.mark.parametrize("texels", [pytest.param(2.3, marks=pytest.mark.slow), 4.5])
@pytest.mark.parametrize("model", ["svd.npz", "coded.npz"])
def test_16_filtered_rays_are_as_good_as_very_many(models, model, texels):
    path = plane(models, model, texels)
    truth = picture(path, 1024, False, seed=7)
    assert error(picture(path, 16, False), truth) > 0.035
    assert error(picture(path, 16, True), truth) < 0.02


@pytest.mark.slow
def test_a_plane_towards_the_horizon(models):
    camera = {
        "type": "perspective",
        "position": [0, -2, 0.5],
        "target": [0.3, 0, 0],
        "up": [0, 0, 1],
        "fov_deg": 30,
    }
    path = plane(models, "svd.npz", 0, camera=camera)
    truth = picture(path, 1024, False, seed=7)
    assert error(picture(path, 16, False), truth) > 0.04
    assert error(picture(path, 16, True), truth) < 0.02


def test_close_ups_keep_their_bytes(models):
    path = plane(models, "coded.npz", 0.6)
    np.testing.assert_array_equal(picture(path, 16, True), picture(path, 16, False))


def test_no_blur_where_a_texel_covers_a_pixel(models):
    path = plane(models, "svd.npz", 1.0)
    truth = picture(path, 1024, False, seed=7)
    filtered = picture(path, 16, True)
    assert error(filtered, truth) < min(0.03, error(picture(path, 16, False), truth))
    contrast = truth[..., :3].std(axis=(0, 1))
    np.testing.assert_allclose(filtered[..., :3].std(axis=(0, 1)), contrast, rtol=0.01)


@pytest.mark.slow
def test_a_moving_camera_does_not_flicker(models):
    """Moved by whole texels along a plane whose sample repeats, nothing else changes: frames differ by what rays miss."""
    frames = {True: [], False: []}
    for step in range(6):
        at = 0.013 + 0.48 * step + 0.0071 * step  # the sample's length, and a part of a pixel
        camera = {
            "type": "orthographic",
            "position": [at, 0, 5],
            "target": [at, 0, 0],
            "height": 24 * 0.045,
        }
        path = plane(models, "svd.npz", 0, size=24, camera=camera)
        truth = picture(path, 576, False, seed=7)
        for filtered, errors in frames.items():
            errors.append(picture(path, 16, filtered)[..., :3] - truth[..., :3])
    mean = truth[..., :3].mean()
    flicker = {key: np.std(errors, axis=0).mean() / mean for key, errors in frames.items()}
    assert flicker[True] < 0.02 < 0.05 < flicker[False]


def test_many_lights_and_threads_show_nothing(models):
    path = plane(models, "coded.npz", 4.5, size=16)
    scene = yaml.safe_load(path.read_text())
    light = scene["lights"][0]
    scene["lights"] = [
        light | {"irradiance": [0.5] * 3, "direction": [x, 0.5, 1]}
        for x in np.linspace(-1, 1, 6).tolist()
    ]
    path.write_text(yaml.safe_dump(scene))
    together = picture(path, 16, True)
    np.testing.assert_array_equal(picture(path, 16, True, threads=2), together)
    alone = 0
    for one in scene["lights"]:  # light by light nothing is shared
        path.write_text(yaml.safe_dump(scene | {"lights": [one]}))
        alone = alone + picture(path, 16, True)[..., :3]
    np.testing.assert_allclose(together[..., :3], alone, rtol=2e-4, atol=1e-5)


@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize("shape", [(8, 6), (7, 9), (1, 5), (20, 14), (13, 22)])
def test_levels_keep_the_mean_and_where_things_are(rng, shape, toroidal):
    weight = rng.random(shape)
    halving = Halving(shape, toroidal, weight)
    values = rng.random((shape[0] * shape[1], 3)).astype(np.float32)
    above = halving(values)
    mean = (above * halving.weight_above.reshape(-1, 1)).sum(axis=0) / halving.weight_above.sum()
    expected = (values * weight.reshape(-1, 1)).sum(axis=0) / weight.sum()
    np.testing.assert_allclose(mean, expected, rtol=1e-5)
    if not toroidal and min(shape) > 5:
        ramp = np.mgrid[: shape[0], : shape[1]].reshape(2, -1).T.astype(np.float32)
        found = Halving(shape, False)(ramp).reshape(*halving.halved, 2)
        for axis, (n, m) in enumerate(zip(shape, halving.halved, strict=True)):
            wanted = (np.arange(m) + 0.5) * n / m - 0.5
            inner = np.take(found[..., axis], range(2, m - 2), axis=axis)
            wanted = np.expand_dims(wanted[2:-2], 1 - axis)
            np.testing.assert_allclose(inner, np.broadcast_to(wanted, inner.shape), atol=1e-5)


@pytest.mark.parametrize("toroidal", [True, False])
def test_a_single_texel_is_the_mean_of_all_whatever_their_number(rng, toroidal):
    shape = (20, 14)
    values = rng.random((20 * 14, 3)).astype(np.float32)
    weight = rng.random(shape)
    expected = (values * weight.reshape(-1, 1)).sum(axis=0) / weight.sum()
    while max(shape) > 1:
        halving = Halving(shape, toroidal, weight)
        values, shape, weight = halving(values), halving.halved, halving.weight_above
    np.testing.assert_allclose(values[0], expected, rtol=1e-5)


def test_invalid_texels_count_for_nothing_where_a_map_leaves_them_out(rng):
    mask = np.ones((8, 8))
    mask[:4, :4] = 0
    values = np.full((64, 1), 0.5, np.float32)
    values[mask.ravel() == 0] = 100
    below = Halving((8, 8), True, mask)
    np.testing.assert_allclose(below(values), 0.5, rtol=1e-6)
    above = Halving(below.halved, True, below.weight_above)
    np.testing.assert_allclose(above(below(values)), 0.5, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_levels_of_a_sample_are_its_averaged_pictures(dtype):
    sample = weave(16, 8, dtype)
    pyramid = Pyramid(sample, RawShader(sample), "nearest")
    assert pyramid.nbytes == 0
    top = pyramid.level(pyramid.top)
    assert (top.rows, top.cols) == (1, 1)
    values = np.empty((19, 3), np.float32)
    zero = np.zeros(19, np.float32)
    views = np.tile(sample.view_directions[0], (19, 1)).astype(np.float32)
    top.shade(zero, zero, sample.light_directions.astype(np.float32), views, values)
    np.testing.assert_allclose(values, sample.pictures(slice(0, 19)).mean(axis=(1, 2)), rtol=0.02)


@pytest.mark.slow
def test_a_map_of_small_pieces(models, rng):
    """Pieces of 6 x 6 texels from anywhere, each other than its neighbours: most pixels see several."""
    from btfpipe.synthesis import CoordinateMap

    y, x = np.mgrid[:96, :96]
    row, col = rng.integers(0, 48, (2, 16, 16))
    row, col = ((a[y // 6, x // 6] + b % 6) % 48 for a, b in ((row, y), (col, x)))
    flat = [a.reshape(1, -1).astype(np.float32) for a in (row, col)]
    domain = {"plane": [96, 96], "toroidal": True}
    CoordinateMap(*flat, np.zeros_like(flat[0]), 100.0, domain).save(models / "map.npz")
    path = plane(models, "svd.npz", 4.5, size=20, map=str(models / "map.npz"))
    scene = yaml.safe_load(path.read_text())
    scene["objects"][0]["plane"]["size"] = [0.96, 0.96]
    path.write_text(yaml.safe_dump(scene))
    truth = picture(path, 1024, False, seed=7)
    assert error(picture(path, 16, False), truth) > 0.06
    found = picture(path, 16, True)
    assert error(found, truth) < 0.02
    np.testing.assert_array_equal(picture(path, 16, True, threads=2), found)


@pytest.mark.slow
def test_a_material_of_a_database_and_a_masked_sample(models):
    """Levels of a material are its own; texels that were not measured count for nothing."""
    other = weave()
    other.codes[:] *= np.float16(0.5)
    compress([weave(), other], "local-pca", components=6, clusters=4).save(models / "two.npz")
    mask = np.ones((48, 48), bool)
    mask[5:9, 6:12] = False
    holed = weave(mask=mask)
    holed.codes[:, ~mask] = 0
    holed.save(models / "masked.npz")
    found = {}
    for model, extra in (
        ("two.npz", {"material": 0}),
        ("two.npz", {"material": 1}),
        ("masked.npz", {}),
    ):
        path = plane(models, model, 4.5, size=12, **extra)
        truth = picture(path, 256, False, seed=7)
        assert error(picture(path, 16, True), truth) < 0.02
        found[model, extra.get("material")] = truth[..., :3].mean()
    assert found["two.npz", 1] < 0.6 * found["two.npz", 0]


def test_levels_report_that_they_are_made(models):
    scene = load_scene(plane(models, "coded.npz", 4.5, size=8), film={"texture_filter": True})
    told = []

    @contextlib.contextmanager
    def progress():
        yield lambda done, total: told.append((done, total))

    (pyramid,) = pyramids(scene)
    pyramid.progress = progress
    render(scene)
    assert told
    assert told[-1] == (pyramid.top, pyramid.top)


def random_directions(n, seed=1):
    out = np.random.default_rng(seed).normal(size=(n, 3))
    out[:, 2] = abs(out[:, 2]) + 0.3
    return (out / np.linalg.norm(out, axis=1)[:, None]).astype(np.float32)


def glossy(size=12, every=1):
    """Texels that shine, each towards its own side: between lights, views and texels roots are unlike values."""
    lights, views = bonn81()[::every], bonn81()[::4]
    normal = np.random.default_rng(2).normal([0, 0, 1.5], 0.6, (size * size, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    half = lights[None] + views[:, None]
    half /= np.linalg.norm(half, axis=2)[..., None]
    shine = np.clip(half @ normal.T, 0, 1) ** 12 + 0.05
    values = (lights[None, :, 2:] * shine).reshape(-1, size, size, 1) * [1, 0.8, 0.6]
    pair = np.arange(len(values))
    lit, seen = pair % len(lights), pair // len(lights)
    return Sample(values.astype(np.float32), lights, views, lit, seen, toroidal=True)


@pytest.fixture(scope="module")
def shiny(tmp_path_factory):
    """A `Pyramid` of `coded`."""
    path = tmp_path_factory.mktemp("shiny") / "coded.npz"
    compress([glossy()], "coded", ratio=4).save(path)
    source = open_appearance(path)
    return Pyramid(source, source.shader(), "barycentric")


def mean_shown(pyramid, w_i, w_o):
    """What level 0 shows on the mean (3,) all over the sample."""
    rows, cols = pyramid.appearance.shape
    row, col = (a.ravel().astype(np.float32) for a in np.mgrid[0:rows:0.25, 0:cols:0.25])
    values = np.empty((len(row), 3), np.float32)
    light, view = (np.tile(w, (len(row), 1)) for w in (w_i, w_o))
    pyramid.level(0).shade(row, col, light, view, values)
    return values.mean(axis=0)


def test_levels_of_blended_roots_are_as_bright_as_what_is_shown_under_any_light(shiny):
    lights, views = random_directions(12), random_directions(12, seed=2)
    shown = [mean_shown(shiny, *pair) for pair in zip(lights, views, strict=True)]
    zero, single = np.zeros(12, np.float32), np.empty((12, 3), np.float32)
    shiny.level(shiny.top).shade(zero, zero, lights, views, single)
    np.testing.assert_allclose(single, shown, rtol=0.01)


def test_their_slices_are_nearly_as_bright(shiny):
    view, lights = random_directions(6, seed=3), random_directions(12)
    shown = [[mean_shown(shiny, w_i, w_o) for w_i in lights] for w_o in view]
    top, base = shiny.level(shiny.top), shiny.level(0)
    factors = np.tile(top.texture[:1], (6, 1))
    slices = base.averaged_slices(top.slice_factors(factors, view), view, np.ones(6, np.float32))
    found = np.empty((6, 12, 3), np.float32)
    for number, w_i in enumerate(lights):
        slices.shade(np.arange(6), np.tile(w_i, (6, 1)), found[:, number])
    np.testing.assert_allclose(found.sum(axis=1), np.sum(shown, axis=1), rtol=0.02)


def test_their_slices_from_measured_views_are_as_bright_under_each_light(tmp_path):
    """Between few lights, where the mean of blended roots is far from that of blended values."""
    compress([glossy(every=6)], "coded", ratio=2).save(tmp_path / "few.npz")
    source = open_appearance(tmp_path / "few.npz")
    pyramid = Pyramid(source, source.shader(), "barycentric")
    view, lights = bonn81()[::12].astype(np.float32), random_directions(8)
    n = len(view)
    top, base = pyramid.level(pyramid.top), pyramid.level(0)
    factors = top.slice_factors(np.tile(top.texture[:1], (n, 1)), view)
    slices = base.averaged_slices(factors, view, np.ones(n, np.float32))
    for w_i in lights:
        shown = np.array([mean_shown(pyramid, w_i, w_o) for w_o in view])
        found = np.empty((n, 3), np.float32)
        slices.shade(np.arange(n), np.tile(w_i, (n, 1)), found)
        np.testing.assert_allclose(found, shown, rtol=0.02)
