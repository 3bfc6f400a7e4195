"""Shading from a coded Model: roots at the four texels and all pairs around a light and view, squared, then blended."""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.compression.coded import values_of
from btfpipe.sample.light_slices import LightSlices, slice_bytes
from btfpipe.sample.shading import PairShader, corners

MANY_LIGHTS = 4  # as measured, at 1 to 4 pixels a texel


class CodedShader(PairShader):
    """Evaluates a `CodedModel` between its texels, lights and views.

    Roots are not linear in the values: every value that is blended (1, 4, 9 or 16 pairs; 4 texels) is made first. Under many
    lights that is done once for all: see `LightSlices`.

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
        if self.pairs.near is None:
            self.many_lights = MANY_LIGHTS
            self.slice_bytes = slice_bytes(len(self.pairs.inverse_cosines))

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

    def slices(self, row, col, w_o):
        """See `Appearance.shader`."""
        return LightSlices(self, row, col, w_o)

    def seen(self, texels, view):
        """Values (n, lights, 3) float32 of texels (n,) from a measured view under every measured light."""
        count = len(self.pairs.inverse_cosines)
        pairs = slice(view * count, (view + 1) * count)
        return values_of(self.texture[texels], [a[pairs] for a in self.angular], self.colour)


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _roots(near, x, y, z, common, out):
    """The three colours of a pair, of weights x, y, z, at the four texels of `near`, over the terms that all have."""
    # rows of their own, or the compiler does not use vectors; texels are loaded once for three colours
    n0 = near[0]
    n1 = near[1]
    n2 = near[2]
    n3 = near[3]
    zero = np.float32(0)
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = zero
    for k in range(common):
        x0 += n0[k] * x[k]
        x1 += n1[k] * x[k]
        x2 += n2[k] * x[k]
        x3 += n3[k] * x[k]
        y0 += n0[k] * y[k]
        y1 += n1[k] * y[k]
        y2 += n2[k] * y[k]
        y3 += n3[k] * y[k]
        z0 += n0[k] * z[k]
        z1 += n1[k] * z[k]
        z2 += n2[k] * z[k]
        z3 += n3[k] * z[k]
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = x0, x1, x2, x3
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = y0, y1, y2, y3
    out[2, 0], out[2, 1], out[2, 2], out[2, 3] = z0, z1, z2, z3


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _add_terms(near, row, common, out):
    """Add the terms that one colour has beyond those of all."""
    if len(row) <= common:
        return
    n0 = near[0]
    n1 = near[1]
    n2 = near[2]
    n3 = near[3]
    a = np.float32(0)
    b = np.float32(0)
    c = np.float32(0)
    d = np.float32(0)
    for k in range(common, len(row)):
        a += n0[k] * row[k]
        b += n1[k] * row[k]
        c += n2[k] * row[k]
        d += n3[k] * row[k]
    out[0] += a
    out[1] += b
    out[2] += c
    out[3] += d


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _shade(
    texture, first, second, third, colour, rows, cols, toroidal, row, col, pair, share, near, root, texel,
    bilinear, out,
):  # fmt: skip
    common = min(first.shape[1], second.shape[1], third.shape[1])
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
            x = first[pair[q, p]]
            y = second[pair[q, p]]
            z = third[pair[q, p]]
            _roots(near, x, y, z, common, root)
            _add_terms(near, x, common, root[0])
            _add_terms(near, y, common, root[1])
            _add_terms(near, z, common, root[2])
            for t in range(4):
                u = root[0, t]
                v = root[1, t]
                w = root[2, t]
                r = colour[0, 0] * u + colour[0, 1] * v + colour[0, 2] * w
                g = colour[1, 0] * u + colour[1, 1] * v + colour[1, 2] * w
                b = colour[2, 0] * u + colour[2, 1] * v + colour[2, 2] * w
                part = weight * bilinear[t]
                red += part * (r * abs(r))
                green += part * (g * abs(g))
                blue += part * (b * abs(b))
        out[q, 0] = red
        out[q, 1] = green
        out[q, 2] = blue
