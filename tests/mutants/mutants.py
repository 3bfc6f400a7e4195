"""Apply each change of `mutants.yaml` to a copy of the package, and see the tests named for it fail.

``python tests/mutants/mutants.py [WORDS ...]``: only the changes whose name or file holds one of the words. Exit code 1 if a change
survives or a test fails without one, 2 if the list is wrong.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("mutants.yaml")
_COPIED = ("btfpipe", "tests", "pyproject.toml")
_KEYS = {"name", "file", "old", "new", "tests"}
# how pytest's summary ends where a comparison did not hold; anything else is a change that merely crashes
_COMPARED = re.compile(r"- (AssertionError|assert |Failed: |RuntimeWarning: Mean of empty slice)")


def read_mutants(path=LIST):
    """The entries of the list, as dicts."""
    return yaml.safe_load(path.read_text())


def problems(mutant, root=ROOT):
    """What is wrong with an entry, as sentences; empty if it can be applied."""
    if set(mutant) != _KEYS:
        return [f"{mutant.get('name')}: has {sorted(mutant)}; expected {sorted(_KEYS)}."]
    found = []
    path = root / mutant["file"]
    count = path.read_text().count(mutant["old"]) if path.is_file() else 0
    if count != 1:
        found.append(
            f"{mutant['name']}: {mutant['old'].strip()!r} stands {count} times in {mutant['file']}; expected once."
        )
    if mutant["old"] == mutant["new"]:
        found.append(f"{mutant['name']}: changes nothing.")
    for test in mutant["tests"]:
        file, _, name = test.partition("::")
        source = (root / file).read_text() if (root / file).is_file() else ""
        if not re.search(rf"^def {re.escape(name)}\(", source, re.MULTILINE):
            found.append(f"{mutant['name']}: there is no test {test}.")
    if not mutant["tests"]:
        found.append(f"{mutant['name']}: names no test.")
    return found


def survivors(mutant, root):
    """Tests named for a change that did not fail by a comparison in the tree `root`, and pytest's output."""
    run = _pytest(mutant["tests"], root)
    failed = [line for line in run.stdout.splitlines() if line.startswith("FAILED ")]
    if run.returncode not in (0, 1):
        return mutant["tests"], run.stdout + run.stderr
    left = [
        test
        for test in mutant["tests"]
        if not any(
            re.match(rf"FAILED {re.escape(test)}(\[| )", line) and _COMPARED.search(line)
            for line in failed
        )
    ]
    return left, run.stdout + run.stderr


def _pytest(tests, root):
    """Run tests of a tree that imports its own package, with compiled code of its own."""
    environment = os.environ | {
        "PYTHONPATH": str(root),
        "NUMBA_CACHE_DIR": str(root / "numba"),
        "COLUMNS": "400",
    }
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-p", "no:cacheprovider", *tests],
        cwd=root, env=environment, capture_output=True, text=True,
    )  # fmt: skip


def _copy(root, target):
    ignored = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    for name in _COPIED:
        source = root / name
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=ignored)
        else:
            shutil.copy(source, target / name)


def _try(mutant):
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        root = Path(folder)
        _copy(ROOT, root)
        path = root / mutant["file"]
        path.write_text(path.read_text().replace(mutant["old"], mutant["new"]))
        return survivors(mutant, root)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*")
    words = parser.parse_args().words
    listed = read_mutants()
    wrong = [sentence for mutant in listed for sentence in problems(mutant)]
    if wrong:
        _fail(wrong, 2)
    chosen = [m for m in listed if not words or any(w in m["name"] + m["file"] for w in words)]
    tests = sorted({test for mutant in chosen for test in mutant["tests"]})
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        _copy(ROOT, Path(folder))
        run = _pytest(tests, Path(folder))
        if run.returncode:
            _fail([run.stdout, "these fail without any change."], 1)
    lived = []
    for mutant in chosen:
        left, output = _try(mutant)
        print(f"{'LIVES ' if left else 'killed'}  {mutant['file']}: {mutant['name']}", flush=True)
        if left:
            lived.append(mutant["name"])
            print(f"{output}\nnot failed: {', '.join(left)}", flush=True)
    print(f"{len(chosen) - len(lived)} of {len(chosen)} killed")
    sys.exit(1 if lived else 0)


def _fail(sentences, code):
    print("\n".join(sentences), file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    main()
