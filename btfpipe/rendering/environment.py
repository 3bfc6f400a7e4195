"""Environment maps: light from far away in every direction, and the lights that stand for it.

The map's own frame has y up and looks along -z: the middle of a picture shows -z, its right half +x, its top +y, as seen
from inside. Both projections are Debevec's. Latitude-longitude: columns go once around from +z over -x, -z (the middle) and +x back
to +z, rows run from +y to -y in equal angles. Angular probe: the angle from -z grows linearly from the middle of a square to the
inscribed circle, on which every point is +z.
"""

import heapq

import numpy as np

from btfpipe.compiled import njit
from btfpipe.errors import InputError
from btfpipe.hashing import uniform

METHODS = ("q2tree", "median-cut", "alias")
PROJECTIONS = ("latlong", "probe")
PIXEL_BYTES = 210  # of a map while it is made into lights, as measured
KEPT_PIXEL_BYTES = 16  # and from then on
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709
_DEPTH = 16  # levels of the quadtree, far finer than any map's pixels
_QUADS = 12
_SPREAD = 0.25  # exponent of a region's solid angle in its importance (Agarwal et al. 2003)


class Environment:
    """A map of the radiance that comes from each direction of the scene.

    Parameters
    ----------
    values : (rows, cols, 3) floats
        Radiance, linear RGB.
    projection : str, optional
        ``latlong`` or ``probe``; without it, maps twice as wide as high are the former, squares the latter.
    intensity : float
        Factor on the radiance.
    turn : (3, 3) array, optional
        Rotation from the map's frame to the scene's.
    visible : bool
        Whether it is seen where a ray hits nothing.
    name : str
        What messages call the map.

    Attributes
    ----------
    values : (rows, cols, 3) float32
        Radiance, `intensity` included.
    projection : str
    turn : (3, 3) float64
    visible : bool
    name : str

    Raises
    ------
    InputError
        If the values are not a floating-point picture, are negative or not finite, or do not fit the projection.
    """

    def __init__(self, values, projection=None, *, intensity=1.0, turn=None, visible=True, name=""):
        values = np.asarray(values)
        if values.dtype.kind != "f":
            raise InputError(
                f"{name}: a picture of {values.dtype} codes; expected radiance in floating point (.hdr or .exr)."
            )
        rows, cols = values.shape[:2]
        if projection is None:
            projection = {2 * rows: "latlong", rows: "probe"}.get(cols)
        if projection is None:
            raise InputError(
                f"{name}: {cols} x {rows} pixels; expected twice as wide as high (latitude-longitude) or a square"
                " (angular probe). Give projection."
            )
        if projection == "probe" and (rows != cols or rows < 4):
            raise InputError(
                f"{name}: {cols} x {rows} pixels; an angular probe is a square of at least 4 x 4."
            )
        self.projection, self.visible, self.values = projection, visible, values
        self.name = name
        self.turn = np.eye(3) if turn is None else np.asarray(turn, float)
        self._used = self._grid()[1] > 0
        _require_radiance(values, self._used, name)
        with np.errstate(over="ignore"):
            self.values = values.astype(np.float32) * np.float32(intensity)
        _require_radiance(self.values, self._used, f"{name} times intensity {intensity:g}")
        if projection == "probe":
            _fill_outside(self.values)

    def _grid(self):
        rows, cols = self.values.shape[:2]
        return (_latlong_pixels if self.projection == "latlong" else _probe_pixels)(rows, cols)

    def pixels(self):
        """The map as a list of its pixels; of a probe, of those inside the circle.

        Returns
        -------
        directions : (n, 3) float64
            Towards the pixels' centres, in the scene.
        solid_angles : (n,) float64
            Steradians; they sum to 4 pi.
        radiances : (n, 3) float64
        """
        own, solid_angles = self._grid()
        used = self._used
        return (
            _turned(own[used], self.turn),
            solid_angles[used],
            self.values[used].astype(np.float64),
        )

    @property
    def power(self):
        """Integral of the radiance over the sphere, (3,) float64: the sum of the irradiances of its lights."""
        _, solid_angles, radiances = self.pixels()
        return solid_angles @ radiances

    def radiance(self, directions):
        """Radiance (..., 3) float64 from unit vectors (..., 3) of the scene, bilinear between the pixels."""
        own = _turned(np.asarray(directions, float), self.turn.T)
        rows, cols = self.values.shape[:2]
        x, y, z = own[..., 0], own[..., 1], np.clip(own[..., 2], -1, 1)
        if self.projection == "latlong":
            col = (np.arctan2(x, -z) / (2 * np.pi) + 0.5) * cols - 0.5
            row = np.arccos(np.clip(y, -1, 1)) / np.pi * rows - 0.5
        else:
            # hypot rather than arccos: exact near the middle and the rim
            across = np.hypot(x, y)
            radius = np.arctan2(across, -z) / np.pi / np.maximum(across, 1e-30)
            col = (1 + x * radius) * cols / 2 - 0.5
            row = (1 - y * radius) * rows / 2 - 0.5
        row = np.clip(row, 0, rows - 1)
        if self.projection == "probe":
            col = np.clip(col, 0, cols - 1)
        i, j = np.floor(row).astype(np.int64), np.floor(col).astype(np.int64)
        v, u = (row - i)[..., None], (col - j)[..., None]
        below, right, j = np.minimum(i + 1, rows - 1), (j + 1) % cols, j % cols
        return (1 - v) * ((1 - u) * self.values[i, j] + u * self.values[i, right]) + v * (
            (1 - u) * self.values[below, j] + u * self.values[below, right]
        )

    def integrate(self, function):
        """Integral over the sphere of ``function(directions) * radiance``, pixel by pixel: the reference of all methods.

        Parameters
        ----------
        function : callable
            Takes directions (n, 3) of the scene; returns factors (n,) or (n, 3).

        Returns
        -------
        (3,) float64
        """
        directions, solid_angles, radiances = self.pixels()
        factor = np.asarray(function(directions), float)
        return solid_angles @ (factor.reshape(len(directions), -1) * radiances)

    def lights(self, count, method="q2tree", seed=0):
        """Directional lights that stand for the map.

        The lights of ``q2tree`` and ``median-cut`` carry the integral of the radiance over one region each, so that their sum is
        the map's power up to rounding; a region's light comes from its mean direction, weighted by luminance. The regions
        belong to the map and turn with it. Regions without light are left out.

        Parameters
        ----------
        count : int
            Most lights; 12 at least for ``q2tree``.
        method : str
            ``q2tree``: a quadtree over the sphere, after Wan, Wong and Leung 2005; roots and importance are chosen here. Its roots
            are the twelve curvilinear quadrilaterals of HEALPix (Górski et al. 2005), which halve along both of their sides into
            four of equal area; the region of the largest importance, luminous power times solid angle to 1/4 (Agarwal et al. 2003),
            is split as long as `count` allows. Deterministic.
            ``median-cut``: Debevec 2005, regions of equal luminous power by repeated cuts across the longer side. Deterministic. For
            counts that are not powers of two, power is cut in proportion to the lights on each side.
            ``alias``: random pixels by luminous power (Walker's alias table as Vose 1991 builds it), weighted so that the
            expectation of every integral is right.
        seed : int
            Of ``alias``.

        Returns
        -------
        directions : (n, 3) float64
            Unit vectors towards the lights, in the scene.
        irradiances : (n, 3) float64
            Of a surface that faces the light.

        Raises
        ------
        InputError
            If the count is too small for the method, or there is no such method.
        """
        if method not in METHODS:
            raise InputError(f"method {method!r}; expected {', '.join(METHODS)}.")
        least = _QUADS if method == "q2tree" else 1
        if count < least:
            raise InputError(f"lights: {count}; {method} needs at least {least}.")
        # regions are those of the unturned map, whatever the turn
        own, solid_angles = (a[self._used] for a in self._grid())
        power = solid_angles[:, None] * self.values[self._used]
        luminous = (power * _LUMINANCE).sum(axis=1)
        if not luminous.any():
            return np.empty((0, 3)), np.empty((0, 3))
        if method == "alias":
            pixel, times = np.unique(_draw(luminous, count, seed), return_counts=True)
            share = times / count * luminous.sum() / luminous[pixel]
            return _turned(own[pixel], self.turn), power[pixel] * share[:, None]
        order, first = (_q2tree if method == "q2tree" else _median_cut)(own, luminous, count)
        power, luminous, own = power[order], luminous[order], own[order]
        mean = np.add.reduceat(luminous[:, None] * own, first)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        # a region's light can come from opposite sides alike
        mean = np.where(length > 0, mean / np.maximum(length, 1e-300), own[first])
        irradiance = np.add.reduceat(power, first)
        lit = irradiance.any(axis=1)
        return _turned(mean[lit], self.turn), irradiance[lit]


