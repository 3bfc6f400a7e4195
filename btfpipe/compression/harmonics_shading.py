"""Shading from a `HarmonicsModel`: the harmonics of a light and a view, contracted with a texel's codes.

Harmonics say nothing of use beyond the directions that they were fitted to: they ring. Beyond the largest measured polar
angle they are therefore evaluated at that angle, for lights as for views; and the value fades with the light's cosine, so
that value / cos(theta_i) stays what it is at the last measured ring.
"""

import math

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.directions.spherical_harmonics import (
    fill_harmonics,
    highest_degree,
    recursion_table,
)
from btfpipe.sample.shading import corners

FAST = {"contract", "reassoc", "nsz"}
MANY_LIGHTS = 2
_FINER = 257  # codes of 16 bits to one of 8


class HarmonicsShader:
    """Evaluates a `HarmonicsModel` at any texel, light and view, without any measured directions between.

    Parameters
    ----------
    model : HarmonicsModel
    """

    many_lights = MANY_LIGHTS

    def __init__(self, model):
        self.rows, self.cols = model.shape
        self.toroidal = model.toroidal
        self.view_table = recursion_table(highest_degree(model.view_terms))
        self.light_table = recursion_table(highest_degree(model.light_terms))
        all_terms = model.view_terms * model.light_terms
        self.codes = np.asarray(model.coefficient_codes).reshape(-1, 3, all_terms)
        self.minimum = np.array(model.minimum, np.float32).reshape(3, all_terms)
        self.step = model.step().reshape(3, all_terms)
        self.slice_bytes = slice_bytes(model.light_terms)
        self.slice_shape = 3, model.light_terms
        self.least_view, self.least_light = (
            least_cosine(d) for d in (model.view_directions, model.light_directions)
        )

    def halved(self, halving):
        """The shader of the next level of a `Pyramid`: codes of 16 bits, as means of codes lie between them."""
        codes, scale = halving(self.codes), 1
        if self.codes.dtype == np.uint8:
            scale = _FINER
            codes *= np.float32(scale)
        codes = np.rint(codes, out=codes).astype(np.uint16)
        return halving.coarser(self, codes=codes, step=self.step / np.float32(scale))

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        _shade(
            self.codes, self.minimum, self.step, self.view_table, self.light_table, self.least_view, self.least_light,
            self.rows, self.cols, self.toroidal, row, col, w_i, w_o, out,
        )  # fmt: skip

    def slices(self, row, col, w_o):
        """See `Appearance.shader`."""
        return HarmonicSlices(self, row, col, w_o)

    def averaged_slices(self, values, w_o, spread):
        """Slices whose `values` are averages; they are linear, whatever the views and however far texels spread."""
        no = np.empty((0, 3), np.float32)
        slices = HarmonicSlices(self, no[:, 0], no[:, 1], no)
        slices.values = values
        return slices


def slice_bytes(light_terms):
    """Bytes of a look-up in `HarmonicSlices`."""
    return 12 * light_terms


class HarmonicSlices:
    """What look-ups show from their views, as harmonics of the light.

    Parameters
    ----------
    shader : HarmonicsShader
    row, col, w_o
        As for `Appearance.shader`.
    """

    def __init__(self, shader, row, col, w_o):
        self.table, self.least = shader.light_table, shader.least_light
        self.values = np.empty((len(row), 3, self.table.shape[0] ** 2), np.float32)
        _slice(
            shader.codes, shader.minimum, shader.step, shader.view_table, shader.least_view,
            shader.rows, shader.cols, shader.toroidal, row, col, w_o, self.values,
        )  # fmt: skip

    def shade(self, chosen, w_i, out):
        """Fill `out`; see `Appearance.shader`."""
        _sum(self.values, self.table, self.least, chosen, w_i, out)


def least_cosine(directions):
    """Cosine of the largest polar angle of measured directions (n, 3)."""
    return max(float(np.min(np.asarray(directions, np.float64)[:, 2])), 0.0)


@leaf
def clamp_to_cap(direction, least, out):
    """Fill ``out`` (3,) with a direction, or with the one above it whose cosine is `least`.

    Returns the direction's cosine over that of ``out``: 1 within the cap.
    """
    z = float(direction[2])
    if z >= least:
        out[0] = direction[0]
        out[1] = direction[1]
        out[2] = z
        return 1.0
    across = direction[0] * float(direction[0]) + direction[1] * float(direction[1])
    scale = math.sqrt((1.0 - least * least) / max(across, 1e-30))
    out[0] = scale * direction[0]
    out[1] = scale * direction[1]
    out[2] = least
    return z / least if least > 0.0 else 0.0


