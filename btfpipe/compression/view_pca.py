"""PCA of each view's pictures over the lights (Wang-PCA 2009, section 3, equations 1 and 2).

With the view held, pictures change smoothly with the light: a mean picture and a few eigen-textures, weighted per
light, stand for all of them. Each view is a problem of its own: a matrix of lights x (texels and channels), whose
eigen-textures follow from its small Gram matrix of lights x lights.
"""

import math

import numpy as np

from btfpipe import store
from btfpipe.compiled import njit
from btfpipe.compression.model import (
    MOST_ENERGY,
    Model,
    comparison_bytes,
    measured_error,
    require_summable,
    sum_of_squares,
)
from btfpipe.compression.svd import _PROCESS_BYTES, planar_pictures
from btfpipe.errors import InputError, too_little
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import ShadingNeeds
from btfpipe.sample.shading import PairShader, corners

_DECODED_BYTES = 6 << 20  # of a view's pictures at a time; fixed, as sums hang on it
_TYPES = {  # of the mean and the eigen-textures
    "half": (np.float16, np.float16),
    "single": (np.float32, np.float32),
    "byte": (np.float16, np.int8),
}
_NOISE = 1e-6  # a singular value below this share of the view's norm is rounding


class ViewPcaModel(Model):
    """A Sample as ``value[texel, view, light] = sum_k weight[view, light, k] * texture[view, k, texel]``.

    Term 0 is the mean picture of the view, with the same weight under every light.

    Parameters
    ----------
    means : (views, rows, cols, 3) float16 or float32
        Scaled to a largest magnitude of 1, as are the textures: half precision then holds samples of any range.
    textures : (views, components, rows, cols, 3) float16, float32, or int8 in steps of 1 / 127
        Eigen-textures.
    weights : (views, lights, 1 + components) float32
        Of the mean and of the textures as they are stored, their scale inside.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm; a product.
    """

    method = "view-pca"

    def __init__(self, means, textures, weights, source, about=None):
        super().__init__(means.shape[1:3], source, about)
        self.require_product("per-view PCA")
        self.means = means
        self.textures = textures
        self.weights = weights

    @property
    def n_terms(self):
        """Eigen-textures a view, the mean left out."""
        return self.textures.shape[1]

    def arrays(self):
        return {"means": self.means, "textures": self.textures, "weights": self.weights}

    @classmethod
    def from_arrays(cls, reader, source):
        views, lights = len(source.view_directions), len(source.light_directions)
        means = reader.require("means", (views, None, None, 3), "f")
        textures = reader.require("textures", (views, None, *means.shape[1:]), "fi")
        weights = reader.require("weights", (views, lights, 1 + textures.shape[1]), "f")
        return cls(means, textures, weights, source, reader.about)

    def terms(self, view):
        """Mean and eigen-textures (1 + components, texels, 3) float32 of a view, as the weights expect them."""
        mean = np.asarray(self.means[view], np.float32)[None]
        terms = np.concatenate([mean, np.asarray(self.textures[view], np.float32)])
        return terms.reshape(len(terms), -1, 3)

    def pictures(self, pairs):
        views, lights = self.view_index[pairs], self.light_index[pairs]
        out = np.empty((len(views), 3 * self.shape[0] * self.shape[1]), np.float32)
        for view in np.unique(views):
            chosen = np.flatnonzero(views == view)
            terms = self.terms(view)
            out[chosen] = self.weights[view][lights[chosen]] @ terms.reshape(len(terms), -1)
        return out.reshape(-1, *self.shape, 3)

    def texels(self, rows, cols):
        means = np.asarray(self.means[:, rows, cols], np.float32)[:, None]
        terms = np.asarray(self.textures[:, :, rows, cols], np.float32)
        terms = np.concatenate([means, terms], axis=1)
        values = np.asarray(self.weights) @ terms.reshape(*terms.shape[:2], -1)
        return np.ascontiguousarray(values.reshape(self.n_pairs, -1, 3).swapaxes(0, 1))

    @classmethod
    def shading_needs(cls, reader):
        means = reader.require("means", (None,) * 4, "f", finite=False)
        textures = reader.require("textures", (None,) * 5, "fi", finite=False)
        weights = reader.require("weights", (None,) * 3, "f", finite=False)
        kept = 4 * (means.size + textures.size + weights.size)
        # while values are checked, then a view in single precision
        loading = max(textures.size, 2 * kept // max(len(means), 1))
        return ShadingNeeds(kept, loading, levels=2 * (means.size + textures.size))

    def shader(self, interpolation="barycentric"):
        return ViewPcaShader(self, interpolation)


def compress_view_pca(
    sample,
    components=5,
    *,
    precision="half",
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Make a mean picture and eigen-textures of each view, and their weights for each light.

    Parameters
    ----------
    sample : Appearance
        A product of views and lights; read view by view, three times: a view's scan lines for its Gram matrix and for
        its textures, and its pictures for the error.
    components : int
        Eigen-textures a view, at least 1. The lights of a view, less its mean, have at most lights - 1; terms
        that are rounding noise in every view are left out too.
    precision : str
        Of the pictures: ``half``, ``single``, or ``byte``, which keeps the mean in half precision.
    seed : int
        Not needed: nothing is random. Taken as by other methods.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within; limits the views worked on at a time, never the result. A Model too
        large for it is kept in a temporary file (`store.scratch`) until it is saved.
    on_progress : callable, optional
        Called with (pictures read, pictures to read).

    Returns
    -------
    ViewPcaModel
        Its ``about`` holds `n_terms`, `precision`, `warnings` (sentences), and, measured on the textures as stored
        and over all linear values, `rmse`, `relative_error` (RMS of the error over RMS of the values) and
        `energy_error` (its square: the error's share of the energy). The paper quotes an error below 2.22 % for
        five components without saying which.

    Raises
    ------
    InputError
        Not a product, no components, non-finite pictures, or too little memory.
    """
    if precision not in _TYPES:
        raise InputError(f"precision {precision!r}; expected half, single or byte.")
    if components < 1:
        raise InputError(f"{components} components asked for; expected at least 1.")
    sample.require_product("per-view PCA")
    lights, views = len(sample.light_directions), len(sample.view_directions)
    texels = sample.shape[0] * sample.shape[1]
    kept = min(components, lights - 1, 3 * texels)
    shapes = ((views, *sample.shape, 3), (views, kept, *sample.shape, 3))
    step = 127 if precision == "byte" else 1
    threads, make = _plan(sample, shapes, _TYPES[precision], threads, memory)
    means, textures = (
        make(shape, dtype) for shape, dtype in zip(shapes, _TYPES[precision], strict=True)
    )
    weights = np.empty((views, lights, 1 + kept), np.float32)

    def work(view):
        terms, weights[view], rank = _view_terms(
            _strips(sample, view, lights), lights, sample.shape, kept
        )
        means[view] = terms[0].transpose(1, 2, 0)
        for texture, term in zip(textures[view], terms[1:], strict=True):
            texture[:] = (np.round(term * step) if step > 1 else term).transpose(1, 2, 0)
        weights[view, :, 1:] /= step
        return view, rank

    most = 0
    total = 2 * sample.n_pairs
    with single_threaded_blas():
        for view, rank in ordered_map(work, range(views), threads, ahead=threads):
            most = max(most, rank)
            if on_progress is not None:
                on_progress((view + 1) * lights, total)
    warnings = []
    if most < components:
        warnings.append(
            f"the views have at most {most} terms beside their mean: {components - most} of the"
            f" {components} components left out"
        )
        textures, weights = textures[:, :most], weights[:, :, : 1 + most].copy()
    model = ViewPcaModel(means, textures, weights, sample)
    error = measured_error(
        model,
        sample,
        threads=threads,
        on_progress=on_progress and (lambda done, _: on_progress(sample.n_pairs + done, total)),
    )
    model.about = {
        "n_terms": model.n_terms,
        "precision": precision,
        **error,
        "energy_error": error["relative_error"] ** 2,
        "warnings": warnings,
    }
    return model


def _plan(sample, shapes, dtypes, threads, memory):
    """How many views fit the memory, at most `threads`, and what makes the Model's arrays: in memory, or in a file."""
    (rows, cols), lights = sample.shape, len(sample.light_directions)
    texels, terms = rows * cols, 1 + shapes[1][1]
    # the textures, one of them transposed; scan lines, centred, and in double precision
    each = 12 * texels * (terms + 2) + 40 * lights * cols * min(rows, _lines_at_once(lights, cols))
    if not hasattr(sample, "codes"):
        each += 2 * 12 * lights * texels  # they come with all scan lines
    each = max(each, comparison_bytes(sample) + 12 * texels * terms)
    size = sum(
        math.prod(shape) * np.dtype(dtype).itemsize
        for shape, dtype in zip(shapes, dtypes, strict=True)
    )
    if _PROCESS_BYTES + each > memory:
        raise InputError(
            f"views of {lights} pictures of {texels} texels need"
            f" {too_little(_PROCESS_BYTES + each, memory)}, or ask for fewer components."
        )
    free = memory - _PROCESS_BYTES
    inside = size + each <= free
    threads = int(min((free - size * inside) // each, threads))
    return threads, np.empty if inside else store.scratch


def _lines_at_once(lights, cols):
    return max(1, _DECODED_BYTES // (12 * lights * cols))


def _strips(sample, view, lights):
    """Yields, each time it is called, slices of scan lines and a view's values there (lights, 3, lines, cols) float32."""
    pairs = slice(view * lights, (view + 1) * lights)
    rows, cols = sample.shape
    whole = None
    if not hasattr(sample, "codes"):
        whole = planar_pictures(sample, pairs).reshape(lights, 3, rows, cols)

    def strips():
        for lines in blocks(rows, _lines_at_once(lights, cols)):
            if whole is None:
                values = planar_pictures(sample, pairs, lines).reshape(lights, 3, -1, cols)
            else:
                values = whole[:, :, lines].copy()
            yield lines, values

    return strips


def _view_terms(strips, lights, shape, terms):
    """Mean and eigen-textures of one view.

    The eigen-textures are the projections of the centred pictures on the first eigenvectors of their Gram matrix; the
    eigenvectors are the weights, orthonormal to double precision, so that all of them give the pictures back
    to rounding, whatever the eigenvalues.

    Parameters
    ----------
    strips : callable
        See `_strips`.
    lights : int
    shape : (int, int)
    terms : int

    Returns
    -------
    textures : (1 + terms, 3, rows, cols) float32
        Each of largest magnitude 1, or zero.
    weights : (lights, 1 + terms) float32
    rank : int
        Terms above rounding, at most `terms`; those beyond are zero.
    """
    textures = np.empty((1 + terms, 3, *shape), np.float32)
    gram, energy = np.zeros((lights, lights)), 0.0
    for lines, values in strips():
        energy += sum_of_squares(values)
        require_summable(energy, MOST_ENERGY**2)  # no squares but in double precision
        textures[0, :, lines] = values.mean(axis=0, dtype=np.float64)
        values -= textures[0, :, lines]
        columns = values.reshape(lights, -1).astype(np.float64)
        gram += columns @ columns.T
    eigenvalues, vectors = np.linalg.eigh(gram)
    eigenvalues, vectors = eigenvalues[::-1][:terms], vectors[:, ::-1][:, :terms]
    rank = int((eigenvalues > _NOISE**2 * energy).sum())
    vectors = vectors.astype(np.float32)
    vectors[:, rank:] = 0
    for lines, values in strips():
        values -= textures[0, :, lines]
        strip = vectors.T @ values.reshape(lights, -1)
        textures[1:, :, lines] = strip.reshape(terms, *values.shape[1:])
    weights = np.concatenate([np.ones((lights, 1), np.float32), vectors], axis=1)
    for term, texture in enumerate(textures):
        scale = np.float32(max(texture.max(), -texture.min()))
        texture /= scale if scale > 0 else 1
        weights[:, term] *= scale
    return textures, weights, rank


class ViewPcaShader(PairShader):
    """Evaluates a `ViewPcaModel` between its texels, lights and views.

    Weights are linear in the values: those of the lights around a direction are blended within each view, then the
    view's textures are summed once, at four texels.

    Parameters
    ----------
    model : ViewPcaModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        super().__init__(model, interpolation)
        views, terms = len(model.means), 1 + model.n_terms
        # the terms of a texel and view lie together; single precision, as the processor computes in no other
        self.textures = np.empty((self.rows * self.cols, views, 3 * terms), np.float32)
        for view in range(views):
            self.textures[:, view] = model.terms(view).swapaxes(0, 1).reshape(-1, 3 * terms)
        self.weights = np.ascontiguousarray(model.weights, np.float32).reshape(-1, terms)
        self.lights = model.weights.shape[1]

    def halved(self, halving):
        """The shader of the next level of a `Pyramid`."""
        return halving.coarser(self, textures=halving(self.textures))

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        # pairs of one view follow each other, or, the nearest in light-view space, stand alone
        near = 1 if self.pairs.near is not None else int(np.sqrt(self.pairs.most))
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.textures, self.weights, self.lights, near, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, out[part],
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _shade(textures, weights, lights, near, rows, cols, toroidal, row, col, pair, share, out):
    terms = weights.shape[1]
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    blended = np.zeros(terms, np.float32)
    local = np.zeros(3 * terms, np.float32)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        for first in range(0, pair.shape[1], near):
            blended[:] = 0.0
            for i in range(first, first + near):
                weight = weights[pair[q, i]]
                w = share[q, i]
                for k in range(terms):
                    blended[k] += w * weight[k]
            view = pair[q, first] // lights
            t0 = textures[texel[0], view]
            t1 = textures[texel[1], view]
            t2 = textures[texel[2], view]
            t3 = textures[texel[3], view]
            for k in range(3 * terms):
                local[k] = (bilinear[0] * t0[k] + bilinear[1] * t1[k]) + (
                    bilinear[2] * t2[k] + bilinear[3] * t3[k]
                )
            for k in range(terms):
                red += blended[k] * local[3 * k]
                green += blended[k] * local[3 * k + 1]
                blue += blended[k] * local[3 * k + 2]
        out[q, 0] = red
        out[q, 1] = green
        out[q, 2] = blue
