"""How far one BTF is from another, picture by picture, streaming."""

import math

import numpy as np

from btfpipe.errors import InputError
from btfpipe.metrics.kernels import (
    N_SUMS,
    WINDOW,
    encode_table,
    ssim_pictures,
    sum_pictures,
    whole_windows,
)
from btfpipe.metrics.pictures import psnr
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas

_SAME_DIRECTION = math.radians(0.05)
_BLOCK_BYTES = 4 << 20  # of one block of linear pictures
_WHITE_QUANTILE = 0.999
_WHITE_PICTURES = 64


def matching_pairs(model, sample):
    """The Model's pair for each of the Sample's.

    Returns
    -------
    (pairs,) int64 or None
        None if a light, a view or a combination of the Sample is missing from the Model (directions are the same
        within 0.05 degrees).
    """
    from scipy.spatial import cKDTree

    have, want = (
        np.concatenate(
            [a.light_directions[a.light_index], a.view_directions[a.view_index]],
            axis=1,
            dtype=np.float64,
        )
        for a in (model, sample)
    )
    found = cKDTree(have).query(want)[1]
    # chords, as the arc cosine cannot tell small angles
    chords = np.linalg.norm((want - have[found]).reshape(-1, 2, 3), axis=2)
    return found if chords.max() <= _SAME_DIRECTION else None


def white_level(sample):
    """The linear value shown as white, and the peak of PSNR; and what it is, in words.

    Returns
    -------
    float, str
    """
    if getattr(sample, "absolute", False):
        return 1.0, "a perfect white diffuser"
    if sample.codes.dtype == np.uint8:
        return sample.scale, "code 255; the absolute scale is unknown"
    chosen = np.unique(np.linspace(0, sample.n_pairs - 1, _WHITE_PICTURES).astype(int))
    white = float(np.quantile(sample.pictures(chosen), _WHITE_QUANTILE))
    return (
        white if white > 0 else 1.0,
        "the 99.9 % quantile of the values; the absolute scale is unknown",
    )


class Comparison:
    """Errors of every picture of a Model against a Sample's; made by `compare`.

    Attributes
    ----------
    rmse, relative_error : (pairs,) float64
        Linear; see `btfpipe.metrics.rmse`.
    display_rmse, ssim : (pairs,) float64
        In the display domain; SSIM of the luma, over windows of valid texels: not a number if there is none, as in pictures
        under 11 texels.
    white : float
        Peak of the linear PSNR, white of the display domain.
    """

    def __init__(self, sums, ssim, count, white):
        self._sums, self._count = sums, count
        self.ssim, self.white = ssim, white
        self.rmse = np.sqrt(sums[:, 0] / count)
        self.relative_error = np.sqrt(sums[:, 0] / np.where(sums[:, 1] > 0, sums[:, 1], np.inf))
        self.display_rmse = np.sqrt(sums[:, 4] / count)

    def overall(self):
        """Figures over all pictures, as plain numbers: errors are None where they have no finite value."""
        error, energy, cross, square, display = self._sums.sum(axis=0)
        count = self._count * len(self._sums)
        best = cross / square if square > 0 else 1.0
        rmse, display_rmse = math.sqrt(error / count), math.sqrt(display / count)
        rest = max(energy - best * cross, 0.0)
        return {
            "linear": {
                "rmse": rmse,
                "psnr_db": _finite(psnr(rmse, self.white)),
                "relative_error": math.sqrt(error / energy) if energy > 0 else None,
                "rmse_after_best_scale": math.sqrt(rest / count),
                "best_scale": best,
            },
            "display": {
                "rmse": display_rmse,
                "psnr_db": _finite(psnr(display_rmse)),
                "ssim": _finite(self.ssim.mean()),
            },
        }

    def order(self):
        """Pairs from the best to the worst by display RMSE."""
        return np.argsort(self.display_rmse, kind="stable")


def _finite(value):
    return float(value) if math.isfinite(value) else None