def _turned(directions, turn):
    """Directions (..., 3) by a rotation; without BLAS, whose rounding may change with its threads."""
    return np.einsum("...j,kj->...k", directions, turn)


def _require_radiance(values, used, name):
    """Refuse negative, NaN and infinite pixels."""
    for what, bad in (
        ("not finite", ~np.isfinite(values)),
        ("negative", values < 0),
    ):
        bad = bad.any(axis=2) & used
        if bad.any():
            row, col = np.argwhere(bad)[0]
            found = ", ".join(f"{x:g}" for x in values[row, col])
            raise InputError(
                f"{name}: {int(bad.sum())} pixels are {what}, the first in row {row}, column {col} ({found}); expected"
                " radiance, finite and not negative. Repair them in an image editor."
            )


def _latlong_pixels(rows, cols):
    """Directions (rows, cols, 3) of the pixels' centres and their solid angles (rows, cols)."""
    edge = np.cos(np.pi * np.arange(rows + 1) / rows)
    solid_angle = np.repeat((edge[:-1] - edge[1:])[:, None] * 2 * np.pi / cols, cols, axis=1)
    polar = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    azimuth = 2 * np.pi * ((np.arange(cols) + 0.5) / cols - 0.5)  # from -z towards +x
    own = [
        np.sin(polar) * np.sin(azimuth),
        np.cos(polar) + 0 * azimuth,
        -np.sin(polar) * np.cos(azimuth),
    ]
    return np.stack(own, axis=-1), solid_angle


