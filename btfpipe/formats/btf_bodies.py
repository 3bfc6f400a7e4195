"""Bodies of Bonn's ``.btf`` files that are factorisations of pairs and texels. Factors stay mapped from the file."""

import numpy as np

from btfpipe.compression.factored import EPSILON, SPACES, FactoredModel
from btfpipe.errors import InputError
from btfpipe.formats.btf_pictures import read_factored_spectra

_SPACE_NAMES = {number: name for name, number in SPACES.items()}
_CHECKED = 1 << 22  # values looked at together
_MOST = 1e37  # of values, which becoming colours may multiply by a little, in single precision


def _values(channels):
    """Channels that are the values themselves."""


def _exponentials(channels):
    """Values from their logarithms."""
    np.exp(channels, out=channels)
    channels -= EPSILON


def _sum_and_ratios(channels):
    """Values from their sum, in the first channel, and from the parts of it that all but the first value have."""
    rest = 1 - channels[1:].sum(axis=0)
    channels[1:] *= channels[0]
    channels[0] *= rest


def _mean_and_differences(channels):
    """Values as the makers' library has them, the one description: the n-fold first channel and what others add to it."""
    n = len(channels)
    mean = channels[0] * n
    channels[0] = mean - channels[1:].sum(axis=0) / n
    channels[1:] = mean * (1 + channels[1:])


# Colour models of any number of channels, by number: what turns (channels, pairs, texels) into values, in place.
_SPECTRAL = {0: _values, 5: _sum_and_ratios, 6: _mean_and_differences, 12: _exponentials}


def read_dfmf(file, header, memory):
    """A factorisation of each channel of a colour space, as a `FactoredModel`; of spectra, as a `Measurement`."""
    section = "colours"
    _, model, *numbers = file.unpack("Ii12f", section)
    mean, matrix = np.array(numbers[:3]), np.array(numbers[3:]).reshape(3, 3)
    colour = header.n_channels == 3
    space = _SPACE_NAMES.get(model) if colour else None
    if space is None and model not in _SPECTRAL:
        known = [f"{number} ({name})" for name, number in SPACES.items() if colour]
        known += [
            str(number) for number in _SPECTRAL if number not in SPACES.values() or not colour
        ]
        channels = "" if colour else f" of {header.n_channels} channels"
        raise file.wrong(f"{section}: colour model{channels}", model, f"one of {', '.join(known)}")
    if space == "pca":
        _require_finite(file, section, np.array(numbers))
    pairs = [_read_factors(file, f"channel {c}") for c in range(header.n_channels)]
    file.finish()
    angular, texture = [], []
    for c, (left, right) in enumerate(pairs):
        section = f"channel {c}"
        left, right = _angular_and_texture(file, header, left, right, section)
        _require_factors(file, section, left, right)
        angular.append(left)
        texture.append(right)
    if space is None:
        return read_factored_spectra(file, header, angular, texture, _SPECTRAL[model], memory)
    pca = space == "pca"
    return FactoredModel(
        angular, texture, space, header,
        matrix=matrix if pca else None, mean=mean if pca else None,
        pair_factor=header.pair_factor(), about=_about(header, angular),
    )  # fmt: skip


def read_fmf(file, header, memory, extended):
    """One factorisation of all channels, as a `FactoredModel`; of spectra in logarithms, as a `Measurement`.

    `extended`: whether a header extension precedes it.
    """
    section, version, method = "header extension", 0, 0
    if extended:
        (version,) = file.unpack("B", section)
        if version > 2:
            raise file.wrong(f"{section}: version", version, "0, 1 or 2")
    if version >= 1:
        (method,) = file.unpack("I", section)
    if version >= 2:
        cols, rows = file.unpack("II", section)
        file.need(2 * rows * cols, "height map")
        file.at += 2 * rows * cols
        if rows * cols:
            header.facts["height_map"] = f"{rows} x {cols}, left out"
    section = "factors"
    file.count(f"{section}: number of terms")
    left, right = _read_factors(file, section)
    file.finish()
    channels = header.n_channels
    left, texture = _angular_and_texture(file, header, left, right, section, channels)
    _require_factors(file, section, left, texture)
    angular = [left[c::channels] for c in range(channels)]
    if header.to_rgb is not None:
        if method != 0:
            texture = [texture] * channels
            return read_factored_spectra(file, header, angular, texture, _exponentials, memory)
        spectra = left.astype(np.float32).reshape(-1, channels, left.shape[1])
        angular = list(np.einsum("rc,pck->rpk", header.to_rgb, spectra))
    return FactoredModel(
        angular, [texture] * 3, "rgb", header, log_range=method != 0,
        pair_factor=header.pair_factor(), about=_about(header, angular),
    )  # fmt: skip


def _about(header, angular):
    return {"source": header.facts, "n_terms": [factors.shape[1] for factors in angular]}


def _read_factors(file, section):
    """Singular values are skipped; U (rows, K) and S V (cols, K) are mapped."""
    dtype = file.scalar(section)
    terms = file.count(f"{section}: number of terms")
    rows, cols = (file.count(f"{section}: size of the matrix") for _ in range(2))
    file.need((1 + rows + cols) * terms * dtype.itemsize, section)
    file.at += terms * dtype.itemsize
    return file.array((rows, terms), dtype, section), file.array((cols, terms), dtype, section)


def _angular_and_texture(file, header, left, right, section, channels=1):
    """Which factor belongs to the pairs; the other becomes (rows, cols, K)."""
    texels, columns = header.rows * header.cols, channels * header.n_pairs
    if (len(left), len(right)) != (columns, texels):
        if (len(left), len(right)) != (texels, columns):
            raise InputError(
                f"{file.path}: {section} is {len(left)} x {len(right)}; expected {columns} x {texels} ("
                f"{len(header.view_directions)} views x {len(header.light_directions)} lights, {header.cols} x"
                f" {header.rows} texels), or that transposed."
            )
        left, right = right, left
    return left, right.reshape(header.rows, header.cols, -1)


def _require_factors(file, section, left, right):
    """Refuse factors that hold what is no number, or whose products may exceed single precision."""
    largest = [_require_finite(file, section, factor) for factor in (left, right)]
    most = left.shape[1] * largest[0] * largest[1]
    if not max(most, *largest) < _MOST:
        raise InputError(
            f"{file.path}: {section} has factors up to {largest[0]:.3g} and {largest[1]:.3g}; expected products in single"
            " precision. The file is damaged."
        )


def _require_finite(file, section, array):
    """Refuse what is no number; else the largest size."""
    flat, largest = array.reshape(-1), 0.0
    for start in range(0, len(flat), _CHECKED):
        part = np.asarray(flat[start : start + _CHECKED])
        bad = part.size - int(np.isfinite(part).sum())
        if bad:
            raise InputError(f"{file.path}: {section} holds {bad} NaN or infinite values.")
        largest = max(largest, float(np.abs(part).max()))
    return largest
