"""Loops over pictures: sums of squares in both domains, and SSIM."""

import functools

import numpy as np

from btfpipe.compiled import njit
from btfpipe.sample.transfer import encode

WINDOW = 11
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2
_NODES = 1 << 16
N_SUMS = 5  # columns of `sum_pictures`


def _gaussian():
    x = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (x / _SIGMA) ** 2)
    return weights / weights.sum()


_WEIGHTS = _gaussian()


@functools.cache
def encode_table():
    """The sRGB curve at 65,537 even steps of [0, 1]; linear between them it is exact to 1e-7."""
    return encode(np.arange(_NODES + 1) / _NODES, "srgb").astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def _display(value, table):
    """Display value of a linear one over white, by table."""
    if not value > 0:
        return np.float32(0)
    if value >= 1:
        return np.float32(1)
    place = value * np.float32(_NODES)
    low = int(place)
    return table[low] + (place - np.float32(low)) * (table[low + 1] - table[low])


@njit(cache=True, nogil=True)
def sum_pictures(reference, pictures, mask, over_white, table, sums, luma_reference, luma):
    """Sums over the valid texels of each picture, and its luma.

    Parameters
    ----------
    reference, pictures : (n, texels, 3) float32
        Linear values.
    mask : (texels,) bool
        Valid texels.
    over_white : float32
        One over the white of the display domain.
    table : (65537,) float32
        See `encode_table`.
    sums : (n, 5) float64
        Filled with the sums of (p - r)^2, r^2, p r, p^2, and of the squared display difference.
    luma_reference, luma : (n, texels) float32
        Filled with the Rec. 709 luma of the display values.
    """
    for n in range(reference.shape[0]):
        s0 = s1 = s2 = s3 = s4 = 0.0
        for t in range(reference.shape[1]):
            y_reference = np.float32(0)
            y = np.float32(0)
            for c in range(3):
                r = reference[n, t, c]
                p = pictures[n, t, c]
                dr = _display(r * over_white, table)
                dp = _display(p * over_white, table)
                weight = np.float32(0.2126 if c == 0 else (0.7152 if c == 1 else 0.0722))
                y_reference += weight * dr
                y += weight * dp
                if mask[t]:
                    # squares of very large and very small values leave single precision
                    r64 = np.float64(r)
                    p64 = np.float64(p)
                    s0 += (p64 - r64) * (p64 - r64)
                    s1 += r64 * r64
                    s2 += p64 * r64
                    s3 += p64 * p64
                    s4 += (dp - dr) * (dp - dr)
            luma_reference[n, t] = y_reference
            luma[n, t] = y
        sums[n, 0] = s0
        sums[n, 1] = s1
        sums[n, 2] = s2
        sums[n, 3] = s3
        sums[n, 4] = s4


def whole_windows(mask):
    """Windows (rows - 10, cols - 10) that hold valid texels alone, of a mask (rows, cols)."""
    down = np.lib.stride_tricks.sliding_window_view(mask, WINDOW, axis=0).all(axis=-1)
    return np.lib.stride_tricks.sliding_window_view(down, WINDOW, axis=1).all(axis=-1)


@njit(cache=True, nogil=True, fastmath={"contract"})
def ssim_pictures(reference, pictures, whole, out):
    """Mean structural similarity of each picture over whole windows.

    Parameters
    ----------
    reference, pictures : (n, rows, cols) float32
        In [0, 1], at least 11 x 11.
    whole : (rows - 10, cols - 10) bool
        Windows that count; see `whole_windows`.
    out : (n,) float64
        Filled; not a number where no window counts.
    """
    _, rows, cols = reference.shape
    # in double precision: variances are small differences of these, and SSIM would exceed 1
    column = np.empty((5, cols))  # weighted sums down each column
    window = np.empty((5, cols - WINDOW + 1))
    for n in range(reference.shape[0]):
        total = 0.0
        count = 0
        for i in range(rows - WINDOW + 1):
            column[:] = 0
            for k in range(WINDOW):
                w = _WEIGHTS[k]
                for j in range(cols):
                    x = np.float64(reference[n, i + k, j])
                    y = np.float64(pictures[n, i + k, j])
                    column[0, j] += w * x
                    column[1, j] += w * y
                    column[2, j] += w * x * x
                    column[3, j] += w * y * y
                    column[4, j] += w * x * y
            window[:] = 0
            for q in range(5):
                for k in range(WINDOW):
                    w = _WEIGHTS[k]
                    for j in range(window.shape[1]):
                        window[q, j] += w * column[q, j + k]
            for j in range(window.shape[1]):
                if whole[i, j]:
                    mx = window[0, j]
                    my = window[1, j]
                    vx = window[2, j] - mx * mx
                    vy = window[3, j] - my * my
                    vxy = window[4, j] - mx * my
                    above = (2 * mx * my + _C1) * (2 * vxy + _C2)
                    below = (mx * mx + my * my + _C1) * (vx + vy + _C2)
                    total += above / below
                    count += 1
        out[n] = total / count if count else np.nan
