"""The command line as a whole."""

import importlib
import re
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
