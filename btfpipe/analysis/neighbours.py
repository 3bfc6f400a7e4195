"""Lists of the texels whose neighbourhoods are most alike, the memory of the k-coherent search.

The distance of two texels is the sum of the squared feature distances over their square neighbourhoods, centres
included: one level on the coarsest level, elsewhere also a square about the texel that stands for each
on the next coarser level (Tong et al. 2002, sections 5.1 and 5.2).

A sample that is not toroidal ends at its border. Lists name only texels whose whole neighbourhood, on both levels,
lies inside; only the first entry, the texel itself, may be one of the others. For a texel near the border the part of its
neighbourhood that lies inside is compared.

Invalid texels, those with the default label, are beyond the border too: lists name no texel whose neighbourhood holds one, and what
of a neighbourhood is invalid is not compared (where vectors are compared one by one, as the mean of all). An invalid texel's list
names itself alone.
"""

import numpy as np

from btfpipe.analysis.neighbour_kernels import (
    Windows,
    all_pairs,
    coarse_texel,
    exhaustive_lists,
    pair_distances,
    seeded_lists,
)
from btfpipe.analysis.pyramid import check_pyramid, halve, plain_level
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas

EXHAUSTIVE_TEXELS = 64 * 64
SEEDS = 100
_ROWS = 4  # rows a task
_TABLE_VECTORS = 1024  # plain features beyond this many are compared vector by vector: their table would leave the cache

__all__ = [
    "add_neighbour_lists",
    "coarse_texel",
    "inside_range",
    "neighbourhood_distances",
    "usable_texels",
]


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


def usable_texels(level, coarse, neighbourhood, coarse_neighbourhood, toroidal):
    """Texels whose whole neighbourhood lies inside the sample and is valid, the only ones that are ever placed.

    Parameters
    ----------
    level, coarse : FeatureLevel
        `coarse` is the next coarser level, or None.
    neighbourhood, coarse_neighbourhood : int
    toroidal : bool

    Returns
    -------
    (rows, cols) bool
    """
    inside = []
    for size, coarse_size in zip(level.shape, coarse.shape if coarse else (0, 0), strict=True):
        low, high = inside_range(size, coarse_size, neighbourhood, coarse_neighbourhood, toroidal)
        inside.append((np.arange(size) >= low) & (np.arange(size) < high))
    usable = np.outer(*inside) & _solid(level, neighbourhood, toroidal)
    if coarse:
        children = (
            _solid(coarse, coarse_neighbourhood, toroidal).repeat(2, axis=0).repeat(2, axis=1)
        )
        usable &= children[: level.shape[0], : level.shape[1]]
    return usable


def _solid(level, side, toroidal):
    """Texels whose square has no invalid texel, whatever lies beyond the border."""
    valid = level.valid
    if valid.all():
        return valid
    from scipy.ndimage import minimum_filter

    return minimum_filter(valid, side, mode="wrap" if toroidal else "nearest")


