"""How fast `ingest` reads a full set, against the decoder alone.

The reference decodes the same members of the same zip on the same threads into a reused buffer and writes nothing.
Memory is what only this process holds (RssAnon), read every few milliseconds.
"""

import contextlib
import os
import shutil
import sys
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from btfpipe.directions import bonn81
from btfpipe.formats import ubo
from btfpipe.formats.images import encode_picture
from btfpipe.parallel import available_threads
from btfpipe.sample.ingest import ingest

SIDE = 256
ROUNDS = 3


@pytest.fixture(scope="module")
def full_set(tmp_path_factory):
    """A 256 x 256 set of all 6561 pairs, of woven-looking pictures that compress like photographs."""
    path = tmp_path_factory.mktemp("full") / "weave256.zip"
    angles = [tuple(a) for a in bonn81(degrees=True).tolist()]
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:SIDE, :SIDE]
    noise = rng.normal(scale=9, size=(4, SIDE, SIDE, 3))
    pictures = []
    for k in range(64):
        weave = np.sin(0.4 * x + 0.1 * k) * np.sin(0.35 * y - 0.07 * k)
        picture = 110 + 40 * weave[..., None] * [1, 0.9, 0.7] + noise[k % 4]
        pictures.append(
            encode_picture(np.clip(picture, 0, 255).astype(np.uint8), ".jpg", quality=92)
        )
    with zipfile.ZipFile(path, "w") as archive:
        for v, view in enumerate(angles):
            for n, light in enumerate(angles):
                name = ubo.pair_name(81 * n + v, light, view, ".jpg")
                archive.writestr(name, pictures[(7 * v + n) % len(pictures)])
    return path


def decode_only(path, threads, folder):
    """Decode every member with the library alone."""
    import OpenImageIO as oiio

    def work(part):
        file, buffer = f"{folder}/{part}.jpg", None
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist()[part::threads]:
                with open(file, "wb") as out:
                    out.write(archive.read(name))
                picture = oiio.ImageInput.open(file)
                values = picture.read_image(oiio.UINT8)
                picture.close()
                buffer = np.empty_like(values) if buffer is None else buffer
                np.copyto(buffer, values)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(threads)))


def ingest_all(path, out, threads):
    with ubo.open_measurement(path) as measurement:
        ingest(measurement, out, threads=threads)


def timed(function, *args):
    """Seconds on the clock and of processors."""
    start = time.perf_counter(), time.process_time()
    function(*args)
    return time.perf_counter() - start[0], time.process_time() - start[1]


@contextlib.contextmanager
def peak_private_memory():
    """A list that holds, after the block, the most RssAnon in it beyond what earlier benchmarks left, in bytes."""

    def private():
        with open("/proc/self/status") as status:
            return next(int(line.split()[1]) * 1024 for line in status if "RssAnon" in line)

    before, peak, stop = private(), [0], threading.Event()

    def watch():
        while not stop.wait(0.005):
            peak[0] = max(peak[0], private() - before)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield peak
    finally:
        stop.set()
        thread.join()


@pytest.mark.skipif(not os.path.isdir("/dev/shm"), reason="needs memory that is a folder")
def test_ingest_takes_less_than_twice_the_time_of_decoding(benchmark, full_set, tmp_path):
    threads = available_threads()
    memory = f"/dev/shm/btfpipe-benchmark-{os.getpid()}"
    os.mkdir(memory)
    try:
        jobs = {
            "decoding alone": (decode_only, full_set, threads, memory),
            "ingest to memory": (ingest_all, full_set, f"{memory}/s.npz", threads),
            "ingest to disk": (ingest_all, full_set, tmp_path / "s.npz", threads),
        }
        seconds = {name: [] for name in jobs}
        with peak_private_memory() as peak:
            for _ in range(ROUNDS):
                for name, job in jobs.items():
                    seconds[name].append(timed(*job))
        benchmark.pedantic(*jobs["ingest to memory"][:1], jobs["ingest to memory"][1:], rounds=1)
    finally:
        shutil.rmtree(memory)
    clock = {name: min(t for t, _ in times) for name, times in seconds.items()}
    processors = {name: min(t for _, t in times) for name, times in seconds.items()}
    sys.stdout.write(
        f"\n256 x 256 x 6561, {threads} threads, least of {ROUNDS} interleaved rounds\n"
    )
    for name in jobs:
        ratio = clock[name] / clock["decoding alone"]
        busy = processors[name] / processors["decoding alone"]
        benchmark.extra_info[name] = {"seconds": clock[name], "ratio": ratio, "cpu_ratio": busy}
        sys.stdout.write(
            f"  {name:18s} {clock[name]:6.2f} s {ratio:6.2f} x   processors {processors[name]:6.2f} s {busy:6.2f} x\n"
        )
    benchmark.extra_info["peak_private_mb"] = peak[0] / 2**20
    sys.stdout.write(f"  peak private memory {peak[0] / 2**20:.0f} MB beyond the process's own\n")
