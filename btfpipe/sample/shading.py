"""Shading straight from a Sample, and the interpolation weights that shaders share."""

import functools
import math
import os

import numpy as np
from numba import prange, types
from numba.extending import overload

from btfpipe.compiled import njit
from btfpipe.directions import Hemisphere
from btfpipe.directions.interpolation import find
from btfpipe.directions.pairs import NearestPairs
from btfpipe.errors import InputError
from btfpipe.parallel import blocks
from btfpipe.sample.appearance import light_cosines
from btfpipe.sample.transfer import decode_table

_QUERIES = 8192  # whose pairs are listed at a time
_CHANNELS = 3 << 8  # of pairs, decoded at a time
_BLOCK = 64  # texels whose pairs are gathered together: a line of the cache is then read once


class PairShader:
    """What shaders that blend measured pairs share.

    Parameters
    ----------
    appearance : Appearance
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, appearance, interpolation="barycentric"):
        self.pairs = PairWeights(appearance, interpolation)
        self.rows, self.cols = appearance.shape
        self.toroidal = bool(appearance.toroidal)


class RawShader(PairShader):
    """Evaluates a Sample between its texels, lights and views.

    Holds the codes in texel-major order ``(texel, view, light, channel)``, so that the pictures blended at one
    texel lie together: one copy of the Sample in memory, made once and shared by all shaders of it.

    Parameters
    ----------
    sample : Sample
    interpolation : str
        See `PairWeights`.

    Raises
    ------
    InputError
        If its copy does not fit the machine.
    """

    def __init__(self, sample, interpolation="barycentric"):
        super().__init__(sample, interpolation)
        self.codes = texel_major(sample)
        self.table = _table(sample)
        self.gain = np.zeros((0, 3), np.float32)
        if sample.gain is not None:
            self.gain = np.ascontiguousarray(sample.gain, np.float32).reshape(-1, 3)

    def halved(self, halving):
        """The shader of the next level of a `Pyramid`: in half precision, of single-precision samples in single."""
        single = self.codes.dtype == np.float32
        codes = np.empty((math.prod(halving.halved), self.codes.shape[1]), np.float32)
        for part in blocks(self.codes.shape[1], _CHANNELS):
            values = self.codes[:, part]
            values = values * self.table[0] if single else self.table[values]
            if len(self.gain):
                values = values * np.tile(self.gain, (values.shape[1] // 3,))
            codes[:, part] = halving(values)
        table = np.ones(1, np.float32)
        if not single:
            scale = np.float32(np.abs(codes).max(initial=1e-30))
            codes /= scale
            codes = codes.astype(np.float16).view(np.uint16)
            table = decode_table(np.float16, "linear", scale)
        return halving.coarser(self, codes=codes, table=table, gain=self.gain[:0])

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.codes, self.table, self.gain, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, out[part],
            )  # fmt: skip


def texel_major(sample):
    """Codes of a Sample as (texels, pairs * 3), kept with it; float16 as their bits.

    Raises
    ------
    InputError
        If the copy would take more than half of the machine's memory.
    """
    cached = getattr(sample, "_texel_major", None)
    if cached is not None:
        return cached
    need = int(sample.codes.nbytes)
    have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if need > have // 2:
        raise InputError(
            f"shading from this sample keeps a copy of {need / 1e9:.1f} GB in memory and the machine has"
            f" {have / 1e9:.1f} GB; `btfpipe compress` makes a Model that takes far less."
        )
    pairs, rows, cols, _ = sample.codes.shape
    codes = np.ascontiguousarray(sample.codes).reshape(pairs, rows * cols, 3)
    if codes.dtype == np.float16:
        codes = codes.view(np.uint16)
    out = np.empty((rows * cols, pairs * 3), codes.dtype)
    _transpose(codes, out)
    sample._texel_major = out
    return out


def _table(sample):
    """Linear value of every code; for float32 samples the scale alone."""
    if sample.codes.dtype == np.float32:
        if sample.transfer != "linear":
            raise InputError(
                f"a float32 sample with transfer {sample.transfer!r} cannot be shaded; ingest it as linear."
            )
        return np.array([sample.scale], np.float32)
    return decode_table(sample.codes.dtype, sample.transfer, sample.scale)


@njit(cache=True, nogil=True, parallel=True)
def _transpose(codes, out):
    """(pairs, texels, 3) into (texels, pairs * 3), a block of texels at a time."""
    pairs, texels, _ = codes.shape
    for block in prange((texels + _BLOCK - 1) // _BLOCK):
        first = block * _BLOCK
        last = min(first + _BLOCK, texels)
        for pair in range(pairs):
            for texel in range(first, last):
                for c in range(3):
                    out[texel, pair * 3 + c] = codes[pair, texel, c]


def _value(table, code):
    """Linear value of a code: by look-up for integers, by scale for floats."""
    return table[code] if np.issubdtype(type(code), np.integer) else table[0] * code


@overload(_value, inline="always")
def _overload_value(table, code):
    if isinstance(code, types.Integer):
        return lambda table, code: table[code]
    return lambda table, code: table[0] * code


class PairWeights:
    """Finds the pairs that stand for lights and views between the measured ones.

    Parameters
    ----------
    appearance : Appearance
        Of a product of views and lights, between which lights and views are interpolated separately; in a list of pairs the
        nearest ones in light-view space are (see `NearestPairs`).
    interpolation : str
        ``barycentric``: 3 lights and 3 views, the 9 nearest pairs of a list; ``four``: 4 and 4, the 4 nearest pairs of a
        list; ``nearest``: 1; ``reciprocal``: the 9 nearest pairs, light and view exchangeable.
    """

    def __init__(self, appearance, interpolation):
        lights = np.asarray(appearance.light_directions, np.float64)
        views = np.asarray(appearance.view_directions, np.float64)
        self.inverse_cosines = 1 / light_cosines(lights)
        self.near = None
        if interpolation not in ("barycentric", "four", "nearest", "reciprocal"):
            raise InputError(
                f"interpolation {interpolation!r}; expected barycentric, four, nearest or reciprocal."
            )
        if appearance.is_product and interpolation != "reciprocal":
            self.lights, self.views = (_tables(a.tobytes(), interpolation) for a in (lights, views))
            self.most = {"barycentric": 9, "four": 16, "nearest": 1}[interpolation]
            return
        self.most = {"barycentric": 9, "reciprocal": 9, "four": 4, "nearest": 1}[interpolation]
        self.inverse_cosines = self.inverse_cosines[appearance.light_index]
        self.near = NearestPairs(
            lights[appearance.light_index],
            views[appearance.view_index],
            self.most,
            interpolation == "reciprocal",
        )

    def blocks(self, w_i, w_o):
        """Yield (slice, pair, share) over blocks of queries (m, 3), unit vectors in the sample's frame, float32 or float64.

        `pair` (n, `most`) int32 and `share` of the same shape, float32, are used again for the next block; blocks
        keep them in the processor's cache. Between lights value / cos(theta_i) is interpolated and multiplied by
        the true cosine; shares are 0 for a light below the horizon.
        """
        n = min(len(w_i), _QUERIES)
        pair = np.empty((n, self.most), np.int32)
        share = np.empty((n, self.most), np.float32)
        if self.near is None:
            index = np.empty((2, n, 4), np.int32)
            weight = np.empty((2, n, 4))
        for part in blocks(len(w_i), _QUERIES):
            n = part.stop - part.start
            if self.near is None:
                find(self.lights, w_i[part], index[0, :n], weight[0, :n])
                find(self.views, w_o[part], index[1, :n], weight[1, :n])
                _combine(
                    self.inverse_cosines,
                    w_i[part],
                    index[:, :n],
                    weight[:, :n],
                    pair[:n],
                    share[:n],
                )
            else:
                self.near.find(w_i[part], w_o[part], pair[:n], share[:n])
                share[:n] *= self.inverse_cosines[pair[:n]]
                share[:n] *= np.maximum(w_i[part, 2:], 0)
            yield part, pair[:n], share[:n]


@functools.lru_cache(maxsize=16)
def _tables(directions, interpolation):
    """Tables of a set of directions (its float64 bytes), kept: `evaluate` makes a shader at each call."""
    return Hemisphere(np.frombuffer(directions).reshape(-1, 3), interpolation).tables


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(inverse_cosines, w_i, index, weight, pair, share):
    """Pairs and shares of the lights and views found; all shares are 0 for a light below the horizon."""
    count = len(inverse_cosines)
    one = int(np.sqrt(pair.shape[1]))
    for q in range(len(w_i)):
        cosine = max(w_i[q, 2], 0.0)
        for o in range(one):
            for i in range(one):
                light = index[0, q, i]
                pair[q, o * one + i] = index[1, q, o] * count + light
                share[q, o * one + i] = (
                    weight[1, q, o] * weight[0, q, i] * cosine * inverse_cosines[light]
                )


@njit(cache=True, nogil=True)
def corners(row, col, rows, cols, toroidal, texel, share):
    """Texels (4,) around a coordinate and their bilinear weights (4,), filled in place."""
    if toroidal:
        row -= np.floor(row / rows) * rows
        col -= np.floor(col / cols) * cols
    else:
        row = min(max(row, 0.0), rows - 1.0)
        col = min(max(col, 0.0), cols - 1.0)
    i = int(row)
    j = int(col)
    y = row - i
    x = col - j
    i %= rows
    j %= cols
    below = (i + 1) % rows
    right = (j + 1) % cols
    texel[0] = i * cols + j
    texel[1] = i * cols + right
    texel[2] = below * cols + j
    texel[3] = below * cols + right
    share[0] = (1.0 - y) * (1.0 - x)
    share[1] = (1.0 - y) * x
    share[2] = y * (1.0 - x)
    share[3] = y * x


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _shade(codes, table, gain, rows, cols, toroidal, row, col, pair, share, out):
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        for k in range(4):
            if bilinear[k] == 0.0:
                continue
            r = np.float32(0)
            g = np.float32(0)
            b = np.float32(0)
            i = texel[k]
            for p in range(pair.shape[1]):
                at = 3 * np.int64(pair[q, p])
                w = share[q, p]
                r += w * _value(table, codes[i, at])
                g += w * _value(table, codes[i, at + 1])
                b += w * _value(table, codes[i, at + 2])
            if len(gain) > 0:
                r *= gain[i, 0]
                g *= gain[i, 1]
                b *= gain[i, 2]
            red += bilinear[k] * r
            green += bilinear[k] * g
            blue += bilinear[k] * b
        out[q, 0] = red
        out[q, 1] = green
        out[q, 2] = blue
