"""The head of Bonn's ``.btf`` files, which all kinds share: meta block, directions, size of the pictures.

A file is mapped and read from front to back. What it declares is held against its own length before anything is read.
"""

import math
import re
import struct
from pathlib import Path

import numpy as np

from btfpipe.directions import from_angles
from btfpipe.errors import InputError, naming
from btfpipe.sample.colour import spectrum_to_rgb

_LEGACY_PVF = 301074
_SCALARS = {2: np.dtype("<f2"), 4: np.dtype("<f4"), 8: np.dtype("<f8")}
_WAVELENGTH = re.compile(r"(\d{2,5}(?:\.\d*)?) *(?:nm)?")
_OURS = re.compile(rb'<btfpipe toroidal="(true|false)" absolute="(true|false)"/>')


class MappedFile:
    """A mapped file, read from front to back; every size is checked against what is left of it."""

    def __init__(self, path):
        self.path = Path(path)
        try:
            self.size = self.path.stat().st_size
            # one mapping for all arrays: there may be more chunks than a process may have mappings
            self.bytes = np.memmap(self.path, np.uint8, "r") if self.size else np.zeros(0, np.uint8)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
        self.at = 0

    def need(self, count, section):
        """Refuse if fewer than `count` bytes are left."""
        if count > self.size - self.at:
            raise InputError(
                f"{self.path}: {section} needs {count} bytes at {self.at}, and the file has"
                f" {self.size - self.at} more; it is truncated or damaged. Fetch it again."
            )

    def take(self, count, section):
        """The next bytes."""
        self.need(count, section)
        data = self.bytes[self.at : self.at + count].tobytes()
        self.at += count
        return data

    def unpack(self, layout, section):
        """The next numbers, by a layout of `struct`."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), section))

    def count(self, section, least=1):
        """The next u32, at least `least`."""
        (value,) = self.unpack("I", section)
        if value < least:
            raise self.wrong(section, value, f"at least {least}")
        return value

    def array(self, shape, dtype, section):
        """Map the next array, read-only."""
        count = math.prod(int(n) for n in shape)
        self.need(count * dtype.itemsize, section)
        array = np.ndarray(tuple(shape), dtype, self.bytes, self.at)
        self.at += array.nbytes
        return array

    def scalar(self, section):
        """The type of the numbers that follow, from the byte that gives their size."""
        (size,) = self.unpack("B", section)
        if size not in _SCALARS:
            raise self.wrong(f"{section}: bytes of a number", size, "2, 4 or 8")
        return _SCALARS[size]

    def finish(self):
        """Refuse bytes after the last section."""
        if self.at != self.size:
            raise InputError(
                f"{self.path}: {self.size - self.at} bytes follow the last section; expected the end of the file"
                f" at {self.at}. The file is damaged, or of a variety that is not known."
            )

    def wrong(self, section, found, expected):
        return InputError(f"{self.path}: {section} is {found}; expected {expected}.")


class Header:
    """What a file says before its rotations and its body.

    Attributes
    ----------
    light_directions, view_directions : (n, 3) float64
    light_index, view_index : (pairs,) int32
        Of a product, light fastest.
    rows, cols : int
    n_channels : int
    to_rgb : (3, n_channels) float32 or None
        Linear Rec. 709 values of spectra, whose channels are wavelengths; None where they are red, green and blue.
    toroidal, absolute : bool
        As our own files say it, else False.
    texels_per_mm : float or None
    flag : int or None
        The cosine flag; files older than it have none.
    legacy : bool
        Whether it is a PVF from before the meta block; then `n_factorised` is its number of views.
    scan_lines, packing, mask
        Of a BDI: rows a chunk; 0 (all texels), 1 (all, by bzip2) or 2 (those of the mask); and (rows * cols,) uint8.
    facts : dict
        For the result.
    """

    toroidal = absolute = legacy = False
    texels_per_mm = flag = to_rgb = None
    n_channels = 3

    def __init__(self, kind, signature):
        self.facts = {"format": f"Bonn .btf, {kind}", "signature": signature.decode()}

    @property
    def n_pairs(self):
        return len(self.light_index)

    def pair_factor(self):
        """Cosine of each pair's light (pairs,) float32, or None where it is in the values already."""
        if self.facts["cosine"].startswith("inside"):
            return None
        return self.light_directions[self.light_index, 2].astype(np.float32)


def read_header(file, kind, signature, cosine):
    """Read all that follows the signature, up to the rotations; `cosine` as in `btf.read_btf`."""
    header = Header(kind, signature)
    if kind == "PVF":
        (magic,) = file.unpack("i", "meta block")
        header.legacy = magic == _LEGACY_PVF
        file.at -= 4
    if header.legacy:
        file.at += 4
        file.count("number of components")
        header.cols, header.rows = file.count("width"), file.count("height")
        header.n_factorised = file.count("number of views")
        header.facts["signature"] += ", legacy"
    else:
        _read_meta(file, header)
    _read_directions(file, header)
    if not header.legacy:
        header.cols, header.rows = file.count("width"), file.count("height")
    if cosine is not None:
        header.facts["cosine"] = f"{cosine}, as asked"
    elif header.flag is None:
        header.facts["cosine"] = "divided: the file is older than the flag; multiplied in"
    elif header.flag:
        header.facts["cosine"] = "inside, by the file's flag"
    else:
        header.facts["cosine"] = "divided, by the file's flag; multiplied in"
    if kind == "BDI":
        _read_mask(file, header)
    return header


