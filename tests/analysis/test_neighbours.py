"""Neighbour lists against a naive twin."""

import numpy as np
import pytest

from btfpipe.analysis import FeatureLevel, Features
from btfpipe.analysis.neighbours import (
    add_neighbour_lists,
    coarse_texel,
    neighbourhood_distances,
)
from btfpipe.analysis.pyramid import plain_features
from btfpipe.errors import InputError


def smooth(rng, rows, cols, depth=3):
    """A toroidal texture with structure at several scales."""
    from scipy.ndimage import gaussian_filter

    noise = rng.normal(size=(rows, cols, depth))
    parts = [gaussian_filter(noise, (s, s, 0), mode="wrap") * s for s in (1, 2, 4)]
    return sum(parts)


def textons(rng, rows, cols, count, depth=6, toroidal=True, levels=2):
    """Features with random labels and a Gram matrix; the vectors are wrong on purpose."""
    made = []
    for i in range(levels):
        full = rng.normal(size=(count + 1, depth))
        full[-1] = full[:-1].mean(axis=0)
        labels = rng.integers(0, count, (rows >> i, cols >> i)).astype(np.int32)
        made.append(FeatureLevel(labels, np.zeros((count + 1, 1), np.float32), full @ full.T))
    return Features(made, {"toroidal": toroidal})


