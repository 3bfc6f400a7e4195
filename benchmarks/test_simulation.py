"""Simulation: the whole of Bonn's 81 x 81 in one run, and what sharing the eye's rays between lights gains."""

import time
from pathlib import Path

import numpy as np
import pytest

from btfpipe.directions import bonn81
from btfpipe.parallel import available_threads
from btfpipe.simulation.campaign import capture, display
from btfpipe.simulation.goniometer import Goniometer
from btfpipe.simulation.materials import build_patch
from btfpipe.simulation.spec import read_spec

WEAVE = Path(__file__).parents[1] / "data-sample" / "weave.yaml"


@pytest.fixture(scope="module")
def patch():
    return build_patch(read_spec(WEAVE), None)


def test_whole_measurement_81_by_81(benchmark, patch):
    """64 x 64 texels, 4 samples, 6561 pictures encoded as JPEG; the target is under 4 minutes on two cores."""
    from btfpipe.formats.images import encode_picture

    directions, shown = bonn81(), display("jpeg", 1.0)
    pair = np.arange(81 * 81)
    pairs = np.stack([pair // 81, pair % 81], axis=1)

    def measure():
        goniometer = Goniometer(patch, threads=available_threads())
        finished = capture(
            goniometer, directions, directions, pairs,
            lambda picture: encode_picture(shown.encode(picture)[0], ".jpg"), available_threads(),
        )  # fmt: skip
        assert sum(1 for _ in finished) == 6561

    benchmark.pedantic(measure, rounds=1, iterations=1)


def test_lights_share_the_rays_of_a_view(benchmark, patch):
    """All lights of a view at once against pair after pair, on one thread; ratio of interleaved minima."""
    goniometer = Goniometer(patch)
    lights = bonn81()
    lit = goniometer.light(lights)
    view = lights[40]
    goniometer.pictures(view, lit, [0])
    seconds = {"shared": [], "pair by pair": []}
    for _ in range(3):
        start = time.perf_counter()
        goniometer.pictures(view, lit, range(81))
        seconds["shared"].append(time.perf_counter() - start)
        start = time.perf_counter()
        for light in range(81):
            goniometer.pictures(view, lit, [light])
        seconds["pair by pair"].append(time.perf_counter() - start)
    best = {name: min(times) for name, times in seconds.items()}
    ratio = best["pair by pair"] / best["shared"]
    rays = 81 * patch.shape[0] * patch.shape[1] * goniometer.samples
    benchmark.extra_info.update(
        ratio=round(ratio, 2), shadow_rays_per_second=round(rays / best["shared"])
    )
    print(f"\n81 lights of one view, 64 x 64 x 4 rays: shared {best['shared']:.2f} s,")  # noqa: T201
    print(f"pair by pair {best['pair by pair']:.2f} s, ratio {ratio:.1f}")  # noqa: T201
    benchmark.pedantic(goniometer.pictures, (view, lit, range(81)), rounds=3)
