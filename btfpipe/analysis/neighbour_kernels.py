"""Kernels of the neighbour lists: flat arrays in, lists out."""

from collections import namedtuple

import numpy as np

from btfpipe.compiled import njit

# A level padded by half a neighbourhood. `labels` (rows + 2 h, cols + 2 h) int32; squared distances come from `table` (n + 1, n + 1),
# or, where that is empty, from `image` (rows + 2 h, (cols + 2 h) d). With `clip` places outside do not count: their distances in
# `table` are 0. `side` is 0 for a level that does not exist.
Windows = namedtuple("Windows", "labels table image side clip")

_NO_TEXEL = 2**31 - 1


@njit(cache=True, inline="always")
def coarse_texel(row):
    """Row (or col) of the next coarser level's texel that stands for this one.

    The texel nearest to (row + 0.5) / 2 - 0.5, which never lies half-way: ``row // 2``.
    """
    return row >> 1


@njit(cache=True, nogil=True)
def _offer(distance, texel, distances, texels):
    """Insert into a sorted list if it belongs there; ties go to the lower texel."""
    last = distances.shape[0] - 1
    if distance > distances[last] or (distance == distances[last] and texel > texels[last]):
        return
    i = last
    while i > 0 and (
        distances[i - 1] > distance or (distances[i - 1] == distance and texels[i - 1] > texel)
    ):
        distances[i] = distances[i - 1]
        texels[i] = texels[i - 1]
        i -= 1
    distances[i] = distance
    texels[i] = texel


@njit(cache=True, nogil=True)
def _columns(padded, table, side, r, s, sums):
    """Distances of padded columns c and e of the rows about r and s, summed over `side` rows: sums[c, e]."""
    width = padded.shape[1]
    for c in range(width):
        for e in range(width):
            sums[c, e] = 0.0
        for o in range(side):
            line = table[padded[r + o, c]]
            other = padded[s + o]
            for e in range(width):
                sums[c, e] += line[other[e]]


@njit(cache=True, nogil=True)
def _diagonal(sums, side, c, out):
    """Sums along the diagonal, the neighbourhood's columns, for texel c against all others of a row."""
    for e in range(out.shape[0]):
        out[e] = sums[c, e]
    for o in range(1, side):
        for e in range(out.shape[0]):
            out[e] += sums[c + o, e + o]


@njit(cache=True, nogil=True)
def all_pairs(windows, first, last, pairs):
    """Neighbourhood distances of the texels of rows first to last with all texels."""
    padded, table, side = windows.labels, windows.table, windows.side
    cols = padded.shape[1] - side + 1
    rows = padded.shape[0] - side + 1
    sums = np.empty((padded.shape[1], padded.shape[1]), np.float32)
    for r in range(first, last):
        for s in range(rows):
            _columns(padded, table, side, r, s, sums)
            for c in range(cols):
                _diagonal(sums, side, c, pairs[r * cols + c, s * cols : (s + 1) * cols])


@njit(cache=True, nogil=True)
def exhaustive_lists(windows, coarse_pairs, coarse_cols, named, bounds, first, last, out):
    """Lists of the texels of rows first to last, out of those `named` (rows, cols), which lie within `bounds` (top, bottom, left, right).

    Of two rows of texels the distances of all pairs of columns are summed over the rows of the neighbourhood once; the sum over its
    columns runs along the diagonals.
    """
    padded, table, side = windows.labels, windows.table, windows.side
    cols = padded.shape[1] - side + 1
    k = out.shape[2] - 1
    sums = np.empty((padded.shape[1], padded.shape[1]), np.float32)
    line = np.empty(cols, np.float32)
    distances = np.empty((cols, k + 1), np.float32)
    texels = np.empty((cols, k + 1), np.int32)
    for r in range(first, last):
        distances[:] = np.inf
        texels[:] = _NO_TEXEL
        for s in range(bounds[0], bounds[1]):
            _columns(padded, table, side, r, s, sums)
            for c in range(cols):
                _diagonal(sums, side, c, line)
                if coarse_cols > 0:
                    start = coarse_texel(s) * coarse_cols
                    coarse = coarse_pairs[coarse_texel(r) * coarse_cols + coarse_texel(c)]
                    for e in range(cols):
                        line[e] += coarse[start + coarse_texel(e)]
                for e in range(bounds[2], bounds[3]):
                    if line[e] <= distances[c, k] and named[s, e]:
                        if s * cols + e != r * cols + c:
                            _offer(line[e], np.int32(s * cols + e), distances[c], texels[c])
        for c in range(cols):
            out[r, c, 0] = r * cols + c
            for i in range(k):
                out[r, c, i + 1] = texels[c, i]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _run_distance(a, b):
    """Squared distance of two runs of numbers."""
    total = np.float32(0.0)
    for i in range(a.shape[0]):
        step = a[i] - b[i]
        total += step * step
    return total


