"""Small meshes made in code."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from shared_meshes import torus
from shared_shapes import boxes

_MAKER = Path(__file__).parents[2] / "data-sample" / "make_meshes.py"


def make_meshes():
    """The module that makes the sample meshes."""
    spec = importlib.util.spec_from_file_location("make_meshes", _MAKER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sphere(halvings=2):
    vertices, faces = make_meshes().icosphere(halvings)
    return vertices, faces.astype(np.int32)


def grid(rows=9, cols=13, width=1.5, height=1.0):
    """An open rectangle in the plane y = 0, seen from above."""
    x, z = np.meshgrid(np.linspace(0, width, cols), np.linspace(0, height, rows))
    vertices = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    i = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(
        np.int32
    )


def double_ring():
    """A slab with two holes: genus 2."""
    solid = np.ones((5, 3, 1), bool)
    solid[1, 1] = solid[3, 1] = False
    return boxes(solid)


def cube():
    return boxes(np.ones((1, 1, 1), bool))


def obj(path, vertices, faces):
    """Write an OBJ and return its path."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, float).tolist()]
    lines += ["f " + " ".join(str(c + 1) for c in face) for face in np.asarray(faces).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def shapes():
    """The makers of this file, and the torus, by name."""
    makers = (make_meshes, sphere, grid, torus, boxes, double_ring, cube, obj)
    return SimpleNamespace(**{maker.__name__: maker for maker in makers})
