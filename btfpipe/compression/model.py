"""What Models of every method share: tables of directions, their file, their measured error."""

import math
from types import SimpleNamespace

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas
from btfpipe.sample.appearance import Appearance

_TABLES = ("light_directions", "view_directions", "light_index", "view_index")
_BLOCK_BYTES = 4 << 20  # linear pictures compared at a time


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
        model = cls.from_arrays(reader, read_tables(reader))
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
    about = reader.about
    lights = reader.require("light_directions", (None, 3), "f")
    views = reader.require("view_directions", (None, 3), "f")
    if "light_index" in reader:
        index = [reader.require(name, (None,), "iu") for name in _TABLES[2:]]
        if len(index[0]) != len(index[1]):
            raise InputError(
                f"{reader.path}: {len(index[0])} lights and {len(index[1])} views of pairs; expected as many."
            )
    else:
        pair = np.arange(len(lights) * len(views), dtype=np.int32)
        index = [pair % len(lights), pair // len(lights)]
    return SimpleNamespace(
        light_directions=lights,
        view_directions=views,
        light_index=index[0],
        view_index=index[1],
        toroidal=about["toroidal"],
        texels_per_mm=about["texels_per_mm"],
        absolute=about["absolute"],
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
        If no texel is valid.
    """
    if sample.mask is not None and not sample.mask.any():
        raise InputError("the sample has no valid texel.")
    texels = sample.shape[0] * sample.shape[1]
    valid = slice(None) if sample.mask is None else np.flatnonzero(sample.mask)

    def values(appearance, pairs):
        pictures = np.asarray(appearance.pictures(pairs), np.float32)
        return pictures.reshape(-1, texels, 3)[:, valid].reshape(-1)

    def work(pairs):
        reference = values(sample, pairs)
        error = reference - values(model, pairs)
        squares = (
            float(np.square(a, dtype=np.float64).sum(dtype=np.float64)) for a in (error, reference)
        )
        return pairs.stop, *squares

    total, energy = 0.0, 0.0
    with single_threaded_blas():
        parts = blocks(sample.n_pairs, max(1, _BLOCK_BYTES // (12 * texels)))
        for done, squared, square in ordered_map(work, parts, threads):
            total += squared
            energy += square
            if on_progress is not None:
                on_progress(done, sample.n_pairs)
    return {
        "rmse": math.sqrt(total / (3 * (texels - sample.n_invalid) * sample.n_pairs)),
        "relative_error": math.sqrt(total / energy) if energy > 0 else 0.0,
    }
