"""Environments in the frequency domain (Leung et al. 2007, section 4.2): radiance = c^T A R e / pi.

The light coefficients c of a `HarmonicsModel` at a texel and view hold only over the upper hemisphere; A, the integrals of
products of two harmonics over it, takes the environment's coefficients e there, once R has turned them into the
local frame. The hemisphere couples degrees, so that e may have more terms than c: with as many (the paper's form) what a
sharper light adds is lost. There is no shadow but the one given.
"""

import functools
import math

import numpy as np
from numba import njit

from btfpipe.compiled import leaf
from btfpipe.compression.harmonics_shading import FAST, HarmonicsShader, contract, multiply, weigh
from btfpipe.directions.spherical_harmonics import (
    fill_harmonics,
    hemisphere_products,
    highest_degree,
    rotation_blocks,
)
from btfpipe.errors import InputError
from btfpipe.sample.shading import corners

# turns n into t, so that a turn about t is one about n between two turns by this
_ASIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class HarmonicEnvironment:
    """Lights a `HarmonicsModel` by a distant environment, a point at a time.

    Parameters
    ----------
    model : HarmonicsModel
    coefficients : (n, 3)
        Of the environment's radiance in world axes, as `project_picture` gives them for a picture whose pole is
        the world's z axis; at least `terms` of them.
    terms : int, optional
        The environment's terms to use, a square number; 169 by default, or as many as there are if fewer.

    Raises
    ------
    InputError
        Coefficients that are not finite, or not as many as a square number and as `terms`.
    """

    def __init__(self, model, coefficients, terms=None):
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
        self.shader = HarmonicsShader(model)
        self.light = np.ascontiguousarray(coefficients[:terms].T, np.float32)
        self.products = _coupling(model.light_terms, terms)
        self.aside = _aside(terms)

    def shade(self, row, col, frames, w_o, out, visibility=None):
        """Radiance towards the eye.

        Parameters
        ----------
        row, col : (n,) float32
            Texel coordinates, as for `Appearance.shader`.
        frames : (n, 3, 3) float32
            Rows are the sample's axes s, t, n at each point, in world axes; orthonormal, right-handed.
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
            shader.codes, shader.minimum, shader.step, shader.view_table, self.light, self.aside, self.products,
            shader.rows, shader.cols, shader.toroidal, row, col, frames, w_o, visibility, out,
        )  # fmt: skip


@functools.lru_cache(maxsize=8)
def _coupling(light_terms, terms):
    """A / pi as (light terms, degrees of the environment) float32: its only elements, those of one order."""
    products = hemisphere_products(light_terms, terms) / math.pi
    out = np.zeros((light_terms, highest_degree(terms) + 1), np.float32)
    for l in range(highest_degree(light_terms) + 1):  # noqa: E741
        for m in range(-l, l + 1):
            for other in range(abs(m), out.shape[1]):
                out[l * (l + 1) + m, other] = products[l * (l + 1) + m, other * (other + 1) + m]
    return out


@functools.lru_cache(maxsize=8)
def _aside(terms):
    """Blocks of `_ASIDE` and of its inverse (2, elements), one after the other, float32."""
    return np.stack(
        [
            np.concatenate([block.ravel() for block in rotation_blocks(rotation, terms)])
            for rotation in (_ASIDE, _ASIDE.T)
        ]
    ).astype(np.float32)


@leaf
def _angles(frames, q, turns):
    """Fill cosines and sines (3, 2) of the turns about n, t, n that make up the rotation from world into frame."""
    sine = math.sqrt(frames[q, 2, 0] ** 2 + frames[q, 2, 1] ** 2)
    turns[2, 0] = 1.0
    turns[2, 1] = 0.0
    if sine > 0.0:
        turns[2, 0] = -frames[q, 2, 0] / sine
        turns[2, 1] = frames[q, 2, 1] / sine
    turns[1, 0] = frames[q, 2, 2]
    turns[1, 1] = sine
    # from the two others, so that a frame hardly tilted keeps the sum of both turns about n
    turns[0, 0] = frames[q, 1, 0] * turns[2, 1] + frames[q, 1, 1] * turns[2, 0]
    turns[0, 1] = -frames[q, 0, 0] * turns[2, 1] - frames[q, 0, 1] * turns[2, 0]


@leaf
def _turn(cosine, sine, coefficients, most):
    """Turn coefficients (3, terms) about n in place; orders above `most` are left."""
    degrees = int(math.sqrt(coefficients.shape[1]) + 0.5)
    a = 1.0
    b = 0.0
    for m in range(1, min(degrees - 1, most) + 1):
        turned = a * cosine - b * sine
        b = a * sine + b * cosine
        a = turned
        x = np.float32(a)
        y = np.float32(b)
        for l in range(m, degrees):  # noqa: E741
            at = l * (l + 1)
            for c in range(3):
                even = coefficients[c, at + m]
                odd = coefficients[c, at - m]
                coefficients[c, at + m] = x * even - y * odd
                coefficients[c, at - m] = y * even + x * odd


@leaf(fastmath=FAST)
def _put_aside(aside, way, coefficients, most, out):
    """Turn coefficients (3, terms) by the blocks of one way; orders above `most` are not filled."""
    degrees = int(math.sqrt(coefficients.shape[1]) + 0.5)
    start = 0
    for l in range(degrees):  # noqa: E741
        size = 2 * l + 1
        at = l * l
        span = min(l, most)
        for i in range(l - span, l + span + 1):
            for c in range(3):
                total = np.float32(0)
                for j in range(size):
                    total += aside[way, start + i * size + j] * coefficients[c, at + j]
                out[c, at + i] = total
        start += size * size


@leaf(fastmath=FAST)
def _couple(products, coefficients, light):
    """Fill ``light`` (3, light terms) with the environment (3, terms) over the hemisphere."""
    degrees = products.shape[1]
    count = int(math.sqrt(light.shape[1]) + 0.5)
    for l in range(count):  # noqa: E741
        for m in range(-l, l + 1):
            i = l * (l + 1) + m
            for c in range(3):
                total = np.float32(0)
                for other in range(abs(m), degrees):
                    total += products[i, other] * coefficients[c, other * (other + 1) + m]
                light[c, i] = total


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _shade(
    codes, minimum, step, view_table, environment, aside, coupling,
    rows, cols, toroidal, row, col, frames, w_o, visibility, out,
):  # fmt: skip
    light_terms = coupling.shape[0]
    most = int(math.sqrt(light_terms) + 0.5) - 1
    every = coupling.shape[1]
    view = np.empty(view_table.shape[0] ** 2, np.float32)
    light = np.empty((3, light_terms), np.float32)
    products = np.empty(minimum.shape[1], np.float32)
    weights = np.empty(minimum.shape, np.float32)
    base = np.empty(3, np.float32)
    texel = np.zeros(4, np.int64)
    share = np.zeros(4, np.float32)
    turns = np.empty((3, 2))
    turned = np.empty_like(environment)
    other = np.empty_like(environment)
    for q in range(len(row)):
        same = q > 0
        for i in range(3):
            for j in range(3):
                same = same and frames[q, i, j] == frames[q - 1, i, j]
        if not same:  # flat parts share one frame
            _angles(frames, q, turns)
            turned[:] = environment
            _turn(turns[2, 0], turns[2, 1], turned, every)
            _put_aside(aside, 1, turned, every, other)
            _turn(turns[1, 0], turns[1, 1], other, every)
            _put_aside(aside, 0, other, most, turned)
            _turn(turns[0, 0], turns[0, 1], turned, most)
            _couple(coupling, turned, light)
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
        fill_harmonics(float(w_o[q, 0]), float(w_o[q, 1]), float(w_o[q, 2]), view_table, view)
        for c in range(3):
            multiply(view, light[c], products)
            weigh(products, minimum, step, c, weights, base)
        contract(codes, texel, share, weights, base, q, out)
        for c in range(3):
            out[q, c] *= visibility[q]
