"""The encoder here is written from the description of the format, apart from the decoder."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats import ubo
from btfpipe.formats.images import Decoder, encode_picture, open_picture, read_picture
from btfpipe.formats.rgbe import decode_rgbe

ORDERS = ["-Y +X", "+X -Y", "-Y -X", "-X -Y", "+Y +X", "+X +Y", "+Y -X", "-X +Y"]


def values_of(pixels):
    """Naive twin: linear values of RGBE pixels (rows, cols, 4)."""
    return pixels[..., :3] * 2.0 ** (pixels[..., 3:].astype(float) - 136)


def flat(line):
    return line.tobytes()


def old_runs(line):
    """Mantissas 1 1 1 and a count repeat the pixel before; further counts are worth 256 times as much."""
    out, j = b"", 0
    while j < len(line):
        n = 1
        while j + n < len(line) and (line[j + n] == line[j]).all():
            n += 1
        out += line[j].tobytes()
        more = n - 1
        while more:
            out += bytes([1, 1, 1, more & 255])
            more >>= 8
        j += n
    return out


def new_runs(line):
    """Component by component: 128 + n and a byte for a run, n and n bytes for a stretch."""
    out = b"\2\2" + struct.pack(">H", len(line))
    for component in line.T:
        j = 0
        while j < len(component):
            n = 1
            while j + n < len(component) and n < 127 and component[j + n] == component[j]:
                n += 1
            if n > 2:
                out += bytes([128 + n, component[j]])
            else:
                n = min(len(component) - j, 5)
                out += bytes([n]) + component[j : j + n].tobytes()
            j += n
    return out


def encode(pixels, order="-Y +X", pack=flat, header=b"FORMAT=32-bit_rle_rgbe\n"):
    """Radiance file of RGBE pixels (rows, cols, 4) with the top left pixel first."""
    first, second = order.split()
    count = {"Y": pixels.shape[0], "X": pixels.shape[1]}
    if "+Y" in order:
        pixels = np.flipud(pixels)
    if "-X" in order:
        pixels = np.fliplr(pixels)
    lines = pixels.transpose(1, 0, 2) if first[1] == "X" else pixels
    resolution = f"{first} {count[first[1]]} {second} {count[second[1]]}\n".encode()
    return b"#?RADIANCE\n" + header + b"\n" + resolution + b"".join(pack(line) for line in lines)


def random_pixels(rng, rows, cols, runs=True):
    pixels = rng.integers(20, 256, (rows, cols, 4), np.uint8)
    pixels[..., 3] = rng.integers(100, 150, (rows, cols))
    if runs:
        pixels[:, cols // 3 : cols - 2] = pixels[:, cols // 3, None]
    return pixels


@pytest.mark.parametrize("pack", [flat, old_runs, new_runs])
@pytest.mark.parametrize("order", ORDERS)
def test_every_order_of_axes_in_every_encoding_comes_out_upright(rng, order, pack):
    pixels = random_pixels(rng, 11, 19)
    read = decode_rgbe(encode(pixels, order, pack), "a.hdr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values_of(pixels))


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 12), st.integers(1, 700), st.sampled_from(ORDERS),
    st.sampled_from([flat, old_runs, new_runs]), st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_what_was_encoded_is_decoded(rows, cols, order, pack, seed):
    pixels = random_pixels(np.random.default_rng(seed), rows, cols, runs=seed % 2 == 0)
    shortest = rows if "X" in order.split()[0] else cols
    pack = flat if pack is new_runs and shortest < 8 else pack
    read = decode_rgbe(encode(pixels, order, pack), "a.hdr")
    np.testing.assert_array_equal(read, values_of(pixels))


@pytest.mark.parametrize("cols", [5, 60])
def test_the_common_order_is_decoded_as_openimageio_does(tmp_path, rng, cols):
    import OpenImageIO as oiio

    picture = (rng.random((9, cols, 3)) * 50).astype(np.float32)
    picture[:, 2:5] = 0.25
    data = encode_picture(picture, ".hdr")
    (tmp_path / "a.hdr").write_bytes(data)
    peer = oiio.ImageInput.open(str(tmp_path / "a.hdr"))
    np.testing.assert_array_equal(decode_rgbe(data, "a.hdr"), peer.read_image(oiio.FLOAT))
    assert abs(decode_rgbe(data, "a.hdr") - picture).max() < 50 / 128
    np.testing.assert_array_equal(read_picture(tmp_path / "a.hdr"), decode_rgbe(data, "a.hdr"))


def test_exposures_and_colour_corrections_are_divided_out(rng):
    pixels = random_pixels(rng, 4, 9)
    header = b"EXPOSURE=2\nFORMAT=32-bit_rle_rgbe\nEXPOSURE = 4.0\nCOLORCORR=1 2 0.5\n"
    read = decode_rgbe(encode(pixels, header=header), "a.hdr")
    np.testing.assert_allclose(read, values_of(pixels) / (8 * np.array([1, 2, 0.5])), rtol=1e-6)


def test_values_far_above_one_and_black_are_kept():
    pixels = np.array([[[200, 100, 0, 170], [0, 0, 0, 0]]], np.uint8)
    read = decode_rgbe(encode(pixels), "a.hdr")
    assert read[0, 0].tolist() == [200 * 2.0**34, 100 * 2.0**34, 0]
    assert (read[0, 1] == 0).all()


@pytest.mark.parametrize("pack", [flat, old_runs, new_runs])
def test_every_cut_is_noticed(rng, pack):
    data = encode(random_pixels(rng, 5, 12, runs=pack is not flat), pack=pack)
    for length in range(1, len(data)):
        with pytest.raises(InputError, match=r"^mine.hdr: "):
            decode_rgbe(data[:length], "mine.hdr")


def test_exposures_beyond_single_precision_make_infinite_values_and_no_warning():
    head = b"#?RADIANCE\n" + b"EXPOSURE=1e-29\n" * 9 + b"\n-Y 1 +X 1\n"
    assert np.isinf(decode_rgbe(head + b"\x80\x80\x80\xff", "a.hdr")).all()


HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (HEADER + b"-Y 4 +Y 4\n" + bytes(64), "resolution line"),
        (HEADER + b"4 4\n" + bytes(64), "resolution line"),
        (HEADER + b"-Y 0 +X 4\n" + bytes(64), "declares 0 scan-lines"),
        (HEADER + b"-Y 99999 +X 99999\n" + bytes(64), "at most 268435456"),
        (HEADER + b"-Y 16000 +X 16000\n" + bytes(64), "cannot lie in 64 bytes"),
        (HEADER + b"-Y 2 +X 2000000\n" + bytes(64), "cannot lie in 64 bytes"),
        (HEADER + b"-Y 1 +X 4\n" + b"\1\1\1\4" + bytes(60), "a run goes beyond"),
        (HEADER + b"-Y 1 +X 4\n" + b"\7\7\7\7\1\1\1\4" + bytes(60), "a run goes beyond"),
        (HEADER + b"-Y 1 +X 9\n" + b"\2\2\0\x09\x8a\7" + bytes(60), "a run goes beyond"),
        (HEADER + b"-Y 1 +X 9\n" + b"\2\2\0\x09\0\7" + bytes(60), "a run goes beyond"),
        (HEADER + b"-Y 2 +X 2\n" + bytes(16) + b"left over", "9 bytes follow"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n" + bytes(4), "ra_xyze"),
        (b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\n" + bytes(4), "expected 1 positive"),
        (b"#?RADIANCE\nEXPOSURE=nan\n\n-Y 1 +X 1\n" + bytes(4), "expected 1 positive"),
        (b"#?RADIANCE\nCOLORCORR=1 2\n\n-Y 1 +X 1\n" + bytes(4), "expected 3 positive"),
        (b"#?RADIANCE\n-Y 1 +X 1\n" + bytes(4), "no empty line"),
    ],
)
def test_a_damaged_picture_is_refused_by_name(data, match):
    with Decoder() as decoder, pytest.raises(InputError, match=match) as error:
        decoder.decode(data, "mine.hdr")
    assert str(error.value).startswith("mine.hdr: ")


def test_the_order_of_atriums_files_is_read_from_a_file_of_any_program(tmp_path, rng):
    pixels = random_pixels(rng, 6, 8)
    data = encode(pixels, "+X -Y").replace(b"#?RADIANCE", b"#?RGBE")
    (tmp_path / "a.hdr").write_bytes(data)
    picture = open_picture(tmp_path / "a.hdr")
    assert picture.suffix == ".hdr"
    np.testing.assert_array_equal(picture.values, values_of(pixels))


def test_a_set_of_radiance_pictures_in_bonns_layout_is_linear(tmp_path, rng):
    pixels = [random_pixels(rng, 12, 9) for _ in range(2)]
    folder = tmp_path / "ATRIUM"
    folder.mkdir()
    for i, tl in enumerate((0, 45)):
        name = f"{i:05d} tl{tl:03d} pl000 tv000 pv000.hdr"
        (folder / name).write_bytes(encode(pixels[i], "+X -Y", new_runs))
    with ubo.open_measurement(folder) as measurement:
        assert measurement.transfer(measurement.read(0)) == "linear"
        np.testing.assert_array_equal(measurement.read(1), values_of(pixels[1]))
