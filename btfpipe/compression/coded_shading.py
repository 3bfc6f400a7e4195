"""Shading from a coded Model: blend the roots' factors of the texels and pairs around a query, multiply, square."""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.compression.coded import roots_of
from btfpipe.compression.light_slices import LightSlices, slice_bytes
from btfpipe.compression.root_blending import RootTables, RootWeights, texel_gain
from btfpipe.sample.shading import PairShader, corners

MANY_LIGHTS = 5  # as measured, at 1 to 4 pixels a texel (even at 3.6 to 6.2)
_FAST = {"contract", "reassoc", "nsz"}


class CodedShader(PairShader):
    """Evaluates a `CodedModel` between its texels, lights and views.

    What is blended is roots, not values: those are linear in the factors, so that one product a query is left. See
    `root_blending` for what keeps the brightness. Under many lights the roots from a view are made once for all: see
    `LightSlices`.

    Parameters
    ----------
    model : CodedModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        self.rows, self.cols = model.shape
        self.toroidal = bool(model.toroidal)
        self.texture = model.texture_factors.reshape(-1, model.n_terms)
        self.angular = model.angular_factors
        self.colour = model.colour
        tables = root_tables(model)
        self.products = tables.texels
        self.pairs = RootWeights(model, interpolation, tables, self.angular)
        if self.pairs.near is None:
            self.many_lights = MANY_LIGHTS
            self.slice_bytes = slice_bytes(len(self.pairs.roots))

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        local = np.empty(self.texture.shape[1], np.float32)
        texel, bilinear = np.empty(4, np.int64), np.empty(4, np.float32)
        for part, pair, weight in self.pairs.blocks(w_i, w_o):
            _shade(
                self.texture, *self.angular, self.colour, self.products, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, weight, local, texel, bilinear, out[part],
            )  # fmt: skip

    def slices(self, row, col, w_o):
        """See `Appearance.shader`."""
        return LightSlices(self, row, col, w_o)

    def seen(self, texels, view):
        """Roots (n, lights, 3) float32 of texels (n,) from a measured view under every measured light."""
        count = len(self.pairs.roots)
        pairs = slice(view * count, (view + 1) * count)
        return roots_of(self.texture[texels], [a[pairs] for a in self.angular], self.colour)


def root_tables(model):
    """`RootTables` of a `CodedModel`, kept with it."""
    if getattr(model, "_root_tables", None) is None:
        model._root_tables = RootTables(model.texture_factors, model.angular_factors, model)
    return model._root_tables


@leaf(fastmath=_FAST)
def _product(local, angular, pair, weight):
    """Product of a texel's factors with the blended ones of some pairs, over the terms of one colour."""
    total = np.float32(0)
    count = len(pair)
    at = 0
    while at < count:  # nine pairs, or three, or one: what the texel's factors are loaded for
        if count - at >= 9:
            total += _nine(local, angular, pair, weight, at)
            at += 9
        elif count - at >= 3:
            total += _three(local, angular, pair, weight, at)
            at += 3
        else:
            total += _one(local, angular[pair[at]], weight[at])
            at += 1
    return total


@leaf(fastmath=_FAST)
def _nine(local, angular, pair, weight, at):
    a, b, c = angular[pair[at]], angular[pair[at + 1]], angular[pair[at + 2]]
    d, e, f = angular[pair[at + 3]], angular[pair[at + 4]], angular[pair[at + 5]]
    g, h, i = angular[pair[at + 6]], angular[pair[at + 7]], angular[pair[at + 8]]
    r, s, t = weight[at], weight[at + 1], weight[at + 2]
    u, v, w = weight[at + 3], weight[at + 4], weight[at + 5]
    x, y, z = weight[at + 6], weight[at + 7], weight[at + 8]
    total = np.float32(0)
    for k in range(len(a)):
        first = r * a[k] + s * b[k] + t * c[k]
        second = u * d[k] + v * e[k] + w * f[k]
        third = x * g[k] + y * h[k] + z * i[k]
        total += local[k] * ((first + second) + third)
    return total


@leaf(fastmath=_FAST)
def _three(local, angular, pair, weight, at):
    a, b, c = angular[pair[at]], angular[pair[at + 1]], angular[pair[at + 2]]
    u, v, w = weight[at], weight[at + 1], weight[at + 2]
    total = np.float32(0)
    for k in range(len(a)):
        total += local[k] * (u * a[k] + v * b[k] + w * c[k])
    return total


@leaf(fastmath=_FAST)
def _one(local, row, weight):
    total = np.float32(0)
    for k in range(len(row)):
        total += local[k] * row[k]
    return weight * total


@leaf(fastmath=_FAST)
def _blend(a, b, c, d, weight, out):
    """Fill ``out`` (terms,) with the factors of a place between four texels."""
    s = weight[0]
    t = weight[1]
    u = weight[2]
    v = weight[3]
    for k in range(len(out)):
        out[k] = (s * a[k] + t * b[k]) + (u * c[k] + v * d[k])


@leaf(fastmath=_FAST)
def _shade(
    texture, first, second, third, colour, products, rows, cols, toroidal, row, col, pair, weight, local, texel,
    bilinear, out,
):  # fmt: skip
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        _blend(
            texture[texel[0]], texture[texel[1]], texture[texel[2]], texture[texel[3]], bilinear, local
        )  # fmt: skip
        gain = np.float32(texel_gain(products, texel, bilinear))
        x = gain * _product(local, first, pair[q], weight[q])
        y = gain * _product(local, second, pair[q], weight[q])
        z = gain * _product(local, third, pair[q], weight[q])
        for c in range(3):
            root = colour[c, 0] * x + colour[c, 1] * y + colour[c, 2] * z
            out[q, c] = root * abs(root)
