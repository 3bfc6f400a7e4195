"""Growing a sample over a toroidal plane of texels: the planar fast path of the same search.

On a plane the neighbourhood is a square of texels, so nothing is flattened or blended: the output's features lie in a
picture with a border, and a row of a neighbourhood is one run of memory, in the output as in the sample.
"""

import time

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.errors import InputError
from btfpipe.synthesis.coordinate_map import CoordinateMap
from btfpipe.synthesis.exemplar import coarse_texel, cut, exemplar, random_texel
from btfpipe.synthesis.growth import COHERENCE, SWEEPS, summary
from btfpipe.synthesis.search import (
    CANDIDATES,
    FALLBACKS,
    FAST,
    MOVED,
    STARTS,
    list_candidates,
    scratch_lists,
    square_of_run,
)

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
            _scatter(sample, np.flatnonzero(sample.usable), np.uint64(seed), texel)
            coarse = _canvas(sample.coarse, texel)
        else:
            _inherit(below, coarse_sample, sample, texel)
            coarse = _canvas(sample.coarse, below)
        canvas = _canvas(sample.fine, texel)
        half = side // 2
        where = tuple(np.pad(a, half, "wrap") for a in np.divmod(texel, np.int32(sample.cols)))
        distances = np.zeros((rows, cols), np.float32)
        done = np.full(where[0].shape, below is not None)
        scratch = _scratch(sample)
        for sweep in range(sweeps[0] if below is None else sweeps[1]):
            tally = np.zeros(5, np.int64)
            start = time.perf_counter()
            for first in range(0, rows, _ROWS):
                last = min(first + _ROWS, rows)
                grow_rows(
                    first, last, where, canvas, coarse, done, distances, sample, full, below is None and sweep == 0,
                    np.float32(0.0 if below is None else coherence * 2.0**-i), scratch, tally,
                )  # fmt: skip
                finished += (last - first) * cols
                if on_progress is not None:
                    on_progress(finished, total)
            seconds = time.perf_counter() - start
            report.append(summary(i, sweep, tally, distances, seconds, seconds))
        row, col = (a[half : half + rows, half : half + cols] for a in where)
        below, coarse_sample = row * sample.cols + col, sample
    return CoordinateMap(
        row.reshape(1, -1),
        col.reshape(1, -1),
        np.zeros((1, below.size), np.float32),
        1.0,
        {"plane": [int(n) for n in shape], "toroidal": True},
        about={"synthesis": report},
    )


def _canvas(tables, texel):
    """What an output level looks like, flat, with a border that continues it: labels, features, width in texels."""
    half = tables.side // 2
    if not tables.side:
        return np.zeros(0, np.int32), np.zeros(0, np.float32), 0
    inner = tables.labels[
        half : tables.labels.shape[0] - half, half : tables.labels.shape[1] - half
    ]
    labels = np.pad(inner.ravel()[texel], half, "wrap")
    image = tables.vectors[labels] if len(tables.vectors) else np.zeros(0, np.float32)
    return np.ascontiguousarray(labels).ravel(), image.ravel(), labels.shape[1]


def _scratch(sample):
    """What `grow_rows` writes down about one texel: by texel of the sample, by place of the square, by candidate."""
    texels, places = sample.rows * sample.cols, sample.fine.side**2
    return (
        np.full(texels, -1, np.int32),
        np.empty(texels, np.int32),
        np.empty((places, 2), np.int32),
        np.empty(places, np.int32),
        np.empty(places, np.float32),
        scratch_lists(sample, places),
    )


@leaf
def _scatter(sample, usable, seed, texel):
    """A random texel everywhere."""
    for r in range(texel.shape[0]):
        for c in range(texel.shape[1]):
            texel[r, c] = random_texel(sample, usable, seed, r * texel.shape[1] + c)


