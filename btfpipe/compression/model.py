"""What Models of every method share: tables of directions, their file, their measured error."""

import math
from types import SimpleNamespace

import numpy as np

from btfpipe import store
from btfpipe.compiled import njit
from btfpipe.errors import InputError, naming
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import Appearance
from btfpipe.sample.sample import check_index, read_directions

_TABLES = ("light_directions", "view_directions", "light_index", "view_index")
_BLOCK_BYTES = 16 << 20  # linear pictures compared at a time; products with few wait for memory
MOST_ENERGY = 1e38  # sum of squares that a method adds up in single precision
_LEAST_PICTURES = 8  # however large: what a Model does once for several is then little


class Model(Appearance):
    """A compressed Sample.

    A method is a module with a subclass that names itself in ``method``, gives its ``arrays`` and is made again from them
    by ``from_arrays``, and evaluates; and a line in `btfpipe.compression`.

    Parameters
    ----------
    shape : (int, int)
        Rows and cols of texels.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm, absolute, mask.
    about : dict, optional
        Facts for the file.
    """

    method = None

    def __init__(self, shape, source, about=None):
        self.shape = tuple(int(n) for n in shape)
        for name in (*_TABLES, "toroidal", "texels_per_mm"):
            setattr(self, name, getattr(source, name))
        self.absolute = getattr(source, "absolute", False)
        self.mask = getattr(source, "mask", None)
        self.about = dict(about or {})

    def arrays(self):
        """The method's own members of the file, by name."""
        raise NotImplementedError

    @classmethod
    def from_arrays(cls, reader, source):
        """The Model again, from a `store.Reader` whose members it checks, and the source of `read_tables`."""
        raise NotImplementedError

    @classmethod
    def from_reader(cls, reader):
        """Map the Model from its file."""
        with naming(reader.path):
            model = cls.from_arrays(reader, read_tables(reader))
        if not model.n_pairs or 0 in model.shape:
            raise InputError(f"{reader.path}: holds no pair, or no texel.")
        mask = model.mask
        if mask is not None and (mask.shape != model.shape or mask.dtype != bool):
            raise InputError(
                f"{reader.path}: mask is {mask.dtype} of shape {mask.shape}; expected bool of {model.shape}."
            )
        return model

    def save(self, path):
        """Write the Model."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        about |= {
            "method": self.method,
            "toroidal": self.toroidal,
            "texels_per_mm": self.texels_per_mm,
            "absolute": self.absolute,
        }
        members = {name: getattr(self, name) for name in tables(self)}
        store.write(path, "model", members | self.arrays(), **about)

    @property
    def nbytes(self):
        arrays = (*self.arrays().values(), self.light_directions, self.view_directions)
        return int(sum(array.nbytes for array in arrays))


def tables(source):
    """Names of the tables that a Model's file holds: of a product, whose pairs follow a rule, directions alone; and its mask."""
    names = _TABLES[:2] if source.is_product else _TABLES
    return names if getattr(source, "mask", None) is None else (*names, "mask")


def read_tables(reader):
    """Directions, index tables and facts of a Model's file, as attributes."""
    lights, views = read_directions(reader)
    if "light_index" in reader:
        index = [reader.require(name, (None,), "iu") for name in _TABLES[2:]]
        with naming(reader.path):
            for name, table, directions in zip(_TABLES[2:], index, (lights, views), strict=True):
                check_index(name, table, len(directions), len(index[0]))
    else:
        pair = np.arange(len(lights) * len(views), dtype=np.int32)
        index = [pair % len(lights), pair // len(lights)]
    return SimpleNamespace(
        light_directions=lights,
        view_directions=views,
        light_index=index[0],
        view_index=index[1],
        toroidal=reader.fact("toroidal", "flag"),
        texels_per_mm=reader.fact("texels_per_mm", "positive", None),
        absolute=reader.fact("absolute", "flag"),
        mask=reader["mask"] if "mask" in reader else None,
    )


def measured_error(model, sample, *, threads=1, on_progress=None):
    """RMSE and relative error of a Model, over all linear values of its Sample's valid texels.

    Parameters
    ----------
    model, sample : Appearance
        Of the same pairs.
    threads : int
        Never changes the result.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).

    Returns
    -------
    dict
        ``rmse``, and ``relative_error``: RMS of the error over RMS of the values.

    Raises
    ------
    InputError
        If no texel is valid; if values of the Sample, or of the Model, are not finite.
    """
    if sample.mask is not None and not sample.mask.any():
        raise InputError("the sample has no valid texel.")
    texels = sample.shape[0] * sample.shape[1]
    valid = slice(None) if sample.mask is None else np.flatnonzero(sample.mask)

    def values(appearance, pairs):
        pictures = np.asarray(appearance.pictures(pairs), np.float32)
        return pictures.reshape(-1, texels, 3)[:, valid].reshape(-1)

    def work(pairs):
        with np.errstate(over="ignore", invalid="ignore"):  # shows in the sums
            return pairs.stop, *_squares(values(sample, pairs), values(model, pairs))

    total, energy = 0.0, 0.0
    with single_threaded_blas():
        parts = blocks(sample.n_pairs, _pictures_at_once(sample))
        for done, squared, square in ordered_map(work, parts, threads):
            total += squared
            energy += square
            if on_progress is not None:
                on_progress(done, sample.n_pairs)
    require_summable(energy, math.inf)
    if not math.isfinite(total):
        raise InputError(
            "the sample's values are too large: what the model makes of them leaves single precision. Scale them down"
            " (`btfpipe ingest --white`)."
        )
    return {
        "rmse": math.sqrt(total / (3 * (texels - sample.n_invalid) * sample.n_pairs)),
        "relative_error": math.sqrt(total / energy) if energy > 0 else 0.0,
    }


def comparison_bytes(sample):
    """Private memory that `measured_error` takes a thread, above what the Model unpacks for itself."""
    return 5 * 12 * math.prod(sample.shape) * _pictures_at_once(sample)


def _pictures_at_once(sample):
    wanted = max(_LEAST_PICTURES, _BLOCK_BYTES // (12 * math.prod(sample.shape)))
    return min(sample.n_pairs, wanted)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _squares(reference, values):
    """Sums of the squared differences and of the squared references (n,), in double precision."""
    squared = 0.0
    square = 0.0
    for i in range(len(reference)):
        value = np.float64(reference[i])
        error = value - np.float64(values[i])
        squared += error * error
        square += value * value
    return squared, square


def require_summable(energy, most=MOST_ENERGY):
    """Refuse a Sample by what its squares add up to so far, by `sum_of_squares`.

    No sum of products of its values is larger: checked before they are made, none of them overflows.

    Parameters
    ----------
    energy : float
    most : float
        What the method stands.

    Raises
    ------
    InputError
        If values are not finite, or too large.
    """
    if not math.isfinite(energy):
        raise InputError("the sample holds non-finite values; `btfpipe info` counts them.")
    if energy > most:
        raise InputError(
            f"the sample's values are too large for single precision: sums over them reach {energy:.1e}, expected at"
            f" most {most:.0e}. Scale them down (`btfpipe ingest --white`)."
        )


def sum_of_squares(values):
    """Sum of squares of a contiguous array, in double precision.

    Squares of single precision neither overflow there nor vanish: the sum is finite if the values are, and 0 only if they are.
    """
    return _sum_of_squares(values.reshape(-1))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _sum_of_squares(values):
    total = 0.0
    for i in range(len(values)):
        total += np.float64(values[i]) * np.float64(values[i])
    return total
