"""Adaptive binary range coder for quantised factors: many planes of small integers, mostly zeros.

A plane's large numbers stand together, and where the last plane's stood. Each number is coded as a few binary decisions
(zero? one? two? ..., then sign), and each decision has a probability learnt from those before it that had the same
context: how large the neighbours coded so far are, in this plane and in the last. Everything is integer arithmetic, so that
the bytes mean the same on every machine.

The coder is the carry-propagating one of Martin 1979 in the form that Subbotin and LZMA gave it, with probabilities of 16 bits that are the mean of a
fast and a slow estimate.
"""

import math
import zlib

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.errors import InputError

_LEVELS = 10  # classes of neighbours in the plane
_BEFORE = 6  # classes of neighbours in the last plane
_PLACES = 16  # classes of place where all neighbours are zero
_CONTEXTS = _LEVELS * _BEFORE + _PLACES
_UNARY = 14  # magnitudes from here on go on in Exp-Golomb code
_FAST, _SLOW = 4, 7
_TOP = 1 << 24
_HALF = 1 << 15
_DENSEST = 15_200  # numbers a byte: the chance of a zero is 65,512 of 65,536 at most
_LIMIT = 1 << 30  # of a number's magnitude: neighbours' sums index tables
_HEADER = 8  # bytes: checksum and length of what follows


