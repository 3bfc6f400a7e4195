"""Shading kernels against the same arithmetic in vectorised numpy, one thread each, timed in turns; a whole picture."""

import sys
import time

import numpy as np
import pytest
from scipy.spatial import Delaunay
from shared_shapes import dense_sphere

from btfpipe.compression.svd import SvdModel
from btfpipe.directions import bonn81, from_angles
from btfpipe.parallel import available_threads, single_threaded_blas
from btfpipe.sample import Sample, light_cosines

SIDE, TERMS, POINTS, BLOCK = 128, 40, 200_000, 10_000


class NumpyShader:
    """Barycentric over light and view, bilinear over texels: the textbook, a block of points at a time."""

    def __init__(self, appearance):
        self.appearance = appearance
        self.toroidal = appearance.toroidal
        self.meshes = []
        for directions in (appearance.light_directions, appearance.view_directions):
            self.meshes.append(Delaunay(directions[:, :2] / (1 + directions[:, 2:])))
        self.inverse = 1 / light_cosines(appearance.light_directions)

    def weights(self, mesh, directions):
        points = directions[:, :2] / (1 + directions[:, 2:])
        simplex = mesh.find_simplex(points)
        transform = mesh.transform[simplex]
        two = np.einsum("nij,nj->ni", transform[:, :2], points - transform[:, 2])
        return mesh.simplices[simplex], np.column_stack([two, 1 - two.sum(axis=1)])

    def shade(self, row, col, w_i, w_o, out):
        for start in range(0, len(row), BLOCK):
            part = slice(start, start + BLOCK)
            out[part] = self.block(row[part], col[part], w_i[part], w_o[part])

    def block(self, row, col, w_i, w_o):
        light, a = self.weights(self.meshes[0], w_i)
        view, b = self.weights(self.meshes[1], w_o)
        a = a * self.inverse[light] * w_i[:, 2:]
        pair = (
            view[:, :, None] * len(self.appearance.light_directions) + light[:, None, :]
        ).reshape(-1, 9)
        weight = (b[:, :, None] * a[:, None, :]).reshape(-1, 9).astype(np.float32)
        i, j = np.floor(row).astype(int), np.floor(col).astype(int)
        y, x = (row - i)[:, None], (col - j)[:, None]
        rows, cols = self.appearance.shape
        i0, i1, j0, j1 = i % rows, (i + 1) % rows, j % cols, (j + 1) % cols
        return self.blend(
            pair, weight, [(i0, j0, (1 - y) * (1 - x)), (i0, j1, (1 - y) * x), (i1, j0, y * (1 - x)), (i1, j1, y * x)]
        )  # fmt: skip


class NumpySvd(NumpyShader):
    def __init__(self, model):
        super().__init__(model)
        self.texture = np.asarray(model.texture_factors, np.float32)
        self.angular = np.asarray(model.angular_factors, np.float32)

    def blend(self, pair, weight, texels):
        texture = sum(w * self.texture[i, j] for i, j, w in texels)
        angular = np.einsum("np,npcm->ncm", weight, self.angular[pair], optimize=True)
        return np.einsum("ncm,nm->nc", angular, texture)


class NumpyRaw(NumpyShader):
    def __init__(self, sample):
        super().__init__(sample)
        self.table = sample.decode(np.arange(256, dtype=np.uint8))
        # texel-major, as the kernel has it: the textbook is given the better layout too
        self.codes = np.ascontiguousarray(sample.codes.transpose(1, 2, 0, 3))

    def blend(self, pair, weight, texels):
        return sum(
            w
            * np.einsum("np,npc->nc", weight, self.table[self.codes[i[:, None], j[:, None], pair]])
            for i, j, w in texels
        )


def _material(kind):
    rng = np.random.default_rng(5)
    directions, pair = bonn81(), np.arange(6561)
    side = SIDE if kind == "svd" else 64
    codes = rng.integers(0, 255, (6561, side, side, 3), np.uint8) if kind == "raw" else None
    if kind == "raw":
        return Sample(
            codes, directions, directions, pair % 81, pair // 81, transfer="srgb", toroidal=True
        )
    tiny = Sample(
        np.zeros((6561, 1, 1, 3), np.uint8),
        directions,
        directions,
        pair % 81,
        pair // 81,
        toroidal=True,
    )
    texture = rng.standard_normal((side, side, TERMS), np.float32)
    return SvdModel(texture, rng.standard_normal((6561, 3, TERMS), np.float32), tiny)


