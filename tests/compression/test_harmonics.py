"""Double spherical harmonics against least squares by numpy, a lambda by bisection, and functions they hold exactly."""

import itertools

import numpy as np
import pytest

from btfpipe import store
from btfpipe.compression import open_appearance
from btfpipe.compression.harmonics import HarmonicsModel, _Fit, compress_harmonics
from btfpipe.compression.model import measured_error
from btfpipe.directions import bonn81, from_angles
from btfpipe.directions.spherical_harmonics import spherical_harmonics
from btfpipe.errors import InputError
from btfpipe.sample import Sample


def product_sample(values, lights, views, **kwargs):
    """A Sample of values (views, lights, rows, cols, 3)."""
    pair = np.arange(len(views) * len(lights))
    codes = np.ascontiguousarray(values, np.float32).reshape(len(pair), *values.shape[2:])
    return Sample(codes, lights, views, pair % len(lights), pair // len(lights), **kwargs)


def smooth_sample(rng, rows=3, cols=40, n=5, noise=0.0):
    """A Sample of all Bonn pairs, of smooth lobes that no few harmonics hold exactly."""
    directions = bonn81()
    axes = rng.standard_normal((2, n, 3)) + np.array([0, 0, 2])
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    light, view = (np.exp(2 * (directions @ a.T - 1)) for a in axes)
    texture = rng.random((n, rows, cols, 3))
    values = np.einsum("vn,ln,nrck->vlrck", view, light * directions[:, 2:], texture)
    values += noise * rng.standard_normal(values.shape)
    return product_sample(values, directions, directions)


def squared_cosines(directions):
    """Weights of the views, of mean 1."""
    return directions[:, 2] ** 2 / (directions[:, 2] ** 2).mean()


def naive(values, basis, weights, n_steps=200):
    """Coefficients of one vector: the least lambda within the energy, by bisection over plain solves."""
    energy = 4 * np.pi / len(values) * (values**2).sum()
    gram, right = basis.T @ np.diag(weights) @ basis, basis.T @ (weights * values)

    def solve(penalty):
        if penalty == 0:
            root = np.sqrt(weights)
            return np.linalg.lstsq(root[:, None] * basis, root * values, rcond=1e-6)[0]
        return np.linalg.solve(gram + penalty * np.eye(len(gram)), right)

    coefficients = solve(0)
    if coefficients @ coefficients <= energy:
        return coefficients
    low, high = 0.0, 1e4
    for _ in range(n_steps):
        middle = (low + high) / 2
        coefficients = solve(middle)
        low, high = (middle, high) if coefficients @ coefficients > energy else (low, middle)
    return solve(high)


def worst_step(model):
    """Largest change of a value that the rounding of all codes could make."""
    views = np.abs(spherical_harmonics(model.view_directions, model.view_terms))
    lights = np.abs(spherical_harmonics(model.light_directions, model.light_terms))
    return float((views @ (model.step() / 2) @ lights.T).max())


def whole(appearance):
    return appearance.pictures(slice(0, appearance.n_pairs))


def test_a_white_diffuser_comes_back_within_half_a_per_cent():
    directions = bonn81()
    cosine = directions[None, :, 2, None, None, None] * np.ones((81, 81, 2, 3, 3))
    grey = Sample(
        np.round(255 * cosine.reshape(6561, 2, 3, 3) ** (1 / 2.2)).astype(np.uint8),
        directions, directions, np.arange(6561) % 81, np.arange(6561) // 81, transfer="gamma2.2",
    )  # fmt: skip
    rng = np.random.default_rng(3)
    for sample in (product_sample(cosine, directions, directions), grey):
        model = compress_harmonics(sample)
        theta, phi = np.arccos(rng.random(200)), 2 * np.pi * rng.random((2, 200))
        w_i, w_o = from_angles(np.minimum(theta, 1.3), phi[0]), from_angles(0.9 * theta, phi[1])
        error = model.evaluate(0.5, 1, w_i, w_o) - w_i[:, 2, None]
        assert np.abs(error).max() < 0.005
        assert model.about["relative_error"] < 0.005


def test_functions_of_few_harmonics_come_back_but_for_the_codes(rng):
    """Their energy lies high above the horizon, so that the constraint allows for them."""
    directions = bonn81()
    view = spherical_harmonics(directions, 9)[:, [0, 4, 8]] @ np.diag([1.0, 0.05, 0.05])
    view[:, 0] += 0.1 * directions[:, 2] ** 2
    light = directions[:, 2:] * (1 + 0.2 * directions[:, :2])
    texture = rng.random((3, 2, 2, 5, 3))
    texture[0] += 1
    sample = product_sample(
        np.einsum("vi,lj,ijrck->vlrck", view, light, texture), directions, directions
    )
    model = compress_harmonics(sample, 9, 9)
    assert worst_step(model) < 0.03
    assert np.abs(whole(model) - whole(sample)).max() < worst_step(model)
    assert model.about["relative_error"] < 0.003
    unfitted = compress_harmonics(sample, 4, 4)
    assert unfitted.about["relative_error"] > 0.01


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_each_vector_is_that_of_a_bisection(rng, noise):
    directions = bonn81()
    values = smooth_sample(rng, 1, 3, noise=noise).pictures(slice(0, 81)).reshape(1, 81, 9)
    for terms, weights in itertools.product(
        (4, 16, 25), (np.ones(81), squared_cosines(directions))
    ):
        fit = _Fit(directions, terms, "lights", None, weights)
        basis = spherical_harmonics(directions, terms)
        found = fit.apply(values)[0]
        expected = np.stack([naive(v.astype(float), basis, weights) for v in values[0].T], axis=1)
        np.testing.assert_allclose(basis @ found, basis @ expected, atol=2e-4 * values.max())
        np.testing.assert_allclose(found, expected, atol=2e-2 * np.abs(expected).max())


def test_no_vector_exceeds_its_energy_and_noise_reaches_it(rng):
    directions = bonn81()
    values = rng.standard_normal((7, 81, 50)).astype(np.float32)
    values[3, :, 4] = 0
    fit = _Fit(directions, 25, "lights", None)
    coefficients = fit.apply(values)
    energy = 4 * np.pi / 81 * (values.astype(float) ** 2).sum(axis=1)
    squares = (coefficients.astype(float) ** 2).sum(axis=1)
    assert (squares <= energy * (1 + 1e-5)).all()
    assert (coefficients[3, :, 4] == 0).all()
    plain = np.linalg.lstsq(spherical_harmonics(directions, 25), values[0], rcond=None)[0]
    bound = (plain**2).sum(axis=0) > energy[0]
    assert bound.sum() > 40
    np.testing.assert_allclose(squares[0][bound], energy[0][bound], rtol=1e-4)


def test_scaled_values_have_scaled_coefficients(rng):
    values = rng.standard_normal((1, 81, 20)).astype(np.float32)
    fit = _Fit(bonn81(), 36, "views", None)
    plain = fit.apply(values)
    for scale in (1e-12, 1e12):
        found = fit.apply(values * np.float32(scale))
        np.testing.assert_allclose(found / scale, plain, atol=2e-4 * np.abs(plain).max())


@pytest.mark.parametrize("equal", [False, True])
def test_the_whole_is_that_of_a_loop_over_texels(rng, equal):
    """Views first, weighted by their squared cosines or not, then lights, a vector at a time, without codes."""
    sample = smooth_sample(rng, 2, 2, noise=0.02)
    model = compress_harmonics(sample, 9, 16, equal_views=equal)
    weights = np.ones(81) if equal else squared_cosines(bonn81())
    values = whole(sample).reshape(81, 81, 2, 2, 3)
    views, lights = (spherical_harmonics(bonn81(), n) for n in (9, 16))
    for row, col, channel in ((0, 0, 0), (1, 0, 2), (1, 1, 1)):
        matrix = values[:, :, row, col, channel].astype(float)
        by_light = np.stack([naive(f, views, weights) for f in matrix.T], axis=1)
        both = np.stack([naive(f, lights, np.ones(81)) for f in by_light])
        found = model.texels([row], [col])[0, :, channel].reshape(81, 81)
        assert np.abs(found - views @ both @ lights.T).max() < worst_step(model) + 1e-3


def test_one_penalty_for_all_is_ridge_regression(rng):
    sample = smooth_sample(rng, 1, 2)
    model = compress_harmonics(sample, 9, 9, penalty=0.5)
    basis = spherical_harmonics(bonn81(), 9)
    seen, lit = (
        np.linalg.solve(basis.T * weights @ basis + 0.5 * np.eye(9), basis.T * weights)
        for weights in (squared_cosines(bonn81()), np.ones(81))
    )
    values = whole(sample).reshape(81, 81, 6).astype(float)
    expected = np.einsum("iv,jl,vla->aij", seen, lit, values).reshape(1, 2, 3, 9, 9)
    found = model.coefficients(slice(None), slice(None))
    assert (np.abs(found - expected) <= 0.51 * model.step() + 1e-5).all()
    assert model.about["penalty"] == 0.5


def test_the_stated_error_is_that_of_the_stored_codes(rng):
    sample = smooth_sample(rng, noise=0.02)
    model = compress_harmonics(sample, 9, 16)
    expected = measured_error(model, sample)
    for name in ("rmse", "relative_error"):
        assert model.about[name] == pytest.approx(expected[name], rel=1e-5)


def test_threads_and_memory_never_show(rng):
    sample = smooth_sample(rng, 3, 70, noise=0.02)
    models = [
        compress_harmonics(sample, 16, 16, threads=threads, memory=memory)
        for threads, memory in ((1, 2 << 30), (2, 2 << 30), (3, 180 << 20))
    ]
    for model in models[1:]:
        for name, array in model.arrays().items():
            assert array.tobytes() == models[0].arrays()[name].tobytes()
        assert model.about == models[0].about


def test_with_the_least_memory_the_codes_wait_in_a_file(rng, tmp_path):
    sample = smooth_sample(rng, 3, 70, noise=0.02)
    for memory in range(140 << 20, 200 << 20, 64 << 10):
        try:
            model = compress_harmonics(sample, 16, 16, memory=memory)
            break
        except InputError:
            continue
    assert isinstance(model.coefficient_codes, np.memmap)
    usual = compress_harmonics(sample, 16, 16)
    assert not isinstance(usual.coefficient_codes, np.memmap)
    for name, one in zip("ab", (model, usual), strict=True):
        one.save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_codes_gain_and_models_are_read_alike(make_sample, rng):
    gain = (0.5 + rng.random((4, 5, 3))).astype(np.float32)
    coded = make_sample(4, 5, dtype=np.uint8, transfer="srgb", scale=1.7)
    gained = make_sample(4, 5, dtype=np.uint8, transfer="srgb", scale=1.7, gain=gain)

    class Other:
        """An appearance without codes."""

        shape, n_pairs = coded.shape, coded.n_pairs
        require_product, texels = coded.require_product, coded.texels

        def __getattr__(self, name):
            if name == "codes":
                raise AttributeError(name)
            return getattr(coded, name)

    plain = compress_harmonics(coded, 4, 9)
    with_gain = compress_harmonics(gained, 4, 9)
    every = slice(None), slice(None)
    difference = with_gain.coefficients(*every) - plain.coefficients(*every) * gain[..., None, None]
    rounding = (with_gain.step() + plain.step() * gain[..., None, None]) / 2
    assert (np.abs(difference) <= 1.01 * rounding + 1e-5).all()
    assert (
        compress_harmonics(Other(), 4, 9).coefficient_codes.tobytes()
        == plain.coefficient_codes.tobytes()
    )


def test_a_file_gives_the_model_back(rng, tmp_path):
    sample = smooth_sample(rng, 2, 5)
    model = compress_harmonics(sample, 4, 9)
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    assert isinstance(back, HarmonicsModel)
    np.testing.assert_array_equal(whole(back), whole(model))
    assert back.about["rmse"] == model.about["rmse"]
    assert back.nbytes == 10 * 3 * 36 + 2 * 4 * 3 * 36 + 2 * 81 * 3 * 8
    broken = {name: np.asarray(a) for name, a in model.arrays().items()}
    tables = {
        name: getattr(model, name)
        for name in ("light_directions", "view_directions", "light_index", "view_index")
    }
    facts = {k: back.about[k] for k in ("method", "toroidal", "texels_per_mm", "absolute")}
    for change, message in (
        ({"codes": broken["codes"][..., :8]}, "8 spherical harmonics.*square"),
        ({"codes": broken["codes"].astype(np.uint16)}, "codes are uint16; expected uint8"),
        ({"minimum": broken["minimum"][:2]}, r"minimum has shape \(2, 4, 9\)"),
        ({"maximum": broken["maximum"] * np.nan}, "maximum holds 108 NaN"),
    ):
        store.write(tmp_path / "b.npz", "model", tables | broken | change, **facts)
        with pytest.raises(InputError, match=message):
            open_appearance(tmp_path / "b.npz")


def test_shading_agrees_with_texels_and_blends_between_them(rng):
    sample = smooth_sample(rng, 3, 4)
    sample.toroidal = True
    model = compress_harmonics(sample, 16, 9)
    pairs = rng.integers(0, 6561, 50)
    rows, cols = rng.integers(0, 3, 50), rng.integers(0, 4, 50)
    lights = model.light_directions[model.light_index[pairs]]
    views = model.view_directions[model.view_index[pairs]]
    expected = model.texels(rows, cols)[np.arange(50), pairs]
    np.testing.assert_allclose(model.evaluate(rows, cols, lights, views), expected, atol=1e-5)
    np.testing.assert_allclose(
        model.pictures(pairs)[np.arange(50), rows, cols], expected, atol=1e-5
    )
    between = model.evaluate(2.25, 3.5, lights, views)
    corners = [
        w * model.evaluate(r, c, lights, views)
        for r, c, w in ((2, 3, 0.375), (2, 0, 0.375), (0, 3, 0.125), (0, 0, 0.125))
    ]
    np.testing.assert_allclose(between, sum(corners), atol=1e-5)


def naive_value(model, row, col, w_i, w_o):
    """Y_v(w_o) C Y_l(w_i)^T at a texel, whatever the directions."""
    view = spherical_harmonics([w_o], model.view_terms)[0]
    light = spherical_harmonics([w_i], model.light_terms)[0]
    return np.einsum("i,cij,j->c", view, model.coefficients([row], [col])[0], light)


@pytest.fixture(scope="module")
def rough():
    """A Model of values so unlike a few harmonics that these ring: noise, cosine inside. Lights to 75, views to 60 degrees."""
    lights, views = bonn81(), bonn81()[:57]
    values = (
        np.random.default_rng(6).random((57, 81, 2, 3, 3)) ** 4 * lights[:, 2, None, None, None]
    )
    return compress_harmonics(product_sample(values, lights, views), 25, 25)


def test_within_the_measured_rings_values_are_those_of_the_harmonics(rough, rng):
    theta = rng.random((2, 40)) * np.radians([[74.99], [59.99]])
    phi = rng.random((2, 40)) * 6.3
    for w_i, w_o in zip(*from_angles(theta, phi), strict=True):
        found = rough.evaluate(1, 2, w_i, w_o)[0]
        np.testing.assert_allclose(found, naive_value(rough, 1, 2, w_i, w_o), atol=1e-4)


def test_beyond_the_last_ring_value_over_cosine_is_that_of_the_ring(rough, rng):
    for phi_i, phi_o in rng.random((20, 2)) * 6.3:
        ring_i, ring_o = (from_angles(np.radians(t), p) for t, p in ((75, phi_i), (60, phi_o)))
        expected = naive_value(rough, 0, 1, ring_i, ring_o) / ring_i[2]
        for theta_i, theta_o in np.radians([(75.01, 70), (80, 60.01), (89.9, 89.9), (85, 95)]):
            w_i, w_o = from_angles(theta_i, phi_i), from_angles(theta_o, phi_o)
            found = rough.evaluate(0, 1, w_i, w_o)[0] / w_i[2]
            np.testing.assert_allclose(found, expected, atol=1e-3)


def test_values_are_continuous_from_the_normal_to_the_horizon(rough):
    theta = np.radians(np.arange(0, 90.01, 0.02))
    fixed = from_angles(np.radians(50.0), 2.0)
    for moves in ("light", "view"):
        w = from_angles(theta, 1.1)
        found = rough.evaluate(1, 1, *((w, fixed) if moves == "light" else (fixed, w)))
        assert np.abs(np.diff(found, axis=0)).max() < 0.003 * np.abs(found).max()
        assert np.ptp(found) > 0.2 * np.abs(found).max()
    assert not rough.evaluate(1, 1, [1, 0, 0], fixed).any()


def test_many_lights_fade_as_one_does(rough, rng):
    shader = rough.shader()
    n = 200
    row, col = (rng.random((2, n)) * 2).astype(np.float32)
    w_i, w_o = (
        from_angles(np.radians(60 + 35 * rng.random(n)), 6.3 * rng.random(n)).astype(np.float32)
        for _ in range(2)
    )
    one, many = np.empty((2, n, 3), np.float32)
    shader.shade(row, col, w_i, w_o, one)
    shader.slices(row, col, w_o).shade(np.arange(n), w_i, many)
    np.testing.assert_allclose(many, one, atol=1e-5)
    assert np.abs(one).max() > 0.1


def test_light_from_below_gives_nothing(rng):
    model = compress_harmonics(smooth_sample(rng, 1, 1), 4, 9)
    below = from_angles([np.pi / 2, 1.6, 3.0], 0.3)
    below[0, 2] = 0
    assert not model.evaluate(0, 0, below, [0, 0, 1]).any()
    assert model.evaluate(0, 0, [0, 0, 1], [0, 0, 1]).all()


def test_directions_that_tell_too_few_harmonics_apart_are_warned_of(rng):
    model = compress_harmonics(smooth_sample(rng, 1, 2), 16, 49)
    assert len(model.about["warnings"]) == 1
    assert "81 lights tell only" in model.about["warnings"][0]
    assert "36 terms are what these directions support" in model.about["warnings"][0]
    assert model.about["relative_error"] < 0.02
    assert compress_harmonics(smooth_sample(rng, 1, 2), 16, 36).about["warnings"] == []


def test_invalid_texels_do_not_coarsen_the_codes_of_the_others(rng):
    sample = smooth_sample(rng, 2, 40)
    whole_range = compress_harmonics(sample, 9, 9)
    mask = np.ones((2, 40), bool)
    mask[0, 3:30] = mask[1, :] = False
    sample.codes[:, ~mask] = 9
    sample.mask = mask
    model = compress_harmonics(sample, 9, 9)
    assert (model.step() <= whole_range.step()).all()
    sample.codes[:, ~mask] = -9
    again = compress_harmonics(sample, 9, 9)
    np.testing.assert_array_equal(again.step(), model.step())
    np.testing.assert_array_equal(again.coefficient_codes[mask], model.coefficient_codes[mask])


def test_a_black_sample_becomes_a_black_model():
    model = compress_harmonics(
        product_sample(np.zeros((81, 81, 2, 2, 3)), bonn81(), bonn81()), 4, 4
    )
    assert not whole(model).any()
    assert model.about["relative_error"] == 0


def test_bad_input_is_refused_by_name(make_sample):
    sample = make_sample(2, 3)
    for terms, message in (
        ((9, 25), "9 terms over 7 views: more than there are. Pass --view-harmonics 4, which"),
        ((4, 24), "24 spherical harmonics asked for"),
        ((4, 25), "25 terms over 19 lights: more than there are. Pass --light-harmonics 9, which"),
    ):
        with pytest.raises(InputError, match=message):
            compress_harmonics(sample, *terms)
    for penalty in (-1, np.nan, np.inf):
        with pytest.raises(InputError, match="expected a number of 0 or more"):
            compress_harmonics(sample, 4, 9, penalty=penalty)
    with pytest.raises(InputError, match=r"need \d+ MB; --memory allows 8 MB"):
        compress_harmonics(sample, 4, 9, memory=8 << 20)
    some = Sample(
        sample.codes[:50], sample.light_directions, sample.view_directions,
        sample.light_index[:50], sample.view_index[:50],
    )  # fmt: skip
    with pytest.raises(InputError, match="method harmonics needs every view under every light"):
        compress_harmonics(some, 4, 9)
    for bad in (np.nan, np.inf):
        sample.codes[3, 1, 1, 0] = bad
        with pytest.raises(InputError, match="non-finite"):
            compress_harmonics(sample, 4, 9)
