import pytest

from btfpipe import files


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
