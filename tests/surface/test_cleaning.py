import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from btfpipe.errors import InputError
from btfpipe.surface.cleaning import clean
from btfpipe.surface.topology import describe, opposite_half_edges


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("fx,fx->", a, np.cross(b, c)) / 6


def test_a_clean_mesh_passes_unchanged(shapes):
    vertices, faces = shapes.torus()
    cleaned, same, repairs = clean(vertices, faces)
    np.testing.assert_array_equal(cleaned, vertices)
    np.testing.assert_array_equal(same, faces)
    assert not any(repairs.values())


def test_every_repair_is_made_and_counted(shapes, rng):
    vertices, faces = shapes.sphere(2)
    n = len(vertices)
    soup = vertices[faces].reshape(-1, 3)  # every corner a vertex of its own
    corners = np.arange(len(soup), dtype=np.int32).reshape(-1, 3)
    flipped = rng.permutation(len(faces))[:50]
    corners[flipped] = corners[flipped][:, ::-1]
    corners = np.concatenate([corners, corners[:3], [[0, 0, 5]]]).astype(np.int32)
    soup = np.concatenate([soup, [[np.nan, 0, 0], [9, 9, 9]]])
    cleaned, made, repairs = clean(soup, corners)
    assert repairs["unreferenced_vertices"] == 2
    assert repairs["merged_vertices"] == len(soup) - 2 - n
    assert repairs["duplicate_faces"] == 3
    assert repairs["degenerate_faces"] == 1
    assert repairs["turned_faces"] in (50, len(faces) - 50)
    assert (len(cleaned), len(made)) == (n, len(faces))
    assert (opposite_half_edges(made) >= 0).all()
    assert volume(cleaned, made) == pytest.approx(volume(vertices, faces))


def test_closed_components_are_turned_outward(shapes):
    vertices, faces = shapes.sphere(1)
    cleaned, made, repairs = clean(vertices + 5, faces[:, ::-1])
    assert volume(cleaned, made) > 0
    assert repairs["turned_faces"] == len(faces)


def test_spheres_that_touch_in_a_vertex_are_parted(shapes):
    vertices, faces = shapes.sphere(1)
    top = vertices[:, 1].argmax()
    turn = Rotation.align_vectors([[0, 1, 0]], [vertices[top]])[0].as_matrix()
    vertices = vertices @ turn.T
    other = vertices * (1, -1, 1) + (0, 2, 0)
    cleaned, made, repairs = clean(
        np.concatenate([vertices, other]), np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    )
    assert repairs["merged_vertices"] == repairs["split_vertices"] == 1
    assert describe(made, len(cleaned))[0].tolist() == [2, 2]


def moebius(n=30):
    u = np.arange(n) * 2 * np.pi / n
    rows = []
    for w in (-0.3, 0.3):
        reach = 1 + w * np.cos(u / 2)
        rows.append(np.stack([reach * np.cos(u), reach * np.sin(u), w * np.sin(u / 2)], 1))
    vertices = np.concatenate(rows)
    low, high = np.arange(n), np.arange(n) + n
    # after one turn the strip's lower side meets its upper one
    next_low, next_high = np.r_[low[1:], high[0]], np.r_[high[1:], low[0]]
    faces = np.concatenate(
        [np.stack([low, next_low, next_high], 1), np.stack([low, next_high, high], 1)]
    )
    return vertices, faces.astype(np.int32)


def fin(shapes):
    vertices, faces = shapes.sphere(1)
    a, b = faces[0, :2]
    return (
        np.concatenate([vertices, [2 * vertices[a]]]),
        np.concatenate([faces, [[a, b, len(vertices)]]]).astype(np.int32),
    )


def loose(shapes):
    points = np.random.default_rng(1).random((60, 3))
    return points, np.arange(60, dtype=np.int32).reshape(-1, 3)


def not_finite(shapes):
    vertices, faces = shapes.sphere(1)
    vertices[7, 1] = np.inf
    return vertices, faces


def without_area(shapes):
    return np.linspace((0, 0, 0), (1, 2, 3), 9), np.array([(0, 1, 2), (1, 2, 3)], np.int32)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda shapes: moebius(), "one-sided like a Möbius strip"),
        (fin, "1 edges are shared by more than 2 faces .first: 3 faces at the edge from"),
        (loose, "20 of 20 faces share no edge"),
        (not_finite, "1 of 42 vertices are not finite .first: vertex 7"),
        (without_area, "nothing is left after cleaning"),
    ],
)
def test_what_cannot_be_dressed_is_refused_with_counts_and_places(shapes, make, says):
    with pytest.raises(InputError, match=f"^thing.obj: .*{says}"):
        clean(*make(shapes), name="thing.obj")
