"""Lists of the texels whose neighbourhoods are most alike, the memory of the k-coherent search.

The distance of two texels is the sum of the squared feature distances over their square neighbourhoods, centres
included: one level on the coarsest level, elsewhere also a square about the texel that stands for each
on the next coarser level (Tong et al. 2002, sections 5.1 and 5.2).

A sample that is not toroidal ends at its border. Lists name only texels whose whole neighbourhood, on both levels,
lies inside; only the first entry, the texel itself, may be one of the others. For a texel near the border the part of its
neighbourhood that lies inside is compared.
"""

import numpy as np
from numba import njit

from btfpipe.analysis.pyramid import check_pyramid, halve, plain_level
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas

EXHAUSTIVE_TEXELS = 64 * 64
SEEDS = 100
_ROWS = 4  # rows a task


@njit(cache=True, inline="always")
def coarse_texel(row):
    """Row (or col) of the next coarser level's texel that stands for this one.

    The texel nearest to (row + 0.5) / 2 - 0.5, which never lies half-way: ``row // 2``.
    """
    return row >> 1


def inside_range(size, coarse_size, neighbourhood, coarse_neighbourhood, toroidal):
    """First and one past the last row (or col) whose neighbourhood lies inside the sample.

    Parameters
    ----------
    size, coarse_size : int
        Rows (or cols) of the level and of the next coarser one; 0 if there is none.
    neighbourhood, coarse_neighbourhood : int
        Sides of the squares on the two levels.
    toroidal : bool
    """
    if toroidal:
        return 0, size
    margin = neighbourhood // 2
    low, high = margin, size - margin
    if coarse_size:
        margin = coarse_neighbourhood // 2
        low = max(low, 2 * margin)
        high = min(high, 2 * (coarse_size - margin))
    return low, high


def add_neighbour_lists(
    features, k=20, neighbourhood=5, coarse_neighbourhood=3, threads=1, *,
    exhaustive_texels=EXHAUSTIVE_TEXELS, seeds=SEEDS,
):  # fmt: skip
    """Fill in the neighbour lists of every level, and say so in ``features.about``.

    Levels of up to `exhaustive_texels` texels are searched exhaustively. On a larger one the candidates of a texel are the four
    children of each of the `seeds` nearest texels of its parent on the next coarser level (the paper's m = 100; there,
    all texels count, neighbourhoods being clamped at the border). Below the coarsest level a low-pass of its vectors serves as parent.

    Parameters
    ----------
    features : Features
        Changed in place. Distances come from `gram` where there is one, else from `vectors`.
    k : int
        Length of the lists, the texel itself included.
    neighbourhood, coarse_neighbourhood : int
        Sides of the squares on the level and on the next coarser one, odd.
    threads : int
    exhaustive_texels, seeds : int

    Returns
    -------
    Features
        The same object.

    Raises
    ------
    InputError
        If a level is smaller than the neighbourhood, or offers fewer than `k` texels.
    """
    toroidal = features.toroidal
    levels = list(features.levels)
    check_pyramid(levels[0].shape, len(levels), neighbourhood, coarse_neighbourhood)
    listed = len(levels)
    while levels[-1].labels.size > exhaustive_texels:
        levels.append(_low_pass(levels[-1], toroidal))
    parents = None
    for i in reversed(range(len(levels))):
        level = levels[i]
        coarse = levels[i + 1] if i + 1 < listed else None
        sides = (neighbourhood, coarse_neighbourhood)
        if i < listed:
            search = _Search(level, coarse, *sides, toroidal)
            if len(search) < k:
                raise InputError(
                    f"level {i} has {len(search)} texels whose neighbourhood lies inside the sample, fewer than"
                    f" k = {k}; lower k or the number of levels, or take a larger sample."
                )
            level.neighbours = search.lists(k, parents, threads)
        if i > 0 and levels[i - 1].labels.size > exhaustive_texels:
            search = _Search(level, coarse, *sides, toroidal, clamped=True)
            parents = search.lists(min(seeds, len(search)), parents, threads)
    features.about |= {
        "neighbourhood": neighbourhood,
        "coarse_neighbourhood": coarse_neighbourhood,
        "k": k,
    }
    return features


def neighbourhood_distances(features, level, texels, others):
    """Squared neighbourhood distances of pairs of texels, as the lists order them.

    Parameters
    ----------
    features : Features
    level : int
    texels, others : (n,) int
        Texels as ``row * cols + col``.

    Returns
    -------
    (n,) float32
    """
    coarse = features.levels[level + 1] if level + 1 < len(features.levels) else None
    about = features.about
    search = _Search(
        features.levels[level], coarse, about["neighbourhood"], about["coarse_neighbourhood"], features.toroidal
    )  # fmt: skip
    texels, others = (np.ascontiguousarray(a, np.int32) for a in (texels, others))
    out = np.zeros(len(texels), np.float32)
    _distances(*search.tables, texels, others, out)
    return out


