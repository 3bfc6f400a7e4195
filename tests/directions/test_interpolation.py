"""Weights between measured directions."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from btfpipe.directions import Hemisphere, bonn81, from_angles, ubo2014
from btfpipe.errors import InputError

SETS = {
    "bonn81": bonn81(),
    "ubo2014": ubo2014(),
    "one": bonn81()[:1],
    "two": bonn81()[:2],
    "on a line": from_angles(np.linspace(-1.2, 1.2, 6), 0.3),
    "scattered": from_angles(*(np.random.default_rng(4).random((2, 40)) * [[1.5], [6.28]])),
}


def dense(hemisphere, queries):
    """Weights over all directions, (queries, directions)."""
    index, weight = hemisphere.weights(queries)
    out = np.zeros((len(queries), len(hemisphere.directions)))
    for k in range(4):
        np.add.at(out, (np.arange(len(queries)), index[:, k]), weight[:, k])
    return out


def somewhere(n, rng):
    return from_angles(np.arccos(rng.random(n)), rng.random(n) * 2 * np.pi)


@pytest.mark.parametrize("method", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("name", SETS)
def test_weights_are_shares_and_measured_directions_return_themselves(name, method, rng):
    directions = SETS[name]
    hemisphere = Hemisphere(directions, method)
    weights = dense(hemisphere, somewhere(500, rng))
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-9)
    assert weights.min() >= -1e-8
    np.testing.assert_allclose(dense(hemisphere, directions), np.eye(len(directions)), atol=1e-7)


@pytest.mark.parametrize("name", ["bonn81", "ubo2014", "scattered"])
def test_barycentric_weights_are_those_of_the_stereographic_triangulation(name, rng):
    directions = SETS[name]
    queries = somewhere(2000, rng)
    points, at = (d[:, :2] / (1 + d[:, 2:]) for d in (directions, queries))
    mesh = Delaunay(points)
    simplex = mesh.find_simplex(at)
    inside = simplex >= 0
    assert 0.3 < inside.mean() < 1
    weights = dense(Hemisphere(directions), queries)[inside]
    # cocircular points have several Delaunay triangulations; scipy builds the same one from the same points
    np.testing.assert_allclose(weights @ points, at[inside], atol=1e-9)
    used = [set(np.flatnonzero(w > 1e-9)) for w in weights]
    corners = [set(mesh.simplices[s]) for s in simplex[inside]]
    assert all(a <= b for a, b in zip(used, corners, strict=True))


@pytest.mark.parametrize("name", ["bonn81", "scattered"])
def test_outside_the_hull_the_nearest_point_of_it_counts(name, rng):
    directions = SETS[name]
    points = directions[:, :2] / (1 + directions[:, 2:])
    queries = from_angles(np.radians(rng.uniform(80, 90, 300)), rng.random(300) * 2 * np.pi)
    at = queries[:, :2] / (1 + queries[:, 2:])
    outside = Delaunay(points).find_simplex(at) < 0
    found = dense(Hemisphere(directions), queries)[outside] @ points
    # brute force: densely sampled edges of the hull
    from scipy.spatial import ConvexHull

    t = np.linspace(0, 1, 400)[:, None]
    border = np.concatenate(
        [points[a] * (1 - t) + points[b] * t for a, b in ConvexHull(points).simplices]
    )
    best = np.linalg.norm(at[outside][:, None] - border, axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(found - at[outside], axis=1), best, atol=1e-4)


@pytest.mark.parametrize(("method", "count"), [("nearest", 1), ("four", 4)])
@pytest.mark.parametrize("name", ["bonn81", "ubo2014", "scattered"])
def test_nearest_directions_are_the_nearest(name, method, count, rng):
    directions = SETS[name]
    queries = np.concatenate(
        [somewhere(3000, rng), from_angles(np.pi / 2, np.linspace(0, 6.2, 200))]
    )
    index, _ = Hemisphere(directions, method).weights(queries)
    found = np.linalg.norm(directions[index[:, :count]] - queries[:, None], axis=2)
    true = np.sort(np.linalg.norm(directions[None] - queries[:, None], axis=2), axis=1)[:, :count]
    np.testing.assert_allclose(np.sort(found, axis=1), true, atol=1e-9)


@pytest.mark.parametrize("name", SETS)
def test_weights_of_the_four_nearest_are_those_of_the_definition(name, rng):
    """Squares of what each is nearer than the first one left out, in inverse distances (Franke and Little)."""
    directions = SETS[name]
    queries = np.concatenate([somewhere(400, rng), from_angles(np.pi / 2, np.linspace(0, 6.2, 50))])
    found = dense(Hemisphere(directions, "four"), queries)
    distance = np.linalg.norm(directions[None] - queries[:, None], axis=2)
    order = np.argsort(distance, axis=1)
    for query, near in enumerate(order):
        expected = np.zeros(len(directions))
        # none is left out: none is farther than the sphere's diameter
        radius = distance[query, near[4]] if len(directions) > 4 else 2.0
        for k in near[:4]:
            expected[k] = (1 / distance[query, k] - 1 / radius) ** 2
        np.testing.assert_allclose(found[query], expected / expected.sum(), atol=1e-6)


@pytest.mark.parametrize("method", ["barycentric", "four"])
def test_weights_are_continuous(method, rng):
    hemisphere = Hemisphere(bonn81(), method)
    queries = somewhere(2000, rng)
    step = queries + 1e-5 * rng.normal(size=queries.shape)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    step[:, 2] = np.maximum(step[:, 2], 0)
    change = np.abs(dense(hemisphere, queries) - dense(hemisphere, step)).max()
    assert change < 5e-3


def test_below_the_surface_counts_as_the_horizon():
    hemisphere = Hemisphere(bonn81())
    below = from_angles(np.radians(100), np.linspace(0, 6, 50))
    level = from_angles(np.radians(90), np.linspace(0, 6, 50))
    np.testing.assert_allclose(dense(hemisphere, below), dense(hemisphere, level), atol=1e-12)


@pytest.mark.parametrize(
    ("directions", "method", "message"),
    [
        (np.zeros((3, 2)), "four", "expected"),
        (np.array([[0, 0, 2.0]]), "four", "unit vectors"),
        (np.array([[0, 0, -1.0]]), "four", "points below the surface"),
        (bonn81(), "bilinear", "expected barycentric, four or nearest"),
    ],
)
def test_unusable_directions_are_refused(directions, method, message):
    with pytest.raises(InputError, match=message):
        Hemisphere(directions, method)
