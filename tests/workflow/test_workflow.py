"""The DAG: refuses bad configs, plans the sample run, prints what it would run."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def snakemake(*args, cwd):
    """Run snakemake with the interpreter of the tests."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        [sys.executable, "-m", "snakemake", "--cores", "2", *map(str, args)],
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def workdir(tmp_path):
    """A copy of what the DAG needs, away from the checkout."""
    for name in ("Snakefile", "workflow", "config", "profiles", "data-sample"):
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    return tmp_path


def change(workdir, **entries):
    """Write a config that is the sample's with some entries replaced."""
    config = yaml.safe_load((workdir / "config/sample.yaml").read_text()) | entries
    path = workdir / "changed.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return path


def test_misspelt_key_is_refused_and_named(workdir):
    done = snakemake("--dry-run", "--configfile", change(workdir, sede=3), cwd=workdir)
    assert done.returncode == 1
    assert "sede" in done.stdout + done.stderr


def test_look_of_an_unknown_sample_is_refused_with_the_known_ones(workdir):
    looks = {"x": {"sample": "wool", "surface": "knot"}}
    done = snakemake("--dry-run", "--configfile", change(workdir, looks=looks), cwd=workdir)
    assert done.returncode == 1
    assert "looks.x.sample is 'wool'; expected one of weave, cords" in done.stdout + done.stderr


@pytest.mark.parametrize("name", ["sample", "gallery"])
def test_shipped_configs_plan_every_picture(workdir, name):
    path = f"config/{name}.yaml"
    done = snakemake("--dry-run", "--quiet", "rules", "--configfile", path, cwd=workdir)
    assert done.returncode == 0, done.stderr
    done = snakemake("--summary", "--configfile", path, cwd=workdir)
    config = yaml.safe_load((ROOT / path).read_text())
    for look in config["looks"]:
        for scene in config["scenes"]:
            assert f"/pictures/{look}.{scene}.png" in done.stdout


def test_commands_shown_by_the_dag_are_commands_of_the_program(workdir):
    from btfpipe.cli import STAGES

    path = "config/sample.yaml"
    done = snakemake("--dry-run", "--printshellcmds", "--configfile", path, cwd=workdir)
    shown = set(re.findall(r"^(?:Shell command: |\s*)btfpipe (\w+) ", done.stdout, re.MULTILINE))
    assert shown <= set(STAGES)
    assert {"ingest", "compress", "textons", "surface", "synthesize", "render"} <= shown


def test_memory_of_the_config_goes_to_every_command(workdir):
    for given, count in ({}, 0), ({"memory": "3.5G"}, 1):
        config = change(workdir, exports={"weave": ["ubo"]}, **given)
        done = snakemake("--dry-run", "--printshellcmds", "--configfile", config, cwd=workdir)
        commands = re.findall(
            r"^(?:Shell command: |\s*)btfpipe (\w+) (.*)", done.stdout, re.MULTILINE
        )
        used = {name for name, _ in commands}
        assert used >= {"ingest", "compress", "compare", "surface", "render", "preview", "export"}
        assert all(line.count("--memory 3.5G") == count for _, line in commands)
        assert all(line.count("--memory") == count for _, line in commands)


def test_memory_of_the_config_is_what_jobs_ask_for_and_makes_nothing_run_again(workdir):
    target = "results/sample/samples/weave.plain.npz"
    amounts = []
    for given in ({}, {"memory": "3.5G"}):
        config = change(workdir, **given)
        ask = (target, "--benchmark-extended", "--configfile", config)
        done = snakemake(*ask, cwd=workdir)
        assert done.returncode == 0, done.stdout + done.stderr
        if amounts:
            assert "Nothing to be done" in done.stdout + done.stderr
            done = snakemake(*ask, "--force", cwd=workdir)
        path = workdir / "results/sample/benchmarks/ingest_frontal/weave.jsonl"
        amounts.append(json.loads(path.read_text())["resources"]["mem_mb"])
    assert amounts == [1000, 500 + 3758]  # 3.5 GiB are 3758 MB


def test_memory_that_is_no_amount_is_refused(workdir):
    done = snakemake("--dry-run", "--configfile", change(workdir, memory="much"), cwd=workdir)
    assert done.returncode == 1
    assert "much" in done.stdout + done.stderr


def test_config_readme_lists_every_key():
    done = subprocess.run(
        [sys.executable, ROOT / "workflow/scripts/config_readme.py", "--check"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
