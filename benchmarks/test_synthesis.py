"""Synthesis: the k-coherent search against full search, planes against numpy, and the whole of it, in one run."""

import itertools
import sys
import time

import numpy as np
import pytest

from btfpipe.analysis import Features
from btfpipe.analysis.neighbours import add_neighbour_lists
from btfpipe.analysis.pyramid import halve, plain_features
from btfpipe.analysis.textons import cluster, texton_level
from btfpipe.surface import Level, Surface
from btfpipe.synthesis.growth import grow_over_surface
from btfpipe.synthesis.plane import grow_over_plane


def say(line):
    """A line of the table that a run prints."""
    sys.stdout.write(line + "\n")


def smooth(side, depth, seed=0):
    """A toroidal texture (side, side, depth) with structure at several scales."""
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(seed).normal(size=(side, side, depth))
    parts = [gaussian_filter(noise, (s, s, 0), mode="wrap") * s for s in (1, 2, 4)]
    return sum(parts).astype(np.float32)


def textons(side, levels=3, k=60):
    """Surface textons of a smooth texture: 400, and a quarter a level, with neighbour lists."""
    image, made = smooth(side, 12), []
    for level in range(levels):
        vectors = image.reshape(-1, image.shape[2])
        made.append(texton_level(cluster(vectors, 400 >> 2 * level, seed=1), image.shape[:2]))
        image = halve(image, True)
    features = Features(made, {"toroidal": False, "neighbourhood": 5, "coarse_neighbourhood": 3})
    return add_neighbour_lists(features, k, threads=2)


