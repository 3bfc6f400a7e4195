"""The one place that turns steps in the local frame (s, t) into steps in (row, col), and back.

Row 0 is the top of the picture and the sample's t axis points up the picture, so row runs against t.
"""

import numpy as np

from btfpipe.compiled import njit


@njit(cache=True, inline="always")
def step_to_texels(ds, dt, angle):
    """Change of (row, col) for a local step of (ds, dt) texels where the sample lies at `angle`.

    Parameters
    ----------
    ds, dt : float
        Step along s and t, in texels.
    angle : float
        Angle of the sample's s axis in the local frame, counter-clockwise, radians.

    Returns
    -------
    drow, dcol : float
    """
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return ds * sine - dt * cosine, ds * cosine + dt * sine


@njit(cache=True, inline="always")
def texels_to_step(drow, dcol, angle):
    """Local step (ds, dt), in texels, of a change of (row, col); the inverse of `step_to_texels`."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return dcol * cosine + drow * sine, dcol * sine - drow * cosine
