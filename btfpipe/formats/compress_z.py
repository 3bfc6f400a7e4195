"""Unix compress (``.Z``): LZW with codes of 9 to 16 bits, in and out.

The format's file has three bytes of header (magic 1F 9D; flags: the widest code in the low five bits, block mode in the
top one), then codes, lowest bits first. Codes come in groups of eight; whenever their width changes, the rest of the
group is skipped. In block mode code 256 empties the table. Neither a length nor a checksum is stored.

References
----------
Welch 1984, A Technique for High-Performance Data Compression.
"""

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.errors import InputError

MAGIC = b"\x1f\x9d"
_CLEAR = 256
_LONGEST = 16
_HASH = 1 << 18  # slots of the writer's table, four times its 65,536 strings
_PATIENCE = 1 << 16  # bytes between the writer's looks at its ratio


def decompress(data, limit, name, *, start_only=False):
    """Bytes of a ``.Z`` file.

    The codes are first only counted out, so nothing is allocated for a file that holds more than `limit`.

    Parameters
    ----------
    data : bytes
        The whole file.
    limit : int
        Most bytes that the content may have.
    name : str
        What messages call the file.
    start_only : bool
        Return the first `limit` bytes (fewer if there are no more) instead of refusing longer content; what comes
        after them is not looked at.

    Returns
    -------
    bytes

    Raises
    ------
    InputError
        If it is no such file, holds an impossible code, or holds more than `limit` bytes. A file cut short between two
        codes cannot be told from a whole one; compare the length of what comes out.
    """
    if data[:2] != MAGIC or len(data) < 3:
        raise InputError(
            f"{name}: no file of Unix compress, or a truncated one (starts with {bytes(data[:3]).hex()!r}); expected"
            " 1f9d."
        )
    widest, block_mode = data[2] & 0x1F, bool(data[2] & 0x80)
    if not 9 <= widest <= _LONGEST:
        raise InputError(f"{name}: damaged; its codes have up to {widest} bits, expected 9 to 16.")
    codes = np.frombuffer(data, np.uint8)[3:]
    tables = (
        np.zeros(1 << _LONGEST, np.int32),
        np.zeros(1 << _LONGEST, np.uint8),
        np.zeros(1 << _LONGEST, np.int32),
    )
    length = limit
    if not start_only:
        length, where = _decode(codes, widest, block_mode, *tables, np.zeros(0, np.uint8), limit)
        if length > limit:
            raise InputError(
                f"{name}: holds more than the {limit} bytes expected; damaged or hostile."
            )
    if length >= 0:
        out = np.zeros(length, np.uint8)
        length, where = _decode(codes, widest, block_mode, *tables, out, -1)
    if length < 0:
        raise InputError(
            f"{name}: damaged; the code at byte {where + 3} of {len(data)} stands for nothing yet. Fetch it again."
        )
    return out[:length].tobytes()