def sphere(n):
    """A unit sphere of n even points, s to the east."""
    from scipy.spatial import ConvexHull

    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    v = np.stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1
    )
    faces = ConvexHull(v).simplices
    corners = v[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("nd,nd->n", normal, corners.mean(axis=1)) < 0
    faces[inward] = faces[inward][:, ::-1]
    east = np.cross([0, 0, 1], v)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    return Level(v, faces.astype(np.int32), v.astype(np.float32), east.astype(np.float32))


def sphere_surface(n, levels):
    """A sphere and its pyramid; places on the coarser level are the nearest ones."""
    import igl

    made = [sphere(n // 4**i) for i in range(levels)]
    for fine, coarse in itertools.pairwise(made):
        found = igl.point_mesh_squared_distance(
            fine.vertices, coarse.vertices, coarse.faces.astype(np.int64)
        )
        fine.parent_face = np.asarray(found[1], np.int32).ravel()
        a, b, c = np.moveaxis(coarse.vertices[coarse.faces[fine.parent_face]], 1, 0)
        point = np.asarray(found[2])
        area = np.stack(
            [np.linalg.norm(np.cross(p - point, q - point), axis=1) for p, q in ((b, c), (c, a), (a, b))], 1
        )  # fmt: skip
        fine.parent_weights = (area / area.sum(axis=1, keepdims=True)).astype(np.float32)
    return Surface(made, digest="sphere")


@pytest.mark.parametrize(("side", "wanted"), [(64, 10), (96, 20), (128, 30)])
def test_k_coherent_against_full_search_on_a_surface(benchmark, side, wanted):
    """The same kernel, neighbourhoods and early out; three levels, and the paper's own choice among candidates."""
    features, surface = textons(side), sphere_surface(4000, 3)
    options = {"levels": 3, "sweeps": (2, 1), "coherence": 0.0, "seed": 1}
    grow_over_surface(features, surface, k=2, **options)  # compiled from here on

    def run(**how):
        grown = grow_over_surface(features, surface, **options, **how)
        steps = grown.about["synthesis"]
        return (
            sum(step["search_seconds"] for step in steps),
            sum(step["seconds"] for step in steps),
            steps[-1]["candidates"],
            steps[-1]["mean_distance"],
        )

    full = run(full=True)
    for k in (1, 4, 11, 20, 40, 60):
        found = min((run(k=k) for _ in range(3)), key=lambda r: r[0])
        say(
            f"  {side}² k {k:2d}: search {found[0]:6.3f} s ({full[0] / found[0]:5.1f} x), resampling"
            f" {found[1] - found[0]:5.3f} s, {found[2]:7.1f} candidates, distance {found[3] / full[3]:.3f} of full"
        )
        if k == 11:
            ratio = full[0] / found[0]
            benchmark.extra_info |= {
                "full_search_seconds": round(full[0], 3),
                "k11_search_seconds": round(found[0], 3),
                "k11_resampling_seconds": round(found[1] - found[0], 3),
                "ratio": round(ratio, 1),
                "wanted_ratio": wanted,
                "candidates": [round(full[2]), round(found[2], 1)],
                "distance_ratio": round(found[3] / full[3], 3),
            }
    say(
        f"  {side}² full: search {full[0]:6.3f} s, resampling {full[1] - full[0]:5.3f} s, {full[2]:7.1f} candidates"
    )
    benchmark.pedantic(run, kwargs={"k": 11}, rounds=1)


@pytest.mark.parametrize("side", [64, 128])
def test_distances_on_one_level(benchmark, side):
    """How near k-coherent neighbourhoods come to those of full search, on one level."""
    features, surface = textons(side, levels=1), sphere_surface(3000, 1)
    options = {"levels": 1, "sweeps": (4, 1), "seed": 1}
    distances = {
        k: grow_over_surface(features, surface, k=k, **options).about["synthesis"][-1]["mean_distance"]
        for k in (1, 4, 11, 30, 60)
    }  # fmt: skip
    full = grow_over_surface(features, surface, full=True, **options)
    full = full.about["synthesis"][-1]["mean_distance"]
    for k, distance in distances.items():
        say(f"  one level, {side}², k {k:2d}: mean distance {distance / full:.3f} of full search's")
        benchmark.extra_info[f"k{k}_of_full"] = round(distance / full, 3)
    benchmark.pedantic(grow_over_surface, (features, surface), {"k": 11, **options}, rounds=1)


def numpy_sweep(features, row, col, k, seconds):
    """One sweep, each texel with numpy; stops after some seconds and returns what it did and how long it took."""
    level = features.levels[0]
    rows, cols = level.shape
    padded = np.pad(level.vectors[level.labels], ((2, 2), (2, 2), (0, 0)), "wrap")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), (0, 1))
    windows = windows.transpose(0, 1, 3, 4, 2).reshape(rows * cols, -1).copy()
    lists = level.neighbours.reshape(rows * cols, -1)[:, :k]
    image = level.vectors[level.labels]
    inside = np.zeros((rows, cols), bool)
    inside[2:-2, 2:-2] = True
    inside = inside.ravel()
    di, dj = (a.ravel() for a in np.mgrid[-2:3, -2:3])
    row, col = row.copy(), col.copy()
    texels = 0
    start = time.perf_counter()
    for r in range(row.shape[0]):
        for c in range(row.shape[1]):
            y, x = (r + di) % row.shape[0], (c + dj) % row.shape[1]
            around = image[row[y, x], col[y, x]].ravel()
            s, e = row[y, x] - di, col[y, x] - dj
            within = (s >= 0) & (s < rows) & (e >= 0) & (e < cols)
            candidates = np.unique(lists[np.unique(s[within] * cols + e[within])])
            candidates = candidates[inside[candidates]]
            error = windows[candidates] - around
            best = candidates[np.argmin(np.einsum("nd,nd->n", error, error))]
            row[r, c], col[r, c] = divmod(best, cols)
            texels += 1
        if time.perf_counter() - start > seconds:
            break
    return row, col, texels, time.perf_counter() - start


def test_plane_against_numpy(benchmark):
    """A sweep with whole neighbourhoods, k = 8, 5 x 5, 8 channels, toroidal output, on one thread."""
    features = plain_features(smooth(64, 8), False, 1)
    add_neighbour_lists(features, 8)
    shape = (128, 128)
    options = {"k": 8, "levels": 1, "seed": 1, "distance": "vectors"}
    before = grow_over_plane(features, shape, sweeps=(1, 1), **options)
    row, col = (a.reshape(shape).astype(int) for a in (before.row, before.col))
    ratios, rates = [], []
    for _ in range(3):
        after = grow_over_plane(features, shape, sweeps=(2, 1), **options)
        own = after.about["synthesis"][1]
        rate = own["elements"] / own["search_seconds"]
        twin = numpy_sweep(features, row, col, 8, 2.0)
        ratios.append(rate * twin[3] / twin[2])
        rates.append(rate)
        done = twin[2] // shape[1]
        same = (twin[0] == after.row.reshape(shape))[:done]
        assert same.mean() > 0.99
    benchmark.pedantic(grow_over_plane, (features, shape), {"sweeps": (2, 1), **options}, rounds=1)
    benchmark.extra_info |= {
        "texels_per_second": round(max(rates)),
        "ratio_to_numpy": round(float(np.median(ratios))),
        "candidates": round(own["candidates"], 1),
    }
    say(
        f"  plane: {max(rates):,.0f} texels/s, {np.median(ratios):.0f} x numpy, {own['candidates']:.1f} candidates a texel"
    )


def test_a_quarter_of_a_million_vertices(benchmark):
    """Three levels, k = 11, two threads, default sweeps: the whole synthesis."""
    features, surface = textons(128), sphere_surface(250_000, 3)
    grow_over_surface(features, sphere_surface(1000, 3), k=11, threads=2)
    start = time.perf_counter()
    grown = benchmark.pedantic(
        grow_over_surface, (features, surface), {"k": 11, "threads": 2}, rounds=1
    )
    seconds = time.perf_counter() - start
    searching = sum(step["search_seconds"] for step in grown.about["synthesis"])
    say(f"  250,000 vertices: {seconds:.1f} s, of which {searching:.1f} s search")
    benchmark.extra_info |= {"seconds": round(seconds, 1), "search_seconds": round(searching, 1)}
