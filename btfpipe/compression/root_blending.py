"""Blending square roots of values between texels, lights and views, without the loss of brightness.

The square of a mean of roots is less than the mean of their squares, by the variance of the roots:
a picture blended so is too dark between the measured directions and texels. The roots are therefore
blended with weights that are a little larger:

- Between texels so much that the mean over all pairs is that of blended values, as an interpolated
  normal is given its length again.
- Between lights, and between views, half of that (the square root of the factor): blended *values*
  are too bright there, as they show a highlight or a lit yarn at two places instead of one between.

Averages of many texels, as texture filtering takes them, are averages of *values*. Between lights and
views values are then blended, with weights that make them on the whole what blended roots are.

The factors come from scalar products of the roots, summed over all pairs or all texels. The SVD's
factors are orthogonal to each other, so that such a sum is one over the terms.
"""

import itertools

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.directions.interpolation import find
from btfpipe.parallel import blocks, single_threaded_blas
from btfpipe.sample.shading import PairWeights, corners

_QUERIES = 8192  # whose pairs are listed at a time
# of a texel from its middle: the Gauss points of the four cells between texels that its area reaches into
_GAUSS = np.float32(0.5 - 12**-0.5)
_AREAS = 1024  # texels whose factors are blended at a time
_LARGEST = 1 << 23  # scalar products kept, 64 MB
_MOST = 16.0  # of a factor: as many directions as are ever blended, of which only one is lit


class RootTables:
    """What a Model of square roots has to know of its factors to blend them.

    Parameters
    ----------
    texture : (rows, cols, n) float32
    angular : list of (pairs, n_k) float32
        Of colours, whose roots' squares add up to those of the channels.
    appearance : Appearance
        Gives the pairs.

    Attributes
    ----------
    texels : (rows * cols, 5) float32
        Scalar products of each texel's roots with its own, and with those of the texels to the
        right, below, and below to the right; and of the texels to the right and below with each
        other. Beyond its borders the sample goes on at the other side.
    lights, views : (n, n) float64
        Scalar products of the roots of value / cos(theta_i) under each light and from each view;
        only of a full grid.
    lights_by_view, views_by_light : (m, n, n) float64
        The same view by view and light by light; m is 1, and they are the mean of all, where there are very many.
    importance, area_importance : (n,) float32
        Sum of the squares of each term over the texels, and over the texels' areas as they are shown.
    """

    def __init__(self, texture, angular, appearance):
        n = texture.shape[2]
        self.importance = np.zeros(n, np.float32)
        for row in texture:
            self.importance += np.square(row).sum(axis=0)
        power = np.zeros(n, np.float32)
        for part in angular:
            for some in blocks(len(part), _QUERIES):
                power[: part.shape[1]] += np.square(part[some]).sum(axis=0)
        self.texels = np.empty((texture.shape[0] * texture.shape[1], 5), np.float32)
        _multiply_neighbours(texture, power, self.texels)
        self.area_importance = np.zeros(n)
        for local in area_factors(texture, self.texels, bool(appearance.toroidal)):
            self.area_importance += np.square(local).sum(axis=0) / 4
        self.area_importance = self.area_importance.astype(np.float32)
        if appearance.is_product:
            lights, views = len(appearance.light_directions), len(appearance.view_directions)
            self.lights, self.views = (
                a[0] for a in _direction_products(angular, self.importance, appearance, whole=True)
            )
            self.lights_by_view, self.views_by_light = _direction_products(
                angular, self.area_importance, appearance, _are_single(lights, views)
            )


def area_factors(texture, products, toroidal):
    """Yield factors (part of the texels, n) float32 at the four points (Gauss) that stand for texels' areas, the gain inside."""
    rows, cols, n = texture.shape
    flat = texture.reshape(-1, n)
    row, col = np.divmod(np.arange(rows * cols, dtype=np.float32), np.float32(cols))
    for down, right in itertools.product((-_GAUSS, _GAUSS), repeat=2):
        for some in blocks(len(row), _AREAS):
            local = np.empty((len(row[some]), n), np.float32)
            _blend_all(
                flat, products, rows, cols, toroidal, row[some] + down, col[some] + right,
                np.empty(4, np.int64), np.empty(4, np.float32), local,
            )  # fmt: skip
            yield local