@pytest.mark.parametrize("kind", ["svd", "raw"])
def test_shading_kernel_against_vectorised_numpy(benchmark, kind):
    rng = np.random.default_rng(6)
    material = _material(kind)
    # what a tile asks for: a smooth surface under one light, its texels in patches
    at = np.linspace(0, 1, POINTS)
    side = material.shape[0]
    row = (
        np.repeat(rng.random(POINTS // 50) * side, 50) + np.tile(np.arange(50) * 0.1, POINTS // 50)
    ) % (side - 2)
    col = (
        np.repeat(rng.random(POINTS // 50) * side, 50) + np.tile(np.arange(50) * 0.1, POINTS // 50)
    ) % (side - 2)
    row, col = row.astype(np.float32), col.astype(np.float32)
    w_i = from_angles(0.2 + 0.8 * at, 40 * at).astype(np.float32)
    w_o = from_angles(1.0 - 0.7 * at, 3 + 25 * at).astype(np.float32)
    ours = material.shader()
    theirs = (NumpySvd if kind == "svd" else NumpyRaw)(material)
    out = [np.zeros((POINTS, 3), np.float32) for _ in range(2)]
    seconds = [[], []]
    with single_threaded_blas():
        ours.shade(row, col, w_i, w_o, out[0])
        for _ in range(4):
            for which, shader in enumerate((ours, theirs)):
                start = time.perf_counter()
                shader.shade(row, col, w_i, w_o, out[which])
                seconds[which].append(time.perf_counter() - start)
        benchmark.pedantic(ours.shade, (row, col, w_i, w_o, out[0]), rounds=3)
    np.testing.assert_allclose(out[0], out[1], atol=1e-4 * np.abs(out[1]).max())
    kernel, textbook = (min(s) for s in seconds)
    benchmark.extra_info.update(
        ratio=textbook / kernel, kernel_per_s=POINTS / kernel, numpy_per_s=POINTS / textbook
    )
    sys.stdout.write(
        f"\nshading {kind}: kernel {POINTS / kernel / 1e6:.2f} M/s, numpy {POINTS / textbook / 1e6:.3f} M/s,"
        f" ratio {textbook / kernel:.1f}\n"
    )


def test_interpolations_per_second(benchmark):
    model = _material("svd")
    rng = np.random.default_rng(7)
    row, col = (rng.random((2, POINTS)) * SIDE).astype(np.float32)
    w_i, w_o = (
        from_angles(*(rng.random((2, POINTS)) * [[1.2], [6.28]])).astype(np.float32)
        for _ in range(2)
    )
    out = np.zeros((POINTS, 3), np.float32)
    for interpolation in ("barycentric", "four", "nearest"):
        shader = model.shader(interpolation)
        shader.shade(row[:9], col[:9], w_i[:9], w_o[:9], out[:9])
        best = np.inf
        for _ in range(3):
            start = time.perf_counter()
            shader.shade(row, col, w_i, w_o, out)
            best = min(best, time.perf_counter() - start)
        benchmark.extra_info[interpolation] = POINTS / best
        sys.stdout.write(
            f"\nSVD-{TERMS}, directions in any order, {interpolation}: {POINTS / best / 1e6:.2f} M/s\n"
        )
    benchmark.pedantic(shader.shade, (row, col, w_i, w_o, out), rounds=1)


def test_whole_picture_of_a_dense_surface(benchmark):
    from btfpipe.rendering.camera import make_camera
    from btfpipe.rendering.objects import dressed_surface
    from btfpipe.rendering.renderer import render
    from btfpipe.rendering.scene import Film, Light, Scene

    level, coordinates = dense_sphere(SIDE)
    thing = dressed_surface(level, coordinates, _material("svd"), "barycentric")
    camera = make_camera({"type": "perspective", "direction": [0, 0.3, 1]}, 1.0, thing.vertices)
    light = Light(True, np.array([0.48, 0.6, 0.64]), np.full(3, np.pi))
    render(Scene(camera, Film(32, 32, 1), [light], [thing]))  # compiles
    scene = Scene(camera, Film(1024, 1024, 16), [light], [thing])
    threads = available_threads()
    picture = benchmark.pedantic(render, (scene,), {"threads": threads}, rounds=1)
    seconds = benchmark.stats.stats.min
    covered, coherent = float((picture[..., 3] > 0).mean()), float(thing.dressing.coherent.mean())
    benchmark.extra_info.update(
        seconds=seconds, covered=covered, coherent=coherent, threads=threads
    )
    sys.stdout.write(
        f"\n1024 x 1024, 16 rays a pixel, {len(level.vertices)} vertices, SVD-{TERMS}, {threads} threads:"
        f" {seconds:.1f} s after loading ({100 * covered:.0f} % covered, {100 * coherent:.0f} % of faces coherent)\n"
    )
    assert covered > 0.5
