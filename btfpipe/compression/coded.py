"""The transform codec: the SVD of the values' square roots, its factors transformed, quantised and entropy-coded.

What counts is what is seen, and displays have a curve that is near a square root: so the square roots are factorised (Zhou et
al. 2005 do so with the values), and squared again on evaluation. The file holds both factors after transforms that gather
their energy in few coefficients:

- eigen-textures by the two-dimensional cosine transform,
- angular factors by the principal axes of their colours (a luminance and two chroma), of their views and of their lights.

All transforms are orthogonal and so are the factors, so that errors of coefficients add up like errors of values. An
eigen-texture times its singular value and an angular factor times its singular value are therefore quantised by
one step for all, the one knob between size and error: weak terms, their chroma first, lose coefficients and
finally vanish. The rate that a step gives is found by trying. In memory the factors are unpacked.
"""

import io
import json
import math
from types import SimpleNamespace

import numpy as np

from btfpipe import store
from btfpipe.compiled import leaf
from btfpipe.compression.entropy import decode_planes, encode_planes
from btfpipe.compression.model import (
    Model,
    comparison_bytes,
    measured_error,
    read_tables,
    tables,
)
from btfpipe.compression.svd import SvdModel, factorise, planar_codes, planar_pictures
from btfpipe.errors import InputError, too_little
from btfpipe.metrics import raw_bytes
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import ShadingNeeds, svd_levels
from btfpipe.sample.transfer import decode_table

_TERMS = 256
_RATIO = 100.0
_ROUND = 0.4  # added before rounding down: halves count as less, which is a little more error and clearly fewer bytes
_SPARSE = 400  # a colour of a term with fewer coefficients than one in so many is not worth its time in shading
_SPARE = 1024  # bytes left for what the caller adds to the description
_LEAST = 16 << 10  # bytes of factors that the default ratio leaves to tiny samples
_CLOSE = 0.01  # share of the wanted size by which a file may be smaller
_MOST_TRIALS = 24
_SEARCH = 1.25  # of the reading of all pictures, what the search for the step takes, as measured
_TRANSFORMED, _PACKED = 0.3, 0.85  # shares of the search that end with transforms, and with trials
_TRIED = 5  # times the wanted size is what trials make in all, about
_TEXELS = 1 << 11  # whose factors stay in the processor's cache for all colours
_BLOCK = 1 << 14  # rows a matrix product, fixed
_LARGEST = 1 << 24  # quantised coefficient: the precision of float32


