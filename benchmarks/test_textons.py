"""Texton analysis against the textbook ways, in one run."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from btfpipe.analysis import Features
from btfpipe.analysis.filters import base_sigma, filter_pictures, leung_malik
from btfpipe.analysis.neighbours import add_neighbour_lists, neighbourhood_distances
from btfpipe.analysis.pyramid import plain_features
from btfpipe.analysis.textons import appearance_vectors, cluster, picture_weights, texton_level


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write(line + "\n")


def best(*functions, rounds=3):
    """Least seconds of each function, called in turn so that a slow spell of the machine hits all."""
    seconds = [np.inf] * len(functions)
    for _ in range(rounds):
        for i, function in enumerate(functions):
            start = time.perf_counter()
            function()
            seconds[i] = min(seconds[i], time.perf_counter() - start)
    return seconds


def smooth(side, depth, seed=0):
    """A toroidal texture (side, side, depth) with structure at several scales."""
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(seed).normal(size=(side, side, depth))
    parts = [gaussian_filter(noise, (s, s, 0), mode="wrap") * s for s in (1, 2, 4)]
    return sum(parts).astype(np.float32)


@pytest.mark.parametrize("side", [64, 128])
def test_filtering_eigen_textures_against_filtering_pictures(benchmark, side):
    """48 filters over 400 pictures in three channels; the long ways are timed on a few and scaled up."""
    from scipy.ndimage import convolve
    from scipy.signal import fftconvolve

    textures = smooth(side, 40)
    angular = np.random.default_rng(1).normal(size=(400, 3, 40)).astype(np.float32)
    kernels = leung_malik(base_sigma(side, side))
    planes = (textures @ angular[:4].reshape(-1, 40).T).transpose(2, 0, 1)

    def short():
        return appearance_vectors(textures @ picture_weights(angular), True)

    def own():
        for _ in filter_pictures(planes, kernels, True):
            pass

    def by_fft():
        pad = kernels.shape[1] // 2
        padded = np.pad(planes, ((0, 0), (pad, pad), (pad, pad)), "wrap")
        for kernel in kernels.astype(np.float32):
            fftconvolve(padded, kernel[None], "valid", axes=(1, 2))

    def direct():
        convolve(planes[0], kernels[0], mode="wrap")

    short()
    seconds = best(short, own, by_fft, direct, rounds=2)
    benchmark.pedantic(short, rounds=1)
    full = (seconds[0], seconds[1] * 100, seconds[2] * 100, seconds[3] * 1200 * 48)
    names = ("eigen_textures", "pictures_own_fft", "pictures_fftconvolve", "pictures_ndimage")
    for name, value in zip(names, full, strict=True):
        benchmark.extra_info[f"{name}_seconds"] = round(value, 3)
        benchmark.extra_info[f"{name}_ratio"] = round(value / full[0], 1)
        say(f"  filters {side}²: {name:22s} {value:9.2f} s  {value / full[0]:8.1f} x")


def test_neighbour_lists_against_a_tree(benchmark):
    """Lists of 20 for 64² texels, 5 x 5 and 3 x 3 neighbourhoods of 8 channels, on one thread."""
    from scipy.spatial import cKDTree

    features = plain_features(smooth(64, 8), toroidal=True, levels=2)

    def windows(level, side):
        reach = range(-(side // 2), side // 2 + 1)
        image = level.vectors[level.labels]
        return np.concatenate([np.roll(image, (-i, -j), (0, 1)) for i in reach for j in reach], 2)

    def tree():
        coarse = windows(features.levels[1], 3).repeat(2, axis=0).repeat(2, axis=1)
        vectors = np.concatenate([windows(features.levels[0], 5), coarse], axis=2).reshape(4096, -1)
        return cKDTree(vectors).query(vectors, 20)

    def lists():
        add_neighbour_lists(features, 20)

    lists()
    (ours,) = best(lists)
    start = time.perf_counter()
    distance, _ = tree()
    theirs = time.perf_counter() - start
    benchmark.pedantic(lists, rounds=1)
    benchmark.extra_info |= {"seconds": round(ours, 3), "ratio_to_ckdtree": round(theirs / ours, 1)}
    say(
        f"  neighbour lists 64²: {ours:.2f} s; cKDTree {theirs:.2f} s, {theirs / ours:.1f} x",
    )
    texel = np.repeat(np.arange(4096), 19)
    found = neighbourhood_distances(
        features, 0, texel, features.levels[0].neighbours[..., 1:].ravel()
    )
    assert np.allclose(np.sort(found.reshape(4096, 19)), distance[:, 1:] ** 2, rtol=1e-3)


def test_seeded_lists_against_exhaustive_ones(benchmark):
    """The paper's m = 100 at 128², where it starts; 400, 100 and 25 textons of 8 channels, not toroidal."""
    levels = [
        texton_level(cluster(image.vectors[:-1], count), image.shape)
        for image, count in zip(plain_features(smooth(128, 8)).levels, (400, 100, 25), strict=True)
    ]
    features = Features(levels, {"toroidal": False})

    def run(most):
        add_neighbour_lists(features, 11, exhaustive_texels=most)
        lists = features.levels[0].neighbours[..., 1:].ravel()
        return neighbourhood_distances(features, 0, np.repeat(np.arange(128**2), 10), lists).mean()

    seeded, exact = run(64 * 64), run(128 * 128)
    seconds = best(lambda: run(64 * 64), lambda: run(128 * 128), rounds=2)
    benchmark.pedantic(lambda: run(64 * 64), rounds=1)
    benchmark.extra_info |= {
        "seconds": round(seconds[0], 3),
        "exhaustive_seconds": round(seconds[1], 3),
        "mean_distance_ratio": round(float(seeded / exact), 4),
    }
    say(
        f"  neighbour lists 128²: seeded {seconds[0]:.2f} s, exhaustive {seconds[1]:.2f} s,"
        f" mean distance {seeded / exact:.4f} x",
    )  # fmt: skip