@leaf(fastmath=FAST)
def multiply(view, light, products):
    """Fill ``products`` (view terms * light terms,) of the harmonics of a view and those of a light."""
    lights = len(light)
    for i in range(len(view)):
        at = i * lights
        for j in range(lights):
            products[at + j] = view[i] * light[j]


@leaf(fastmath=FAST)
def weigh(products, minimum, step, c, weights, base):
    """Fill the weight of each code in the value of channel `c`, and what all codes at 0 give."""
    total = np.float32(0)
    for n in range(len(products)):
        weights[c, n] = products[n] * step[c, n]
        total += products[n] * minimum[c, n]
    base[c] = total


@leaf(fastmath=FAST)
def contract(codes, texel, share, weights, base, q, out):
    """Fill ``out[q]`` (3,): weighted codes of four texels and their shares."""
    for c in range(3):
        value = base[c]
        for k in range(4):
            if share[k] == 0.0:
                continue
            i = texel[k]
            total = np.float32(0)
            for n in range(weights.shape[1]):
                total += weights[c, n] * np.float32(codes[i, c, n])
            value += share[k] * total
        out[q, c] = value


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _shade(
    codes, minimum, step, view_table, light_table, least_view, least_light, rows, cols, toroidal, row, col, w_i, w_o,
    out,
):  # fmt: skip
    view = np.empty(view_table.shape[0] ** 2, np.float32)
    light = np.empty(light_table.shape[0] ** 2, np.float32)
    products = np.empty(minimum.shape[1], np.float32)
    weights = np.empty(minimum.shape, np.float32)
    base = np.empty(3, np.float32)
    texel = np.zeros(4, np.int64)
    share = np.zeros(4, np.float32)
    at = np.empty(3)
    for q in range(len(row)):
        if not w_i[q, 2] > 0.0:
            out[q, :] = 0.0
            continue
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
        clamp_to_cap(w_o[q], least_view, at)
        fill_harmonics(at[0], at[1], at[2], view_table, view)
        fade = np.float32(clamp_to_cap(w_i[q], least_light, at))
        fill_harmonics(at[0], at[1], at[2], light_table, light)
        multiply(view, light, products)
        for c in range(3):
            weigh(products, minimum, step, c, weights, base)
        contract(codes, texel, share, weights, base, q, out)
        for c in range(3):
            out[q, c] *= fade


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _slice(codes, minimum, step, view_table, least, rows, cols, toroidal, row, col, w_o, out):
    view = np.empty(view_table.shape[0] ** 2, np.float32)
    texel = np.zeros(4, np.int64)
    share = np.zeros(4, np.float32)
    at = np.empty(3)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
        clamp_to_cap(w_o[q], least, at)
        fill_harmonics(at[0], at[1], at[2], view_table, view)
        for c in range(3):
            _contract_view(codes, minimum, step, c, view, texel, share, out[q, c])


@leaf(fastmath=FAST)
def _contract_view(codes, minimum, step, c, view, texel, share, out):
    """Fill the coefficients (light terms,) of channel `c` over the lights, from one view, between four texels."""
    first = codes[texel[0], c]
    second = codes[texel[1], c]
    third = codes[texel[2], c]
    fourth = codes[texel[3], c]
    least = minimum[c]
    scale = step[c]
    lights = len(out)
    for j in range(lights):
        out[j] = np.float32(0)
    for i in range(len(view)):
        at = i * lights
        for j in range(lights):
            n = at + j
            code = (
                share[0] * np.float32(first[n])
                + share[1] * np.float32(second[n])
                + share[2] * np.float32(third[n])
                + share[3] * np.float32(fourth[n])
            )
            out[j] += view[i] * (least[n] + scale[n] * code)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _sum(coefficients, light_table, least, chosen, w_i, out):
    light = np.empty(light_table.shape[0] ** 2, np.float32)
    at = np.empty(3)
    for q in range(len(chosen)):
        if not w_i[q, 2] > 0.0:
            out[q, :] = 0.0
            continue
        fade = np.float32(clamp_to_cap(w_i[q], least, at))
        fill_harmonics(at[0], at[1], at[2], light_table, light)
        for c in range(3):
            some = coefficients[chosen[q], c]
            total = np.float32(0)
            for j in range(len(light)):
                total += light[j] * some[j]
            out[q, c] = fade * total
