"""Shading from a `HarmonicsModel`: the harmonics of a light and a view, contracted with a texel's codes."""

import numpy as np
from numba import njit

from btfpipe.compiled import leaf
from btfpipe.directions.pairs import lifted
from btfpipe.directions.spherical_harmonics import (
    fill_harmonics,
    highest_degree,
    recursion_table,
)
from btfpipe.sample.shading import corners

FAST = {"contract", "reassoc", "nsz"}


class HarmonicsShader:
    """Evaluates a `HarmonicsModel` at any texel, light and view, without any measured directions between.

    Parameters
    ----------
    model : HarmonicsModel
    """

    def __init__(self, model):
        self.rows, self.cols = model.shape
        self.toroidal = model.toroidal
        self.view_table = recursion_table(highest_degree(model.view_terms))
        self.light_table = recursion_table(highest_degree(model.light_terms))
        all_terms = model.view_terms * model.light_terms
        self.codes = np.asarray(model.coefficient_codes).reshape(-1, 3, all_terms)
        self.minimum = np.array(model.minimum, np.float32).reshape(3, all_terms)
        self.step = model.step().reshape(3, all_terms)

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        _shade(
            self.codes, self.minimum, self.step, self.view_table, self.light_table,
            self.rows, self.cols, self.toroidal, row, col, w_i, lifted(w_o), out,
        )  # fmt: skip


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
    codes, minimum, step, view_table, light_table, rows, cols, toroidal, row, col, w_i, w_o, out
):
    view = np.empty(view_table.shape[0] ** 2, np.float32)
    light = np.empty(light_table.shape[0] ** 2, np.float32)
    products = np.empty(minimum.shape[1], np.float32)
    weights = np.empty(minimum.shape, np.float32)
    base = np.empty(3, np.float32)
    texel = np.zeros(4, np.int64)
    share = np.zeros(4, np.float32)
    for q in range(len(row)):
        if not w_i[q, 2] > 0.0:
            out[q, :] = 0.0
            continue
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
        fill_harmonics(float(w_o[q, 0]), float(w_o[q, 1]), float(w_o[q, 2]), view_table, view)
        fill_harmonics(float(w_i[q, 0]), float(w_i[q, 1]), float(w_i[q, 2]), light_table, light)
        multiply(view, light, products)
        for c in range(3):
            weigh(products, minimum, step, c, weights, base)
        contract(codes, texel, share, weights, base, q, out)
