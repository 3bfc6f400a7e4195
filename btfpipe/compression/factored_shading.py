"""Shading from a `FactoredModel`: decode each pair at each texel, then blend; linear spaces blend first."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.compression.factored import SPACES, decode_colour
from btfpipe.sample.shading import PairShader, corners

_FLAGS = {"contract", "reassoc", "nsz"}  # sums in any order, so that they run in vectors


class FactoredShader(PairShader):
    """Evaluates a `FactoredModel` between its texels, lights and views.

    Holds both factors in single precision, the three channels of a texel or pair side by side.

    Parameters
    ----------
    model : FactoredModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        super().__init__(model, interpolation)
        self.ends = np.cumsum([0, *model.n_terms])
        self.texture = _joined(
            [f.reshape(self.rows * self.cols, f.shape[2]) for f in model.texture_factors]
        )
        self.angular = _joined(model.angular_factors)
        self.factor = model.pair_factor
        if self.factor is None:
            self.factor = np.ones(model.n_pairs, np.float32)
        self.colour = (
            SPACES[model.space], model.matrix, model.mean, np.float32(model.epsilon),
            model.log_range,
        )  # fmt: skip
        self.kernel = _shade_linear if model.is_linear else _shade

    @property
    def halved(self):
        """Makes the shader of the next level of a `Pyramid`; not there where texels cannot be averaged before decoding."""
        if self.kernel is not _shade_linear:
            raise AttributeError("halved")
        return lambda halving: halving.coarser(self, texture=halving(self.texture))

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            self.kernel(
                self.texture, self.angular, self.ends, self.factor, *self.colour,
                self.rows, self.cols, self.toroidal, row[part], col[part], pair, share, out[part],
            )  # fmt: skip


def _joined(factors):
    """Factors (n, K_c) of three channels as one array (n, sum of K_c) float32."""
    out = np.empty((len(factors[0]), sum(f.shape[1] for f in factors)), np.float32)
    return np.concatenate(factors, axis=1, out=out, casting="same_kind")


@njit(cache=True, nogil=True, fastmath=_FLAGS, error_model="numpy")
def _shade(
    texture, angular, ends, factor, space, matrix, mean, epsilon, log_range,
    rows, cols, toroidal, row, col, pair, share, out,
):  # fmt: skip
    n = texture.shape[1]
    most = pair.shape[1]
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    local = np.zeros((n, 4), np.float32)
    channel = np.zeros((3, 3, 4), np.float32)  # channel, pair, texel
    weight = np.zeros(3, np.float32)
    zero = np.float32(0)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        t0 = texture[texel[0]]
        t1 = texture[texel[1]]
        t2 = texture[texel[2]]
        t3 = texture[texel[3]]
        for k in range(n):
            local[k, 0] = t0[k]
            local[k, 1] = t1[k]
            local[k, 2] = t2[k]
            local[k, 3] = t3[k]
        red, green, blue = zero, zero, zero
        # three pairs at a time: four texels fill a vector, and three sums at once hide an addition's delay
        for first in range(0, most, 3):
            p1 = min(first + 1, most - 1)
            p2 = min(first + 2, most - 1)
            weight[0] = share[q, first] * factor[pair[q, first]]
            weight[1] = share[q, p1] * factor[pair[q, p1]] if p1 == first + 1 else zero
            weight[2] = share[q, p2] * factor[pair[q, p2]] if p2 == first + 2 else zero
            if weight[0] == 0.0 and weight[1] == 0.0 and weight[2] == 0.0:
                continue
            a = angular[pair[q, first]]
            b = angular[pair[q, p1]]
            c = angular[pair[q, p2]]
            for part in range(3):
                a0, a1, a2, a3 = zero, zero, zero, zero
                b0, b1, b2, b3 = zero, zero, zero, zero
                c0, c1, c2, c3 = zero, zero, zero, zero
                for k in range(ends[part], ends[part + 1]):
                    x = a[k]
                    y = b[k]
                    z = c[k]
                    a0 += x * local[k, 0]
                    a1 += x * local[k, 1]
                    a2 += x * local[k, 2]
                    a3 += x * local[k, 3]
                    b0 += y * local[k, 0]
                    b1 += y * local[k, 1]
                    b2 += y * local[k, 2]
                    b3 += y * local[k, 3]
                    c0 += z * local[k, 0]
                    c1 += z * local[k, 1]
                    c2 += z * local[k, 2]
                    c3 += z * local[k, 3]
                channel[part, 0, 0] = a0
                channel[part, 0, 1] = a1
                channel[part, 0, 2] = a2
                channel[part, 0, 3] = a3
                channel[part, 1, 0] = b0
                channel[part, 1, 1] = b1
                channel[part, 1, 2] = b2
                channel[part, 1, 3] = b3
                channel[part, 2, 0] = c0
                channel[part, 2, 1] = c1
                channel[part, 2, 2] = c2
                channel[part, 2, 3] = c3
            for p in range(3):
                for i in range(4):
                    w = weight[p] * bilinear[i]
                    if w == 0.0:
                        continue
                    r, g, bl = decode_colour(
                        space, channel[0, p, i], channel[1, p, i], channel[2, p, i], matrix, mean,
                        epsilon, log_range,
                    )  # fmt: skip
                    red += w * r
                    green += w * g
                    blue += w * bl
        out[q, 0] = red
        out[q, 1] = green
        out[q, 2] = blue


@njit(cache=True, nogil=True, fastmath=_FLAGS, error_model="numpy")
def _shade_linear(
    texture, angular, ends, factor, space, matrix, mean, epsilon, log_range,
    rows, cols, toroidal, row, col, pair, share, out,
):  # fmt: skip
    n = texture.shape[1]
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    local = np.zeros(n, np.float32)
    blended = np.zeros(n, np.float32)
    channel = np.zeros(3, np.float32)
    centre = np.zeros(3, np.float32)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        t0 = texture[texel[0]]
        t1 = texture[texel[1]]
        t2 = texture[texel[2]]
        t3 = texture[texel[3]]
        for k in range(n):
            local[k] = (bilinear[0] * t0[k] + bilinear[1] * t1[k]) + (
                bilinear[2] * t2[k] + bilinear[3] * t3[k]
            )
        blended[:] = 0.0
        whole = np.float32(0)
        for p in range(pair.shape[1]):
            w = share[q, p] * factor[pair[q, p]]
            whole += w
            a = angular[pair[q, p]]
            for k in range(n):
                blended[k] += w * a[k]
        for c in range(3):
            total = np.float32(0)
            for k in range(ends[c], ends[c + 1]):
                total += local[k] * blended[k]
            channel[c] = total
            centre[c] = whole * mean[c]  # a constant is blended too: shares do not add up to 1
        r, g, b = decode_colour(
            space, channel[0], channel[1], channel[2], matrix, centre, epsilon, log_range
        )
        out[q, 0] = r
        out[q, 1] = g
        out[q, 2] = b
