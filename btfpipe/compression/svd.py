"""Full-matrix SVD (Zhou et al. 2005, section III): texels x (pairs and channels), n terms, no mean removed.

The product of two factors: eigen-textures over the texels, and angular factors over pairs and channels, whose
linear combination gives any picture. Its error is the least that n terms can have (Eckart-Young).

The factors come from a randomised subspace iteration (Halko, Martinsson and Tropp 2011, section 4.5) that reads
the pictures once an iteration: with the matrix `A` (texels, pairs and channels) cut into blocks of columns, the
same pass yields ``A^T Q`` for the answer and ``A A^T Q`` for the next iteration. It starts from the answer for an
eighth of the pictures, which is nearly right and nearly free, and shifts ``A A^T`` so that the terms beyond the
wanted ones die out faster (Feng and Yu 2023).
"""

import math

import numpy as np

from btfpipe.compiled import njit
from btfpipe.compression.model import Model, measured_error, require_summable, sum_of_squares
from btfpipe.errors import InputError, too_little
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import ShadingNeeds
from btfpipe.sample.transfer import decode_table

_OVERSAMPLING = 10
_GROUPS = 32  # partial sums a pass, added in order; fixed, so that threads and memory never show
_DECODED_BYTES = 6 << 20  # linear pictures in a thread's hands; fixed, as sums hang on it
LEAST_PICTURES = 8  # in a thread's hands, however large: products with fewer only wait for memory
_TEXELS = 1 << 14  # whose sums are added at a time; fixed
_FIRST_SHARE = 8  # one in so many pictures for the start
_FIRST_PASSES = 3
_TRACE = 2.0**-40  # of noise to the RMS in the start, where rounding has 2^-46 and terms 2^-30
_MOST_ITERATIONS = 8
_GOOD_ENOUGH = 0.005  # share by which the error may exceed the least possible, by the estimate
_PROCESS_BYTES = 104 << 20  # Python and its libraries, before any work


