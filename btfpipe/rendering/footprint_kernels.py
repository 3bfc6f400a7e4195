"""Compiled steps of texture filtering: what rays cover of the sample, and the probes that read it. See `footprint`."""

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.hashing import uniform
from btfpipe.rendering.kernels import face_edges, film_ray, filter_offset

ANISOTROPY = 16  # probes at most; a longer footprint is widened
LEAST_VARIANCE = 0.1  # variance of a pixel, in texels squared, up to which it is a point (0.63 texels); whole from twice that on
_SPLIT = 0.12  # variance that rays stand for, both axes, from which on strata are divided
_TEXTURE_RATE = 3.3  # texture rays along an axis of the film for a texel a pixel
MOST_TEXTURE_RAYS = 3  # of a ray along an axis
_ADDED = 5 / 12  # variance of level l: so often 4^l - 1
_TEXEL = 1 / 12  # variance that a texel of level 0 stands for
# variance of a probe to that of what it stands for, so that neighbouring ones leave no gap
_WIDER = 3.0
_ROOM = 0.5  # at most so much of a pixel's variance is a probe's own
# where between two levels the upper one comes in, and how fast: it is preferred, as it costs no less
_RAMP = (0.2, 0.4)
_GRAZING = 1e-3  # cosine at which a tangent plane is seen from the side


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
        _, _, _, _, _, _, nx, ny, nz = face_edges(vertices, faces, prim[ray])
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
def widest_square(mine, over_x, over_y):
    """The largest sum of a point's two squared steps; no footprint is wider, whatever its direction."""
    widest = 0.0
    for h in mine:
        square = 0.0
        for k in range(3):
            square += over_x[h, k] ** 2 + over_y[h, k] ** 2
        widest = max(widest, square)
    return widest


@njit(cache=True, nogil=True)
def film_offsets(pixels, rows, cols, table, seed, offset, stratum):
    """Offset (n, 2) float64 of rays in their pixels, and its strata (n, 2) int64; rays as `kernels.camera_rays` makes them."""
    samples = rows * cols
    for h in range(len(pixels)):
        s = pixels[h] % samples
        stratum[h, 0] = s % cols
        stratum[h, 1] = s // cols
        for axis in range(2):
            u = 0.5
            if samples > 1:
                u = (stratum[h, axis] + uniform(seed, pixels[h], axis)) / (rows if axis else cols)
            offset[h, axis] = filter_offset(table, u)


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
                    dx = filter_offset(table, (s % cols + (b + 0.5) / across[q]) / cols)
                    dy = filter_offset(table, (s // cols + (a + 0.5) / down[q]) / rows)
                parent[n] = h
                film_ray(
                    pixel % film_width + 0.5 + dx, pixel // film_width + 0.5 + dy,
                    film_width, film_height, position, axes, extent, perspective,
                    n, origins, directions,
                )  # fmt: skip
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
def fill_footprints(
    target, corner, at_x, at_y, texels_per_unit, offset, stratum, parts_x, parts_y, film, top, scratch, row,
    col, first, part_row, part_col, weight, level, share, count, steps, spread,
):  # fmt: skip
    """List the parts of look-ups' footprints: those of look-up q from ``first[q]``; returns whether any is more than a point.

    `film` has the variance of the filter, those of the means of its strata and of the means of their parts, each across and down,
    and the means of the strata themselves. The arrays from `part_row` on have room for all parts; `scratch` is (8, 6).
    `spread` (n,) says how far a look-up is from a point.
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
        apart = np.sqrt((want[0] - want[2]) ** 2 / 4 + want[1] * want[1])
        whole = min(max((middle + apart) / LEAST_VARIANCE - 1, 0.0), 1.0)
        spread[q] = whole
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
                _ROOM * (middle - apart),
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
def count_probes(chosen, first, count, share, ends):
    """Fill the running number of probes `ends` (n,) of look-ups."""
    total = 0
    for q in range(len(chosen)):
        for i in range(first[chosen[q]], first[chosen[q] + 1]):
            total += count[i] * (2 if share[i] > 0 else 1)
        ends[q] = total


@leaf
def list_probes(
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
def add(values, owner, weight, out):
    for n in range(len(owner)):
        for k in range(out.shape[1]):
            out[owner[n], k] += weight[n] * values[n, k]
