"""The bodies of Bonn's ``.btf`` files: what follows head and rotations, one function a kind.

Factors stay mapped from the file; pictures of PVF and BDI are made when they are asked for.
"""

import threading

import numpy as np

from btfpipe.compression.factored import SPACES, FactoredModel
from btfpipe.errors import InputError
from btfpipe.sample.measurement import Measurement

_SCALARS = {2: np.dtype("<f2"), 4: np.dtype("<f4"), 8: np.dtype("<f8")}
_SPACE_NAMES = {number: name for name, number in SPACES.items()}
_CHECKED = 1 << 22  # values looked at together


def read_dfmf(file, header):
    """A factorisation of each channel of a colour space, as a `FactoredModel`."""
    section = "colours"
    _, model, *numbers = file.unpack("Ii12f", section)
    mean, matrix = np.array(numbers[:3]), np.array(numbers[3:]).reshape(3, 3)
    space = _SPACE_NAMES.get(model)
    if space is None:
        known = ", ".join(f"{number} ({name})" for name, number in SPACES.items())
        raise file.wrong(f"{section}: colour model", model, f"one of {known}")
    if space == "pca":
        _require_finite(file, section, mean, matrix)
    pairs = [_read_factors(file, f"channel {c}") for c in range(3)]
    file.finish()
    angular, texture = [], []
    for c, (left, right) in enumerate(pairs):
        section = f"channel {c}"
        left, right = _angular_and_texture(file, header, left, right, section)
        _require_finite(file, section, left, right)
        angular.append(left)
        texture.append(right)
    pca = space == "pca"
    return FactoredModel(
        angular, texture, space, header,
        matrix=matrix if pca else None, mean=mean if pca else None,
        pair_factor=header.pair_factor(), about=_about(header, angular),
    )  # fmt: skip


def read_fmf(file, header, extended):
    """One factorisation of all channels, as a `FactoredModel`; `extended`: whether a header extension precedes it."""
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
    left, texture = _angular_and_texture(file, header, left, right, section, 3)
    _require_finite(file, section, left, texture)
    angular = [left[c::3] for c in range(3)]
    return FactoredModel(
        angular, [texture] * 3, "rgb", header, log_range=method != 0,
        pair_factor=header.pair_factor(), about=_about(header, angular),
    )  # fmt: skip


def read_pvf(file, header):
    """A principal component analysis of each view, as a `Measurement`."""
    n_views, n_lights = len(header.view_directions), len(header.light_directions)
    texels = header.rows * header.cols
    if header.legacy:
        n_factorised = header.n_factorised
    else:
        file.count("number of components")
        n_factorised = file.count("number of views")
    if n_factorised != n_views:
        raise file.wrong("number of factorised views", n_factorised, f"{n_views}, as directions")
    views = []
    for v in range(n_views):
        section = f"view {v}"
        dtype = _scalar(file, section)
        terms, n_weights, size = (file.count(f"{section}: sizes") for _ in range(3))
        file.need((terms + size + (size + n_weights) * terms) * dtype.itemsize, section)
        file.at += terms * dtype.itemsize
        mean = file.array((size,), dtype, section)
        components = file.array((size, terms), dtype, section)
        weights = file.array((n_weights, terms), dtype, section)
        per_texel = (n_weights, size) == (texels, 3 * n_lights)
        if not per_texel and (n_weights, size) != (n_lights, 3 * texels):
            raise InputError(
                f"{file.path}: {section} has {n_weights} weights of {size} values; expected {texels} of"
                f" {3 * n_lights}, or {n_lights} of {3 * texels}."
            )
        views.append((mean, components, weights, per_texel))
    file.finish()
    factor = header.pair_factor()

    def read(pair):
        v, light = divmod(pair, n_lights)
        mean, components, weights, per_texel = views[v]
        if per_texel:
            part = slice(3 * light, 3 * light + 3)
            weights = np.asarray(weights, np.float32)
            picture = weights @ np.asarray(components[part], np.float32).T
            picture += np.asarray(mean[part], np.float32)
        else:
            picture = np.asarray(components, np.float32) @ np.asarray(weights[light], np.float32)
            picture += np.asarray(mean, np.float32)
        picture = picture.reshape(header.rows, header.cols, 3)
        return picture if factor is None else picture * factor[pair]

    return _measurement(file, header, read)


