"""Real spherical harmonics: the basis, its rotations, its products over the upper hemisphere, projection.

Coefficients lie in the order l(l + 1) + m, with -l <= m <= l, so that `terms` is a square number,
(l_max + 1)^2. The basis is orthonormal over the sphere; m > 0 goes with cos(m phi), m < 0 with sin(|m| phi), and
there is no Condon-Shortley sign: the three functions of l = 1 are positive multiples of y, z and x.
"""

import functools
import math

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.directions.sets import from_angles
from btfpipe.errors import InputError


def highest_degree(terms):
    """The degree l_max of (l_max + 1)^2 terms.

    Raises
    ------
    InputError
        If the number is not a square.
    """
    root = math.isqrt(max(int(terms), 0))
    if root < 1 or root * root != terms:
        raise InputError(
            f"{terms} spherical harmonics asked for; expected a square number, such as"
            f" {max(root, 1) ** 2} or {(root + 1) ** 2}: all orders of a degree go together."
        )
    return root - 1


@functools.lru_cache(maxsize=16)
def recursion_table(degree):
    """Factors of the recursion over the degree, for `fill_harmonics`.

    Returns
    -------
    (degree + 1, degree + 1, 2) float64
        At [m, l], for l > m: a and b of ``P_l = a (z P_{l-1} - b P_{l-2})``; at [m, m, 0] the ratio of the first
        function of order m to that of order m - 1, apart from the sine of the polar angle.
    """
    table = np.zeros((degree + 1, degree + 1, 2))
    for m in range(degree + 1):
        table[m, m, 0] = math.sqrt((2 * m + 1) / (2 * m)) if m > 0 else math.sqrt(0.25 / math.pi)
        for l in range(m + 1, degree + 1):  # noqa: E741 (the field's own letter)
            table[m, l, 0] = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            table[m, l, 1] = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
    if degree > 0:
        table[1, 1, 0] *= math.sqrt(2)  # the real functions of order 0 lack this factor
    table.flags.writeable = False
    return table


@leaf
def fill_harmonics(x, y, z, table, out):
    """Fill ``out`` (terms,) with the basis at a unit vector; the recursion rises in the degree, which is stable."""
    count = table.shape[0]
    sine = math.sqrt(x * x + y * y)
    across = 1.0
    up = 0.0
    if sine > 0.0:
        across = x / sine
        up = y / sine
    first = table[0, 0, 0]
    cosine_m = 1.0
    sine_m = 0.0
    for m in range(count):
        if m > 0:
            first *= table[m, m, 0] * sine
            turned = cosine_m * across - sine_m * up
            sine_m = sine_m * across + cosine_m * up
            cosine_m = turned
        value = first
        before = 0.0
        for l in range(m, count):  # noqa: E741
            if l > m:
                above = table[m, l, 0] * (z * value - table[m, l, 1] * before)
                before = value
                value = above
            out[l * (l + 1) + m] = value * cosine_m
            if m > 0:
                out[l * (l + 1) - m] = value * sine_m


@njit(cache=True, nogil=True)
def _fill_all(directions, table, out):
    for i in range(len(directions)):
        fill_harmonics(directions[i, 0], directions[i, 1], directions[i, 2], table, out[i])


def spherical_harmonics(directions, terms):
    """The real basis at some directions.

    Parameters
    ----------
    directions : (n, 3)
        Unit vectors.
    terms : int
        (l_max + 1)^2.

    Returns
    -------
    (n, terms) float64

    Examples
    --------
    >>> (spherical_harmonics([[0, 0, 1]], 4) * np.sqrt(4 * np.pi)).round(3).tolist()
    [[1.0, 0.0, 1.732, 0.0]]
    """
    table = recursion_table(highest_degree(terms))
    directions = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
    out = np.empty((len(directions), int(terms)))
    _fill_all(directions, table, out)
    return out


def rotation_blocks(rotation, terms):
    """Matrices that the basis turns by: ``basis(R w) = M basis(w)``, M block diagonal, a block a degree.

    A function with coefficients c, carried along by the rotation (its value at R w is that of the old one at w),
    has the coefficients M c.

    Parameters
    ----------
    rotation : (3, 3)
        Orthonormal, right-handed.
    terms : int

    Returns
    -------
    list of (2 l + 1, 2 l + 1) float64
        By the recursion of Ivanic and Ruedenberg 1996, with the correction of 1998.
    """
    degree = highest_degree(terms)
    sizes = [2 * n + 1 for n in range(degree + 1)]
    starts = np.cumsum([0] + [n * n for n in sizes])
    flat = np.zeros(starts[-1])
    _fill_blocks(np.ascontiguousarray(rotation, np.float64), degree, flat)
    return [
        flat[start : start + n * n].reshape(n, n)
        for start, n in zip(starts[:-1], sizes, strict=True)
    ]


