"""Pictures at another size: mean over the covered area when shrinking, linear when growing."""

import numpy as np

from btfpipe.compiled import njit


class Resizer:
    """Resizes linear pictures from one size to another.

    Texel centres map as DESIGN.md says: output x covers input [x, x + 1) * scale. Along an axis that shrinks, an output
    texel is the mean over the input it covers, fractions included; along one that grows, it is interpolated linearly
    between input centres. A toroidal picture wraps, others repeat their border.

    Parameters
    ----------
    shape, texels : (int, int)
        Rows and columns before and after.
    toroidal : bool
    """

    def __init__(self, shape, texels, toroidal=False):
        self._down = _taps(shape[0], texels[0], toroidal)
        self._across = _taps(shape[1], texels[1], toroidal)
        self._texels = tuple(texels)

    def __call__(self, picture):
        """Resize a picture (rows, cols, 3); the result is float32."""
        picture = np.ascontiguousarray(picture, np.float32)
        rows, cols = self._texels
        between = np.empty((rows, picture.shape[1] * 3), np.float32)
        out = np.empty((rows, cols, 3), np.float32)
        _resize_rows(picture.reshape(len(picture), -1), *self._down, between)
        _resize_cols(between, *self._across, out.reshape(rows, -1))
        return out


def resize_mask(mask, texels, toroidal=False):
    """A mask at another size: a texel is valid only if all that `Resizer` makes it of are.

    Parameters
    ----------
    mask : (rows, cols) bool
        Valid texels.
    texels, toroidal
        As for `Resizer`.

    Returns
    -------
    (rows, cols) bool
    """
    invalid = np.repeat(~np.asarray(mask, bool)[..., None], 3, axis=2)
    share = Resizer(mask.shape, texels, toroidal)(invalid)[..., 0]
    return share < 1e-6  # a texel that is only touched has a share of rounding


def _taps(before, after, toroidal):
    """Inputs (after, taps) int64 of each output texel along one axis, and weights float32 that sum to 1."""
    scale = before / after
    if scale >= 1:
        low = np.arange(after) * scale
        taps = int(np.ceil(scale)) + 1
        index = np.floor(low + 1e-9).astype(np.int64)[:, None] + np.arange(taps)
        covered = np.minimum(index + 1, (low + scale)[:, None]) - np.maximum(index, low[:, None])
        weight = np.maximum(covered, 0)
    else:
        centre = (np.arange(after) + 0.5) * scale - 0.5
        index = np.floor(centre).astype(np.int64)[:, None] + np.arange(2)
        weight = np.maximum(1 - np.abs(index - centre[:, None]), 0)
    weight /= weight.sum(axis=1, keepdims=True)
    index = index % before if toroidal else np.clip(index, 0, before - 1)
    return index, weight.astype(np.float32)


@njit(cache=True, nogil=True)
def _resize_rows(picture, index, weight, out):
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] = 0.0
        for tap in range(index.shape[1]):
            w = weight[i, tap]
            source = index[i, tap]
            if w != 0.0:
                for k in range(out.shape[1]):
                    out[i, k] += w * picture[source, k]


@njit(cache=True, nogil=True)
def _resize_cols(picture, index, weight, out):
    for i in range(out.shape[0]):
        for j in range(index.shape[0]):
            red = np.float32(0.0)
            green = np.float32(0.0)
            blue = np.float32(0.0)
            for tap in range(index.shape[1]):
                w = weight[j, tap]
                source = 3 * index[j, tap]
                red += w * picture[i, source]
                green += w * picture[i, source + 1]
                blue += w * picture[i, source + 2]
            out[i, 3 * j] = red
            out[i, 3 * j + 1] = green
            out[i, 3 * j + 2] = blue