def naive_distances(features, i, side, coarse_side):
    """All squared neighbourhood distances of level i (texels, texels), float64, and which texels are inside."""

    def windows(level, places, side):
        rows, cols = level.shape
        out = []
        for r, c in places:
            window = []
            for dr in range(-(side // 2), side // 2 + 1):
                for dc in range(-(side // 2), side // 2 + 1):
                    a, b = r + dr, c + dc
                    if features.toroidal:
                        a, b = a % rows, b % cols
                    window.append(level.labels[a, b] if 0 <= a < rows and 0 <= b < cols else -1)
            out.append(window)
        return np.array(out)

    def table(level):
        if level.gram is None:
            v = level.vectors.astype(float)
            return ((v[:, None] - v[None]) ** 2).sum(axis=2)
        g = np.asarray(level.gram, float)
        return np.diagonal(g)[:, None] + np.diagonal(g)[None] - 2 * g

    level = features.levels[i]
    places = [(r, c) for r in range(level.shape[0]) for c in range(level.shape[1])]
    parts = [(level, places, side)]
    if i + 1 < len(features.levels):
        above = [
            (round((r + 0.5) / 2 - 0.5 + 1e-9), round((c + 0.5) / 2 - 0.5 + 1e-9))
            for r, c in places
        ]
        parts.append((features.levels[i + 1], above, coarse_side))
    total, inside = 0.0, np.ones(len(places), bool)
    for part, where, width in parts:
        window = windows(part, where, width)
        inside &= (window >= 0).all(axis=1)
        distance = table(part)[window[:, None], window[None]]
        both = (window[:, None] >= 0) & (window[None] >= 0)
        total = total + np.where(both, distance, 0).sum(axis=2)
    return total, inside


def test_coarse_texel_is_the_one_nearest_to_the_place_on_the_coarser_level():
    fine = np.arange(50)
    place = (fine + 0.5) / 2 - 0.5
    nearest = np.abs(place[:, None] - np.arange(25)).argmin(axis=1)
    assert [coarse_texel(int(x)) for x in fine] == nearest.tolist()


@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize("kind", ["plain", "textons"])
def test_exhaustive_lists_match_brute_force(rng, toroidal, kind):
    if kind == "plain":
        features = plain_features(smooth(rng, 14, 18), toroidal, levels=2)
    else:
        features = textons(rng, 14, 18, 20, toroidal=toroidal)
    add_neighbour_lists(features, k=9)
    for i, level in enumerate(features.levels):
        distance, inside = naive_distances(features, i, 5, 3)
        lists = level.neighbours.reshape(-1, 9)
        texel = np.arange(len(lists))
        assert np.array_equal(lists[:, 0], texel)
        assert inside[lists[:, 1:]].all()
        assert (np.diff(np.sort(lists, axis=1), axis=1) > 0).all()
        np.fill_diagonal(distance, np.inf)
        best = np.sort(np.where(inside[None], distance, np.inf), axis=1)[:, :8]
        assert np.allclose(distance[texel[:, None], lists[:, 1:]], best, rtol=1e-5)


@pytest.mark.parametrize("toroidal", [True, False])
def test_neighbourhood_distances_match_brute_force(rng, toroidal):
    features = textons(rng, 14, 18, 20, toroidal=toroidal)
    features.about |= {"neighbourhood": 5, "coarse_neighbourhood": 3}
    expected, inside = naive_distances(features, 0, 5, 3)
    texels = rng.integers(0, 14 * 18, 300)
    others = rng.choice(np.flatnonzero(inside), 300)
    found = neighbourhood_distances(features, 0, texels, others)
    assert np.allclose(found, expected[texels, others], rtol=1e-5)


@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize("kind", ["plain", "textons"])
def test_seeded_lists_are_nearly_as_near_as_exhaustive_ones(rng, toroidal, kind):
    features = plain_features(smooth(rng, 64, 64), toroidal, levels=2)
    if kind == "textons":  # the same distances, through a table
        for level in features.levels:
            level.gram = level.vectors.astype(np.float64) @ level.vectors.T
    add_neighbour_lists(features, k=9)
    exact = features.levels[0].neighbours[..., 1:].ravel()
    add_neighbour_lists(features, k=9, exhaustive_texels=1024)
    lists = features.levels[0].neighbours
    assert np.array_equal(lists[..., 0].ravel(), np.arange(4096))
    texel = np.repeat(np.arange(4096), 8)
    seeded = neighbourhood_distances(features, 0, texel, lists[..., 1:].ravel())
    exact = neighbourhood_distances(features, 0, texel, exact)
    assert (seeded >= exact * (1 - 1e-5)).reshape(-1, 8).all(axis=1).mean() > 0.99
    assert seeded.mean() < 1.03 * exact.mean()
    if not toroidal:
        row, col = lists[..., 1:] // 64, lists[..., 1:] % 64
        assert row.min() == col.min() == 2
        assert row.max() == col.max() == 61


def test_large_single_level_of_odd_sides_is_seeded_from_its_own_low_pass(rng):
    image = smooth(rng, 35, 41)
    features = plain_features(image, toroidal=False, levels=1)
    add_neighbour_lists(features, k=6, exhaustive_texels=500)
    seeded = features.levels[0].neighbours.copy()
    add_neighbour_lists(features, k=6)
    texel = np.repeat(np.arange(35 * 41), 5)
    near, far = (
        neighbourhood_distances(features, 0, texel, lists[..., 1:].ravel())
        for lists in (features.levels[0].neighbours, seeded)
    )
    assert far.mean() < 1.1 * near.mean()


def test_threads_do_not_change_the_lists(rng):
    features = plain_features(smooth(rng, 32, 32), levels=2)
    for most in (4096, 256):
        one, two = (
            add_neighbour_lists(features, 7, threads=threads, exhaustive_texels=most)
            .levels[0]
            .neighbours.tobytes()
            for threads in (1, 2)
        )
        assert one == two


def test_equal_distances_go_to_the_first_texel():
    features = plain_features(np.zeros((16, 16, 2)), toroidal=True, levels=1)
    add_neighbour_lists(features, 4)
    assert features.levels[0].neighbours[3, 3].tolist() == [51, 0, 1, 2]


def test_lists_longer_than_the_sample_offers_are_refused(rng):
    features = plain_features(smooth(rng, 16, 16), toroidal=False, levels=2)
    with pytest.raises(InputError, match=r"level 1 has 16 texels .* fewer than k = 20"):
        add_neighbour_lists(features, 20)


def test_a_level_smaller_than_the_neighbourhood_is_refused(rng):
    features = plain_features(smooth(rng, 16, 16), toroidal=True, levels=2)
    with pytest.raises(InputError, match="fewer than its neighbourhood of 9 x 9"):
        add_neighbour_lists(features, 5, neighbourhood=9)
