"""`recognise` of every format, in the order in which `ingest` should ask."""

import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.directions import bonn81
from btfpipe.formats import pairs, pictures, ptm, rti, ubo, utia
from btfpipe.formats.images import write_picture
from btfpipe.formats.pairs import write_pairs
from btfpipe.formats.rti import write_lp
from btfpipe.formats.ubo_writing import write_ubo
from btfpipe.formats.utia import write_utia

FORMATS = [ptm, rti, pairs, utia, ubo, pictures]
STARTS = [b"", b"PK\3\4", b"PK\5\6", b"#?", b"PTM_1.", b"#HSH", b"2\na 0 0 1\n", b"name,lx\n", b"[{", b"\x93NUMPY"]  # fmt: skip


def first(path):
    return next((f for f in FORMATS if f.recognise(path)), None)


@pytest.mark.parametrize(
    ("write", "expected"),
    [(write_ubo, ubo), (write_utia, utia), (write_lp, rti), (write_pairs, pairs)],
)
@pytest.mark.parametrize("target", ["set", "set.zip"])
def test_what_was_written_is_recognised_as_that(tmp_path, make_sample, write, expected, target):
    sample = make_sample(3, 4, lights=bonn81()[:3], views=bonn81()[:2])
    write(tmp_path / target, sample, ".png")
    assert first(tmp_path / target) is expected


def test_a_picture_is_one_whatever_its_name(tmp_path):
    write_picture(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "a.png").rename(tmp_path / "a.lp")
    assert first(tmp_path / "a.lp") is pictures


def cut_in_half(data):
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    ("write", "name", "spoil", "message"),
    [
        (write_pairs, "directions.csv", lambda d: d.replace(b"lx", b"lightx"), "Found 'lightx, ly, lz, name"),
        (write_pairs, "directions.csv", lambda d: d.partition(b"\n")[2], "line 1 is '0.png,"),
        (write_pairs, "directions.csv", lambda d: d.decode().encode("utf-16"), "is not UTF-8"),
        (write_pairs, "directions.csv", lambda d: b"", "expected the columns name and one of"),
        (write_pairs, "directions.json", cut_in_half, "not a list of pictures"),
        (write_lp, "lights.lp", lambda d: d.partition(b"\n")[2], "expected the number of pictures"),
        (write_lp, "lights.lp", lambda d: b"", "begins with ''; expected the number of pictures"),
    ],
)  # fmt: skip
def test_a_list_that_is_nearly_right_is_named_with_what_is_wrong(
    btfpipe, tmp_path, make_sample, write, name, spoil, message
):
    write(tmp_path / "set", make_sample(3, 4, lights=bonn81()[:3], views=bonn81()[:1]), ".png")
    (tmp_path / "set/notes.txt").write_text("anything")
    listed = next(p for p in (tmp_path / "set").iterdir() if p.suffix in (".csv", ".lp"))
    data = spoil(listed.read_bytes())
    listed.unlink()
    (tmp_path / "set" / name).write_bytes(data)
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        for file in (tmp_path / "set").iterdir():
            archive.write(file, file.name)
    for source in (tmp_path / "set", tmp_path / "set.zip", tmp_path / "set" / name):
        said = btfpipe("ingest", source, "-o", tmp_path / "s.npz", code=3).stderr
        assert name in said
        assert message in said
        assert message in btfpipe("info", source).stdout


@pytest.mark.parametrize(
    ("name", "message"),
    [("a.btf", "expected one of !DFMF08FCR"), ("a.ptm", "expected PTM_1.2 or #HSH"), ("a.rti", "expected PTM_1.2 or #HSH")],
)  # fmt: skip
def test_a_file_of_unknown_content_is_held_against_its_ending(btfpipe, tmp_path, name, message):
    (tmp_path / name).write_bytes(b"something else altogether")
    done = btfpipe("ingest", tmp_path / name, "-o", tmp_path / "s.npz", code=3)
    assert message in done.stderr
    assert message in btfpipe("info", tmp_path / name).stdout


def test_a_large_tiff_is_a_picture_whatever_its_ending(tmp_path):
    from btfpipe.formats import sources

    (tmp_path / "a.btf").write_bytes(b"II+\0\x08\0\0\0BigTIFF")
    assert sources.recognise(tmp_path / "a.btf")[0] == "picture"


@pytest.mark.parametrize("name", ["btf", "ptm", "picture"])
def test_a_folder_is_no_single_file(btfpipe, tmp_path, name):
    done = btfpipe("ingest", tmp_path, "--format", name, "-o", tmp_path.with_suffix(".npz"), code=3)
    assert f"a folder; format {name} expects one file" in done.stderr


def test_a_list_that_is_not_there_is_told_with_those_that_are(btfpipe, tmp_path, make_sample):
    write_pairs(tmp_path / "set", make_sample(3, 4), ".png")
    source, out = tmp_path / "set", tmp_path / "s.npz"
    done = btfpipe("ingest", source, "--listing", "no.csv", "--format", "pairs", "-o", out, code=3)
    assert "holds no no.csv" in done.stderr
    assert "of .csv and .json it has directions.csv." in done.stderr


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(STARTS), st.binary(max_size=60),
    st.sampled_from(["a.zip", "a.lp", "a.csv", "a.json", "a.ptm", "a", "btfpipe.json"]),
)  # fmt: skip
def test_no_file_however_strange_makes_it_raise(tmp_path_factory, start, rest, name):
    folder = tmp_path_factory.mktemp("strange")
    (folder / name).write_bytes(start + rest)
    with zipfile.ZipFile(folder / "b.zip", "w") as archive:
        archive.writestr(name, start + rest)
    for path in (folder / name, folder, folder / "b.zip", folder / "nothing"):
        for module in FORMATS:
            reason = module.recognise(path)
            assert reason is None or isinstance(reason, str)
