"""Textons: the short way through eigen-textures against the long way through every picture."""

import numpy as np
import pytest

from btfpipe.analysis import Features
from btfpipe.analysis.filters import base_sigma, filter_pictures, leung_malik
from btfpipe.analysis.pyramid import halve
from btfpipe.analysis.textons import (
    appearance_vectors,
    cluster,
    eigen_textures,
    equalise,
    feature_image,
    picture_weights,
    representative_pictures,
    texton_features,
    texton_level,
)
from btfpipe.compression import compress
from btfpipe.compression.svd import SvdModel, compress_svd
from btfpipe.errors import InputError


def filter_all(pictures, toroidal):
    """Responses (texels, filter, picture, channel) float64 of pictures (n, rows, cols, 3)."""
    n, rows, cols, _ = pictures.shape
    planes = pictures.transpose(0, 3, 1, 2).reshape(3 * n, rows, cols)
    responses = np.stack(
        list(filter_pictures(planes, leung_malik(base_sigma(rows, cols)), toroidal))
    )
    return responses.astype(float).reshape(48, n, 3, rows * cols).transpose(3, 0, 1, 2)


def distances(vectors):
    """All squared distances (n, n) float64."""
    vectors = np.asarray(vectors, float)
    vectors = vectors - vectors.mean(axis=0)
    square = (vectors**2).sum(axis=1)
    return square[:, None] + square[None] - 2 * vectors @ vectors.T


@pytest.fixture
def sample(make_sample):
    return make_sample(16, 20, toroidal=True)


@pytest.fixture
def model(sample):
    return compress_svd(sample, 12, precision="single")


def test_responses_of_eigen_textures_are_those_of_the_models_own_pictures(model):
    explicit = filter_all(model.pictures(slice(None)), toroidal=True)
    short = appearance_vectors(model.texture_factors, True).reshape(320, 48, -1)
    combined = np.einsum("pfn,acn->pfac", short, model.angular_factors)
    assert np.abs(combined - explicit).max() < 2e-6 * np.abs(explicit).max()


METHODS = {
    "coded": {"ratio": 4},
    "svd": {"components": 6},
    "factored": {"channel_components": (6, 3, 3)},
    "view-pca": {"components": 3},
    "local-pca": {"components": 3, "clusters": 4},
    "harmonics": {"view_harmonics": 4, "light_harmonics": 9},
}


@pytest.mark.parametrize("method", [None, *METHODS])
def test_distances_of_features_are_those_of_all_values(sample, method):
    appearance = compress([sample], method, **METHODS[method]) if method else sample
    values = appearance.pictures(slice(None)).transpose(1, 2, 0, 3).reshape(320, -1)
    features, few = (feature_image(appearance, n) for n in (None, 3))
    assert features.shape[:2] == few.shape[:2] == (16, 20)
    expected = distances(values)
    # but for what 40 terms and half precision leave out
    np.testing.assert_allclose(
        distances(features.reshape(320, -1)), expected, atol=3e-3 * expected.max()
    )
    assert few.shape[2] == 3
    assert (distances(few.reshape(320, -1)) <= expected + 3e-3 * expected.max()).all()


def test_responses_are_those_of_the_original_pictures_within_the_compression_error(sample):
    model = compress_svd(sample, 4, precision="single")
    assert model.about["relative_error"] > 0.01
    original = filter_all(sample.pictures(slice(None)), toroidal=True)
    short = filter_all(model.pictures(slice(None)), toroidal=True)
    # absolute values of a filter sum to 1, so on a torus it lengthens no picture
    error = np.sqrt(((original - short) ** 2).mean(axis=(0, 2, 3)))
    assert error.max() <= model.about["rmse"] * 1.0001
    assert error.max() > 0.1 * model.about["rmse"]


