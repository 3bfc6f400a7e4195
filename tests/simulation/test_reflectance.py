"""The reflectance of a point against integrals over the hemisphere."""

import numpy as np
import pytest

from btfpipe.directions import from_angles
from btfpipe.simulation.reflectance import lobes, masking_ratio, reflect, schlick, visible_normal

UP = np.array([0.0, 0.0, 1.0])


def value(albedo, f0, roughness, light, view):
    n_l, n_v, l_h, coat = lobes(UP, np.full(3, f0), roughness, light, view)
    return reflect(albedo, f0, n_l, n_v, l_h, coat) if n_l > 0 else 0.0


def hemisphere(n=160):
    """Directions and solid angles of a product rule over the hemisphere."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    theta = (nodes + 1) * np.pi / 4
    phi = (np.arange(2 * n) + 0.5) * np.pi / n
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    solid = np.sin(theta) * weights[:, None] * np.pi / 4 * np.pi / n
    return from_angles(theta.ravel(), phi.ravel()), solid.ravel()


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("theta", [0.0, 0.8, 1.3])
@pytest.mark.parametrize(("albedo", "f0"), [(1.0, 0.0), (1.0, 0.04), (0.0, 1.0), (0.5, 0.5)])
def test_no_point_reflects_more_than_it_gets(roughness, theta, albedo, f0):
    view = from_angles(theta, 0.4)
    directions, solid = hemisphere()
    # value = pi f cos, so the reflected share is its integral over pi
    share = sum(
        value(albedo, f0, roughness, light, view) * w
        for light, w in zip(directions, solid, strict=True)
    )
    assert share / np.pi <= 1.0 + 1e-3
    if f0 == 0:
        assert share / np.pi == pytest.approx(1, abs=1e-3)
    if f0 == 1 and roughness == 0.3:
        assert share / np.pi > 0.93  # a metal loses only what bounces twice on its micro-facets


def test_light_and_eye_can_be_exchanged(rng):
    for _ in range(200):
        light, view = from_angles(rng.uniform(0, 1.5, 2), rng.uniform(0, 6.3, 2))
        there = value(0.6, 0.3, 0.4, light, view) / light[2]
        back = value(0.6, 0.3, 0.4, view, light) / view[2]
        assert there == pytest.approx(back, rel=1e-9)


@pytest.mark.parametrize(("roughness", "theta"), [(0.4, 0.3), (0.7, 1.2), (1.0, 0.9)])
def test_drawn_half_vectors_reproduce_the_integral_of_the_coat(rng, roughness, theta):
    view = from_angles(theta, 0.0)
    f0, directions, solid = 0.3, *hemisphere()
    tint = 1 + 0.5 * directions[:, 0]  # something to see in the mirror
    expected = (
        sum(
            value(0.0, f0, roughness, light, view) * w * c
            for light, w, c in zip(directions, solid, tint, strict=True)
        )
        / np.pi
    )
    draws = []
    for u1, u2 in rng.uniform(size=(40_000, 2)):
        half = np.array(visible_normal(tuple(view), roughness, u1, u2))
        light = 2 * (view @ half) * half - view
        weight = 0.0
        if light[2] > 0:
            weight = schlick(f0, view @ half) * masking_ratio(roughness, light[2], view[2])
        draws.append(weight * (1 + 0.5 * light[0]))
    error = np.std(draws) / np.sqrt(len(draws))
    assert abs(np.mean(draws) - expected) < 4 * error + 1e-3