def rotate_coefficients(coefficients, rotation):
    """Coefficients (terms, ...) of a function carried along by a rotation (3, 3)."""
    coefficients = np.asarray(coefficients, np.float64)
    out = np.empty_like(coefficients)
    for n, block in enumerate(rotation_blocks(rotation, len(coefficients))):
        part = slice(n * n, (n + 1) ** 2)
        out[part] = np.tensordot(block, coefficients[part], 1)
    return out


@njit(cache=True, nogil=True)
def _fill_blocks(rotation, degree, flat):
    """Fill the blocks one after the other, each from the one before and that of degree 1."""
    flat[0] = 1.0
    if degree == 0:
        return
    axes = (1, 2, 0)  # y, z, x are the orders -1, 0, 1
    one = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            one[i, j] = rotation[axes[i], axes[j]]
    flat[1:10] = one.ravel()
    start = 1
    for n in range(2, degree + 1):
        before = flat[start : start + (2 * n - 1) ** 2].reshape(2 * n - 1, 2 * n - 1)
        start += (2 * n - 1) ** 2
        block = flat[start : start + (2 * n + 1) ** 2].reshape(2 * n + 1, 2 * n + 1)
        for m in range(-n, n + 1):
            for k in range(-n, n + 1):
                block[m + n, k + n] = _element(one, before, n, m, k)


@njit(cache=True, nogil=True)
def _element(one, before, n, m, k):
    """An element by Ivanic and Ruedenberg, table 1; n is the degree."""
    scale = float((n + k) * (n - k)) if abs(k) < n else float(2 * n * (2 * n - 1))
    size = abs(m)
    total = 0.0
    if size < n:
        total += math.sqrt((n + m) * (n - m) / scale) * _part(one, before, n, 0, m, k)
    v = 0.5 * math.sqrt((n + size - 1) * (n + size) / scale)
    if m == 0:
        v *= -math.sqrt(2.0)
        total += v * (_part(one, before, n, 1, 1, k) + _part(one, before, n, -1, -1, k))
    elif m == 1:
        total += v * math.sqrt(2.0) * _part(one, before, n, 1, 0, k)
    elif m == -1:
        total += v * math.sqrt(2.0) * _part(one, before, n, -1, 0, k)
    elif m > 0:
        total += v * (_part(one, before, n, 1, m - 1, k) - _part(one, before, n, -1, 1 - m, k))
    else:
        total += v * (_part(one, before, n, 1, m + 1, k) + _part(one, before, n, -1, -m - 1, k))
    if 0 < size < n - 1:
        w = -0.5 * math.sqrt((n - size - 1) * (n - size) / scale)
        if m > 0:
            total += w * (_part(one, before, n, 1, m + 1, k) + _part(one, before, n, -1, -m - 1, k))
        else:
            total += w * (_part(one, before, n, 1, m - 1, k) - _part(one, before, n, -1, 1 - m, k))
    return total


@njit(cache=True, nogil=True)
def _part(one, before, n, i, m, k):
    """P of table 2: products of the degree 1 with the degree before."""
    row = m + n - 1
    last = 2 * n - 2
    if k == n:
        return one[i + 1, 2] * before[row, last] - one[i + 1, 0] * before[row, 0]
    if k == -n:
        return one[i + 1, 2] * before[row, 0] + one[i + 1, 0] * before[row, last]
    return one[i + 1, 1] * before[row, k + n - 1]


def hemisphere_products(terms, other_terms):
    """Integrals of products of two basis functions over the upper hemisphere.

    The matrix A of Leung et al. 2007, equation 2, not necessarily square. Exact: Gauss-Legendre nodes in cos(theta),
    evenly spaced ones in phi. Only equal orders m have a product; equal degrees have half of the sphere's, other
    degrees of one parity none.

    Returns
    -------
    (terms, other_terms) float64
    """
    total = highest_degree(terms) + highest_degree(other_terms)
    directions, weights = quadrature(total, hemisphere=True)
    first = spherical_harmonics(directions, terms)
    return first.T @ (weights[:, None] * spherical_harmonics(directions, other_terms))


def quadrature(degree, hemisphere=False):
    """Directions (n, 3) and weights (n,) that integrate harmonics up to a degree over the sphere exactly.

    Over the upper hemisphere this holds for products of two harmonics whose degrees sum to it.
    """
    height, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    if hemisphere:
        height, weight = (height + 1) / 2, weight / 2
    count = degree + 1
    phi = 2 * np.pi * np.arange(count) / count
    directions = from_angles(np.arccos(height)[:, None], phi[None]).reshape(-1, 3)
    return directions, np.repeat(weight * (2 * np.pi / count), count)


def project_function(function, terms, degree=None):
    """Coefficients of a function on the sphere.

    Parameters
    ----------
    function : callable
        Takes directions (n, 3), returns (n, ...).
    terms : int
    degree : int, optional
        Degree up to which the function is integrated exactly; 64 beyond the terms' own by default.

    Returns
    -------
    (terms, ...) float64
    """
    own = highest_degree(terms)
    directions, weights = quadrature(own + (own + 64 if degree is None else degree))
    basis = spherical_harmonics(directions, terms)
    return np.tensordot((basis * weights[:, None]).T, np.asarray(function(directions)), 1)
