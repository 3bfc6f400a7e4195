"""The transform codec against plain SVD at equal bytes, and what its shading costs.

The sample is made in code: 64 x 64 texels of a relief of two yarns with shadows, occlusion and gloss under 81 lights
and 81 views, as 8-bit codes. Ratios are of the uncompressed bytes to the files' true sizes.
"""

import sys
import time

import numpy as np

from btfpipe.compression.coded import compress_coded
from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81, from_angles
from btfpipe.metrics import raw_bytes
from btfpipe.metrics.comparison import compare
from btfpipe.parallel import available_threads
from btfpipe.sample import Sample, encode

SIDE = 64
RATIOS = (25, 50, 100, 200, 400)
MOST_QUERIES = 4.2  # of an SVD of 40 terms that one may cost: one and a half times what was read


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write("\n" + line)


def relief_sample():
    """A toroidal Sample whose pictures have detail that moves with light and view, as cloth's have."""
    rng = np.random.default_rng(81)
    directions = bonn81()
    row, col = np.indices((SIDE, SIDE))
    threads = np.sin(row * np.pi / 4) * np.sin(col * np.pi / 4)
    height = threads + 0.25 * rng.standard_normal((SIDE, SIDE))
    slope = [(np.roll(height, -1, axis) - np.roll(height, 1, axis)) / 2 for axis in (1, 0)]
    normal = np.stack([-slope[0], slope[1], np.ones_like(height)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    yarn = np.where((threads > 0)[..., None], [0.7, 0.45, 0.2], [0.08, 0.2, 0.3])
    yarn = yarn * rng.uniform(0.7, 1.3, (SIDE, SIDE, 1))
    # how high the relief stands towards each direction, within three texels
    horizon = np.full((81, SIDE, SIDE), -9.0)
    for n, (s, t, up) in enumerate(directions):
        length = max(np.hypot(s, t), 1e-9)
        for step in (1, 2, 3):
            shift = (round(step * t / length), -round(step * s / length))
            rise = np.roll(height, shift, (0, 1)) - height
            horizon[n] = np.maximum(horizon[n], rise / step - up / length)
    visible = 1 / (1 + np.exp(6 * horizon))
    lambert = np.clip(np.einsum("ld,rcd->lrc", directions, normal), 0, None) * visible
    codes = np.empty((81, 81, SIDE, SIDE, 3), np.uint8)
    for v in range(81):
        half = directions + directions[v]
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        gloss = np.clip(np.einsum("ld,rcd->lrc", half, normal), 0, None) ** 25
        values = lambert[..., None] * (yarn + 0.25 * gloss[..., None])
        values *= 0.4 + 0.6 * visible[v][..., None]
        codes[v] = np.round(255 * encode(np.clip(values, 0, 1), "srgb"))
    pair = np.arange(6561)
    return Sample(
        codes.reshape(-1, SIDE, SIDE, 3), directions, directions, pair % 81, pair // 81,
        transfer="srgb", absolute=True, toroidal=True,
    )  # fmt: skip


def seconds(call):
    """A call's result and how long it took."""
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


def shading_time(model, rng_seed=5, n=20_000):
    """Microseconds a query of the Model's shader, best of five."""
    rng = np.random.default_rng(rng_seed)
    row, col = (rng.random((2, n)) * SIDE).astype(np.float32)
    w = rng.normal(size=(2, n, 3))
    w[..., 2] = np.abs(w[..., 2])
    w_i, w_o = (w / np.linalg.norm(w, axis=2, keepdims=True)).astype(np.float32)
    out = np.empty((n, 3), np.float32)
    shader = model.shader()
    shader.shade(row, col, w_i, w_o, out)  # compiles
    return (
        min(seconds(lambda: shader.shade(row, col, w_i, w_o, out))[1] for _ in range(5)) / n * 1e6
    )


def neighbouring_queries(n, seed=6):
    """What a picture under one light asks for: directions that change little from one pixel to the next."""
    rng = np.random.default_rng(seed)
    at = np.linspace(0, n / 200_000, n)
    row, col = (
        (np.repeat(rng.random(n // 50) * SIDE, 50) + np.tile(np.arange(50) * 0.1, n // 50)) % SIDE
        for _ in range(2)
    )
    w_i = from_angles(0.2 + 0.8 * at, 40 * at)
    w_o = from_angles(1.0 - 0.7 * at, 3 + 25 * at)
    return [np.ascontiguousarray(a, np.float32) for a in (row, col, w_i, w_o)]


def test_a_query_under_one_light_costs_few_of_an_svd_of_40_terms(benchmark):
    """In turns, so that a ratio is of one and the same moment; the best of many short rounds."""
    sample = relief_sample()
    threads = available_threads()
    shaders = {
        "svd-40": compress_svd(sample, 40, threads=threads).shader(),
        "coded": compress_coded(sample, threads=threads).shader(),
    }
    n = 2000
    queries, out = neighbouring_queries(n), np.empty((n, 3), np.float32)
    best = dict.fromkeys(shaders, np.inf)
    for _ in range(60):
        for name, shader in shaders.items():
            best[name] = min(best[name], seconds(lambda s=shader: s.shade(*queries, out))[1])
    ratio = best["coded"] / best["svd-40"]
    terms = [a.shape[1] for a in shaders["coded"].angular]
    benchmark.extra_info.update({name: 1e6 * t / n for name, t in best.items()}, ratio=ratio)
    say(
        f"a query under one light, {SIDE} x {SIDE}, terms {terms}: "
        + ", ".join(f"{name} {1e6 * t / n:.2f} us" for name, t in best.items())
        + f", ratio {ratio:.1f}"
    )
    benchmark.pedantic(shaders["coded"].shade, (*queries, out), rounds=3)
    assert ratio < MOST_QUERIES


def test_more_decibels_at_equal_bytes(benchmark, tmp_path):
    sample = relief_sample()
    threads = available_threads()
    raw = raw_bytes(sample)
    compress_coded(sample, 400, n_terms=4)  # compiles
    say("ratio of file   PSNR display/linear, dB           seconds        shading, us a query")
    say("svd    coded    svd           coded               svd    coded   svd    coded")
    for ratio in RATIOS:
        terms = max(1, round((raw / ratio - 6000) / (2 * (SIDE * SIDE + 3 * sample.n_pairs))))
        models = {
            "svd": seconds(lambda n=terms: compress_svd(sample, n, threads=threads)),
            "coded": seconds(lambda r=ratio: compress_coded(sample, r, threads=threads)),
        }
        sizes, psnr, shading = {}, {}, {}
        for name, (model, _) in models.items():
            model.save(tmp_path / f"{name}.npz")
            sizes[name] = (tmp_path / f"{name}.npz").stat().st_size
            found = compare(model, sample, threads=threads).overall()
            psnr[name] = [found[domain]["psnr_db"] for domain in ("display", "linear")]
            shading[name] = shading_time(model)
        benchmark.extra_info[str(ratio)] = {
            name: [raw / sizes[name], *psnr[name], models[name][1], shading[name]]
            for name in models
        }
        say(
            "".join(f"{raw / sizes[name]:<8.1f}" for name in models)
            + "".join(" {:5.2f}/{:5.2f}   ".format(*psnr[name]) for name in models)
            + "     "
            + "".join(f"{models[name][1]:7.1f}" for name in models)
            + "  "
            + "".join(f"{shading[name]:7.2f}" for name in models)
        )
        assert psnr["coded"][0] > psnr["svd"][0] + 3
        assert psnr["coded"][1] > psnr["svd"][1]
    benchmark.pedantic(lambda: None, rounds=1)
