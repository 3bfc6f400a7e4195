"""Fixtures that every test may use. Scenes are tiny and made in code."""

import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner


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