class CodedModel(Model):
    """A Sample as ``root[texel, pair, channel] = sum_k colour[channel, k] sum_n texture[texel, n] angular_k[pair, n]``.

    Values are ``root * abs(root)``. There are fewer terms for the weaker colours.

    Parameters
    ----------
    members : dict
        The coded factors as the file has them; see `arrays`.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm, absolute.
    about : dict
        With ``shape``, ``step`` and ``terms`` (of the eigen-textures, then of the three colours).

    Attributes
    ----------
    texture_factors : (rows, cols, n) float32
    angular_factors : list of three (pairs, n_k) float32
    colour : (3, 3) float32
    """

    method = "coded"

    def __init__(self, members, source, about):
        super().__init__(about["shape"], source, about)
        self.members = dict(members)
        self.texture_factors, self.angular_factors = _unpack(self.members, self, self.about)
        self.colour = np.asarray(members["colour"], np.float32)

    @property
    def n_terms(self):
        return self.texture_factors.shape[2]

    def arrays(self):
        """``texture_code`` and ``angular_code``: planes of `entropy`; then the transforms' tables."""
        return self.members

    @classmethod
    def from_arrays(cls, reader, source):
        about = reader.about
        _, (n, *_) = _sizes(reader)
        members = {
            "texture_code": reader.require("texture_code", (None,), "u"),
            "angular_code": reader.require("angular_code", (None,), "u"),
            "singular_values": reader.require("singular_values", (n,), "f"),
            "colour": reader.require("colour", (3, 3), "f"),
        }
        if "view_basis" in reader:
            for name in ("view", "light"):
                count = len(getattr(source, f"{name}_directions"))
                members[f"{name}_basis"] = reader.require(f"{name}_basis", (count, None), "f")
        return cls(members, source, about)

    def pictures(self, pairs):
        texture = self.texture_factors.reshape(-1, self.n_terms)
        angular = [a[pairs] for a in self.angular_factors]
        out = np.empty((len(angular[0]), len(texture), 3), np.float32)
        for part in blocks(len(texture), _TEXELS):
            roots = [a @ texture[part, : a.shape[1]].T for a in angular]
            to_channels(*roots, self.colour, out[:, part])
            square(out[:, part])
        return out.reshape(-1, *self.shape, 3)

    def texels(self, rows, cols):
        out = roots_of(self.texture_factors[rows, cols], self.angular_factors, self.colour)
        square(out)
        return out

    @classmethod
    def shading_needs(cls, reader):
        from btfpipe.compression.coded_shading import MANY_LIGHTS
        from btfpipe.compression.light_slices import slice_bytes
        from btfpipe.compression.root_blending import product_bytes

        shape, terms = _sizes(reader)
        source = read_tables(reader)
        texture = 4 * math.prod(shape) * terms[0]
        angular = 4 * len(source.light_index) * sum(terms[1:])
        products, shared = 20 * math.prod(shape), (0, 0)
        if "view_basis" in reader:
            lights, views = len(source.light_directions), len(source.view_directions)
            shared = slice_bytes(lights), MANY_LIGHTS
            products += product_bytes(lights, views)
        # each is unpacked into one array and laid out anew in another
        levels = svd_levels(math.prod(shape), len(source.light_index))
        return ShadingNeeds(texture + angular + products, max(texture, angular), *shared, **levels)

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.coded_shading import CodedShader

        return CodedShader(self, interpolation)


def _sizes(reader):
    """Rows and columns, and the numbers of terms, of a checked description."""
    about = reader.about
    whole = [about.get("shape"), about.get("terms")]
    if (
        [isinstance(a, list) and len(a) for a in whole] != [2, 4]
        or not all(isinstance(n, int) and 1 <= n <= 1 << 20 for a in whole for n in a)
        or not isinstance(about.get("step"), float)
        or not 0 < about["step"] < math.inf
        or max(about["terms"][1:]) > about["terms"][0]
    ):
        raise InputError(f"{reader.path}: the description lacks the factors' shape and step.")
    return whole


def roots_of(texture, angular, colour):
    """Roots (n, m, 3) float32 of texels' factors (n, terms) with three angular factors (m, at most as many terms)."""
    roots = [texture[:, : a.shape[1]] @ a.T for a in angular]
    out = np.empty((len(texture), len(angular[0]), 3), np.float32)
    to_channels(*roots, colour, out)
    return out


