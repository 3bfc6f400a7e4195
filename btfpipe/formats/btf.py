"""Bonn's ``.btf`` files (UBO2014 and before): factorisations and plain values of a BTF, in one binary file.

====  =========================================================  =================
kind  holds                                                      read as
====  =========================================================  =================
DFMF  a factorisation of each channel of a colour space          `FactoredModel`
FMF   one factorisation of all channels together                 `FactoredModel`
PVF   a principal component analysis of each view                `Measurement`
BDI   half floats, one texel's lights and views after the other  `Measurement`
====  =========================================================  =================

Nothing is expanded: factors stay mapped from the file. All sizes that a file declares are held against its own length
before anything is read, and a file must end exactly where they say.

What no measured file has confirmed yet:

- The first stored row is taken as the top of the picture, as the library of the data's makers shows it; another
  reader turns the rows over. Azimuth 0 is taken along the columns, turning towards the picture's top, as in UBO2003.
- A cosine flag of 1 means that the light's cosine is inside the values, which is this project's convention; otherwise
  (and in files older than the flag) values are taken as divided by it, and each pair gets its light's cosine as a
  factor. `cosine` overrides that.
- Lab is taken under D50 to linear Rec. 709. The RGB scale factors of the header are reported, not applied.
- The mask of a BDI is taken with columns fastest.
"""

import math
import re
import struct
import threading
from pathlib import Path

import numpy as np

from btfpipe import store
from btfpipe.compression.factored import EPSILON, SPACES, FactoredModel, compress_factored
from btfpipe.directions import from_angles, to_angles
from btfpipe.errors import InputError
from btfpipe.sample.measurement import Measurement

# By signature, longest first: kind, whether the header is extended, whether rotations follow.
SIGNATURES = {
    b"!DFMF08FCR": ("DFMF", False, True),
    b"!FMF12FCER": ("FMF", True, True),
    b"!BDIF06R2!": ("BDI", False, True),
    b"!FMF06FCR": ("FMF", False, True),
    b"!PVF06FCR": ("PVF", False, True),
    b"!FMF06FC": ("FMF", False, False),
    b"!PVF06FC": ("PVF", False, False),
}
_KINDS = {
    "DFMF": "a factorisation channel by channel",
    "FMF": "a factorisation of all channels together",
    "PVF": "a principal component analysis of each view",
    "BDI": "plain values, texel by texel",
}
_LEGACY_PVF = 301074
_SCALARS = {2: np.dtype("<f2"), 4: np.dtype("<f4"), 8: np.dtype("<f8")}
_SPACE_NAMES = {number: name for name, number in SPACES.items()}
_CHECKED = 1 << 22  # values looked at together
_OURS = re.compile(rb'<btfpipe toroidal="(true|false)" absolute="(true|false)"/>')


def recognise(path):
    """Say why a file is one of Bonn's ``.btf``, or None if it is not (BigTIFF and others use the ending too)."""
    try:
        with open(path, "rb") as file:
            found = _signature(file.read(16))
    except OSError:
        return None
    if found is None:
        return None
    return f"its first bytes are {found.decode()}: {_KINDS[SIGNATURES[found][0]]} in Bonn's .btf format"


def _signature(head):
    return next((known for known in SIGNATURES if head.startswith(known)), None)