@leaf(fastmath={"contract"})
def _blend_all(texture, products, rows, cols, toroidal, row, col, texel, weight, out):
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, weight)
        gain = np.float32(texel_gain(products, texel, weight))
        a, b, c, d = texture[texel[0]], texture[texel[1]], texture[texel[2]], texture[texel[3]]
        for k in range(out.shape[1]):
            blended = (weight[0] * a[k] + weight[1] * b[k]) + (weight[2] * c[k] + weight[3] * d[k])
            out[q, k] = gain * blended


def _direction_products(angular, importance, appearance, whole):
    """Scalar products of the roots of value / cos(theta_i): (views, lights, lights) and (lights, views, views), or of the whole (1, n, n)."""
    from btfpipe.sample.appearance import light_cosines

    lights, views = len(appearance.light_directions), len(appearance.view_directions)
    scale = np.sqrt(1 / light_cosines(appearance.light_directions)).astype(np.float32)
    by_view = np.zeros((1 if whole else views, lights, lights))
    by_light = np.zeros((1 if whole else lights, views, views))
    with single_threaded_blas():
        for part in angular:
            part = part.reshape(views, lights, -1)
            each = np.sqrt(importance[: part.shape[2]])
            for number, seen in enumerate(part):
                scaled = seen * each * scale[:, None]
                by_view[0 if whole else number] += scaled @ scaled.T
            for light in range(lights):
                scaled = part[:, light] * each * scale[light]
                by_light[0 if whole else light] += scaled @ scaled.T
    return by_view, by_light


def _are_single(lights, views):
    """Whether there are too many directions for a table of products for each."""
    return lights * views * (lights + views) > _LARGEST


def product_bytes(lights, views):
    """Bytes of the products that a `RootTables` keeps."""
    each = lights**2 + views**2
    if not _are_single(lights, views):
        each = lights * views * (lights + views)
    return 8 * (each + lights**2 + views**2)


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _dot(a, b, power):
    total = np.float32(0)
    for k in range(len(power)):
        total += a[k] * b[k] * power[k]
    return total


@leaf
def _multiply_neighbours(texture, power, out):
    rows, cols = texture.shape[:2]
    for i in range(rows):
        below = (i + 1) % rows
        for j in range(cols):
            right = (j + 1) % cols
            a = texture[i, j]
            to = out[i * cols + j]
            to[0] = _dot(a, a, power)
            to[1] = _dot(a, texture[i, right], power)
            to[2] = _dot(a, texture[below, j], power)
            to[3] = _dot(a, texture[below, right], power)
            to[4] = _dot(texture[i, right], texture[below, j], power)


@leaf
def texel_gain(products, texel, weight):
    """What four texels' blended roots are multiplied by to keep their mean square."""
    a = products[texel[0]]
    b = products[texel[1]]
    c = products[texel[2]]
    d = products[texel[3]]
    kept = weight[0] * a[0] + weight[1] * b[0] + weight[2] * c[0] + weight[3] * d[0]
    blended = weight[0] * weight[0] * a[0] + weight[1] * weight[1] * b[0]
    blended += weight[2] * weight[2] * c[0] + weight[3] * weight[3] * d[0]
    mixed = weight[0] * (weight[1] * a[1] + weight[2] * a[2] + weight[3] * a[3])
    mixed += weight[1] * weight[2] * a[4] + weight[1] * weight[3] * b[2]
    mixed += weight[2] * weight[3] * c[1]
    return np.sqrt(_factor(kept, blended + 2 * mixed))


@leaf
def _factor(kept, blended):
    """A mean of squares over the square of a mean; 1 where all is black."""
    return kept / max(blended, kept / _MOST) if kept > 0 else 1.0


@leaf
def _direction_gain(products, index, weight):
    """What the blended roots of some directions are multiplied by."""
    kept, blended = _squares(products, index, weight)
    return np.sqrt(np.sqrt(_factor(kept, blended)))


@leaf
def _squares(products, index, weight):
    """Blended squares of the roots of some directions, and the square of the blended ones."""
    kept = 0.0
    blended = 0.0
    for i in range(len(index)):
        kept += weight[i] * products[index[i], index[i]]
        for j in range(len(index)):
            blended += weight[i] * weight[j] * products[index[i], index[j]]
    return kept, blended


def pair_powers(angular, importance):
    """Sums (pairs,) float32 of the squares of pairs' roots."""
    out = np.zeros(len(angular[0]), np.float32)
    for part in angular:
        for some in blocks(len(part), _QUERIES):
            out[some] += np.square(part[some]) @ importance[: part.shape[1]]
    return out


