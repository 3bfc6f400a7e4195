"""The streaming SVD against `scipy.sparse.linalg.svds` in one run, and its private memory.

The sample is made in code: 81 x 81 pairs whose spectrum falls like a measured cloth's (40 terms leave a relative
error of about 8 %), as 8-bit codes. `svds` gets the linear values as one float32 array and all BLAS threads.
"""

import math
import sys
import time

import numpy as np
from shared_memory import peak_private_mb

from btfpipe import store
from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81
from btfpipe.parallel import available_threads, blocks
from btfpipe.sample import Sample, encode

N_TERMS = 40
PAIRS = 6561


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write("\n" + line)


def write_sample(path, rows, cols, rank=300, power=0.8):
    """A Sample file of the full Bonn set with `rank` terms whose singular values fall as n^-power."""
    rng = np.random.default_rng(2005)
    texture = rng.standard_normal((rank, rows * cols), np.float32)
    # neighbouring pairs look alike: smooth the angular factors along the pairs
    angular = rng.standard_normal((PAIRS + 4, rank), np.float32)
    angular = sum(angular[k : k + PAIRS] for k in range(5)) / np.sqrt(5)
    angular *= 0.12 / np.arange(1, rank + 1, dtype=np.float32) ** power
    tint = 1 + 0.1 * rng.standard_normal((PAIRS, 3, rank), np.float32)
    directions = bonn81()
    pair = np.arange(PAIRS)
    sample = Sample(
        np.zeros((PAIRS, 1, 1, 3), np.uint8),
        directions, directions, pair % 81, pair // 81, transfer="gamma2.2",
    )  # fmt: skip
    shade = np.sqrt(directions[:, 2][sample.light_index])
    with store.create(path, "sample", **sample.facts()) as writer:
        sample.write_tables(writer)
        with writer.stream("pictures", (PAIRS, rows, cols, 3), np.uint8) as put:
            for some in blocks(PAIRS, 243):
                weights = (angular[some, None] * tint[some]).reshape(-1, rank)
                values = (weights @ texture).reshape(-1, 3, rows, cols).transpose(0, 2, 3, 1)
                values = (0.3 + values) * shade[some, None, None, None]
                put(np.round(255 * encode(np.clip(values, 0, 1), "gamma2.2")))
    return path


def write_tiled(path, small, times):
    """A Sample file whose pictures are those of `small`, repeated `times` each way."""
    with store.create(path, "sample", **small.facts()) as writer:
        small.write_tables(writer)
        shape = (PAIRS, small.shape[0] * times, small.shape[1] * times, 3)
        with writer.stream("pictures", shape, np.uint8) as put:
            for some in blocks(PAIRS, 243):
                put(np.tile(small.codes[some], (1, times, times, 1)))
    return path


def linear_matrix(sample):
    """Texels x (pairs and channels) float32, as `svds` wants it."""
    out = np.empty((sample.shape[0] * sample.shape[1], PAIRS * 3), np.float32)
    for some in blocks(PAIRS, 243):
        pictures = sample.pictures(some)
        out[:, 3 * some.start : 3 * some.stop] = pictures.transpose(1, 2, 0, 3).reshape(
            len(out), -1
        )
    return out


def test_svd_is_many_times_faster_than_svds(benchmark, tmp_path):
    from scipy.sparse.linalg import svds

    sample = Sample.open(write_sample(tmp_path / "s.npz", 128, 128))
    whole = linear_matrix(sample)
    energy = sum(float(np.vecdot(row, row)) for row in whole)
    threads = available_threads()
    compress_svd(sample, 2, iterations=0, threads=threads)  # compiles

    ours, theirs = [], []
    for _ in range(3):
        start = time.perf_counter()
        model = compress_svd(sample, N_TERMS, threads=threads)
        ours.append(time.perf_counter() - start)
        if len(theirs) < 2:
            start = time.perf_counter()
            values = svds(whole, N_TERMS, return_singular_vectors=True, random_state=0)[1]
            theirs.append(time.perf_counter() - start)
    benchmark.pedantic(compress_svd, (sample, N_TERMS), {"threads": threads}, rounds=1)

    optimum = math.sqrt(energy - float((values.astype(np.float64) ** 2).sum()))
    error = model.about["rmse"] * math.sqrt(whole.size)
    facts = {
        "svds_seconds": min(theirs),
        "seconds": min(ours),
        "ratio": min(theirs) / min(ours),
        "error_over_optimum": error / optimum,
        "relative_error": model.about["relative_error"],
        "iterations": model.about["iterations"],
    }
    benchmark.extra_info |= facts
    say("128 x 128 x 6561, 40 terms: " + ", ".join(f"{k} {v:.4g}" for k, v in facts.items()))
    assert facts["error_over_optimum"] < 1.01


def test_private_memory(benchmark, tmp_path):
    small = Sample.open(write_sample(tmp_path / "small.npz", 64, 64))
    run = [
        sys.executable,
        "-c",
        "from btfpipe.cli import main; main()",
        "compress",
        "--method",
        "svd",
        "-q",
        "-f",
    ]
    out = tmp_path / "m.npz"
    for times in (1, 2, 4):
        path = write_tiled(tmp_path / "s.npz", small, times)
        found = {}
        for budget in ("256M", "512M", "2G"):
            command = [*run, str(path), "-o", str(out), "--memory", budget]
            found[budget] = round(peak_private_mb(command))
        size = f"{64 * times} x {64 * times} x {PAIRS}"
        benchmark.extra_info[size] = found
        say(f"{size}: peak private MB by --memory: {found}")
    benchmark.pedantic(lambda: None, rounds=1)