class SvdModel(Model):
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

    method = "svd"

    def __init__(self, texture_factors, angular_factors, source, about=None):
        super().__init__(texture_factors.shape[:2], source, about)
        self.texture_factors = texture_factors
        self.angular_factors = angular_factors

    @property
    def n_terms(self):
        return self.texture_factors.shape[2]

    def arrays(self):
        return {"texture_factors": self.texture_factors, "angular_factors": self.angular_factors}

    @classmethod
    def from_arrays(cls, reader, source):
        texture = reader.require("texture_factors", (None, None, None), "f")
        angular = reader.require(
            "angular_factors", (len(source.light_index), 3, texture.shape[2]), "f"
        )
        return cls(texture, angular, source, reader.about)

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

    @classmethod
    def shading_needs(cls, reader):
        names = ("texture_factors", "angular_factors")
        factors = [reader.require(name, (None,) * 3, "f", finite=False) for name in names]
        # single precision stays mapped
        kept = sum(4 * f.size for f in factors if f.dtype != np.float32)
        return ShadingNeeds(kept, max(f.size for f in factors), levels=2 * factors[0].size)

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.svd_shading import SvdShader

        return SvdShader(self, interpolation)


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
        Read in blocks of pictures, about `iterations` + 2.4 times.
    n_terms : int
        At least 1. No more than min(texels, 3 pairs) exist, and terms whose singular value is rounding noise are
        left out, so that the Model may have fewer.
    iterations : int, optional
        Power iterations over all pictures. By default they stop when the RMS error is estimated to be within
        0.5 % of the least possible, after 8 at the latest.
    precision : str
        Of the factors: ``half`` or ``single``.
    seed : int
        Of the random start.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within; limits how many blocks are worked on at a time, never the
        result.
    on_progress : callable, optional
        Called with (pictures read, pictures to read).

    Returns
    -------
    SvdModel
        Its ``about`` holds `n_terms`, `iterations`, `singular_values`, `excess` (the estimate: error over the
        least possible, less 1), and, measured on the factors as stored
        and over all linear values, `rmse` and `relative_error` (RMS of the error over RMS of the values).

    Raises
    ------
    InputError
        No terms, non-finite pictures, values too large for sums in single precision, values beyond half precision, or too little memory.
    """
    texture, angular, facts = factorise(
        sample, n_terms, iterations=iterations, precision=precision, seed=seed, threads=threads,
        memory=memory, on_progress=on_progress,
    )  # fmt: skip
    warnings = left_out(sample, n_terms, facts["n_terms"])
    if warnings:
        facts["warnings"] = warnings
    model = SvdModel(texture.reshape(*sample.shape, -1), angular, sample, facts)
    if model.mask is not None:
        model.about |= measured_error(model, sample, threads=threads)
    return model


def left_out(sample, n_terms, have, channels=3):
    """Warnings, a list of sentences, if `factorise` made fewer terms than were asked for."""
    texels, most = sample.shape[0] * sample.shape[1], _most_terms(sample, channels)
    warnings = []
    if n_terms > most:
        of = " of three channels" if channels == 3 else ""
        warnings.append(
            f"{texels} texels and {sample.n_pairs} pairs{of} have at most {most} terms:"
            f" {n_terms - most} terms left out"
        )
    if have < min(n_terms, most):
        what = "sample" if channels == 3 else "channel"
        warnings.append(f"the {what}'s rank is {have}: {min(n_terms, most) - have} terms left out")
    return warnings


def _most_terms(sample, channels=3):
    """As many terms as a matrix of the pictures can have."""
    return min(sample.shape[0] * sample.shape[1], channels * sample.n_pairs)


def factorise(
    sample,
    n_terms,
    *,
    rows=None,
    channels=3,
    measure=True,
    iterations=None,
    precision="half",
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Factorise a matrix whose rows are made from the pictures of a Sample; see `compress_svd`.

    Parameters
    ----------
    rows : callable, optional
        ``rows(sample, pairs)`` gives the matrix's rows (pairs * channels, texels) float32; by default the
        linear values, `planar_pictures`.
    channels : int
        Rows that each picture makes.
    measure : bool
        Read the pictures once more for the error of the stored factors.

    Returns
    -------
    texture : (texels, n), angular : (pairs, channels, n)
        Float16 or float32.
    facts : dict
        As `compress_svd` keeps them; ``rmse`` and ``relative_error`` only if measured.
    """
    if precision not in ("half", "single"):
        raise InputError(f"precision {precision!r}; expected half or single.")
    texels = sample.shape[0] * sample.shape[1]
    if n_terms < 1:
        raise InputError(f"{n_terms} terms asked for; expected at least 1.")
    n_terms, width, n_first = _sizes(sample, n_terms, channels)
    import scipy.linalg  # noqa: F401 (before its BLAS is limited to one thread)

    most_passes = _most_passes(iterations)
    rng = np.random.default_rng(seed)
    first = np.sort(rng.choice(sample.n_pairs, n_first, replace=False))
    total = pictures_to_read(sample, n_terms, channels, iterations, measure)
    passes = _Passes(
        sample, rows or planar_pictures, channels, width, threads, memory, total, on_progress
    )
    with single_threaded_blas():
        basis = rng.standard_normal((texels, width), np.float32)
        for _ in range(_FIRST_PASSES):
            basis = _orthonormal(basis)
            basis = passes.power(basis, first)[1]
        # where the start's pictures are black or span too little, columns are 0 or rounding, blind to what other
        # pictures show; noise takes their place
        noise = rng.standard_normal(basis.shape, np.float32)
        noise *= np.float32(math.sqrt(sum_of_squares(basis) / basis.size) * _TRACE or 1)
        basis += noise
        del noise
        shift = 0.0
        for iteration in range(most_passes):
            basis = _orthonormal(basis)
            weights, image, energy = passes.power(basis)
            flat = weights.reshape(-1, width).astype(np.float64)
            values, turn = np.linalg.eigh(flat.T @ flat)
            values, turn = np.maximum(values[::-1], 0), turn[:, ::-1]
            excess = _excess(basis, image, values, turn[:, :n_terms], energy)
            if (iterations is None and excess <= _GOOD_ENOUGH) or iteration + 1 == most_passes:
                break
            shift = max(shift, float(values[-1]) / 2)
            basis *= np.float32(shift)
            image -= basis
            basis, image = image, None  # four arrays of this size are all there may be
        singular = np.sqrt(values[:n_terms])
        n_terms = max(1, int((singular > 1e-6 * singular[0]).sum()))
        singular, turn = singular[:n_terms], turn[:, :n_terms]
        root = np.sqrt(singular)
        texture = basis @ (turn * root).astype(np.float32)
        angular = (flat @ turn / np.where(root > 0, root, 1)).reshape(
            sample.n_pairs, channels, n_terms
        )
        del basis, image
        dtype = np.float16 if precision == "half" else np.float32
        _require_range(dtype, texture, angular)
        texture, angular = texture.astype(dtype), angular.astype(dtype)
        facts = {
            "n_terms": n_terms,
            "iterations": iteration,
            "excess": excess,
            "precision": precision,
        }
        if measure:
            squared = passes.squared_error(texture, angular)
            facts |= {
                "rmse": math.sqrt(squared / (channels * texels * sample.n_pairs)),
                "relative_error": math.sqrt(squared / energy) if energy > 0 else 0.0,
            }
    facts["singular_values"] = [float(f"{value:.6g}") for value in singular]
    passes.finish()
    return texture, angular, facts


