"""Pictures through OpenImageIO: JPEG, PNG, TIFF, EXR, HDR, in and out; Radiance pictures are read by `rgbe`.

Arrays are (rows, cols, channels), row 0 at the top. Colours are left as stored: no colour management, alpha not
multiplied in.
"""

import contextlib
import os
import shutil
import tempfile
import threading
from collections import namedtuple
from pathlib import Path

import numpy as np

from btfpipe.errors import InputError
from btfpipe.files import whole
from btfpipe.formats.rgbe import decode_rgbe

_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
_MAX_PIXELS = 2**28
_MOST_IN_JPEG = (
    8 * 1032
)  # pixels a byte; plain ones have 512 at most, a bit for each block of 8 x 8

# First bytes of the formats, and the ending that each is known by.
_SIGNATURES = [
    (b"\xff\xd8\xff", ".jpg"),
    (b"\x89PNG\r\n\x1a\n", ".png"),
    (b"\x76\x2f\x31\x01", ".exr"),
    (b"#?", ".hdr"),
    (b"II*\0", ".tif"),
    (b"MM\0*", ".tif"),
    (b"II+\0", ".tif"),
    (b"MM\0+", ".tif"),
    (b"BM", ".bmp"),
    (b"GIF8", ".gif"),
    (b"RIFF", ".webp"),
]
_ALIASES = {".jpeg": ".jpg", ".tiff": ".tif"}

# A decoded picture: the array, the names of its channels, and the ending its content (not its name) calls for.
Picture = namedtuple("Picture", "values channels suffix")


def picture_suffix(head):
    """The ending that a picture's first bytes call for, or None."""
    return next((suffix for start, suffix in _SIGNATURES if head.startswith(start)), None)


def is_mislabelled(name, suffix):
    """Whether a picture's name ends otherwise than its content calls for."""
    ending = os.path.splitext(name)[1].lower()
    return ending != "" and _ALIASES.get(ending, ending) != suffix


class Decoder:
    """Decodes pictures held in memory, on any number of threads at once.

    The library's Python side reads files only, so each thread passes its pictures through one file in memory. Where the
    system offers nameless ones, a killed process leaves nothing behind but links. Use as a context manager.
    """

    def __enter__(self):
        self._folder = tempfile.mkdtemp(prefix="btfpipe-", dir=_MEMORY)
        self._files = {}
        return self

    def __exit__(self, *_):
        for file, _ in self._files.values():
            os.close(file)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _file(self, suffix):
        """File of the calling thread for one format: descriptor and path."""
        key = threading.get_ident(), suffix
        if key not in self._files:
            path = f"{self._folder}/{key[0]}{suffix}"
            if hasattr(os, "memfd_create") and os.path.isdir("/proc/self/fd"):
                file = os.memfd_create("picture")
                os.symlink(f"/proc/self/fd/{file}", path)
            else:
                file = os.open(path, os.O_RDWR | os.O_CREAT)
            self._files[key] = file, path
        return self._files[key]

    def decode(self, data, name):
        """Decode the bytes of a picture.

        Parameters
        ----------
        data : bytes
            Contents of a picture file; the format is told by the content, not by the name.
        name : str
            What messages call the picture.

        Returns
        -------
        Picture

        Raises
        ------
        InputError
            If it is empty, truncated, damaged, or not a picture.
        """
        if not len(data):
            raise InputError(f"{name}: empty; expected a picture.")
        suffix = picture_suffix(bytes(data[:16]))
        if suffix == ".hdr":
            return _radiance(data, name)
        try:
            file, path = self._file(suffix or ".picture")
            os.pwrite(file, data, 0)
            os.ftruncate(file, len(data))
        except OSError as error:
            raise InputError(
                f"{self._folder}: no room for a decoded picture ({error.strerror}); make room there."
            ) from error
        return _decode_file(path, name, suffix)


def _radiance(data, name):
    return Picture(decode_rgbe(data, name), ("R", "G", "B"), ".hdr")


def _decode_file(path, name, suffix):
    """Decode the picture file at `path`; messages call it `name`."""
    if suffix == ".hdr":
        return _radiance(Path(path).read_bytes(), name)
    if suffix == ".png" and not _png_ends(path):
        # found here, because the library below prints its own line about it
        raise InputError(f"{name}: truncated or damaged picture (no end of a PNG).")
    try:
        return _decode_by_library(path, name, suffix)
    except (
        UnicodeDecodeError
    ) as error:  # of names of channels and the like, or of what the library says of them
        raise InputError(f"{name}: truncated or damaged picture (a text in it is none).") from error


def _decode_by_library(path, name, suffix):
    import OpenImageIO as oiio

    def reason(text):
        text = (text or "unknown format").replace(f' ("{path}")', "").replace(str(path), str(name))
        return text.strip().splitlines()[0].rstrip(".")

    opened = oiio.ImageInput.open(str(path), _config(oiio))
    if opened is None:
        problem = reason(oiio.geterror())
        if suffix is None:
            raise InputError(f"{name}: not a readable picture ({problem}).")
        raise InputError(f"{name}: truncated or damaged picture ({problem}).")
    spec = opened.spec()
    if spec.width * spec.height > _MAX_PIXELS:
        opened.close()
        raise InputError(
            f"{name}: declares {spec.height} x {spec.width} pixels; expected a picture of at most"
            f" {_MAX_PIXELS} pixels."
        )
    size = os.stat(path).st_size
    if suffix == ".jpg" and spec.width * spec.height > _MOST_IN_JPEG * size:
        opened.close()
        raise InputError(
            f"{name}: truncated or damaged picture ({spec.height} x {spec.width} pixels cannot lie in {size} bytes)."
        )
    kinds = {oiio.UINT8: oiio.UINT8, oiio.UINT16: oiio.UINT16, oiio.HALF: oiio.HALF}
    values = opened.read_image(kinds.get(spec.format.basetype, oiio.FLOAT))
    problem = opened.geterror()
    opened.close()
    if values is None or problem:
        raise InputError(f"{name}: truncated or damaged picture ({reason(problem)}).")
    values = values.reshape(spec.height, spec.width, spec.nchannels)
    return Picture(values, tuple(spec.channelnames), suffix or "." + opened.format_name())


