import os
import struct

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.formats.images import (
    Decoder,
    colours,
    encode_picture,
    is_mislabelled,
    open_picture,
    read_picture,
    write_picture,
)


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        (".png", np.uint8),
        (".png", np.uint16),
        (".tif", np.uint16),
        (".exr", np.float16),
        (".exr", np.float32),
    ],
)
def test_lossless_formats_give_back_what_was_written(tmp_path, rng, suffix, dtype):
    if np.dtype(dtype).kind == "f":
        picture = (rng.normal(size=(7, 9, 3)) * 100).astype(dtype)
    else:
        picture = rng.integers(0, np.iinfo(dtype).max, (7, 9, 3), dtype, endpoint=True)
    write_picture(tmp_path / f"a{suffix}", picture)
    read = read_picture(tmp_path / f"a{suffix}")
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, picture)


def test_jpeg_is_close_and_the_right_way_up(tmp_path):
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:16, :, 0] = 200  # red on top
    picture[:, 24:, 1] = 200  # green on the right
    read = read_picture(encode_picture(picture, ".jpg"), "a.jpg")
    assert np.abs(read.astype(int) - picture).mean() < 2


def test_alpha_is_not_multiplied_in(tmp_path):
    picture = np.full((4, 4, 4), 200, np.uint8)
    picture[..., 3] = 10
    write_picture(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), picture)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".exr"])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.95])
def test_a_truncated_picture_is_refused_by_the_users_name(rng, suffix, share, capfd):
    picture = rng.integers(0, 255, (40, 50, 3), np.uint8)
    data = encode_picture(picture.astype(np.float16) if suffix == ".exr" else picture, suffix)
    with Decoder() as decoder:
        with pytest.raises(InputError) as error:
            decoder.decode(data[: int(share * len(data)) + 8], f"folder/mine{suffix}")
    text = str(error.value)
    assert text.startswith(f"folder/mine{suffix}: ")
    assert "truncated" in text
    assert "/dev/shm" not in text
    assert "btfpipe-" not in text
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_every_cut_of_a_small_picture_is_noticed(rng, suffix):
    data = encode_picture(rng.integers(0, 255, (8, 8, 3), np.uint8), suffix)
    with Decoder() as decoder:
        for length in range(0, len(data) - 1, 7):
            with pytest.raises(InputError, match="mine"):
                decoder.decode(data[:length], "mine" + suffix)


def test_an_empty_picture_is_called_empty(tmp_path):
    (tmp_path / "a.jpg").touch()
    with pytest.raises(InputError, match=r"a.jpg: empty"):
        read_picture(tmp_path / "a.jpg")
    with Decoder() as decoder, pytest.raises(InputError, match=r"b.jpg: empty"):
        decoder.decode(b"", "b.jpg")


def test_text_is_not_a_picture(tmp_path):
    (tmp_path / "a.jpg").write_text("hello, this is no picture at all")
    with pytest.raises(InputError, match=r"a.jpg: not a readable picture"):
        read_picture(tmp_path / "a.jpg")


def test_a_missing_picture_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no.png: no such file"):
        read_picture(tmp_path / "no.png")


def test_a_mislabelled_picture_is_decoded_and_told(rng):
    picture = rng.integers(0, 255, (6, 7, 3), np.uint8)
    with Decoder() as decoder:
        decoded = decoder.decode(encode_picture(picture, ".png"), "a.jpg")
    np.testing.assert_array_equal(decoded.values, picture)
    assert is_mislabelled("a.jpg", decoded.suffix)
    assert not is_mislabelled("a.JPEG", ".jpg")
    assert not is_mislabelled("without ending", ".png")


def test_a_picture_that_declares_an_absurd_size_is_refused(rng):
    data = bytearray(encode_picture(rng.integers(0, 255, (8, 8, 3), np.uint8), ".jpg"))
    frame = data.index(b"\xff\xc0")  # start of frame: height and width follow after five bytes
    data[frame + 5 : frame + 9] = b"\xff\x00\xff\x00"
    with Decoder() as decoder, pytest.raises(InputError, match=r"bomb.jpg: .*malicious"):
        decoder.decode(data, "bomb.jpg")


