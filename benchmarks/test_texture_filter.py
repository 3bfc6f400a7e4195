"""Prefiltered look-ups against very many rays, and what they cost, on the weave of `make sample`.

A plane seen from above, one towards the horizon, and a close-up: 16 rays a pixel with and without the texture filter,
RMS difference from 1024 rays without it over their mean. Seconds are those of two runs, the faster, once levels are made.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from btfpipe.compression import compress
from btfpipe.formats.sources import open_source, recognise
from btfpipe.rendering.renderer import render
from btfpipe.rendering.scene import load_scene
from btfpipe.sample import Sample
from btfpipe.sample.ingest import ingest

WEAVE = Path(__file__).parent.parent / "data-sample" / "weave.zip"
TEXELS = (1, 1.5, 2, 3.1, 4.5, 4.7, 20)
HORIZON = {"type": "perspective", "position": [0, -2, 0.5], "target": [0.3, 0, 0.2], "up": [0, 0, 1], "fov_deg": 30}  # fmt: skip


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filter")
    with open_source(WEAVE, recognise(WEAVE)[0]) as measurement:
        ingest(measurement, folder / "sample.npz")
    sample = Sample.open(folder / "sample.npz")
    compress([sample], "svd", components=40).save(folder / "svd.npz")
    compress([sample], "coded", ratio=40, components=96).save(folder / "coded.npz")
    return folder


def plane(folder, model, texels, size=48, camera=None, lights=1):
    """A scene file of a plane with so many texels a pixel, or before a camera; under one light, or more from all sides."""
    scene = {
        "camera": camera or {
            "type": "orthographic", "position": [0.013, 0.027, 5], "target": [0.013, 0.027, 0],
            "height": size * texels / 100,
        },
        "film": {"width": size, "height": size},
        "lights": [{"type": "directional", "direction": [0.4, 0.5, 1], "irradiance": [3, 3, 3]}],
        "objects": [{
            "plane": {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [80, 80]},
            "model": str(folder / model), "texels_per_unit": 100,
        }],
    }  # fmt: skip
    if lights > 1:
        rng = np.random.default_rng(3)
        height, turn = rng.uniform(0.2, 1, lights), rng.uniform(0, 2 * np.pi, lights)
        across = np.sqrt(1 - height**2)
        towards = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
        scene["lights"] = [
            scene["lights"][0] | {"direction": d, "irradiance": [3 / lights] * 3}
            for d in towards.tolist()
        ]
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(scene))
    return path


def picture(path, samples, filtered, seed=0):
    """Layers, and seconds of the faster of two runs."""
    scene = load_scene(path, film={"samples": samples, "texture_filter": filtered}, threads=2)
    seconds = []
    for _ in range(1 if samples > 16 else 3):
        start = time.perf_counter()
        out = render(scene, seed=seed, threads=2)
        seconds.append(time.perf_counter() - start)
    return out, min(seconds)


def error(found, truth):
    inside = truth[..., 3] == 1
    found, truth = found[inside][:, :3], truth[inside][:, :3]
    return np.sqrt(((found - truth) ** 2).mean()) / truth.mean()


def compare(name, path):
    """Prints a row of the table; returns the error with the filter, and its time over that without."""
    truth, _ = picture(path, 1024, False, seed=7)
    without, plain = picture(path, 16, False)
    found, seconds = picture(path, 16, True)
    bias = found[..., :3].mean() / truth[..., :3].mean() - 1
    say(
        f"{name}: {100 * error(without, truth):.1f} % without, {100 * error(found, truth):.2f} % with the filter,"
        f" mean {100 * bias:+.2f} %, {seconds / plain:.2f} times the time"
    )
    return error(found, truth), seconds / plain


@pytest.mark.parametrize("model", ["coded.npz", "svd.npz", "sample.npz"])
def test_a_plane_from_above(folder, model):
    say("")
    for texels in TEXELS:
        found, times = compare(f"{model} {texels} texels a pixel", plane(folder, model, texels))
        assert times < 8
        assert found <= 0.02 or texels < 1.5


@pytest.mark.parametrize(("model", "lights"), [("coded.npz", 1), ("coded.npz", 24), ("svd.npz", 1)])
def test_a_plane_towards_the_horizon(folder, model, lights):
    say("")
    path = plane(folder, model, 0, 64, HORIZON, lights)
    found, times = compare(f"{model} horizon, {lights} lights", path)
    assert found <= 0.02
    assert times < 10


def test_a_plane_from_above_under_many_lights(folder):
    say("")
    path = plane(folder, "coded.npz", 4.5, lights=24)
    found, times = compare("coded.npz 4.5 texels a pixel, 24 lights", path)
    assert found <= 0.02
    assert times < 8


def test_a_close_up_costs_nothing(folder):
    say("")
    _, times = compare("coded.npz close up", plane(folder, "coded.npz", 0.4, 256))
    assert times < 1.1
