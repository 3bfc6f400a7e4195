"""What is asked of `surface` and cannot be: refused before the work, with what can."""

import re

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.surface.cleaning import clean
from btfpipe.surface.prepare import prepare


def test_memory_that_does_not_suffice_is_refused_with_the_vertices_that_fit(
    shapes, btfpipe, tmp_path
):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(1))
    ask = ("surface", mesh, "-o", tmp_path / "s.npz", "--levels", 1)
    done = btfpipe(*ask, "--vertices", 20000, "--memory", "302M", code=3)
    assert "sphere.obj: 20000 vertices need about 346 MB; --memory allows 302 MB" in done.stderr
    fits = int(re.search(r"at most (\d+) with --vertices", done.stderr)[1])
    btfpipe(*ask, "--vertices", fits + 1, "--memory", "302M", code=3)
    btfpipe(*ask, "--vertices", fits, "--memory", "302M")
    done = btfpipe(*ask, "--vertices", 100, "--memory", "100M", "--force", code=3)
    assert "Raise it" in done.stderr


def test_the_number_of_vertices_has_an_end(shapes, btfpipe, tmp_path):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(1))
    btfpipe("surface", mesh, "-o", tmp_path / "s.npz", "--vertices", 20_000_001, code=2)


def test_levels_without_vertices_are_refused_with_the_levels_that_fit(shapes, btfpipe, tmp_path):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(1))
    ask = ("surface", mesh, "-o", tmp_path / "s.npz", "--vertices", 400)
    done = btfpipe(*ask, "--levels", 5, code=3)
    assert "sphere.obj: 5 levels of 400 vertices leave 1 on the coarsest" in done.stderr
    assert "at most 3 with --levels" in done.stderr
    btfpipe(*ask, "--levels", 4, code=3)
    btfpipe(*ask, "--levels", 3)


def test_the_least_mesh_keeps_one_level(shapes):
    made, _ = prepare(*shapes.sphere(1), 100, 1)
    assert len(made.levels) == 1


def test_faces_without_area_and_no_faces_are_told_apart():
    line = np.linspace((0, 0, 0), (1, 2, 3), 9)
    with pytest.raises(InputError, match="but 2 faces without area"):
        clean(line, np.array([(0, 1, 2), (1, 2, 3)], np.int32), "line.obj")
    point = np.zeros((3, 3))
    with pytest.raises(InputError, match="every face has two corners in one place"):
        clean(point, np.array([(0, 1, 2)], np.int32), "point.obj")
