"""Pictures through OpenImageIO: JPEG, PNG, TIFF, EXR, HDR, in and out.

Arrays are (rows, cols, channels), row 0 at the top. Colours are left as stored: no colour management, alpha not
multiplied in.
"""

import os
import tempfile
from pathlib import Path

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError

_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def read_picture(source, name=None):
    """Read a picture from a path or from bytes.

    Parameters
    ----------
    source : path-like or bytes
        File, or the contents of one; then `name` tells the format by its ending.
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
    import OpenImageIO as oiio

    name = str(name or source)
    if isinstance(source, bytes | bytearray | memoryview):
        # the library's Python side reads files only: give it one that lives in memory where there is such a place
        with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
            path = Path(folder) / ("picture" + Path(name).suffix.lower())
            path.write_bytes(source)
            return read_picture(path, name)
    path = Path(source)
    if not path.is_file():
        raise InputError(f"{name}: no such file; expected a picture.")
    if path.stat().st_size == 0:
        raise InputError(f"{name}: empty; expected a picture.")
    opened = oiio.ImageInput.open(str(path), _config(oiio))
    if opened is None:
        raise InputError(f"{name}: not a readable picture ({_first_line(oiio.geterror())}).")
    spec = opened.spec()
    native = spec.format.basetype
    kind = {oiio.UINT8: oiio.UINT8, oiio.UINT16: oiio.UINT16, oiio.HALF: oiio.HALF}
    picture = opened.read_image(kind.get(native, oiio.FLOAT))
    problem = opened.geterror()
    opened.close()
    if picture is None or problem:
        raise InputError(f"{name}: truncated or damaged picture ({_first_line(problem)}).")
    return picture.reshape(spec.height, spec.width, spec.nchannels)


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
    half : bool
        Store 16-bit floats where the format can.
    """
    import OpenImageIO as oiio

    picture = np.ascontiguousarray(picture)
    if picture.ndim == 2:
        picture = picture[..., None]
    kinds = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float16": oiio.HALF, "float32": oiio.FLOAT}
    kind = kinds[str(picture.dtype)]
    rows, cols, channels = picture.shape
    spec = oiio.ImageSpec(cols, rows, channels, oiio.HALF if half else kind)
    if names:
        spec.channelnames = tuple(names)
    if suffix in (".jpg", ".jpeg"):
        spec.attribute("CompressionQuality", quality)
        spec.attribute("jpeg:subsampling", "4:4:4")
    if suffix == ".exr":
        spec.attribute("compression", "zip")
    # no DateTime or Software: equal pictures are equal bytes
    for key in ("DateTime", "Software"):
        spec.erase_attribute(key)
    out = oiio.ImageOutput.create("picture" + suffix)
    if out is None:
        raise InputError(f"{suffix}: no picture format that can be written; use .exr or .png.")
    with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
        path = Path(folder) / ("picture" + suffix)
        if not out.open(str(path), spec) or not out.write_image(picture) or not out.close():
            raise InputError(f"picture{suffix}: cannot be written ({_first_line(out.geterror())}).")
        return path.read_bytes()


def write_picture(path, picture, **options):
    """Write a picture, whole or not at all; see `encode_picture`."""
    data = encode_picture(picture, Path(path).suffix.lower(), **options)
    with store.whole(path) as file:
        file.write(data)
