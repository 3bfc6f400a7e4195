import numpy as np

from btfpipe.surface.prepare import prepare
from btfpipe.surface.pyramid import parents


def test_levels_have_a_quarter_of_the_vertices(shapes):
    surface, facts = prepare(*shapes.torus(), 8000, 3)
    for i, count in enumerate(facts["level_vertices"]):
        assert abs(count - 8000 / 4**i) <= 0.05 * 8000 / 4**i
    assert surface.levels[2].parent_face is None


def test_parents_lie_on_the_normal_of_their_vertex(shapes):
    surface, facts = prepare(*shapes.torus(48, 24), 4000, 2)
    fine, coarse = surface.levels
    assert facts["closest_point_parents"] == [0]
    assert (fine.parent_weights >= 0).all()
    np.testing.assert_allclose(fine.parent_weights.sum(axis=1), 1, atol=1e-5)
    place = np.einsum(
        "nc,ncx->nx", fine.parent_weights, coarse.vertices[coarse.faces[fine.parent_face]]
    )
    away = place - fine.vertices
    beside = away - (away * fine.normals).sum(axis=1, keepdims=True) * fine.normals
    assert np.linalg.norm(beside, axis=1).max() < 1e-5
    assert np.linalg.norm(away, axis=1).max() < 0.03


def test_a_vertex_whose_normal_misses_takes_the_closest_point_and_is_counted():
    coarse = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)
    vertices = np.array([(0.2, 0.2, 0.05), (1.5, 0, 0), (0.2, 0.2, -0.05)])
    normals = np.tile(np.float32((0, 0, 1)), (3, 1))
    face, weights, missed = parents(vertices, normals, coarse, np.array([(0, 1, 2)], np.int32))
    assert missed == 1
    assert face.tolist() == [0, 0, 0]
    np.testing.assert_allclose(weights, [(0.6, 0.2, 0.2), (0, 1, 0), (0.6, 0.2, 0.2)], atol=1e-6)


def test_the_other_side_of_a_thin_wall_is_no_parent():
    coarse = np.array(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, -0.1), (1, 0, -0.1), (0, 1, -0.1)], float
    )
    faces = np.array([(0, 1, 2), (3, 5, 4)], np.int32)  # one looks up, one down
    vertices = np.array([(0.2, 0.2, -0.08), (0.2, 0.2, -0.02)])
    normals = np.float32([(0, 0, 1), (0, 0, -1)])
    face, _, missed = parents(vertices, normals, coarse, faces)
    assert missed == 0
    assert face.tolist() == [0, 1]
