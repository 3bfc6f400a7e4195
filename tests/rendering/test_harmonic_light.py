"""Environments in the frequency domain against sums over the hemisphere."""

import numpy as np
import pytest

from btfpipe.compression.harmonics import compress_harmonics
from btfpipe.directions import bonn81, from_angles
from btfpipe.directions.spherical_harmonics import (
    project_function,
    quadrature,
    rotate_coefficients,
    spherical_harmonics,
)
from btfpipe.errors import InputError
from btfpipe.rendering.environment import Environment
from btfpipe.rendering.harmonic_light import HarmonicEnvironment, project_environment
from btfpipe.sample import Sample


@pytest.fixture
def model(rng):
    """A Model of lobes: light and view terms 16 x 25."""
    directions = bonn81()
    axes = rng.standard_normal((2, 4, 3)) + np.array([0, 0, 2])
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    light, view = (np.exp(2 * (directions @ a.T - 1)) for a in axes)
    texture = rng.random((4, 3, 5, 3))
    values = np.einsum("vn,ln,nrck->vlrck", view, light * directions[:, 2:], texture)
    sample = Sample(
        values.reshape(6561, 3, 5, 3).astype(np.float32),
        directions, directions, np.arange(6561) % 81, np.arange(6561) // 81, toroidal=True,
    )  # fmt: skip
    return compress_harmonics(sample, 16, 25)


def turns(rng, n):
    """Random right-handed frames (n, 3, 3); the first is upright, the second upside down, the third hardly tilted."""
    q, r = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    q *= np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    q *= np.linalg.det(q)[:, None, None]
    q[0] = np.eye(3)
    q[1] = np.diag([1, -1, -1])
    tilt = 3e-4
    about_y = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    about_z = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
    q[2] = np.array(about_z) @ about_y
    return q


def shade(environment, row, col, frames, w_o, **kwargs):
    row, col, frames, w_o = (np.ascontiguousarray(a, np.float32) for a in (row, col, frames, w_o))
    out = np.full((len(row), 3), np.nan, np.float32)
    environment.shade(row, col, frames, w_o, out, **kwargs)
    return out


def summed(model, coefficients, row, col, frame, w_o):
    """The integral of value * radiance / pi over the hemisphere, by the model's own evaluation."""
    w_i, weights = quadrature(200, hemisphere=True)  # many nodes: the last ring is a kink
    radiance = spherical_harmonics(w_i @ frame, len(coefficients)) @ coefficients
    values = model.evaluate(row, col, w_i, w_o)
    return (weights[:, None] * values * radiance).sum(axis=0) / np.pi