def encode_planes(planes):
    """Code integers (planes, rows, cols) int32, of magnitude below 2^30.

    Returns
    -------
    (n,) uint8

    Raises
    ------
    ValueError
        If a number is too large.
    """
    planes = np.ascontiguousarray(planes, np.int32)
    if planes.size and max(-int(planes.min()), int(planes.max())) >= _LIMIT:
        raise ValueError(f"numbers of {planes.min()} to {planes.max()}; expected less than 2^30.")
    out = np.empty(planes.size // 4 + 1024, np.uint8)
    n = _encode(planes, out, *_models())
    while n > len(out):
        out = np.empty(2 * n, np.uint8)
        n = _encode(planes, out, *_models())
    coded = out[:n].tobytes()
    header = zlib.crc32(coded).to_bytes(4, "little") + n.to_bytes(4, "little")
    return np.frombuffer(header + coded, np.uint8)


def decode_planes(coded, shape):
    """The integers again, int32.

    Parameters
    ----------
    coded : (n,) uint8
        From `encode_planes`.
    shape : (int, int, int)

    Raises
    ------
    InputError
        If the bytes are not those that were written.
    """
    data = np.asarray(coded).tobytes()
    crc, size = (int.from_bytes(data[k : k + 4], "little") for k in (0, 4))
    body = data[_HEADER:]
    if len(data) < _HEADER or size != len(body):
        raise InputError(f"{len(data)} coded bytes; expected {size + _HEADER}: cut off.")
    if zlib.crc32(body) != crc:
        raise InputError("the coded bytes do not have their checksum: damaged.")
    if math.prod(shape) > _DENSEST * (size + 1):
        raise InputError(f"{size} coded bytes cannot hold {shape} numbers: damaged.")
    planes = np.zeros(shape, np.int32)
    if not _decode(np.frombuffer(body, np.uint8), planes, *_models()):
        raise InputError(f"the coded bytes end before {shape} numbers: damaged.")
    return planes


def _models():
    """Probabilities of a zero decision (contexts, decisions, fast and slow) and the coder's registers."""
    return np.full((_CONTEXTS, _UNARY + 1, 2), _HALF, np.int64), np.zeros(5, np.uint64)


@leaf
def _context(planes, p, i, j):
    """Class of the neighbours that are known already: left, above, and around the place in the last plane."""
    rows = planes.shape[1]
    cols = planes.shape[2]
    near = 0
    if j > 0:
        near += 2 * abs(planes[p, i, j - 1])
        if j > 1:
            near += abs(planes[p, i, j - 2])
    if i > 0:
        near += 2 * abs(planes[p, i - 1, j])
        if j > 0:
            near += abs(planes[p, i - 1, j - 1])
        if j + 1 < cols:
            near += abs(planes[p, i - 1, j + 1])
        if i > 1:
            near += abs(planes[p, i - 2, j])
    before = 0
    if p > 0:
        before = 2 * abs(planes[p - 1, i, j])
        if j + 1 < cols:
            before += abs(planes[p - 1, i, j + 1])
        if i + 1 < rows:
            before += abs(planes[p - 1, i + 1, j])
        if p > 1:
            before += abs(planes[p - 2, i, j])
    if near == 0 and before == 0:
        place = (i + 1) * (j + 1)
        bits = 0
        while place > 1:
            place >>= 1
            bits += 1
        return _LEVELS * _BEFORE + min(bits, _PLACES - 1)
    if near > 4:
        level = 5
        edge = 6
        while near > edge and level < _LEVELS - 1:
            edge += edge >> 1
            level += 1
        near = level
    if before > 3:
        before = 4 if before < 8 else 5
    return near * _BEFORE + before


@leaf
def _put(out, state, byte):
    """Append a byte; beyond the end only the count goes on."""
    at = np.int64(state[4])
    if at < len(out):
        out[at] = np.uint8(byte)
    state[4] += np.uint64(1)


@leaf
def _shift_low(out, state):
    """Move the top byte of `low` out, with the carry into the bytes held back."""
    # state: low (33 bits), range, byte held back, 1 and how many 0xFF follow that byte, bytes out
    low = state[0]
    if low < np.uint64(0xFF000000) or low >= np.uint64(1 << 32):
        carry = low >> np.uint64(32)
        _put(out, state, (state[2] + carry) & np.uint64(0xFF))
        for _ in range(np.int64(state[3]) - 1):
            _put(out, state, (np.uint64(0xFF) + carry) & np.uint64(0xFF))
        state[2] = (low >> np.uint64(24)) & np.uint64(0xFF)
        state[3] = 0
    state[3] += np.uint64(1)
    state[0] = (low & np.uint64(0x00FFFFFF)) << np.uint64(8)


@leaf
def _encode_bit(out, state, probability, bit):
    """Code one decision whose chance of 0 is `probability` of 65,536."""
    bound = (state[1] >> np.uint64(16)) * np.uint64(probability)
    if bit == 0:
        state[1] = bound
    else:
        state[0] += bound
        state[1] -= bound
    while state[1] < np.uint64(_TOP):
        state[1] <<= np.uint64(8)
        _shift_low(out, state)


@leaf
def _chance(model):
    """Chance of 0, kept away from 0 and 1."""
    return min(max((model[0] + model[1]) >> 1, 24), 65536 - 24)


@leaf
def _learn(model, bit):
    if bit == 0:
        model[0] += (65536 - model[0]) >> _FAST
        model[1] += (65536 - model[1]) >> _SLOW
    else:
        model[0] -= model[0] >> _FAST
        model[1] -= model[1] >> _SLOW


@njit(cache=True, nogil=True, error_model="numpy")
def _encode(planes, out, models, state):
    """Code all planes; bytes needed, which may be more than `out` holds."""
    state[1] = 0xFFFFFFFF
    state[3] = 1  # a byte 0 comes first
    for p in range(planes.shape[0]):
        for i in range(planes.shape[1]):
            for j in range(planes.shape[2]):
                value = planes[p, i, j]
                size = abs(value)
                model = models[_context(planes, p, i, j)]
                k = 0
                while k < _UNARY:
                    bit = 1 if size > k else 0
                    _encode_bit(out, state, _chance(model[k]), bit)
                    _learn(model[k], bit)
                    if bit == 0:
                        break
                    k += 1
                if k == _UNARY:
                    rest = size - _UNARY + 1
                    bits = 0
                    while rest >> (bits + 1) > 0:
                        bits += 1
                    for _ in range(bits):
                        _encode_bit(out, state, _HALF, 1)
                    _encode_bit(out, state, _HALF, 0)
                    for b in range(bits - 1, -1, -1):
                        _encode_bit(out, state, _HALF, (rest >> b) & 1)
                if size > 0:
                    _encode_bit(out, state, _HALF, 1 if value < 0 else 0)
    for _ in range(5):
        _shift_low(out, state)
    return np.int64(state[4])


@leaf
def _decode_bit(data, state, probability):
    # state: code, range, unused, unused, bytes read
    bound = (state[1] >> np.uint64(16)) * np.uint64(probability)
    if state[0] < bound:
        state[1] = bound
        bit = 0
    else:
        state[0] -= bound
        state[1] -= bound
        bit = 1
    while state[1] < np.uint64(_TOP):
        state[1] <<= np.uint64(8)
        at = np.int64(state[4])
        byte = np.uint64(data[at]) if at < len(data) else np.uint64(0)
        state[0] = (state[0] << np.uint64(8)) | byte
        state[4] += np.uint64(1)
    return bit


@njit(cache=True, nogil=True, error_model="numpy")
def _decode(data, planes, models, state):
    """Fill the planes; false if the bytes do not suffice."""
    state[1] = 0xFFFFFFFF
    for at in range(1, 5):
        byte = np.uint64(data[at]) if at < len(data) else np.uint64(0)
        state[0] = (state[0] << np.uint64(8)) | byte
    state[4] = 5
    for p in range(planes.shape[0]):
        if state[4] > np.uint64(len(data) + 4):
            return False
        for i in range(planes.shape[1]):
            for j in range(planes.shape[2]):
                model = models[_context(planes, p, i, j)]
                size = 0
                while size < _UNARY:
                    bit = _decode_bit(data, state, _chance(model[size]))
                    _learn(model[size], bit)
                    if bit == 0:
                        break
                    size += 1
                if size == _UNARY:
                    bits = 0
                    while bits < 30 and _decode_bit(data, state, _HALF) == 1:
                        bits += 1
                    rest = 1
                    for _ in range(bits):
                        rest = (rest << 1) | _decode_bit(data, state, _HALF)
                    size = rest + _UNARY - 1
                if size > 0 and _decode_bit(data, state, _HALF) == 1:
                    size = -size
                planes[p, i, j] = size
    return state[4] <= np.uint64(len(data) + 4)
