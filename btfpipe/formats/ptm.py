"""What is fitted to RTI pictures: polynomial texture maps (``.ptm``) and hemispherical harmonics (``.rti``), as Models.

Their coefficients are bytes and stay so. They give display values, whose curve the files do not name: sRGB unless told
otherwise, and recorded. Planes packed by JPEG are read, with their prediction from each other but without motion; JPEG-LS, look-up tables
and LUM are not.
"""

from pathlib import Path

import numpy as np

from btfpipe.compression.relighting import TERMS, RelightingModel
from btfpipe.errors import InputError, naming
from btfpipe.formats.images import Decoder

_MOST_HEADER = 1 << 16
_MOST_PIXELS = 2**28
_VERSIONS = ("PTM_1.0", "PTM_1.1", "PTM_1.2")
_PLANES = {"PTM_FORMAT_RGB": 18, "PTM_FORMAT_LRGB": 9}  # bytes a texel
_PLANES |= {"PTM_FORMAT_JPEG_RGB": 18, "PTM_FORMAT_JPEG_LRGB": 9}
_TYPES = {1: "PTM", 2: "spherical harmonics", 4: "an adaptive basis"}  # of .rti files, besides 3


def recognise(path):
    """Why a file is taken for a fitted RTI file, in words, or None."""
    try:
        with Path(path).open("rb") as file:
            head = file.read(8)
    except OSError:
        return None
    if head.startswith(b"PTM_1."):
        return "begins as polynomial texture maps do (PTM)"
    if head.startswith(b"#HSH"):
        return "begins as RTI files of hemispherical harmonics do (HSH)"
    return None


