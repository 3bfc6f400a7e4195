"""What a ray covers of the sample, and the texels of a `Pyramid` that stand for it.

A pixel's rays follow its reconstruction filter, each in a stratum of it. The mean and the variances of a stratum, taken to
the surface's tangent plane by ray differentials (Igehy 1999) and to texels by the local frame, are what the texture is
averaged over for that ray: the averages of all strata add up to the filter's own, so that nothing is averaged twice.

An elliptical footprint is read by several probes along its major axis, each as wide as the minor axis (McCormack et al. 1999,
*Feline*), between two levels whose variances enclose the minor axis's. All variances are in texels squared: level l adds
(4^l - 1) / 4 to that of level 0, a third of it by the means of texels and two thirds by reading between them.

That lights and views differ within a footprint is neglected: they turn by about the angle of a pixel.
"""

import copy

import numpy as np
from numba import njit

from btfpipe.compiled import leaf
from btfpipe.hashing import uniform
from btfpipe.parallel import blocks

ANISOTROPY = 16  # probes at most; a longer footprint is widened
PROBES = 1 << 14  # evaluated at a time
_LEAST = 0.03  # variance of a footprint, in texels squared, up to which it is a point; whole from twice that on
_STEPS = 256  # of a stratum's integrals
_GRAZING = 1e-3  # cosine at which a tangent plane is seen from the side


def strata_moments(table, count):
    """Means and variances (count,) float64, in pixels, of the strata of a filter; see `camera.filter_table`."""
    if count == 1:
        at = (np.arange(len(table) * 4) + 0.5) / (len(table) * 4)
    else:
        at = (np.arange(count * _STEPS) + 0.5) / (count * _STEPS)
    offsets = np.interp(at * (len(table) - 1), np.arange(len(table)), table).reshape(count, -1)
    return offsets.mean(axis=1), offsets.var(axis=1)


@njit(cache=True, nogil=True)
def film_steps(
    hits, prim, directions, depth, vertices, faces, axes, step_x, step_y, perspective, over_x, over_y
):  # fmt: skip
    """Steps (n, 3) float64 on the tangent plane of each hit, in scene units, for a pixel to the right and one down.

    Parameters
    ----------
    hits, prim, directions, vertices, faces
        As for `kernels.surface_points`.
    depth : (n,) float64
        Distance along the ray.
    axes : (3, 3) float64
    step_x, step_y : float
        Change of ``right`` and ``up`` of a ray for a pixel.
    perspective : bool
    over_x, over_y : (n, 3) float64
        Filled in.
    """
    for h in range(len(hits)):
        ray = hits[h]
        f = prim[ray]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux = vertices[b, 0] - vertices[a, 0]
        uy = vertices[b, 1] - vertices[a, 1]
        uz = vertices[b, 2] - vertices[a, 2]
        vx = vertices[c, 0] - vertices[a, 0]
        vy = vertices[c, 1] - vertices[a, 1]
        vz = vertices[c, 2] - vertices[a, 2]
        nx = uy * vz - uz * vy
        ny = uz * vx - ux * vz
        nz = ux * vy - uy * vx
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-300
        facing = (nx * dx + ny * dy + nz * dz) / length
        if abs(facing) < _GRAZING:
            facing = _GRAZING if facing >= 0 else -_GRAZING
        scale = 1.0
        if perspective:
            scale = depth[h] * (dx * axes[2, 0] + dy * axes[2, 1] + dz * axes[2, 2])
        for k in range(2):
            by = scale * (step_x if k == 0 else step_y)
            x, y, z = by * axes[k, 0], by * axes[k, 1], by * axes[k, 2]
            along = (nx * x + ny * y + nz * z) / length / facing
            out = over_x if k == 0 else over_y
            out[h, 0] = x - along * dx
            out[h, 1] = y - along * dy
            out[h, 2] = z - along * dz


