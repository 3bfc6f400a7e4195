"""Shading from a coded Model: blend the roots' factors of the texels and pairs around a query, multiply, square."""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.compression.coded import roots_of
from btfpipe.compression.light_slices import AveragedSlices, LightSlices, slice_bytes
from btfpipe.compression.root_blending import (
    RootTables,
    RootWeights,
    ValueWeights,
    area_factors,
    blend_pairs,
    texel_gain,
)
from btfpipe.parallel import blocks
from btfpipe.sample.shading import PairShader, PairWeights, corners

MANY_LIGHTS = 5  # as measured, at 1 to 4 pixels a texel (even at 3.6 to 6.2)
_BATCH = 8  # queries at a time: their factors and those of nine pairs (18 + 16 kB at 512 terms) share the nearest cache
_TEXELS = 1024  # whose roots are made at a time
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
        self.mean_pairs = ValueWeights(self.pairs, PairWeights(model, interpolation))
        if self.pairs.near is None:
            self.many_lights = MANY_LIGHTS
            self.slice_bytes = slice_bytes(len(self.pairs.roots))
            self.slice_shape = len(self.pairs.roots), 3

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        local = np.empty((_BATCH, self.texture.shape[1]), np.float32)
        roots = np.empty((_BATCH, 3), np.float32)
        gain = np.empty(_BATCH, np.float32)
        texel, bilinear = np.empty(4, np.int64), np.empty(4, np.float32)
        for part, pair, weight in self.pairs.blocks(w_i, w_o):
            _shade(
                self.texture, *self.angular, self.colour, self.products, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, weight, local, roots, gain, texel, bilinear, out[part],
            )  # fmt: skip

    def add_means(self, row, col, weight, owner, w_i, w_o, out):
        """Add weighted values at (p,) coordinates to rows of `out` (m, 3) float32.

        `owner` (p,) int64, ascending, has the row of each; all coordinates of a row share its light and view, of `w_i` and
        `w_o` (m, 3): what these pairs show is blended once for all.
        """
        local = np.empty(self.texture.shape[1], np.float32)
        blended = np.empty((3, self.texture.shape[1]), np.float32)
        texel, bilinear = np.empty(4, np.int64), np.empty(4, np.float32)
        rows = slice(int(owner[0]), int(owner[-1]) + 1)
        for part, pair, share in self.pairs.blocks(w_i[rows], w_o[rows]):
            first, last = rows.start + part.start, rows.start + part.stop
            some = slice(*np.searchsorted(owner, [first, last]))
            _add_means(
                self.texture, *self.angular, self.colour, self.products, self.rows, self.cols, self.toroidal,
                row[some], col[some], weight[some], owner[some] - first, pair, share, local, blended, texel, bilinear,
                out[first:last],
            )  # fmt: skip

    def slices(self, row, col, w_o):
        """See `Appearance.shader`."""
        return LightSlices(self, row, col, w_o)

    def averaged_slices(self, values, w_o, spread):
        """Slices of averages; see `AveragedSlices`."""
        return AveragedSlices(self.pairs, self.mean_pairs, values, w_o, spread)

    def area_pictures(self, pairs):
        """Pictures (n, texels, 3) float32 of some pairs, as bright as what is shown all over the texels' areas.

        Blended roots are not, pair by pair.
        """
        angular = [a[pairs] for a in self.angular]
        out = np.empty((len(angular[0]), len(self.texture), 3), np.float32)
        wanted = np.zeros((len(out), 3))
        texture = self.texture.reshape(self.rows, self.cols, -1)
        for local in area_factors(texture, self.products, self.toroidal):
            wanted += np.square(roots_of(local, angular, self.colour)).sum(axis=0) / 4
        for some in blocks(len(self.texture), _TEXELS):
            roots = roots_of(self.texture[some], angular, self.colour)
            out[:, some] = (roots * np.abs(roots)).transpose(1, 0, 2)
        found = np.abs(out).sum(axis=1, dtype=np.float64)
        out *= (wanted / np.maximum(found, 1e-30))[:, None]
        return out

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
    texture, first, second, third, colour, products, rows, cols, toroidal, row, col, pair, weight, local, roots, gain,
    texel, bilinear, out,
):  # fmt: skip
    for start in range(0, len(row), len(local)):
        count = min(len(local), len(row) - start)
        for i in range(count):
            q = start + i
            corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
            _blend(
                texture[texel[0]], texture[texel[1]], texture[texel[2]], texture[texel[3]], bilinear, local[i]
            )  # fmt: skip
            gain[i] = texel_gain(products, texel, bilinear)
        # colour by colour, so that neighbouring queries find their pairs' factors in the cache
        _multiply(local, first, pair, weight, start, count, roots, 0)
        _multiply(local, second, pair, weight, start, count, roots, 1)
        _multiply(local, third, pair, weight, start, count, roots, 2)
        for i in range(count):
            x = gain[i] * roots[i, 0]
            y = gain[i] * roots[i, 1]
            z = gain[i] * roots[i, 2]
            for c in range(3):
                root = colour[c, 0] * x + colour[c, 1] * y + colour[c, 2] * z
                out[start + i, c] = root * abs(root)


@leaf(fastmath=_FAST)
def _multiply(local, angular, pair, weight, start, count, roots, c):
    """Fill column `c` of `roots` for `count` queries from `start` on."""
    for i in range(count):
        roots[i, c] = _product(local[i], angular, pair[start + i], weight[start + i])


@leaf(fastmath=_FAST)
def _add_means(
    texture, first, second, third, colour, products, rows, cols, toroidal, row, col, weight, owner, pair, share, local,
    blended, texel, bilinear, out,
):  # fmt: skip
    at = -1
    for p in range(len(row)):
        q = owner[p]
        if q != at:
            at = q
            blend_pairs(first, pair[q], share[q], blended[0])
            blend_pairs(second, pair[q], share[q], blended[1])
            blend_pairs(third, pair[q], share[q], blended[2])
        corners(float(row[p]), float(col[p]), rows, cols, toroidal, texel, bilinear)
        _blend(
            texture[texel[0]], texture[texel[1]], texture[texel[2]], texture[texel[3]], bilinear, local
        )  # fmt: skip
        gain = np.float32(texel_gain(products, texel, bilinear))
        x = gain * _dot(local, blended[0], first.shape[1])
        y = gain * _dot(local, blended[1], second.shape[1])
        z = gain * _dot(local, blended[2], third.shape[1])
        for c in range(3):
            root = colour[c, 0] * x + colour[c, 1] * y + colour[c, 2] * z
            out[q, c] += weight[p] * root * abs(root)


@leaf(fastmath=_FAST)
def _dot(a, b, n):
    total = np.float32(0)
    for k in range(n):
        total += a[k] * b[k]
    return total