def _probe_pixels(rows, cols):
    """As `_latlong_pixels`; solid angles are 0 outside the circle.

    That of a pixel at radius r is its area times ``pi^2 sinc r``; scaled by the little that makes the sum 4 pi.
    """
    x = ((np.arange(cols) + 0.5) * 2 / cols - 1)[None, :]
    y = (1 - (np.arange(rows) + 0.5) * 2 / rows)[:, None]
    radius = np.hypot(x, y)
    polar = np.pi * radius
    across = np.pi * np.sinc(radius)
    own = np.stack([across * x, across * y, -np.cos(polar)], axis=-1)
    solid_angle = np.where(radius < 1, np.sinc(radius), 0)
    return own, solid_angle * (4 * np.pi / solid_angle.sum())


def _fill_outside(values):
    """Give the pixels outside a probe's circle their neighbours' values, so that interpolation at the rim stays inside."""
    n = len(values)
    place = (np.arange(n) + 0.5) * 2 / n - 1
    radius = np.hypot(place[:, None], place)
    i, j = np.nonzero(radius >= 1)
    # two thirds of a pixel inside of the rim at the most, after rounding
    scale = (1 - 2 / n) / radius[i, j]
    from_i, from_j = (((place[k] * scale + 1) * n / 2 - 0.5).round().astype(int) for k in (i, j))
    values[i, j] = values[from_i, from_j]


def healpix(directions):
    """Places on the sphere's twelve base quadrilaterals, equal areas in equal areas.

    Górski et al. 2005, section 4: four quadrilaterals around the north pole, four along the equator, four around the south
    pole; between z = 2/3 and -2/3 their sides are straight in (azimuth, z), towards the poles azimuth shrinks with
    ``sqrt(3 (1 - |z|))``.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit vectors; the pole is y here, azimuth runs from z towards x.

    Returns
    -------
    quad : (n,) int64
        0 to 11.
    u, v : (n,) float64
        Place along its sides, 0 to 1.
    """
    height = directions[:, 1]
    azimuth = np.arctan2(directions[:, 0], directions[:, 2]) / (np.pi / 2) % 4
    # quadrilaterals are counted by the diagonals that bound them
    up, down = azimuth + 0.5 - 0.75 * height, azimuth + 0.5 + 0.75 * height
    i, j = np.floor(up).astype(np.int64), np.floor(down).astype(np.int64)
    quad = np.where(i == j, i % 4 + 4, np.where(i < j, i % 4, j % 4 + 8))
    u, v = down - j, 1 - (up - i)
    cap = np.abs(height) > 2 / 3
    sector = np.minimum(azimuth.astype(np.int64), 3)
    shrink = np.sqrt(np.maximum(3 * (1 - np.abs(height)), 0))
    left, right = (azimuth - sector) * shrink, (1 - (azimuth - sector)) * shrink
    north = height > 0
    quad = np.where(cap, np.where(north, sector, sector + 8), quad)
    u = np.where(cap, np.where(north, 1 - right, left), u)
    v = np.where(cap, np.where(north, 1 - left, right), v)
    return quad, u, v


