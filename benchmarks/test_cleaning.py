"""Cleaning a mesh of many parts: time in proportion to their number."""

import time

import numpy as np
import pytest

from btfpipe.surface.cleaning import clean

_CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
_FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
     (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
)  # fmt: skip


def cubes(count, apart):
    """Cubes in a grid, one face of each turned the wrong way."""
    side = int(np.ceil(count ** (1 / 3)))
    cell = np.stack(np.unravel_index(np.arange(count), (side,) * 3), 1)
    vertices = (apart * cell[:, None] + _CUBE).reshape(-1, 3)
    faces = _FACES.copy()
    if apart > 1:
        faces[0] = faces[0, ::-1]
    faces = (faces + 8 * np.arange(count)[:, None, None]).reshape(-1, 3).astype(np.int32)
    return vertices, faces


def soup(vertices, faces):
    return vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


@pytest.mark.parametrize("kind", ["apart", "touching, as triangles"])
def test_four_times_the_parts_take_four_times_as_long(benchmark, kind):
    few, many = 10_000, 40_000
    if kind == "touching, as triangles":
        few, many = few // 4, many // 4

    def mesh(count):
        return cubes(count, 3) if kind == "apart" else soup(*cubes(count, 1))

    clean(*mesh(8))  # compiled outside the figure
    seconds = {few: [], many: []}
    for _ in range(3):
        for count, taken in seconds.items():
            start = time.perf_counter()
            _, faces, repairs = clean(*mesh(count))
            taken.append(time.perf_counter() - start)
            assert len(faces) == 12 * count
    ratio = min(seconds[many]) / (4 * min(seconds[few]))
    print(  # noqa: T201
        f"\n{kind}: {few} in {min(seconds[few]):.2f} s, {many} in {min(seconds[many]):.2f} s,"
        f" ratio {ratio:.2f}"
    )
    benchmark.extra_info.update(parts=many, ratio=ratio, turned=repairs["turned_faces"])
    benchmark.pedantic(clean, args=mesh(few), rounds=1)
    assert ratio < 1.6
