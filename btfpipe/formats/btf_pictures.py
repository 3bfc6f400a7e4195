"""Bodies of Bonn's ``.btf`` files whose pictures are made when they are asked for: each gives a `Measurement`."""

import bz2
import threading

import numpy as np

from btfpipe.errors import InputError
from btfpipe.sample.measurement import Measurement


def read_pvf(file, header):
    """A principal component analysis of each view, as a `Measurement`."""
    n_views, n_lights = len(header.view_directions), len(header.light_directions)
    channels, texels = header.n_channels, header.rows * header.cols
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
        dtype = file.scalar(section)
        terms, n_weights, size = (file.count(f"{section}: sizes") for _ in range(3))
        file.need((terms + size + (size + n_weights) * terms) * dtype.itemsize, section)
        file.at += terms * dtype.itemsize
        mean = file.array((size,), dtype, section)
        components = file.array((size, terms), dtype, section)
        weights = file.array((n_weights, terms), dtype, section)
        per_texel = (n_weights, size) == (texels, channels * n_lights)
        if not per_texel and (n_weights, size) != (n_lights, channels * texels):
            raise InputError(
                f"{file.path}: {section} has {n_weights} weights of {size} values; expected {texels} of"
                f" {channels * n_lights}, or {n_lights} of {channels * texels}."
            )
        views.append((mean, components, weights, per_texel))
    file.finish()

    def read(pair):
        v, light = divmod(pair, n_lights)
        mean, components, weights, per_texel = views[v]
        if per_texel:
            part = slice(channels * light, channels * (light + 1))
            weights = np.asarray(weights, np.float32)
            picture = weights @ np.asarray(components[part], np.float32).T
            picture += np.asarray(mean[part], np.float32)
        else:
            picture = np.asarray(components, np.float32) @ np.asarray(weights[light], np.float32)
            picture += np.asarray(mean, np.float32)
        return picture.reshape(texels, channels)

    return _measurement(file, header, read)


def read_bdi(file, header, memory):
    """Half floats, texel by texel, as a `Measurement` that turns them into pictures within `memory` bytes."""
    stored = np.arange(len(header.mask))
    if header.packing == 2:
        stored = np.flatnonzero(header.mask)
    n_values = header.n_channels * header.n_pairs
    full = header.cols * header.scan_lines
    chunks = []
    for first in range(0, len(stored), min(full, max(len(stored), 1))):
        section = f"chunk {len(chunks)}"
        count = min(full, len(stored) - first)
        # the makers' library writes a last chunk as long as the others, with nothing at its end
        sizes = 2 * n_values * count, 2 * n_values * full
        (size,) = file.unpack("I", section)
        if header.packing != 1 and size not in sizes:
            raise file.wrong(f"{section}: bytes", size, f"{sizes[0]}, for {count} texels")
        if header.packing == 1 and sizes[0] > memory:
            raise file.wrong(f"{section}: bytes once unpacked", sizes[0], f"at most {memory}")
        chunk = file.array((size,), np.dtype("u1"), section)
        chunks.append((stored[first : first + count], chunk, sizes))
    file.finish()

    def fill(first, last):
        out = np.zeros((last - first, len(header.mask), header.n_channels), np.float16)
        part = slice(header.n_channels * first, header.n_channels * last)
        for number, (texels, chunk, sizes) in enumerate(chunks):
            if header.packing == 1:
                chunk = _unpacked(file, f"chunk {number}", chunk, sizes)
            values = chunk.view("<f2").reshape(-1, n_values)[: len(texels), part]
            out[:, texels] = values.reshape(len(texels), last - first, -1).swapaxes(0, 1)
        return out

    windows = _Windows(fill, header, 2, memory)
    measurement = _measurement(file, header, windows.picture)
    valid = header.mask.reshape(header.rows, header.cols) != 0
    if (
        header.packing == 2 or valid.any()
    ):  # beside all texels, an empty mask is one never filled in
        measurement.mask = None if valid.all() else valid
    return measurement


def _unpacked(file, section, chunk, sizes):
    """The bytes of a chunk packed by bzip2, of which there must be one of two numbers."""
    try:
        data = bz2.BZ2Decompressor().decompress(chunk.tobytes(), max(sizes) + 1)
    except OSError as error:
        raise InputError(f"{file.path}: {section} is damaged ({error}). Fetch it again.") from error
    if len(data) not in sizes:
        raise file.wrong(f"{section}: bytes once unpacked", len(data), sizes[0])
    return np.frombuffer(data, np.uint8)


def read_factored_spectra(file, header, angular, texture, undo, memory):
    """Spectra from factors of each channel, as a `Measurement` that multiplies them within `memory` bytes.

    Parameters
    ----------
    file, header
    angular : sequence of (pairs, K_c)
    texture : sequence of (rows, cols, K_c)
    undo : callable
        ``undo(channels)`` turns products of factors (channels, pairs, texels) into values, in place.
    memory : int
    """

    def fill(first, last):
        channels = np.stack(
            [
                np.asarray(left[first:last], np.float32)
                @ np.asarray(right, np.float32).reshape(-1, right.shape[2]).T
                for left, right in zip(angular, texture, strict=True)
            ]
        )
        undo(channels)
        return np.ascontiguousarray(np.moveaxis(channels, 0, 2))

    windows = _Windows(
        fill, header, 8, memory
    )  # twice single precision: as channels and as pictures
    terms = [factors.shape[1] for factors in angular]
    header.facts["terms"] = f"{min(terms)} to {max(terms)} a channel"
    return _measurement(file, header, windows.picture)


class _Windows:
    """Pictures of all channels: two runs of consecutive pairs in memory, each filled by one pass over the file.

    Two, as threads that read one pair after the other may be on both sides of a border. ``fill(first, last)`` gives the
    values (last - first, texels, channels) of pairs; `each` is the bytes of one in memory.
    """

    def __init__(self, fill, header, each, memory):
        self.fill, self.n_pairs = fill, header.n_pairs
        picture = each * header.n_channels * header.rows * header.cols
        self.length = max(1, min(self.n_pairs, memory // 2 // picture))
        self.held = {}
        self.lock = threading.Lock()

    def picture(self, pair):
        """Values (texels, channels) of a pair."""
        window, slot = divmod(pair, self.length)
        with self.lock:
            if window not in self.held:
                while len(self.held) > 1:
                    self.held.pop(min(self.held))
                first = window * self.length
                self.held[window] = self.fill(first, min(first + self.length, self.n_pairs))
            return self.held[window][slot]


def _measurement(file, header, read):
    """A Measurement from what reads the values (texels, channels) of a pair."""
    names = [
        f"{file.path}: view {v}, light {n}"
        for v, n in zip(header.view_index.tolist(), header.light_index.tolist(), strict=True)
    ]
    factor = header.pair_factor()

    def picture(pair):
        with np.errstate(over="ignore", invalid="ignore"):  # `ingest` names what is not finite
            values = read(pair)
            if header.to_rgb is not None:
                values = values.astype(np.float32) @ header.to_rgb.T
            values = values.reshape(header.rows, header.cols, 3)
            return values if factor is None else values.astype(np.float32) * factor[pair]

    return Measurement(
        source=file.path,
        light_directions=header.light_directions,
        view_directions=header.view_directions,
        light_index=header.light_index,
        view_index=header.view_index,
        names=names,
        read=picture,
        transfer=lambda picture: "linear",
        white=1.0 if header.absolute else None,
        toroidal=True if header.toroidal else None,
        texels_per_mm=header.texels_per_mm,
        facts=header.facts,
    )