@leaf(fastmath={"contract"})
def to_channels(first, second, third, colour, out):
    """Fill `out` (n, m, 3) with the channels' roots, of those (n, m) of three colours."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for c in range(3):
                out[i, j, c] = (
                    colour[c, 0] * first[i, j]
                    + colour[c, 1] * second[i, j]
                    + colour[c, 2] * third[i, j]
                )


@leaf
def square(roots):
    """Turn roots (n, m, 3) into values, in place; they keep their sign."""
    for i in range(roots.shape[0]):
        for j in range(roots.shape[1]):
            for c in range(3):
                roots[i, j, c] *= abs(roots[i, j, c])


def compress_coded(
    sample, ratio=None, *, target_bytes=None, n_terms=None, seed=0, threads=1, memory=2 << 30,
    on_progress=None,
):  # fmt: skip
    """Compress a Sample into a file of a wanted size.

    Parameters
    ----------
    sample : Appearance
        Read about four times.
    ratio : float, optional
        Bytes of the uncompressed pictures (see `raw_bytes`) over those of the file. By default 100, but samples so small
        that this would leave nothing get what they need.
    target_bytes : int, optional
        The file's size instead of the ratio. The file is at most that large, and no more than some per cent smaller
        unless all that `n_terms` can give fits.
    n_terms : int, optional
        Terms made at most; those of no use at this size are left out. Fewer shade faster, more help at low ratios. By
        default 256, twelve times those of a plain SVD of the same size up to 512, and never fewer than it has.
    seed : int
        Of the random start.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within.
    on_progress : callable, optional
        Called with (pictures read, pictures to read); the search for the step counts as some more of them.

    Returns
    -------
    CodedModel
        Its ``about`` holds ``shape``, ``step``, ``terms``, and the measured linear ``rmse`` and ``relative_error``.

    Raises
    ------
    InputError
        If the size is too small for even the tables, or as `compress_svd`.
    """
    if ratio is not None and target_bytes is not None:
        raise InputError("a ratio and a size are given; expected one of them.")
    if ratio is not None and not 0 < ratio < math.inf:
        raise InputError(f"ratio {ratio}; expected a positive number.")
    source = getattr(sample, "about", {}).get("source")
    spare = _SPARE + len(json.dumps(store.jsonable(source)))
    if target_bytes is None:
        target_bytes = int(raw_bytes(sample) / (ratio or _RATIO))
        if ratio is None:
            target_bytes = max(target_bytes, _file_bytes({}, sample, {}) + spare + _LEAST)
    lengths = sample.shape[0] * sample.shape[1] + 3 * sample.n_pairs
    if n_terms is None:
        plain = target_bytes // (2 * lengths)
        n_terms = max(_TERMS, plain, min(12 * plain, 2 * _TERMS))
    most = min(n_terms, sample.shape[0] * sample.shape[1], 3 * sample.n_pairs)
    # factors, transformed, quantised, with what that takes, and unpacked again
    need = (104 << 20) + 4 * 4 * most * lengths + comparison_bytes(sample)
    if need > memory:
        raise InputError(
            f"{most} terms of {lengths} numbers need {too_little(need, memory)}, or ask for fewer terms."
        )
    search = math.ceil(_SEARCH * sample.n_pairs)
    report = on_progress or (lambda done, total: None)
    reads = 0

    def first(done, total):
        nonlocal reads
        reads = total
        report(done, reads + search + sample.n_pairs)

    def then(done):
        report(reads + int(done), reads + search + sample.n_pairs)

    roots = _Roots(sample)
    texture, angular, facts = factorise(
        roots, n_terms, rows=_Roots.rows, measure=False, iterations=1, precision="single", seed=seed,
        threads=threads, memory=memory, on_progress=first,
    )  # fmt: skip
    with single_threaded_blas():
        packer = _Packer(SvdModel(texture.reshape(*sample.shape, -1), angular, roots, facts))
        packer.source.mask = sample.mask
        del texture, angular
        then(_TRANSFORMED * search)
        model = packer.fit(
            target_bytes,
            spare,
            threads,
            lambda share: then((_TRANSFORMED + (_PACKED - _TRANSFORMED) * share) * search),
        )
    then(search)
    model.about |= measured_error(
        model, sample, threads=threads, on_progress=lambda done, _: then(search + done)
    )
    return model


class _Roots:
    """The square roots of an Appearance's values, with their sign."""

    def __init__(self, source):
        self.source = source
        for name in (
            "shape", "n_pairs", "light_directions", "view_directions", "light_index", "view_index",
            "toroidal", "texels_per_mm", "is_product",
        ):  # fmt: skip
            setattr(self, name, getattr(source, name))
        self.absolute = getattr(source, "absolute", False)
        codes = getattr(source, "codes", None)
        self.table = None
        if codes is not None and codes.dtype == np.uint8 and source.gain is None:
            self.table = np.sqrt(decode_table(np.uint8, source.transfer, source.scale))

    def pictures(self, pairs):
        values = np.asarray(self.source.pictures(pairs), np.float32)
        roots = np.abs(values)
        np.sqrt(roots, out=roots)
        return np.copysign(roots, values, out=roots)

    def rows(self, pairs):
        """As `planar_pictures`."""
        if self.table is None:
            return planar_pictures(self, pairs)
        return planar_codes(self.source.codes[pairs], self.table)


def _principal_axes(values, axis):
    """Orthonormal columns, by falling energy, of what stands along an axis."""
    values = np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis])
    gram = np.zeros((values.shape[1],) * 2)
    for part in blocks(len(values), _BLOCK):
        some = values[part].astype(np.float64)
        gram += some.T @ some
    axes = np.linalg.eigh(gram)[1][:, ::-1]
    # the sign is arbitrary: the largest entry is positive
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=0)[None], 0)
    return axes * np.where(largest < 0, -1, 1)