def read_btf(path, *, cosine=None, memory=1 << 30):
    """Read one of Bonn's ``.btf`` files.

    Parameters
    ----------
    path : path-like
        Must stay in place while the result is in use: it is mapped.
    cosine : str, optional
        ``inside`` or ``divided``: what was done with the light's cosine, whatever the file's flag says.
    memory : int
        Bytes in which to turn a BDI's values into pictures; each filling reads the file once.

    Returns
    -------
    FactoredModel or Measurement
        Of a product of views and lights; see the module for which. Values are linear and may exceed 1.

    Raises
    ------
    InputError
        Naming the section: another format, a size that the file's length does not bear, trailing bytes, counts that
        contradict each other, values that are not finite, or a variety that is not read (bzip, spectral).
    """
    if cosine not in (None, "inside", "divided"):
        raise InputError(f"cosine {cosine!r}; expected inside or divided.")
    file = _File(path)
    head = file.bytes[:16].tobytes()
    signature = _signature(head)
    if signature is None:
        raise InputError(
            f"{path}: not one of Bonn's .btf files: it starts with {head[:10]!r}; expected one of"
            f" {', '.join(known.decode() for known in SIGNATURES)}."
        )
    kind, extended, rotations = SIGNATURES[signature]
    file.take(len(signature), "signature")
    header = _read_header(file, kind, signature, rotations, cosine)
    bodies = {
        "DFMF": _read_dfmf,
        "FMF": lambda file, header: _read_fmf(file, header, extended),
        "PVF": _read_pvf,
        "BDI": lambda file, header: _read_bdi(file, header, memory),
    }
    return _with_rotations(file, header, bodies[kind])


class _File:
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

    def finish(self):
        """Refuse bytes after the last section."""
        if self.at != self.size:
            raise InputError(
                f"{self.path}: {self.size - self.at} bytes follow the last section; expected the end of the file"
                f" at {self.at}. The file is damaged, or of a variety that is not known."
            )

    def wrong(self, section, found, expected):
        return InputError(f"{self.path}: {section} is {found}; expected {expected}.")


class _Header:
    """What all four kinds share: directions, size, and facts for the result."""

    light_directions = view_directions = light_index = view_index = None
    toroidal, texels_per_mm, absolute = False, None, False

    def __init__(self, kind, signature):
        self.kind = kind
        self.facts = {"format": f"Bonn .btf, {kind}", "signature": signature.decode()}
        self.flag = None
        self.rows = self.cols = 0

    @property
    def n_pairs(self):
        return len(self.light_index)

    def pair_factor(self):
        """Cosine of each pair's light (pairs,) float32, or None where it is in the values already."""
        if self.facts["cosine"].startswith("inside"):
            return None
        return self.light_directions[self.light_index, 2].astype(np.float32)


