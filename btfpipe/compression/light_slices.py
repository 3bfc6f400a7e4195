"""The same look-ups under many lights: what does not hang on the light is done once.

At one texel and from one view a BTF is a function of the light alone: a slice of it. A slice under all measured lights
costs what some single lights do, less where look-ups share texels; each further light then only interpolates. What is
interpolated is square roots of values (`btfpipe.compression.root_blending`).

Slices of values can be averaged over what a look-up covers of the sample, those of roots cannot.
"""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.compression.root_blending import texel_gain
from btfpipe.directions.interpolation import find
from btfpipe.parallel import blocks
from btfpipe.sample.shading import corners

_LOOKUPS = 2048  # whose texels are evaluated together; their roots stay in the cache


class LightSlices:
    """What look-ups show from their views under every measured light.

    Call it with BLAS on one thread, for results that do not hang on the number of threads.

    Parameters
    ----------
    shader : PairShader
        Of a product of views and lights, with ``pairs``, `RootWeights`; ``products``, those of its `RootTables`; and a method
        ``seen(texels, view)`` that gives the roots (n, lights, 3) float32 of texels (n,), numbered row by row, from a
        measured view.
    row, col : (n,) float32
        Texel coordinates.
    w_o : (n, 3) float32
        Directions to the eye, in the sample's frame.
    """

    def __init__(self, shader, row, col, w_o):
        self.pairs = shader.pairs
        texel, bilinear = np.empty((len(row), 4), np.int64), np.empty((len(row), 4), np.float32)
        _all_corners(
            row, col, shader.rows, shader.cols, shader.toroidal, shader.products, texel, bilinear
        )
        view, weight = np.zeros((len(row), 4), np.int32), np.zeros((len(row), 4))
        self.pairs.find_views(w_o, view, weight)
        self.roots = np.zeros((len(row), len(self.pairs.roots), 3), np.float32)
        number = np.full(shader.rows * shader.cols, -1, np.int32)
        order = np.argsort(np.where(weight > 0, view, -1), axis=None, kind="stable")
        order = order[np.count_nonzero(weight <= 0) :]
        bounds = np.flatnonzero(np.diff(view.ravel()[order])) + 1
        for items in np.split(order, bounds):
            for part in blocks(len(items), _LOOKUPS):
                some = items[part]
                lookup = some // 4
                texels = np.empty(4 * len(some), np.int32)
                texels = texels[: _list_texels(texel, lookup, number, texels)]
                seen = shader.seen(texels, int(view.ravel()[some[0]]))
                _add(seen, texel, bilinear, lookup, weight.ravel()[some], number, self.roots)
                number[texels] = -1

    @property
    def values(self):
        """What the look-ups show under the measured lights (n, lights, 3) float32."""
        return self.roots * np.abs(self.roots)

    def shade(self, chosen, w_i, out):
        """Values of some look-ups under lights of theirs.

        Parameters
        ----------
        chosen : (m,) int
            Which look-ups.
        w_i : (m, 3) float32
            Unit vectors to the light, in the sample's frame.
        out : (m, 3) float32
            Filled in place.
        """
        light, weight = np.zeros((len(chosen), 4), np.int32), np.zeros((len(chosen), 4))
        self.pairs.find_lights(w_i, light, weight)
        _interpolate(self.roots, chosen, light, weight, out)


class AveragedSlices:
    """Slices of look-ups of which many are averages over several texels.

    Parameters
    ----------
    pairs : RootWeights
    means : ValueWeights
    values : (n, lights, 3) float32
        Under the measured lights.
    w_o : (n, 3) float32
    spread : (n,) float32
        1 for an average, between whose lights values are blended; 0 for a point, as in `LightSlices`.
    """

    def __init__(self, pairs, means, values, w_o, spread):
        self.pairs, self.means = pairs, means
        self.values, self.spread = values, spread
        self.view, self.share = np.zeros((len(w_o), 4), np.int32), np.zeros((len(w_o), 4))
        find(pairs.views, w_o, self.view, self.share)

    def shade(self, chosen, w_i, out):
        """Fill `out`; see `LightSlices.shade`."""
        light, weight = np.zeros((len(chosen), 4), np.int32), np.zeros((2, len(chosen), 4))
        self.pairs.find_lights(w_i, light, weight[0])
        self.means.find_lights(w_i, self.view[chosen], self.share[chosen], light, weight[1])
        _interpolate_means(self.values, self.spread, chosen, light, *weight, out)


def slice_bytes(lights):
    """Bytes of a look-up in `LightSlices`."""
    return 12 * lights


@leaf
def _all_corners(row, col, rows, cols, toroidal, products, texel, weight):
    """Texels around look-ups and the weights of their roots."""
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel[q], weight[q])
        gain = np.float32(texel_gain(products, texel[q], weight[q]))
        for k in range(4):
            weight[q, k] *= gain


@leaf
def _list_texels(texel, lookup, number, texels):
    """List the texels that look-ups need, each once, and number them; returns how many."""
    count = 0
    for q in lookup:
        for k in range(4):
            if number[texel[q, k]] < 0:
                number[texel[q, k]] = count
                texels[count] = texel[q, k]
                count += 1
    return count


@leaf(fastmath={"contract"})
def _add(seen, texel, bilinear, lookup, weight, number, out):
    """Add the texels' roots from one view to the look-ups' slices."""
    for at in range(len(lookup)):
        q = lookup[at]
        a = seen[number[texel[q, 0]]]
        b = seen[number[texel[q, 1]]]
        c = seen[number[texel[q, 2]]]
        d = seen[number[texel[q, 3]]]
        w = np.float32(weight[at])
        wa = w * bilinear[q, 0]
        wb = w * bilinear[q, 1]
        wc = w * bilinear[q, 2]
        wd = w * bilinear[q, 3]
        to = out[q]
        for i in range(out.shape[1]):
            for k in range(3):
                to[i, k] += wa * a[i, k] + wb * b[i, k] + wc * c[i, k] + wd * d[i, k]


@leaf(fastmath={"contract"})
def _interpolate(roots, chosen, light, weight, out):
    for q in range(len(chosen)):
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        slice_ = roots[chosen[q]]
        for k in range(light.shape[1]):
            w = np.float32(weight[q, k])
            red += w * slice_[light[q, k], 0]
            green += w * slice_[light[q, k], 1]
            blue += w * slice_[light[q, k], 2]
        out[q, 0] = red * abs(red)
        out[q, 1] = green * abs(green)
        out[q, 2] = blue * abs(blue)


@leaf
def _interpolate_means(values, spread, chosen, light, of_roots, of_values, out):
    for q in range(len(chosen)):
        share = spread[chosen[q]]
        for c in range(3):
            root = np.float32(0)
            mean = np.float32(0)
            for k in range(light.shape[1]):
                value = values[chosen[q], light[q, k], c]
                mean += np.float32(of_values[q, k]) * value
                if share < 1.0:
                    root += np.float32(of_roots[q, k] * np.copysign(np.sqrt(abs(value)), value))
            out[q, c] = share * mean + (np.float32(1) - share) * root * abs(root)
