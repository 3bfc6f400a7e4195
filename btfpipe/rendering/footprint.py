"""What a ray covers of the sample, and the texels of a `Pyramid` that stand for it.

A pixel's rays follow its reconstruction filter, each in a stratum of it. Where several texels share a pixel a ray no longer shows the
point that it hits: its look-up moves to the mean of its stratum, by ray differentials (Igehy 1999) on the surface's tangent
plane and by the local frame, and to a level whose texels leave no gap between neighbouring strata. What such a probe
is wider than its stratum the means are drawn together, so that all rays of a pixel add up to the variance of its filter: the
picture is neither noisier nor more blurred than with any number of rays.

An elliptical footprint is read by several probes along its major axis (McCormack et al. 1999, *Feline*). All variances are in
texels squared: a probe of level l has 5 / 12 (4^l - 1) more than one of level 0, three fifths by the low-pass of
the levels and two by reading between their texels.

That lights and views differ within a footprint is neglected: they turn by about the angle of a pixel. Inside triangles whose
vertices are blended there is no coordinate to move; each vertex is read at its own, as widely.
"""

import copy
import math

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.hashing import uniform

ANISOTROPY = 16  # probes at most; a longer footprint is widened
PROBES = 1 << 14  # evaluated at a time
_LEAST = 0.1  # variance of a pixel, in texels squared, up to which it is a point (0.63 texels); whole from twice that on
_SPLIT = 0.12  # variance that rays stand for, both axes, from which on strata are divided
_TEXTURE_RATE = 3.3  # texture rays along an axis of the film for a texel a pixel
MOST_TEXTURE_RAYS = 3  # of a ray along an axis
_MOST_PARTS = 3  # of a stratum along each axis
_WIDEST = 0.4  # standard deviation of a part over that of the filter
_ADDED = 5 / 12  # variance of level l: so often 4^l - 1
_TEXEL = 1 / 12  # variance that a texel of level 0 stands for
_WIDER = (
    3.0  # variance of a probe to that of what it stands for, so that neighbouring ones leave no gap
)
_ROOM = 0.5  # at most so much of a pixel's variance is a probe's own
_RAMP = (
    0.2,
    0.4,
)  # where between two levels the upper one comes in, and how fast: it is preferred, as it costs no less
_STEPS = 256  # of a stratum's integrals
_GRAZING = 1e-3  # cosine at which a tangent plane is seen from the side


