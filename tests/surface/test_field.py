import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.surface import field
from btfpipe.surface import prepare as preparing
from btfpipe.surface.prepare import prepare
from btfpipe.surface.topology import edges


def angle_between(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


@pytest.mark.parametrize(
    ("shape", "euler", "most"), [("sphere", 2, 2), ("torus", 0, 0), ("double_ring", -2, 8)]
)
def test_indices_of_singularities_add_up_to_the_euler_characteristic(shapes, shape, euler, most):
    surface, facts = prepare(*getattr(shapes, shape)(), 4000, 2)
    assert facts["index_sum"] == facts["euler_characteristic"] == euler
    assert facts["singularities"] <= most
    for level in surface.levels:
        index = field.singularities(level.faces, level.normals, level.tangents)
        assert index.sum() == euler


def test_a_field_around_the_axis_has_its_singularities_at_the_poles(shapes):
    vertices, faces = shapes.sphere(3)
    tangents = np.cross((0.3, 1.0, 0.2), vertices)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    index = field.singularities(faces, vertices, tangents)
    where = vertices[faces[index != 0]].mean(axis=1)
    assert index[index != 0].tolist() == [1, 1]
    assert np.abs(where @ (0.3, 1.0, 0.2)).min() > 1.0


def test_a_sphere_without_strokes_is_combed_around_the_y_axis(shapes):
    surface, _ = prepare(*shapes.sphere(3), 4000, 2)
    finest = surface.levels[0]
    expected = np.cross(field.UP, finest.normals)
    away = np.linalg.norm(expected, axis=1) > 0.5
    assert np.degrees(angle_between(finest.tangents, expected)[away].max()) < 6


def test_the_field_of_a_dense_last_level_comes_from_coarser_ones(shapes, monkeypatch):
    """To factorise the matrix of 60,000 vertices takes a minute, and of 250,000 many."""
    factorised, real = [], field.relaxed_field

    def relaxed(vertices, faces, normals):
        factorised.append(len(vertices))
        return real(vertices, faces, normals)

    monkeypatch.setattr(field, "relaxed_field", relaxed)
    direct, facts = prepare(*shapes.double_ring(), 4000, 1)
    monkeypatch.setattr(preparing, "_MOST_RELAXED", 1000)
    surface, facts_of_both = prepare(*shapes.double_ring(), 4000, 1)
    assert factorised == [facts["vertices"], pytest.approx(1000, rel=0.1)]
    assert len(surface.levels) == 1
    assert surface.levels[0].parent_face is None
    assert facts_of_both.keys() == facts.keys()
    assert facts_of_both["closest_point_parents"] == []
    assert facts_of_both["index_sum"] == facts["euler_characteristic"]
    assert facts_of_both["singularities"] == facts["singularities"]
    off = np.degrees(angle_between(surface.levels[0].tangents, direct.levels[0].tangents))
    assert np.median(off) < 10


def test_frames_are_orthonormal_and_right_handed(shapes):
    surface, _ = prepare(*shapes.double_ring(), 2000, 2)
    for level in surface.levels:
        s, t, n = level.tangents, level.bitangents, level.normals
        for vector in (s, t, n):
            np.testing.assert_allclose(np.linalg.norm(vector, axis=1), 1, atol=1e-5)
        np.testing.assert_allclose((s * n).sum(axis=1), 0, atol=1e-5)
        np.testing.assert_allclose(np.einsum("nx,nx->n", np.cross(s, t), n), 1, atol=1e-5)


def test_the_field_passes_through_strokes_and_is_smooth_around_them(shapes):
    points = [(1, 0, 0), (0, 0, 1), (0, 1, 0)]
    vectors = [(0, 1, 0), (1, 1, 0), (1, 0, 1)]
    surface, _ = prepare(
        *shapes.sphere(3), 6000, 2, strokes=list(zip(points, vectors, strict=True))
    )
    finest = surface.levels[0]
    a, b = edges(finest.faces).T
    carried = field.transport(finest.tangents[a], finest.normals[a], finest.normals[b])
    change = np.degrees(angle_between(carried, finest.tangents[b]))
    for point, vector in zip(np.array(points, float), np.array(vectors, float), strict=True):
        near = np.linalg.norm(finest.vertices - point, axis=1) < 0.1
        wanted = vector - finest.normals[near] @ vector[:, None] * finest.normals[near]
        assert np.degrees(angle_between(finest.tangents[near], wanted).max()) < 12
        # an edge is 0.045 long here: a few degrees along it
        assert change[near[a] & near[b]].max() < 6


def test_transport_is_the_shortest_rotation(rng):
    from scipy.spatial.transform import Rotation

    start, end = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.normal(size=(2, 20, 3)))
    vectors = np.cross(start, rng.normal(size=(20, 3)))
    axis = np.cross(start, end)
    turn = Rotation.from_rotvec(
        axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle_between(start, end)[:, None]
    )
    np.testing.assert_allclose(field.transport(vectors, start, end), turn.apply(vectors), atol=1e-9)


def test_turning_the_field_turns_every_tangent(shapes):
    straight, _ = prepare(*shapes.torus(), 1000, 1)
    turned, _ = prepare(*shapes.torus(), 1000, 1, turn=np.pi / 2)
    np.testing.assert_allclose(turned.levels[0].tangents, straight.levels[0].bitangents, atol=1e-6)


@pytest.mark.parametrize(
    ("stroke", "says"),
    [
        (((5, 0, 0), (0, 1, 0)), "stroke 1: its point is 4 away"),
        (((1, 0, 0), (2, 0, 0)), "stroke 1: its vector stands on the surface"),
    ],
)
def test_strokes_that_say_nothing_are_refused(shapes, stroke, says):
    with pytest.raises(InputError, match=says):
        prepare(*shapes.sphere(2), 4000, 1, strokes=[stroke])