class _Packer:
    """Transformed factors of a Sample, quantised and coded with a step."""

    def __init__(self, factors):
        from scipy.fft import dctn

        self.source = SimpleNamespace(
            **{
                name: getattr(factors, name)
                for name in (
                    "shape", "light_directions", "view_directions", "light_index", "view_index",
                    "toroidal", "texels_per_mm", "absolute", "is_product", "n_pairs",
                )
            }
        )  # fmt: skip
        n = factors.n_terms
        texture = factors.texture_factors.transpose(2, 0, 1)
        weight = np.sqrt([np.square(plane, dtype=np.float64).sum() for plane in texture])
        weight[weight == 0] = 1
        self.singular = (weight**2).astype(np.float32)
        weight = weight.astype(np.float32)[:, None, None]
        self.texture = dctn(texture, axes=(1, 2), norm="ortho")
        self.texture *= weight
        angular = factors.angular_factors.transpose(2, 0, 1) * weight
        colour = _principal_axes(angular, 2)
        self.tables = {"colour": colour}
        angular = (angular @ colour.astype(np.float32)).transpose(2, 0, 1)
        if factors.is_product:
            angular = angular.reshape(3, n, len(factors.view_directions), -1)
            for name, axis in (("view_basis", 2), ("light_basis", 3)):
                stored = _principal_axes(angular, axis).astype(np.float16)
                self.tables[name] = stored
                # of the axes as stored, which rounding has left not quite orthogonal
                onto = np.linalg.inv(stored.astype(np.float64)).T.astype(np.float32)
                angular = np.moveaxis(np.moveaxis(angular, axis, -1) @ onto, -1, axis)
        else:
            angular = angular[:, :, None]
        self.angular = np.ascontiguousarray(angular)

    def pack(self, step, threads=1):
        """Members and description for a step."""
        texture = _quantise(self.texture, step)
        angular = _quantise(self.angular, step)
        least = angular[0, 0].size / _SPARSE
        live = [_live(texture, 0), *(_worthwhile(part, least) for part in angular)]
        n = max(1, min(live[0], max(live[1:])))
        terms = [n, *(max(1, min(n, part)) for part in live[1:])]
        angular = [part[:k] for part, k in zip(angular, terms[1:], strict=True)]
        members = {
            "singular_values": self.singular[:n],
            "colour": self.tables["colour"],
        }
        if "view_basis" in self.tables:
            kept = np.concatenate(angular)
            # an axis is kept if it saves more than its own bytes
            views, lights = (max(1, _live(kept, axis, 2 * kept.shape[axis])) for axis in (1, 2))
            members["view_basis"] = np.ascontiguousarray(self.tables["view_basis"][:, :views])
            members["light_basis"] = np.ascontiguousarray(self.tables["light_basis"][:, :lights])
            angular = [part[:, :views, :lights] for part in angular]
        jobs = [texture[:n], np.concatenate(angular)]
        members["texture_code"], members["angular_code"] = ordered_map(encode_planes, jobs, threads)
        return members, {"shape": list(self.source.shape), "step": step, "terms": terms}

    def fit(self, target, spare=0, threads=1, on_progress=None):
        """The Model whose file is as large as `target` allows, with some bytes to spare; tells its share of the trials done."""
        largest = max(float(np.abs(self.texture).max()), float(np.abs(self.angular).max()))
        tiny = float(np.finfo(np.float32).tiny)
        if largest < tiny:  # single precision has no step for these
            largest = 0.0
        sizes = {}

        def attempt(step):
            members, about = self.pack(step, threads)
            sizes[step] = _file_bytes(members, self.source, about) + spare
            if on_progress is not None:  # a trial takes the longer the more it makes
                on_progress(min(1.0, sum(sizes.values()) / (_TRIED * target)))
            return sizes[step] <= target, members, about

        coarse = 2 * largest or 1.0  # all coefficients are 0
        fits, *best = attempt(coarse)
        if not fits:
            raise InputError(
                f"{target} bytes are too few: tables and description alone take {sizes[coarse]}. Ask for a smaller"
                " --ratio, or for more --target-bytes."
            )
        finest = max(largest / _LARGEST, tiny)
        fine = coarse
        while fits and largest > 0 and fine > finest:  # coarse steps are quick
            coarse, fine = fine, max(fine / 4, finest)
            fits, *found = attempt(fine)
            best = found if fits else best
        for trial in range(_MOST_TRIALS):
            if fits or sizes[coarse] >= (1 - _CLOSE) * target:
                break
            # sizes are near a power of the step
            span = math.log(sizes[fine] / sizes[coarse])
            place = math.log(sizes[fine] / ((1 - _CLOSE / 2) * target)) / span
            place = min(max(place, 0.05), 0.95) if trial % 3 < 2 else 0.5
            step = math.exp(math.log(fine) + place * math.log(coarse / fine))
            fewer, *found = attempt(step)
            if fewer:
                coarse, best = step, found
            else:
                fine = step
        return CodedModel(best[0], self.source, best[1])