def test_dot_products_and_distances_are_those_of_the_explicit_vectors(model, rng):
    pictures = np.sort(rng.choice(model.n_pairs, 40, replace=False))
    explicit = filter_all(model.pictures(pictures), toroidal=True).reshape(320, -1)
    assert explicit.shape[1] == 48 * 40 * 3
    textures, angular = eigen_textures(model)
    short = appearance_vectors(textures @ picture_weights(angular[pictures]), True).astype(float)
    assert np.allclose(short @ short.T, explicit @ explicit.T, rtol=1e-5)
    far = distances(explicit)
    assert np.abs(distances(short) - far).max() < 1e-5 * far.max()


def test_filters_can_be_made_to_vary_alike(model):
    """By the same factors as those of the explicit vectors; a filter that sees nothing is not blown up."""
    explicit = filter_all(model.pictures(slice(None)), toroidal=True)
    energy = explicit.var(axis=0).sum(axis=(1, 2))
    textures, angular = eigen_textures(model)
    vectors = appearance_vectors(textures @ picture_weights(angular), True)
    factors = equalise(vectors)
    assert np.allclose(factors, np.sqrt(energy.max() / energy), rtol=1e-4)
    alike = vectors.reshape(320, 48, -1).var(axis=0).sum(axis=1)
    assert np.allclose(alike, alike[0], rtol=1e-4)
    stripes = np.broadcast_to(textures[:1], textures.shape)
    assert equalise(appearance_vectors(stripes, True)).max() == pytest.approx(50)


def test_gram_distances_and_texton_map_are_those_of_the_explicit_appearance_vectors(model):
    explicit = filter_all(model.pictures(slice(None)), toroidal=True).reshape(320, -1)
    textures, angular = eigen_textures(model)
    textons = cluster(appearance_vectors(textures @ picture_weights(angular), True), 30)
    level = texton_level(textons, model.shape)
    centres = np.stack([explicit[textons.members == i].mean(axis=0) for i in range(30)])
    centres = np.concatenate([centres, centres.mean(axis=0, keepdims=True)])
    far = distances(centres)
    gram = np.asarray(level.gram, float)
    by_gram = np.diagonal(gram)[:, None] + np.diagonal(gram)[None] - 2 * gram
    assert np.abs(by_gram - far).max() < 1e-5 * far.max()
    assert np.abs(distances(level.vectors) - far).max() < 1e-4 * far.max()
    to_centres = (
        (explicit**2).sum(axis=1)[:, None]
        + (centres[:-1] ** 2).sum(axis=1)
        - 2 * explicit @ centres[:-1].T
    )
    chosen = to_centres[np.arange(320), level.labels.ravel()]
    assert (chosen <= to_centres.min(axis=1) + 1e-5 * far.max()).all()
    spread = ((explicit - explicit.mean(axis=0)) ** 2).sum()
    assert textons.inertia == pytest.approx(chosen.sum() / spread, rel=1e-3)


def test_clustering_in_the_projection_is_as_good_as_in_the_full_space(make_sample):
    from scipy.ndimage import gaussian_filter
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    sample = make_sample(32, 32, toroidal=True)
    sample.codes = gaussian_filter(sample.codes, (0, 1, 1, 0), mode="wrap")
    model = compress_svd(sample, 20, precision="single")
    explicit = filter_all(model.pictures(slice(None)), toroidal=True).reshape(1024, -1)
    with threadpool_limits(1):
        full = KMeans(60, n_init=1, random_state=0).fit(explicit.astype(np.float32))
    full = full.inertia_ / ((explicit - explicit.mean(axis=0)) ** 2).sum()
    textures, angular = eigen_textures(model)
    textons = cluster(appearance_vectors(textures @ picture_weights(angular), True), 60)
    assert textons.share > 0.98
    assert textons.inertia < 1.02 * full


def test_the_default_texton_is_the_mean_and_the_origin(model):
    features = texton_features(model, levels=1, n_textons=40, k=5)
    level = features.levels[0]
    assert level.gram.shape == (41, 41)
    assert not level.vectors[-1].any()
    assert np.abs(level.vectors[:-1].mean(axis=0)).max() < 1e-5 * np.abs(level.vectors).max()
    assert np.abs(level.gram[-1]).max() < 1e-5 * level.gram.max()