def add_neighbour_lists(
    features, k=20, neighbourhood=5, coarse_neighbourhood=3, threads=1, *,
    exhaustive_texels=EXHAUSTIVE_TEXELS, seeds=SEEDS,
):  # fmt: skip
    """Fill in the neighbour lists of every level, and say so in ``features.about``.

    Levels of up to `exhaustive_texels` texels are searched exhaustively. On a larger one the candidates of a texel are the four
    children of each of the `seeds` nearest texels of its parent on the next coarser level (the paper's m = 100; there,
    all texels count, or with a mask those that have such children, neighbourhoods being clamped at the border). Below the
    coarsest level a low-pass of its vectors serves as parent.

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
    sides = (neighbourhood, coarse_neighbourhood)
    toroidal = features.toroidal
    levels = list(features.levels)
    check_pyramid(levels[0].shape, len(levels), neighbourhood, coarse_neighbourhood)
    listed = len(levels)
    while levels[-1].labels.size > exhaustive_texels:
        levels.append(_low_pass(levels[-1], toroidal))
    below = [*levels[1:listed], *[None] * (len(levels) - listed + 1)]
    masked = not all(level.valid.all() for level in features.levels)
    usable = [usable_texels(levels[i], below[i], *sides, toroidal) for i in range(listed)]
    seedable = [np.zeros(levels[0].shape, bool)]  # of a mask, what has a child to list
    for i, level in enumerate(levels[1:]):
        children = seedable[i] | usable[i] if i < listed else seedable[i]
        seedable.append(_parents(children, level.shape) if masked else np.ones(level.shape, bool))
    parents = None
    for i in reversed(range(len(levels))):
        level, coarse = levels[i], below[i]
        if i < listed:
            search = _Search(level, coarse, *sides, toroidal, usable[i])
            if len(search) < k:
                where = "inside the sample and is valid" if masked else "inside the sample"
                raise InputError(
                    f"level {i} has {len(search)} texels whose neighbourhood lies {where}, fewer than"
                    f" k = {k}; lower k or the number of levels, or take a larger sample."
                )
            level.neighbours = search.lists(k, parents, threads)
            invalid = np.flatnonzero(~level.valid)
            level.neighbours.reshape(-1, k)[invalid] = invalid[:, None]
        if i > 0 and levels[i - 1].labels.size > exhaustive_texels:
            search = _Search(level, coarse, *sides, toroidal, seedable[i], clamped=True)
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
        Texels as ``row * cols + col``; the neighbourhoods of `others` must lie inside the sample.

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
    pair_distances(search.fine, search.coarse, texels, others, out)
    return out


class _Search:
    """A level and its coarser one, made ready for both searches; `named` (rows, cols) bool is what lists may name."""

    def __init__(self, level, coarse, side, coarse_side, toroidal, named=None, clamped=False):
        self.shape = level.shape
        coarse_shape = coarse.shape if coarse else (0, 0)
        self.named = named
        mode = "wrap" if toroidal else "edge" if clamped else "constant"
        self.fine = _windows(level, side, mode)
        self.coarse = _windows(coarse, coarse_side, mode) if coarse else _NOTHING
        self.coarse_shape = coarse_shape
        self.levels = (level, coarse)

    def __len__(self):
        """How many texels lists may name."""
        return int(np.count_nonzero(self.named))

    def lists(self, k, parents, threads):
        """Lists (rows, cols, k), from the children of `parents` (rows / 2, cols / 2, seeds) if given."""
        out = np.empty((*self.shape, k), np.int32)
        named, bounds = self.named, np.array(bounding_box(self.named))
        if parents is None:
            fine, coarse = (
                windows
                if len(windows.table) or not windows.side
                else windows._replace(table=_distance_table(level))
                for windows, level in zip((self.fine, self.coarse), self.levels, strict=True)
            )
            pairs = self._coarse_pairs(coarse, threads)

            def search(rows):
                exhaustive_lists(
                    fine, pairs, self.coarse_shape[1], named, bounds, rows.start, rows.stop, out
                )
        else:
            parents = np.ascontiguousarray(parents)

            def search(rows):
                seeded_lists(
                    self.fine, self.coarse, parents, named, bounds, rows.start, rows.stop, out
                )

        list(ordered_map(search, blocks(self.shape[0], _ROWS), threads))
        return out

    def _coarse_pairs(self, coarse, threads):
        """Neighbourhood distances (n, n) of the coarser level's texels; (1, 1) if there is none."""
        rows, cols = self.coarse_shape
        if not rows:
            return np.zeros((1, 1), np.float32)
        pairs = np.empty((rows * cols, rows * cols), np.float32)

        def fill(part):
            all_pairs(coarse, part.start, part.stop, pairs)

        list(ordered_map(fill, blocks(rows, _ROWS), threads))
        return pairs


def bounding_box(mask):
    """Top, bottom, left and right (the second and last exclusive) of what is true; zeros if nothing is."""
    found = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
    return [int(bound) for at in found for bound in ((at[0], at[-1] + 1) if len(at) else (0, 0))]


def _parents(children, shape):
    """Texels of a coarser level that have one of the given children."""
    parents = np.zeros(shape, bool)
    row, col = np.nonzero(children)
    parents[row // 2, col // 2] = True
    return parents


def _low_pass(level, toroidal):
    """A plain level of half the sides; odd sides are first made even by repeating the border."""
    image = level.vectors[level.labels]
    odd = [(0, n % 2) for n in level.shape]
    return plain_level(halve(np.pad(image, (*odd, (0, 0)), "edge"), toroidal))


def _windows(level, side, mode):
    """A level padded by half a neighbourhood, in a mode of `numpy.pad`; ``constant`` means that places outside do not count."""
    margin = side // 2
    default = len(level.vectors) - 1
    outside = {"constant_values": default} if mode == "constant" else {}
    labels = np.ascontiguousarray(np.pad(level.labels, margin, mode, **outside), np.int32)
    table = image = np.zeros((0, 0), np.float32)
    if level.gram is not None or default <= _TABLE_VECTORS:
        table = _distance_table(level)
    else:
        image = np.ascontiguousarray(level.vectors[labels], np.float32).reshape(len(labels), -1)
    return Windows(labels, table, image, side, mode == "constant")


_NOTHING = Windows(
    np.zeros((0, 0), np.int32), np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32), 0, False
)


def _distance_table(level):
    """Squared distances (n + 1, n + 1) float32 of a level's vectors; 0 for the default, the last one."""
    if level.gram is not None:
        table = np.array(level.gram, np.float64)
    else:
        vectors = np.asarray(level.vectors, np.float64)
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