class RootWeights(PairWeights):
    """Finds the pairs of which roots are blended, and their weights.

    Parameters
    ----------
    appearance : Appearance
    interpolation : str
        See `PairWeights`.
    tables : RootTables
    angular : list of (pairs, n_k) float32
        As for `RootTables`. A list of pairs has no tables of directions: its factors are found
        query by query.
    """

    def __init__(self, appearance, interpolation, tables, angular):
        super().__init__(appearance, interpolation)
        self.roots = np.sqrt(self.inverse_cosines)
        self.tables = tables
        self.angular = angular
        if self.near is not None:
            self.power = pair_powers(angular, tables.importance)

    def find_lights(self, w_i, light, weight):
        """Fill `light`, `weight` (n, 4) for lights (n, 3): of roots, cosine and gain inside."""
        find(self.lights, w_i, light, weight)
        _weigh_lights(self.tables.lights, self.roots, w_i, light, weight)

    def find_views(self, w_o, view, weight):
        """Fill `view`, `weight` (n, 4) for views (n, 3): weights of roots, gain inside."""
        find(self.views, w_o, view, weight)
        _weigh_views(self.tables.views, view, weight)

    def blocks(self, w_i, w_o):
        """As `PairWeights.blocks`, but with weights of roots: the blend squared is the value."""
        if self.near is not None:
            yield from self._near_blocks(w_i, w_o)
            return
        n = min(len(w_i), _QUERIES)
        pair = np.empty((n, self.most), np.int32)
        weight = np.empty((n, self.most), np.float32)
        index, each = np.empty((2, n, 4), np.int32), np.empty((2, n, 4))
        for part in blocks(len(w_i), _QUERIES):
            n = part.stop - part.start
            self.find_lights(w_i[part], index[0, :n], each[0, :n])
            self.find_views(w_o[part], index[1, :n], each[1, :n])
            _combine(len(self.roots), index[:, :n], each[:, :n], pair[:n], weight[:n])
            yield part, pair[:n], weight[:n]

    def _near_blocks(self, w_i, w_o):
        blended = np.empty(len(self.tables.importance), np.float32)
        for part in blocks(len(w_i), _QUERIES):
            n = part.stop - part.start
            pair, weight = np.empty((n, self.most), np.int32), np.empty((n, self.most), np.float32)
            self.near.find(w_i[part], w_o[part], pair, weight)
            _weigh_pairs(
                *self.angular, self.tables.importance, self.power, self.roots, w_i[part],
                pair, blended, weight,
            )  # fmt: skip
            yield part, pair, weight


class ValueWeights:
    """Finds the pairs of which values, averaged over texels, are blended, and their weights.

    The mean over the whole sample is that of blended roots: exactly in `blocks`, and in `find_lights` and `find_views` from measured
    views and under measured lights.

    Parameters
    ----------
    roots : RootWeights
    plain : PairWeights
        Of the same pairs.
    """

    def __init__(self, roots, plain):
        self._roots, self._plain = roots, plain
        self._power = pair_powers(roots.angular, roots.tables.area_importance)
        self.inverse_cosines = plain.inverse_cosines

    def find_lights(self, w_i, view, share, light, weight):
        """Fill `light`, `weight` (n, 4) for lights (n, 3) and views (n, 4) of such a share, the cosine inside."""
        tables = self._roots.tables
        find(self._roots.lights, w_i, light, weight)
        _weigh_values(tables.lights, tables.lights_by_view, view, share, light, weight)
        weight *= self.inverse_cosines[light] * np.maximum(w_i[:, 2:], 0)

    def find_views(self, w_o, view, weight, scale):
        """Fill `view`, `weight` (n, 4) for views (n, 3), and `scale` (n, lights) with what values under each light are scaled by."""
        tables = self._roots.tables
        find(self._roots.views, w_o, view, weight)
        _scale_values(tables.views, tables.views_by_light, view, weight, scale)

    def blocks(self, w_i, w_o):
        """See `PairWeights.blocks`."""
        roots, tables = self._roots, self._roots.tables
        blended = np.empty(len(tables.importance), np.float32)
        both = zip(self._plain.blocks(w_i, w_o), roots.blocks(w_i, w_o), strict=True)
        for (part, pair, weight), (_, _, of_roots) in both:
            _match(
                *roots.angular, tables.area_importance, self._power, pair, of_roots, blended, weight
            )
            yield part, pair, weight


