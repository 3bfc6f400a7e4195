"""Shading from factors in colour spaces against decoding in vectorised numpy and against the SVD, timed in turns."""

import sys
import time

import numpy as np

from btfpipe.compression.factored import FactoredModel
from btfpipe.compression.svd import SvdModel
from btfpipe.directions import bonn81, from_angles
from btfpipe.parallel import single_threaded_blas
from btfpipe.sample import Sample

SIDE, TERMS, POINTS, BLOCK = 128, (32, 16, 16), 40_000, 5_000


def numpy_shade(model, pairs, row, col, w_i, w_o, out):
    """Decode 9 pairs at 4 texels each, then blend; the kernel's own pairs and shares are given to it."""
    texture = [np.asarray(t, np.float32) for t in model.texture_factors]
    angular = [np.asarray(a, np.float32) for a in model.angular_factors]
    for part, pair, share in pairs.blocks(w_i, w_o):
        for start in range(0, len(pair), BLOCK):
            some = slice(start, start + BLOCK)
            y, x = row[part][some], col[part][some]
            i, j = y.astype(int), x.astype(int)
            total = 0
            for di, dj in np.ndindex(2, 2):
                weight = abs(1 - di - (y - i)) * abs(1 - dj - (x - j))
                a, b, c = (
                    np.einsum("npk,nk->np", v[pair[some]], t[i + di, j + dj])
                    for v, t in zip(angular, texture, strict=True)
                )
                y_ = np.exp(a)
                u, v, y_ = b * y_, c * y_, y_ - np.float32(1e-5)
                rgb = np.stack(
                    [y_ + 1.13983 * v, y_ - 0.39465 * u - 0.5806 * v, y_ + 2.03211 * u], axis=-1
                )
                total = total + weight[:, None] * np.einsum("np,npc->nc", share[some], rgb)
            out[part][some] = total


def test_shading_in_a_logarithmic_space(benchmark):
    rng = np.random.default_rng(8)
    directions, pair = bonn81(), np.arange(6561)
    tiny = Sample(
        np.zeros((6561, 1, 1, 3), np.uint8), directions, directions, pair % 81, pair // 81
    )

    def factors(*shape):
        return [0.3 * rng.standard_normal((*shape, k), np.float32) for k in TERMS]

    log, linear = (
        FactoredModel(factors(6561), factors(SIDE, SIDE), space, tiny)
        for space in ("log_y_uv_over_y", "yuv")
    )
    svd = SvdModel(
        rng.standard_normal((SIDE, SIDE, 40), np.float32),
        rng.standard_normal((6561, 3, 40), np.float32),
        tiny,
    )
    row, col = (rng.random((2, POINTS)) * (SIDE - 1)).astype(np.float32)
    w_i, w_o = (
        from_angles(*(rng.random((2, POINTS)) * [[1.2], [6.28]])).astype(np.float32)
        for _ in range(2)
    )
    query = (row, col, w_i, w_o)
    shaders = {"log": log.shader(), "yuv": linear.shader(), "svd": svd.shader()}
    calls = {name: shader.shade for name, shader in shaders.items()}
    calls["numpy"] = lambda *args: numpy_shade(log, shaders["log"].pairs, *args)
    out = {name: np.zeros((POINTS, 3), np.float32) for name in calls}
    best = dict.fromkeys(calls, np.inf)
    with single_threaded_blas():
        for turn in range(4):  # the first compiles
            for name, call in calls.items():
                start = time.perf_counter()
                call(*query, out[name])
                if turn > 0:
                    best[name] = min(best[name], time.perf_counter() - start)
        benchmark.pedantic(calls["log"], (*query, out["log"]), rounds=1)
    np.testing.assert_allclose(out["log"], out["numpy"], rtol=1e-3, atol=1e-3)
    ratios = {name: best[name] / best["log"] for name in calls}
    benchmark.extra_info.update(ratios)
    sys.stdout.write(
        f"\nfactored {TERMS}, log_y_uv_over_y: {POINTS / best['log'] / 1e6:.2f} M/s,"
        f" {ratios['numpy']:.1f} times numpy; yuv is {1 / ratios['yuv']:.1f} times as fast,"
        f" SVD-40 {1 / ratios['svd']:.1f}\n"
    )
