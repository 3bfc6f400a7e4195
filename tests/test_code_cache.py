"""Compiled code is that of the sources as they are; its folders are shared, held and removed as they should be."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from btfpipe import code_cache

PACKAGE = Path(code_cache.__file__).parent

# One triangle, whose edges are steps of a sample laid along them; whether the kernel finds them so.
ASK = """
import numpy as np
from btfpipe.synthesis.coherence import find_coherent
vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
up, right = (np.tile(np.float32(axis), (3, 1)) for axis in ([0, 0, 1], [1, 0, 0]))
found = np.zeros(1, bool)
find_coherent(
    vertices, np.array([[0, 1, 2]], np.int32), up, right, np.float32([0, 0, -1]), np.float32([0, 1, 0]), 1.0, 8, 8,
    False, found,
)
print(found[0])
"""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A copy of the package without compiled code, and a function that runs a program on it."""
    for name in ("BTFPIPE_CACHE", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, tmp_path / "btfpipe", ignore=ignored)

    def run(program, **environment):
        return subprocess.run(
            [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True,
            env=os.environ | {"PYTHONPATH": str(tmp_path), "HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": ""} | environment,
        )  # fmt: skip

    return tmp_path / "btfpipe", run


def folders(place):
    return sorted(path.name for path in place.glob("*") if code_cache._NAMES.fullmatch(path.name))


def test_a_helper_in_another_file_changes_the_kernels_that_it_was_compiled_into(checkout):
    package, run = checkout
    assert run(ASK).stdout == "True\n"
    helper = package / "sample" / "orientation.py"
    source = helper.read_text()
    line = "return ds * sine - dt * cosine, ds * cosine + dt * sine"
    assert source.count(line) == 1
    kernels = {path: path.read_bytes() for path in (package / "synthesis").glob("*.py")}
    helper.write_text(source.replace(line, line.replace("sine - dt", "sine + dt")))
    assert run(ASK).stdout == "False\n"
    helper.write_text(source)
    assert run(ASK).stdout == "True\n"
    assert all(path.read_bytes() == before for path, before in kernels.items())
    # beside the package, a folder for either state; with nothing left elsewhere
    assert len(folders(package / "__pycache__")) == 2
    assert not list((package / "synthesis" / "__pycache__").glob("*.nb?"))
    assert not (package.parent / "home").exists()


HOLD = "import sys; from btfpipe.code_cache import cache_folder; print(cache_folder(), flush=True);"


def test_a_package_that_cannot_be_written_uses_the_users_cache(checkout):
    package, run = checkout
    (package / "__pycache__").write_text("in the way of a folder")
    home = package.parent / "home"
    assert Path(run(HOLD).stdout.strip()).parent == home / ".cache" / "btfpipe"
    elsewhere = package.parent / "xdg"
    done = run(HOLD, XDG_CACHE_HOME=str(elsewhere))
    assert Path(done.stdout.strip()).parent == elsewhere / "btfpipe"
    assert done.stderr == ""


def test_nothing_that_can_be_written_is_one_warning_and_kernels_work(checkout):
    package, run = checkout
    (package / "__pycache__").write_text("in the way of a folder")
    (package.parent / "home").write_text("in the way, too")
    done = run("from btfpipe.hashing import uniform; print(0 <= uniform(1, 2, 3) < 1)")
    assert done.stdout == "True\n"
    assert done.stderr.count("RuntimeWarning: compiled code cannot be kept") == 1
    assert "BTFPIPE_CACHE" in done.stderr


def test_the_environment_names_the_place(checkout):
    package, run = checkout
    one, two = package.parent / "one", package.parent / "two"
    assert Path(run(HOLD, NUMBA_CACHE_DIR=str(one)).stdout.strip()).parent == one
    both = {"NUMBA_CACHE_DIR": str(one), "BTFPIPE_CACHE": str(two)}
    assert Path(run(HOLD, **both).stdout.strip()).parent == two
    assert len(folders(one)) == len(folders(two)) == 1
    assert not folders(package / "__pycache__")


def test_other_packages_kernels_stay_where_they_are():
    import numba

    from btfpipe import compiled

    before = numba.config.CACHE_DIR
    compiled.njit(cache=True)(_nothing)
    assert before == numba.config.CACHE_DIR


def _nothing():
    return None


def _make_old(place, copy, count, age):
    """Folders of a copy of the package, last used so many seconds ago, the first longest."""
    made = [place / f"{copy}-{i:012x}" for i in range(count)]
    for i, folder in enumerate(made):
        (folder / "analysis").mkdir(parents=True)
        lock = folder / "held"
        lock.touch()
        used = time.time() - age - 10 * (count - i)
        os.utime(lock, (used, used))
    return made


def test_old_folders_go_when_a_new_one_is_made(tmp_path, monkeypatch):
    monkeypatch.setenv("BTFPIPE_CACHE", str(tmp_path))
    own = _make_old(tmp_path, code_cache._copy(), 6, 3600)
    others = _make_old(tmp_path, "0123abcd", 2, 3600)
    forgotten = _make_old(tmp_path, "4567abcd", 2, 40 * 24 * 3600)
    half = tmp_path / "4567abcd-000000000009.old-17"
    half.mkdir()
    stranger = tmp_path / "mine"
    stranger.mkdir()
    new = code_cache.cache_folder()
    assert [folder.exists() for folder in own] == 3 * [False] + 3 * [True]
    assert all(folder.exists() for folder in [*others, new, stranger])
    assert not any(folder.exists() for folder in [*forgotten, half])
    # made once: the next process removes nothing
    shutil.move(own[-1], own[0])
    assert code_cache.cache_folder() == new
    assert own[0].exists()


def test_a_folder_that_another_process_holds_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("BTFPIPE_CACHE", str(tmp_path))
    (held, *_rest) = own = _make_old(tmp_path, code_cache._copy(), 5, 3600)
    holder = subprocess.Popen(
        [sys.executable, "-c",
         "import sys; from pathlib import Path; from btfpipe import code_cache;"
         "code_cache._hold(Path(sys.argv[1])); print(flush=True); sys.stdin.read()", str(held)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        holder.stdout.readline()
        used = time.time() - 7200
        os.utime(held / "held", (used, used))
        code_cache.cache_folder()
        assert [folder.exists() for folder in own] == [True, False, True, True, True]
    finally:
        holder.stdin.close()
        holder.wait(30)
        holder.stdout.close()
    shutil.rmtree(code_cache.cache_folder())
    code_cache.cache_folder()
    assert not held.exists()


def test_processes_that_start_together_share_a_folder_whatever_is_removed(tmp_path):
    """Makers and removers of the same few folders at once: all end, each with a folder that is there."""
    program = (
        "import sys, os; from pathlib import Path; from btfpipe import code_cache\n"
        "place, me = Path(sys.argv[1]), int(sys.argv[2])\n"
        "for turn in range(40):\n"
        "    folder = place / f'00000000-{(turn + me) % 3:012x}'\n"
        "    code_cache._hold(folder)\n"
        "    assert (folder / 'held').exists()\n"
        "    for other in range(3):\n"
        "        code_cache._remove(place / f'00000000-{other:012x}', 0)\n"
        "    assert (folder / 'held').exists()\n"
    )
    jobs = [
        subprocess.Popen([sys.executable, "-c", program, tmp_path, str(i)], stderr=subprocess.PIPE)
        for i in range(4)
    ]
    for job in jobs:
        _, said = job.communicate(timeout=60)
        assert job.returncode == 0, said.decode()


def test_the_digest_tells_every_module_and_takes_no_time(checkout):
    package, run = checkout
    program = "from btfpipe.provenance import code_digest; print(code_digest())"
    seen = {run(program).stdout}
    for path in (package / "__init__.py", package / "sample" / "orientation.py"):
        path.write_text(path.read_text() + "# another\n")
        seen.add(run(program).stdout)
    (package / "sample" / "orientation.py").rename(package / "sample" / "orientations.py")
    seen.add(run(program).stdout)
    assert len(seen) == 4
    took = []
    for _ in range(5):
        start = time.perf_counter()
        code_cache.code_digest()
        took.append(time.perf_counter() - start)
    assert min(took) < 0.03


def test_kernels_are_declared_through_the_module_that_keeps_their_code():
    for path in PACKAGE.rglob("*.py"):
        if path.name != "compiled.py":
            for line in path.read_text().splitlines():
                found = line.startswith("from numba import") and "jit" in line
                assert not found, f"{path.name}: {line}"
