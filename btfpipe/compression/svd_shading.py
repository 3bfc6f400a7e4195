"""Shading from an SVD Model: blend the angular factors of the pairs around a light and view, then dot."""

import numpy as np
from numba import njit

from btfpipe.directions import Hemisphere
from btfpipe.sample.appearance import light_cosines
from btfpipe.sample.shading import corners, pair_weights


class SvdShader:
    """Evaluates an `SvdModel` between its texels, lights and views.

    The factors are linear in the values, so blending them (9 pairs barycentrically, 16 of the four nearest,
    1 of the nearest; 4 texels) is blending the pictures.

    Parameters
    ----------
    model : SvdModel
        Of a product of views and lights.
    interpolation : str
        ``barycentric``, ``four`` or ``nearest``.

    Raises
    ------
    InputError
        If the Model's pairs are not a product.
    """

    def __init__(self, model, interpolation="barycentric"):
        model.require_product("shading")
        self.rows, self.cols = model.shape
        self.toroidal = model.toroidal
        self.lights = Hemisphere(model.light_directions, interpolation).tables
        self.views = Hemisphere(model.view_directions, interpolation).tables
        self.inverse_cosines = 1 / light_cosines(model.light_directions)
        n = model.n_terms
        self.texture = np.ascontiguousarray(model.texture_factors, np.float32).reshape(-1, n)
        self.angular = np.ascontiguousarray(model.angular_factors, np.float32).reshape(-1, 3 * n)

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        _shade(
            self.texture, self.angular, self.rows, self.cols, self.toroidal,
            self.lights, self.inverse_cosines, self.views, row, col, w_i, w_o, out,
        )  # fmt: skip


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _shade(
    texture, angular, rows, cols, toroidal, lights, inverse_cosines, views, row, col, w_i, w_o, out
):
    n = texture.shape[1]
    index = np.zeros((2, 4), np.int32)
    weight = np.zeros((2, 4))
    pair = np.zeros(18, np.int32)
    share = np.zeros(18, np.float32)
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    blended = np.zeros(3 * n, np.float32)
    local = np.zeros(n, np.float32)
    for q in range(len(row)):
        used = pair_weights(
            lights, inverse_cosines, views, w_i[q], w_o[q], index, weight, pair, share
        )
        if used == 0:
            out[q, 0] = 0.0
            out[q, 1] = 0.0
            out[q, 2] = 0.0
            continue
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        t0 = texture[texel[0]]
        t1 = texture[texel[1]]
        t2 = texture[texel[2]]
        t3 = texture[texel[3]]
        for k in range(n):
            local[k] = (bilinear[0] * t0[k] + bilinear[1] * t1[k]) + (
                bilinear[2] * t2[k] + bilinear[3] * t3[k]
            )
        # three pairs at a time: their sum is written once, and 9 pairs are three passes
        for p in range(used, (used + 2) // 3 * 3):
            pair[p] = pair[0]
            share[p] = 0.0
        for p in range(0, used, 3):
            a0 = angular[pair[p]]
            a1 = angular[pair[p + 1]]
            a2 = angular[pair[p + 2]]
            w0 = share[p]
            w1 = share[p + 1]
            w2 = share[p + 2]
            if p == 0:
                for k in range(3 * n):
                    blended[k] = w0 * a0[k] + w1 * a1[k] + w2 * a2[k]
            else:
                for k in range(3 * n):
                    blended[k] += w0 * a0[k] + w1 * a1[k] + w2 * a2[k]
        for c in range(3):
            total = np.float32(0)
            at = c * n
            for k in range(n):
                total += local[k] * blended[at + k]
            out[q, c] = total
