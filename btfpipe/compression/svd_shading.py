"""Shading from an SVD Model: blend the angular factors of the pairs around a light and view, then dot."""

import numpy as np
from numba import njit

from btfpipe.sample.light_slices import LightSlices
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

    def slices(self, row, col, w_o):
        """See `Appearance.shader`; no faster than `shade`, but to be averaged with those of slower shaders."""
        return LightSlices(self, row, col, w_o)

    def seen(self, texels, view):
        """Values (n, lights, 3) float32 of texels (n,) from a measured view under every measured light."""
        lights, n = len(self.pairs.inverse_cosines), self.texture.shape[1]
        angular = self.angular[view * lights : (view + 1) * lights].reshape(-1, n)
        return (self.texture[texels] @ angular.T).reshape(len(texels), lights, 3)

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.texture, self.angular, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, out[part],
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _shade(texture, angular, rows, cols, toroidal, row, col, pair, share, out):
    n = texture.shape[1]
    most = pair.shape[1]
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
        # three pairs at a time, so that their sum is written once: 9 pairs are three passes
        first = most % 3
        if first > 0:
            a0 = angular[pair[q, 0]]
            w0 = share[q, 0]
            for k in range(3 * n):
                blended[k] = w0 * a0[k]
        else:
            blended[:] = 0.0
        for p in range(first, most, 3):
            a0 = angular[pair[q, p]]
            a1 = angular[pair[q, p + 1]]
            a2 = angular[pair[q, p + 2]]
            w0 = share[q, p]
            w1 = share[q, p + 1]
            w2 = share[q, p + 2]
            for k in range(3 * n):
                blended[k] += w0 * a0[k] + w1 * a1[k] + w2 * a2[k]
        for c in range(3):
            total = np.float32(0)
            at = c * n
            for k in range(n):
                total += local[k] * blended[at + k]
            out[q, c] = total
