"""Double spherical harmonics against least squares per texel, their shading, and the frequency-domain light, in one run.

The sample is made in code: 81 x 81 pairs of smooth lobes, cosines and noise, as 8-bit codes. Least squares per texel is
`numpy.linalg.lstsq` twice, over the values of all channels at once. The fits are timed on the same texels, one in 32, from
linear values in memory, on one thread; the whole has everything in it: reading, codes, and the error.
"""

import sys
import time

import numpy as np
import pytest

from btfpipe import store
from btfpipe.compression.harmonics import _COLS, _Fit, compress_harmonics
from btfpipe.directions import bonn81, from_angles
from btfpipe.directions.spherical_harmonics import spherical_harmonics
from btfpipe.parallel import available_threads, blocks, single_threaded_blas
from btfpipe.rendering.harmonic_light import HarmonicEnvironment
from btfpipe.sample import Sample, encode

SIDE, PAIRS, TERMS, LOBES = 128, 6561, 25, 24
ONE_IN = 32  # texels that the fits are timed on
ROUNDS = 3


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write("\n" + line)


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """A Sample file of the full Bonn set."""
    path = tmp_path_factory.mktemp("harmonics") / "s.npz"
    rng = np.random.default_rng(2007)
    directions = bonn81()
    axes = rng.standard_normal((2, LOBES, 3)) + np.array([0, 0, 2])
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    light, view = (np.exp(4 * (directions @ a.T - 1)) for a in axes)
    weights = np.einsum("vn,ln->vln", view, light * directions[:, 2:]).reshape(PAIRS, LOBES)
    texture = rng.random((LOBES, SIDE * SIDE * 3), np.float32) / 4
    pair = np.arange(PAIRS)
    small = Sample(
        np.zeros((PAIRS, 1, 1, 3), np.uint8),
        directions, directions, pair % 81, pair // 81, transfer="gamma2.2", toroidal=True,
    )  # fmt: skip
    with store.create(path, "sample", **small.facts()) as writer:
        small.write_tables(writer)
        with writer.stream("pictures", (PAIRS, SIDE, SIDE, 3), np.uint8) as put:
            for some in blocks(PAIRS, 81):
                values = weights[some].astype(np.float32) @ texture
                values += 0.01 * rng.standard_normal(values.shape, np.float32)
                put(np.round(255 * encode(np.clip(values, 0, 1), "gamma2.2")))
    return Sample.open(path)


def least_squares(values, basis):
    """Coefficients (terms, terms, 3) of one texel's values (views, lights, 3), without a constraint."""
    by_light = np.linalg.lstsq(basis, values.reshape(81, -1), rcond=None)[0]
    by_light = by_light.reshape(TERMS, 81, 3).swapaxes(0, 1).reshape(81, -1)
    return np.linalg.lstsq(basis, by_light, rcond=None)[0].reshape(TERMS, TERMS, 3)


def seconds(function, *args, **kwargs):
    start = time.perf_counter()
    function(*args, **kwargs)
    return time.perf_counter() - start


def test_compression_is_many_times_faster_than_least_squares_per_texel(benchmark, sample):
    threads = available_threads()
    chosen = np.arange(0, SIDE * SIDE, ONE_IN)
    texels = sample.texels(*np.divmod(chosen, SIDE)).reshape(-1, 81, 81, 3)
    basis = spherical_harmonics(bonn81(), TERMS).astype(np.float32)

    # as scan lines come: (views, lights, texels * 3), 32 texels at a time
    lines = [
        np.ascontiguousarray(texels[part].transpose(1, 2, 0, 3)).reshape(81, 81, -1)
        for part in blocks(len(texels), _COLS)
    ]
    fits = {
        name: [_Fit(bonn81(), TERMS, what, penalty) for what in ("views", "lights")]
        for name, penalty in (("fixed", 1e-3), ("search", None))
    }

    def per_texel():
        for values in texels:
            least_squares(values, basis)

    def by_line(fits):
        for values in lines:
            by_light = fits[0].apply(values.reshape(1, 81, -1)).reshape(TERMS, 81, -1)
            fits[1].apply(by_light)

    compress_harmonics(sample, 4, 4, threads=threads)  # compiles
    times = {name: [] for name in ("least_squares", "fixed", "search", "whole")}
    for _ in range(ROUNDS):
        with single_threaded_blas():
            times["least_squares"].append(seconds(per_texel) * ONE_IN)
            for name, pair in fits.items():
                times[name].append(seconds(by_line, pair) * ONE_IN)
        times["whole"].append(seconds(compress_harmonics, sample, threads=threads))
    model = benchmark.pedantic(compress_harmonics, (sample,), {"threads": threads}, rounds=1)
    best = {name: min(some) for name, some in times.items()}
    facts = {f"{name}_seconds": value for name, value in best.items()} | {
        "ratio_fixed": best["least_squares"] / best["fixed"],
        "ratio_search": best["least_squares"] / best["search"],
        "bytes_ratio": 3 * PAIRS * SIDE * SIDE / model.nbytes,
        "relative_error": model.about["relative_error"],
    }
    benchmark.extra_info |= facts
    say("128 x 128 x 6561, 25 x 25: " + ", ".join(f"{k} {v:.4g}" for k, v in facts.items()))


def test_shading_and_frequency_domain_light(benchmark, sample):
    model = compress_harmonics(sample, threads=available_threads())
    rng = np.random.default_rng(1)
    n = 100_000
    row, col = (SIDE * rng.random((2, n))).astype(np.float32)
    w_i, w_o = (
        from_angles(np.arccos(rng.random(n)), 2 * np.pi * rng.random(n)).astype(np.float32)
        for _ in range(2)
    )
    frames = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    frames = (frames * np.linalg.det(frames)[:, None, None]).astype(np.float32)
    out = np.empty((n, 3), np.float32)
    shader = model.shader()
    sky = HarmonicEnvironment(model, rng.standard_normal((169, 3)))
    shader.shade(row, col, w_i, w_o, out)
    sky.shade(row, col, frames, w_o, out)
    light = min(seconds(shader.shade, row, col, w_i, w_o, out) for _ in range(ROUNDS))
    environment = min(seconds(sky.shade, row, col, frames, w_o, out) for _ in range(ROUNDS))
    benchmark.pedantic(shader.shade, (row, col, w_i, w_o, out), rounds=1)
    facts = {
        "one_light_million_per_second": n / light / 1e6,
        "environment_169_million_per_second": n / environment / 1e6,
    }
    benchmark.extra_info |= facts
    say("one thread: " + ", ".join(f"{k} {v:.3g}" for k, v in facts.items()))
