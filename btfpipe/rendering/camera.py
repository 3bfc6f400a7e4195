"""Cameras, and the filter that spreads their rays over the film."""

from dataclasses import dataclass

import numpy as np

from btfpipe.errors import InputError

FILTER_RADIUS = {"box": 0.5, "tent": 1.0, "gaussian": 1.5}
_TABLE = 1024


@dataclass
class Camera:
    """A pinhole or an orthographic camera.

    Attributes
    ----------
    position : (3,) float64
        The pinhole, or a point of the plane that orthographic rays start from.
    axes : (3, 3) float64
        Rows: right, up, forward; orthonormal.
    extent : (float, float)
        Half width and half height of the picture: at distance 1, or in scene units if orthographic.
    perspective : bool
    """

    position: np.ndarray
    axes: np.ndarray
    extent: tuple
    perspective: bool


def make_camera(description, aspect, points):
    """Make a Camera of its description.

    Parameters
    ----------
    description : dict
        The scene's ``camera``.
    aspect : float
        Width of the picture over its height.
    points : (n, 3) float64
        What automatic framing has to fit in: the vertices of the dressed objects.

    Raises
    ------
    InputError
        If the position and direction contradict, or are degenerate.
    """
    kind = description["type"]
    up = np.array(description.get("up", [0, 1, 0]), float)
    for key in {"perspective": ("height",), "orthographic": ("fov_deg",)}[kind]:
        if key in description:
            raise InputError(f"camera: {key} does not belong to an {kind} camera.")
    placed = "position" in description and "target" in description
    framed = "direction" in description
    if placed == framed or ("position" in description) != ("target" in description):
        raise InputError(
            "camera: give either position and target, or direction for automatic framing."
        )
    if placed:
        if "margin" in description:
            raise InputError("camera: margin belongs to automatic framing, with direction.")
        position = np.array(description["position"], float)
        forward = np.array(description["target"], float) - position
    else:
        forward = -np.array(description["direction"], float)
    axes = _axes(forward, up)
    half = np.tan(np.radians(description.get("fov_deg", 35)) / 2)
    if kind == "perspective":
        extent = np.array([half * aspect, half])
        if framed:
            position = _frame_perspective(points, axes, extent, description.get("margin", 0.08))
        return Camera(position, axes, tuple(extent), True)
    if framed:
        local = points @ axes.T
        low, high = local.min(axis=0), local.max(axis=0)
        middle = (low + high) / 2
        # a whole diagonal in front of the nearest point
        middle[2] = low[2] - np.linalg.norm(high - low)
        position = middle @ axes
        need = max((high[0] - low[0]) / aspect, high[1] - low[1])
        height = description.get("height", need / (1 - description.get("margin", 0.08)))
    else:
        height = description.get("height")
        if height is None:
            raise InputError("camera: an orthographic camera with a position needs its height.")
    return Camera(position, axes, (height * aspect / 2, height / 2), False)


def _axes(forward, up):
    """Right, up and forward as rows."""
    length = np.linalg.norm(forward)
    right = np.cross(forward, up)
    if length < 1e-12 or np.linalg.norm(right) < 1e-9 * length * max(np.linalg.norm(up), 1e-12):
        raise InputError(
            "camera: it looks along its up direction, or nowhere; choose another up, target or direction."
        )
    forward = forward / length
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _frame_perspective(points, axes, extent, margin):
    """The pinhole nearest to the points from which all of them are in the picture.

    With x, z right and forward of the pinhole, a point is inside if |x| <= k z; the tightest bounds of both
    sides meet at the pinhole's place along each axis.
    """
    local = points @ axes.T
    depth = []
    place = np.zeros(3)
    for axis in (0, 1):
        k = extent[axis] * (1 - margin)
        right = (local[:, axis] / k - local[:, 2]).max()
        left = (-local[:, axis] / k - local[:, 2]).max()
        place[axis] = k * (right - left) / 2
        depth.append(-(right + left) / 2)
    place[2] = min(depth)
    return place @ axes


def filter_table(kind, radius):
    """Inverse cumulative distribution (1025,) float64 of a separable filter: uniform number to offset in pixels.

    Rays that follow the filter's density and count equally give the filtered picture (Ernst, Stamminger and
    Greiner 2006), and a ray concerns one pixel only, so that tiles stay independent.
    """
    p = np.linspace(0, 1, _TABLE + 1)
    if kind == "box":
        return (2 * p - 1) * radius
    if kind == "tent":
        half = np.where(p < 0.5, np.sqrt(2 * p) - 1, 1 - np.sqrt(2 * (1 - p)))
        return half * radius
    from scipy.special import erf, erfinv

    sigma = radius / 3
    whole = erf(3 / np.sqrt(2))
    return np.clip(np.sqrt(2) * sigma * erfinv((2 * p - 1) * whole), -radius, radius)


def strata(samples):
    """Two factors of the number of rays a pixel, as near to each other as they come."""
    rows = max(n for n in range(1, int(np.sqrt(samples)) + 1) if samples % n == 0)
    return rows, samples // rows