def _read_meta(file, header):
    """The meta block."""
    section, start = "meta block", file.at
    size, version = file.unpack("II", section)
    if size < 264:
        raise file.wrong(f"{section}: size", size, "at least 264")
    file.at = start
    file.need(size, section)
    file.at = start + 8
    for name in ("measurement_setup", "image_sensor", "light_source"):
        text = file.take(80, section).split(b"\0")[0].decode("latin-1").strip()
        if text:
            header.facts[name] = text
    density, *scale = file.unpack("4f", section)
    if math.isfinite(density) and density > 0:
        header.texels_per_mm = density
    if all(map(math.isfinite, scale)) and any(s not in (0.0, 1.0) for s in scale):
        header.facts["rgb_scale"] = list(scale)
    names = ()
    if version > 1:
        header.flag = file.unpack("I", section)[0]
        if header.flag > 1:
            raise file.wrong(f"{section}: cosine flag", header.flag, "0 or 1")
    if version > 2:
        ours = _OURS.fullmatch(file.take(file.unpack("I", section)[0], f"{section}: XML"))
        if ours:
            header.toroidal, header.absolute = (value == b"true" for value in ours.groups())
    if version > 3:
        header.n_channels = file.count(f"{section}: number of channels")
        file.need(4 * header.n_channels, f"{section}: channel names")
        names = [
            file.take(file.unpack("I", section)[0], f"{section}: channel names")
            for _ in range(header.n_channels)
        ]
    if file.at != start + size:
        raise file.wrong(f"{section}: size", size, f"{file.at - start}, where its fields end")
    if header.n_channels != 3:
        _read_wavelengths(file, header, [name.decode("latin-1").strip("\0 ") for name in names])


def _read_wavelengths(file, header, names):
    """What the channels of spectra count as red, green and blue."""
    found = [_WAVELENGTH.fullmatch(name) for name in names]
    if not all(found):
        bad = names[found.index(None)]
        raise InputError(
            f"{file.path}: {header.n_channels} channels, one of them {bad[:20]!r}; expected 3 (red, green and blue), or names"
            " that are wavelengths in nanometres."
        )
    wavelengths = np.array([float(match[1]) for match in found])
    with naming(f"{file.path}: channels"):
        header.to_rgb = spectrum_to_rgb(wavelengths).astype(np.float32)
    header.facts["spectra"] = (
        f"{header.n_channels} wavelengths, {wavelengths.min():g} to {wavelengths.max():g} nm, as seen under D65"
    )


def _read_directions(file, header):
    """Views, each with the same lights."""
    section = "directions"
    n_views = file.count(f"{section}: number of views")
    file.need(12 * n_views, section)
    views, first = np.empty((n_views, 2)), None
    for v in range(n_views):
        *views[v], n_lights = file.unpack("ffI", section)
        file.need(8 * n_lights, f"{section}: lights of view {v}")
        lights = file.take(8 * n_lights, section)
        if first is None:
            first = lights
        if not lights:
            raise file.wrong(f"{section}: number of lights of view {v}", 0, "at least 1")
        if lights != first:
            raise InputError(
                f"{file.path}: {section}: the {n_lights} lights of view {v} differ from the {len(first) // 8} of"
                " view 0; expected the same lights for every view."
            )
    lights = np.frombuffer(first, "<f4").reshape(-1, 2).astype(float)
    for name, angles in (("view", views), ("light", lights)):
        theta = angles[:, 0]
        good = np.isfinite(angles).all(axis=1) & (theta >= 0) & (theta <= math.pi / 2 + 1e-3)
        if not good.all():
            bad = int(np.argmin(good))
            raise InputError(
                f"{file.path}: {section}: {name} {bad} has the angles {angles[bad].tolist()}; expected radians, the"
                " polar angle from 0 to pi / 2."
            )
        theta = np.minimum(theta, math.pi / 2)
        setattr(header, f"{name}_directions", from_angles(theta, angles[:, 1]))
    pair = np.arange(n_views * len(lights))
    header.light_index = (pair % len(lights)).astype(np.int32)
    header.view_index = (pair // len(lights)).astype(np.int32)


def _read_mask(file, header):
    """How a BDI is packed, and the mask of its texels."""
    header.scan_lines = file.count("scan lines a chunk")
    (header.packing,) = file.unpack("B", "compression")
    if header.packing not in (0, 1, 2):
        raise file.wrong("compression", header.packing, "0 (none), 1 (bzip2) or 2 (sparse)")
    header.mask = file.array((header.rows * header.cols,), np.dtype("u1"), "mask")
