"""Growing a sample over a toroidal plane of texels: the planar fast path of the same search.

On a plane the neighbourhood is a square of texels, so nothing is flattened or blended: the output's features lie in a
picture with a border, and a row of a neighbourhood is one run of memory, in the output as in the sample.
"""

import time

import numpy as np
from numba import njit

from btfpipe.errors import InputError
from btfpipe.hashing import uniform
from btfpipe.synthesis.coordinate_map import CoordinateMap
from btfpipe.synthesis.exemplar import coarse_texel, cut, exemplar, is_inside
from btfpipe.synthesis.growth import COHERENCE, SWEEPS, summary
from btfpipe.synthesis.search import CANDIDATES, FALLBACKS, MOVED, STARTS

_FAST = {"reassoc", "contract", "nsz"}
_ROWS = 16  # rows between two reports of progress


def grow_over_plane(
    features, shape, *, full=False, k=11, levels=3, sweeps=SWEEPS, coherence=COHERENCE, seed=0, distance=None,
    on_progress=None,
):  # fmt: skip
    """Grow a sample over a plane of rows x cols texels that continues at its opposite borders.

    Parameters
    ----------
    features : Features
    shape : (int, int)
        Rows and cols, multiples of ``2 ** (levels - 1)``.
    full, k, levels, sweeps, coherence, seed, distance, on_progress
        As for `grow_over_surface`; progress is in texels.

    Returns
    -------
    CoordinateMap
        Whole texels: there are no fractions on a plane.

    Raises
    ------
    InputError
    """
    features = cut(features, levels)
    step = 2 ** (levels - 1)
    side = int(features.about["neighbourhood"])
    if any(n % step or n < step * side for n in shape):
        raise InputError(
            f"the plane has {shape[0]} x {shape[1]} texels; with {levels} levels both must be multiples of"
            f" {step}, and at least {step * side}."
        )
    total = sum(
        (shape[0] >> i) * (shape[1] >> i) * (sweeps[0] if i == levels - 1 else sweeps[1])
        for i in range(levels)
    )
    finished, report = 0, []
    below = coarse_sample = None
    for i in reversed(range(levels)):
        sample = exemplar(features, i, None if full else k, distance)
        rows, cols = shape[0] >> i, shape[1] >> i
        texel = np.empty((rows, cols), np.int32)
        if below is None:
            _scatter(sample, np.uint64(seed), texel)
            coarse = _Canvas(sample.coarse, np.zeros((0, 0), np.int32), sample)
        else:
            _inherit(below, coarse_sample, sample, texel)
            coarse = _Canvas(sample.coarse, below, coarse_sample)
        canvas = _Canvas(sample.fine, texel, sample)
        half = side // 2
        distances = np.zeros((rows, cols), np.float32)
        done = np.full((rows + 2 * half, cols + 2 * half), below is not None)
        for sweep in range(sweeps[0] if below is None else sweeps[1]):
            tally = np.zeros(5, np.int64)
            start = time.perf_counter()
            for first in range(0, rows, _ROWS):
                last = min(first + _ROWS, rows)
                grow_rows(
                    first, last, texel, canvas.labels, canvas.image, coarse.labels, coarse.image, done, distances,
                    sample, full, np.float32(0.0 if below is None else coherence), tally,
                )  # fmt: skip
                finished += (last - first) * cols
                if on_progress is not None:
                    on_progress(finished, total)
            seconds = time.perf_counter() - start
            report.append(summary(i, sweep, tally, distances, seconds, seconds))
        below, coarse_sample = texel, sample
    return CoordinateMap(
        (texel // sample.cols).reshape(1, -1),
        (texel % sample.cols).reshape(1, -1),
        np.zeros((1, texel.size), np.float32),
        1.0,
        {"plane": [int(n) for n in shape], "toroidal": True},
        about={"synthesis": report},
    )


class _Canvas:
    """What an output level looks like, with a border that continues it: labels, and features if these are compared."""

    def __init__(self, tables, texel, sample):
        half = tables.side // 2
        self.labels = np.zeros((0, 0), np.int32)
        self.image = np.zeros((0, 0, 0), np.float32)
        if not tables.side:
            return
        own = tables.labels.shape[0] - 2 * half, tables.labels.shape[1] - 2 * half
        inner = tables.labels[half : half + own[0], half : half + own[1]]
        self.labels = np.pad(inner.ravel()[texel], half, "wrap")
        if len(tables.vectors):
            self.image = tables.vectors[self.labels]


@njit(cache=True, nogil=True)
def _scatter(sample, seed, texel):
    """A random texel everywhere."""
    low, high, left, right = sample.inside
    for r in range(texel.shape[0]):
        for c in range(texel.shape[1]):
            item = r * texel.shape[1] + c
            row = low + int(uniform(seed, item, 0) * (high - low))
            col = left + int(uniform(seed, item, 1) * (right - left))
            texel[r, c] = row * sample.cols + col


@njit(cache=True, nogil=True)
def _inherit(below, coarse_sample, sample, texel):
    """First pass: the texel of the coarser level, scaled up, and the place among its four children."""
    for r in range(texel.shape[0]):
        for c in range(texel.shape[1]):
            parent = below[r >> 1, c >> 1]
            row = 2 * (parent // coarse_sample.cols) + (r & 1)
            col = 2 * (parent % coarse_sample.cols) + (c & 1)
            texel[r, c] = row * sample.cols + col


@njit(cache=True, nogil=True, fastmath=_FAST)
def _square(labels, image, r, c, tables, s, e, total, limit):
    """`total` plus the distance of the squares at (r, c) of the output and (s, e) of the sample, up to `limit`."""
    side = tables.side
    if tables.table.shape[0] > 0:
        n = tables.table.shape[1]
        table = tables.table.ravel()
        ours, theirs = labels.ravel(), tables.labels.ravel()
        width, other_width = labels.shape[1], tables.labels.shape[1]
        for i in range(side):
            run = (r + i) * width + c
            other = (s + i) * other_width + e
            for j in range(side):
                total += table[ours[run + j] * n + theirs[other + j]]
            if total >= limit:
                return total
        return total
    depth = image.shape[2]
    ours, theirs = image.ravel(), tables.image.ravel()
    width, other_width = image.shape[1] * depth, tables.image.shape[1] * depth
    for i in range(side):
        run = (r + i) * width + c * depth
        other = (s + i) * other_width + e * depth
        part = np.float32(0.0)
        for d in range(side * depth):
            step = ours[run + d] - theirs[other + d]
            part += step * step
        total += part
        if total >= limit:
            return total
    return total


@njit(cache=True, nogil=True, fastmath=_FAST)
def _places(labels, image, r, c, tables, s, e, places, count, limit):
    """As `_square`, over some places of the square only: those synthesised."""
    total = np.float32(0.0)
    side = tables.side
    for p in range(count):
        i, j = places[p] // side, places[p] % side
        if tables.table.shape[0] > 0:
            total += tables.table[labels[r + i, c + j], tables.labels[s + i, e + j]]
        else:
            for d in range(image.shape[2]):
                step = image[r + i, c + j, d] - tables.image[s + i, e + j, d]
                total += step * step
        if total >= limit:
            return total
    return total


@njit(cache=True, nogil=True)
def _compare(
    texel, sample, labels, image, r, c, coarse_labels, coarse_image, places, count, limit
):  # fmt: skip
    """Distance of the output's neighbourhoods at (r, c) to those of a texel of the sample."""
    s = texel // sample.cols
    e = texel - s * sample.cols
    total = np.float32(0.0)
    if sample.coarse.side > 0:
        total = _square(
            coarse_labels, coarse_image, r >> 1, c >> 1, sample.coarse, coarse_texel(s), coarse_texel(e),
            total, limit,
        )  # fmt: skip
        if total >= limit:
            return total
    if count < sample.fine.side * sample.fine.side:
        return _places(labels, image, r, c, sample.fine, s, e, places, count, limit)
    return _square(labels, image, r, c, sample.fine, s, e, total, limit)


@njit(cache=True, nogil=True)
def grow_rows(
    first, last, texel, labels, image, coarse_labels, coarse_image, done, distances, sample, full, kappa, tally
):  # fmt: skip
    """Synthesise rows first to last in scanning order; the search is that of `search.grow`.

    Parameters
    ----------
    texel : (rows, cols) int32
        Texels of the sample; changed in place.
    labels, image : (rows + side - 1, cols + side - 1[, d])
        What they look like, with a border; kept up to date.
    coarse_labels, coarse_image
        The same of the coarser level.
    done : (rows + side - 1, cols + side - 1) bool
        What has been synthesised; only this counts.
    distances : (rows, cols) float32
        Distance of the texel chosen.
    sample : Exemplar
    full : bool
    kappa : float32
    tally : (5,) int64
    """
    rows, cols = texel.shape
    side = sample.fine.side
    half = side // 2
    depth = image.shape[2]
    low, high, left, right = sample.inside
    compared = np.full(sample.rows * sample.cols, -1, np.int32)
    places = np.empty(side * side, np.int64)
    owners = np.empty(side * side, np.int32)
    support = np.empty(side * side, np.float32)
    slot = np.empty(sample.rows * sample.cols, np.int32)
    for r in range(first, last):
        for c in range(cols):
            stamp = r * cols + c
            count = 0
            n = 0
            for i in range(side):
                for j in range(side):
                    if not done[r + i, c + j]:
                        continue
                    places[count] = i * side + j
                    count += 1
                    u = texel[(r + i - half) % rows, (c + j - half) % cols]
                    s = u // sample.cols + half - i
                    e = u % sample.cols + half - j
                    if sample.toroidal:
                        s %= sample.rows
                        e %= sample.cols
                    elif s < 0 or s >= sample.rows or e < 0 or e >= sample.cols:
                        continue
                    t = s * sample.cols + e
                    if compared[t] == stamp:
                        support[slot[t]] += np.float32(1.0)
                    else:
                        compared[t] = stamp
                        slot[t] = n
                        owners[n] = t
                        support[n] = np.float32(1.0)
                        n += 1
            best = texel[r, c]
            if count == 0:
                tally[STARTS] += 1
            else:
                best = -1
                best_distance = np.float32(np.inf)
                lowest = np.float32(np.inf)
                found = 0
                for j in range(n):
                    if is_inside(owners[j], sample):
                        found += 1
                        penalty = np.float32(1.0) + kappa * (np.float32(1.0) - support[j] / count)
                        distance = _compare(
                            owners[j], sample, labels, image, r, c, coarse_labels, coarse_image, places,
                            count, lowest / penalty,
                        )  # fmt: skip
                        if distance * penalty < lowest:
                            lowest = distance * penalty
                            best_distance = distance
                            best = owners[j]
                limit = lowest / (np.float32(1.0) + kappa)
                if not full:
                    for j in range(n):
                        for m in range(1, sample.lists.shape[1]):
                            t = sample.lists[owners[j], m]
                            if compared[t] == stamp:
                                continue
                            compared[t] = stamp
                            found += 1
                            distance = _compare(
                                t, sample, labels, image, r, c, coarse_labels, coarse_image, places, count,
                                limit,
                            )  # fmt: skip
                            if distance < limit:
                                limit = distance
                                best_distance = distance
                                best = t
                    if best < 0:
                        tally[FALLBACKS] += 1
                if full or best < 0:
                    for s in range(low, high):
                        for e in range(left, right):
                            t = s * sample.cols + e
                            if compared[t] == stamp:
                                continue
                            found += 1
                            distance = _compare(
                                t, sample, labels, image, r, c, coarse_labels, coarse_image, places, count,
                                limit,
                            )  # fmt: skip
                            if distance < limit:
                                limit = distance
                                best_distance = distance
                                best = t
                tally[CANDIDATES] += found
                distances[r, c] = best_distance
            if best != texel[r, c]:
                tally[MOVED] += 1
            texel[r, c] = best
            s = best // sample.cols + half
            e = best % sample.cols + half
            # The texel, and its copies in the border.
            for i in range((r + half) % rows, rows + 2 * half, rows):
                for j in range((c + half) % cols, cols + 2 * half, cols):
                    done[i, j] = True
                    labels[i, j] = sample.fine.labels[s, e]
                    for d in range(depth):
                        image[i, j, d] = sample.fine.image[s, e, d]