@pytest.mark.parametrize("source", ["sample", "model"])
def test_whole_analysis(benchmark, tmp_path_factory, source):
    """The command, from start to written file, on 64² x 6561 with three levels (the paper: 45 minutes)."""
    path = _files(tmp_path_factory)[source]
    program = Path(sys.executable).with_name("btfpipe")
    command = [program, "textons", path, "-o", path.with_name("t.npz"), "--force", "--quiet"]

    def run():
        subprocess.run(command, check=True)

    benchmark.pedantic(run, rounds=2, warmup_rounds=1)
    seconds = benchmark.stats.stats.min if benchmark.stats else float("nan")
    benchmark.extra_info["seconds"] = round(seconds, 2)
    say(f"  texton analysis of a 64² x 6561 {source}: {seconds:.1f} s")


def _files(factory, made={}):  # noqa: B006, made once for both cases
    """A bumpy Lambertian material under Bonn's 81 x 81 directions, as Sample and as Model."""
    if made:
        return made
    from btfpipe.compression.svd import compress_svd
    from btfpipe.directions import bonn81
    from btfpipe.sample import Sample

    lights = bonn81()
    albedo = 0.3 + 0.2 * np.tanh(smooth(64, 3))
    height = smooth(64, 1, 2)[..., 0]
    slope = np.stack(np.gradient(height)[::-1], axis=-1) * [-1, 1]
    shade = np.maximum(lights[:, 2, None, None] + np.einsum("ld,rcd->lrc", lights[:, :2], slope), 0)
    codes = np.empty((81, 81, 64, 64, 3), np.uint8)
    for view, direction in enumerate(lights):
        shift = 1 + 0.4 * slope @ direction[:2]
        picture = (shade * shift)[..., None] * albedo
        codes[view] = np.clip(picture, 0, 1) ** (1 / 2.2) * 255
    pair = np.arange(6561)
    codes = codes.reshape(6561, 64, 64, 3)
    sample = Sample(
        codes, lights, lights, pair % 81, pair // 81, transfer="gamma2.2", toroidal=True
    )
    folder = factory.mktemp("textons")
    made |= {"sample": folder / "s.npz", "model": folder / "m.npz"}
    sample.save(made["sample"])
    compress_svd(sample, 40).save(made["model"])
    return made
