import io
import json
import mmap
import struct
import tempfile
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from btfpipe import store
from btfpipe.errors import InputError

ARRAYS = {
    "codes": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    "half": np.linspace(0, 1, 7).astype(np.float16),
    "empty": np.zeros((0, 3), np.float32),
    "scalar": np.array(3.5),
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.npz"
    store.write(path, "sample", ARRAYS, seed=7)
    return path


def test_numpy_reads_what_we_write(path):
    with np.load(path) as loaded:
        for name, array in ARRAYS.items():
            assert loaded[name].dtype == array.dtype
            np.testing.assert_array_equal(loaded[name], array)


def test_what_is_written_is_mapped_back(path):
    reader = store.read(path, "sample")
    assert reader.names() == list(ARRAYS)
    assert reader.about["seed"] == 7
    assert isinstance(reader["codes"], np.memmap)
    for name, array in ARRAYS.items():
        assert reader[name].dtype == array.dtype
        np.testing.assert_array_equal(reader[name], array)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        hnp.arrays(
            st.sampled_from(["u1", "f2", "<f4", "<f8", "i4", "?"]),
            hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
        ),
        max_size=4,
    ),
    st.dictionaries(st.text("abc_", min_size=1), st.integers() | st.text() | st.none(), max_size=3),
)
def test_any_arrays_survive_the_round_trip(tmp_path_factory, arrays, facts):
    path = tmp_path_factory.mktemp("store") / "x.npz"
    named = {f"m{'x' * i}": array for i, array in enumerate(arrays)}
    store.write(path, "map", named, facts=facts)
    reader = store.read(path, "map")
    assert reader.about["facts"] == facts
    for name, array in named.items():
        assert reader[name].dtype == array.dtype
        np.testing.assert_array_equal(reader[name], array)


def test_array_data_starts_at_multiples_of_64(path):
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".npy"):
                name, extra = struct.unpack_from("<HH", data, info.header_offset + 26)
                start = info.header_offset + 30 + name + extra
                member = io.BytesIO(data[start:])
                np.lib.format.read_magic(member)
                np.lib.format.read_array_header_1_0(member)
                assert (start + member.tell()) % 64 == 0, info.filename
                assert info.compress_type == zipfile.ZIP_STORED


def test_local_headers_are_zip64_so_that_members_may_pass_4_gib(path):
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("codes.npy")
    name, extra = struct.unpack_from("<HH", data, info.header_offset + 26)
    fields = data[info.header_offset + 30 + name :][:extra]
    kinds = []
    while fields:
        kind, size = struct.unpack_from("<HH", fields)
        kinds.append(kind)
        fields = fields[4 + size :]
    assert 0x0001 in kinds


def test_equal_work_gives_equal_bytes(path, tmp_path):
    store.write(tmp_path / "other.npz", "sample", ARRAYS, seed=7)
    assert path.read_bytes() == (tmp_path / "other.npz").read_bytes()
    store.write(tmp_path / "other.npz", "sample", ARRAYS, seed=8)
    assert path.read_bytes() != (tmp_path / "other.npz").read_bytes()


def test_streaming_equals_writing_at_once(path, tmp_path):
    with store.create(tmp_path / "s.npz", "sample", seed=7) as writer:
        with writer.stream("codes", (2, 3, 4), np.uint8) as put:
            put(ARRAYS["codes"][:1])
            put(ARRAYS["codes"][1:])
        for name in ("half", "empty", "scalar"):
            writer.array(name, ARRAYS[name])
    assert path.read_bytes() == (tmp_path / "s.npz").read_bytes()


def test_arrays_in_any_order_of_memory_are_written_alike(path, tmp_path, rng):
    wide = rng.random((5, 8, 6))
    arrays = {
        "part": wide[:, :3],
        "turned": wide.T,
        "line": wide[0, 0],
        "every other": wide[::2, 0, 1],
    }
    store.write(path, "sample", arrays)
    store.write(tmp_path / "b.npz", "sample", {k: a.copy(order="C") for k, a in arrays.items()})
    assert path.read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_scratch_array_is_zero_and_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    array = store.scratch((3, 4), np.int16)
    assert list(tmp_path.iterdir()) == []
    assert not array.any()
    array[1] = 7
    assert array.sum() == 28