def read_model(path, *, transfer="srgb"):
    """Read a ``.ptm`` (RGB or LRGB, plain or by JPEG, versions 1.0 to 1.2) or a ``.rti`` of hemispherical harmonics.

    Parameters
    ----------
    path : path-like
    transfer : str
        Curve of the display values: ``srgb``, ``gamma2.2`` or ``linear``.

    Returns
    -------
    RelightingModel
        `about` says format, transfer and basis.

    Raises
    ------
    InputError
        If it is another file, truncated, goes on after its end, or is packed otherwise than by JPEG.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_MOST_HEADER)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    if head.startswith(b"PTM_"):
        return _read_ptm(path, head, size, transfer)
    if head.startswith(b"#HSH"):
        return _read_hsh(path, head, size, transfer)
    raise InputError(
        f"{path}: begins with {head[:16]!r}; expected PTM_1.2 or #HSH1.2, a .ptm or .rti file."
    )


class _Lines:
    """The lines of a header, from one place on; `at` is where the next begins."""

    def __init__(self, path, head):
        self.path, self.head, self.at = path, head, 0

    def next(self):
        end = self.head.find(b"\n", self.at, self.at + 4096)
        if end < 0:
            raise InputError(f"{self.path}: truncated or damaged in its header.")
        line = self.head[self.at : end].decode("latin-1").strip()
        self.at = end + 1
        return line

    def numbers(self, count):
        """So many numbers from as many lines as they take."""
        words = []
        while len(words) < count:
            words += self.next().split()
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not (np.abs(values) < 1e15).all():
            raise InputError(
                f"{self.path}: {' '.join(words)[:80]!r} in its header; expected {count} numbers."
            )
        return values


def _size(path, width, height):
    rows, cols = int(height), int(width)
    if rows != height or cols != width or not 0 < rows * cols <= _MOST_PIXELS or rows < 0:
        raise InputError(
            f"{path}: declares {height:g} x {width:g} texels; expected at most {_MOST_PIXELS}."
        )
    return rows, cols


def _read_body(path, start, count, size):
    """The bytes after the header, of which there must be just so many."""
    if size - start < count:
        raise InputError(
            f"{path}: truncated; its header calls for {count} bytes after it, and {size - start} are there."
        )
    with path.open("rb") as file:
        file.seek(start + count)
        if size - start - count > 64 or file.read().strip(b"\0\r\n "):
            raise InputError(
                f"{path}: {size - start - count} bytes follow its {count} of coefficients; the header or the file is"
                " damaged."
            )
        file.seek(start)
        body = np.fromfile(file, np.uint8, count)
    if len(body) != count:
        raise InputError(f"{path}: truncated while it was read.")
    return body


def _read_ptm(path, head, size, transfer):
    lines = _Lines(path, head)
    version, kind = lines.next(), lines.next()
    if version not in _VERSIONS:
        raise InputError(f"{path}: version {version!r}; expected {', '.join(_VERSIONS)}.")
    if kind not in _PLANES:
        raise InputError(
            f"{path}: {kind[:40]!r} is not supported; expected {', '.join(_PLANES)}. Save it as one of these, or ingest the"
            " pictures with their .lp."
        )
    numbers = lines.numbers(14)
    rows, cols = _size(path, *numbers[:2])
    texels, n = rows * cols, _PLANES[kind]
    if "JPEG" in kind:
        planes = _read_jpegs(path, lines, size, rows, cols, n)
    else:
        body = _read_body(path, lines.at, texels * n, size)
        if kind == "PTM_FORMAT_RGB":  # six bytes together, three times
            planes = body.reshape(3, rows, cols, 6).transpose(1, 2, 0, 3)
        elif version == "PTM_1.2":  # six bytes together, then three
            parts = body[: 6 * texels], body[6 * texels :]
            planes = np.concatenate([part.reshape(rows, cols, -1) for part in parts], axis=2)
        else:  # nine bytes together
            planes = body.reshape(rows, cols, 9)
    if n == 18:
        codes, colour = planes.reshape(rows, cols, 3, 6), None
    else:
        codes, colour = planes[:, :, None, :6], planes[:, :, 6:]
    scale, bias = numbers[2:8], numbers[8:]
    return _upright(
        path, codes, scale / 255, -bias * scale / 255, colour, "ptm", transfer, f"{version} {kind}"
    )


def _read_jpegs(path, lines, size, rows, cols, n):
    """Planes (rows, cols, n) uint8, each a grey JPEG: of itself, or of what it differs by from a plane that comes before it.

    After the scales and biases come the quality and seven numbers a plane: how it is predicted, a motion in x and in y, its
    place in the order of decoding, the plane that it is predicted from, the bytes of its JPEG, and those of its corrections,
    which are five bytes each: where, and the right value.
    """
    numbers = lines.numbers(1 + 7 * n)[1:].reshape(7, n)
    inverted, _, _, order, reference, packed, corrected = numbers.astype(int)
    known = (numbers == np.round(numbers)).all() and np.isin(inverted, [0, 1]).all()
    if not known or numbers[1:3].any() or (reference < -1).any() or (reference >= n).any():
        raise InputError(
            f"{path}: its planes are predicted from each other in a way that is not read (motion), or their numbers are damaged."
        )
    first = reference == -1  # a plane comes after that from which it is predicted
    late = (order[reference] < order) | first
    if sorted(order) != list(range(n)) or not late.all() or min(*packed, *corrected) < 0:
        raise InputError(f"{path}: the order or the sizes of its planes are damaged.")
    body = _read_body(path, lines.at, int(packed.sum() + corrected.sum()), size)
    ends = np.cumsum(packed + corrected)
    planes = [None] * n
    with Decoder() as decoder:
        for c in np.argsort(order):
            jpeg, corrections = np.split(
                body[ends[c] - packed[c] - corrected[c] : ends[c]], packed[[c]]
            )
            name = f"{path}: plane {c}"
            plane = decoder.decode(jpeg.tobytes(), name).values
            if plane.shape != (rows, cols, 1) or plane.dtype != np.uint8:
                raise InputError(
                    f"{name}: {' x '.join(map(str, plane.shape))} {plane.dtype}; expected {rows} x {cols}, grey, 8 bits."
                )
            plane = plane[..., 0]
            if not first[c]:  # modulo 256, as bytes are
                other = planes[reference[c]]
                plane = plane + (255 - other if inverted[c] else other) - np.uint8(128)
            planes[c] = _corrected(name, plane, corrections)
    return np.stack(planes, axis=2)


def _corrected(name, plane, corrections):
    """A plane with values put right, each by four bytes that say where, the highest first, and the value."""
    if len(corrections) % 5:
        raise InputError(f"{name}: {len(corrections)} bytes of corrections; expected fives.")
    corrections = corrections.reshape(-1, 5)
    where = np.ascontiguousarray(corrections[:, :4]).view(">u4")[:, 0]
    if (where >= plane.size).any():
        raise InputError(
            f"{name}: a correction at {where.max()} of {plane.size} texels; the file is damaged."
        )
    plane = plane.copy()
    plane.reshape(-1)[where] = corrections[:, 4]
    return plane


def _read_hsh(path, head, size, transfer):
    lines = _Lines(path, head)
    version = line = lines.next()
    while line.startswith("#"):
        line = lines.next()
    if line != "3":
        what = _TYPES.get(int(line)) if line.isascii() and line.isdigit() else None
        raise InputError(
            f"{path}: holds type {line[:40]!r}{f' ({what})' if what else ''}; expected 3, hemispherical harmonics."
        )
    width, height, channels = lines.numbers(3)
    n, kind, element = lines.numbers(3)
    rows, cols = _size(path, width, height)
    if channels != 3 or n not in TERMS["hsh"] or kind != 2 or element != 1:
        raise InputError(
            f"{path}: {channels:g} channels, {n:g} terms of basis type {kind:g} in {element:g} bytes each; expected 3"
            f" channels, {', '.join(map(str, TERMS['hsh']))} terms, type 2 (R, G and B apart), 1 byte."
        )
    n = int(n)
    body = _read_body(path, lines.at, 8 * n + rows * cols * 3 * n, size)
    with np.errstate(invalid="ignore"):  # a NaN may warn by itself
        scale, bias = body[: 8 * n].view("<f4").astype(float).reshape(2, n)
    codes = body[8 * n :].reshape(rows, cols, 3, n)
    return _upright(path, codes, scale / 255, bias, None, "hsh", transfer, version.strip("#"))


def _upright(path, codes, scale, offset, colour, basis, transfer, version):
    """A Model from codes whose rows run from the bottom to the top."""
    codes = np.ascontiguousarray(codes[::-1])
    colour = None if colour is None else np.ascontiguousarray(colour[::-1])
    about = {"source": {"format": version, "source_transfer": transfer}}
    with naming(path):
        return RelightingModel(codes, scale, offset, colour, basis, transfer, about=about)