def compress(data, widest=16):
    """A ``.Z`` file of `data`, in block mode, with codes of up to `widest` bits (9 to 16)."""
    if not 9 <= widest <= _LONGEST:
        raise ValueError(f"widest is {widest}; expected 9 to 16")
    data = np.frombuffer(data, np.uint8)
    # a byte costs at most one code, and a change of width at most a group of eight
    out = np.zeros(2 * len(data) + len(data) // 64 + 1024, np.uint8)
    length = _encode(data, widest, np.full(_HASH, -1, np.int64), np.zeros(_HASH, np.int32), out)
    return MAGIC + bytes([0x80 | widest]) + out[:length].tobytes()


@leaf
def _decode(data, widest, block_mode, prefix, last, length, out, limit):
    """Length of the content, and the byte of the last code looked at; length -1 for a bad code.

    `prefix`, `last` and `length` (65,536,) are scratch: of each string, the string before its last byte, that byte, and its
    length. Strings go to `out` until it is full; with a limit of 0 or more they are only counted, until beyond it.
    """
    write = limit < 0
    for code in range(256):
        last[code] = code
        length[code] = 1
    total = np.int64(8) * len(data)
    position = np.int64(0)
    group = np.int64(0)  # where codes of this width began
    bits = 9
    free = 257 if block_mode else 256
    old = -1
    first = np.uint8(0)  # of the string of `old`
    done = np.int64(0)
    where = np.int64(0)
    while True:
        if free > (1 << bits) - 1 and bits < widest:
            position = group + (position - group + 8 * bits - 1) // (8 * bits) * (8 * bits)
            group = position
            bits += 1
        if position + bits > total or (write and done >= len(out)):
            return done, where
        where = position >> 3
        code = np.int64(data[where]) | np.int64(data[where + 1]) << 8
        if where + 2 < len(data):
            code |= np.int64(data[where + 2]) << 16
        code = (code >> (position & 7)) & ((1 << bits) - 1)
        position += bits
        if block_mode and code == _CLEAR:
            position = group + (position - group + 8 * bits - 1) // (8 * bits) * (8 * bits)
            group = position
            bits = 9
            free = 257
            old = -1
            continue
        if old < 0:
            if code > 255:
                return -1, where
        elif code > free or (code == free and free >= 1 << widest):
            return -1, where
        # the one string that is used before it is complete: the old one and its own first byte
        known = code if old < 0 or code < free else old
        size = length[known]
        if write:
            at = done + size
            step = known
            while step >= 256:
                at -= 1
                if at < len(out):
                    out[at] = last[step]
                step = prefix[step]
            first = last[step]
            if done < len(out):
                out[done] = first
            if known != code and done + size < len(out):
                out[done + size] = first
        if known != code:
            size += 1
        done += size
        if old >= 0 and free < 1 << widest:
            if not write:
                first = np.uint8(0)
            prefix[free] = old
            last[free] = first
            length[free] = length[old] + 1
            free += 1
        old = code
        if done > limit and not write:
            return done, where


@njit(cache=True, nogil=True)
def _encode(data, widest, keys, codes, out):
    """Write the codes of `data` to `out`, zeros so far; return their bytes. `keys` are -1, `codes` scratch."""
    position = np.int64(0)
    group = np.int64(0)
    bits = 9
    free = 257
    if len(data) == 0:
        return 0
    string = np.int64(data[0])
    looked = 0
    best = 0.0
    for at in range(1, len(data) + 1):
        end = at == len(data)
        if not end:
            key = string << 8 | np.int64(data[at])
            slot = (key * 0x9E3779B1 >> 7) & (_HASH - 1)
            while keys[slot] != key and keys[slot] >= 0:
                slot = (slot + 1) & (_HASH - 1)
            if keys[slot] == key:
                string = np.int64(codes[slot])
                continue
        _put(out, position, string)
        position += bits
        if free > (1 << bits) - 1 and bits < widest:
            position = group + (position - group + 8 * bits - 1) // (8 * bits) * (8 * bits)
            group = position
            bits += 1
        if end:
            break
        if free < 1 << widest:
            keys[slot] = key
            codes[slot] = free
            free += 1
        elif at - looked >= _PATIENCE:
            # the table is full: begin anew once it packs worse than it did
            looked = at
            ratio = at / position
            if ratio > best:
                best = ratio
            else:
                _put(out, position, np.int64(_CLEAR))
                position += bits
                position = group + (position - group + 8 * bits - 1) // (8 * bits) * (8 * bits)
                group = position
                bits = 9
                free = 257
                best = 0.0
                keys[:] = -1
        string = np.int64(data[at])
    return (position + 7) >> 3


@njit(cache=True, inline="always")
def _put(out, position, code):
    """Or a code of at most 16 bits into the bytes at a bit."""
    where = position >> 3
    code = code << (position & 7)
    out[where] |= code & 255
    out[where + 1] |= code >> 8 & 255
    out[where + 2] |= code >> 16
