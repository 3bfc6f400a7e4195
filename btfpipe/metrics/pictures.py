"""Errors of one picture, or of a stack, against a reference of the same shape."""

import math

import numpy as np

from btfpipe.errors import InputError
from btfpipe.metrics.kernels import WINDOW, encode_table, ssim_pictures, whole_windows
from btfpipe.sample.transfer import encode

LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


def _pair(reference, picture):
    reference, picture = np.asarray(reference), np.asarray(picture)
    if reference.shape != picture.shape:
        raise InputError(
            f"pictures have shapes {picture.shape} and {reference.shape}; expected equal ones."
        )
    return reference, picture


def mean_squared_error(reference, picture):
    """Mean of (picture - reference)^2 over everything; the unit of the values, squared."""
    reference, picture = _pair(reference, picture)
    return float(np.square(np.subtract(picture, reference, dtype=np.float64)).mean())


def rmse(reference, picture):
    """Root of the mean of (picture - reference)^2 over all pixels and channels; the unit of the values."""
    return math.sqrt(mean_squared_error(reference, picture))


def psnr(error, peak=1.0):
    """Peak signal-to-noise ratio 20 log10(peak / error), dB, of an RMS error; infinite if there is none.

    Parameters
    ----------
    error : float
        RMS error, in the unit of the peak.
    peak : float
        The largest value that counts.
    """
    return math.inf if error == 0 else 20 * math.log10(peak / error)


def relative_error(reference, picture):
    """Norm of the error over norm of the reference: sqrt(sum (p - r)^2 / sum r^2); 1 is 100 %."""
    reference, picture = _pair(reference, picture)
    energy = float(np.square(reference, dtype=np.float64).mean())
    error = mean_squared_error(reference, picture)
    if energy == 0:
        return 0.0 if error == 0 else math.inf
    return math.sqrt(error / energy)


def to_display(values, white=1.0):
    """Display values in [0, 1]: linear values over `white`, clipped, by the sRGB curve (IEC 61966-2-1)."""
    return encode(np.clip(np.asarray(values, np.float64) / white, 0, 1), "srgb")


def ssim(reference, picture):
    """Structural similarity of two grey display pictures (Wang et al. 2004, equation 13, section III.C).

    Mean over all 11 x 11 windows that lie inside, weighted by a Gaussian of 1.5 pixels; K1 = 0.01, K2 = 0.03,
    range 1. No downscaling.

    Parameters
    ----------
    reference, picture : (rows, cols)
        Values in [0, 1]; at least 11 pixels each way.

    Returns
    -------
    float
        At most 1, which is identity.
    """
    reference, picture = _pair(reference, picture)
    if reference.ndim != 2 or min(reference.shape) < WINDOW:
        raise InputError(
            f"pictures have shape {reference.shape}; SSIM needs (rows, cols) of at least"
            f" {WINDOW} x {WINDOW}."
        )
    stacks = [np.ascontiguousarray(p[None], np.float32) for p in (reference, picture)]
    out = np.empty(1)
    ssim_pictures(*stacks, whole_windows(np.ones(reference.shape, bool)), out)
    return float(out[0])


__all__ = [
    "LUMA",
    "encode_table",
    "mean_squared_error",
    "psnr",
    "relative_error",
    "rmse",
    "ssim",
    "to_display",
]
