"""Image pyramids of feature images, and Features straight from a feature image."""

import math

import numpy as np

from btfpipe.analysis.features import FeatureLevel, Features
from btfpipe.errors import InputError


def halve(image, toroidal):
    """One pyramid step: the low-pass (1, 3, 3, 1) / 8 along both axes, then every second texel.

    Texel x of the finer level is at (x + 0.5) / 2 - 0.5 of the coarser one, so a coarse texel is the centre of the
    2 x 2 texels that it stands for. Beyond the border a toroidal image goes on at the opposite side; any other is mirrored.

    Parameters
    ----------
    image : (rows, cols, ...) array
        Even rows and cols.
    toroidal : bool

    Returns
    -------
    (rows / 2, cols / 2, ...) array
    """
    for axis in (0, 1):
        pad = [(0, 0)] * image.ndim
        pad[axis] = (1, 1)
        padded = np.moveaxis(np.pad(image, pad, "wrap" if toroidal else "symmetric"), axis, 0)
        outer = padded[0:-3:2] + padded[3::2]
        inner = padded[1:-2:2] + padded[2:-1:2]
        image = np.moveaxis((outer + 3 * inner) / np.asarray(8, image.dtype), 0, axis)
    return image


def valid_pyramid(mask, levels, toroidal):
    """Which texels are valid on each level of a pyramid: those that `halve` makes of valid texels alone.

    Parameters
    ----------
    mask : (rows, cols) bool or None
        Of the finest level; None if all are valid.
    levels : int
    toroidal : bool

    Returns
    -------
    list of (rows, cols) bool, or of None

    Raises
    ------
    InputError
        If a level has none.
    """
    if mask is None:
        return [None] * levels
    finest = mask = np.asarray(mask, bool)
    made = []
    for level in range(levels):
        if level:
            mask = halve(mask.astype(np.float32), toroidal) == 1
        if not mask.any():
            if not level:
                raise InputError("the sample has no valid texel.")
            raise InputError(
                f"the sample has no valid texel on level {level}: {int((~finest).sum())} of its {finest.size} are invalid."
                " Take fewer levels, or crop it to a part that is valid."
            )
        made.append(mask)
    return made