def test_each_level_has_a_quarter_of_the_textons(make_sample):
    model = compress_svd(make_sample(32, 48, toroidal=True), 12)
    features = texton_features(model, levels=3, n_textons=200, k=5)
    assert [level.shape for level in features.levels] == [(32, 48), (16, 24), (8, 12)]
    assert [len(level.vectors) - 1 for level in features.levels] == [200, 50, 12]
    for level in features.levels:
        assert level.labels.max() < len(level.vectors) - 1
        assert level.neighbours.shape == (*level.shape, 5)


def test_alike_texels_share_textons_and_unlike_ones_do_not(make_sample):
    """Stripes of two materials, eight texels wide: period 16, so labels repeat with it and no texton is in both."""
    sample = make_sample(32, 32, toroidal=True)
    stripe = (np.arange(32) // 8 % 2).astype(bool)
    sample.codes[:, :, stripe] *= 0.2
    sample.codes[:] = sample.codes.mean(axis=1, keepdims=True)
    sample.codes[:, :, 16:] = sample.codes[:, :, :16]
    labels = texton_features(sample, levels=1, n_textons=16, k=5).levels[0].labels
    assert (labels == labels[:1]).all()
    assert np.array_equal(labels[:, :16], labels[:, 16:])
    assert not set(labels[0, stripe]) & set(labels[0, ~stripe])


def test_representative_pictures_come_one_from_each_kind(model):
    """Sixty pictures of three kinds, equal but for a trace of noise."""
    textures, angular = eigen_textures(model)
    rng = np.random.default_rng(5)
    kinds = rng.permutation(np.repeat(np.arange(3), 20))
    many = angular[[0, 40, 100]][kinds] * (1 + 1e-3 * rng.normal(size=(60, 1, 1)))
    chosen = representative_pictures(textures, many.astype(np.float32), True, 3)
    assert sorted(kinds[chosen]) == [0, 1, 2]
    assert np.array_equal(representative_pictures(textures, many, True, 60), np.arange(60))


def test_representative_pictures_are_nearest_to_their_clusters_centre(model):
    textures, angular = eigen_textures(model)
    chosen = representative_pictures(textures, angular, True, 20)
    assert len(chosen) == 20
    assert (np.diff(chosen) > 0).all()
    pictures = model.pictures(slice(None)).reshape(model.n_pairs, -1)
    to_chosen = np.sqrt(((pictures[:, None] - pictures[chosen][None]) ** 2).sum(axis=2)).min(axis=1)
    rng = np.random.default_rng(0)
    for _ in range(5):  # pictures drawn at random stand for the others less well
        drawn = pictures[rng.choice(model.n_pairs, 20, replace=False)]
        to_drawn = np.sqrt(((pictures[:, None] - drawn[None]) ** 2).sum(axis=2)).min(axis=1)
        assert to_chosen.mean() < to_drawn.mean()


def test_the_representative_of_a_kind_is_the_one_nearest_to_its_mean(model):
    """Pictures of a kind differ by a factor alone, so the nearest to the mean is known."""
    textures, angular = eigen_textures(model)
    rng = np.random.default_rng(8)
    kinds = rng.permutation(np.repeat(np.arange(4), 15))
    factor = 1 + 0.02 * rng.random(60) ** 2
    many = (angular[[0, 40, 70, 100]][kinds] * factor[:, None, None]).astype(np.float32)
    chosen = representative_pictures(textures, many, True, 4)
    expected = []
    for kind in range(4):
        own = np.flatnonzero(kinds == kind)
        expected.append(own[np.abs(factor[own] - factor[own].mean()).argmin()])
    assert chosen.tolist() == sorted(expected)


@pytest.mark.parametrize("different", [1, 3])
def test_pictures_that_coincide_have_one_representative(model, different):
    """Fewer kinds than representatives asked for: one of each, and no mean of nothing."""
    textures, angular = eigen_textures(model)
    kinds = np.tile(np.arange(different), 10)
    many = angular[[0, 40, 100]][kinds]
    chosen = representative_pictures(textures, many, True, 6)
    assert sorted(kinds[chosen]) == list(range(different))


def test_black_pictures_have_one_representative(model):
    textures, angular = eigen_textures(model)
    assert len(representative_pictures(textures, 0 * angular, True, 6)) == 1


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_filters_vary_alike_on_every_level_but_the_coarsest(make_sample, levels):
    """Each level's textons are those of the responses to its own picture, scaled or as they are."""
    model = compress_svd(make_sample(20, 24, toroidal=True), 3, precision="single")
    features = texton_features(model, levels=levels, n_textons=60, k=5)
    textures, angular = eigen_textures(model)
    image = textures @ picture_weights(angular)
    for level, found in enumerate(features.levels):
        if level:
            image = halve(image, True)
        expected = {}
        for alike in (True, False):
            vectors = appearance_vectors(image, True)
            energy = vectors.reshape(len(vectors), 48, -1).var(axis=0).sum(axis=1)
            if alike:  # by the definition: the strongest keeps its own, the faintest of 2 % at most
                factors = np.sqrt(energy.max() / np.maximum(energy, 4e-4 * energy.max()))
                vectors = (vectors.reshape(len(vectors), 48, -1) * factors[:, None]).reshape(
                    len(vectors), -1
                )
            textons = cluster(vectors.astype(np.float32), max(2, 60 // 4**level))
            made = texton_level(textons, image.shape[:2]).gram
            expected[alike] = np.linalg.norm(made)
        coarsest = level == levels - 1
        found = np.linalg.norm(found.gram)
        assert found == pytest.approx(expected[not coarsest], rel=0.02)
        assert found != pytest.approx(expected[coarsest], rel=0.2)


def test_one_picture_is_enough(make_sample):
    from btfpipe.directions import bonn81

    sample = make_sample(16, 16, lights=bonn81()[:1], views=bonn81()[:1], toroidal=True)
    features = texton_features(sample, levels=2, n_textons=50, k=5)
    assert features.about["pictures"] == 1
    assert features.about["svd_terms"] <= 3


def test_threads_do_not_change_the_file(btfpipe, sample, tmp_path):
    sample.save(tmp_path / "s.npz")
    for threads in (1, 2):
        btfpipe(
            "textons", tmp_path / "s.npz", "-o", tmp_path / f"{threads}.npz", "--threads", threads,
            "--levels", 2, "--textons", 30, "--images", 20, "-k", 6, "--json",
        )  # fmt: skip
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    features = Features.open(tmp_path / "1.npz")
    assert features.toroidal
    assert features.about["neighbourhood"] == 5
    assert features.about["pictures"] == 20


def test_not_a_number_is_refused_with_its_place(model):
    textures = model.texture_factors.copy()
    textures[3, 4, 0] = np.nan
    with pytest.raises(InputError, match="the first at row 3, col 4"):
        texton_features(SvdModel(textures, model.angular_factors, model), levels=1)
    angular = model.angular_factors.copy()
    angular[7, 1, 0] = np.inf
    with pytest.raises(InputError, match="first for pair 7"):
        texton_features(SvdModel(model.texture_factors, angular, model), levels=1)


def test_responses_beyond_the_memory_are_refused_before_filtering(model):
    with pytest.raises(InputError, match="--memory allows 97 KB"):
        texton_features(model, levels=1, memory=100_000)


def test_small_sample_exits_3_and_writes_nothing(btfpipe, make_sample, tmp_path):
    make_sample(12, 12).save(tmp_path / "s.npz")
    result = btfpipe("textons", tmp_path / "s.npz", "-o", tmp_path / "t.npz", code=3)
    assert "3 x 3 texels on level 2" in result.stderr
    assert not (tmp_path / "t.npz").exists()