def _q2tree(directions, luminous, count):
    """Leaves of the quadtree: an order (n,) of the pixels, and where in it each leaf starts, (leaves,)."""
    quad, u, v = healpix(directions)
    side = 1 << _DEPTH
    code = quad
    i, j = (np.minimum((a * side).astype(np.int64), side - 1) for a in (u, v))
    for bit in range(_DEPTH - 1, -1, -1):
        code = 4 * code + 2 * (i >> bit & 1) + (j >> bit & 1)
    order = np.argsort(code, kind="stable")
    code = code[order]
    sums = np.concatenate([[0], np.cumsum(luminous[order])])

    def node(number, level):
        """A cell of the tree, by the range of its pixels; the heap gives the most important first."""
        step = 4 ** (_DEPTH - level)
        first, last = np.searchsorted(code, [number * step, (number + 1) * step])
        # a single pixel is not split, nor equal ones in one place
        whole = last <= first or code[first] == code[last - 1]
        importance = 0.0 if whole else (sums[last] - sums[first]) * 4.0 ** (-_SPREAD * level)
        return (-importance, number, level, int(first), int(last))

    heap = [node(number, 0) for number in range(_QUADS)]
    heap = [leaf for leaf in heap if leaf[-1] > leaf[-2]]
    heapq.heapify(heap)
    while heap[0][0] < 0:
        _, number, level, _, _ = heap[0]
        parts = [node(4 * number + part, level + 1) for part in range(4)]
        parts = [part for part in parts if part[-1] > part[-2]]  # a part may lie between pixels
        if len(heap) - 1 + len(parts) > count:
            break
        heapq.heapreplace(heap, parts[0])
        for part in parts[1:]:
            heapq.heappush(heap, part)
    return order, np.array(sorted(first for *_, first, _ in heap))


def _median_cut(directions, luminous, count):
    """Regions of equal power; returns as `_q2tree`."""
    latitude = np.arcsin(np.clip(directions[:, 1], -1, 1))
    azimuth = np.arctan2(directions[:, 0], -directions[:, 2])
    order, starts = np.arange(len(directions)), []

    def cut(first, last, lights):
        if lights == 1 or last - first < 2:
            starts.append(first)
            return
        part = order[first:last]
        lat, lon = latitude[part], azimuth[part]
        middle = (lat.max() + lat.min()) / 2
        wide = np.ptp(lon) * np.cos(middle) > np.ptp(lat)
        part = part[np.lexsort((lat, lon) if wide else (lon, lat))]
        order[first:last] = part
        sums = np.cumsum(luminous[part])
        few = lights // 2
        at = first + 1 + int(np.abs(sums[:-1] - sums[-1] * few / lights).argmin())
        cut(first, at, few)
        cut(at, last, lights - few)

    cut(0, len(order), count)
    return order, np.array(starts)


def _draw(weight, count, seed):
    """Draw `count` items (count,) int64 in proportion to their weights."""
    n = len(weight)
    share = np.ascontiguousarray(weight * (n / weight.sum()))
    other = np.arange(n)
    stack = np.concatenate([np.flatnonzero(share < 1), np.flatnonzero(share >= 1)])
    _fill_alias(share, other, stack, int((share < 1).sum()))
    drawn = np.empty(count, np.int64)
    _draw_alias(share, other, seed, drawn)
    return drawn


@njit(cache=True, nogil=True)
def _fill_alias(share, other, stack, small):
    """Vose's table in place: item i is kept with probability share[i], else other[i] is taken.

    The stack of small items lies at the front of `stack`, whose first `small` they are; large ones follow.
    """
    n = len(share)
    large = small
    while small > 0 and large < n:
        small -= 1
        i = stack[small]
        j = stack[large]
        other[i] = j
        share[j] -= 1.0 - share[i]
        if share[j] < 1.0:
            stack[small] = j
            small += 1
            large += 1
    # what is left is 1 but for rounding
    for k in range(small):
        share[stack[k]] = 1.0
    for k in range(large, n):
        share[stack[k]] = 1.0


@njit(cache=True, nogil=True)
def _draw_alias(share, other, seed, drawn):
    n = len(share)
    for k in range(len(drawn)):
        i = min(int(uniform(seed, k, 0) * n), n - 1)
        drawn[k] = i if uniform(seed, k, 1) < share[i] else other[i]
