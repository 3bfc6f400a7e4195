"""Between CIE XYZ and linear Rec. 709, both with white D65."""

import numpy as np

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
