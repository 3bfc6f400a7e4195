"""The whole DAG on a small config: it runs, it resumes, it ends with the same bytes whatever the threads, it reports."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFIG = """
results: results
samples:
  cords:
    source: data-sample/cords.zip
    truth: {spec: data-sample/cords.yaml, pairs: pairs.csv}
compress: {components: 12}
textons: {textons: 64, images: 60, levels: 2}
surfaces:
  pebble: {mesh: data-sample/meshes/pebble.obj, vertices: 3000}
looks:
  dressed: {sample: cords, surface: pebble, plain: true}
scenes: {window: config/scenes/window.yaml}
film: {width: 48, height: 48, samples: 2}
"""
PAIRS = "theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n20,33,15,200\n50,121,0,0\n"


def start(cwd, cores):
    """Start the DAG in a process group of its own."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = [sys.executable, "-m", "snakemake", "--cores", str(cores), "--configfile", "my.yaml"]
    return subprocess.Popen(
        command,
        cwd=cwd,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def finish(process):
    """Wait for the DAG; its output."""
    text, _ = process.communicate(timeout=400)
    assert process.returncode == 0, text
    return text


def results(folder):
    """Bytes of every result that has no time in it."""
    suffixes = {".npz", ".zip", ".exr", ".png", ".md"}
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted((folder / "results").rglob("*"))
        if path.suffix in suffixes
    }


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two folders with the same work: one run with one core, one killed half-way and resumed with two."""
    folders = []
    for name in ("one", "two"):
        folder = tmp_path_factory.mktemp(name)
        for part in ("Snakefile", "workflow", "config", "profiles", "data-sample"):
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / part)
        (folder / "my.yaml").write_text(CONFIG)
        (folder / "pairs.csv").write_text(PAIRS)
        folders.append(folder)
    finish(start(folders[0], 1))
    killed = start(folders[1], 2)
    deadline = time.monotonic() + 300
    while not list(folders[1].glob("results/features/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    assert not list(folders[1].glob("results/pictures/*.png"))
    shutil.rmtree(folders[1] / ".snakemake/locks", ignore_errors=True)
    finish(start(folders[1], 2))
    return folders


def test_one_core_and_two_with_a_kill_between_give_the_same_bytes(runs):
    one, two = map(results, runs)
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []
    assert any(name.endswith(".exr") for name in one)


def test_second_run_does_nothing(runs):
    assert "Nothing to be done" in finish(start(runs[0], 2))


def test_changed_code_runs_its_stage_again(runs, tmp_path):
    # a copy of the package in front of the installed one, with a change in one room
    package = tmp_path / "btfpipe"
    shutil.copytree(ROOT / "btfpipe", package, ignore=shutil.ignore_patterns("__pycache__"))
    kernels = package / "rendering/kernels.py"
    kernels.write_text(kernels.read_text() + "\n# changed\n")
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--dry-run", "--cores", "1", "--configfile", "my.yaml"],
        cwd=runs[0],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    planned = set(re.findall(r"^(\w+) +\d+$", done.stdout, re.MULTILINE))
    assert {"render", "render_plain"} <= planned
    assert not {"ingest", "compress", "textons", "surface", "synthesize"} & planned
    assert "Params have changed" in done.stdout


def test_summaries_say_what_was_done_with_what(runs):
    for path in (runs[0] / "results/summaries").rglob("*.json"):
        summary = json.loads(path.read_text())
        assert {"stage", "btfpipe", "inputs", "parameters", "threads", "seconds"} <= summary.keys()
        assert all(len(thing["digest"]) == 12 for thing in summary["inputs"])


def test_table_of_errors_has_a_row_for_each_comparison(runs):
    table = (runs[0] / "results/fidelity.md").read_text().splitlines()
    # the model at its own pairs; sample and model at true directions, each with three interpolations
    assert len(table) == 2 + 1 + 2 * 3
