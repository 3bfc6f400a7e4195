"""Shading from an SVD Model: blend the angular factors of the pairs around a light and view, then dot."""

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.sample.shading import PairShader, corners


class SvdShader(PairShader):
    """Evaluates an `SvdModel` between its texels, lights and views.

    The factors are linear in the values, so blending them (1, 4, 9 or 16 pairs; 4 texels) is blending the pictures.

    Parameters
    ----------
    model : SvdModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        super().__init__(model, interpolation)
        n = model.n_terms
        self.texture = np.ascontiguousarray(model.texture_factors, np.float32).reshape(-1, n)
        self.angular = np.ascontiguousarray(model.angular_factors, np.float32).reshape(-1, 3 * n)

    def halved(self, halving):
        """The shader of the next level of a `Pyramid`."""
        return halving.coarser(self, texture=halving(self.texture))

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.texture, self.angular, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, out[part],
            )  # fmt: skip

    def add_factors(self, row, col, weight, owner, out):
        """Add weighted factors between texels at (p,) coordinates to the rows `owner` (p,) of `out` (m, terms) float32.

        Averaged over what a look-up covers, they give its value at once: see `shade_factors`.
        """
        _add_factors(
            self.texture, self.rows, self.cols, self.toroidal, row, col, weight, owner,
            np.zeros(4, np.int64), np.zeros(4, np.float32), out,
        )  # fmt: skip

    def shade_factors(self, factors, w_i, w_o, out):
        """Fill `out` (m, 3) float32 with the values of texels' factors (m, terms) float32."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade_factors(factors[part], self.angular, pair, share, out[part])

    def slice_factors(self, factors, w_o):
        """Values (m, lights, 3) float32 of texels' factors (m, terms) from views (m, 3) under every measured light."""
        lights = len(self.pairs.inverse_cosines)
        view, weight = np.zeros((len(factors), 4), np.int32), np.zeros((len(factors), 4))
        scale = np.empty((len(factors), lights), np.float32)
        self.pairs.find_views(w_o, view, weight, scale)
        out = np.zeros((len(factors), lights, 3), np.float32)
        flat = out.reshape(len(factors), -1)
        for seen in np.unique(view[weight > 0]):
            mine, which = np.nonzero((view == seen) & (weight > 0))
            angular = self.angular[seen * lights : (seen + 1) * lights]
            values = factors[mine] @ angular.reshape(3 * lights, -1).T
            flat[mine] += weight[mine, which, None].astype(np.float32) * values
        out *= scale[:, :, None]
        return out


_FAST = {"contract", "reassoc", "nsz"}


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _shade(texture, angular, rows, cols, toroidal, row, col, pair, share, out):
    n = texture.shape[1]
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    blended = np.zeros(3 * n, np.float32)
    local = np.zeros(n, np.float32)
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
        _multiply(local, angular, pair[q], share[q], blended, out[q])


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _shade_factors(factors, angular, pair, share, out):
    blended = np.zeros(3 * factors.shape[1], np.float32)
    for q in range(len(factors)):
        _multiply(factors[q], angular, pair[q], share[q], blended, out[q])


@leaf(fastmath=_FAST)
def _add_factors(texture, rows, cols, toroidal, row, col, weight, owner, texel, bilinear, out):
    for p in range(len(row)):
        corners(float(row[p]), float(col[p]), rows, cols, toroidal, texel, bilinear)
        a = weight[p] * bilinear[0]
        b = weight[p] * bilinear[1]
        c = weight[p] * bilinear[2]
        d = weight[p] * bilinear[3]
        t0 = texture[texel[0]]
        t1 = texture[texel[1]]
        t2 = texture[texel[2]]
        t3 = texture[texel[3]]
        to = out[owner[p]]
        for k in range(len(to)):
            to[k] += (a * t0[k] + b * t1[k]) + (c * t2[k] + d * t3[k])


@leaf(fastmath=_FAST)
def _multiply(local, angular, pair, share, blended, out):
    """Fill ``out`` (3,): the product of a texel's factors with the blended ones of some pairs."""
    n = len(local)
    most = len(pair)
    # three pairs at a time, so that their sum is written once: 9 pairs are three passes
    first = most % 3
    if first > 0:
        a0 = angular[pair[0]]
        w0 = share[0]
        for k in range(3 * n):
            blended[k] = w0 * a0[k]
    else:
        blended[:] = 0.0
    for p in range(first, most, 3):
        a0 = angular[pair[p]]
        a1 = angular[pair[p + 1]]
        a2 = angular[pair[p + 2]]
        w0 = share[p]
        w1 = share[p + 1]
        w2 = share[p + 2]
        for k in range(3 * n):
            blended[k] += w0 * a0[k] + w1 * a1[k] + w2 * a2[k]
    for c in range(3):
        total = np.float32(0)
        at = c * n
        for k in range(n):
            total += local[k] * blended[at + k]
        out[c] = total