def _png_ends(path):
    with open(path, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - 4096))
        return b"IEND\xaeB`\x82" in file.read()


def read_picture(source, name=None):
    """Read a picture from a path or from bytes.

    Parameters
    ----------
    source : path-like or bytes
        File, or the contents of one.
    name : str, optional
        What messages call the picture.

    Returns
    -------
    (rows, cols, channels) array
        uint8, uint16, float16 or float32, as stored.

    Raises
    ------
    InputError
        If the file is missing, empty, truncated, or not a picture.
    """
    if isinstance(source, bytes | bytearray | memoryview):
        with Decoder() as decoder:
            return decoder.decode(source, str(name or "picture")).values
    return open_picture(source, name).values


def open_picture(path, name=None):
    """As `read_picture` from a path, with channel names and format: a `Picture`."""
    path, name = Path(path), str(name or path)
    if not path.is_file():
        raise InputError(f"{name}: no such file; expected a picture.")
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror}).") from error
    if not head:
        raise InputError(f"{name}: empty; expected a picture.")
    return _decode_file(path, name, picture_suffix(head))


def colours(picture, name):
    """The three colour channels of a `Picture`; grey is repeated, alpha and other layers are left out.

    Returns
    -------
    (rows, cols, 3) array
        Of the picture's own type.

    Raises
    ------
    InputError
        If the picture has neither grey nor red, green and blue.
    """
    values, channels = picture.values, [c.upper() for c in picture.channels]
    if all(c in channels for c in "RGB"):
        index = [channels.index(c) for c in "RGB"]
        return values[..., :3] if index == [0, 1, 2] else values[..., index]
    if len(channels) <= 2:
        return np.repeat(values[..., :1], 3, axis=2)
    raise InputError(
        f"{name}: has the channels {', '.join(picture.channels)}; expected R, G and B, or grey."
    )


def _config(oiio):
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    config.attribute("oiio:RawColor", 1)
    return config


def _first_line(text):
    return (text or "unknown format").strip().splitlines()[0]


def encode_picture(picture, suffix, quality=95, names=None, half=False):
    """Bytes of a picture file.

    Parameters
    ----------
    picture : (rows, cols, channels) uint8, uint16, float16 or float32
    suffix : str
        ``.png``, ``.jpg``, ``.exr``, ``.hdr``, ``.tif``.
    quality : int
        Of JPEG, 1 to 100; chroma is not subsampled.
    names : list of str, optional
        Channel names, for EXR layers.
    half : bool or list of bool
        Store 16-bit floats where the format can; a list says so channel by channel (EXR).
    """
    with _encoded(picture, suffix, quality, names, half) as path:
        return path.read_bytes()


@contextlib.contextmanager
def _encoded(picture, suffix, quality=95, names=None, half=False):
    """A temporary file of what `encode_picture` gives, in memory where the system has files there."""
    import OpenImageIO as oiio

    picture = np.ascontiguousarray(picture)
    if picture.ndim == 2:
        picture = picture[..., None]
    kinds = {
        "uint8": oiio.UINT8,
        "uint16": oiio.UINT16,
        "float16": oiio.HALF,
        "float32": oiio.FLOAT,
    }
    kind = kinds[str(picture.dtype)]
    rows, cols, channels = picture.shape
    each = isinstance(half, list)
    spec = oiio.ImageSpec(cols, rows, channels, kind if each or not half else oiio.HALF)
    if each:
        spec.channelformats = tuple(oiio.TypeHalf if h else oiio.TypeFloat for h in half)
    if names:
        spec.channelnames = tuple(names)
    if suffix in (".jpg", ".jpeg"):
        spec.attribute("CompressionQuality", quality)
        spec.attribute("jpeg:subsampling", "4:4:4")
    if suffix == ".exr":
        spec.attribute("compression", "zip")
    else:
        spec.attribute("oiio:UnassociatedAlpha", 1)  # or the library divides colours by alpha
    # no clock time: equal pictures are equal bytes. The writers of EXR and TIFF would put the time in where there is none
    for key in ("DateTime", "Software"):
        spec.erase_attribute(key)
    if suffix in (".exr", ".tif", ".tiff"):
        spec.attribute("DateTime", "1980:01:01 00:00:00")
    out = oiio.ImageOutput.create("picture" + suffix)
    if out is None:
        raise InputError(f"{suffix}: no picture format that can be written; use .exr or .png.")
    with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
        path = Path(folder) / ("picture" + suffix)
        if not out.open(str(path), spec) or not out.write_image(picture) or not out.close():
            raise InputError(f"picture{suffix}: cannot be written ({_first_line(out.geterror())}).")
        yield path


def write_picture(path, picture, **options):
    """Write a picture, whole or not at all; see `encode_picture`."""
    # not by the library itself, which takes a full disk in silence for some formats
    with (
        _encoded(picture, Path(path).suffix.lower(), **options) as encoded,
        whole(path) as file,
    ):
        with encoded.open("rb") as data:
            shutil.copyfileobj(data, file, 1 << 20)
