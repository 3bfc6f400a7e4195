"""Lights that stand for an environment: their error against their number, and the time of a picture under fifty of them.

The errors are also drawn, to .benchmarks/lights.png.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pytest

from btfpipe.compression.coded import compress_coded
from btfpipe.compression.svd import SvdModel
from btfpipe.directions import bonn81
from btfpipe.parallel import available_threads
from btfpipe.rendering.environment import METHODS, Environment
from btfpipe.sample import Sample
from btfpipe.surface.surface import Level
from btfpipe.synthesis import CoordinateMap

SIDE, TERMS = 128, 40
COUNTS = (12, 25, 50, 100, 200, 400)


def _room(rows=128):
    """A dark hall with a bright window, four small lamps thousands of times as bright, and a floor that shines back."""
    polar = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    azimuth = 2 * np.pi * ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5)
    w = np.stack(
        np.broadcast_arrays(
            np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)
        ),
        axis=-1,
    )
    out = 0.1 * np.array([1.0, 0.9, 0.7]) + 0.2 * np.maximum(-w[..., 1:2], 0) * [0.8, 0.6, 0.4]
    window = (np.abs(w @ [0.5, -0.2, 0.8]) < 0.2) & (w @ [-0.8, 0.3, 0.5] > 0.85)
    out += 8 * window[..., None] * np.array([0.7, 0.9, 1.2])
    for x, z in ((0.3, 0.3), (-0.4, 0.2), (0.2, -0.5), (-0.3, -0.4)):
        towards = np.array([x, 1, z]) / np.linalg.norm([x, 1, z])
        out += 1000 * (w @ towards > 0.9995)[..., None] * np.array([1.2, 0.9, 0.5])
    return Environment(out.astype(np.float32), name="room")


def test_error_against_number_of_lights(benchmark):
    """Root of the mean squared error over that of the light, on surfaces of all sides, free or half shaded by another."""
    rng = np.random.default_rng(2)
    facing, shade = rng.standard_normal((2, 300, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    environment = _room()

    def lit(directions, powers):
        cosine = np.maximum(facing @ directions.T, 0)
        gloss = np.maximum(cosine, 0) ** 20
        return [v @ powers for v in (cosine, cosine * (shade @ directions.T > 0), gloss)]

    directions, solid_angles, radiances = environment.pixels()
    expected = lit(directions, solid_angles[:, None] * radiances)
    curves = {}
    text = ["lights:    " + "".join(f"{count:>22}" for count in COUNTS)]
    for method in METHODS:
        row = []
        for count in COUNTS:
            squares = []
            for seed in range(20 if method == "alias" else 1):
                found = lit(*environment.lights(count, method, seed))
                squares.append(
                    [((a - b) ** 2).mean() for a, b in zip(found, expected, strict=True)]
                )
            scale = [(b**2).mean() for b in expected]
            row.append(np.sqrt(np.mean(squares, axis=0) / scale))
        curves[method] = np.array(row)
        benchmark.extra_info[method] = {n: list(e) for n, e in zip(COUNTS, row, strict=True)}
        text.append(
            f"{method:11}" + "".join(f"{'{:.4f} {:.4f} {:.4f}'.format(*e):>22}" for e in row)
        )
        assert row[-1][0] < 0.3 * row[0][0]
    _draw(curves, Path(".benchmarks") / "lights.png")
    benchmark.pedantic(environment.lights, (50,), rounds=3)
    sys.stdout.write(
        "\nerror of irradiance, with a half of the sphere shaded, and of a glossy lobe (cos^20)\n"
        + "\n".join(text)
        + f"\nq2tree, 50 lights of {len(directions)} pixels: {1e3 * benchmark.stats.stats.min:.0f} ms\n"
    )


def _draw(curves, path):
    """Draw error against number of lights, a part for each kind of surface and a curve for each method."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    names = "diffuse, in the open", "diffuse, half the sphere shaded", "glossy lobe, cos$^{20}$"
    for number, (axes, name) in enumerate(
        zip(figure.subplots(1, 3, sharey=True), names, strict=True)
    ):
        for method, errors in curves.items():
            axes.plot(COUNTS, 100 * errors[:, number], marker="o", label=method)
        axes.set(xscale="log", yscale="log", title=name, xlabel="lights")
        axes.set_xticks(COUNTS, [str(count) for count in COUNTS])
        axes.minorticks_off()
        axes.set_yticks([0.1, 1, 10, 100], ["0.1 %", "1 %", "10 %", "100 %"])
        axes.grid(True, alpha=0.3)
    figure.axes[0].set_ylabel("root mean square error")
    figure.axes[0].legend()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def _ring(around=700, across=360):
    """A ring of 252,000 vertices that stands on its rim and shades itself; a map along both of its turns."""
    u, v = np.meshgrid(*(2 * np.pi * np.arange(n) / n for n in (around, across)), indexing="ij")
    radial = np.stack([np.cos(u), np.sin(u), 0 * u], axis=-1)
    normals = np.cos(v)[..., None] * radial + np.sin(v)[..., None] * [0, 0, 1]
    vertices = radial + 0.4 * normals
    tangents = np.stack([-np.sin(u), np.cos(u), 0 * u], axis=-1)
    a = np.arange(around * across).reshape(around, across)
    b, c, d = np.roll(a, -1, 0), np.roll(a, -1, (0, 1)), np.roll(a, -1, 1)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3).astype(np.int32)
    flat = (x.reshape(-1, 3) for x in (vertices, normals, tangents))
    vertices, normals, tangents = flat
    level = Level(vertices, faces, normals.astype(np.float32), tangents.astype(np.float32))
    per_unit = 4 * SIDE / (2 * np.pi)
    row, col = (-0.4 * v.ravel() * per_unit) % SIDE, (u.ravel() * per_unit) % SIDE
    return level, CoordinateMap(row, col, 0 * row, per_unit, {})


