"""The command line as a whole."""

import importlib
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from btfpipe.cli import STAGES

ROOT = Path(__file__).resolve().parents[2]


def test_help_lists_every_stage_and_imports_nothing_heavy():
    code = (
        "import sys; from btfpipe.cli import main; main(['--help'], standalone_mode=False);"
        "print(sorted({'numpy', 'scipy', 'numba', 'sklearn', 'OpenImageIO'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")
    for name, what in STAGES.items():
        assert name in done.stdout
        assert what in done.stdout


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_has_help_with_an_example(btfpipe, name):
    text = btfpipe(name, "--help").stdout
    assert "Example" in text
    assert f"btfpipe {name} " in text.split("Example")[1]
    assert getattr(importlib.import_module(f"btfpipe.cli.{name}"), name).help


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_stands_in_the_readme_and_the_design(name):
    for page in ("README.md", "DESIGN.md"):
        assert re.search(rf"`{name}\b", (ROOT / page).read_text()), page


def test_unknown_command_is_a_usage_error(btfpipe):
    assert "No such command" in btfpipe("weave", code=2).stderr


@pytest.mark.parametrize("target", ["set", "set.zip"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_a_run_without_a_trace(make_sample, tmp_path, number, target):
    make_sample(8, 8).save(tmp_path / "s.npz")
    # holds still after its first picture, so that the signal is certain to come half-way
    victim = (
        "import signal, sys, time; from btfpipe.formats import writing; from btfpipe.cli import main;"
        "signal.signal(signal.SIGINT, signal.default_int_handler);"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL);"
        "real = writing.encode_picture;"
        "writing.encode_picture = lambda *a: (print(flush=True), real(*a), time.sleep(60));"
        "main(sys.argv[1:])"
    )
    out = tmp_path / target
    command = [sys.executable, "-c", victim, "export", tmp_path / "s.npz", "-o", out, "-t", "1"]
    process = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        process.stdout.readline()
        assert len(list(tmp_path.iterdir())) == 2
        process.send_signal(number)
        process.send_signal(number)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 128 + number
    assert said == ""
    assert [p.name for p in tmp_path.iterdir()] == ["s.npz"]


def test_signals_are_as_before_once_the_command_line_is_done(btfpipe):
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    btfpipe("--help")
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before