def model_pictures(model, sample, interpolation=None):
    """A function from a slice of the Sample's pairs to the Model's pictures of them.

    Parameters
    ----------
    interpolation : str, optional
        ``barycentric``, ``four`` or ``nearest``: evaluates the Model between its directions, as rendering does.
        None takes the Model's own pictures of these pairs.

    Raises
    ------
    InputError
        If no interpolation is given and the Model lacks one of the pairs.
    """
    if interpolation is None:
        found = matching_pairs(model, sample)
        if found is None:
            raise InputError(
                "the model lacks some of the sample's directions; pass --interpolation to compare between its own."
            )
        return lambda pairs: model.pictures(found[pairs])
    rows, cols = sample.shape
    row, col = (np.ascontiguousarray(a.ravel(), np.float32) for a in np.indices((rows, cols)))
    shader = model.shader(interpolation)
    w_i = np.asarray(sample.light_directions, np.float32)[sample.light_index]
    w_o = np.asarray(sample.view_directions, np.float32)[sample.view_index]

    def evaluate(pairs):
        out = np.empty((pairs.stop - pairs.start, rows, cols, 3), np.float32)
        for picture, light, view in zip(out, w_i[pairs], w_o[pairs], strict=True):
            directions = (
                np.ascontiguousarray(np.broadcast_to(d, (row.size, 3))) for d in (light, view)
            )
            shader.shade(row, col, *directions, picture.reshape(-1, 3))
        return out

    return evaluate


def compare(model, sample, *, interpolation=None, threads=1, on_progress=None):
    """Compare a Model (or another Sample) with a Sample, at all of the Sample's pairs.

    Parameters
    ----------
    model : Appearance
    sample : Sample
        The reference; its white is the peak. Texels count that are valid in both.
    interpolation : str, optional
        See `model_pictures`.
    threads : int
        Never changes the result.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If the sizes differ, if no texel is valid in both, or as `model_pictures`.
    """
    if tuple(model.shape) != tuple(sample.shape):
        raise InputError(
            f"the model has {model.shape[0]} x {model.shape[1]} texels, the sample"
            f" {sample.shape[0]} x {sample.shape[1]}; compare those of one size."
        )
    rows, cols = sample.shape
    texels = rows * cols
    mask = np.ones((rows, cols), bool)
    for who in (sample, model):
        if who.mask is not None:
            mask &= who.mask
    if not mask.any():
        raise InputError("no texel is valid in both the model and the sample.")
    white = white_level(sample)[0]
    over_white = np.float32(min(1 / white, float(np.finfo(np.float32).max)))
    table = encode_table()
    pictures = model_pictures(model, sample, interpolation)
    windows = whole_windows(mask) if min(rows, cols) >= WINDOW else None
    sums = np.empty((sample.n_pairs, N_SUMS))
    ssim = np.full(sample.n_pairs, np.nan)

    def work(pairs):
        with np.errstate(over="ignore", invalid="ignore"):  # shows in the sums
            reference = np.ascontiguousarray(sample.pictures(pairs)).reshape(-1, texels, 3)
            other = np.ascontiguousarray(pictures(pairs)).reshape(-1, texels, 3)
        lumas = np.empty((2, len(reference), texels), np.float32)
        sum_pictures(reference, other, mask.ravel(), over_white, table, sums[pairs], *lumas)
        if windows is not None:
            ssim_pictures(*lumas.reshape(2, -1, rows, cols), windows, ssim[pairs])
        return pairs.stop

    with single_threaded_blas():
        size = max(1, _BLOCK_BYTES // (12 * texels))
        for done in ordered_map(work, blocks(sample.n_pairs, size), threads):
            if on_progress is not None:
                on_progress(done, sample.n_pairs)
    for who, column in ((sample, 1), (model, 3)):  # sums of squares: finite if the values are
        bad = np.count_nonzero(~np.isfinite(sums[:, column]))
        if bad and hasattr(who, "codes"):
            raise InputError(
                f"{bad} pictures hold non-finite values; `btfpipe info` says in which file."
            )
        if bad:
            raise InputError(
                f"{bad} pictures of the model are not finite: what it makes of the sample's values leaves single"
                " precision. Scale the sample down (`btfpipe ingest --white`)."
            )
    return Comparison(sums, ssim, 3 * int(mask.sum()), white)
