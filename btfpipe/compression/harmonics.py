"""Double spherical harmonics (Leung et al. 2007, section 3.1 and appendix): value = Y_v(w_o) C Y_l(w_i)^T.

Each texel and channel is a matrix of coefficients C (view terms x light terms), found by constrained least squares:
first over the views under each light, then over the lights of each view coefficient (the other order is as good to
0.3 dB; the paper does not say). Directions cover the upper hemisphere only, where the harmonics are far from orthogonal, so that plain least squares answers noise with huge coefficients.
The constraint keeps the squares of each vector of coefficients within the energy of its values, mirrored to the whole
sphere: the smallest lambda of ``(Y^T Y + lambda I) c = Y^T f`` with ``c^T c <= E = (4 pi / M) sum f^2``.

Views are weighted by their squared cosines (`view_weights`), where the paper does not say. Over views as a picture has them that is 0 to 1.1 dB
better (display PSNR, four materials) and keeps deep grooves from turning black; over all measured pairs alike the linear error is 2 to 9 % higher.

With ``Y^T Y`` diagonalised once, lambda is a root of a sum over the terms. Where the paper bisects, Newton's method on
``1 / |c|`` (Moré and Sorensen 1983) climbs to the same root in about five steps: that function is concave, so that
starting from 0 no step passes the root.

Work goes by scan lines (section 5.2), twice: for the range of each coefficient, then for its 8-bit codes and the error.
"""

import math

import numpy as np

from btfpipe import store
from btfpipe.compiled import njit
from btfpipe.compression.model import Model, measured_error, require_summable, sum_of_squares
from btfpipe.directions.spherical_harmonics import highest_degree, spherical_harmonics
from btfpipe.errors import InputError, too_little
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import ShadingNeeds
from btfpipe.sample.transfer import decode_table

_COLS = 32  # texels of a scan line worked on together; fixed, so that memory and threads never show
_LANES = 16  # vectors whose lambda is sought together: a register's width
_MOST_STEPS = 60
_LEAST_COSINE = 0.05  # of a view, so that none goes without weight
_FULL_RANK = 1e-6  # singular values of Y below this share of the largest count as none
_PROCESS_BYTES = 140 << 20  # Python and its libraries, before any work


class HarmonicsModel(Model):
    """A Sample as two sets of spherical harmonics a texel and channel, in 8-bit codes.

    Parameters
    ----------
    codes : (rows, cols, 3, view terms, light terms) uint8
        A coefficient is ``minimum + code / 255 * (maximum - minimum)``.
    minimum, maximum : (3, view terms, light terms) float32
        Range of each coefficient over the texels.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm.
    """

    method = "harmonics"

    def __init__(self, codes, minimum, maximum, source, about=None):
        super().__init__(codes.shape[:2], source, about)
        self.coefficient_codes = codes  # not `codes`, which are a Sample's pictures
        self.minimum, self.maximum = minimum, maximum

    @property
    def view_terms(self):
        return self.coefficient_codes.shape[3]

    @property
    def light_terms(self):
        return self.coefficient_codes.shape[4]

    def arrays(self):
        return {"codes": self.coefficient_codes, "minimum": self.minimum, "maximum": self.maximum}

    @classmethod
    def from_arrays(cls, reader, source):
        codes = reader.require("codes", (None, None, 3, None, None), "u")
        if codes.dtype != np.uint8:
            raise InputError(f"{reader.path}: codes are {codes.dtype}; expected uint8.")
        for terms in codes.shape[3:]:
            highest_degree(terms)
        minimum = reader.require("minimum", codes.shape[2:], "f")
        maximum = reader.require("maximum", codes.shape[2:], "f")
        return cls(codes, minimum, maximum, source, reader.about)

    def step(self):
        """Difference (3, view terms, light terms) float32 between neighbouring codes."""
        return step_of(self.minimum, self.maximum)

    def coefficients(self, rows, cols):
        """Coefficients (n, 3, view terms, light terms) float32 of some texels (two index arrays, or slices)."""
        return np.asarray(self.coefficient_codes[rows, cols]) * self.step() + self.minimum

    def pictures(self, pairs):
        lights = self.light_directions[np.asarray(self.light_index[pairs])]
        view = np.asarray(self.view_index[pairs])
        basis = spherical_harmonics(lights, self.light_terms).astype(np.float32)
        seen, place = np.unique(view, return_inverse=True)
        views = spherical_harmonics(self.view_directions[seen], self.view_terms)
        texels = self.shape[0] * self.shape[1]
        codes = np.asarray(self.coefficient_codes).reshape(
            texels, 3, self.view_terms, self.light_terms
        )
        out = np.empty((len(view), texels, 3), np.float32)
        from_view = np.empty((texels, 3, self.light_terms), np.float32)
        for k, weights in enumerate(views):
            _contract_views(codes, self.minimum, self.step(), weights.astype(np.float32), from_view)
            chosen = place == k
            out[chosen] = np.matmul(
                basis[chosen], from_view.reshape(3 * texels, self.light_terms).T
            ).reshape(-1, texels, 3)
        return out.reshape(len(view), *self.shape, 3)

    def texels(self, rows, cols):
        coefficients = self.coefficients(np.asarray(rows), np.asarray(cols))
        views, lights = self._bases()
        if self.is_product:
            values = np.matmul(views @ coefficients, lights.T)
            return np.ascontiguousarray(
                values.reshape(*values.shape[:2], self.n_pairs).swapaxes(1, 2)
            )
        return np.einsum(
            "ncij,pi,pj->npc", coefficients, views[self.view_index], lights[self.light_index]
        )

    def _bases(self):
        return (
            spherical_harmonics(self.view_directions, self.view_terms).astype(np.float32),
            spherical_harmonics(self.light_directions, self.light_terms).astype(np.float32),
        )

    @classmethod
    def shading_needs(cls, reader):
        from btfpipe.compression.harmonics_shading import MANY_LIGHTS, slice_bytes

        codes = reader.require("codes", (None,) * 5, "u")  # stay mapped
        return ShadingNeeds(
            slice_bytes=slice_bytes(codes.shape[4]),
            many_lights=MANY_LIGHTS,
            levels=2 * codes.size // 3,
            making_levels=codes.size,
        )

    def shader(self, interpolation="barycentric"):
        """As `Appearance.shader`, but straight from the harmonics: `interpolation` changes nothing."""
        from btfpipe.compression.harmonics_shading import HarmonicsShader

        return HarmonicsShader(self)


