"""Samples of which a part is invalid: what is not valid is never laid."""

import numpy as np
import pytest

from btfpipe.analysis.features import Features
from btfpipe.analysis.neighbours import add_neighbour_lists, neighbourhood_distances
from btfpipe.analysis.pyramid import fill_invalid, halve, plain_features, valid_pyramid
from btfpipe.analysis.textons import texton_features
from btfpipe.compression.svd import compress_svd
from btfpipe.errors import InputError
from btfpipe.synthesis import CoordinateMap
from btfpipe.synthesis.growth import grow_over_surface
from btfpipe.synthesis.plane import grow_over_plane


def solid(valid, side, toroidal):
    """Naive twin: texels whose square lies inside and is valid."""
    half = side // 2
    padded = np.pad(valid, half, "wrap") if toroidal else np.pad(valid, half)
    out = np.empty(valid.shape, bool)
    for r, c in np.ndindex(valid.shape):
        out[r, c] = padded[r : r + side, c : c + side].all()
    return out


def may_be_laid(mask, toroidal, levels):
    """Naive twin: texels of the finest level whose neighbourhoods of 5 and 3 are valid."""
    fine = solid(mask, 5, toroidal)
    if levels == 1:
        return fine
    shape = (mask.shape[0] // 2, mask.shape[1] // 2)
    coarse = np.empty(shape, bool)
    for r, c in np.ndindex(shape):
        rows, cols = (np.arange(2 * x - 1, 2 * x + 3) for x in (r, c))
        if toroidal:
            rows, cols = rows % mask.shape[0], cols % mask.shape[1]
        else:
            rows, cols = (
                np.clip(x, 0, n - 1) for x, n in zip((rows, cols), mask.shape, strict=True)
            )
        coarse[r, c] = mask[np.ix_(rows, cols)].all()
    coarse = solid(coarse, 3, toroidal)
    return fine & coarse[np.arange(mask.shape[0])[:, None] // 2, np.arange(mask.shape[1]) // 2]


def nearest(grown, shape, toroidal):
    row, col = (np.floor(x[0] + 0.5).astype(int) for x in (grown.row, grown.col))
    return (row % shape[0], col % shape[1]) if toroidal else (row, col)


def ragged(rng, shape=(40, 48), spots=3):
    """The lower left half valid, but for some spots."""
    mask = np.add.outer(-np.arange(shape[0]), np.arange(shape[1])) < 8
    mask[rng.integers(0, shape[0], spots), rng.integers(0, shape[1], spots)] = False
    return mask


@pytest.fixture
def texture(rng):
    """A smooth random picture (40, 48, 3) whose invalid texels stand out, by mask."""

    def make(mask):
        image = rng.random((*mask.shape, 3))
        for axis in (0, 1):
            image = image + np.roll(image, 1, axis) + np.roll(image, -1, axis)
        return np.where(mask[..., None], image, np.float32(1e3)).astype(np.float32)

    return make


@pytest.mark.parametrize("toroidal", [False, True])
@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("seeded", [False, True])
def test_lists_name_valid_neighbourhoods_alone_the_nearest_first(
    texture, rng, toroidal, levels, seeded
):
    mask = ragged(rng)
    features = plain_features(texture(mask), toroidal, levels, mask=mask)
    add_neighbour_lists(features, 6, **({"exhaustive_texels": 500} if seeded else {}))
    lists = features.levels[0].neighbours.reshape(mask.size, -1)
    named = may_be_laid(mask, toroidal, levels)
    assert 50 < named.sum() < mask.sum()
    assert named.ravel()[lists[mask.ravel(), 1:]].all()
    assert (lists[:, 0] == np.arange(mask.size)).all()
    assert (lists[~mask.ravel()] == np.flatnonzero(~mask)[:, None]).all()
    others = np.flatnonzero(named)
    overlap = []
    for texel in others[::40]:
        distance = neighbourhood_distances(features, 0, np.full(len(others), texel), others)
        best = others[np.argsort(distance, kind="stable")[:6]]
        overlap.append(len(set(best) & set(lists[texel])) / 6)
    assert np.mean(overlap) == 1 if not seeded else np.mean(overlap) > 0.6


@pytest.mark.parametrize("toroidal", [False, True])
def test_what_is_invalid_does_not_matter(texture, rng, toroidal):
    mask = ragged(rng)
    images = [texture(mask)]
    images.append(np.where(mask[..., None], images[0], np.nan))
    grown = []
    for image in images:
        features = plain_features(image, toroidal, 2, mask=mask)
        add_neighbour_lists(features, 6)
        grown.append(grow_over_plane(features, (32, 32), k=6, levels=2, seed=1))
    np.testing.assert_array_equal(grown[0].row, grown[1].row)
    np.testing.assert_array_equal(grown[0].col, grown[1].col)


@pytest.mark.parametrize("toroidal", [False, True])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("levels", [1, 2])
def test_no_invalid_texel_is_laid_on_a_plane(texture, rng, toroidal, full, levels):
    mask = ragged(rng)
    features = plain_features(texture(mask), toroidal, levels, mask=mask)
    if not full:
        add_neighbour_lists(features, 6)
    grown = grow_over_plane(features, (32, 40), k=6, levels=levels, full=full, sweeps=(2, 1))
    assert may_be_laid(mask, toroidal, levels)[nearest(grown, mask.shape, toroidal)].all()


def test_no_growth_starts_from_an_invalid_texel(texture, rng):
    mask = ragged(rng)
    features = plain_features(texture(mask), False, 1, mask=mask)
    add_neighbour_lists(features, 6)
    first = set()
    for seed in range(12):  # one sweep: the first texel stays as it was drawn
        grown = grow_over_plane(features, (8, 8), k=6, levels=1, sweeps=(1, 1), seed=seed)
        row, col = nearest(grown, mask.shape, False)
        assert may_be_laid(mask, False, 1)[row, col].all()
        first.add((int(row[0]), int(col[0])))
    assert len(first) > 8


@pytest.mark.parametrize("toroidal", [False, True])
@pytest.mark.parametrize("k", [1, 6])
def test_no_invalid_texel_is_laid_on_a_surface(texture, rng, sphere_surface, toroidal, k):
    mask = ragged(rng)
    features = plain_features(texture(mask), toroidal, 2, mask=mask)
    add_neighbour_lists(features, 6)
    grown = grow_over_surface(features, sphere_surface, k=k, levels=2, sweeps=(3, 1))
    laid = nearest(grown, mask.shape, toroidal)
    assert may_be_laid(mask, toroidal, 2)[laid].all()
    assert len(np.unique(np.ravel_multi_index(laid, mask.shape))) > 50


def test_a_half_that_is_valid_is_used_as_if_it_were_cropped(rng, sphere_surface):
    image = rng.integers(0, 1000, (28, 36, 3)).astype(np.float32)  # whole numbers: no rounding
    mask = np.zeros((28, 36), bool)
    mask[:24, :20] = True
    plane, surface, lists = [], [], []
    for features in (
        plain_features(image, False, 1, mask=mask),
        plain_features(image[:24, :20], False, 1),
    ):
        add_neighbour_lists(features, 8)
        lists.append(
            np.divmod(features.levels[0].neighbours[:24, :20], features.levels[0].shape[1])
        )
        made = grow_over_plane(features, (24, 32), k=8, levels=1, seed=4)
        plane.append((made.row, made.col))
        made = grow_over_surface(
            features, sphere_surface, 12.0, k=8, levels=1, sweeps=(4, 1), seed=4
        )
        surface.append((made.row, made.col))
    np.testing.assert_array_equal(*lists)
    np.testing.assert_array_equal(*plane)
    np.testing.assert_array_equal(*surface)


@pytest.mark.parametrize("toroidal", [False, True])
def test_a_coarse_texel_is_valid_if_the_filter_reads_valid_ones(rng, toroidal):
    mask = rng.random((24, 32)) < 0.98
    levels = valid_pyramid(mask, 3, toroidal)
    poisoned = np.where(mask, 1.0, np.nan)
    for valid in levels:
        np.testing.assert_array_equal(valid, np.isfinite(poisoned))
        poisoned = halve(poisoned, toroidal)


@pytest.mark.parametrize("toroidal", [False, True])
def test_invalid_texels_repeat_the_nearest_valid_one(rng, toroidal):
    mask = rng.random((9, 12)) < 0.2
    image = rng.random((9, 12, 2))
    filled = fill_invalid(image, mask, toroidal)
    places = np.argwhere(mask)
    for r, c in np.ndindex(mask.shape):
        step = np.abs(places - (r, c))
        if toroidal:
            step = np.minimum(step, np.array(mask.shape) - step)
        distance = (step**2).sum(axis=1)
        best = places[distance == distance.min()]
        assert any((filled[r, c] == image[tuple(place)]).all() for place in best)


@pytest.fixture
def half(make_sample):
    """A Sample whose right half is invalid and black."""
    mask = np.zeros((32, 64), bool)
    mask[:, :32] = True
    sample = make_sample(32, 64, mask=mask)
    sample.codes = sample.codes * mask[..., None]
    return sample


def test_textons_are_those_of_valid_texels(half, tmp_path):
    features = texton_features(half, levels=2, n_textons=40, k=6)
    features.save(tmp_path / "f.npz")
    features = Features.open(tmp_path / "f.npz")
    np.testing.assert_array_equal(features.levels[0].valid, half.mask)
    assert features.about["invalid_texels"] == [32 * 32, 16 * 17]
    assert features.about["n_textons"] == [40, 10]
    for level in features.levels:  # every texton is some texel's, and the default is none's
        assert set(np.unique(level.labels[level.valid])) == set(range(len(level.vectors) - 1))
        assert (level.labels[~level.valid] == len(level.vectors) - 1).all()


def test_textons_do_not_depend_on_what_a_model_shows_at_invalid_texels(half):
    model = compress_svd(half, 6)
    made = [texton_features(model, levels=2, n_textons=40, k=6)]
    model.texture_factors[~half.mask] = np.nan
    made.append(texton_features(model, levels=2, n_textons=40, k=6))
    for a, b in zip(*(features.levels for features in made), strict=True):
        np.testing.assert_array_equal(a.labels, b.labels)
        np.testing.assert_array_equal(a.neighbours, b.neighbours)


def test_the_command_line_lays_valid_texels_alone(btfpipe, half, tmp_path, sphere_surface):
    half.save(tmp_path / "s.npz")
    sphere_surface.save(tmp_path / "u.npz")
    btfpipe("textons", tmp_path / "s.npz", "--levels", 2, "-k", 6, "-o", tmp_path / "f.npz")
    assert "invalid texels: 1024 272\n" in btfpipe("info", tmp_path / "f.npz").stdout
    for source in ("f.npz", "s.npz"):
        for target in (["--plane", "32x32"], [tmp_path / "u.npz"]):
            out = tmp_path / "c.npz"
            btfpipe(
                "synthesize", tmp_path / source, *target, "--levels", 2, "-k", 6, "-f", "-o", out
            )
            laid = nearest(CoordinateMap.open(out), half.shape, False)
            assert may_be_laid(half.mask, False, 2)[laid].all()


def test_a_sample_with_nothing_valid_is_refused_in_one_sentence(btfpipe, make_sample, tmp_path):
    mask = np.zeros((32, 32), bool)
    make_sample(32, 32, mask=mask).save(tmp_path / "none.npz")
    mask[:3] = True
    make_sample(32, 32, mask=mask).save(tmp_path / "few.npz")
    mask[:6, ::7] = True
    make_sample(32, 32, mask=mask).save(tmp_path / "thin.npz")
    for name, levels, sentence in (
        ("none.npz", 3, "the sample has no valid texel."),
        ("few.npz", 3, "the sample has no valid texel on level 2: 928 of its 1024 are invalid."),
        (
            "thin.npz",
            1,
            "level 0 has 0 texels whose neighbourhood lies inside the sample and is valid",
        ),
    ):
        for command in (["textons"], ["synthesize", "--plane", "32x32"]):
            done = btfpipe(
                *command, tmp_path / name, "--levels", levels, "-o", tmp_path / "o.npz", code=3
            )
            assert sentence in done.stderr
            assert done.stderr.count("\n") == 1
    full = ["--search", "full", "--plane", "32x32", "--levels", 1]
    done = btfpipe("synthesize", tmp_path / "thin.npz", *full, "-o", tmp_path / "o.npz", code=3)
    assert "(111 of them valid), too few for a neighbourhood of 5 x 5" in done.stderr


def test_features_of_nothing_are_not_made_from_arrays(rng):
    with pytest.raises(InputError, match="no valid texel"):
        plain_features(rng.random((16, 16, 2)), mask=np.zeros((16, 16), bool))