def _read_header(file, kind, signature, rotations, cosine):
    header = _Header(kind, signature)
    header.rotations = rotations
    header.legacy = False
    if kind == "PVF":
        (magic,) = file.unpack("i", "meta block")
        header.legacy = magic == _LEGACY_PVF
        file.at -= 4
    if header.legacy:
        file.at += 4
        header.rotations = False
        header.components = file.count("number of components")
        header.cols, header.rows = file.count("width"), file.count("height")
        header.slots = file.count("number of views")
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
    channels = 3
    if version > 1:
        header.flag = file.unpack("I", section)[0]
        if header.flag > 1:
            raise file.wrong(f"{section}: cosine flag", header.flag, "0 or 1")
    if version > 2:
        ours = _OURS.fullmatch(file.take(file.unpack("I", section)[0], f"{section}: XML"))
        if ours:
            header.toroidal, header.absolute = (value == b"true" for value in ours.groups())
    if version > 3:
        (channels,) = file.unpack("I", section)
        file.need(4 * channels, f"{section}: channel names")
        names = [
            file.take(file.unpack("I", section)[0], f"{section}: channel names")
            for _ in range(channels)
        ]
    if file.at != start + size:
        raise file.wrong(f"{section}: size", size, f"{file.at - start}, where its fields end")
    if channels != 3:
        some = ", ".join(name.decode("latin-1") for name in names[:3])
        raise InputError(
            f"{file.path}: {channels} channels ({some} ...); expected 3, red, green and blue. Spectral data are"
            " not read."
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


def _with_rotations(file, header, body):
    """Read the body behind the rotations, whose numbers some writers take for 9 and some for 3 a frame."""
    if header.kind == "BDI":
        _read_mask(file, header)
    (count,) = file.unpack("I", "rotations") if header.rotations else (0,)
    if count == 0:
        return body(file, header)
    header.facts["rotations"] = count
    start, first = file.at, None
    for each in (9, 3):
        try:
            file.at = start
            file.need(4 * each * count, f"rotations ({each} numbers a frame)")
            file.at += 4 * each * count
            return body(file, header)
        except InputError as error:
            if file.at == file.size:  # the sizes fit, so something else is wrong
                raise
            first = first or error
    raise first


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


def _read_dfmf(file, header):
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


def _read_fmf(file, header, extended):
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


def _read_pvf(file, header):
    n_views, n_lights = len(header.view_directions), len(header.light_directions)
    texels = header.rows * header.cols
    if not header.legacy:
        file.count("number of components")
        header.slots = file.count("number of views")
    if header.slots != n_views:
        raise file.wrong("number of factorised views", header.slots, f"{n_views}, as directions")
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


def _read_mask(file, header):
    """What a BDI has before the rotations: how it is packed, and the mask of its texels."""
    header.scan_lines = file.count("scan lines a chunk")
    (header.packing,) = file.unpack("B", "compression")
    if header.packing not in (0, 2):
        found = "1 (bzip)" if header.packing == 1 else header.packing
        raise file.wrong("compression", found, "0 (all texels) or 2 (sparse)")
    header.mask = file.array((header.rows * header.cols,), np.dtype("u1"), "mask")


def _read_bdi(file, header, memory):
    stored = np.arange(len(header.mask))
    if header.packing == 2:
        stored = np.flatnonzero(header.mask)
        if len(stored) < len(header.mask):
            header.facts["missing_texels"] = len(header.mask) - len(stored)
    n_values = 3 * header.n_pairs
    most = min(header.cols * header.scan_lines, max(len(stored), 1))
    chunks = []
    for first in range(0, len(stored), most):
        section = f"chunk {len(chunks)}"
        count = min(most, len(stored) - first)
        (size,) = file.unpack("I", section)
        if size != 2 * n_values * count:
            raise file.wrong(
                f"{section}: bytes", size, f"{2 * n_values * count}, for {count} texels"
            )
        chunk = file.array((count, n_values), np.dtype("<f2"), section)
        chunks.append((stored[first : first + count], chunk))
    file.finish()
    windows = _Windows(chunks, len(header.mask), header.n_pairs, memory)
    factor = header.pair_factor()

    def read(pair):
        picture = windows.picture(pair).reshape(header.rows, header.cols, 3)
        return picture if factor is None else picture.astype(np.float32) * factor[pair]

    return _measurement(file, header, read)


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


def write_btf(
    path,
    appearance,
    *,
    terms=None,
    space=None,
    precision=None,
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Write a DFMF file (``!DFMF08FCR``), the kind of the UBO2014 downloads.

    A `FactoredModel` is written as it is; anything else is compressed first. Rows keep their order, so that what is
    written is read back equal; the light's cosine stays inside the values, and the flag says so.

    Parameters
    ----------
    path : path-like
    appearance : Appearance
        Of a product of views and lights. Some other readers also need as many lights as views, and colour model
        ``rgb`` or ``log_y_uv_over_y``.
    terms, space, precision : optional
        As in `compress_factored`, by default (32, 16, 16), ``log_y_uv_over_y`` and ``half``. A FactoredModel keeps its own;
        others may not be asked for.
    seed, threads, memory, on_progress
        As in `compress_factored`, where it is used.

    Returns
    -------
    FactoredModel
        What was written.

    Raises
    ------
    InputError
        If the pairs are not a product, or a FactoredModel does what the format cannot say, or has other terms, space or
        precision than those given.
    """
    appearance.require_product("a .btf file")
    store.check_writable(path)
    model = appearance
    if isinstance(model, FactoredModel):
        _require_own(model, terms, space, precision)
    else:
        given = {"terms": terms, "space": space, "precision": precision}
        given = {name: value for name, value in given.items() if value is not None}
        model = compress_factored(
            appearance, **given, seed=seed, threads=threads, memory=memory, on_progress=on_progress
        )
    number, flag = _expressible(model)
    light, view = (
        np.stack(to_angles(directions), axis=-1)
        for directions in (model.light_directions, model.view_directions)
    )
    rows, cols = model.shape
    with store.whole(path) as file:
        file.write(b"!DFMF08FCR" + _meta(model, flag))
        lights = struct.pack("<I", len(light)) + _signed(light)
        file.write(struct.pack("<I", len(view)))
        for angles in view:
            file.write(_signed(angles) + lights)
        file.write(struct.pack("<3I", cols, rows, 0))
        file.write(struct.pack("<Ii", max(model.n_terms), number))
        file.write(model.mean.astype("<f4").tobytes() + model.matrix.astype("<f4").tobytes())
        for angular, texture in zip(model.angular_factors, model.texture_factors, strict=True):
            _write_factors(file, angular, texture.reshape(rows * cols, -1))
    return model


def _require_own(model, terms, space, precision):
    """Refuse to write a FactoredModel otherwise than it is; None asks for nothing."""
    half = all(factors.dtype == np.float16 for factors in model.angular_factors)
    for what, given, own in (
        ("terms", terms if terms is None else tuple(terms), model.n_terms),
        ("space", space, model.space),
        ("precision", precision, "half" if half else "single"),
    ):
        if given not in (None, own):
            given, own = (
                value if isinstance(value, str) else " ".join(map(str, value))
                for value in (given, own)
            )
            raise InputError(
                f"the model's {what}: {own}; asked for: {given}. A factored model is written as it is: leave that out, or"
                " compress the Sample again."
            )


def _expressible(model):
    """Colour model and cosine flag of a FactoredModel, which must be what the format can say."""
    number = SPACES[model.space]
    if model.log_range:
        if model.space != "rgb":
            raise InputError(
                f"a .btf file cannot stretch the colours of {model.space} by exp; only those of rgb."
            )
        number = SPACES["log_rgb"]
    if model.epsilon != EPSILON:
        raise InputError(f"epsilon is {model.epsilon:g}; a .btf file can hold only {EPSILON:g}.")
    if model.pair_factor is None:
        return number, 1
    cosine = np.asarray(model.light_directions)[model.light_index, 2]
    if not np.allclose(model.pair_factor, cosine, rtol=0, atol=1e-6):
        raise InputError(
            "the pairs' factors are not their lights' cosines; a .btf file can hold no others."
        )
    return number, 0


def _meta(model, flag):
    said = {True: "true", False: "false"}
    xml = (
        f'<btfpipe toroidal="{said[bool(model.toroidal)]}"'
        f' absolute="{said[bool(model.absolute)]}"/>'
    ).encode()
    block = struct.pack("<I80s80s80s", 4, b"btfpipe", b"", b"")
    block += struct.pack("<4f", model.texels_per_mm or 0.0, 1.0, 1.0, 1.0)
    block += struct.pack("<II", flag, len(xml)) + xml
    block += struct.pack("<I", 3) + b"".join(
        struct.pack("<I", 1) + name for name in (b"R", b"G", b"B")
    )
    return struct.pack("<I", 4 + len(block)) + block


def _signed(angles):
    """Angles as float32, azimuths in (-pi, pi]."""
    theta, phi = angles[..., 0], angles[..., 1]
    phi = np.where(phi > math.pi, phi - 2 * math.pi, phi)
    return np.stack([theta, phi], axis=-1).astype("<f4").tobytes()


def _write_factors(file, angular, texture):
    """One channel; singular values are the products of the factors' lengths."""
    dtype = np.dtype(np.result_type(angular, texture)).newbyteorder("<")
    values = np.ones(angular.shape[1])
    for factors in (angular, texture):
        squares = np.zeros(factors.shape[1])
        for start in range(0, len(factors), 4096):
            part = np.asarray(factors[start : start + 4096], np.float64)
            squares += np.square(part).sum(axis=0)
        values *= np.sqrt(squares)
    values = np.minimum(values, float(np.finfo(dtype).max))
    file.write(struct.pack("<B3I", dtype.itemsize, len(values), len(angular), len(texture)))
    for array in (values, angular, texture):
        file.write(np.ascontiguousarray(array, dtype).tobytes())