@njit(cache=True, nogil=True)
def _square_distance(windows, r, c, s, e, start, limit):
    """`start` plus the distance of the squares about texels (r, c) and (s, e), given up row by row above `limit`.

    The square about (s, e) must lie inside.
    """
    total = start
    side = windows.side
    if side == 0:
        return total
    if windows.table.shape[0] > 0:
        for i in range(side):
            a = windows.labels[r + i, c : c + side]
            b = windows.labels[s + i, e : e + side]
            for j in range(side):
                total += windows.table[a[j], b[j]]
            if total > limit:
                break
        return total
    height, width = windows.labels.shape
    top, bottom, left, right = 0, side, 0, side
    if windows.clip:  # padded texels within half a neighbourhood of the edges lie outside
        margin = side // 2
        top, bottom = max(0, margin - r), min(side, height - margin - r)
        left, right = max(0, margin - c), min(side, width - margin - c)
    depth = windows.image.shape[1] // width
    for i in range(top, bottom):
        total += _run_distance(
            windows.image[r + i, (c + left) * depth : (c + right) * depth],
            windows.image[s + i, (e + left) * depth : (e + right) * depth],
        )
        if total > limit:
            break
    return total


@njit(cache=True, nogil=True)
def pair_distances(fine, coarse, texels, others, out):
    """Neighbourhood distances of pairs of texels."""
    cols = fine.labels.shape[1] - fine.side + 1
    for i in range(texels.shape[0]):
        r, c = texels[i] // cols, texels[i] % cols
        s, e = others[i] // cols, others[i] % cols
        start = _square_distance(
            coarse, coarse_texel(r), coarse_texel(c), coarse_texel(s), coarse_texel(e),
            np.float32(0.0), np.float32(np.inf),
        )  # fmt: skip
        out[i] = _square_distance(fine, r, c, s, e, start, np.float32(np.inf))


@njit(cache=True, nogil=True)
def seeded_lists(fine, coarse, parents, named, bounds, first, last, out):
    """As `exhaustive_lists`, out of the children of their parents' seeds."""
    cols = fine.labels.shape[1] - fine.side + 1
    parent_cols = parents.shape[1]
    k = out.shape[2] - 1
    distances = np.empty(k + 1, np.float32)  # one more, so that lists of the texel alone work
    texels = np.empty(k + 1, np.int32)
    for r in range(first, last):
        for c in range(cols):
            distances[:] = np.inf
            texels[:] = _NO_TEXEL
            seeds = parents[coarse_texel(r), coarse_texel(c)]
            for i in range(seeds.shape[0]):
                seed_row, seed_col = seeds[i] // parent_cols, seeds[i] % parent_cols
                start = np.float32(-1.0)
                for child in range(4):
                    s = 2 * seed_row + child // 2
                    e = 2 * seed_col + child % 2
                    if s < bounds[0] or s >= bounds[1] or e < bounds[2] or e >= bounds[3]:
                        continue
                    if not named[s, e] or (s == r and e == c):
                        continue
                    if start < 0.0:  # the coarse part is the same for all children
                        start = _square_distance(
                            coarse, coarse_texel(r), coarse_texel(c), coarse_texel(s), coarse_texel(e),
                            np.float32(0.0), distances[k],
                        )  # fmt: skip
                    distance = _square_distance(fine, r, c, s, e, start, distances[k])
                    if distance <= distances[k]:
                        _offer(distance, np.int32(s * cols + e), distances, texels)
            out[r, c, 0] = r * cols + c
            for i in range(k):  # too few seeds near a border: repeat the last one found
                out[r, c, i + 1] = texels[i] if distances[i] < np.inf else out[r, c, i]
