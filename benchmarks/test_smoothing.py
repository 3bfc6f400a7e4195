"""What smoothing brings back of a mesh that was coarsened: normals and positions beside those of the fine mesh."""

import os
from pathlib import Path

import numpy as np
import pytest
from shared_shapes import SHAPES

from btfpipe.formats.meshes import read_mesh
from btfpipe.surface import prepare as preparation
from btfpipe.surface.cleaning import clean
from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import barycentric, smooth_input

# name, vertices it is coarsened to, then resampled to, and the most that is left of the errors of flat faces with
# interpolated normals: of normals, of positions
CASES = [
    ("starfish", 3000, 60_000, 1.1, 0.5),
    pytest.param("armadillo", 6000, 60_000, 0.8, 1.1, marks=pytest.mark.measured),
    pytest.param("bunny", 1200, 30_000, 0.8, 1.1, marks=pytest.mark.measured),
]


def load(name):
    if name in SHAPES:
        return clean(*SHAPES[name](), name)[:2]
    if "BTFPIPE_DATA" not in os.environ:
        pytest.skip("needs measured data: set BTFPIPE_DATA to their folder")
    mesh = read_mesh(Path(os.environ["BTFPIPE_DATA"]) / "meshes" / name / f"{name}.obj")
    return clean(*mesh, name)[:2]


def beside(fine, points, normals, trimesh):
    """Mean angle to the normals of the fine mesh, degrees, and mean distance from it."""
    mesh = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    closest, distance, face = trimesh.proximity.closest_point(mesh, points)
    weights = barycentric(closest, fine.vertices[fine.faces[face]])
    true = np.einsum("kc,kcx->kx", weights, fine.corner_normals[face])
    cosine = (normals * true).sum(axis=1) / np.linalg.norm(true, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(), distance.mean()


@pytest.mark.parametrize(("name", "coarse", "dense", "most_angle", "most_distance"), CASES)
def test_a_coarsened_mesh_comes_back(name, coarse, dense, most_angle, most_distance):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("rtree")
    fine = smooth_input(*load(name), alpha=0.0)
    few = resample(fine, coarse)
    source = smooth_input(fine.flat(few.place_face, few.place_weights), few.faces)
    many = resample(source, dense)
    some = np.random.default_rng(0).choice(len(many.place_face), 4000, replace=False)
    face, weights = many.place_face[some], many.place_weights[some]
    linear = np.einsum("kc,kcx->kx", weights, source.corner_normals[face])
    linear /= np.linalg.norm(linear, axis=1, keepdims=True)
    before = beside(fine, source.flat(face, weights), linear, trimesh)
    normals, positions = preparation._smoothed(source, many)
    after = beside(fine, positions[some], normals[some], trimesh)
    print(  # noqa: T201
        f"\n| {name} | {len(fine.vertices):,} | {coarse:,} | {before[0]:.2f} | {after[0]:.2f} |"
        f" {before[1] / many.spacing:.3f} | {after[1] / many.spacing:.3f} |"
    )
    assert after[0] <= most_angle * before[0]
    assert after[1] <= most_distance * before[1]
