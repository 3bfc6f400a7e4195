"""The levels of detail of an `Appearance`: its texels averaged in linear values, halving by halving.

Level 0 is the shader itself. A texel of level l + 1 is the centre of the 2 x 2 texels of level l that it stands for, so that a
coordinate x of level 0 is at (x + 0.5) / 2^l - 0.5 (Williams, *Pyramidal parametrics*, 1983); like the pyramids of
features it is their mean after the low-pass (1, 2, 1) / 4, (1, 3, 3, 1) / 8 in all. Sides that are odd give ``(n + 1) // 2``
texels, each for the n / ((n + 1) // 2) texels that it covers, some in part.

Where values are linear in the texels' factors the factors are averaged (`halved` of the shader). Roots, logarithms, clusters and
display values are not: there the decoded pictures are averaged, and one SVD of them holds level 1 in linear values; its factors
give the levels above.
"""

import contextlib
import copy
import math
import threading
import time
from types import SimpleNamespace

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.sample.shading import corners

ERROR_BOUND = 0.04  # RMS of an SVD's error over the RMS of the averaged values; a picture averages most of it away
_UNUSED = 0.01  # weight of a texel that a map does not use, over the mean weight
_MAKING = threading.Lock()  # one pyramid at a time, for memory
FIRST_TERMS, MOST_TERMS = 64, 512  # of that SVD; doubled until it is within the bound