def pictures_to_read(sample, n_terms, channels=3, iterations=None, measure=True):
    """The most pictures that `factorise` reads, as its progress counts them."""
    n_first = _sizes(sample, n_terms, channels)[2]
    return _FIRST_PASSES * n_first + (_most_passes(iterations) + measure) * sample.n_pairs


def _most_passes(iterations):
    return (_MOST_ITERATIONS if iterations is None else iterations) + 1


def _sizes(sample, n_terms, channels):
    """Terms that can exist, columns of the subspace, and pictures for the start."""
    most = _most_terms(sample, channels)
    n_terms = min(n_terms, most)
    width = min(n_terms + _OVERSAMPLING, most)
    return n_terms, width, min(sample.n_pairs, max(sample.n_pairs // _FIRST_SHARE, width))


def _orthonormal(columns):
    """An orthonormal basis of the columns, in single precision throughout (numpy's QR would double it)."""
    from scipy.linalg import qr

    return np.ascontiguousarray(qr(columns, mode="economic", check_finite=False)[0])


def _excess(basis, image, values, turn, energy):
    """Estimate by what share the error exceeds the least that as many terms can have.

    Kato and Temple: a Ritz value of ``A A^T`` is too small by about its residual squared over the gap to the
    spectrum left out, here taken to start at the least Ritz value. Near convergence this is true to some 20 %.

    Parameters
    ----------
    basis, image : (texels, width) float32
        Orthonormal columns Q, and ``A A^T Q``.
    values, turn : (width,), (width, n) float64
        Ritz values, falling, and the first n Ritz vectors in the basis.
    energy : float
        Squared norm of A.
    """
    width = basis.shape[1]
    kept = values[: turn.shape[1]]
    turn, squares = turn.astype(np.float32), 0.0
    for some in blocks(len(basis), _TEXELS):
        residual = image[some] @ turn
        residual -= (basis[some] @ turn) * kept.astype(np.float32)
        squares = squares + np.square(residual, dtype=np.float64).sum(axis=0)
    outside = values[-1] if width > turn.shape[1] else 0.0
    rounding = 1e-7 * energy
    error = max(energy - kept.sum(), 0.0)
    if error <= rounding:
        return 0.0
    deficit = (squares / np.maximum(kept - outside, rounding)).sum()
    return math.sqrt(error / max(error - deficit, 1e-4 * error)) - 1


def _require_range(dtype, *factors):
    largest = max(float(np.abs(factor).max()) for factor in factors)
    limit = float(np.finfo(dtype).max)
    if largest > limit:
        raise InputError(
            f"the factors reach {largest:.3g}, beyond half precision ({limit:.0f});"
            " pass --precision single."
        )


class _Passes:
    """Passes over a Sample's pictures: groups of fixed size on threads, results summed in their order."""

    def __init__(self, sample, rows, channels, width, threads, memory, total, on_progress):
        self.sample, self.rows, self.channels = sample, rows, channels
        self.total, self.on_progress = total, on_progress
        self.texels = sample.shape[0] * sample.shape[1]
        # pictures decoded at a time; each time the whole basis is read
        self.step = max(LEAST_PICTURES, width // 8, _DECODED_BYTES // (12 * self.texels))
        self.step = min(self.step, math.ceil(sample.n_pairs / _GROUPS))
        self.done = 0
        vectors = 4 * width * self.texels  # one array of as many columns as the subspace
        # the weights, also in double precision and turned; then what QR takes, or a pass
        fixed = _PROCESS_BYTES + 4 * width * 6 * channels * sample.n_pairs
        each = vectors + 36 * self.step * self.texels  # a partial sum; pictures being decoded
        each += 4 * width * min(_TEXELS, self.texels)
        need = fixed + max(4 * vectors, 2 * vectors + each)
        if need > memory:
            raise InputError(
                f"{width} vectors of {self.texels} texels need"
                f" {too_little(need, memory)}, or ask for fewer components."
            )
        self.at_once = int(min((memory - fixed - 2 * vectors) // each, 2 * threads))
        self.threads = min(threads, self.at_once)

    def _groups(self, work, chosen=None):
        """Apply `work` to each group's list of pairs; yields (slice of the chosen pairs, result)."""
        count = self.sample.n_pairs if chosen is None else len(chosen)
        groups = blocks(count, math.ceil(count / _GROUPS))

        def run(group):
            steps = [
                slice(start, min(start + self.step, group.stop))
                for start in range(group.start, group.stop, self.step)
            ]
            return work(steps if chosen is None else [chosen[step] for step in steps])

        results = ordered_map(run, groups, self.threads, ahead=self.at_once)
        for group, result in zip(groups, results, strict=True):
            yield group, result
            self.done += group.stop - group.start
            if self.on_progress is not None:
                self.on_progress(self.done, self.total)

    def finish(self):
        if self.on_progress is not None:
            self.on_progress(self.total, self.total)

    def power(self, basis, chosen=None):
        """``A^T Q`` (pairs, channels, width), ``A A^T Q`` (texels, width) and the squared norm of the matrix.

        `chosen` restricts the matrix to some pairs.
        """
        count = self.sample.n_pairs if chosen is None else len(chosen)
        weights = np.empty((count, self.channels, basis.shape[1]), np.float32)
        image = np.zeros(basis.shape, np.float32)
        energy = 0.0

        def work(steps):
            parts, sum_, squares = [], np.zeros_like(image), 0.0
            for pairs in steps:
                values = self.rows(self.sample, pairs)
                squares += sum_of_squares(values)
                require_summable(squares)
                parts.append(values @ basis)
                for some in blocks(self.texels, _TEXELS):
                    sum_[some] += values[:, some].T @ parts[-1]
            return np.concatenate(parts), sum_, squares

        for group, (part, sum_, squares) in self._groups(work, chosen):
            energy += squares
            require_summable(energy)
            weights[group] = part.reshape(-1, self.channels, basis.shape[1])
            image += sum_
        return weights, image, energy

    def squared_error(self, texture, angular):
        """Sum of squared differences between the matrix and the product of its stored factors."""
        texture = np.ascontiguousarray(texture.T, np.float32)

        def work(steps):
            total = 0.0
            for pairs in steps:
                values = self.rows(self.sample, pairs)
                weights = np.asarray(angular[pairs], np.float32)
                values -= weights.reshape(-1, len(texture)) @ texture
                total += sum_of_squares(values)
            return total

        return sum(part for _, part in self._groups(work))


def planar_pictures(sample, pairs, lines=slice(None)):
    """Linear pictures as rows (pairs * 3, texels) float32, a channel a row; 8-bit codes by table.

    Of the texels, those of some scan lines (a slice); of a Sample, no others are read.
    """
    codes = getattr(sample, "codes", None)
    if codes is not None and codes.dtype == np.uint8 and sample.gain is None:
        table = decode_table(np.uint8, sample.transfer, sample.scale)
        return planar_codes(codes[pairs, lines], table)
    if codes is None:
        values = sample.pictures(pairs)[:, lines]
    else:
        values = sample.decode(np.asarray(codes[pairs, lines]))
        if sample.gain is not None:
            values = values * sample.gain[lines]
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2)).reshape(3 * len(values), -1)


def planar_codes(codes, table):
    """Table values of 8-bit codes (pairs, rows, cols, 3) as rows (pairs * 3, texels) float32."""
    codes = np.ascontiguousarray(codes)
    codes = codes.reshape(len(codes), -1, 3)
    values = np.empty((len(codes), 3, codes.shape[1]), np.float32)
    decode_planar(codes, table, values)
    return values.reshape(3 * len(codes), -1)


@njit(cache=True, nogil=True)
def decode_planar(codes, table, out):
    """Fill ``out`` (pairs, 3, texels) with table values of ``codes`` (pairs, texels, 3)."""
    for p in range(codes.shape[0]):
        for t in range(codes.shape[1]):
            out[p, 0, t] = table[codes[p, t, 0]]
            out[p, 1, t] = table[codes[p, t, 1]]
            out[p, 2, t] = table[codes[p, t, 2]]
