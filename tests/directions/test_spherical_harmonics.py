"""Real spherical harmonics against scipy's complex ones, their own orthonormality, and directions that are turned."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.directions import from_angles, to_angles
from btfpipe.directions.spherical_harmonics import (
    hemisphere_products,
    highest_degree,
    project_function,
    quadrature,
    rotate_coefficients,
    rotation_blocks,
    spherical_harmonics,
)
from btfpipe.errors import InputError


def unit(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def turn(seed):
    """A random rotation, right-handed."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def real_from_complex(directions, degree):
    """The basis by scipy: its functions carry the sign (-1)^m, which is taken off."""
    from scipy.special import sph_harm_y

    theta, phi = to_angles(directions)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), theta, phi) * (-1) ** m
            part = value.imag if m < 0 else value.real
            columns.append(part * (np.sqrt(2) if m else 1))
    return np.stack(columns, axis=1)


def test_the_basis_is_that_of_scipys_complex_functions(rng):
    directions = np.concatenate([unit(rng, 60), [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]]])
    ours = spherical_harmonics(directions, 21**2)
    np.testing.assert_allclose(ours, real_from_complex(directions, 20), atol=1e-11)


def test_high_degrees_stay_stable(rng):
    """Unsöld: the squares of a degree's functions sum to (2 l + 1) / 4 pi everywhere."""
    directions = np.concatenate([unit(rng, 20), from_angles([1e-3, 1e-9, np.pi - 1e-4], 0.7)])
    basis = spherical_harmonics(directions, 201**2)
    for n in (0, 1, 50, 200):
        squares = (basis[:, n * n : (n + 1) ** 2] ** 2).sum(axis=1)
        np.testing.assert_allclose(squares, (2 * n + 1) / (4 * np.pi), rtol=1e-10)


def test_the_basis_is_orthonormal_over_the_sphere():
    directions, weights = quadrature(24)
    basis = spherical_harmonics(directions, 169)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(169), atol=1e-12)


def test_degree_one_is_y_z_x(rng):
    directions = unit(rng, 5)
    np.testing.assert_allclose(
        spherical_harmonics(directions, 4)[:, 1:],
        np.sqrt(3 / (4 * np.pi)) * directions[:, [1, 2, 0]],
        atol=1e-14,
    )


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_turned_coefficients_are_the_function_at_turned_directions(seed):
    rng = np.random.default_rng(seed)
    rotation, directions = turn(seed), unit(rng, 9)
    coefficients = rng.standard_normal((169, 2))
    turned = rotate_coefficients(coefficients, rotation)
    np.testing.assert_allclose(
        spherical_harmonics(directions @ rotation.T, 169) @ turned,
        spherical_harmonics(directions, 169) @ coefficients,
        atol=1e-11,
    )


def test_rotation_blocks_follow_one_another_and_are_orthogonal():
    first, second = turn(1), turn(2)
    for a, b, both in zip(
        rotation_blocks(first, 441),
        rotation_blocks(second, 441),
        rotation_blocks(first @ second, 441),
        strict=True,
    ):
        np.testing.assert_allclose(a @ b, both, atol=1e-11)
        np.testing.assert_allclose(a @ a.T, np.eye(len(a)), atol=1e-11)


def test_products_over_the_hemisphere_are_those_of_a_fine_grid():
    products = hemisphere_products(25, 169)
    rows, cols = 1500, 40
    theta = np.pi / 2 * (np.arange(rows) + 0.5) / rows
    phi = 2 * np.pi * np.arange(cols) / cols
    directions = from_angles(theta[:, None], phi[None]).reshape(-1, 3)
    weights = np.repeat(np.sin(theta), cols)[:, None] * (np.pi / 2 / rows) * (2 * np.pi / cols)
    grid = spherical_harmonics(directions, 25).T @ (weights * spherical_harmonics(directions, 169))
    np.testing.assert_allclose(products, grid, atol=1e-5)


def test_products_of_one_parity_are_half_the_spheres():
    products = hemisphere_products(36, 36)
    degree = np.floor(np.sqrt(np.arange(36)))
    even = (degree[:, None] + degree) % 2 == 0
    np.testing.assert_allclose(products[even], 0.5 * np.eye(36)[even], atol=1e-13)
    assert np.abs(products[~even]).max() > 0.3


def test_projection_gives_back_the_coefficients_of_functions(rng):
    coefficients = rng.standard_normal((49, 3))
    np.testing.assert_allclose(
        project_function(lambda d: spherical_harmonics(d, 49) @ coefficients, 49),
        coefficients,
        atol=1e-12,
    )


def test_numbers_that_are_no_squares_are_refused():
    assert highest_degree(169) == 12
    for terms in (0, -4, 24, 26):
        with pytest.raises(InputError, match=f"{terms} spherical harmonics.*square number"):
            highest_degree(terms)