def read_bdi(file, header, memory):
    """Half floats, texel by texel, as a `Measurement` that turns them into pictures within `memory` bytes."""
    stored = np.arange(len(header.mask))
    if header.packing == 2:
        stored = np.flatnonzero(header.mask)
    n_values = 3 * header.n_pairs
    full = header.cols * header.scan_lines
    chunks = []
    for first in range(0, len(stored), min(full, max(len(stored), 1))):
        section = f"chunk {len(chunks)}"
        count = min(full, len(stored) - first)
        (size,) = file.unpack("I", section)
        # the makers' library writes a last chunk as long as the others, with nothing at its end
        if size not in (2 * n_values * count, 2 * n_values * full):
            raise file.wrong(
                f"{section}: bytes", size, f"{2 * n_values * count}, for {count} texels"
            )
        chunk = file.array((size // (2 * n_values), n_values), np.dtype("<f2"), section)
        chunks.append((stored[first : first + count], chunk[:count]))
    file.finish()
    windows = _Windows(chunks, len(header.mask), header.n_pairs, memory)
    factor = header.pair_factor()

    def read(pair):
        picture = windows.picture(pair).reshape(header.rows, header.cols, 3)
        return picture if factor is None else picture.astype(np.float32) * factor[pair]

    measurement = _measurement(file, header, read)
    valid = header.mask.reshape(header.rows, header.cols) != 0
    if (
        header.packing == 2 or valid.any()
    ):  # beside all texels, an empty mask is one never filled in
        measurement.mask = None if valid.all() else valid
    return measurement


class _Windows:
    """Pictures from chunks of texels: two runs of consecutive pairs in memory, each filled by one pass over the file.

    Two, as threads that read one pair after the other may be on both sides of a border.
    """

    def __init__(self, chunks, texels, n_pairs, memory):
        self.chunks, self.texels, self.n_pairs = chunks, texels, n_pairs
        self.length = max(1, min(n_pairs, memory // 2 // (6 * texels)))
        self.held = {}
        self.lock = threading.Lock()

    def picture(self, pair):
        """Values (texels, 3) float16; 0 where no texel is stored."""
        window, slot = divmod(pair, self.length)
        with self.lock:
            if window not in self.held:
                while len(self.held) > 1:
                    self.held.pop(min(self.held))
                self.held[window] = self._fill(window * self.length)
            return self.held[window][slot]

    def _fill(self, first):
        last = min(first + self.length, self.n_pairs)
        out = np.zeros((last - first, self.texels, 3), np.float16)
        for texels, chunk in self.chunks:
            part = np.asarray(chunk[:, 3 * first : 3 * last]).reshape(len(texels), -1, 3)
            out[:, texels] = part.swapaxes(0, 1)
        return out


def _about(header, angular):
    return {"source": header.facts, "n_terms": [factors.shape[1] for factors in angular]}


def _measurement(file, header, read):
    names = [
        f"{file.path}: view {v}, light {n}"
        for v, n in zip(header.view_index.tolist(), header.light_index.tolist(), strict=True)
    ]
    return Measurement(
        source=file.path,
        light_directions=header.light_directions,
        view_directions=header.view_directions,
        light_index=header.light_index,
        view_index=header.view_index,
        names=names,
        read=read,
        transfer=lambda picture: "linear",
        white=1.0 if header.absolute else None,
        toroidal=True if header.toroidal else None,
        texels_per_mm=header.texels_per_mm,
        facts=header.facts,
    )


def _read_factors(file, section):
    """Singular values are skipped; U (rows, K) and S V (cols, K) are mapped."""
    dtype = _scalar(file, section)
    terms = file.count(f"{section}: number of terms")
    rows, cols = (file.count(f"{section}: size of the matrix") for _ in range(2))
    file.need((1 + rows + cols) * terms * dtype.itemsize, section)
    file.at += terms * dtype.itemsize
    return file.array((rows, terms), dtype, section), file.array((cols, terms), dtype, section)


def _scalar(file, section):
    (size,) = file.unpack("B", section)
    if size not in _SCALARS:
        raise file.wrong(f"{section}: bytes of a number", size, "2, 4 or 8")
    return _SCALARS[size]


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


def _require_finite(file, section, *arrays):
    for array in arrays:
        flat = array.reshape(-1)
        for start in range(0, len(flat), _CHECKED):
            part = np.asarray(flat[start : start + _CHECKED])
            bad = part.size - int(np.isfinite(part).sum())
            if bad:
                raise InputError(f"{file.path}: {section} holds {bad} NaN or infinite values.")