def fill_invalid(image, mask, toroidal):
    """An image (rows, cols, d) whose invalid texels repeat the nearest valid one, as pictures repeat their border."""
    from scipy.ndimage import distance_transform_edt

    pad = [(n + 1) // 2 if toroidal else 0 for n in mask.shape]
    invalid = np.pad(~np.asarray(mask, bool), [(n, n) for n in pad], "wrap")
    nearest = distance_transform_edt(invalid, return_distances=False, return_indices=True)
    rows, cols = (slice(n, n + size) for n, size in zip(pad, mask.shape, strict=True))
    row, col = (
        (index[rows, cols] - n) % size
        for index, n, size in zip(nearest, pad, mask.shape, strict=True)
    )
    return image[row, col]


def check_pyramid(shape, levels, neighbourhood, coarse_neighbourhood, what="the sample"):
    """Refuse a sample that is too small, or of the wrong size, for its pyramid.

    Raises
    ------
    InputError
        If a side cannot be halved ``levels - 1`` times, or a level is smaller than a neighbourhood on it.
    """
    for side, name in (
        (neighbourhood, "neighbourhood"),
        (coarse_neighbourhood, "coarse neighbourhood"),
    ):
        if side < 1 or side % 2 == 0:
            raise InputError(f"{name} of {side} texels; expected an odd number, such as 3 or 5.")
    step = 2 ** (levels - 1)
    if any(n % step for n in shape):
        fitting = " x ".join(str(n // step * step) for n in shape)
        raise InputError(
            f"{what} has {shape[0]} x {shape[1]} texels, which cannot be halved {levels - 1} times; crop it"
            f" to {fitting} or lower the number of levels from {levels}."
        )
    for level in range(levels):
        rows, cols = shape[0] >> level, shape[1] >> level
        side = max(neighbourhood, coarse_neighbourhood if level else 1)
        if min(rows, cols) < side:
            raise InputError(
                f"{what} has {rows} x {cols} texels on level {level}, fewer than its neighbourhood of"
                f" {side} x {side}; take fewer levels, a smaller neighbourhood or a larger sample."
            )


def plain_features(
    image, toroidal=False, levels=3, neighbourhood=5, coarse_neighbourhood=3, mask=None, **about
):
    """Features whose vectors are the texels of a feature image: no textons.

    Parameters
    ----------
    image : (rows, cols, d) array
        Any feature image, compared by Euclidean distance: SVD coordinates, colours, heights.
    toroidal : bool
    levels : int
        Levels of the pyramid, made by `halve`.
    neighbourhood, coarse_neighbourhood : int
        Sides that the synthesis will use; the sample is checked against them.
    mask : (rows, cols) bool, optional
        Valid texels; what the others hold does not matter. All by default.
    **about
        Further facts for ``Features.about``.

    Returns
    -------
    Features
        Without neighbour lists; see `add_neighbour_lists`. The default vector is the level's mean.

    Raises
    ------
    InputError
        If the image is not (rows, cols, d), holds NaN or infinity, is too small, has no valid texel on some level, or its
        values are so large that squared distances of neighbourhoods overflow single precision.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.size == 0:
        raise InputError(f"feature image has shape {image.shape}; expected (rows, cols, features).")
    valid = valid_pyramid(mask, levels, toroidal)
    if mask is not None:
        image = fill_invalid(image, mask, toroidal)
    require_finite(image, "feature image")
    _require_distances(image, neighbourhood, coarse_neighbourhood)
    image = image.astype(np.float32)
    check_pyramid(image.shape[:2], levels, neighbourhood, coarse_neighbourhood, "feature image")
    made = []
    for level in range(levels):
        if level:
            image = halve(image, toroidal)
        made.append(plain_level(image, valid[level]))
    about |= {
        "toroidal": bool(toroidal),
        "neighbourhood": neighbourhood,
        "coarse_neighbourhood": coarse_neighbourhood,
    }
    return Features(made, about)


def plain_level(image, valid=None):
    """One FeatureLevel of a feature image (rows, cols, d): a vector a texel, the mean as default and for invalid texels."""
    rows, cols, depth = image.shape
    vectors = image.reshape(-1, depth)
    kept = slice(None) if valid is None else valid.ravel()
    default = vectors[kept].mean(axis=0, dtype=np.float64, keepdims=True)
    labels = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols)
    if valid is not None:
        labels[~valid] = rows * cols
    return FeatureLevel(
        labels,
        np.concatenate([vectors, default]).astype(np.float32),
    )


def require_finite(image, what):
    """Refuse NaN and infinity in an image (rows, cols, ...), with their number and the first place."""
    bad = ~np.isfinite(image)
    if bad.any():
        row, col = np.argwhere(bad)[0][:2]
        raise InputError(
            f"{what} holds {int(bad.sum())} NaN or infinite values, the first at row {row}, col {col};"
            " every texel needs finite features. Mend or crop the source."
        )


def largest_feature(dimensions, *sides):
    """The greatest value whose squared distances in so many dimensions, summed over squares of these sides, are in single precision."""
    texels = sum(side * side for side in sides)
    return math.sqrt(float(np.finfo(np.float32).max) / (4 * dimensions * texels))


def _require_distances(image, *sides):
    """Refuse values that are larger than `largest_feature`."""
    largest = max(abs(float(image.max())), abs(float(image.min())))
    limit = largest_feature(image.shape[2], *sides)
    if largest > limit:
        raise InputError(
            f"feature image reaches {largest:.3g}; squared distances overflow single precision beyond"
            f" {limit:.3g}. Scale the features down: only their ratios matter."
        )