class _Search:
    """What both searches need of a level and its coarser one."""

    def __init__(self, level, coarse, side, coarse_side, toroidal, clamped=False):
        self.rows, self.cols = level.shape
        coarse_rows, coarse_cols = coarse.shape if coarse else (0, 0)
        self.coarse_cols = coarse_cols
        everywhere = toroidal or clamped
        self.row_range = inside_range(self.rows, coarse_rows, side, coarse_side, everywhere)
        self.col_range = inside_range(self.cols, coarse_cols, side, coarse_side, everywhere)
        mode = "wrap" if toroidal else "edge" if clamped else "constant"
        fine = _padded(level, side, mode)
        if coarse:
            self.tables = (*fine, side, *_padded(coarse, coarse_side, mode), coarse_side)
        else:
            self.tables = (*fine, side, fine[0][:0], fine[1][:0, :0], fine[2][:0], 0)

    def __len__(self):
        """How many texels lists may name."""
        spans = [max(0, high - low) for low, high in (self.row_range, self.col_range)]
        return spans[0] * spans[1]

    def lists(self, k, parents, threads):
        """Lists (rows, cols, k), from the children of `parents` (rows / 2, cols / 2, seeds) if given."""
        if parents is None:
            return self.exhaustive(k, threads)
        return self.seeded(parents, k, threads)

    def exhaustive(self, k, threads):
        padded, table, vectors, side, coarse_padded, coarse_table, coarse_vectors, coarse_side = (
            self.tables
        )
        if not len(table):
            table = _distance_table(vectors)
        pairs = np.zeros((1, 1), np.float32)
        if coarse_side:
            if not len(coarse_table):
                coarse_table = _distance_table(coarse_vectors)
            n = len(coarse_padded) - coarse_side + 1
            pairs = np.empty((n * self.coarse_cols, n * self.coarse_cols), np.float32)

            def fill(rows):
                _all_pairs(coarse_padded, coarse_table, coarse_side, rows.start, rows.stop, pairs)

            list(ordered_map(fill, blocks(n, _ROWS), threads))
        out = np.empty((self.rows, self.cols, k), np.int32)

        def search(rows):
            _exhaustive(
                padded, table, side, pairs, self.coarse_cols, *self.row_range, *self.col_range,
                rows.start, rows.stop, out,
            )  # fmt: skip

        list(ordered_map(search, blocks(self.rows, _ROWS), threads))
        return out

    def seeded(self, seeds, k, threads):
        seeds = np.ascontiguousarray(seeds)
        out = np.empty((self.rows, self.cols, k), np.int32)

        def search(rows):
            _seeded(
                *self.tables, seeds, *self.row_range, *self.col_range, rows.start, rows.stop, out
            )

        list(ordered_map(search, blocks(self.rows, _ROWS), threads))
        return out


def _low_pass(level, toroidal):
    """A plain level of half the sides; odd sides are first made even by repeating the border."""
    image = level.vectors[level.labels]
    odd = [(0, n % 2) for n in level.shape]
    return plain_level(halve(np.pad(image, (*odd, (0, 0)), "edge"), toroidal))


def _padded(level, side, mode):
    """Labels with half a neighbourhood around them, the distance table, and the vectors.

    In mode ``constant`` the label outside is the default's, whose distance to everything is set to 0: such
    places do not count. The table is empty where it would not pay (plain features of a large sample).
    """
    margin = side // 2
    default = len(level.vectors) - 1
    outside = {"constant_values": default} if mode == "constant" else {}
    padded = np.pad(level.labels, margin, mode, **outside)
    if level.gram is not None:
        gram = np.asarray(level.gram, np.float64)
        square = np.diagonal(gram)
        table = np.maximum(square[:, None] + square[None] - 2 * gram, 0).astype(np.float32)
        table[default] = 0
        table[:, default] = 0
        vectors = np.zeros((1, 1), np.float32)
    else:
        vectors = np.ascontiguousarray(level.vectors, np.float32)
        table = _distance_table(vectors) if default <= 1024 else np.zeros((0, 0), np.float32)
    return np.ascontiguousarray(padded, np.int32), table, vectors


def _distance_table(vectors):
    """Squared distances (n + 1, n + 1) of vectors; 0 for the default, the last one."""
    vectors = np.asarray(vectors, np.float64)
    vectors = vectors - vectors[-1]
    with single_threaded_blas():
        table = vectors @ vectors.T
    square = np.diagonal(table).copy()
    table *= -2
    table += square[:, None]
    table += square[None]
    np.maximum(table, 0, out=table)
    table[-1] = 0
    table[:, -1] = 0
    return table.astype(np.float32)


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
def _all_pairs(padded, table, side, first, last, pairs):
    """Neighbourhood distances of the texels of rows first to last with all texels."""
    cols = padded.shape[1] - side + 1
    rows = padded.shape[0] - side + 1
    sums = np.empty((padded.shape[1], padded.shape[1]), np.float32)
    for r in range(first, last):
        for s in range(rows):
            _columns(padded, table, side, r, s, sums)
            for c in range(cols):
                _diagonal(sums, side, c, pairs[r * cols + c, s * cols : (s + 1) * cols])