def step_of(minimum, maximum):
    """Difference of neighbouring 8-bit codes, float32."""
    return ((np.asarray(maximum, float) - np.asarray(minimum, float)) / 255).astype(np.float32)


def compress_harmonics(
    sample,
    view_terms=25,
    light_terms=25,
    *,
    penalty=None,
    equal_views=False,
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Fit double spherical harmonics to a Sample by constrained least squares, and quantise them.

    Parameters
    ----------
    sample : Appearance
        Every view under every light. Read twice, by scan lines.
    view_terms, light_terms : int
        Square numbers, no more than there are views and lights.
    penalty : float, optional
        One lambda for all vectors, in place of the smallest that meets each one's constraint.
    equal_views : bool
        Weigh all views alike, in place of `view_weights`.
    seed : int
        Of no effect: nothing is random.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within. Never changes the result; with little of it the coefficients are found
        twice instead of being kept, and the codes wait in a temporary file (`store.scratch`) until they are saved.
    on_progress : callable, optional
        Called with (scan lines done, scan lines to do).

    Returns
    -------
    HarmonicsModel
        Its ``about`` holds `view_terms`, `light_terms`, `penalty`, `equal_views`, `warnings`, and, measured on the codes over all linear
        values, `rmse` and `relative_error` (RMS of the error over RMS of the values).

    Raises
    ------
    InputError
        A list of pairs, terms that are not a square number or more than the directions, values that are not finite, or
        too little memory.
    """
    sample.require_product("method harmonics")
    if penalty is not None and not (math.isfinite(penalty) and penalty >= 0):
        raise InputError(f"penalty {penalty}; expected a number of 0 or more.")
    views, lights = sample.view_directions, sample.light_directions
    fits = [
        _Fit(views, view_terms, "views", penalty, 1.0 if equal_views else view_weights(views)),
        _Fit(lights, light_terms, "lights", penalty),
    ]
    with single_threaded_blas():
        lines = _Lines(sample, fits, threads, memory, on_progress)
        minimum, maximum, energy = lines.ranges()
        codes, squared_error = lines.quantise(minimum, maximum)
    count = 3 * sample.n_pairs * sample.shape[0] * sample.shape[1]
    about = {
        "view_terms": fits[0].terms,
        "light_terms": fits[1].terms,
        "penalty": penalty,
        "equal_views": equal_views,
        "warnings": [fit.warning for fit in fits if fit.warning],
        "rmse": math.sqrt(squared_error / count),
        "relative_error": math.sqrt(squared_error / energy) if energy > 0 else 0.0,
    }
    model = HarmonicsModel(codes, minimum, maximum, sample, about)
    if model.mask is not None:
        model.about |= measured_error(model, sample, threads=threads)
    return model


def view_weights(views):
    """Weights (n,) of views in the fit: their squared cosines.

    A patch takes a share of a picture that falls with the cosine, while what it shows varies most from the side; with equal
    weights those views decide, and the harmonics ring in all others.
    """
    return np.maximum(views[:, 2], _LEAST_COSINE) ** 2


class _Fit:
    """Constrained least squares over one set of directions; the energy allowed has no weights."""

    def __init__(self, directions, terms, what, penalty, weights=1.0):
        highest_degree(terms)
        self.terms = int(terms)
        basis = spherical_harmonics(directions, terms)
        count = len(basis)
        if terms > count:
            raise InputError(
                f"{terms} terms over {count} {what}: more than there are. Pass --{what[:-1]}-harmonics {supported(directions)}, which"
                " is what these directions support."
            )
        weights = np.broadcast_to(weights, count)
        root = np.sqrt(weights / weights.mean())[:, None]
        left, singular, right = np.linalg.svd(root * basis, full_matrices=False)
        left *= root
        kept = singular > _FULL_RANK * singular[0]
        self.warning = None
        if not kept.all():
            self.warning = (
                f"the {count} {what} tell only {int(kept.sum())} of {terms} harmonics apart; the rest is left at"
                f" the least energy ({supported(directions)} terms are what these directions support)"
            )
        self.basis = basis.astype(np.float32)
        self.mirrored = np.float32(4 * np.pi / count)
        # an infinite eigenvalue keeps what the directions cannot tell at 0
        eigenvalues = np.where(kept, singular**2, np.inf)
        self.search = penalty is None
        if self.search:
            self.eigenvalues = eigenvalues.astype(np.float32)
            self.project = (singular[:, None] * left.T).astype(np.float32)
            self.turn = np.ascontiguousarray(right.T, np.float32)
        else:
            damped = singular / (eigenvalues + penalty)
            self.solve = (right.T @ (damped[:, None] * left.T)).astype(np.float32)

    def apply(self, values):
        """Coefficients (n, terms, m) of functions (n, directions, m), float32."""
        if not self.search:
            return np.matmul(self.solve, values)
        projected = np.matmul(self.project, values)
        constrain(projected, values, self.eigenvalues, self.mirrored)
        return np.matmul(self.turn, projected)


def supported(directions, most=None):
    """The largest number of terms, all orders of a degree together, that directions (n, 3) tell apart; no more than `most`."""
    best = 1
    count = len(directions) if most is None else min(len(directions), most)
    for degree in range(1, math.isqrt(count)):
        singular = np.linalg.svd(
            spherical_harmonics(directions, (degree + 1) ** 2), compute_uv=False
        )
        if singular[-1] <= _FULL_RANK * singular[0]:
            break
        best = (degree + 1) ** 2
    return best


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def constrain(projected, values, eigenvalues, mirrored):
    """Divide projections by eigenvalue + lambda, lambda the least that keeps each vector within its energy.

    Parameters
    ----------
    projected : (n, terms, m) float32
        In the eigenvectors' frame; becomes the coefficients there, in place.
    values : (n, directions, m) float32
        The functions; their mean square times 4 pi is the energy allowed.
    eigenvalues : (terms,) float32
    mirrored : float32
        4 pi over the number of directions.
    """
    n, terms, m = projected.shape
    directions = values.shape[1]
    scale = np.empty(_LANES, np.float32)
    penalty = np.empty(_LANES, np.float32)
    square = np.empty(_LANES, np.float32)
    slope = np.empty(_LANES, np.float32)
    for v in range(n):
        for start in range(0, m, _LANES):
            lanes = min(_LANES, m - start)
            scale[:] = 0.0
            penalty[:] = 0.0
            for i in range(directions):
                for j in range(lanes):
                    scale[j] += values[v, i, start + j] * values[v, i, start + j]
            for j in range(lanes):
                # a vector of no energy has coefficients of 0 at any scale
                scale[j] = 1 / np.sqrt(mirrored * scale[j]) if scale[j] > 0 else 0.0
            for _ in range(_MOST_STEPS):
                square[:] = 0.0
                slope[:] = 0.0
                for i in range(terms):
                    for j in range(lanes):
                        share = np.float32(1.0) / (eigenvalues[i] + penalty[j])
                        part = projected[v, i, start + j] * share * scale[j]
                        part *= part
                        square[j] += part
                        slope[j] += part * share
                moved = False
                for j in range(lanes):
                    if square[j] > np.float32(1.0001):
                        penalty[j] += square[j] / slope[j] * (np.sqrt(square[j]) - 1)
                        moved = True
                if not moved:
                    break
            # Newton stops just above the energy: the last 0.005 % is a scale
            for j in range(lanes):
                scale[j] = 1 / np.sqrt(square[j]) if square[j] > 1 else 1.0
            for i in range(terms):
                for j in range(lanes):
                    projected[v, i, start + j] *= scale[j] / (eigenvalues[i] + penalty[j])


class _Lines:
    """Passes over the scan lines of a Sample."""

    def __init__(self, sample, fits, threads, memory, on_progress):
        self.sample, self.fits, self.on_progress = sample, fits, on_progress
        self.views, self.lights = (len(fit.basis) for fit in fits)
        self.terms = tuple(fit.terms for fit in fits)
        self.rows, self.cols = sample.shape
        self.done = 0
        self.threads = threads
        self.table = None
        codes = getattr(sample, "codes", None)
        if codes is not None and codes.dtype == np.uint8 and sample.gain is None:
            self.table = decode_table(np.uint8, sample.transfer, sample.scale)
        self._plan(memory)

    def _plan(self, memory):
        """How many scan lines to read at a time, and whether the coefficients are kept."""
        all_terms = 3 * self.terms[0] * self.terms[1]
        texels = self.rows * self.cols
        # values, their reconstruction; coefficients over the views, in two frames; over the lights, in two frames
        pairs = self.sample.n_pairs
        each = 12 * min(_COLS, self.cols) * (2 * pairs + 2 * self.terms[0] * self.lights)
        each += 8 * min(_COLS, self.cols) * all_terms
        # two bands: the next is read while the last is still held; values that are no 8-bit codes are decoded at once
        line = 2 * self.cols * pairs * (3 if self.table is not None else 36)
        fixed = _PROCESS_BYTES + all_terms * texels
        self.make = np.empty
        if fixed + line + each > memory:
            fixed, self.make = _PROCESS_BYTES, store.scratch
        need = fixed + line + each
        if need > memory:
            raise InputError(
                f"{self.terms[0]} x {self.terms[1]} terms of {texels} texels need"
                f" {too_little(need, memory)}, or ask for fewer terms."
            )
        free = memory - fixed
        self.at_once = max(1, min((free - line) // each, 2 * self.threads))
        self.threads = min(self.threads, self.at_once)
        free -= self.at_once * each
        kept = 4 * all_terms * texels
        self.kept = {} if free - line >= kept else None
        if self.kept is not None:
            free -= kept
        # bands of an eighth of a gigabyte are read in long runs
        self.band = max(1, min(free, 256 << 20) // line)

    def _blocks(self, work):
        """Apply `work` to (values, row, cols) block by block and yield its results in order."""
        for band in blocks(self.rows, self.band):
            lines = self._read(band)
            items = [
                (row, cols)
                for row in range(band.start, band.stop)
                for cols in blocks(self.cols, _COLS)
            ]

            def run(item, lines=lines, first=band.start):
                row, cols = item
                return work(self._values(lines[row - first], cols), row, cols)

            yield from ordered_map(run, items, self.threads, ahead=self.at_once)
            self.done += band.stop - band.start
            if self.on_progress is not None:
                self.on_progress(self.done, 2 * self.rows)

    def _read(self, band):
        """Some scan lines (lines, pairs, cols, 3), one after the other: 8-bit codes, or linear values."""
        if not hasattr(self.sample, "codes"):
            rows, cols = (a.ravel() for a in np.mgrid[band, : self.cols])
            values = self.sample.texels(rows, cols)
            values = values.reshape(-1, self.cols, self.sample.n_pairs, 3).swapaxes(1, 2)
            return np.ascontiguousarray(values)
        store.will_read(self.sample.codes, band)
        codes = np.ascontiguousarray(self.sample.codes[:, band].swapaxes(0, 1))
        if self.table is not None:
            return codes
        values = self.sample.decode(codes)
        return values if self.sample.gain is None else values * self.sample.gain[band][:, None]

    def _values(self, line, cols):
        """Linear values (views, lights, texels * 3) float32 of a block of a scan line (pairs, cols, 3)."""
        part = line[:, cols]
        if self.table is None:
            values = np.ascontiguousarray(part, np.float32)
        else:
            values = np.empty(part.shape, np.float32)
            _decode(part, self.table, values)
        return values.reshape(self.views, self.lights, -1)

    def _fit(self, values):
        """Coefficients (view terms, light terms, texels * 3) of values (views, lights, texels * 3)."""
        by_light = self.fits[0].apply(values.reshape(1, self.views, -1))
        return self.fits[1].apply(by_light.reshape(self.terms[0], self.lights, -1))

    def ranges(self):
        """Minimum and maximum (3, view terms, light terms) of each coefficient, and the sum of squared values."""
        shape = (3, *self.terms)
        minimum = np.full(shape, np.inf, np.float32)
        maximum = np.full(shape, -np.inf, np.float32)
        energy = 0.0

        def work(values, row, cols):
            square = sum_of_squares(values)
            require_summable(square)
            coefficients = self._fit(values)
            if self.kept is not None:
                self.kept[row, cols.start] = coefficients
            low, high = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
            coefficients = coefficients.reshape(*self.terms, -1, 3)
            if self.sample.mask is not None:  # what an invalid texel holds is nobody's value
                coefficients = coefficients[:, :, self.sample.mask[row, cols]]
            _range(np.ascontiguousarray(coefficients), low, high)
            return low, high, square

        for low, high, square in self._blocks(work):
            np.minimum(minimum, low, out=minimum)
            np.maximum(maximum, high, out=maximum)
            energy += square
        return minimum, maximum, energy

    def quantise(self, minimum, maximum):
        """Codes (rows, cols, 3, view terms, light terms), and the sum of their squared errors."""
        codes = self.make((self.rows, self.cols, 3, *self.terms), np.uint8)
        step = step_of(minimum, maximum)
        views, lights = (fit.basis for fit in self.fits)

        def work(values, row, cols):
            if self.kept is None:
                coefficients = self._fit(values)
            else:
                coefficients = self.kept.pop((row, cols.start))
            _quantise(coefficients.reshape(*self.terms, -1, 3), minimum, step, codes[row, cols])
            by_light = np.matmul(lights, coefficients)
            values -= np.matmul(views, by_light.reshape(self.terms[0], -1)).reshape(values.shape)
            return sum_of_squares(values)

        return codes, sum(self._blocks(work))


@njit(cache=True, nogil=True)
def _decode(codes, table, out):
    """Fill ``out`` (pairs, texels, 3) with table values of the codes."""
    for p in range(codes.shape[0]):
        for t in range(codes.shape[1]):
            out[p, t, 0] = table[codes[p, t, 0]]
            out[p, t, 1] = table[codes[p, t, 1]]
            out[p, t, 2] = table[codes[p, t, 2]]


@njit(cache=True, nogil=True)
def _range(coefficients, low, high):
    """Widen the least and the greatest (3, view terms, light terms) by coefficients (view terms, light terms, texels, 3)."""
    for i in range(coefficients.shape[0]):
        for j in range(coefficients.shape[1]):
            for c in range(3):
                least, most = low[c, i, j], high[c, i, j]
                for t in range(coefficients.shape[2]):
                    least = min(least, coefficients[i, j, t, c])
                    most = max(most, coefficients[i, j, t, c])
                low[c, i, j] = least
                high[c, i, j] = most


@njit(cache=True, nogil=True)
def _quantise(coefficients, minimum, step, codes):
    """Fill codes (texels, 3, view terms, light terms); coefficients (view terms, light terms, texels, 3) become theirs."""
    for i in range(coefficients.shape[0]):
        for j in range(coefficients.shape[1]):
            for t in range(coefficients.shape[2]):
                for c in range(3):
                    code = np.float32(0)
                    if step[c, i, j] > 0:
                        code = (coefficients[i, j, t, c] - minimum[c, i, j]) / step[c, i, j]
                    code = np.floor(
                        min(max(code, np.float32(0)), np.float32(255)) + np.float32(0.5)
                    )
                    codes[t, c, i, j] = np.uint8(code)
                    coefficients[i, j, t, c] = minimum[c, i, j] + step[c, i, j] * code


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _contract_views(codes, minimum, step, weights, out):
    """Fill ``out`` (texels, 3, light terms): coefficients over the light from one view."""
    texels, _, views, lights = codes.shape
    base = np.zeros((3, lights), np.float32)
    scaled = np.empty((3, views, lights), np.float32)
    for c in range(3):
        for i in range(views):
            for j in range(lights):
                scaled[c, i, j] = weights[i] * step[c, i, j]
                base[c, j] += weights[i] * minimum[c, i, j]
    for t in range(texels):
        for c in range(3):
            for j in range(lights):
                out[t, c, j] = base[c, j]
            for i in range(views):
                for j in range(lights):
                    out[t, c, j] += scaled[c, i, j] * codes[t, c, i, j]