@leaf
def _weigh_values(whole, by_view, view, share, light, weight):
    for q in range(len(light)):
        kept = 0.0
        blended = 0.0
        for k in range(4):
            table = by_view[min(np.int64(view[q, k]), len(by_view) - 1)]
            some, others = _squares(table, light[q], weight[q])
            kept += share[q, k] * some
            blended += share[q, k] * others
        gain = _direction_gain(whole, light[q], weight[q])
        scale = gain * gain * blended / kept if kept > 0.0 else 1.0
        for k in range(4):
            weight[q, k] *= scale


@leaf
def _scale_values(whole, by_light, view, weight, scale):
    for q in range(len(view)):
        gain = _direction_gain(whole, view[q], weight[q])
        for light in range(scale.shape[1]):
            table = by_light[min(light, len(by_light) - 1)]
            kept, blended = _squares(table, view[q], weight[q])
            scale[q, light] = gain * gain * blended / kept if kept > 0.0 else 1.0


@leaf
def _match(first, second, third, importance, power, pair, of_roots, blended, weight):
    """Scale weights of values so that their mean over all texels is that of blended roots."""
    for q in range(len(pair)):
        kept = 0.0
        for p in range(pair.shape[1]):
            kept += weight[q, p] * power[pair[q, p]]
        found = _mean_square(first, importance, pair[q], of_roots[q], blended)
        found += _mean_square(second, importance, pair[q], of_roots[q], blended)
        found += _mean_square(third, importance, pair[q], of_roots[q], blended)
        share = found / kept if kept > 0.0 else 1.0
        for p in range(pair.shape[1]):
            weight[q, p] *= share


@leaf
def _weigh_lights(products, roots, w_i, light, weight):
    for q in range(len(w_i)):
        gain = np.sqrt(max(w_i[q, 2], 0.0)) * _direction_gain(products, light[q], weight[q])
        for k in range(4):
            weight[q, k] *= gain * roots[light[q, k]]


@leaf
def _weigh_views(products, view, weight):
    for q in range(len(view)):
        gain = _direction_gain(products, view[q], weight[q])
        for k in range(4):
            weight[q, k] *= gain


@leaf
def _combine(lights, index, each, pair, weight):
    """Pairs of the lights and views found."""
    one = int(np.sqrt(pair.shape[1]))
    for q in range(len(pair)):
        for o in range(one):
            for i in range(one):
                pair[q, o * one + i] = index[1, q, o] * lights + index[0, q, i]
                weight[q, o * one + i] = each[1, q, o] * each[0, q, i]


@leaf(fastmath={"contract", "reassoc", "nsz"})
def blend_pairs(angular, pair, weight, out):
    """Fill `out`, as far as there are terms of this colour, with the blended factors of some pairs."""
    n = angular.shape[1]
    for k in range(n):
        out[k] = np.float32(0)
    for p in range(len(pair)):
        row = angular[pair[p]]
        w = weight[p]
        for k in range(n):
            out[k] += w * row[k]


@leaf(fastmath={"contract", "reassoc", "nsz"})
def _mean_square(rows, importance, pair, weight, blended):
    """Sum over the texels of the squares of one colour's blended roots."""
    blend_pairs(rows, pair, weight, blended)
    total = np.float32(0)
    for k in range(rows.shape[1]):
        total += importance[k] * blended[k] * blended[k]
    return total


@leaf
def _weigh_pairs(first, second, third, importance, power, roots, w_i, pair, blended, weight):
    """Turn weights of values over cosine into those of roots, in place."""
    for q in range(len(w_i)):
        kept = 0.0
        for p in range(pair.shape[1]):
            root = roots[pair[q, p]]
            kept += weight[q, p] * root * root * power[pair[q, p]]
            weight[q, p] *= root
        found = _mean_square(first, importance, pair[q], weight[q], blended)
        found += _mean_square(second, importance, pair[q], weight[q], blended)
        found += _mean_square(third, importance, pair[q], weight[q], blended)
        gain = np.sqrt(np.sqrt(_factor(kept, float(found)))) * np.sqrt(max(w_i[q, 2], 0.0))
        for p in range(pair.shape[1]):
            weight[q, p] *= gain