@leaf
def _inherit(below, coarse_sample, sample, texel):
    """First pass: the texel of the coarser level, scaled up, and the place among its four children."""
    for r in range(texel.shape[0]):
        for c in range(texel.shape[1]):
            parent = below[r >> 1, c >> 1]
            row = 2 * (parent // coarse_sample.cols) + (r & 1)
            col = 2 * (parent % coarse_sample.cols) + (c & 1)
            texel[r, c] = row * sample.cols + col


@leaf(fastmath=FAST)
def _square(
    ours, our_image, our_width, r, c, side, labels, table, image, width, n, depth, s, e, total, limit
):  # fmt: skip
    """`total` plus the distance of the squares at (r, c) of the output and (s, e) of the sample.

    Given up above `limit` after the second row: a test after every row is mispredicted more often than it saves.
    """
    for i in range(side):
        run = (r + i) * our_width + c
        other = (s + i) * width + e
        if n > 0:
            for j in range(side):
                total += table[
                    np.uint64(ours[np.uint64(run + j)] * n + labels[np.uint64(other + j)])
                ]
        else:
            total += square_of_run(our_image, run * depth, image, other * depth, side * depth)
        if i == 1 and total >= limit:
            break
    return total


@leaf(fastmath=FAST)
def _places(
    ours, our_image, our_width, r, c, labels, table, image, width, n, depth, s, e, places, limit
):  # fmt: skip
    """As `_square`, over some places of the square only: those synthesised."""
    total = np.float32(0.0)
    for p in range(places.shape[0]):
        run = (r + places[p, 0]) * our_width + c + places[p, 1]
        other = (s + places[p, 0]) * width + e + places[p, 1]
        if n > 0:
            total += table[np.uint64(ours[np.uint64(run)] * n + labels[np.uint64(other)])]
        else:
            total += square_of_run(our_image, run * depth, image, other * depth, depth)
        if total >= limit:
            break
    return total


@leaf(fastmath=FAST)
def _choose(
    tries, penalty, count, r, c, places, cols, side, canvas, flat, coarse_side, coarse_canvas, coarse_flat
):  # fmt: skip
    """Place in `tries` of the texel nearest by penalty times distance, and its distance; the coarser level first."""
    ours, our_image, our_width = canvas
    labels, table, image, width, n, depth = flat
    ours1, our_image1, our_width1 = coarse_canvas
    labels1, table1, image1, width1, n1, depth1 = coarse_flat
    whole = places.shape[0] == side * side
    inverse = 1.0 / cols
    best = 0
    best_distance = np.float32(np.inf)
    lowest = np.float32(np.inf)
    for m in range(count):
        limit = lowest / penalty[m]
        s = int((tries[m] + 0.5) * inverse)  # an integer division costs more
        e = tries[m] - s * cols
        total = np.float32(0.0)
        if coarse_side > 0:
            total = _square(
                ours1, our_image1, our_width1, r >> 1, c >> 1, coarse_side, labels1, table1, image1, width1,
                n1, depth1, coarse_texel(s), coarse_texel(e), total, limit,
            )  # fmt: skip
        if total < limit:
            if whole:
                total = _square(
                    ours, our_image, our_width, r, c, side, labels, table, image, width, n, depth, s, e,
                    total, limit,
                )  # fmt: skip
            else:
                total = _places(
                    ours, our_image, our_width, r, c, labels, table, image, width, n, depth, s, e, places,
                    limit,
                )  # fmt: skip
            if total < limit:
                best = m
                best_distance = total
                lowest = total * penalty[m]
    return best, best_distance


@leaf
def grow_rows(
    first, last, where, canvas, coarse_canvas, done, distances, sample, full, skip, kappa, scratch, tally
):  # fmt: skip
    """Synthesise rows first to last in scanning order; the search is that of `search.grow`.

    Parameters
    ----------
    where : two (rows + side - 1, cols + side - 1) int32
        Row and col in the sample of each texel of the output, with a border that continues it; changed in place.
    canvas, coarse_canvas : (labels, image, width)
        What the output looks like on this level and the coarser one, flat, with the same border; this level's is kept up to date.
    done : (rows + side - 1, cols + side - 1) bool
        What has been synthesised; only this counts.
    distances : (rows, cols) float32
        Distance of the texel chosen.
    sample : Exemplar
    full : bool
    skip : bool
        Whether something is not `done` yet.
    kappa : float32
    scratch
        Of `_scratch`.
    tally : (5,) int64
    """
    side = sample.fine.side
    half = side // 2
    rows, cols = distances.shape
    width = cols + 2 * half
    row, col = where
    flat_row, flat_col, flat_done = (
        row.reshape(row.size),
        col.reshape(row.size),
        done.reshape(row.size),
    )
    our_labels, our_image, _ = canvas
    labels, _, image, sample_width, _, depth = sample.fine.flat
    sample_rows, sample_cols = sample.rows, sample.cols
    toroidal = sample.toroidal
    lists, usable = sample.lists, sample.usable
    compared, slot, places, owners, support, (tries, origin, penalty) = scratch
    compared[:] = -1
    pair = (
        sample_cols, side, canvas, sample.fine.flat, sample.coarse.side, coarse_canvas, sample.coarse.flat,
    )  # fmt: skip
    for r in range(first, last):
        for c in range(cols):
            stamp = r * cols + c
            count = 0
            n = 0
            last_texel = -1
            for i in range(side):
                for j in range(side):
                    place = np.uint64((r + i) * width + c + j)
                    if skip:
                        if not flat_done[place]:
                            continue
                        places[count, 0] = i
                        places[count, 1] = j
                    count += 1
                    s = flat_row[place] + half - i
                    e = flat_col[place] + half - j
                    if toroidal:  # a sample has at least `side` texels: one period is enough
                        s += sample_rows if s < 0 else (-sample_rows if s >= sample_rows else 0)
                        e += sample_cols if e < 0 else (-sample_cols if e >= sample_cols else 0)
                    elif np.uint64(s) >= np.uint64(sample_rows) or np.uint64(e) >= np.uint64(
                        sample_cols
                    ):
                        continue
                    t = s * sample_cols + e
                    if t == last_texel:  # most runs lead to the same one
                        support[slot[t]] += np.float32(1.0)
                        continue
                    last_texel = t
                    if compared[t] == stamp:
                        support[slot[t]] += np.float32(1.0)
                    else:
                        compared[t] = stamp
                        slot[t] = n
                        owners[n] = t
                        support[n] = np.float32(1.0)
                        n += 1
            old = row[r + half, c + half] * sample_cols + col[r + half, c + half]
            best = old
            if count == 0:
                tally[STARTS] += 1
            else:
                for j in range(n):
                    support[j] /= count
                found = list_candidates(
                    owners,
                    n,
                    support,
                    kappa,
                    full,
                    lists,
                    usable,
                    compared,
                    stamp,
                    tries,
                    origin,
                    penalty,
                )
                if origin[0] < 0 and not full:
                    tally[FALLBACKS] += 1
                m, distances[r, c] = _choose(tries, penalty, found, r, c, places[:count], *pair)
                best = tries[m]
                tally[CANDIDATES] += found
            if best != old:
                tally[MOVED] += 1
            s = best // sample_cols
            e = best - s * sample_cols
            texel = (s + half) * sample_width + e + half
            # The texel, and its copies in the border.
            for i in range((r + half) % rows, rows + 2 * half, rows):
                for j in range((c + half) % cols, cols + 2 * half, cols):
                    done[i, j] = True
                    row[i, j] = s
                    col[i, j] = e
                    place = i * width + j
                    our_labels[place] = labels[texel]
                    for d in range(depth):
                        our_image[place * depth + d] = image[texel * depth + d]