@pytest.mark.parametrize("terms", [1, 25, 169])
def test_it_equals_the_sum_over_the_hemisphere(model, rng, terms):
    coefficients = rng.standard_normal((terms, 3)) / np.sqrt(terms)
    n = 8
    frames = turns(rng, n)
    row, col = 3 * rng.random(n), 5 * rng.random(n)
    w_o = from_angles(1.2 * rng.random(n), 6.3 * rng.random(n))
    found = shade(HarmonicEnvironment(model, coefficients), row, col, frames, w_o)
    expected = [
        summed(model, coefficients, *point) for point in zip(row, col, frames, w_o, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def map_directions(rows, cols):
    """Of a map's pixels, in its own axes: y up, -z in the middle."""
    y, x = 1 - 2 * (np.mgrid[:rows, :cols] + 0.5) / [[[rows]], [[cols]]]
    if cols == 2 * rows:
        theta, phi = np.pi / 2 * (1 - y), -np.pi * x
        return np.stack(
            [np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1
        )
    radius = np.hypot(x, y)
    away = np.sin(np.pi * radius) / radius
    return np.stack([-x * away, y * away, -np.cos(np.pi * radius)], axis=-1)


@pytest.mark.parametrize("shape", [(64, 128), (128, 128)])
def test_a_map_has_the_coefficients_of_the_function_that_it_shows(rng, shape):
    axes, _, _, turn = turns(rng, 4)

    def sky(directions):
        return np.exp(2 * (directions @ axes.T - 1))

    values = sky(map_directions(*shape) @ turn.T).astype(np.float32)
    found = project_environment(Environment(values, turn=turn), 49)
    expected = project_function(sky, 49)
    assert np.abs(expected[1:]).max() > 0.3
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_map_too_small_for_its_terms_is_refused_by_name():
    small = Environment(np.ones((16, 32, 3), np.float32), name="sky.exr")
    with pytest.raises(InputError, match=r"sky\.exr: 16 rows of pixels .* 64 terms at most"):
        project_environment(small, 169)
    assert np.isfinite(project_environment(small, 64)).all()


def test_a_white_diffuser_under_a_white_sky_is_white():
    directions = bonn81()
    values = directions[None, :, 2, None, None, None] * np.ones((81, 81, 1, 1, 3))
    sample = Sample(
        np.round(255 * values.reshape(6561, 1, 1, 3) ** (1 / 2.2)).astype(np.uint8),
        directions, directions, np.arange(6561) % 81, np.arange(6561) // 81, transfer="gamma2.2",
    )  # fmt: skip
    white = project_environment(Environment(np.ones((32, 64, 3), np.float32)), 169)
    environment = HarmonicEnvironment(compress_harmonics(sample), white)
    frames = turns(np.random.default_rng(5), 20)
    w_o = from_angles(np.linspace(0, 1.3, 20), np.linspace(0, 9, 20))
    found = shade(environment, np.zeros(20), np.zeros(20), frames, w_o)
    np.testing.assert_allclose(found, 1, atol=0.005)


def test_turning_environment_and_object_together_changes_nothing(model, rng):
    def sky(directions):
        return np.exp(3 * (directions @ axes.T - 1))

    axes = turns(rng, 4)[3]
    coefficients = project_function(sky, 169)
    n = 6
    frames, turn = turns(rng, n), turns(rng, 4)[3]
    row, col = 3 * rng.random(n), 5 * rng.random(n)
    w_o = from_angles(1.2 * rng.random(n), 6.3 * rng.random(n))
    before = shade(HarmonicEnvironment(model, coefficients), row, col, frames, w_o)
    turned = HarmonicEnvironment(model, rotate_coefficients(coefficients, turn))
    after = shade(turned, row, col, frames @ turn.T, w_o)
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert np.abs(shade(turned, row, col, frames, w_o) - before).max() > 0.01


def test_equal_terms_of_light_and_sky_lose_what_a_sharp_sky_adds(model, rng):
    sharp = project_function(lambda d: np.exp(12 * (d @ np.eye(3) - 1)), 169)
    frame = turns(rng, 6)[5]
    expected = summed(model, sharp, 0, 0, frame, [0, 0, 1])
    error = [
        np.abs(
            shade(HarmonicEnvironment(model, sharp, terms), [0], [0], frame[None], [[0, 0, 1]])
            - expected
        ).max()
        for terms in (25, 169)
    ]
    assert error[1] < 1e-5 < error[0]


def test_a_point_has_its_radiance_in_any_company_and_visibility_scales_it(model, rng):
    coefficients = rng.standard_normal((169, 3))
    environment = HarmonicEnvironment(model, coefficients)
    n = 19
    frames = turns(rng, n)
    row, col, w_o = np.arange(n) % 3, np.arange(n) % 5, np.tile([0, 0.6, 0.8], (n, 1))
    alone = [shade(environment, row[[i]], col[[i]], frames[[i]], w_o[[i]])[0] for i in range(n)]
    np.testing.assert_array_equal(shade(environment, row, col, frames, w_o), alone)
    visibility = np.linspace(0, 1, n).astype(np.float32)
    np.testing.assert_allclose(
        shade(environment, row, col, frames, w_o, visibility=visibility),
        alone * visibility[:, None],
        rtol=1e-6,
    )


def test_bad_environments_are_refused(model):
    for coefficients, terms, message in (
        (np.ones((169, 4)), None, r"shape \(169, 4\); expected \(n, 3\)"),
        (np.ones((24, 3)), None, "24 spherical harmonics"),
        (np.full((25, 3), np.nan), None, "NaN"),
        (np.ones((25, 3)), 36, "36 terms of an environment asked for; it has 25"),
        (np.ones((25, 3)), 24, "24 spherical harmonics"),
    ):
        with pytest.raises(InputError, match=message):
            HarmonicEnvironment(model, coefficients, terms)


def test_only_models_of_harmonics_are_lit_so(make_sample):
    with pytest.raises(InputError, match="method harmonics; this is a Sample"):
        HarmonicEnvironment(make_sample(), np.ones((25, 3)))