@njit(cache=True, nogil=True)
def film_offsets(pixels, rows, cols, table, seed, mean_x, mean_y, shift):
    """From each ray to the mean of its stratum, in pixels (n, 2) float64; rays as `kernels.camera_rays` makes them."""
    samples = rows * cols
    last = len(table) - 1
    for h in range(len(pixels)):
        if samples == 1:
            shift[h, :] = 0.0
            continue
        s = pixels[h] % samples
        u = (s % cols + uniform(seed, pixels[h], 0)) / cols
        v = (s // cols + uniform(seed, pixels[h], 1)) / rows
        i = min(int(u * last), last - 1)
        j = min(int(v * last), last - 1)
        shift[h, 0] = mean_x[s % cols] - table[i] - (u * last - i) * (table[i + 1] - table[i])
        shift[h, 1] = mean_y[s // cols] - table[j] - (v * last - j) * (table[j + 1] - table[j])


@leaf
def choose_probes(vxx, vxy, vyy, top, out):
    """Level, share of the level above, number of probes and the step (row, col) between them: fill `out` (5,) float64.

    The footprint's variances `vxx` (rows), `vyy` (cols) and covariance `vxy` are in texels squared; `top` is the coarsest level.
    """
    middle = (vxx + vyy) / 2
    spread = np.sqrt((vxx - vyy) ** 2 / 4 + vxy * vxy)
    major = middle + spread
    minor = max(middle - spread, 0.0)
    most = ANISOTROPY * ANISOTROPY - 1.0
    # n probes a step d apart add d^2 (n^2 - 1) / 12; d is at most a texel of the level
    least = (12 * major - most) / (12 + 4 * most)
    minor = max(minor, least)
    extra = major - minor
    count = np.sqrt(1 + 12 * max(extra, 0.0) / (1 + 4 * minor))
    if count < 1.25:
        minor = min(middle, major)
        count = 1.0
    else:
        count = min(np.ceil(count - 1e-9), float(ANISOTROPY))
    level = np.log2(1 + 4 * minor) / 2
    below = int(level)
    share = 0.0
    if below >= top:
        below = top
        count = 1.0
    else:
        power = 4.0**below
        share = (minor - (power - 1) / 4) / (0.75 * power)
        if share < 0.06:
            share = 0.0
        elif share > 0.94:
            share = 0.0
            below += 1
    out[0] = below
    out[1] = share
    out[2] = count
    out[3] = 0.0
    out[4] = 0.0
    if count > 1.0:
        step = np.sqrt(12 * extra / (count * count - 1))
        # the eigenvector of the larger eigenvalue, from the row of the matrix that is farther from 0
        x, y = vxy, major - vxx
        if vxx >= vyy:
            x, y = major - vyy, vxy
        length = np.sqrt(x * x + y * y)
        if length > 0.0:
            out[3] = step * x / length
            out[4] = step * y / length


@leaf
def _fill_footprints(
    target, corner, at_x, at_y, texels_per_unit, shift, variance, top, chosen, row, col, level, share,
    count, steps,
):  # fmt: skip
    """Fill level, share, count and steps of look-ups, and shift `row` and `col`; returns whether any is more than a point."""
    any_ = False
    for q in range(len(target)):
        h = target[q]
        # row runs against t
        rx = -texels_per_unit * at_x[q, 1]
        ry = -texels_per_unit * at_y[q, 1]
        cx = texels_per_unit * at_x[q, 0]
        cy = texels_per_unit * at_y[q, 0]
        vxx = rx * rx * variance[h, 0] + ry * ry * variance[h, 1]
        vxy = rx * cx * variance[h, 0] + ry * cy * variance[h, 1]
        vyy = cx * cx * variance[h, 0] + cy * cy * variance[h, 1]
        major = (vxx + vyy) / 2 + np.sqrt((vxx - vyy) ** 2 / 4 + vxy * vxy)
        whole = min(max(major / _LEAST - 1, 0.0), 1.0)
        level[q] = 0
        share[q] = 0
        count[q] = 1
        steps[q, 0] = 0
        steps[q, 1] = 0
        if not whole > 0.0:
            continue
        any_ = True
        choose_probes(whole * vxx, whole * vxy, whole * vyy, top, chosen)
        level[q] = int(chosen[0])
        share[q] = chosen[1]
        count[q] = int(chosen[2])
        steps[q, 0] = chosen[3]
        steps[q, 1] = chosen[4]
        if corner[q] < 0:
            row[q] += whole * (rx * shift[h, 0] + ry * shift[h, 1])
            col[q] += whole * (cx * shift[h, 0] + cy * shift[h, 1])
    return any_


@leaf
def _count_probes(chosen, count, share, ends):
    """Fill the running number of probes `ends` (n,) of look-ups."""
    total = 0
    for q in range(len(chosen)):
        i = chosen[q]
        total += count[i] * (2 if share[i] > 0 else 1)
        ends[q] = total


@leaf
def _list_probes(chosen, row, col, level, share, count, steps, owner, at_row, at_col, at_level, weight):
    """List the probes of look-ups: whose they are (numbered along `chosen`), coordinates of level 0, level, and weight."""
    n = 0
    for q in range(len(chosen)):
        i = chosen[q]
        for above in range(2 if share[i] > 0 else 1):
            part = share[i] if above else 1.0 - share[i]
            for k in range(count[i]):
                by = k - (count[i] - 1) / 2
                owner[n] = q
                at_row[n] = row[i] + by * steps[i, 0]
                at_col[n] = col[i] + by * steps[i, 1]
                at_level[n] = level[i] + above
                weight[n] = part / count[i]
                n += 1


@leaf
def _add(values, owner, weight, out):
    for n in range(len(owner)):
        for k in range(out.shape[1]):
            out[owner[n], k] += weight[n] * values[n, k]


class Footprints:
    """Look-ups of an object, each with what it covers of the sample.

    Parameters
    ----------
    pyramid : Pyramid
    lookups : tuple
        row, col, at_i, at_o, blend, target, corner: what `kernels.gather_lookups` fills.
    at_x, at_y : (n, 3) float32
        The steps of `film_steps` in the look-ups' frames.
    texels_per_unit : float
    shift : (points, 2) float64
        See `film_offsets`.
    variance : (points, 2) float64
        Of the strata, across and down the film.

    Attributes
    ----------
    points : bool
        Whether no look-up is more than a point: then nothing is filtered.
    """

    def __init__(self, pyramid, row, col, target, corner, at_x, at_y, texels_per_unit, shift, variance):
        self.pyramid, self.target = pyramid, target
        n = len(row)
        self.row, self.col = row.copy(), col.copy()
        self.level, self.count = np.empty(n, np.int16), np.empty(n, np.int16)
        self.share, self.steps = np.empty(n, np.float32), np.empty((n, 2), np.float32)
        self.points = not _fill_footprints(
            target, corner, at_x, at_y, float(texels_per_unit), shift, variance, pyramid.top, np.empty(5),
            self.row, self.col, self.level, self.share, self.count, self.steps,
        )  # fmt: skip

    def average(self, chosen, evaluate, out):
        """Average over the footprints of some look-ups.

        Parameters
        ----------
        chosen : (m,) int
            Look-ups.
        evaluate : callable
            ``evaluate(shader, which, row, col)`` gives values (p, ...) at coordinates (p,) of a level's shader;
            `which` (p,) numbers them along `chosen`.
        out : (m, ...) float32
            Filled in place.
        """
        ends = np.empty(len(chosen), np.int64)
        _count_probes(chosen, self.count, self.share, ends)
        out[:] = 0
        flat = out.reshape(len(out), -1)
        start = 0
        while start < len(chosen):
            before = ends[start - 1] if start else 0
            stop = max(int(np.searchsorted(ends, before + PROBES, "right")), start + 1)
            n = ends[stop - 1] - before
            owner, level = np.empty(n, np.int64), np.empty(n, np.int16)
            row, col, weight = (np.empty(n, np.float32) for _ in range(3))
            _list_probes(
                chosen[start:stop], self.row, self.col, self.level, self.share, self.count, self.steps,
                owner, row, col, level, weight,
            )  # fmt: skip
            owner += start
            for number in np.unique(level):
                shader = self.pyramid.level(int(number))
                some = np.flatnonzero(level == number)
                which = owner[some]
                values = evaluate(
                    shader, which, *self._coordinates(shader, number, row[some], col[some])
                )
                _add(values.reshape(len(values), -1), which, weight[some], flat)
            start = stop

    def _coordinates(self, shader, number, row, col):
        """Coordinates of level 0 on another level."""
        if not number:
            return row, col
        rows, cols = self.pyramid.appearance.shape
        return (
            ((row + 0.5) * (shader.rows / rows) - 0.5).astype(np.float32),
            ((col + 0.5) * (shader.cols / cols) - 0.5).astype(np.float32),
        )

    def shade(self, chosen, w_i, w_o, out):
        """Fill `out` (m, 3) float32 with what some look-ups show; see `Appearance.shader`."""

        def evaluate(shader, which, row, col):
            values = np.empty((len(which), 3), np.float32)
            shader.shade(row, col, w_i[which], w_o[which], values)
            return values

        self.average(chosen, evaluate, out)

    def slices(self, w_o):
        """What all look-ups show whatever the light; see `Appearance.shader`."""

        def evaluate(shader, which, row, col):
            return shader.slices(row, col, w_o[which]).values

        shader = self.pyramid.level(0)
        whole = shader.slices(self.row[:0], self.col[:0], w_o[:0])
        whole.values = np.empty((len(self.row), *whole.values.shape[1:]), np.float32)
        self.average(np.arange(len(self.row)), evaluate, whole.values)
        return whole

    def shade_sky(self, sky, frames, w_o, out, visibility):
        """Fill `out` with the light of a `HarmonicEnvironment`; arguments as for its ``shade``."""

        def evaluate(shader, which, row, col):
            values = np.empty((len(which), 3), np.float32)
            level = copy.copy(sky)
            level.shader = shader
            level.shade(row, col, frames[which], w_o[which], values, visibility[which])
            return values

        self.average(np.arange(len(self.row)), evaluate, out)