def test_the_bytes_asked_for_are_those_of_the_part(path, rng):
    array = rng.integers(0, 255, (7, 40, 50, 3)).astype(np.uint8)
    store.write(path, "sample", {"before": np.zeros(5001, np.uint8), "pictures": array})
    mapped = store.read(path)["pictures"]
    for part in (slice(0, 3), slice(11, 12), slice(38, 40), slice(0, 40)):
        store.will_read(mapped, part)
        store.will_read(array, part)
        ranges = list(store._pages(mapped, part))
        assert len(ranges) == 7
        for (start, length), picture in zip(ranges, array, strict=True):
            assert start % mmap.PAGESIZE == 0
            found = mapped.base[start : start + length]
            assert found.endswith(picture[part].tobytes())
            assert len(found) < picture[part].nbytes + mmap.PAGESIZE


@pytest.mark.parametrize("blocks", [[], [3], [5]])
def test_a_stream_that_is_not_filled_leaves_no_file(tmp_path, blocks):
    def fill():
        with store.create(tmp_path / "s.npz", "sample") as writer:
            with writer.stream("x", (4,), np.uint8) as put:
                for n in blocks:
                    put(np.zeros(n, np.uint8))

    with pytest.raises(ValueError, match="promised"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_the_old_file_and_no_part(path, tmp_path):
    before = path.read_bytes()

    def fail():
        with store.create(path, "sample") as writer:
            writer.array("x", np.zeros(3))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_a_full_disk_is_an_input_error_and_leaves_nothing(tmp_path, monkeypatch):
    import errno

    def full(self, name, array):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store.Writer, "array", full)
    with pytest.raises(InputError, match=r"a.npz: cannot be written \(No space left"):
        store.write(tmp_path / "a.npz", "sample", ARRAYS)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        store.write(tmp_path / "no" / "a.npz", "sample", {})


def test_json_is_written_with_numpy_values(tmp_path):
    file = io.StringIO()
    thing = {"n": np.int64(3), "a": np.arange(2), "p": tmp_path, "psnr": float("inf")}
    store.put_json(file, thing)
    assert json.loads(file.getvalue()) == {"n": 3, "a": [0, 1], "p": str(tmp_path), "psnr": None}
    with pytest.raises(TypeError, match="no JSON form"):
        store.put_json(file, {"x": object()})


def test_another_kind_is_refused_with_the_command_that_makes_the_right_one(path):
    with pytest.raises(
        InputError, match=r"holds a sample\. Expected a model made by `btfpipe compress`"
    ):
        store.read(path, "model")
    assert store.read(path, ("sample", "model")).kind == "sample"


def test_a_newer_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "FORMAT_VERSION", store.FORMAT_VERSION + 1)
    store.write(tmp_path / "a.npz", "sample", {})
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"format version 2.*Install a newer btfpipe"):
        store.read(tmp_path / "a.npz")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no\.npz: no such file"):
        store.read(tmp_path / "no.npz")


