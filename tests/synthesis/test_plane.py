"""Planar growth: a naive twin, and laws that need none."""

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.hashing import uniform
from btfpipe.synthesis.coherence import coherence_facts
from btfpipe.synthesis.plane import grow_over_plane


def squares_of(image, side):
    """The vectors of the square about every place of a toroidal image, (rows, cols, side * side, d)."""
    around = range(-(side // 2), side // 2 + 1)
    return np.stack([np.roll(image, (-i, -j), (0, 1)) for i in around for j in around], axis=2)


def naive_sweep(features, i, out, below, done, k, kappa):
    """One sweep over level i of a plane, texel by texel, with nothing but the definitions.

    `out` (rows, cols, 2) is changed in place, and so is `done`; `below` is the next coarser level's, or None.
    """
    level = features.levels[i]
    rows, cols = level.shape
    image = level.vectors[level.labels].astype(np.float64)
    offsets = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]
    squares = squares_of(image, 5)
    if below is not None:
        coarse = features.levels[i + 1]
        coarse = coarse.vectors[coarse.labels].astype(np.float64)
        coarse_squares = squares_of(coarse, 3)
        ours = squares_of(coarse[below[..., 0], below[..., 1]], 3)

    def inside(r, c):
        return features.toroidal or (2 <= r < rows - 2 and 2 <= c < cols - 2)

    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            around = [(i, j, (r + i) % out.shape[0], (c + j) % out.shape[1]) for i, j in offsets]
            known = [n for n, (_, _, y, x) in enumerate(around) if done[y, x]]
            around = [around[n] for n in known]
            if not around:
                done[r, c] = True
                continue
            votes = {}
            for i, j, y, x in around:
                s, e = out[y, x, 0] - i, out[y, x, 1] - j
                if features.toroidal:
                    s, e = s % rows, e % cols
                if 0 <= s < rows and 0 <= e < cols:
                    votes[s, e] = votes.get((s, e), 0) + 1
            penalty = {
                texel: 1 + kappa * (1 - n / len(around))
                for texel, n in votes.items()
                if inside(*texel)
            }
            for s, e in votes:
                for t in level.neighbours[s, e, 1:k] if k > 1 else ():
                    if divmod(int(t), cols) not in votes:
                        penalty[divmod(int(t), cols)] = 1 + kappa
            seen = np.array([image[tuple(out[y, x])] for _, _, y, x in around])
            best, lowest = None, np.inf
            for (s, e), factor in penalty.items():
                distance = ((seen - squares[s, e][known]) ** 2).sum()
                if below is not None:
                    distance += ((ours[r // 2, c // 2] - coarse_squares[s // 2, e // 2]) ** 2).sum()
                if factor * distance < lowest:
                    best, lowest = (s, e), factor * distance
            out[r, c] = best
            done[r, c] = True


def naive_growth(features, shape, k, sweeps, coherence, seed):
    """Rows and cols of the sample, (rows, cols, 2), that a plane of this shape gets."""
    below, count = None, len(features.levels)
    for i in reversed(range(count)):
        rows, cols = shape[0] >> i, shape[1] >> i
        size = features.levels[i].shape
        out = np.empty((rows, cols, 2), int)
        for r in range(rows):
            for c in range(cols):
                if below is None:
                    out[r, c] = [int(uniform(seed, r * cols + c, d) * size[d]) for d in (0, 1)]
                else:
                    out[r, c] = 2 * below[r // 2, c // 2] + [r % 2, c % 2]
        done = np.full((rows, cols), below is not None)
        for _ in range(sweeps[0] if below is None else sweeps[1]):
            # coherence does not count on the coarsest level
            kappa = 0.0 if below is None else coherence / 2**i
            naive_sweep(features, i, out, below, done, k, kappa)
        below = out
    return out


@pytest.mark.parametrize(
    ("shape", "levels", "coherence"), [((9, 11), 1, 0.0), ((9, 11), 1, 0.7), ((24, 20), 3, 0.7)]
)
def test_compiled_growth_equals_its_naive_twin(make_features, shape, levels, coherence):
    size = {"rows": 20, "cols": 28} if levels > 1 else {}
    features = make_features(k=6, smooth=False, levels=levels, **size)
    options = {"k": 6, "sweeps": (2, 1), "coherence": coherence, "seed": 5}
    expected = naive_growth(features, shape, **options)
    grown = grow_over_plane(features, shape, levels=levels, **options)
    np.testing.assert_array_equal(grown.row.reshape(shape), expected[..., 0])
    np.testing.assert_array_equal(grown.col.reshape(shape), expected[..., 1])


def test_both_forms_of_the_distance_choose_alike(make_features):
    features = make_features(levels=2, k=6, toroidal=False, rows=24, cols=24)
    a, b = (
        grow_over_plane(features, (32, 32), k=6, levels=2, distance=form, seed=2)
        for form in ("gram", "vectors")
    )
    np.testing.assert_array_equal(a.row, b.row)
    np.testing.assert_array_equal(a.col, b.col)


def test_lists_of_all_texels_are_full_search(make_features):
    features = make_features(rows=8, cols=8, k=64, smooth=False)
    options = {"levels": 1, "sweeps": (3, 1), "seed": 4}
    a = grow_over_plane(features, (12, 10), k=64, **options)
    b = grow_over_plane(features, (12, 10), full=True, **options)
    np.testing.assert_array_equal(a.row, b.row)
    np.testing.assert_array_equal(a.col, b.col)


def test_one_neighbour_copies_a_toroidal_sample_whole(make_features):
    features = make_features(rows=16, cols=20)
    grown = grow_over_plane(features, (16, 20), k=1, levels=1, sweeps=(1, 1), seed=6)
    row, col = grown.row.reshape(16, 20), grown.col.reshape(16, 20)
    np.testing.assert_array_equal(row, (row[0, 0] + np.arange(16)[:, None] + 0 * col) % 16)
    np.testing.assert_array_equal(col, (col[0, 0] + np.arange(20)[None] + 0 * row) % 20)
    facts = coherence_facts(grown, None, (16, 20), True)
    assert facts == {"coherent_share": 1.0, "patch_texels": 320.0}


def test_one_neighbour_continues_runs_of_its_surroundings(make_features):
    features = make_features(rows=14, cols=14, toroidal=False)
    shape = (24, 20)
    grown = grow_over_plane(features, shape, k=1, levels=1, sweeps=(1, 1), seed=1)
    fallbacks = grown.about["synthesis"][0]["fallbacks"]
    row, col = grown.row.reshape(shape), grown.col.reshape(shape)
    done = np.zeros(shape, bool)
    broken = -1  # the first texel has nothing to continue
    for r in range(shape[0]):
        for c in range(shape[1]):
            runs = set()
            for i in range(-2, 3):
                for j in range(-2, 3):
                    y, x = (r + i) % shape[0], (c + j) % shape[1]
                    if done[y, x]:
                        runs.add((row[y, x] - i, col[y, x] - j))
            broken += (row[r, c], col[r, c]) not in runs
            done[r, c] = True
    assert broken == fallbacks > 0  # the sample ends somewhere, and full search steps in


def test_candidates_never_leave_a_sample_with_borders(make_features):
    features = make_features(rows=24, cols=28, toroidal=False, levels=2)
    grown = grow_over_plane(features, (40, 40), levels=2, k=5, seed=3)
    assert grown.row.min() >= 2
    assert grown.row.max() <= 21
    assert grown.col.min() >= 2
    assert grown.col.max() <= 25


def test_the_seed_decides(make_features):
    features = make_features()
    a, b, c = (grow_over_plane(features, (16, 16), k=5, levels=1, seed=s) for s in (1, 1, 2))
    assert a.row.tobytes() == b.row.tobytes()
    assert a.row.tobytes() != c.row.tobytes()


def test_a_plane_that_cannot_be_halved_is_refused(make_features):
    with pytest.raises(InputError, match="multiples of 2"):
        grow_over_plane(make_features(levels=2), (31, 32), levels=2)


def test_more_levels_than_the_features_have_are_refused(make_features):
    with pytest.raises(InputError, match="have 1 levels, fewer than --levels 3"):
        grow_over_plane(make_features(), (32, 32))


def test_missing_and_short_lists_are_refused(make_features):
    with pytest.raises(InputError, match="no neighbour lists"):
        grow_over_plane(make_features(k=None), (32, 32), levels=1)
    with pytest.raises(InputError, match="lists of 5 neighbours, fewer than k = 11"):
        grow_over_plane(make_features(k=5), (32, 32), levels=1)


def test_a_sample_smaller_than_its_neighbourhood_is_refused(make_features):
    features = make_features(rows=16, cols=16, k=None, toroidal=False)
    features.about["neighbourhood"] = 17
    with pytest.raises(InputError, match=r"16 x 16 texels, too few for a neighbourhood of 17 x 17"):
        grow_over_plane(features, (32, 32), levels=1, full=True)
