"""Unix compress, against an encoder written apart and against gzip, which reads the format too."""

import shutil
import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats.compress_z import compress, decompress


def naive(data, widest=16, block_mode=True, clear_at=()):
    """Encode with a dict of strings and lists of codes; `clear_at` are code counts after which the table is emptied."""
    groups = []  # (bits, codes) of equal width
    strings = {bytes([i]): i for i in range(256)}
    first = 257 if block_mode else 256
    free, bits, codes, count = first, 9, [], 0
    string = b""
    for byte in [*data, None]:
        longer = string + bytes([byte]) if byte is not None else None
        if longer is not None and (longer in strings or not string):
            string = longer
            continue
        if string:
            codes.append(strings[string])
            count += 1
        if free >= 1 << bits and bits < widest:
            groups.append((bits, codes))
            bits, codes = bits + 1, []
        if longer is not None and free < 1 << widest:
            strings[longer] = free
            free += 1
        if block_mode and count in clear_at and longer is not None:
            codes.append(256)
            groups.append((bits, codes))
            strings = {bytes([i]): i for i in range(256)}
            free, bits, codes = first, 9, []
        string = bytes([byte]) if byte is not None else b""
    groups.append((bits, codes))
    out = bytearray([0x1F, 0x9D, widest | (0x80 if block_mode else 0)])
    for number, (bits, codes) in enumerate(groups):
        if number < len(groups) - 1:
            codes = codes + [0] * (-len(codes) % 8)
        value = sum(code << (bits * i) for i, code in enumerate(codes))
        out += value.to_bytes((bits * len(codes) + 7) // 8, "little")
    return bytes(out)


# few different bytes, so that strings grow long and the one code that is used before it is complete comes up
texts = st.binary(max_size=400) | st.lists(st.sampled_from([0, 0, 0, 1, 255]), max_size=800).map(
    bytes
)


@given(texts, st.integers(9, 16), st.booleans(), st.sets(st.integers(1, 300), max_size=4))
@settings(max_examples=150, deadline=None)
def test_what_an_encoder_written_apart_packs_is_unpacked(data, widest, block_mode, clear_at):
    packed = naive(data, widest, block_mode, clear_at)
    assert decompress(packed, len(data), "x") == data


@given(texts, st.integers(9, 16))
@settings(max_examples=50, deadline=None)
def test_packed_is_what_the_encoder_written_apart_packs(data, widest):
    if data:
        assert compress(data, widest) == naive(data, widest)
    assert decompress(compress(data, widest), len(data), "x") == data


def walk(n, seed=3):
    """Bytes that pack about as well as a photograph."""
    steps = np.random.default_rng(seed).normal(0, 3, n)
    return (np.cumsum(steps) % 256).astype(np.uint8).tobytes()


@pytest.mark.parametrize("widest", [10, 12, 16])
def test_long_files_pass_every_width_and_emptied_tables(widest):
    # the second part packs otherwise than the first, so the table is emptied
    data = walk(300_000) + b"abc" * 20_000 + walk(300_000, seed=4)
    packed = compress(data, widest)
    assert decompress(packed, len(data), "x") == data


@pytest.mark.parametrize("widest", [10, 13, 16])
def test_gzip_reads_what_is_packed(widest):
    if shutil.which("gzip") is None:
        pytest.skip("needs gzip")
    data = walk(200_000) + b"abc" * 20_000
    done = subprocess.run(
        ["gzip", "-dc"], input=compress(data, widest), capture_output=True, check=True
    )
    assert done.stdout == data


def test_the_systems_compress_is_read():
    if shutil.which("compress") is None:
        pytest.skip("needs compress")
    data = walk(200_000)
    done = subprocess.run(["compress", "-c"], input=data, capture_output=True, check=True)
    assert decompress(done.stdout, len(data), "x") == data


def test_the_start_can_be_had_alone():
    data = b"abc" * 1000
    packed = compress(data)
    assert decompress(packed, 40, "x", start_only=True) == data[:40]
    assert decompress(packed, 5000, "x", start_only=True) == data


def test_longer_content_than_the_limit_is_refused_before_it_is_unpacked():
    packed = compress(bytes(3_000_000))
    assert len(packed) < 5000
    assert len(decompress(packed, 3_000_000, "x")) == 3_000_000
    with pytest.raises(InputError, match=r"bomb\.Z: holds more than the 2999999 bytes"):
        decompress(packed, 2_999_999, "bomb.Z")


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "no file of Unix compress"),
        (b"\x1f\x9d", "no file of Unix compress"),
        (b"\x1f\x8b\x08", "no file of Unix compress.*1f8b08"),
        (b"\x1f\x9d\x88\x00", "codes have up to 8 bits"),
        (b"\x1f\x9d\x91\x00", "codes have up to 17 bits"),
        (b"\x1f\x9d\x90\xff\xff", "code at byte 3 of 5 stands for nothing"),
        (b"\x1f\x9d\x90\x61\xfe\x03", "code at byte 4 of 6 stands for nothing"),
    ],
)
def test_damaged_files_are_refused_by_name(data, match):
    with pytest.raises(InputError, match=rf"a\.Z: .*{match}"):
        decompress(data, 100, "a.Z")


@given(st.integers(0, 2000), st.integers(0, 255), st.integers(0, 2000))
@settings(max_examples=100, deadline=None)
def test_cut_or_spoiled_files_give_no_more_than_the_limit(at, value, cut):
    data = walk(3000)
    packed = bytearray(compress(data))
    whole = bytes(packed[: 3 + cut])
    start = decompress(whole, len(data), "x")
    assert data.startswith(start)
    assert len(start) == len(data) or len(whole) < len(packed)
    packed[3 + at] = value
    try:
        assert len(decompress(bytes(packed), 4000, "x")) <= 4000
    except InputError:
        pass
