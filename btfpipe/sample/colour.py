"""Between CIE XYZ and linear Rec. 709, both with white D65; and from spectra."""

import numpy as np

from btfpipe.errors import InputError

_PRIMARIES = np.array(
    [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]]
)  # x, y of R, G and B: ITU-R BT.709
_WHITE = np.array([0.3127, 0.3290])  # x, y of D65


def _columns(xy):
    """XYZ with Y = 1 of chromaticities (..., 2), as columns."""
    x, y = np.moveaxis(xy, -1, 0)
    return np.stack([x / y, np.ones_like(x), (1 - x - y) / y])


# amounts of the primaries are such that R = G = B = 1 is white with Y = 1
RGB_TO_XYZ = _columns(_PRIMARIES) * np.linalg.solve(_columns(_PRIMARIES), _columns(_WHITE))
XYZ_TO_RGB = np.linalg.inv(RGB_TO_XYZ)


def rgb_to_xyz(values):
    """XYZ (..., 3) float32 of linear Rec. 709 values (..., 3); white has Y = 1."""
    return np.asarray(values, np.float32) @ RGB_TO_XYZ.T.astype(np.float32)


def xyz_to_rgb(values):
    """Linear Rec. 709 values (..., 3) float32 of XYZ (..., 3); colours outside its gamut come out negative."""
    return np.asarray(values, np.float32) @ XYZ_TO_RGB.T.astype(np.float32)


_NANOMETRES = np.arange(380.0, 781.0)
# Relative power of CIE illuminant D65, 380 to 780 nm in steps of 10 (ISO 11664-2)
_D65 = (
    49.9755, 54.6482, 82.7549, 91.486, 93.4318, 86.6823, 104.865, 117.008, 117.812, 114.861, 115.923, 108.811, 109.354, 107.802,
    104.79, 107.689, 104.405, 104.046, 100.0, 96.3342, 95.788, 88.6856, 90.0062, 89.5991, 87.6987, 83.2886, 83.6992, 80.0268,
    80.2146, 82.2778, 78.2842, 69.7213, 71.6091, 74.349, 61.604, 69.8856, 75.087, 63.5927, 46.4182, 66.8054, 63.3828,
)  # fmt: skip
# Height, place, and fall to either side of the lobes that make the CIE 1931 colour matching functions x, y and z, within 2.4 % of
# their largest (Wyman, Sloan and Shirley 2013, multi-lobe fit)
_LOBES = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)


def _matching():
    """Colour matching functions (3, nanometres)."""
    functions = np.zeros((3, len(_NANOMETRES)))
    for function, lobes in zip(functions, _LOBES, strict=True):
        for height, place, below, above in lobes:
            away = _NANOMETRES - place
            function += height * np.exp(-0.5 * (away / np.where(away < 0, below, above)) ** 2)
    return functions


def spectrum_to_rgb(wavelengths):
    """What reflectances at some wavelengths count as linear Rec. 709 values, seen under D65.

    Spectra are straight between their wavelengths and constant beyond them. 1 at all wavelengths is white: R = G = B = 1.

    Parameters
    ----------
    wavelengths : (n,)
        Nanometres, each another one, in any order.

    Returns
    -------
    (3, n) float64
        ``weights @ reflectances``; colours outside the gamut come out negative.

    Raises
    ------
    InputError
        If a wavelength comes twice, or fewer than three are between 400 and 700 nm: those show no colour.
    """
    wavelengths = np.asarray(wavelengths, float)
    order = np.argsort(wavelengths)
    known = wavelengths[order]
    twice = known[1:][np.diff(known) == 0]
    if len(twice):
        raise InputError(f"wavelength {twice[0]:g} nm comes twice.")
    visible = int(((known >= 400) & (known <= 700)).sum())
    if visible < 3:
        raise InputError(
            f"{visible} of {len(known)} wavelengths are between 400 and 700 nm; expected at least 3, which colours need."
        )
    upper = np.clip(np.searchsorted(known, _NANOMETRES), 1, len(known) - 1)
    part = np.clip((_NANOMETRES - known[upper - 1]) / (known[upper] - known[upper - 1]), 0, 1)
    light = np.interp(_NANOMETRES, np.arange(380, 781, 10), _D65)
    weights = np.empty((3, len(known)))
    for row, each in zip(weights, XYZ_TO_RGB @ (_matching() * light), strict=True):
        row[order] = np.bincount(upper - 1, each * (1 - part), len(known))
        row[order] += np.bincount(upper, each * part, len(known))
    return weights / weights.sum(axis=1, keepdims=True)
