"""Samples that are lists of pairs go everywhere that products go."""

import numpy as np
import pytest
from shared_roots import NaiveRoots

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81, from_angles
from btfpipe.sample import Sample


def as_list(sample, order):
    """The same pictures as a list of pairs in another order."""
    return Sample(
        sample.codes[order], sample.light_directions, sample.view_directions,
        sample.light_index[order], sample.view_index[order], transfer=sample.transfer,
    )  # fmt: skip


@pytest.fixture
def lambertian():
    """A white diffuser over 60 scattered pairs: value cos(theta_i)."""
    rng = np.random.default_rng(1)
    theta, phi = np.radians(75) * np.sqrt(rng.random((2, 60))), 2 * np.pi * rng.random((2, 60))
    lights, views = from_angles(theta[0], phi[0]), from_angles(theta[1], phi[1])
    codes = np.broadcast_to(lights[:, 2, None, None, None], (60, 4, 5, 3)).astype(np.float32)
    return Sample(codes, lights, views, np.arange(60), np.arange(60))


def queries(n, seed=2):
    rng = np.random.default_rng(seed)
    theta, phi = np.radians(89) * np.sqrt(rng.random((2, n))), 2 * np.pi * rng.random((2, n))
    return from_angles(theta[0], phi[0]), from_angles(theta[1], phi[1])


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest", "reciprocal"])
def test_a_white_diffuser_is_white_at_every_direction(lambertian, interpolation):
    w_i, w_o = queries(300)
    for appearance in (lambertian, compress_svd(lambertian, 3, precision="single")):
        assert not appearance.is_product
        value = appearance.evaluate(1.3, 2.6, w_i, w_o, interpolation=interpolation)
        np.testing.assert_allclose(value, w_i[:, 2:] * np.ones(3), atol=1e-4)


def test_the_nearest_pair_of_a_product_in_any_order_is_its_nearest_light_and_view(make_sample):
    product = make_sample()
    listed = as_list(product, np.random.default_rng(3).permutation(product.n_pairs))
    assert not listed.is_product
    w_i, w_o = queries(400)
    rng = np.random.default_rng(4)
    row, col = rng.random(400) * 15, rng.random(400) * 19
    a, b = (s.evaluate(row, col, w_i, w_o, interpolation="nearest") for s in (product, listed))
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_exchanging_light_and_view_leaves_value_over_cosine(lambertian):
    rng = np.random.default_rng(5)
    lights, views = (
        lambertian.light_directions[lambertian.light_index],
        lambertian.view_directions[lambertian.view_index],
    )
    codes = rng.random(lambertian.codes.shape).astype(np.float32)
    sample = Sample(codes, lights, views, np.arange(60), np.arange(60))
    value = sample.evaluate(2, 3, views, lights, interpolation="reciprocal")
    expected = codes[:, 2, 3] / lights[:, 2:] * views[:, 2:]
    np.testing.assert_allclose(value, expected, rtol=1e-4)


def test_a_list_of_pairs_is_compressed_synthesised_and_rendered(make_sample, tmp_path):
    from btfpipe.analysis.textons import texton_features
    from btfpipe.rendering.renderer import render
    from btfpipe.rendering.scene import load_scene
    from btfpipe.synthesis.plane import grow_over_plane

    product = make_sample(24, 24, lights=bonn81()[:9], views=bonn81()[:5])
    listed = as_list(product, np.random.default_rng(3).permutation(product.n_pairs)[:30])
    model = compress_svd(listed, 12)
    model.save(tmp_path / "m.npz")
    features = texton_features(model, levels=2, n_textons=20, n_pictures=10)
    grow_over_plane(features, (32, 32), levels=2, k=4).save(tmp_path / "c.npz")
    (tmp_path / "scene.yaml").write_text(
        "camera: {type: orthographic, position: [0, 0, 3], target: [0, 0, 0], height: 2}\n"
        "lights: [{type: directional, direction: [0.2, 0.1, 1], irradiance: [3, 3, 3]}]\n"
        "objects: [{plane: {center: [0, 0, 0], s: [1, 0, 0], t: [0, 1, 0], size: [2, 2]}, model: m.npz,"
        " map: c.npz, interpolation: reciprocal}]\n"
    )
    picture = render(load_scene(tmp_path / "scene.yaml", film={"width": 16, "height": 16}))
    values = model.pictures(slice(None))
    assert picture[..., :3].min() > 0.2 * values.mean()
    assert picture[..., :3].std() > 0


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest", "reciprocal"])
def test_models_of_every_method_are_interpolated_as_their_pictures_are(make_sample, interpolation):
    """A Sample made of a Model's own pictures is evaluated like the Model; one of roots by its roots."""
    from btfpipe.compression import METHODS, compress

    few = {
        "svd": {"components": 6},
        "view-pca": {"components": 2},
        "local-pca": {"clusters": 3, "components": 4},
        "factored": {"channel_components": (5, 3, 3)},
        "coded": {"ratio": 4.0},
    }
    assert set(few) == {n for n, m in METHODS.items() if m.function} - {"harmonics"}
    sample = make_sample(10, 12)
    w_i, w_o = queries(200)
    rng = np.random.default_rng(4)
    row, col = rng.random(200) * 9, rng.random(200) * 11
    for method, options in few.items():
        model = compress([sample], method, **options)
        a = model.evaluate(row, col, w_i, w_o, interpolation=interpolation)
        if method == "coded":  # blends roots
            naive = NaiveRoots(model, interpolation)
            b = [naive(*query) for query in zip(row, col, w_i, w_o, strict=True)]
        else:
            pictures = Sample(
                model.pictures(slice(None)), sample.light_directions, sample.view_directions,
                sample.light_index, sample.view_index,
            )  # fmt: skip
            b = pictures.evaluate(row, col, w_i, w_o, interpolation=interpolation)
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4, err_msg=method)


def test_a_model_of_any_method_is_compressed_again_by_any_other(make_sample):
    """What is a Model is never taken for a Sample."""
    from btfpipe.analysis.textons import texton_features
    from btfpipe.compression import METHODS, compress
    from btfpipe.metrics import raw_bytes

    few = {
        "svd": {"components": 9},
        "view-pca": {"components": 4},
        "local-pca": {"clusters": 3, "components": 6},
        "factored": {"channel_components": (9, 6, 6)},
        "coded": {"ratio": 2.0},
        "harmonics": {"view_harmonics": 4, "light_harmonics": 9},
    }
    assert set(few) == {n for n, m in METHODS.items() if m.function}
    sample = make_sample(10, 12)
    for method, options in few.items():
        model = compress([sample], method, **options)
        model.about["sample_bytes"] = 12345
        assert raw_bytes(model) == 12345
        pictures = model.pictures(slice(None))
        for again in few:
            twice = compress([model], again, **few[again]).pictures(slice(None))
            assert np.abs(twice - pictures).mean() < 0.5 * pictures.std(), (method, again)
        texton_features(model, levels=1, n_textons=8, n_pictures=8)
