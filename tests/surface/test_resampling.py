import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.surface.cleaning import clean
from btfpipe.surface.remeshing import resample
from btfpipe.surface.smooth_input import barycentric, smooth_input
from btfpipe.surface.topology import describe, edges, half_edges, opposite_half_edges


def resampled(vertices, faces, n, crease_deg=None, alpha=0.75):
    vertices, faces, _ = clean(vertices, faces)
    source = smooth_input(vertices, faces, crease_deg, alpha)
    made, place, weights = resample(source, n)
    return source, made, source.lift(place, weights), source.normals(place, weights)


def edge_lengths(vertices, faces):
    a, b = edges(faces).T
    return np.linalg.norm(vertices[a] - vertices[b], axis=1)


def topology(faces, n):
    """Euler characteristic and boundary loops of the components, sorted."""
    euler, loops, _ = describe(faces, n)
    return sorted(zip(euler.tolist(), loops.tolist(), strict=True))


def assert_manifold(faces):
    """Each edge has at most two faces, run in opposite senses, and each vertex one fan."""
    start, end = half_edges(faces)
    directed = start.astype(np.int64) * (faces.max() + 1) + end
    assert len(np.unique(directed)) == len(directed)
    opposite = opposite_half_edges(faces)
    rim = opposite < 0
    assert np.bincount(start[rim], minlength=1).max(initial=0) <= 1


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("sphere", [(2, 0)]),
        ("torus", [(0, 0)]),
        ("grid", [(1, 1)]),
        ("double_ring", [(-2, 0)]),
        ("cube", [(2, 0)]),
    ],
)
@pytest.mark.parametrize("n", [300, 3000])
def test_resampling_meets_the_number_evenly_and_keeps_the_topology(shapes, shape, expected, n):
    vertices, faces = getattr(shapes, shape)()
    _, made, points, _ = resampled(vertices, faces, n)
    assert abs(len(points) - n) <= 0.05 * n
    assert_manifold(made)
    assert topology(made, len(points)) == expected
    lengths = edge_lengths(points, made)
    assert lengths.std() < 0.16 * lengths.mean()
    assert lengths.min() > 0.3 * lengths.mean()


@pytest.mark.measured
def test_resampling_keeps_the_genus_of_three_holes(measured_data):
    from btfpipe.formats.meshes import read_mesh

    vertices, faces = read_mesh(measured_data / "meshes/three_holes/3holes.obj")
    for n in (500, 10_000):
        _, made, points, _ = resampled(vertices, faces, n)
        assert topology(made, len(points)) == [(-4, 0)]
        assert_manifold(made)


def test_small_components_do_not_vanish(shapes):
    vertices, faces = shapes.sphere(2)
    tiny = vertices * 0.003 + (0, 2, 0)
    both = np.concatenate([vertices, tiny]), np.concatenate([faces, faces + len(vertices)])
    _, made, points, _ = resampled(*both, 500)
    assert topology(made, len(points)) == [(2, 0), (2, 0)]
    assert (points[:, 1] > 1.9).sum() >= 4


def test_the_rim_of_an_open_mesh_stays_where_it_was(shapes):
    vertices, faces = shapes.grid()
    _, made, points, normals = resampled(vertices, faces, 2000)
    start, _ = half_edges(made)
    rim = np.unique(start[opposite_half_edges(made) < 0])
    x, y, z = points[rim].T
    beside = np.minimum.reduce([np.abs(x), np.abs(x - 1.5), np.abs(z), np.abs(z - 1)])
    assert beside.max() < 1e-9
    assert np.abs(y).max() < 1e-9
    for corner in ((0, 0), (1.5, 0), (0, 1), (1.5, 1)):
        assert np.linalg.norm(points[:, [0, 2]] - corner, axis=1).min() < 1e-9
    np.testing.assert_allclose(normals, np.tile((0, 1.0, 0), (len(points), 1)), atol=1e-12)
    corners = points[made]
    twice = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (twice[:, 1] > 0).all()
    assert twice[:, 1].sum() / 2 == pytest.approx(1.5, rel=1e-9)


def test_a_coarse_sphere_gets_the_position_and_the_normals_of_a_round_one(shapes):
    vertices, faces = shapes.sphere(2)  # 162 vertices
    _, _, points, normals = resampled(vertices, faces, 5000)
    _, _, flat, _ = resampled(vertices, faces, 5000, alpha=0.0)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    error = np.degrees(np.arccos(np.clip((normals * outward).sum(axis=1), -1, 1)))
    assert error.max() < 1.5
    # the faces of an icosahedron's second subdivision lie up to 1.8 % inside
    assert np.ptp(np.linalg.norm(flat, axis=1)) > 0.016
    assert np.ptp(np.linalg.norm(points, axis=1)) < 0.008


def test_creases_stay_sharp_and_straight(shapes):
    vertices, faces = shapes.cube()
    _, made, points, normals = resampled(vertices, faces, 3000, crease_deg=30)
    assert np.abs(np.abs(points - 1.5).max(axis=1) - 0.5).max() < 1e-9
    inside = np.sort(np.abs(points - 1.5), axis=1)[:, 1] < 0.5 - 1e-6
    np.testing.assert_allclose(np.abs(normals[inside]).max(axis=1), 1, atol=1e-12)
    corners = points[made]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # cut corners would lose area
    assert area.sum() == pytest.approx(6, rel=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1, 1, allow_subnormal=False), min_size=12, max_size=12))
def test_barycentric_coordinates_give_back_the_point(numbers):
    corners = np.array(numbers[:9]).reshape(1, 3, 3)
    weights = np.abs(numbers[9:]) + 1e-3
    weights = weights / weights.sum()
    point = weights @ corners[0]
    found = barycentric(point[None], corners)
    assert found.min() >= 0
    assert found.sum() == pytest.approx(1)
    # also for triangles without area, whose coordinates are not unique
    assert np.linalg.norm(found[0] @ corners[0] - point) < 1e-5


def test_phong_tessellation_is_continuous_across_edges_and_creases(shapes):
    vertices, faces = shapes.double_ring()
    vertices, faces, _ = clean(vertices + 0.1 * np.sin(7 * vertices[:, [1, 2, 0]]), faces)
    for crease_deg in (None, 60):
        source = smooth_input(vertices, faces, crease_deg)
        opposite = opposite_half_edges(faces)
        h = np.arange(len(opposite))
        g = opposite
        share = 0.3
        here, there = np.zeros((len(h), 3)), np.zeros((len(h), 3))
        here[h, h % 3], here[h, (h + 1) % 3] = 1 - share, share
        there[h, g % 3], there[h, (g + 1) % 3] = share, 1 - share
        np.testing.assert_allclose(
            source.lift(h // 3, here), source.lift(g // 3, there), atol=1e-12
        )
