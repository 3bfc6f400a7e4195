"""Full-matrix SVD (Zhou et al. 2005, section 4): texels x (pairs and channels), n terms, no mean removed.

The product of two factors: eigen-textures over the texels, and angular factors over pairs and channels, whose
linear combination gives any picture. Its error is the least that n terms can have (Eckart-Young).

The factors come from a randomised subspace iteration (Halko, Martinsson and Tropp 2011, section 4.5) that reads
the pictures once an iteration: with the matrix `A` (texels, pairs and channels) cut into blocks of columns, the
same pass yields ``A^T Q`` for the answer and ``A A^T Q`` for the next iteration.
"""

import functools
import math

import numpy as np
from numba import njit

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import Appearance
from btfpipe.sample.transfer import decode_table

_OVERSAMPLING = 10
_GROUPS = 32  # partial sums a pass, added in order; fixed, so that threads and memory never show
_DECODED_BYTES = 16 << 20  # linear pictures in a thread's hands; fixed, since sums depend on it too
_MOST_ITERATIONS = 8
_GOOD_ENOUGH = 0.004  # stop when an iteration lowers the error by a smaller share


class SvdModel(Appearance):
    """A Sample as ``value[texel, pair, channel] = sum_n texture[texel, n] * angular[pair, channel, n]``.

    Parameters
    ----------
    texture_factors : (rows, cols, n) float16 or float32
        Eigen-textures.
    angular_factors : (pairs, 3, n) float16 or float32
        Weights of the eigen-textures in each picture and channel. Columns are orthogonal in both factors, and
        both carry the square root of the singular value, so that neither leaves the range of half precision.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm.
    """

    def __init__(self, texture_factors, angular_factors, source, about=None):
        self.texture_factors = texture_factors
        self.angular_factors = angular_factors
        self.shape = texture_factors.shape[:2]
        for name in (
            "light_directions",
            "view_directions",
            "light_index",
            "view_index",
            "toroidal",
            "texels_per_mm",
        ):
            setattr(self, name, getattr(source, name))
        self.absolute = getattr(source, "absolute", False)
        self.about = dict(about or {})

    @property
    def n_terms(self):
        return self.texture_factors.shape[2]

    @classmethod
    def from_reader(cls, reader):
        """Map the Model from its file."""
        from types import SimpleNamespace

        about = reader.about
        texture = reader.require("texture_factors", (None, None, None), "f")
        source = SimpleNamespace(
            light_directions=reader.require("light_directions", (None, 3), "f"),
            view_directions=reader.require("view_directions", (None, 3), "f"),
            light_index=reader.require("light_index", (None,), "iu"),
            view_index=reader.require("view_index", (None,), "iu"),
            toroidal=about["toroidal"],
            texels_per_mm=about["texels_per_mm"],
            absolute=about["absolute"],
        )
        angular = reader.require(
            "angular_factors", (len(source.light_index), 3, texture.shape[2]), "f"
        )
        return cls(texture, angular, source, about)

    def save(self, path):
        """Write the Model."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        about |= {
            "method": "svd",
            "toroidal": self.toroidal,
            "texels_per_mm": self.texels_per_mm,
            "absolute": self.absolute,
        }
        names = ("light_directions", "view_directions", "light_index", "view_index")
        arrays = {name: getattr(self, name) for name in names}
        arrays["texture_factors"] = self.texture_factors
        arrays["angular_factors"] = self.angular_factors
        store.write(path, "model", arrays, **about)

    def pictures(self, pairs):
        angular = np.asarray(self.angular_factors[pairs], np.float32)
        texture = np.asarray(self.texture_factors, np.float32).reshape(-1, self.n_terms)
        values = angular.reshape(-1, self.n_terms) @ texture.T
        return np.ascontiguousarray(
            values.reshape(len(angular), 3, *self.shape).transpose(0, 2, 3, 1)
        )

    def texels(self, rows, cols):
        texture = np.asarray(self.texture_factors[rows, cols], np.float32)
        angular = np.asarray(self.angular_factors, np.float32).reshape(-1, self.n_terms)
        return (texture @ angular.T).reshape(len(texture), -1, 3)

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.svd_shading import SvdShader

        return SvdShader(self, interpolation)

    @property
    def nbytes(self):
        return int(
            sum(
                a.nbytes
                for a in (
                    self.texture_factors,
                    self.angular_factors,
                    self.light_directions,
                    self.view_directions,
                )
            )
        )


def compress_svd(
    sample,
    n_terms=40,
    *,
    iterations=None,
    precision="half",
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Factorise a Sample by the singular value decomposition of all its linear values.

    Parameters
    ----------
    sample : Appearance
        Read in blocks of pictures, `iterations` + 2 times.
    n_terms : int
        At most min(texels, 3 pairs). Terms whose singular value is rounding noise are left out, so that the
        Model may have fewer.
    iterations : int, optional
        Power iterations after the first pass. By default they stop when one more lowers the RMS error by
        less than 0.4 %, after 8 at the latest.
    precision : str
        Of the factors: ``half`` or ``single``.
    seed : int
        Of the random start.
    threads : int
        Never changes the result.
    memory : int
        Bytes to stay within; limits how many blocks are worked on at a time, never the result.
    on_progress : callable, optional
        Called with (pictures read, pictures to read).

    Returns
    -------
    SvdModel
        Its ``about`` holds `n_terms`, `iterations`, `singular_values`, and, measured on the factors as stored
        and over all linear values, `rmse` and `relative_error` (RMS of the error over RMS of the values).

    Raises
    ------
    InputError
        Too many terms, non-finite pictures, values beyond half precision, or too little memory.
    """
    if precision not in ("half", "single"):
        raise InputError(f"precision {precision!r}; expected half or single.")
    texels = sample.shape[0] * sample.shape[1]
    most = min(texels, 3 * sample.n_pairs)
    if not 1 <= n_terms <= most:
        raise InputError(
            f"{n_terms} terms of a sample of {texels} texels and {sample.n_pairs} pairs; expected 1 to {most},"
            " the lesser of texels and pairs times channels."
        )
    width = min(n_terms + _OVERSAMPLING, most)
    groups = blocks(sample.n_pairs, math.ceil(sample.n_pairs / _GROUPS))
    step = max(1, _DECODED_BYTES // (12 * texels))
    at_once = _groups_within(memory, texels, sample.n_pairs, width, min(step, groups[0].stop))
    most_iterations = _MOST_ITERATIONS if iterations is None else iterations
    done, total = 0, sample.n_pairs * (most_iterations + 2)

    def each_group(work):
        nonlocal done
        results = ordered_map(work, groups, min(threads, at_once), ahead=at_once)
        for group, result in zip(groups, results, strict=True):
            yield group, result
            done += group.stop - group.start
            if on_progress is not None:
                on_progress(done, total)

    basis = np.random.default_rng(seed).standard_normal((texels, width), np.float32)
    error = math.inf
    with single_threaded_blas():
        for used in range(most_iterations + 1):
            basis = np.linalg.qr(basis)[0]
            weights = np.empty((sample.n_pairs, 3, width), np.float32)
            image = np.zeros((texels, width), np.float32)
            energy = 0.0
            work = functools.partial(_pass, sample, basis, step)
            for group, (weights[group], part, squares) in each_group(work):
                image += part
                energy += squares
            if not math.isfinite(energy):
                raise InputError("the sample holds non-finite values; `btfpipe info` counts them.")
            flat = weights.reshape(-1, width).astype(np.float64)
            values, turn = np.linalg.eigh(flat.T @ flat)
            values, turn = np.maximum(values[::-1], 0), turn[:, ::-1]
            before, error = error, math.sqrt(max(energy - values[:n_terms].sum(), 0))
            if iterations is None and error >= (1 - _GOOD_ENOUGH) * before:
                break
            basis = image
        singular = np.sqrt(values[:n_terms])
        n_terms = max(1, int((singular > 1e-6 * singular[0]).sum()))
        singular, turn = singular[:n_terms], turn[:, :n_terms]
        root = np.sqrt(np.maximum(singular, np.finfo(np.float32).tiny))
        texture = (basis @ turn * root).reshape(*sample.shape, n_terms)
        angular = (flat @ turn / root).reshape(sample.n_pairs, 3, n_terms)
        dtype = np.float16 if precision == "half" else np.float32
        _require_range(dtype, texture, angular)
        model = SvdModel(texture.astype(dtype), angular.astype(dtype), sample)
        work = functools.partial(_squared_error, sample, model, step)
        squared_error = sum(part for _, part in each_group(work))
    model.about = {
        "n_terms": n_terms,
        "iterations": used,
        "precision": precision,
        "rmse": math.sqrt(squared_error / (3 * texels * sample.n_pairs)),
        "relative_error": math.sqrt(squared_error / energy) if energy > 0 else 0.0,
        "singular_values": [float(f"{value:.6g}") for value in singular],
    }
    if on_progress is not None:
        on_progress(total, total)
    return model


def _groups_within(memory, texels, pairs, width, step):
    """How many groups may be in work or waiting at a time; each holds its pictures and a partial sum."""
    fixed = (
        4 * width * (3 * texels + 3 * pairs * 4)
    )  # basis, sum, QR's copy; weights, also in double
    each = 4 * width * 2 * texels + step * texels * 3 * 6
    if fixed + each > memory:
        need = (fixed + each) / (1 << 20)
        raise InputError(
            f"{width} vectors of {texels} texels need {need:.0f} MB; --memory allows {memory >> 20} MB."
            " Raise it, or ask for fewer components."
        )
    return int((memory - fixed) // each)


def _require_range(dtype, *factors):
    largest = max(float(np.abs(factor).max()) for factor in factors)
    if largest > np.finfo(dtype).max:
        raise InputError(
            f"the factors reach {largest:.3g}, beyond half precision ({np.finfo(dtype).max:.0f});"
            " pass --precision single."
        )


def _pass(sample, basis, step, group):
    """For the pictures of `group`: ``A^T Q`` (pairs, 3, width), their share of ``A A^T Q``, squares."""
    texels, width = basis.shape
    weights = np.empty((group.stop - group.start, 3, width), np.float32)
    image = np.zeros((texels, width), np.float32)
    share = np.empty_like(image)
    squares = 0.0
    for start in range(group.start, group.stop, step):
        pairs = slice(start, min(start + step, group.stop))
        values = planar_pictures(sample, pairs)
        part = np.matmul(values, basis)
        image += np.matmul(values.T, part, out=share)
        weights[pairs.start - group.start : pairs.stop - group.start] = part.reshape(-1, 3, width)
        squares += float(np.vecdot(values, values).sum(dtype=np.float64))
    return weights, image, squares


def _squared_error(sample, model, step, group):
    """Sum of squared differences over the pictures of `group`."""
    texture = np.asarray(model.texture_factors, np.float32).reshape(-1, model.n_terms)
    total = 0.0
    for start in range(group.start, group.stop, step):
        pairs = slice(start, min(start + step, group.stop))
        values = planar_pictures(sample, pairs)
        angular = np.asarray(model.angular_factors[pairs], np.float32).reshape(-1, model.n_terms)
        values -= angular @ texture.T
        total += float(np.vecdot(values, values).sum(dtype=np.float64))
    return total


def planar_pictures(sample, pairs):
    """Linear pictures as rows (pairs * 3, texels) float32, a channel a row; 8-bit codes by table."""
    codes = getattr(sample, "codes", None)
    if codes is None or codes.dtype != np.uint8 or sample.gain is not None:
        values = sample.pictures(pairs)
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2)).reshape(3 * len(values), -1)
    codes = np.asarray(codes[pairs]).reshape(-1, sample.shape[0] * sample.shape[1], 3)
    values = np.empty((len(codes), 3, codes.shape[1]), np.float32)
    decode_planar(codes, decode_table(np.uint8, sample.transfer, sample.scale), values)
    return values.reshape(3 * len(codes), -1)


@njit(cache=True, nogil=True)
def decode_planar(codes, table, out):
    """Fill ``out`` (pairs, 3, texels) with table values of ``codes`` (pairs, texels, 3)."""
    for p in range(codes.shape[0]):
        for t in range(codes.shape[1]):
            out[p, 0, t] = table[codes[p, t, 0]]
            out[p, 1, t] = table[codes[p, t, 1]]
            out[p, 2, t] = table[codes[p, t, 2]]
