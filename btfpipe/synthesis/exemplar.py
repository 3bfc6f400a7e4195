"""One level of the features, laid out for the search."""

from collections import namedtuple

import numpy as np

from btfpipe.analysis.neighbours import bounding_box, coarse_texel, usable_texels
from btfpipe.compiled import njit
from btfpipe.errors import InputError, amount
from btfpipe.hashing import uniform
from btfpipe.parallel import single_threaded_blas

TABLE_LIMIT = (
    2048  # vectors whose distances are tabulated (16 MB); a plain feature image has one a texel
)

# The tables of one level, for a neighbourhood of `side` texels:
# labels (rows + side - 1, cols + side - 1) int32: with half a neighbourhood on each side.
# table (n + 1, n + 1) float32: squared distances of the vectors, from the dot products; empty if unused.
# image (rows + side - 1, cols + side - 1, d) float32 and vectors (n + 1, d) float32: the Euclidean form; empty if unused.
# flat: views of labels, table and image in one dimension, their width in texels, n + 1, and d, which is what inner loops take:
# taking arrays out of tuples or reshaping them there costs as much as the search.
Tables = namedtuple("Tables", "side labels table image vectors flat")

# What the search knows of a level: its tables, those of the next coarser one (side 0: none), its
# neighbour lists (texels, k), the numbers of rows and cols, the texels whose neighbourhood lies inside and is valid (texels,) bool, the
# bounds of those, and whether it is toroidal.
Exemplar = namedtuple("Exemplar", "fine coarse lists rows cols usable inside toroidal")


def exemplar(features, level, k=None, distance=None):
    """Lay out one level of the features.

    Parameters
    ----------
    features : Features
    level : int
    k : int, optional
        Entries of the neighbour lists to use; None for full search, which needs no lists.
    distance : str, optional
        ``gram``: by the dot-product matrix; ``vectors``: by its Euclidean factor. By default the first for levels that
        have such a matrix or few enough vectors, which is faster.

    Returns
    -------
    Exemplar

    Raises
    ------
    InputError
        If the lists are missing or too short, or no texel's neighbourhood lies inside the sample and is valid.
    """
    here = features.levels[level]
    below = features.levels[level + 1] if level + 1 < len(features.levels) else None
    side = int(features.about["neighbourhood"])
    coarse_side = int(features.about["coarse_neighbourhood"]) if below is not None else 0
    rows, cols = here.shape
    if k is None or k == 1:
        lists = np.arange(rows * cols, dtype=np.int32)[:, None]
    elif here.neighbours is None:
        raise InputError(
            f"level {level} of the features has no neighbour lists; make them with `btfpipe textons`, or pass"
            " --search full."
        )
    elif here.neighbours.shape[2] < k:
        raise InputError(
            f"level {level} of the features has lists of {here.neighbours.shape[2]} neighbours, fewer than"
            f" k = {k}; lower -k or make longer lists."
        )
    else:
        lists = np.ascontiguousarray(here.neighbours[:, :, :k]).reshape(rows * cols, k)
    usable = usable_texels(here, below, side, coarse_side, features.toroidal)
    if not usable.any() or min(rows, cols) < side:
        valid = "" if here.valid.all() else f" ({int(here.valid.sum())} of them valid)"
        raise InputError(
            f"level {level} of the sample has {rows} x {cols} texels{valid}, too few for a neighbourhood of"
            f" {side} x {side}; take fewer --levels or a larger sample."
        )
    return Exemplar(
        _tables(here, side, features.toroidal, distance),
        _tables(below, coarse_side, features.toroidal, distance),
        lists,
        rows,
        cols,
        usable.ravel(),
        tuple(bounding_box(usable)),
        features.toroidal,
    )


def cut(features, levels):
    """The features' first levels, so that the last of them has a one-level neighbourhood.

    Raises
    ------
    InputError
        If there are fewer.
    """
    have = len(features.levels)
    if have < levels:
        raise InputError(
            f"the features have {have} levels, fewer than --levels {levels}; lower it, or make more with"
            " `btfpipe textons`."
        )
    return features if have == levels else type(features)(features.levels[:levels], features.about)


def _tables(level, side, toroidal, distance):
    none = np.zeros((0, 0), np.float32)
    if level is None:
        return _with_views(
            0, np.zeros((0, 0), np.int32), none, np.zeros((0, 0, 0), np.float32), none
        )
    margin = ((side // 2, side // 2),) * 2
    mode = "wrap" if toroidal else "edge"
    labels = np.ascontiguousarray(np.pad(level.labels, margin, mode), np.int32)
    if distance is None:
        few = level.gram is not None or len(level.vectors) <= TABLE_LIMIT
        distance = "gram" if few else "vectors"
    if distance == "gram":
        if level.gram is None and len(level.vectors) > 4 * TABLE_LIMIT:
            raise InputError(
                f"a dot-product matrix of {len(level.vectors)} vectors would take"
                f" {amount(4 * len(level.vectors) ** 2)}; leave --distance out, or make textons of them."
            )
        table = _square_distances(level)
        return _with_views(side, labels, table, np.zeros((0, 0, 0), np.float32), none)
    vectors = np.ascontiguousarray(level.vectors, np.float32)
    return _with_views(side, labels, none, vectors[labels], vectors)


def _with_views(side, labels, table, image, vectors):
    flat = (
        labels.ravel(),
        table.ravel(),
        image.ravel(),
        labels.shape[1],
        table.shape[0],
        image.shape[2],
    )
    return Tables(side, labels, table, image, vectors, flat)


def _square_distances(level):
    """|t_i - t_j|^2 = G_ii + G_jj - 2 G_ij for all pairs of vectors, (n + 1, n + 1) float32."""
    if level.gram is not None:
        gram = np.asarray(level.gram, np.float64)
    else:
        vectors = np.asarray(level.vectors, np.float64)
        vectors = vectors - vectors.mean(axis=0)
        with single_threaded_blas():
            gram = vectors @ vectors.T
    square = np.diagonal(gram)
    table = np.maximum(square[:, None] + square[None] - 2 * gram, 0)
    np.fill_diagonal(table, 0)
    return np.ascontiguousarray(table, np.float32)


@njit(cache=True, inline="always")
def texel_under(row, col, exemplar):
    """Nearest texel ``row * cols + col`` of a coordinate, -1 beyond the border of a sample that is not toroidal."""
    r = int(np.floor(row + 0.5))
    c = int(np.floor(col + 0.5))
    if exemplar.toroidal:
        r %= exemplar.rows
        c %= exemplar.cols
    elif r < 0 or r >= exemplar.rows or c < 0 or c >= exemplar.cols:
        return -1
    return r * exemplar.cols + c


@njit(cache=True, inline="always")
def random_texel(sample, usable, seed, item):
    """A texel to start from: one within the bounds, or where that is not usable one of ``usable`` (n,), which all are."""
    low, high, left, right = sample.inside
    r = low + int(uniform(seed, item, 0) * (high - low))
    c = left + int(uniform(seed, item, 1) * (right - left))
    texel = r * sample.cols + c
    if not sample.usable[texel]:
        texel = usable[int(uniform(seed, item, 2) * len(usable))]
    return texel


@njit(cache=True, inline="always")
def wrapped(x, size):
    """The coordinate moved by whole periods into [-0.5, size - 0.5)."""
    return x - size * np.floor((x + 0.5) / size)


__all__ = [
    "Exemplar",
    "Tables",
    "coarse_texel",
    "cut",
    "exemplar",
    "random_texel",
    "texel_under",
    "wrapped",
]
