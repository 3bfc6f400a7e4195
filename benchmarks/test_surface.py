"""Even resampling beside gpytoolbox's remeshing of the same kind (Botsch and Kobbelt 2004, compiled C++)."""

import time
import warnings

import numpy as np
import pytest

from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import smooth_input
from btfpipe.surface.topology import edges


def bumpy_torus(around=96, across=48):
    u, w = np.meshgrid(
        2 * np.pi * np.arange(around) / around,
        2 * np.pi * np.arange(across) / across,
        indexing="ij",
    )
    inner = 0.4 + 0.04 * np.cos(5 * u) * np.sin(3 * w)
    reach = 1 + inner * np.cos(w)
    vertices = np.stack([reach * np.cos(u), inner * np.sin(w), -reach * np.sin(u)], 2).reshape(
        -1, 3
    )
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    k, m = (i + 1) % around, (j + 1) % across
    a, b, c, d = (
        x.ravel() for x in (i * across + j, k * across + j, k * across + m, i * across + m)
    )
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(
        np.int32
    )


def variation(vertices, faces):
    a, b = edges(faces).T
    lengths = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    return lengths.std() / lengths.mean(), lengths.mean()


@pytest.mark.parametrize("n", [20_000, pytest.param(250_000, marks=pytest.mark.slow)])
def test_resampling_beside_gpytoolbox(benchmark, n):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its imports are deprecated by scipy
        gpytoolbox = pytest.importorskip("gpytoolbox")
    vertices, faces = bumpy_torus()
    source = smooth_input(vertices, faces)
    resample(source, 500)  # compiled outside the figure
    rounds = 3 if n < 100_000 else 1
    ours, theirs = [], []
    for _ in range(rounds):
        start = time.perf_counter()
        made, place, weights = resample(source, n)
        ours.append(time.perf_counter() - start)
        spread, length = variation(source.lift(place, weights), made)
        start = time.perf_counter()
        points, other = gpytoolbox.remesh_botsch(vertices, faces.astype(np.int64), i=10, h=length)[
            :2
        ]
        theirs.append(time.perf_counter() - start)
    their_spread, _ = variation(points, other)
    benchmark.extra_info.update(
        vertices=len(place),
        variation=spread,
        gpytoolbox_vertices=len(points),
        gpytoolbox_variation=their_spread,
        gpytoolbox_seconds=min(theirs),
        ratio=min(theirs) / min(ours),
    )
    print(  # noqa: T201
        f"\n{'':12}{'vertices':>10}{'seconds':>9}{'variation of edge lengths':>28}"
        f"\n{'btfpipe':12}{len(place):10}{min(ours):9.2f}{spread:28.3f}"
        f"\n{'gpytoolbox':12}{len(points):10}{min(theirs):9.2f}{their_spread:28.3f}"
        f"\nratio {min(theirs) / min(ours):.1f}"
    )
    benchmark.pedantic(resample, args=(source, n), rounds=1)
    assert spread < their_spread
