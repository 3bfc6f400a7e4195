import struct
import zipfile

import pytest

from btfpipe.errors import InputError
from btfpipe.formats.archive import is_zip, open_archive


def pack(path, members, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_members_are_read_as_zipfile_reads_them(tmp_path, rng, method):
    members = {f"a/{i}.bin": rng.bytes(1000 * i) for i in range(4)}
    with open_archive(pack(tmp_path / "a.zip", members, method)) as archive:
        assert {name: archive.read(name) for name in archive.names} == members


def test_a_zip_in_front_of_which_something_stands_is_read(tmp_path):
    plain = pack(tmp_path / "a.zip", {"x": b"hello"}).read_bytes()
    (tmp_path / "b.zip").write_bytes(b"#!/bin/sh\n" + plain)
    with open_archive(tmp_path / "b.zip") as archive:
        assert archive.read("x") == b"hello"


@pytest.mark.parametrize(
    "name", ["../up.jpg", "a/../../up.jpg", "/etc/x.jpg", "..\\up.jpg", "C:x.jpg"]
)
def test_a_member_that_points_outside_is_refused_by_name(tmp_path, name):
    path = pack(tmp_path / "a.zip", {"fine.jpg": b"x", name: b"x"})
    with pytest.raises(InputError, match="points outside the archive") as error:
        open_archive(path)
    assert repr(name) in str(error.value)


def test_an_encrypted_member_is_refused_by_name(tmp_path):
    path = pack(tmp_path / "a.zip", {"secret.jpg": b"x"})
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"'secret.jpg' is encrypted"):
        open_archive(path)


@pytest.mark.parametrize("declared", [2**30 + 1, 500_000])
def test_a_member_that_declares_an_impossible_size_is_refused(tmp_path, declared):
    path = pack(tmp_path / "a.zip", {"bomb.jpg": bytes(200)}, zipfile.ZIP_DEFLATED)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, declared)
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"'bomb.jpg' declares {declared} bytes"):
        open_archive(path)


def test_a_member_larger_than_declared_is_never_unpacked_beyond_that(tmp_path):
    path = pack(tmp_path / "a.zip", {"bomb.jpg": bytes(10_000_000)}, zipfile.ZIP_DEFLATED)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 1000)
    path.write_bytes(data)
    with open_archive(path) as archive:
        with pytest.raises(InputError, match="wrong checksum"):
            archive.read("bomb.jpg")


def test_overlapping_members_are_refused(tmp_path):
    path = pack(tmp_path / "a.zip", {"a.jpg": bytes(range(200)), "b.jpg": b"x" * 200})
    data = bytearray(path.read_bytes())
    first = data.index(b"PK\x01\x02")
    second = data.index(b"PK\x01\x02", first + 4)
    for entry in (first, second):
        struct.pack_into("<II", data, entry + 20, 390, 390)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"overlap|damaged or hostile"):
        open_archive(path)


def test_a_flipped_bit_is_found(tmp_path):
    path = pack(tmp_path / "a.zip", {"a.jpg": b"x" * 200})
    data = bytearray(path.read_bytes())
    data[60] ^= 1
    path.write_bytes(data)
    with (
        open_archive(path) as archive,
        pytest.raises(InputError, match=r"a.zip: a.jpg: .*checksum"),
    ):
        archive.read("a.jpg")


def test_a_truncated_zip_is_called_so(tmp_path):
    path = pack(tmp_path / "a.zip", {"a.jpg": b"x" * 200})
    path.write_bytes(path.read_bytes()[:150])
    assert is_zip(path)
    with pytest.raises(InputError, match="not a zip file, or a truncated one"):
        open_archive(path)


def test_a_file_that_vanished_from_a_folder_is_named(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"x")
    with open_archive(tmp_path) as folder:
        (tmp_path / "a.jpg").unlink()
        with pytest.raises(InputError, match=r"a.jpg: cannot be read"):
            folder.read("a.jpg")


def test_a_damaged_local_header_is_found(tmp_path):
    path = pack(tmp_path / "a.zip", {"a.jpg": b"x" * 200})
    path.write_bytes(b"XX" + path.read_bytes()[2:])
    with (
        open_archive(path) as archive,
        pytest.raises(InputError, match=r"a\.jpg: truncated or damaged"),
    ):
        archive.read("a.jpg")


def test_a_broken_deflate_stream_is_found(tmp_path, rng):
    path = pack(tmp_path / "a.zip", {"a.jpg": rng.bytes(300) * 3}, zipfile.ZIP_DEFLATED)
    data = bytearray(path.read_bytes())
    data[40:60] = b"\xff" * 20
    path.write_bytes(data)
    with open_archive(path) as archive, pytest.raises(InputError, match=r"a\.jpg: damaged"):
        archive.read("a.jpg")


def test_another_packing_method_is_named(tmp_path):
    path = pack(tmp_path / "a.zip", {"a.jpg": b"x" * 200}, zipfile.ZIP_LZMA)
    with open_archive(path) as archive, pytest.raises(InputError, match=r"packed by method 14"):
        archive.read("a.jpg")


@pytest.mark.parametrize(
    ("at", "layout", "value"),
    [
        (6, "<H", 255),  # version needed to read it
        (8, "<H", 0x800),  # name in UTF-8, which it then is not
        (28, "<H", 0),  # length of the name
        (42, "<I", 0xFFFFFFF0),  # where its local header is
    ],
)
def test_a_directory_with_wrong_bytes_is_refused_by_name(tmp_path, at, layout, value):
    path = pack(tmp_path / "a.zip", {"\xe9.jpg": b"x" * 200})
    data = bytearray(path.read_bytes())
    entry = data.index(b"PK\x01\x02")
    data[entry + 46] = 0xFF
    struct.pack_into(layout, data, entry + at, value)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.zip: "):
        open_archive(path)


def test_a_file_longer_than_it_may_be_is_refused_unread(tmp_path):
    packed = pack(tmp_path / "a.zip", {"b.json": bytes(5000)}, zipfile.ZIP_DEFLATED)
    (tmp_path / "b.json").write_bytes(bytes(5000))
    for source in (packed, tmp_path):
        with open_archive(source) as archive:
            assert archive.read("b.json", 5000) == bytes(5000)
            with pytest.raises(
                InputError, match=r"b\.json: longer than 4999 bytes; expected a list"
            ):
                archive.read("b.json", 4999, "a list")
    with (tmp_path / "huge.jpg").open("wb") as file:
        file.truncate(2**31)  # a hole, which takes no room
    with (
        open_archive(tmp_path) as folder,
        pytest.raises(InputError, match=r"huge\.jpg: longer than .* expected a picture"),
    ):
        folder.read("huge.jpg")