def _quantise(values, step):
    sizes = np.abs(values)
    sizes *= 1 / step
    sizes += _ROUND
    np.floor(sizes, out=sizes)
    return np.copysign(sizes, values, out=sizes).astype(np.int32)


def _live(planes, axis, least=1):
    """How far along an axis there are at least so many numbers other than 0."""
    others = tuple(a for a in range(planes.ndim) if a != axis)
    found = np.flatnonzero(np.count_nonzero(planes, axis=others) >= least)
    return int(found[-1]) + 1 if len(found) else 0


def _worthwhile(planes, least):
    """How many terms there are before those that have on average fewer numbers other than 0 than `least`."""
    counts = np.count_nonzero(planes, axis=(1, 2))[::-1]
    average = np.cumsum(counts) / np.arange(1, len(counts) + 1)
    few = np.flatnonzero(average < least)
    return len(counts) - (int(few[-1]) + 1 if len(few) else 0)


def _file_bytes(members, source, about):
    """Size of the file that a Model of these members is saved to."""
    file = io.BytesIO()
    writer = store.Writer(file)
    for name, array in members.items():
        writer.array(name, array)
    for name in tables(source):
        writer.array(name, getattr(source, name))
    writer.about(about)
    writer.close()
    return file.getbuffer().nbytes


def _unpack(members, source, about):
    """Texture factors (rows, cols, n) and the three angular factors (pairs, n_k), float32, of coded members."""
    n, *terms = about["terms"]
    with np.errstate(all="ignore"):  # shows in the factors
        texture, angular = _transform(members, source, n, terms, np.float32(about["step"]))
    if not all(np.isfinite(factors).all() for factors in (texture, *angular)):
        raise InputError("its factors are not finite: damaged.")
    return texture, angular


def _transform(members, source, n, terms, step):
    from scipy.fft import idctn

    singular = np.asarray(members["singular_values"], np.float32)
    texture = decode_planes(members["texture_code"], (n, *source.shape))
    texture = texture.astype(np.float32)
    texture *= (step / singular)[:, None, None]
    texture = idctn(texture, axes=(1, 2), norm="ortho", overwrite_x=True)
    texture = np.ascontiguousarray(texture.transpose(1, 2, 0))  # one copy at a time
    if "view_basis" in members:
        view, light = (
            np.asarray(members[f"{name}_basis"], np.float32) for name in ("view", "light")
        )
        if len(view) * len(light) != source.n_pairs:
            raise InputError(
                f"{source.n_pairs} pairs; expected {len(view)} views times {len(light)} lights."
            )
        shape = (view.shape[1], light.shape[1])
    else:
        shape = (1, source.n_pairs)
    planes = decode_planes(members["angular_code"], (sum(terms), *shape))
    planes = planes.astype(np.float32)
    planes *= step
    if "view_basis" in members:
        with single_threaded_blas():
            planes = view @ planes @ light.T
    planes = planes.reshape(len(planes), -1)
    parts = np.split(planes, np.cumsum(terms)[:-1])
    return texture, [np.ascontiguousarray(part.T) for part in parts]