def strata_parts(table, count):
    """Means and weights (2, count, parts) float64 of the parts of a filter's strata, in pixels; see `camera.filter_table`.

    A ray stands for its stratum. Strata that are wide, as the outer ones of a filter with tails are, are divided at their mean, again
    and again, so that all parts are about as wide; a part that a stratum lacks has weight 0, the others of one stratum add up to 1.
    """
    steps = max(_STEPS, 8 * len(table) // count)
    at = (np.arange(count * steps) + 0.5) / (count * steps)
    offsets = np.interp(at * (len(table) - 1), np.arange(len(table)), table)
    widest = _WIDEST * offsets.std()
    out = np.zeros((2, count, _MOST_PARTS))
    for stratum, values in enumerate(offsets.reshape(count, steps)):
        parts = [values]
        while len(parts) < _MOST_PARTS:
            wide = max(range(len(parts)), key=lambda k: parts[k].std())
            if parts[wide].std() <= widest:
                break
            part = parts[wide]
            parts[wide : wide + 1] = [part[part < part.mean()], part[part >= part.mean()]]
        out[0, stratum, : len(parts)] = [part.mean() for part in parts]
        out[1, stratum, : len(parts)] = [len(part) / steps for part in parts]
    return out


def filter_variance(table):
    """Variance of a filter, in pixels squared."""
    at = (np.arange(8 * len(table)) + 0.5) / (8 * len(table)) * (len(table) - 1)
    return float(np.interp(at, np.arange(len(table)), table).var())


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
def film_offsets(pixels, rows, cols, table, seed, offset, stratum):
    """Offset (n, 2) float64 of rays in their pixels, and its strata (n, 2) int64; rays as `kernels.camera_rays` makes them."""
    samples = rows * cols
    last = len(table) - 1
    for h in range(len(pixels)):
        s = pixels[h] % samples
        stratum[h, 0] = s % cols
        stratum[h, 1] = s // cols
        for axis in range(2):
            u = 0.5
            if samples > 1:
                u = (stratum[h, axis] + uniform(seed, pixels[h], axis)) / (rows if axis else cols)
            i = min(int(u * last), last - 1)
            offset[h, axis] = table[i] + (u * last - i) * (table[i + 1] - table[i])


@leaf
def count_texture_rays(mine, over_x, over_y, texels_per_unit, rows, cols, across, down):
    """Fill how many texture rays points of a mapped object need, `across` and `down` (m,) int64; returns their sum.

    One more than half a texel apart would miss what the map shows between them, up to `MOST_TEXTURE_RAYS` along an axis.
    """
    total = 0
    for q in range(len(mine)):
        h = mine[q]
        x = np.sqrt(over_x[h, 0] ** 2 + over_x[h, 1] ** 2 + over_x[h, 2] ** 2) * texels_per_unit
        y = np.sqrt(over_y[h, 0] ** 2 + over_y[h, 1] ** 2 + over_y[h, 2] ** 2) * texels_per_unit
        across[q] = int(min(max(np.ceil(_TEXTURE_RATE * x / cols), 1.0), MOST_TEXTURE_RAYS))
        down[q] = int(min(max(np.ceil(_TEXTURE_RATE * y / rows), 1.0), MOST_TEXTURE_RAYS))
        total += across[q] * down[q]
    return total


@njit(cache=True, nogil=True)
def texture_rays(
    pixels, mine, across, down, rows, cols, film_width, film_height, table, position, axes, extent,
    perspective, offset, parent, origins, directions,
):  # fmt: skip
    """Rays through the middles of equal parts of points' strata: fills parent (m,), origins and directions (m, 3).

    A point with one part keeps its own ray, `offset` in its pixel.
    """
    samples = rows * cols
    last = len(table) - 1
    n = 0
    for q in range(len(mine)):
        h = mine[q]
        pixel = pixels[h] // samples
        s = pixels[h] % samples
        for a in range(down[q]):
            for b in range(across[q]):
                dx = offset[h, 0]
                dy = offset[h, 1]
                if across[q] > 1 or down[q] > 1:
                    u = (s % cols + (b + 0.5) / across[q]) / cols
                    v = (s // cols + (a + 0.5) / down[q]) / rows
                    i = min(int(u * last), last - 1)
                    j = min(int(v * last), last - 1)
                    dx = table[i] + (u * last - i) * (table[i + 1] - table[i])
                    dy = table[j] + (v * last - j) * (table[j + 1] - table[j])
                right = ((pixel % film_width + 0.5 + dx) / film_width * 2.0 - 1.0) * extent[0]
                up = (1.0 - (pixel // film_width + 0.5 + dy) / film_height * 2.0) * extent[1]
                length = np.sqrt(1.0 + right * right + up * up)
                parent[n] = h
                for k in range(3):
                    if perspective:
                        origins[n, k] = position[k]
                        directions[n, k] = (
                            axes[2, k] + right * axes[0, k] + up * axes[1, k]
                        ) / length
                    else:
                        origins[n, k] = position[k] + right * axes[0, k] + up * axes[1, k]
                        directions[n, k] = axes[2, k]
                n += 1


@leaf
def choose_probes(wxx, wxy, wyy, wider, room, top, out):
    """Level, share of the level above, probes, and the step (row, col) between them: fill `out` (6,), variance of a probe last.

    Parameters
    ----------
    wxx, wxy, wyy : float
        Variances over rows and cols, and covariance, of what one part of a ray stands for, in texels squared.
    wider : float
        Variance of a probe to that of what it stands for.
    room : float
        Variance that a probe may have at most.
    top : int
        Coarsest level.
    """
    middle = (wxx + wyy) / 2
    spread = np.sqrt((wxx - wyy) ** 2 / 4 + wxy * wxy)
    major = middle + spread
    minor = max(middle - spread, 0.0)
    count = np.ceil(np.sqrt(major / max(minor, _TEXEL)) - 0.3)
    count = min(max(count, 1.0), float(ANISOTROPY))
    wanted = wider * max(minor, major / (ANISOTROPY * ANISOTROPY))
    if count == 1.0:
        wanted = wider * middle
    wanted = min(wanted, room)
    level = np.log2(1 + wanted / _ADDED) / 2
    below = int(level)
    share = min(max((level - below - _RAMP[0]) / _RAMP[1], 0.0), 1.0)
    power = 4.0**below
    if share > 0.0:
        share = min(share, max((room / _ADDED - (power - 1)) / (3 * power), 0.0))
    if share < 0.05:
        share = 0.0
    elif share > 0.95:
        share = 0.0
        below += 1
        power *= 4
    if below >= top:
        below = top
        share = 0.0
        count = 1.0
    out[0] = below
    out[1] = share
    out[2] = count
    out[3] = 0.0
    out[4] = 0.0
    out[5] = _ADDED * (power - 1 + 3 * power * share)
    if count > 1.0:
        step = np.sqrt(12 * major) / count
        # the eigenvector of the larger eigenvalue, from the row of the matrix that is farther from 0
        x, y = wxy, major - wxx
        if wxx >= wyy:
            x, y = major - wyy, wxy
        length = np.sqrt(x * x + y * y)
        if length > 0.0:
            out[3] = step * x / length
            out[4] = step * y / length


@leaf
def _root(matrix, out):
    """Fill `out` (3,) with the square root of a symmetric matrix ``(xx, xy, yy)``; what is below 0 in it counts as 0."""
    middle = (matrix[0] + matrix[2]) / 2
    spread = np.sqrt((matrix[0] - matrix[2]) ** 2 / 4 + matrix[1] * matrix[1])
    high = np.sqrt(max(middle + spread, 0.0))
    low = np.sqrt(max(middle - spread, 0.0))
    # root = a I + b M on both eigenvalues
    b = (high - low) / (2 * spread) if spread > 0.0 else 0.0
    a = high - b * (middle + spread)
    out[0] = a + b * matrix[0]
    out[1] = b * matrix[1]
    out[2] = a + b * matrix[2]


@leaf
def _congruent(a, m, out):
    """Fill `out` (3,) with A M A of symmetric matrices."""
    p = a[0] * m[0] + a[1] * m[1]
    q = a[0] * m[1] + a[1] * m[2]
    r = a[1] * m[0] + a[2] * m[1]
    s = a[1] * m[1] + a[2] * m[2]
    out[0] = p * a[0] + q * a[1]
    out[1] = p * a[1] + q * a[2]
    out[2] = r * a[1] + s * a[2]


@leaf
def transport(have, want, out, scratch):
    """Fill `out` (3,) with the symmetric T for which T have T = want, covariances ``(xx, xy, yy)``, the nearest to none.

    The optimal transport of one Gaussian to another. `scratch` is (3, 3).
    """
    root, inner, middle = scratch[0], scratch[1], scratch[2]
    _root(have, root)
    _congruent(root, want, inner)
    _root(inner, middle)
    determinant = root[0] * root[2] - root[1] * root[1]
    if determinant <= 1e-12 * (root[0] + root[2]) ** 2:
        out[0], out[1], out[2] = 1.0, 0.0, 1.0
        return
    inner[0] = root[2] / determinant
    inner[1] = -root[1] / determinant
    inner[2] = root[0] / determinant
    _congruent(inner, middle, out)


@leaf
def _covariance(rx, ry, cx, cy, across, down, out):
    """Fill `out` (3,) with the covariance over (row, col) of variances across and down the film."""
    out[0] = across * rx * rx + down * ry * ry
    out[1] = across * rx * cx + down * ry * cy
    out[2] = across * cx * cx + down * cy * cy


@leaf
def _fill_footprints(
    target, corner, at_x, at_y, texels_per_unit, offset, stratum, parts_x, parts_y, film, top, scratch, row,
    col, first, part_row, part_col, weight, level, share, count, steps,
):  # fmt: skip
    """List the parts of look-ups' footprints: those of look-up q from ``first[q]``; returns whether any is more than a point.

    `film` has the variance of the filter, those of the means of its strata and of the means of their parts, each across and down,
    and the means of the strata themselves. The arrays from `part_row` on have room for all parts; `scratch` is (8, 6).
    """
    chosen, have, want, move = scratch[0], scratch[1], scratch[2], scratch[3]
    any_ = False
    n = 0
    for q in range(len(target)):
        first[q] = n
        h = target[q]
        # row runs against t
        rx = -texels_per_unit * at_x[q, 1]
        ry = -texels_per_unit * at_y[q, 1]
        cx = texels_per_unit * at_x[q, 0]
        cy = texels_per_unit * at_y[q, 0]
        _covariance(rx, ry, cx, cy, film[0], film[0], want)
        middle = (want[0] + want[2]) / 2
        spread = np.sqrt((want[0] - want[2]) ** 2 / 4 + want[1] * want[1])
        whole = min(max((middle + spread) / _LEAST - 1, 0.0), 1.0)
        most = 1
        if whole > 0.0:
            any_ = True
            _covariance(rx, ry, cx, cy, film[1], film[2], have)
            wide = (want[0] - have[0]) + (want[2] - have[2]) > _SPLIT
            if wide and corner[q] < 0:
                most = parts_x.shape[2]
                _covariance(rx, ry, cx, cy, film[3], film[4], have)
            choose_probes(
                want[0] - have[0],
                want[1] - have[1],
                want[2] - have[2],
                _WIDER if corner[q] < 0 else 1.0,
                _ROOM * (middle - spread),
                top,
                chosen,
            )
            if corner[q] < 0:
                along = 1 - 1 / (chosen[2] * chosen[2])
                along *= chosen[2] * chosen[2] / 12  # of squared steps
                want[0] -= chosen[5] + along * chosen[3] * chosen[3]
                want[1] -= along * chosen[3] * chosen[4]
                want[2] -= chosen[5] + along * chosen[4] * chosen[4]
                transport(have, want, move, scratch[4:7, :3])
        for a in range(most):
            for b in range(most):
                weight[n] = 1.0
                if most > 1:
                    weight[n] = parts_x[1, stratum[h, 0], a] * parts_y[1, stratum[h, 1], b]
                    if weight[n] == 0.0:
                        continue
                part_row[n] = row[q]
                part_col[n] = col[q]
                level[n] = 0
                share[n] = 0
                count[n] = 1
                steps[n, 0] = 0
                steps[n, 1] = 0
                if whole > 0.0:
                    level[n] = int(chosen[0])
                    share[n] = chosen[1]
                    count[n] = int(chosen[2])
                    steps[n, 0] = chosen[3]
                    steps[n, 1] = chosen[4]
                    if corner[q] < 0:
                        x = parts_x[0, stratum[h, 0], a]
                        y = parts_y[0, stratum[h, 1], b]
                        if most == 1:
                            x = film[5 + stratum[h, 0]]
                            y = film[5 + parts_x.shape[1] + stratum[h, 1]]
                        u = rx * x + ry * y
                        v = cx * x + cy * y
                        x = move[0] * u + move[1] * v - rx * offset[h, 0] - ry * offset[h, 1]
                        y = move[1] * u + move[2] * v - cx * offset[h, 0] - cy * offset[h, 1]
                        part_row[n] += whole * x
                        part_col[n] += whole * y
                n += 1
    first[len(target)] = n
    return any_


@leaf
def _count_probes(chosen, first, count, share, ends):
    """Fill the running number of probes `ends` (n,) of look-ups."""
    total = 0
    for q in range(len(chosen)):
        for i in range(first[chosen[q]], first[chosen[q] + 1]):
            total += count[i] * (2 if share[i] > 0 else 1)
        ends[q] = total


@leaf
def _list_probes(
    chosen, first, row, col, part, level, share, count, steps, owner, at_row, at_col, at_level, weight
):  # fmt: skip
    """List the probes of look-ups: whose they are (numbered along `chosen`), coordinates of level 0, level, and weight."""
    n = 0
    for q in range(len(chosen)):
        for i in range(first[chosen[q]], first[chosen[q] + 1]):
            for above in range(2 if share[i] > 0 else 1):
                some = part[i] * (share[i] if above else 1.0 - share[i]) / count[i]
                for k in range(count[i]):
                    by = k - (count[i] - 1) / 2
                    owner[n] = q
                    at_row[n] = row[i] + by * steps[i, 0]
                    at_col[n] = col[i] + by * steps[i, 1]
                    at_level[n] = level[i] + above
                    weight[n] = some
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
    offset, stratum : (points, 2)
        See `film_offsets`.
    parts : tuple
        Of strata across and down; see `strata_parts`.
    variance : float
        See `filter_variance`.

    Attributes
    ----------
    target : (n,) int64
        The look-ups' points.
    points : bool
        Whether no look-up is more than a point: then nothing is filtered.
    """

    def __init__(
        self, pyramid, row, col, target, corner, at_x, at_y, texels_per_unit, offset, stratum, parts, variance
    ):  # fmt: skip
        self.pyramid, self.target = pyramid, target
        n = len(row) * math.prod(int((some[1] > 0).sum(axis=1).max()) for some in parts) + 1
        self.first = np.empty(len(row) + 1, np.int64)
        self.row, self.col, self.weight, self.share = (np.empty(n, np.float32) for _ in range(4))
        self.level, self.count = np.empty(n, np.int16), np.empty(n, np.int16)
        self.steps = np.empty((n, 2), np.float32)
        whole = [(some[0] * some[1]).sum(axis=1) for some in parts]
        divided = [(some[0] ** 2 * some[1]).sum(axis=1).mean() for some in parts]
        film = np.concatenate([[variance], [means.var() for means in whole], divided, *whole])
        self.points = not _fill_footprints(
            target, corner, at_x, at_y, float(texels_per_unit), offset, stratum, *parts, film, pyramid.top,
            np.empty((8, 6)), row, col, self.first, self.row, self.col, self.weight, self.level, self.share, self.count,
            self.steps,
        )  # fmt: skip

    @property
    def linear_slices(self):
        """Whether slices of the look-ups can be averaged: those of square roots cannot."""
        return getattr(self.pyramid.level(0), "linear_slices", False)

    def average(self, chosen, evaluate, out, shade_factors=None):
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
        shade_factors : callable, optional
            ``shade_factors(shader, which, factors)`` gives values of factors that were averaged, of shaders that have some;
            those of one `Pyramid` have the same terms.
        """
        ends = np.empty(len(chosen), np.int64)
        _count_probes(chosen, self.first, self.count, self.share, ends)
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
                chosen[start:stop], self.first, self.row, self.col, self.weight, self.level, self.share, self.count,
                self.steps, owner, row, col, level, weight,
            )  # fmt: skip
            owner += start
            factors, last, touched = None, None, np.zeros(stop - start, bool)
            for number in np.flatnonzero(np.bincount(level)):
                shader = self.pyramid.level(int(number))
                some = np.flatnonzero(level == number)
                which = owner[some]
                at = self._coordinates(shader, number, row[some], col[some])
                if shade_factors is not None and hasattr(shader, "add_factors"):
                    if factors is None:
                        factors = np.zeros((stop - start, shader.texture.shape[1]), np.float32)
                    shader.add_factors(*at, weight[some], which - start, factors)
                    touched[which - start] = True
                    last = shader
                else:
                    values = evaluate(shader, which, *at)
                    _add(values.reshape(len(values), -1), which, weight[some], flat)
            if factors is not None:
                rows = np.flatnonzero(touched)
                values = shade_factors(last, start + rows, factors[rows])
                _add(values, start + rows, np.ones(len(rows), np.float32), flat)
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

        def shade_factors(shader, which, factors):
            values = np.empty((len(which), 3), np.float32)
            shader.shade_factors(factors, w_i[which], w_o[which], values)
            return values

        self.average(chosen, evaluate, out, shade_factors)

    def slices(self, w_o):
        """What all look-ups show whatever the light; see `Appearance.shader`."""

        def evaluate(shader, which, row, col):
            return shader.slices(row, col, w_o[which]).values

        shader = self.pyramid.level(0)
        whole = shader.slices(self.row[:0], self.col[:0], w_o[:0])
        whole.values = np.empty((len(self.target), *whole.values.shape[1:]), np.float32)
        self.average(np.arange(len(self.target)), evaluate, whole.values)
        return whole

    def shade_sky(self, sky, frames, w_o, out, visibility):
        """Fill `out` with the light of a `HarmonicEnvironment`; arguments as for its ``shade``."""

        def evaluate(shader, which, row, col):
            values = np.empty((len(which), 3), np.float32)
            level = copy.copy(sky)
            level.shader = shader
            level.shade(row, col, frames[which], w_o[which], values, visibility[which])
            return values

        self.average(np.arange(len(self.target)), evaluate, out)
