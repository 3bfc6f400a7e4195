"""Environments in the frequency domain (Leung et al. 2007, section 4.2): radiance = c^T A R e / pi.

The light coefficients c of a `HarmonicsModel` at a texel and view hold only over the upper hemisphere; A, the integrals of
products of two harmonics over it, takes the environment's coefficients e there, once R has turned them into the
local frame. The hemisphere couples degrees, so that e may have more terms than c: with as many (the paper's form) what a
sharper light adds is lost. There is no shadow but the one given.

Beyond the last measured ring of lights A holds not what the harmonics say there but what `HarmonicsShader` makes of them: their value at
the ring, fading with the light's cosine. That is linear in c and keeps the azimuth, so that A has elements in the same places.

R is three turns, about n, t and n. A turn about n mixes two coefficients at a time; one about t is one about n between
two quarter turns, whose fixed, sparse matrices are made once by the recursion. Points go through this in groups, side by side.
"""

import functools
import math

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.compression.harmonics import HarmonicsModel
from btfpipe.compression.harmonics_shading import (
    FAST,
    HarmonicsShader,
    clamp_to_cap,
    contract,
    multiply,
    weigh,
)
from btfpipe.directions.spherical_harmonics import (
    fill_harmonics,
    highest_degree,
    rotation_blocks,
    spherical_harmonics,
)
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, single_threaded_blas
from btfpipe.sample.shading import corners

