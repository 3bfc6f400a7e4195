"""Fixtures that every test may use. Scenes are tiny and made in code."""

import contextlib
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import settings

# Every run of the tests tries the same examples, so that what passes here passes elsewhere; `make fuzz` looks for others.
settings.register_profile("same", derandomize=True)
settings.register_profile("other", print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


@pytest.fixture
def rng():
    return np.random.default_rng(20021202)


@pytest.fixture
def btfpipe():
    """Run the command line in this process; stdout and stderr are kept apart."""
    from btfpipe.cli import main

    def run(*args, code=0):
        result = CliRunner().invoke(main, [str(a) for a in args])
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == code, (result.exit_code, result.output)
        return result

    return run


@pytest.fixture
def peak_bytes():
    """``with peak_bytes() as peak:`` and then ``peak[0]`` is the most that Python and numpy held at once inside."""

    @contextlib.contextmanager
    def watch():
        peak = []
        tracemalloc.start()
        try:
            yield peak
            peak.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()

    return watch


@pytest.fixture(scope="session")
def measured_data():
    """Folder of measured data (BTFPIPE_DATA); tests that need it are skipped without it."""
    folder = os.environ.get("BTFPIPE_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("needs measured data: set BTFPIPE_DATA to their folder")
    return Path(folder)


@pytest.fixture
def make_sample():
    """Make a small product Sample with smooth, view- and light-dependent texture."""
    from btfpipe.directions import bonn81
    from btfpipe.sample import Sample

    def make(rows=16, cols=20, lights=None, views=None, dtype=np.float32, seed=1, **kwargs):
        rng = np.random.default_rng(seed)
        lights = bonn81()[:19] if lights is None else lights
        views = bonn81()[:7] if views is None else views
        texture = rng.random((rows, cols, 3))
        tilt = rng.normal(scale=0.2, size=(rows, cols, 2))
        n_lights, n_views = len(lights), len(views)
        value = np.clip(
            lights[:, 2, None, None] + np.einsum("ld,rcd->lrc", lights[:, :2], tilt), 0, None
        )
        shift = 1 + 0.3 * np.einsum("vd,rcd->vrc", views[:, :2], tilt)
        pictures = value[None, ..., None] * shift[:, None, ..., None] * texture
        pictures = pictures.reshape(n_views * n_lights, rows, cols, 3)
        if dtype == np.uint8:
            codes = np.clip(pictures * 255 + 0.5, 0, 255).astype(np.uint8)
        else:
            codes = pictures.astype(dtype)
        pair = np.arange(n_views * n_lights)
        return Sample(codes, lights, views, pair % n_lights, pair // n_lights, **kwargs)

    return make


@pytest.fixture
def make_measurement(tmp_path):
    """Write a tiny set in Bonn's layout as a zip or folder.

    Returns its path and the codes (views, lights, rows, cols, 3). ``change(members)`` may spoil the dict of
    names and bytes before it is packed.
    """
    import zipfile

    from btfpipe.formats.images import encode_picture
    from btfpipe.formats.ubo import pair_name

    def make(
        name="set.zip",
        lights=((0, 0), (30, 0), (30, 90)),
        views=((0, 0), (45, 180)),
        shape=(6, 8),
        suffix=".png",
        dtype=np.uint8,
        seed=1,
        change=None,
    ):
        rng = np.random.default_rng(seed)
        size = (len(views), len(lights), *shape, 3)
        if np.dtype(dtype).kind == "f":
            codes = (rng.random(size) * 4).astype(dtype)
        else:
            codes = rng.integers(0, np.iinfo(dtype).max, size, dtype)
        members = {
            pair_name(len(views) * n + v, light, view, suffix): encode_picture(codes[v, n], suffix)
            for v, view in enumerate(views)
            for n, light in enumerate(lights)
        }
        if change is not None:
            change(members)
        path = tmp_path / name
        if path.suffix == ".zip":
            with zipfile.ZipFile(path, "w") as archive:
                for member, data in members.items():
                    archive.writestr(member, data)
        else:
            for member, data in members.items():
                (path / member).parent.mkdir(parents=True, exist_ok=True)
                (path / member).write_bytes(data)
        return path, codes

    return make


def pytest_collection_modifyitems(items):
    """Order files for processes side by side.

    The longest ones, of the workflow, come first, so that no process waits for another at the end. Then files of far
    folders take turns: two processes in one folder would compile the same kernels twice.
    """
    files = {}
    for item in sorted(items, key=lambda item: item.path.parent.name != "workflow"):
        files.setdefault(item.path, []).append(item)
    files = list(files.values())
    half = (len(files) + 1) // 2
    order = [None] * len(files)
    order[::2], order[1::2] = files[:half], files[half:]
    items[:] = [item for file in order for item in file]
