"""Shading from a coded Model: roots at the four texels and all pairs around a light and view, squared, then blended."""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.sample.shading import PairShader, corners


class CodedShader(PairShader):
    """Evaluates a `CodedModel` between its texels, lights and views.

    Roots are not linear in the values: every value that is blended (1, 4, 9 or 16 pairs; 4 texels) is made first.

    Parameters
    ----------
    model : CodedModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        super().__init__(model, interpolation)
        self.texture = model.texture_factors.reshape(-1, model.n_terms)
        self.angular = model.angular_factors
        self.colour = model.colour

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        near = np.empty((4, self.texture.shape[1]), np.float32)
        root = np.empty((3, 4), np.float32)
        texel, bilinear = np.empty(4, np.int64), np.empty(4, np.float32)
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.texture, *self.angular, self.colour, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, near, root, texel, bilinear, out[part],
            )  # fmt: skip


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _roots(near, weights, pair, out):
    """One colour of a pair at the four texels of `near`."""
    # rows of their own, or the compiler does not use vectors
    row = weights[pair]
    n0 = near[0]
    n1 = near[1]
    n2 = near[2]
    n3 = near[3]
    a = np.float32(0)
    b = np.float32(0)
    c = np.float32(0)
    d = np.float32(0)
    for k in range(len(row)):
        a += n0[k] * row[k]
        b += n1[k] * row[k]
        c += n2[k] * row[k]
        d += n3[k] * row[k]
    out[0] = a
    out[1] = b
    out[2] = c
    out[3] = d


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _shade(
    texture, first, second, third, colour, rows, cols, toroidal, row, col, pair, share, near, root, texel,
    bilinear, out,
):  # fmt: skip
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        for t in range(4):
            for k in range(texture.shape[1]):
                near[t, k] = texture[texel[t], k]
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        for p in range(pair.shape[1]):
            weight = share[q, p]
            if weight == 0:
                continue
            _roots(near, first, pair[q, p], root[0])
            _roots(near, second, pair[q, p], root[1])
            _roots(near, third, pair[q, p], root[2])
            for t in range(4):
                x = root[0, t]
                y = root[1, t]
                z = root[2, t]
                r = colour[0, 0] * x + colour[0, 1] * y + colour[0, 2] * z
                g = colour[1, 0] * x + colour[1, 1] * y + colour[1, 2] * z
                b = colour[2, 0] * x + colour[2, 1] * y + colour[2, 2] * z
                part = weight * bilinear[t]
                red += part * (r * abs(r))
                green += part * (g * abs(g))
                blue += part * (b * abs(b))
        out[q, 0] = red
        out[q, 1] = green
        out[q, 2] = blue