@njit(cache=True, nogil=True)
def _exhaustive(
    padded, table, side, coarse_pairs, coarse_cols, row_low, row_high, col_low, col_high, first, last, out
):  # fmt: skip
    """Lists of the texels of rows first to last, out of all texels inside."""
    cols = padded.shape[1] - side + 1
    k = out.shape[2] - 1
    sums = np.empty((padded.shape[1], padded.shape[1]), np.float32)
    line = np.empty(cols, np.float32)
    distances = np.empty((cols, k + 1), np.float32)
    texels = np.empty((cols, k + 1), np.int32)
    for r in range(first, last):
        distances[:] = np.inf
        texels[:] = 2**31 - 1
        for s in range(row_low, row_high):
            _columns(padded, table, side, r, s, sums)
            for c in range(cols):
                _diagonal(sums, side, c, line)
                if coarse_cols > 0:
                    start = coarse_texel(s) * coarse_cols
                    coarse = coarse_pairs[coarse_texel(r) * coarse_cols + coarse_texel(c)]
                    for e in range(cols):
                        line[e] += coarse[start + coarse_texel(e)]
                for e in range(col_low, col_high):
                    if line[e] <= distances[c, k]:
                        if s * cols + e != r * cols + c:
                            _offer(line[e], np.int32(s * cols + e), distances[c], texels[c])
        for c in range(cols):
            out[r, c, 0] = r * cols + c
            for i in range(k):
                out[r, c, i + 1] = texels[c, i]


@njit(cache=True, nogil=True)
def _texel_distance(table, vectors, a, b):
    """Squared distance of two labels, from the table or else from the vectors."""
    if table.shape[0] > 0:
        return table[a, b]
    default = vectors.shape[0] - 1
    total = np.float32(0.0)
    if a != default and b != default:
        for i in range(vectors.shape[1]):
            step = vectors[a, i] - vectors[b, i]
            total += step * step
    return total


@njit(cache=True, nogil=True)
def _square_distance(padded, table, vectors, side, r, c, s, e, start, limit):
    """`start` plus the distance of the squares about (r, c) and (s, e), given up row by row above `limit`."""
    total = start
    for i in range(side):
        for j in range(side):
            total += _texel_distance(table, vectors, padded[r + i, c + j], padded[s + i, e + j])
        if total > limit:
            break
    return total


@njit(cache=True, nogil=True)
def _distances(
    padded, table, vectors, side, coarse_padded, coarse_table, coarse_vectors, coarse_side, texels, others, out
):  # fmt: skip
    """Neighbourhood distances of pairs of texels."""
    cols = padded.shape[1] - side + 1
    for i in range(texels.shape[0]):
        r, c = texels[i] // cols, texels[i] % cols
        s, e = others[i] // cols, others[i] % cols
        start = np.float32(0.0)
        start = _square_distance(
            coarse_padded, coarse_table, coarse_vectors, coarse_side,
            coarse_texel(r), coarse_texel(c), coarse_texel(s), coarse_texel(e), start, np.inf,
        )  # fmt: skip
        out[i] = _square_distance(padded, table, vectors, side, r, c, s, e, start, np.inf)


@njit(cache=True, nogil=True)
def _seeded(
    padded, table, vectors, side, coarse_padded, coarse_table, coarse_vectors, coarse_side,
    seeds, row_low, row_high, col_low, col_high, first, last, out,
):  # fmt: skip
    """Lists of the texels of rows first to last, out of the children of their parents' seeds."""
    cols = padded.shape[1] - side + 1
    seed_cols = seeds.shape[1]
    k = out.shape[2] - 1
    distances = np.empty(k + 1, np.float32)
    texels = np.empty(k + 1, np.int32)
    for r in range(first, last):
        for c in range(cols):
            distances[:] = np.inf
            texels[:] = 2**31 - 1
            parent = seeds[coarse_texel(r), coarse_texel(c)]
            for i in range(parent.shape[0]):
                seed_row, seed_col = parent[i] // seed_cols, parent[i] % seed_cols
                start = np.float32(0.0)
                start = _square_distance(
                    coarse_padded, coarse_table, coarse_vectors, coarse_side,
                    coarse_texel(r), coarse_texel(c), seed_row, seed_col, start, distances[k],
                )  # fmt: skip
                for child in range(4):
                    s = 2 * seed_row + child // 2
                    e = 2 * seed_col + child % 2
                    if s < row_low or s >= row_high or e < col_low or e >= col_high:
                        continue
                    if s == r and e == c:
                        continue
                    distance = _square_distance(
                        padded, table, vectors, side, r, c, s, e, start, distances[k]
                    )
                    if distance <= distances[k]:
                        _offer(distance, np.int32(s * cols + e), distances, texels)
            out[r, c, 0] = r * cols + c
            for i in range(k):  # too few seeds near a border: repeat the last one found
                out[r, c, i + 1] = texels[i] if distances[i] < np.inf else out[r, c, i]