def test_a_picture_larger_than_any_measurement_is_refused(rng, monkeypatch):
    monkeypatch.setattr("btfpipe.formats.images._MAX_PIXELS", 63)
    data = encode_picture(rng.integers(0, 255, (8, 8, 3), np.uint8), ".jpg")
    with Decoder() as decoder, pytest.raises(InputError, match=r"huge.jpg: declares 8 x 8 pixels"):
        decoder.decode(data, "huge.jpg")


def test_decoder_leaves_nothing_behind(rng):
    from pathlib import Path

    with Decoder() as decoder:
        folder = Path(decoder._folder)
        decoder.decode(encode_picture(rng.integers(0, 255, (6, 7, 3), np.uint8), ".png"), "a.png")
        assert folder.is_dir()
    assert not folder.exists()


def test_grey_is_repeated_and_layers_are_left_out(tmp_path, rng):
    grey = rng.integers(0, 255, (5, 6, 1), np.uint8)
    write_picture(tmp_path / "grey.png", grey)
    np.testing.assert_array_equal(
        colours(open_picture(tmp_path / "grey.png"), "grey"), np.repeat(grey, 3, axis=2)
    )
    layered = rng.random((5, 6, 5)).astype(np.float32)
    names = ["depth.Z", "B", "G", "R", "A"]
    write_picture(tmp_path / "layered.exr", layered, names=names)
    np.testing.assert_array_equal(
        colours(open_picture(tmp_path / "layered.exr"), "layered"), layered[..., [3, 2, 1]]
    )


def test_layers_without_colour_are_refused(tmp_path, rng):
    write_picture(
        tmp_path / "a.exr", rng.random((5, 6, 3)).astype(np.float32), names=["x", "y", "z"]
    )
    with pytest.raises(InputError, match="expected R, G and B, or grey"):
        colours(open_picture(tmp_path / "a.exr"), "a.exr")


def test_equal_pictures_are_equal_bytes(rng):
    picture = rng.random((5, 6, 3)).astype(np.float16)
    assert encode_picture(picture, ".exr") == encode_picture(picture, ".exr")


def test_no_room_for_a_decoded_picture_is_said_of_that_folder(rng):
    with Decoder() as decoder:
        decoder._folder += "/gone"
        with pytest.raises(InputError, match=r"gone: no room for a decoded picture"):
            decoder.decode(encode_picture(rng.integers(0, 9, (4, 4, 3), np.uint8), ".png"), "a.png")


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="needs files without a name")
def test_what_a_killed_process_would_leave_takes_no_memory(rng):
    with Decoder() as decoder:
        decoder.decode(encode_picture(rng.integers(0, 9, (4, 4, 3), np.uint8), ".png"), "a.png")
        (left,) = os.scandir(decoder._folder)
        assert left.is_symlink()


def test_without_nameless_files_plain_ones_serve(rng, monkeypatch):
    monkeypatch.delattr(os, "memfd_create", raising=False)
    pictures = rng.integers(0, 255, (2, 30, 40, 3), np.uint8)
    pictures[1] = 0  # much smaller than the first: nothing of that may be left in the file
    with Decoder() as decoder:
        for picture in pictures:
            decoded = decoder.decode(encode_picture(picture, ".png"), "a.png")
            np.testing.assert_array_equal(decoded.values, picture)


def test_a_small_jpeg_that_declares_many_pixels_is_refused_before_memory_is_taken(rng):
    data = bytearray(encode_picture(rng.integers(0, 255, (8, 8, 3), np.uint8), ".jpg"))
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">2H", 16000, 16000)
    with Decoder() as decoder, pytest.raises(InputError, match=r"16000 x 16000 pixels cannot lie"):
        decoder.decode(data, "bomb.jpg")


def test_the_emptiest_jpeg_is_no_bomb():
    picture = np.zeros((2000, 2000, 1), np.uint8)
    assert read_picture(encode_picture(picture, ".jpg", quality=1), "black.jpg").max() < 3


def test_a_text_that_is_none_is_refused_by_name(rng):
    data = encode_picture(rng.random((4, 5, 3)).astype(np.float16), ".exr")
    assert data.count(b"chlist") == 1
    with Decoder() as decoder, pytest.raises(InputError, match=r"mine\.exr: truncated or damaged"):
        decoder.decode(data.replace(b"chlist", b"chl\xffst"), "mine.exr")