def _model(method):
    """Of the method, with its default number of terms."""
    rng = np.random.default_rng(5)
    directions, pair = bonn81(), np.arange(6561)
    tiny = Sample(
        np.zeros((6561, 1, 1, 3), np.uint8), directions, directions, pair % 81, pair // 81, toroidal=True
    )  # fmt: skip
    texture = rng.standard_normal((SIDE, SIDE, TERMS), np.float32)
    model = SvdModel(texture, rng.standard_normal((6561, 3, TERMS), np.float32), tiny)
    return model if method == "svd" else compress_coded(model, threads=available_threads())


@pytest.mark.parametrize("method", ["svd", "coded"])
def test_picture_under_fifty_lights(benchmark, method):
    """640 x 480, 4 rays a pixel, shadows, a ring on a ground; against as many pictures of one light each."""
    from btfpipe.rendering import objects
    from btfpipe.rendering.camera import make_camera
    from btfpipe.rendering.renderer import render
    from btfpipe.rendering.scene import Film, Light, Scene

    level, coordinates = _ring()
    thing = objects.dressed_surface(level, coordinates, _model(method), "barycentric")
    ground = objects.flat(
        {"center": [0, -1.4, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [100, 100]}, [0.5] * 3
    )
    environment = _room()
    lights = [Light(True, *both) for both in zip(*environment.lights(52), strict=True)]
    view = {"type": "perspective", "direction": [0.4, 0.3, 1]}
    camera = make_camera(view, 640 / 480, thing.vertices)

    def scene(film, some):
        return Scene(camera, film, some, [thing, ground], environments=[environment])

    threads = available_threads()
    render(scene(Film(32, 24, 1), lights[:1]))  # compiles
    film = Film(640, 480, 4)
    ones, processor = [], []
    for light in lights[:: len(lights) // 5]:
        start = time.perf_counter()
        render(scene(film, [light]), threads=threads)
        ones.append(time.perf_counter() - start)
    busy = time.process_time()
    picture = benchmark.pedantic(render, (scene(film, lights),), {"threads": threads}, rounds=1)
    processor = time.process_time() - busy
    seconds = benchmark.stats.stats.min
    ratio = len(lights) * np.mean(ones) / seconds
    hit = float((picture[..., 4] > 0).mean())
    dressed = float((picture[..., 8] >= 0).mean())
    benchmark.extra_info.update(
        seconds=seconds,
        processor_seconds=processor,
        lights=len(lights),
        ratio=ratio,
        threads=threads,
    )
    sys.stdout.write(
        f"\n640 x 480, 4 rays a pixel, {len(lights)} lights, {method} of {SIDE}² x 81 x 81, {threads} threads:"
        f" {seconds:.1f} s after loading, {processor:.1f} s of processor time ({100 * dressed:.0f} % dressed,"
        f" {100 * hit:.0f} % hit); {ratio:.1f} times as fast as one light at a time\n"
    )
    assert dressed > 0.2
    assert ratio > 1.5