_PIXELS = 1 << 14  # of a map, projected at a time
_NODES = 64  # of a quadrature beyond those of a polynomial: odd orders hold a root
_GROUP = 16  # points worked on side by side: a register's width
# turns n into t, so that a turn about t is one about n between two turns by this
_ASIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def project_environment(environment, terms):
    """Coefficients (terms, 3) of an `Environment`'s radiance, in the scene's axes.

    Raises
    ------
    InputError
        If the map has too few rows of pixels for so many terms.
    """
    rows = environment.values.shape[0]
    if rows < 2 * highest_degree(terms) + 1:
        most = ((rows - 1) // 2 + 1) ** 2
        raise InputError(
            f"{environment.name or 'the environment'}: {rows} rows of pixels tell fewer than {terms} harmonics apart; ask for"
            f" {most} terms at most, or give a larger map."
        )
    directions, solid_angles, radiances = environment.pixels()
    out = np.zeros((terms, 3))
    with single_threaded_blas():
        for part in blocks(len(directions), _PIXELS):
            basis = spherical_harmonics(directions[part], terms)
            out += basis.T @ (solid_angles[part, None] * radiances[part])
    return out


class HarmonicEnvironment:
    """Lights a `HarmonicsModel` by a distant environment, a point at a time.

    Parameters
    ----------
    model : HarmonicsModel
    coefficients : (n, 3)
        Of the environment's radiance in world axes, as `project_environment` gives them; at least `terms` of them.
    terms : int, optional
        The environment's terms to use, a square number; 169 by default, or as many as there are if fewer.
    occlusion_rays : int
        Rays a point by which a renderer finds `visibility`, if it has some; not used here.

    Raises
    ------
    InputError
        A Model of another method, coefficients that are not finite, or not as many as a square number and as `terms`.
    """

    def __init__(self, model, coefficients, terms=None, occlusion_rays=0):
        if not isinstance(model, HarmonicsModel):
            raise InputError(
                f"light in the frequency domain needs a Model of method harmonics; this is"
                f" {getattr(model, 'method', None) or 'a Sample'}."
            )
        coefficients = np.asarray(coefficients, np.float64)
        if coefficients.ndim != 2 or coefficients.shape[1] != 3:
            raise InputError(
                f"environment coefficients have shape {coefficients.shape}; expected (n, 3)."
            )
        if not np.isfinite(coefficients).all():
            raise InputError("the environment's coefficients hold NaN or infinite values.")
        highest_degree(len(coefficients))
        terms = min(169, len(coefficients)) if terms is None else terms
        highest_degree(terms)
        if terms > len(coefficients):
            raise InputError(
                f"{terms} terms of an environment asked for; it has {len(coefficients)}. Project it to more."
            )
        self.occlusion_rays = occlusion_rays
        self.shader = HarmonicsShader(model)
        self.environment = np.ascontiguousarray(coefficients[:terms], np.float32)
        self.coupling = _coupling(model.light_terms, terms, self.shader.least_light)
        self.quarters = (*_quarter(terms, False), *_quarter(terms, True))

    def shade(self, row, col, frames, w_o, out, visibility=None):
        """Radiance towards the eye; a little below 0 at places if the environment's own harmonics are.

        Parameters
        ----------
        row, col : (n,) float32
            Texel coordinates, as for `Appearance.shader`.
        frames : (n, 3, 3) float32
            Rows are the sample's axes s, t, n at each point, in world axes; orthonormal, left-handed where a surface is
            seen from behind.
        w_o : (n, 3) float32
            Unit vectors to the eye in those frames.
        out : (n, 3) float32
            Filled with radiance.
        visibility : (n,) float32, optional
            A factor a point: the share of the environment that no object hides, by any measure.
        """
        shader = self.shader
        if visibility is None:
            visibility = np.ones(len(row), np.float32)
        _shade(
            shader.codes, shader.minimum, shader.step, shader.view_table, shader.least_view,
            self.environment, self.quarters, self.coupling, shader.rows, shader.cols, shader.toroidal, row, col, frames, w_o, visibility, out,
        )  # fmt: skip


@functools.lru_cache(maxsize=8)
def _coupling(light_terms, terms, least):
    """A / pi as (light terms, degrees of the environment) float32: its only elements, those of one order.

    Rows are the light's harmonics up to the cosine `least`; below, those at that cosine times cos(theta_i) / least.
    """
    height, weight = _heights(highest_degree(light_terms) + highest_degree(terms), least)
    # a harmonic of order m is what it is at azimuth 0, or that of -m is, times cos(m phi) or sin(|m| phi)
    light = _meridian(np.maximum(height, least), light_terms)
    light *= np.minimum(height / max(least, 1e-30), 1)[:, None]
    products = (weight[:, None] * light).T @ _meridian(height, terms)
    out = np.zeros((light_terms, highest_degree(terms) + 1), np.float32)
    for l in range(highest_degree(light_terms) + 1):  # noqa: E741
        for m in range(-l, l + 1):
            for other in range(abs(m), out.shape[1]):
                around = 1 if m else 2  # the integral of the squared cosine or sine, over pi
                product = products[l * (l + 1) + abs(m), other * (other + 1) + abs(m)]
                out[l * (l + 1) + m, other] = around * product
    return out


def _heights(degree, least):
    """Nodes and weights over the cosine from 0 to 1, on either side of a kink at `least`; on the cap exact up to a degree."""
    node, weight = np.polynomial.legendre.leggauss(degree + _NODES)
    parts = [
        (a + (b - a) * (node + 1) / 2, (b - a) * weight / 2) for a, b in ((0, least), (least, 1))
    ]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def _meridian(height, terms):
    """Harmonics (n, terms) at azimuth 0 and the given cosines (n,)."""
    sine = np.sqrt(np.maximum(1 - height**2, 0))
    return spherical_harmonics(np.stack([sine, 0 * height, height], axis=1), terms)


@functools.lru_cache(maxsize=8)
def _quarter(terms, back):
    """The matrix (terms, terms) of `_ASIDE`, or of its inverse: starts of rows, columns, elements other than 0."""
    first, columns, elements = [0], [], []
    for n, block in enumerate(rotation_blocks(_ASIDE.T if back else _ASIDE, terms)):
        for row in block:
            kept = np.flatnonzero(np.abs(row) > 1e-9)
            columns.append(n * n + kept)
            elements.append(row[kept])
            first.append(first[-1] + len(kept))
    return (
        np.array(first, np.int32),
        np.concatenate(columns).astype(np.int32),
        np.concatenate(elements).astype(np.float32),
    )


@leaf
def _angles(frames, q, p, turns):
    """Fill cosines and sines ``turns[:, :, p]`` of the turns about n, t, n that make up the rotation into a frame.

    Returns 1, or -1 for a left-handed frame, whose t axis is taken the other way round.
    """
    hand = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        cross = frames[q, 0, i] * frames[q, 1, j] - frames[q, 0, j] * frames[q, 1, i]
        hand += cross * frames[q, 2, k]
    hand = 1.0 if hand >= 0.0 else -1.0
    sine = math.sqrt(frames[q, 2, 0] ** 2 + frames[q, 2, 1] ** 2)
    a = 1.0
    b = 0.0
    if sine > 0.0:
        a = -frames[q, 2, 0] / sine
        b = frames[q, 2, 1] / sine
    turns[2, 0, p] = a
    turns[2, 1, p] = b
    turns[1, 0, p] = frames[q, 2, 2]
    turns[1, 1, p] = sine
    # from the two others, so that a frame hardly tilted keeps the sum of both turns about n
    turns[0, 0, p] = hand * (frames[q, 1, 0] * b + frames[q, 1, 1] * a)
    turns[0, 1, p] = -frames[q, 0, 0] * b - frames[q, 0, 1] * a
    return hand


@leaf(fastmath=FAST)
def _turn(turns, k, degrees, most, power, coefficients):
    """Turn coefficients (terms, 3, points) about n in place, up to the order `most`; ``power`` (2, points) is scratch."""
    for p in range(_GROUP):
        power[0, p] = 1.0
        power[1, p] = 0.0
    for m in range(1, min(degrees - 1, most) + 1):
        for p in range(_GROUP):
            a = power[0, p] * turns[k, 0, p] - power[1, p] * turns[k, 1, p]
            power[1, p] = power[0, p] * turns[k, 1, p] + power[1, p] * turns[k, 0, p]
            power[0, p] = a
        for l in range(m, degrees):  # noqa: E741
            i = l * (l + 1) + m
            j = i - 2 * m
            for c in range(3):
                for p in range(_GROUP):
                    even = coefficients[i, c, p]
                    odd = coefficients[j, c, p]
                    coefficients[i, c, p] = power[0, p] * even - power[1, p] * odd
                    coefficients[j, c, p] = power[1, p] * even + power[0, p] * odd


@leaf(fastmath=FAST)
def _put_aside(first, columns, elements, degrees, most, coefficients, out):
    """Fill ``out`` (terms, 3, points), up to the order `most`, with a quarter turn of the coefficients."""
    for l in range(degrees):  # noqa: E741
        span = min(l, most)
        for i in range(l * (l + 1) - span, l * (l + 1) + span + 1):
            for c in range(3):
                for p in range(_GROUP):
                    out[i, c, p] = np.float32(0)
            for at in range(first[i], first[i + 1]):
                element = elements[at]
                j = columns[at]
                for c in range(3):
                    for p in range(_GROUP):
                        out[i, c, p] += element * coefficients[j, c, p]


@leaf(fastmath=FAST)
def _couple(coupling, coefficients, light):
    """Fill ``light`` (light terms, 3, points) with the environment over the hemisphere."""
    degrees = coupling.shape[1]
    i = 0
    l = 0  # noqa: E741
    while i < coupling.shape[0]:
        for m in range(-l, l + 1):
            for c in range(3):
                for p in range(_GROUP):
                    light[i, c, p] = np.float32(0)
            for other in range(abs(m), degrees):
                element = coupling[i, other]
                j = other * (other + 1) + m
                for c in range(3):
                    for p in range(_GROUP):
                        light[i, c, p] += element * coefficients[j, c, p]
            i += 1
        l += 1  # noqa: E741


@leaf(fastmath=FAST)
def _mirror(hand, most, light):
    """Turn the t axis of left-handed frames back: harmonics of an order below 0 change their sign with it."""
    for l in range(1, most + 1):  # noqa: E741
        for i in range(l * l, l * (l + 1)):
            for c in range(3):
                for p in range(_GROUP):
                    light[i, c, p] *= hand[p]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _shade(
    codes, minimum, step, view_table, least_view, environment, quarters, coupling,
    rows, cols, toroidal, row, col, frames, w_o, visibility, out,
):  # fmt: skip
    first, columns, elements, first_back, columns_back, elements_back = quarters
    terms = len(environment)
    degrees = coupling.shape[1]
    most = int(math.sqrt(len(coupling)) + 0.5) - 1
    turns = np.empty((3, 2, _GROUP), np.float32)
    hand = np.empty(_GROUP, np.float32)
    power = np.empty((2, _GROUP), np.float32)
    turned = np.empty((terms, 3, _GROUP), np.float32)
    other = np.empty((terms, 3, _GROUP), np.float32)
    lights = np.empty((len(coupling), 3, _GROUP), np.float32)
    view = np.empty(view_table.shape[0] ** 2, np.float32)
    light = np.empty(len(coupling), np.float32)
    products = np.empty(minimum.shape[1], np.float32)
    weights = np.empty(minimum.shape, np.float32)
    base = np.empty(3, np.float32)
    texel = np.zeros(4, np.int64)
    share = np.zeros(4, np.float32)
    seen_from = np.empty(3)
    for start in range(0, len(row), _GROUP):
        for p in range(_GROUP):
            hand[p] = _angles(frames, min(start + p, len(row) - 1), p, turns)
        for i in range(terms):
            for c in range(3):
                turned[i, c, :] = environment[i, c]
        _turn(turns, 2, degrees, degrees, power, turned)
        _put_aside(first_back, columns_back, elements_back, degrees, degrees, turned, other)
        _turn(turns, 1, degrees, degrees, power, other)
        _put_aside(first, columns, elements, degrees, most, other, turned)
        _turn(turns, 0, degrees, most, power, turned)
        _couple(coupling, turned, lights)
        _mirror(hand, most, lights)
        for q in range(start, min(start + _GROUP, len(row))):
            corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
            clamp_to_cap(w_o[q], least_view, seen_from)
            fill_harmonics(seen_from[0], seen_from[1], seen_from[2], view_table, view)
            for c in range(3):
                for i in range(len(light)):
                    light[i] = lights[i, c, q - start]
                multiply(view, light, products)
                weigh(products, minimum, step, c, weights, base)
            contract(codes, texel, share, weights, base, q, out)
            for c in range(3):
                out[q, c] *= visibility[q]