def halved_shape(shape):
    """Rows and cols of the next level."""
    return tuple((n + 1) // 2 for n in shape)


def count_levels(shape):
    """Levels from the sample down to a single texel."""
    return 1 + math.ceil(math.log2(max(shape)))


def share_above(shape):
    """Texels of all levels above 0, over those of level 0."""
    total, level = 0, shape
    while max(level) > 1:
        level = halved_shape(level)
        total += math.prod(level)
    return total / math.prod(shape)


class Halving:
    """Averages what the texels of a level hold into what those of the next hold.

    Parameters
    ----------
    shape : (int, int)
    toroidal : bool
    weight : (rows, cols) float64, optional
        How much each texel counts, such as 0 where it was not measured; all alike by default.

    Attributes
    ----------
    halved : (int, int)
        Shape of the next level.
    weight_above : (rows, cols) float64
        Its texels' weights. Those of weight 0 repeat the nearest texel with some.
    """

    def __init__(self, shape, toroidal, weight=None):
        self.shape = shape
        self.halved = halved_shape(shape)
        self.weight = np.ones(shape) if weight is None else weight
        self.taps = tuple(
            _taps(n, m, toroidal) for n, m in zip(self.shape, self.halved, strict=True)
        )
        (row, by_row), (col, by_col) = self.taps
        above = np.einsum("ia,iajb,jb->ij", by_row, self.weight[row][:, :, col], by_col)
        self.weight_above = above
        self.nearest = None
        if not above.all():
            self.nearest = _nearest(above > 0, toroidal)

    def __call__(self, values):
        """Average (rows * cols, ...) into float32 of as many texels as the next level has."""
        return self.pictures(values[None])[0]

    def pictures(self, values):
        """Average (n, rows * cols, ...) into float32 (n, texels of the next level, ...)."""
        n, texels = values.shape[:2]
        out = np.zeros((n, math.prod(self.halved), math.prod(values.shape[2:])), np.float32)
        (row, by_row), (col, by_col) = self.taps
        _halve(
            values.reshape(n, texels, -1), self.shape[1], row, by_row, col, by_col, self.weight,
            self.weight_above, out,
        )  # fmt: skip
        if self.nearest is not None:
            out = out[:, self.nearest]
        return out.reshape(n, -1, *values.shape[2:])

    def coarser(self, shader, **factors):
        """The shader of the next level: the same as that of this one, but for its shape and some arrays (texels, ...)."""
        other = copy.copy(shader)
        other.rows, other.cols = self.halved
        for name, array in factors.items():
            setattr(other, name, array)
        return other


def _taps(n, m, toroidal):
    """Which of n texels make up each of m, about half as many: index (m, k) int64 and weight (m, k) float64.

    Of an even n (1, 3, 3, 1) / 8. Of an odd one a smooth kernel as wide (its variance is that of (1, 3, 3, 1) / 8 where n is
    2 m): the indicator of what a texel covers, widened by a triangle two texels wide and by (1, 6, 1) / 8. In either case
    the weights of each texel of the m sum to 1, those that each of the n has in all of the m to m / n, and a ramp stays a
    ramp.
    """
    if n == 1:
        return np.zeros((m, 1), np.int64), np.ones((m, 1))
    if n % 2 == 0:
        first = 2 * np.arange(m) - 1
        weight = np.tile(np.array([1, 3, 3, 1]) / 8, (m, 1))
    else:
        centre = (np.arange(m) + 0.5) * n / m - 0.5
        first = np.floor(centre).astype(np.int64) - 3
        offset = first[:, None] + np.arange(1, 7) - centre[:, None]
        half = n / m / 2
        covered = (_triangle_below(offset + half) - _triangle_below(offset - half)) / (2 * half)
        weight = np.array([np.convolve(some, [1 / 8, 6 / 8, 1 / 8]) for some in covered])
    index = first[:, None] + np.arange(weight.shape[1])
    if toroidal:
        return index % n, weight
    index %= 2 * n  # mirrored at the borders
    return np.where(index < n, index, 2 * n - 1 - index), weight


def _triangle_below(x):
    """Integral of the triangle of unit height over [-1, 1], up to x."""
    x = np.clip(x, -1, 1)
    return np.where(x < 0, (1 + x) ** 2 / 2, 1 - (1 - x) ** 2 / 2)


@leaf
def _halve(values, cols, row, by_row, col, by_col, weight, above, out):
    """Add weighted means of `values` (n, texels, k) to `out` (n, coarser texels, k); nothing where nothing has weight."""
    for i in range(len(row)):
        for j in range(len(col)):
            at = i * len(col) + j
            if above[i, j] <= 0.0:
                continue
            for a in range(row.shape[1]):
                for b in range(col.shape[1]):
                    y = row[i, a]
                    x = col[j, b]
                    share = np.float32(by_row[i, a] * by_col[j, b] * weight[y, x] / above[i, j])
                    if share == 0.0:
                        continue
                    for p in range(values.shape[0]):
                        for k in range(values.shape[2]):
                            out[p, at, k] += share * np.float32(values[p, y * cols + x, k])


def _nearest(valid, toroidal):
    """Number of the nearest valid texel (texels,), its own where it is valid; the first where none is."""
    from scipy.ndimage import distance_transform_edt

    if not valid.any():
        return np.zeros(valid.size, np.int64)
    pad = [n if toroidal else 0 for n in valid.shape]
    invalid = np.pad(~valid, [(n, n) for n in pad], "wrap")
    index = distance_transform_edt(invalid, return_distances=False, return_indices=True)
    inside = tuple(slice(n, n + size) for n, size in zip(pad, valid.shape, strict=True))
    row, col = ((i[inside] - n) % size for i, n, size in zip(index, pad, valid.shape, strict=True))
    return (row * valid.shape[1] + col).ravel()


def usage(thing):
    """How much of a dressed object each texel of the sample covers (rows, cols) float64.

    With these weights a look-up on any level has the mean of what the object shows, not of the whole sample: a map may leave
    parts of it out, invalid texels always. Texels that the map does not use count a little, for footprints that reach them.
    """
    dress = thing.dressing
    points = thing.vertices[thing.faces]
    area = np.linalg.norm(
        np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1
    )
    own = np.bincount(thing.faces.ravel(), np.repeat(area, 3), len(thing.vertices))
    total = np.zeros(dress.model.shape)
    texel, share = np.zeros(4, np.int64), np.zeros(4, np.float32)
    for row, col, weight in zip(dress.row, dress.col, dress.weight, strict=True):
        _splat(
            row, col, own * weight, *dress.model.shape, bool(dress.model.toroidal), texel, share, total
        )  # fmt: skip
    total += _UNUSED * total.mean()
    if dress.model.mask is not None:
        total *= dress.model.mask
    return total


@leaf
def _splat(row, col, weight, rows, cols, toroidal, texel, share, total):
    """Add the weights of coordinates to the four texels around each."""
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, share)
        for k in range(4):
            total[texel[k] // cols, texel[k] % cols] += weight[q] * share[k]


@contextlib.contextmanager
def _silent():
    yield lambda done, total: None


class Pyramid:
    """Shaders of all levels, made when they are first asked for.

    Parameters
    ----------
    appearance : Appearance
    shader : object
        Its own, level 0.
    interpolation : str
        See `Appearance.evaluate`; the same on all levels.
    weight : (rows, cols) float64, optional
        See `Halving`.
    name : str
        What messages call the appearance.
    threads : int
        That make the levels; never changes them.

    Attributes
    ----------
    nbytes : int
        Of the levels above 0, once they are made.
    seconds : float
        That making them took.
    progress : callable
        Gives a context manager whose ``report(done, total)`` is called while levels are made; silent by default.
    facts : dict
        ``terms`` and ``relative_error`` of the SVD, where there is one.
    """

    def __init__(self, appearance, shader, interpolation, *, weight=None, name="", threads=1):
        self.appearance, self.interpolation, self.name = appearance, interpolation, name
        self.threads = threads
        self.weight = weight
        self.nbytes, self.seconds, self.facts = 0, 0.0, {}
        self.top = count_levels(appearance.shape) - 1
        self._levels = [shader]
        self.progress = _silent

    @property
    def made(self):
        """Whether any level above 0 was asked for."""
        return len(self._levels) > 1

    def level(self, number):
        """The shader of a level, at most `top`."""
        if number and not self.made:
            with _MAKING:
                if not self.made:
                    start = time.perf_counter()
                    with self.progress() as report:
                        self._levels = self._make(report)
                    self.seconds = time.perf_counter() - start
        return self._levels[number]

    def _make(self, report):
        levels, weight = self._levels[:], self.weight
        toroidal = bool(self.appearance.toroidal)
        for number in range(self.top):
            below = levels[-1]
            halving = Halving((below.rows, below.cols), toroidal, weight)
            if hasattr(below, "halved"):
                made = below.halved(halving)
            else:
                made = self._factorised(halving, report)
            self.nbytes += _own_bytes(made, below)
            levels.append(made)
            weight = halving.weight_above
            report(number + 1, self.top)
        return levels

    def _factorised(self, halving, report):
        """Level 1 as an SVD of the averaged pictures."""
        from btfpipe.compression.svd import SvdModel, factorise

        source = self.appearance
        make = getattr(self._levels[0], "area_pictures", source.pictures)
        level = SimpleNamespace(shape=halving.halved, n_pairs=source.n_pairs)

        def rows(_, pairs):
            pictures = make(pairs)
            pictures = halving.pictures(pictures.reshape(len(pictures), -1, 3))
            return np.ascontiguousarray(pictures.transpose(0, 2, 1)).reshape(3 * len(pictures), -1)

        terms = FIRST_TERMS
        while True:
            texture, angular, facts = factorise(
                level, terms, rows=rows, iterations=0, precision="single", threads=self.threads,
                memory=1 << 62, on_progress=report,
            )  # fmt: skip
            if (
                facts["relative_error"] <= ERROR_BOUND
                or facts["n_terms"] < terms
                or terms >= MOST_TERMS
            ):
                break
            terms *= 2
        self.facts = {"terms": facts["n_terms"], "relative_error": facts["relative_error"]}
        model = SvdModel(texture.reshape(*halving.halved, -1), angular, source)
        shader = model.shader(self.interpolation)
        shader.pairs = getattr(self._levels[0], "mean_pairs", shader.pairs)
        return shader


def _own_bytes(shader, below):
    """Bytes of the arrays that a shader does not share with the one below."""
    kept = {id(array) for array in vars(below).values()}
    arrays = (a for a in vars(shader).values() if isinstance(a, np.ndarray))
    return sum(a.nbytes for a in arrays if id(a) not in kept)
