"""What every command shares, seen through small commands made here and through real ones."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from btfpipe.cli.options import FiniteFloat, input_file, stage, warn
from btfpipe.errors import NumericalError


def command(body, out="optional", **options):
    """A command with one input and one more output, which does `body`."""

    @click.command()
    @click.argument("sources", nargs=-1, type=input_file())
    @click.option("--other", type=click.Path(path_type=Path))
    @stage(out=out, outputs=("other",), **options)
    def made(sources, other, out):
        return body(out) or {}

    return made


def run(made, *args):
    return CliRunner().invoke(made, [str(a) for a in args])


NUMBERS = [
    ("surface", "--turn-deg"),
    ("surface", "--crease-deg"),
    ("ingest", "--white"),
    ("ingest", "--grey-card-reflectance"),
    ("ingest", "--texels-per-mm"),
    ("synthesize", "--turn-deg"),
    ("synthesize", "--texels-per-unit"),
    ("synthesize", "--repeats"),
    ("synthesize", "--coherence"),
]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999"])
@pytest.mark.parametrize(("name", "option"), NUMBERS)
def test_numbers_that_are_not_finite_are_wrong_usage(btfpipe, tmp_path, name, option, value):
    (tmp_path / "x").write_bytes(b"x")
    done = btfpipe(name, tmp_path / "x", "-o", tmp_path / "y", f"{option}={value}", code=2)
    assert option in done.stderr


def test_every_float_of_these_commands_is_finite():
    import importlib

    for name in ("compress", "compare", "surface", "ingest", "info", "textons", "synthesize"):
        for option in getattr(importlib.import_module(f"btfpipe.cli.{name}"), name).params:
            assert type(option.type) not in (click.FloatRange, click.types.FloatParamType), option


def test_bounds_of_a_finite_float_hold_and_show():
    kind = FiniteFloat(0, 1, min_open=True)
    assert kind.convert("0.5", None, None) == 0.5
    for value in ("0", "1.5"):
        with pytest.raises(click.BadParameter, match="not in the range"):
            kind.convert(value, None, None)
    assert FiniteFloat().convert("-1e30", None, None) == -1e30


def test_help_of_a_number_without_bounds_shows_none(btfpipe):
    assert "None" not in btfpipe("surface", "--help").stdout


def test_a_summary_is_json_whatever_its_numbers():
    facts = {"a": np.nan, "b": [np.float32("inf"), 1.5], "c": {"d": np.array([1, np.nan])}, "e": 3}
    done = run(command(lambda out: facts), "--json")

    def never(text):
        raise AssertionError(text)

    said = json.loads(done.stdout, parse_constant=never)
    assert (said["a"], said["b"], said["c"], said["e"]) == (None, [None, 1.5], {"d": [1, None]}, 3)


def test_too_little_memory_is_one_sentence():
    def body(out):
        return np.empty(2**58)

    done = run(command(body))
    assert done.exit_code == 3
    assert done.stderr.startswith("Error: made needs more memory than there is")
    assert done.stderr.count("\n") == 1


def test_a_matrix_that_cannot_be_solved_is_one_sentence_and_exit_code_4(
    btfpipe, make_sample, tmp_path, monkeypatch
):
    def fail(*args, **kwargs):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    make_sample(8, 8).save(tmp_path / "s.npz")
    monkeypatch.setattr(np.linalg, "eigh", fail)
    done = btfpipe("compress", tmp_path / "s.npz", "-o", tmp_path / "m.npz", "-q", code=4)
    assert done.stderr.startswith("Error: compress came upon a matrix that cannot be worked with")
    assert "(Eigenvalues did not converge)" in done.stderr
    assert done.stderr.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["s.npz"]


def test_a_vector_field_that_cannot_be_factorised_is_exit_code_4(monkeypatch):
    import scipy.sparse.linalg

    from btfpipe.surface import field

    def fail(*args, **kwargs):
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.setattr(scipy.sparse.linalg, "splu", fail)
    with pytest.raises(NumericalError, match=r"factorised \(Factor is exactly singular\)"):
        field._factor(scipy.sparse.identity(3), 0.0)


def test_a_pipe_is_no_input(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    result = run(command(lambda out: None), tmp_path / "pipe")
    assert result.exit_code == 2
    assert "pipe is a pipe or a device; expected a file" in result.stderr


@pytest.mark.parametrize("options", [[], ["-q"], ["-q", "--json"]])
def test_warnings_are_told_to_those_who_want_it_quiet_too(options):
    def body(out):
        warn("it is dark.", "it is cold")

    done = run(command(body), *options)
    assert "Warning: it is dark.\nWarning: it is cold.\n" in done.stderr
    assert "Warning" not in done.stdout


def test_an_input_is_never_an_output_even_with_force(tmp_path):
    (tmp_path / "a").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    done = []
    made = command(lambda out: done.append(out))
    for options in (["-o", tmp_path / "a"], ["-o", tmp_path / "link"], ["--other", tmp_path / "a"],
                    ["-o", tmp_path / ".." / tmp_path.name / "a"]):  # fmt: skip
        result = run(made, tmp_path / "a", *options, "--force")
        assert result.exit_code == 2
        assert "is also the input" in result.stderr
    assert not done
    assert (tmp_path / "a").read_text() == "mine"


def test_a_folder_with_the_input_is_never_an_output(tmp_path):
    (tmp_path / "set/below").mkdir(parents=True)
    (tmp_path / "set/below/a").write_text("mine")
    done = []
    made = command(lambda out: done.append(out), folder=True)
    result = run(made, tmp_path / "set/below/a", "-o", tmp_path / "set", "--force")
    assert result.exit_code == 2
    assert "holds the input" in result.stderr
    assert not done


def test_a_sample_does_not_replace_itself_by_its_model(btfpipe, make_sample, tmp_path):
    path = tmp_path / "s.npz"
    make_sample().save(path)
    before = path.read_bytes()
    done = btfpipe("compress", path, "-o", path, "--force", code=2)
    assert "is also the input" in done.stderr
    assert path.read_bytes() == before


def test_two_outputs_of_one_name_are_refused(tmp_path):
    result = run(command(lambda out: None), "-o", tmp_path / "a", "--other", tmp_path / "a")
    assert result.exit_code == 2
    assert "written twice" in result.stderr


@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("target", ["", ".", "/", "..", "a/.."])
def test_what_names_no_file_is_wrong_usage(target, folder):
    done = []
    made = command(lambda out: done.append(out), folder=folder)
    for options in (["-o", target], ["-o", target, "--force"], ["--other", target]):
        result = run(made, *options)
        assert result.exit_code == 2
        assert "is no name of a file; give one to write" in result.stderr
    assert not done


@pytest.mark.parametrize("option", ["-o", "--other"])
def test_what_cannot_be_written_is_found_before_the_work(tmp_path, option):
    done = []
    (tmp_path / "folder").mkdir()
    made = command(lambda out: done.append(out))
    result = run(made, option, tmp_path / "folder", "--force")
    assert result.exit_code == 3
    assert "folder: cannot be written (a folder is there)" in result.stderr
    result = run(made, option, tmp_path / ("n" * 300))
    assert result.exit_code == 3
    assert "cannot be written (File name too long)" in result.stderr
    assert not done
    result = run(made, option, tmp_path / "free")
    assert result.exit_code == 0
    assert len(done) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_pipes_and_links_in_a_ring_are_found_before_the_work(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    done = []
    made = command(lambda out: done.append(out))
    for name in ("pipe", "a"):
        result = run(made, "-o", tmp_path / name, "--force")
        assert result.exit_code == 3
        assert f"{tmp_path / name}: cannot be written" in result.stderr
    assert not done
    assert (tmp_path / "pipe").is_fifo()


def test_a_command_that_writes_folders_may_replace_one(tmp_path):
    (tmp_path / "set").mkdir()
    made = command(lambda out: None, folder=True)
    assert run(made, "-o", tmp_path / "set", "--force").exit_code == 0


def test_textons_and_synthesize_name_the_file_that_is_too_odd(btfpipe, make_sample, tmp_path):
    from btfpipe.analysis.pyramid import plain_features

    make_sample(rows=18, cols=22).save(tmp_path / "odd.npz")
    done = btfpipe("textons", tmp_path / "odd.npz", "-o", tmp_path / "f.npz", code=3)
    assert f"Error: {tmp_path / 'odd.npz'}: " in done.stderr
    assert "cannot be halved" in done.stderr
    plain_features(np.ones((8, 8, 1)), levels=1).save(tmp_path / "f.npz")
    done = btfpipe(
        "synthesize", tmp_path / "f.npz", "--plane", "16x16", "-o", tmp_path / "m.npz", code=3
    )
    assert f"Error: {tmp_path / 'f.npz'} on a plane: the features have 1 levels" in done.stderr


@pytest.mark.parametrize(("name", "option"), [("ingest", "--size"), ("synthesize", "--plane")])
@pytest.mark.parametrize("size", ["999999x999999", "16385x4", f"4x{10**400}"])
def test_sizes_beyond_all_measure_are_refused(btfpipe, tmp_path, name, option, size):
    np.save(tmp_path / "x.npy", np.ones((8, 8, 1)))
    done = btfpipe(name, tmp_path / "x.npy", "-o", tmp_path / "y", option, size, code=2)
    assert "at most 16384" in done.stderr


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "btfpipe", "--help"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("Usage: btfpipe ")
