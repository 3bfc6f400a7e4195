"""Radiance pictures (``.hdr``, RGBE), decoded here: OpenImageIO reads one of the eight orders of their axes rightly.

After Ward, "Real Pixels" (Graphics Gems II, 1991), and Radiance's description of its picture files. A pixel is three
mantissas and a common exponent, ``value = mantissa * 2^(exponent - 136)``; the half code that Radiance itself adds to a
mantissa is left out, as most readers do, so that black stays black.
"""

import re

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.errors import InputError

_RESOLUTION = re.compile(rb"([-+])([XY]) +(\d{1,9}) +([-+])([XY]) +(\d{1,9})[ \r]*")
_MOST_HEADER = 1 << 16
_MOST_PIXELS = 2**28
_MOST_RATIO = 1032  # pixels a byte: far above what real runs give, and what bounds a zip's members
_TRUNCATED, _OVERRUN = -1, -2


def is_rgbe(head):
    """Whether a file that starts so is a Radiance picture."""
    return head[:2] == b"#?"


def decode_rgbe(data, name):
    """Decode a Radiance picture.

    Parameters
    ----------
    data : bytes
        Contents of the file: flat, or in the old or new run-length encoding, scan-line by scan-line. The first axis of the
        resolution line is the one that steps from scan-line to scan-line; all eight orders are turned to row 0 at the
        top, column 0 at the left. Values are divided by the header's EXPOSURE and COLORCORR, all of them.
    name : str
        What messages call the picture.

    Returns
    -------
    (rows, cols, 3) float32

    Raises
    ------
    InputError
        If it is truncated, damaged, declares a size that its bytes cannot hold, or holds XYZ colours.
    """
    data = bytes(data)
    start, exposure = _header(data, name)
    end = data.find(b"\n", start, start + 64)
    found = _RESOLUTION.fullmatch(data[start:end]) if end >= 0 else None
    if found is None or found[2] == found[5]:
        line = data[start : end if end >= 0 else start + 24]
        raise InputError(
            f"{name}: truncated or damaged picture (resolution line {line!r}); expected one such as"
            " '-Y 256 +X 256'."
        )
    lines, length = int(found[3]), int(found[6])
    body = np.frombuffer(data, np.uint8, offset=end + 1)
    if not 0 < lines * length <= _MOST_PIXELS:
        raise InputError(
            f"{name}: declares {lines} scan-lines of {length} pixels; expected a picture of at most"
            f" {_MOST_PIXELS} pixels."
        )
    if 4 * lines > len(body) or lines * length > _MOST_RATIO * len(body):
        raise InputError(
            f"{name}: truncated or damaged picture ({lines} scan-lines of {length} pixels cannot lie in"
            f" {len(body)} bytes)."
        )
    pixels = np.empty((lines, length, 4), np.uint8)
    used = _unpack(body, pixels)
    if used < 0:
        reason = "ends early" if used == _TRUNCATED else "a run goes beyond its scan-line"
        raise InputError(f"{name}: truncated or damaged picture ({reason}).")
    if bytes(body[used:]).strip(b"\0\r\n "):
        raise InputError(
            f"{name}: {len(body) - used} bytes follow the {lines} scan-lines of {length} pixels; the resolution"
            " line or the file is damaged."
        )
    values = np.ldexp(pixels[..., :3].astype(np.float32), pixels[..., 3:].astype(np.int32) - 136)
    if (exposure != 1).any():
        with np.errstate(over="ignore"):  # shows in the picture
            values /= exposure.astype(np.float32)
    if found[2] == b"X":
        values = values.swapaxes(0, 1)
    signs = {found[2]: found[1], found[5]: found[4]}
    if signs[b"Y"] == b"+":
        values = values[::-1]
    if signs[b"X"] == b"-":
        values = values[:, ::-1]
    return np.ascontiguousarray(values)


def _header(data, name):
    """Where the resolution line starts, and what to divide the three channels by."""
    head = data[:_MOST_HEADER]
    end = re.search(rb"\n[ \r]*\n", head)
    if not is_rgbe(head) or end is None:
        raise InputError(
            f"{name}: truncated or damaged picture (no empty line ends its header); expected a Radiance picture."
        )
    exposure = np.ones(3)
    for line in head[: end.start()].splitlines():
        key, equals, value = (part.strip() for part in line.partition(b"="))
        if not equals:
            continue
        if key == b"FORMAT" and value != b"32-bit_rle_rgbe":
            raise InputError(
                f"{name}: its colours are {value.decode('latin-1')}; expected 32-bit_rle_rgbe. Radiance's"
                " ra_xyze -r converts XYZE pictures."
            )
        if key in (b"EXPOSURE", b"COLORCORR"):
            try:
                factors = np.array([float(word) for word in value.split()])
            except ValueError:
                factors = np.zeros(0)
            count = 1 if key == b"EXPOSURE" else 3
            if len(factors) != count or not ((factors > 1e-30) & (factors < 1e30)).all():
                raise InputError(
                    f"{name}: {line.decode('latin-1')!r} in its header; expected {count} positive numbers."
                )
            exposure = np.clip(exposure * factors, 1e-30, 1e30)
    return end.end(), exposure


@leaf
def _unpack(data, pixels):
    """Fill `pixels` (lines, length, 4) from `data`; bytes used, or a negative code for what is wrong."""
    lines, length, _ = pixels.shape
    at = 0
    for i in range(lines):
        if at + 4 > len(data):
            return _TRUNCATED
        packed = (
            8 <= length <= 32767
            and data[at] == 2
            and data[at + 1] == 2
            and np.int64(data[at + 2]) * 256 + data[at + 3] == length
        )
        if packed:  # the four components one after another, each in runs and stretches
            at += 4
            for c in range(4):
                j = 0
                while j < length:
                    if at + 2 > len(data):
                        return _TRUNCATED
                    count = np.int64(data[at])
                    at += 1
                    run = count > 128
                    if run:
                        count -= 128
                    elif count == 0:
                        return _OVERRUN
                    if j + count > length:
                        return _OVERRUN
                    if not run and at + count > len(data):
                        return _TRUNCATED
                    for _ in range(count):
                        pixels[i, j, c] = data[at]
                        j += 1
                        if not run:
                            at += 1
                    if run:
                        at += 1
        else:  # pixel by pixel; mantissas of 1 1 1 repeat the last one
            j = 0
            shift = 0
            while j < length:
                if at + 4 > len(data):
                    return _TRUNCATED
                if data[at] == 1 and data[at + 1] == 1 and data[at + 2] == 1:
                    count = np.int64(data[at + 3]) << shift
                    if j == 0 or shift > 24 or j + count > length:
                        return _OVERRUN
                    for _ in range(count):
                        for c in range(4):
                            pixels[i, j, c] = pixels[i, j - 1, c]
                        j += 1
                    shift += 8
                else:
                    for c in range(4):
                        pixels[i, j, c] = data[at + c]
                    j += 1
                    shift = 0
                at += 4
    return at