def test_numpys_own_files_and_others_are_told_apart(tmp_path):
    np.savez(tmp_path / "numpy.npz", x=np.zeros(3))
    with pytest.raises(InputError, match="not one of btfpipe's"):
        store.read(tmp_path / "numpy.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(InputError, match="not a btfpipe file, or damaged"):
        store.read(tmp_path / "text.npz")


@pytest.mark.parametrize("about", [b"[]", b"3", b"{", b"\xff\xfe", b'{"format": "x"}', b"{}"])
def test_a_damaged_description_is_refused(tmp_path, about):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("about.json", about)
    with pytest.raises(InputError, match=r"a\.npz"):
        store.read(tmp_path / "a.npz")


def test_a_file_truncated_anywhere_is_refused(path, tmp_path):
    data = path.read_bytes()
    cut = tmp_path / "cut.npz"
    for length in range(0, len(data) - 1, 13):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.npz"):
            store.read(cut, "sample")


def test_damage_in_a_header_is_refused_by_array(path):
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("codes.npy").header_offset
    for place, value in (
        (start, b"XX"),
        (data.index(b"\x93NUMPY"), b"XXXXXX"),
        (data.index(b"(2, 3, 4)"), b"(9, 9, 9)"),
        (data.index(b"(2, 3, 4)"), b"(2, 3(, 4"),
        (data.index(b"(2, 3, 4)"), b"(2, 3, ''"),
    ):
        spoiled = bytearray(data)
        spoiled[place : place + len(value)] = value
        path.write_bytes(spoiled)
        with pytest.raises(InputError, match=r"array 'codes' is damaged"):
            store.read(path)["codes"]


def test_an_array_that_is_not_there_is_named(path):
    reader = store.read(path)
    assert "codes" in reader
    assert "pictures" not in reader
    with pytest.raises(InputError, match=r"no array 'pictures'; it has \['codes'"):
        reader["pictures"]


def test_requirements_fire(tmp_path):
    store.write(tmp_path / "a.npz", "map", {"x": np.array([[1.0, np.nan]]), "n": np.arange(3)})
    reader = store.read(tmp_path / "a.npz")
    assert reader.require("n", (None,), "iu").shape == (3,)
    with pytest.raises(InputError, match=r"n has shape \(3,\); expected \(4,\)"):
        reader.require("n", (4,))
    with pytest.raises(InputError, match=r"expected \('any', 3\)"):
        reader.require("n", (None, 3))
    with pytest.raises(InputError, match="n is int64; expected kind 'f'"):
        reader.require("n", (3,), "f")
    with pytest.raises(InputError, match="x holds 1 NaN or infinite values"):
        reader.require("x", (1, 2))
    assert reader.require("x", (1, 2), finite=False).shape == (1, 2)


def test_digests_follow_content_and_not_place(path, tmp_path):
    copy = tmp_path / "copy.npz"
    copy.write_bytes(path.read_bytes())
    assert store.digest(path) == store.digest(copy) == store.read(path).digest
    store.write(copy, "sample", ARRAYS | {"half": np.zeros(7, np.float16)}, seed=7)
    assert store.digest(path) != store.digest(copy)
    (tmp_path / "text").write_text("hello")
    first = store.digest(tmp_path / "text")
    (tmp_path / "text").write_text("hellO")
    assert store.digest(tmp_path / "text") != first


def test_the_digest_of_a_folder_follows_its_names_and_sizes(tmp_path):
    (tmp_path / "a").write_text("x")
    first = store.digest(tmp_path)
    (tmp_path / "b").write_text("x")
    assert store.digest(tmp_path) != first


def test_ours_is_known_from_foreign(path, tmp_path):
    assert store.is_ours(path)
    np.savez(tmp_path / "numpy.npz", x=np.zeros(3))
    assert not store.is_ours(tmp_path / "numpy.npz")
    assert not store.is_ours(tmp_path / "none")


def test_zip_files_of_another_version_and_descriptions_beyond_measure_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    store.write(path, "sample", {})
    data = bytearray(path.read_bytes())
    data[data.rindex(b"PK\1\2") + 6] = 144  # the version that reading takes
    path.write_bytes(data)
    assert not store.is_ours(path)
    assert len(store.digest(path)) == 12
    with pytest.raises(InputError, match="not a btfpipe file, or damaged"):
        store.read(path)
    for packing, about in ((zipfile.ZIP_STORED, "[" * 100_000), (zipfile.ZIP_DEFLATED, "{}")):
        with zipfile.ZipFile(path, "w", packing) as archive:
            archive.writestr("about.json", about)
        with pytest.raises(InputError, match="not a btfpipe file, or damaged"):
            store.read(path)
