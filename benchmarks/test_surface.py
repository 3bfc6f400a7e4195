"""Even resampling beside gpytoolbox's remeshing of the same kind (Botsch and Kobbelt 2004, compiled C++)."""

import time
import warnings

import numpy as np
import pytest
from shared_meshes import torus

from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import smooth_input
from btfpipe.surface.topology import edges


def variation(vertices, faces):
    a, b = edges(faces).T
    lengths = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    return lengths.std() / lengths.mean(), lengths.mean()


@pytest.mark.parametrize("n", [20_000, pytest.param(250_000, marks=pytest.mark.slow)])
def test_resampling_beside_gpytoolbox(benchmark, n):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its imports are deprecated by scipy
        gpytoolbox = pytest.importorskip("gpytoolbox")
    vertices, faces = torus(96, 48, bumps=0.04)
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
