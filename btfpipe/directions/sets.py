"""Measured sets of directions."""

import numpy as np

_BONN_STEPS_DEG = {0: 360, 15: 60, 30: 30, 45: 20, 60: 18, 75: 15}

# polar angle, number of azimuths, offset of the first azimuth, all in degrees
_UBO2014_RINGS_DEG = [
    (0, 1, 0), (11, 6, 15), (23.5, 12, 0), (30, 12, 15), (37.5, 12, 0),
    (45, 18, 0), (52.5, 18, 7.5), (60, 24, 0), (67.5, 24, 7.5), (75, 24, 0),
]  # fmt: skip


def from_angles(theta, phi):
    """Unit vectors (..., 3) from polar angle and azimuth in radians."""
    theta, phi = np.broadcast_arrays(np.asarray(theta, float), np.asarray(phi, float))
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)


def to_angles(directions):
    """Polar angle and azimuth in [0, 2 pi), radians, of unit vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(directions, float), -1, 0)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2 * np.pi)


def bonn81(degrees=False):
    """The 81 directions of Bonn's UBO2003 and ATRIUM sets (Sattler et al. 2003), lights and views alike.

    Returns
    -------
    ndarray
        (81, 3) unit vectors, or (81, 2) integer (theta, phi) in degrees.
    """
    angles = np.array(
        [(theta, phi) for theta, step in _BONN_STEPS_DEG.items() for phi in range(0, 360, step)]
    )
    return angles if degrees else from_angles(*np.radians(angles.T))


def ubo2014(degrees=False):
    """The 151 directions of Bonn's UBO2014 sets, as `bonn81`."""
    angles = np.array(
        [
            (theta, offset + 360 * i / count)
            for theta, count, offset in _UBO2014_RINGS_DEG
            for i in range(count)
        ]
    )
    return angles if degrees else from_angles(*np.radians(angles.T))


def nearest(directions, queries):
    """Index of the direction nearest in angle to each query: (n, 3), (m, 3) -> (m,)."""
    return np.argmax(np.asarray(queries, float) @ np.asarray(directions, float).T, axis=1)
