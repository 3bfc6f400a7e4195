import os

import pytest

from btfpipe import files
from btfpipe.errors import InputError


def write_file(path):
    with files.whole(path) as file:
        file.write(b"new")


def write_folder(path):
    with files.whole_folder(path) as part:
        (part / "x").write_text("new")


@pytest.mark.parametrize("write", [write_file, write_folder])
def test_what_a_killed_run_left_goes_and_nothing_else(tmp_path, write):
    for name in ("a.btfpipe-0123abcd.part", "a.btfpipe-89abcdef.part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x").write_text("half")
    (tmp_path / "a.btfpipe-00000000.part").write_bytes(b"x" * 100_000)
    others = {
        "a.part",
        "b.btfpipe-0123abcd.part",
        "a.btfpipe-0123.part",
        "a.btfpipe-0123abcd.parts",
    }
    others |= {f"{name}s" for name in others}
    for name in others:
        if name.endswith("s"):
            (tmp_path / name).mkdir()
            (tmp_path / name / "mine").write_text("mine")
        else:
            (tmp_path / name).write_text("mine")
    files.check_writable(tmp_path / "a", folder=True)
    write(tmp_path / "a")
    assert {p.name for p in tmp_path.iterdir()} == others | {"a"}
    assert all((tmp_path / n / "mine").exists() for n in others if n.endswith("s"))


def test_two_runs_that_write_the_same_do_not_disturb_each_other(tmp_path):
    with files.whole(tmp_path / "a") as file:
        write_file(tmp_path / "a")
        assert len(list(tmp_path.iterdir())) == 2
        file.write(b"last")
    assert (tmp_path / "a").read_bytes() == b"last"
    with files.whole_folder(tmp_path / "b") as part:
        (part / "y").write_text("last")
        write_folder(tmp_path / "b")
        assert len(list(tmp_path.iterdir())) == 3
    assert [p.name for p in (tmp_path / "b").iterdir()] == ["y"]
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("write", [write_file, write_folder, files.check_writable])
def test_pipes_and_devices_are_not_replaced(tmp_path, write):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name in ("pipe", "link"):
        with pytest.raises(InputError, match=f"{name}: cannot be written .a device, a pipe"):
            write(tmp_path / name)
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "link").is_symlink()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_is_not_replaced_by_a_folder_nor_a_folder_by_a_file(tmp_path):
    write_file(tmp_path / "file")
    write_folder(tmp_path / "folder")
    with pytest.raises(InputError, match="a file is there"):
        write_folder(tmp_path / "file")
    with pytest.raises(InputError, match="a folder is there"):
        write_file(tmp_path / "folder")


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("write", [write_file, write_folder])
def test_links_are_written_through_whether_they_dangle_or_not(tmp_path, write, there):
    (tmp_path / "far").mkdir()
    (tmp_path / "near").symlink_to("link")
    (tmp_path / "link").symlink_to("far/target")
    if there:
        write(tmp_path / "far/target")
    files.check_writable(tmp_path / "near", folder=True)
    write(tmp_path / "near")
    assert (tmp_path / "near").is_symlink()
    assert (tmp_path / "link").is_symlink()
    assert [p.name for p in (tmp_path / "far").iterdir()] == ["target"]
    found = tmp_path / "far/target"
    assert (found if write is write_file else found / "x").read_text() == "new"


def test_links_in_a_ring_are_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(InputError, match=r"a: cannot be written \(Too many levels"):
        files.check_writable(tmp_path / "a")
