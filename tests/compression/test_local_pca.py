"""Clustered local PCA against LAPACK per cluster, as a database, and its promises about bytes and bad input."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.compression import compress, local_pca, open_appearance
from btfpipe.compression import local_clusters as local_clusters_module
from btfpipe.compression.local_clusters import local_clusters
from btfpipe.compression.local_pca import LocalPcaModel, compress_local_pca
from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.sample import Sample
from btfpipe.sample.resample import Resampled


def matrix(appearance):
    """Texels x (pairs and channels), float64."""
    pictures = appearance.pictures(slice(0, appearance.n_pairs)).astype(np.float64)
    return pictures.transpose(1, 2, 0, 3).reshape(-1, 3 * appearance.n_pairs)


def naive(values, labels, terms):
    """Each cluster's best approximation by its mean and principal vectors, by LAPACK."""
    out = np.empty_like(values)
    for label in np.unique(labels):
        own = labels == label
        mean = values[own].mean(axis=0)
        left, singular, right = np.linalg.svd(values[own] - mean, full_matrices=False)
        out[own] = mean + (left[:, :terms] * singular[:terms]) @ right[:terms]
    return out


def sample_of(values, shape, n_lights, n_views, **kwargs):
    """A product Sample from its matrix of texels x (pairs and channels)."""
    pair = np.arange(n_lights * n_views)
    codes = values.reshape(*shape, -1, 3).transpose(2, 0, 1, 3).astype(np.float32)
    lights, views = bonn81()[:n_lights], bonn81()[:n_views]
    return Sample(
        np.ascontiguousarray(codes), lights, views, pair % n_lights, pair // n_lights, **kwargs
    )


@pytest.fixture
def patchy_sample(rng):
    """Make a Sample of regions, each with a mean and a few vectors of its own, and noise."""

    def make(shape=(12, 15), n_lights=11, n_views=4, regions=3, rank=2, noise=0.02, **kwargs):
        columns, texels = 3 * n_lights * n_views, shape[0] * shape[1]
        region = np.arange(texels) * regions // texels
        means = rng.random((regions, columns))
        vectors = rng.standard_normal((regions, rank, columns)) * 0.3
        coordinates = rng.standard_normal((texels, rank)) * 0.5 ** np.arange(rank)
        values = means[region] + np.einsum("tk,tkn->tn", coordinates, vectors[region])
        values += noise * rng.standard_normal(values.shape)
        return sample_of(values, shape, n_lights, n_views, **kwargs)

    return make


@pytest.mark.parametrize(("clusters", "terms"), [(1, 3), (3, 2), (5, 4)])
def test_each_cluster_has_its_best_approximation_of_that_rank(patchy_sample, clusters, terms):
    sample = patchy_sample(noise=0.05)
    model = compress_local_pca(sample, clusters=clusters, components=terms, precision="single")
    values = matrix(sample)
    best = naive(values, model.labels, terms)
    error = np.linalg.norm(matrix(model) - values)
    least = np.linalg.norm(best - values)
    assert least * (1 - 1e-6) <= error <= 1.005 * least
    # the best approximation is also near in itself, where the singular values are apart
    assert np.linalg.norm(matrix(model) - best) < 0.15 * least


def test_clusters_have_the_directions_of_the_samples_own_values(patchy_sample, monkeypatch):
    """Clusters are found in few dimensions; what they are given comes from all values, not from those few."""
    monkeypatch.setattr(local_pca, "REDUCED_TERMS", 8)
    sample = patchy_sample((16, 20), rank=8, noise=0.3)
    model = compress_local_pca(sample, clusters=3, components=3, precision="single")
    values = matrix(sample)
    least = np.linalg.norm(naive(values, model.labels, 3) - values)
    assert np.linalg.norm(matrix(model) - values) <= 1.015 * least
    for label in range(3):
        own = values[model.labels == label].mean(axis=0)
        np.testing.assert_allclose(model.bases[label, ..., 0].ravel(), own, atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    clusters=st.integers(1, 6),
    n_pairs=st.integers(1, 5),
    seed=st.integers(0, 1000),
)
def test_all_terms_give_any_small_sample_back(shape, clusters, n_pairs, seed):
    texels = shape[0] * shape[1]
    values = np.random.default_rng(seed).random((texels, 3 * n_pairs))
    sample = sample_of(values, shape, n_pairs, 1)
    clusters = min(clusters, texels)
    model = compress_local_pca(
        sample, clusters=clusters, components=texels, precision="single", seed=seed
    )
    assert model.n_terms <= min(texels - clusters, 3 * n_pairs)
    assert len(np.unique(model.labels)) == clusters
    np.testing.assert_allclose(matrix(model), values, atol=2e-5)


def test_regions_of_their_own_few_vectors_are_found(patchy_sample):
    sample = patchy_sample(noise=0, rank=3, regions=4, shape=(16, 20))
    model = compress_local_pca(sample, clusters=4, components=3, precision="single")
    region = np.arange(320) * 4 // 320
    assert len(set(zip(region, model.labels.tolist(), strict=True))) == 4
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-5)


def test_neither_step_of_the_clustering_raises_the_error(rng):
    points = rng.standard_normal((600, 12)).astype(np.float32)
    points[:300] += 2 * np.abs(points[:300, :1])
    labels, bases, error = local_clusters(points, 5, 2)
    residual = np.empty((5, len(points)))
    for cluster in range(5):
        centred = points - points[labels == cluster].mean(axis=0)
        residual[cluster] = ((centred - centred @ bases[cluster] @ bases[cluster].T) ** 2).sum(
            axis=1
        )
    own = residual[labels, np.arange(len(points))].sum()
    # the fit of the last labels is no worse than what they were chosen by, and nearly settled
    assert own <= error * (1 + 1e-5)
    assert residual.min(axis=0).sum() >= 0.98 * own
    kmeans = local_clusters(points, 5, 0)[0]
    spread = sum(
        ((points[kmeans == k] - points[kmeans == k].mean(axis=0)) ** 2).sum() for k in range(5)
    )
    assert spread < ((points - points.mean(axis=0)) ** 2).sum() * 0.85


def test_the_best_cluster_is_found_as_by_comparing_all(rng):
    points = rng.standard_normal((300, 9)).astype(np.float32)
    means = rng.standard_normal((4, 9))
    widths = (3, 0, 2, 3)  # a cluster of one point has no directions
    bases = [np.linalg.qr(rng.standard_normal((9, n)))[0].astype(np.float32) for n in widths]
    residual = []
    for mean, basis in zip(means, bases, strict=True):
        centred = points - mean
        residual.append(((centred - centred @ basis @ basis.T) ** 2).sum(axis=1))
    labels, error = local_clusters_module._assign(points, means, bases, 1)
    np.testing.assert_array_equal(labels, np.argmin(residual, axis=0))
    assert error == pytest.approx(np.min(residual, axis=0).sum(), rel=1e-5)


def test_clusters_of_many_points_are_found_from_a_part_of_them(rng, monkeypatch):
    centres = 6 * rng.standard_normal((5, 10))
    axes = np.stack([np.linalg.qr(rng.standard_normal((10, 2)))[0] for _ in range(5)])
    which = rng.integers(5, size=4000)
    along = rng.standard_normal((4000, 2))
    points = centres[which] + np.einsum("nk,ndk->nd", along, axes[which])
    points = (points + 0.01 * rng.standard_normal(points.shape)).astype(np.float32)
    whole = local_clusters(points, 5, 2, seed=3)
    monkeypatch.setattr(local_clusters_module, "_MANY", 400)
    monkeypatch.setattr(local_clusters_module, "_EACH", 40)
    seen = []
    assign = local_clusters_module._assign
    monkeypatch.setattr(
        local_clusters_module, "_assign", lambda p, *rest: seen.append(len(p)) or assign(p, *rest)
    )
    parts = [local_clusters(points, 5, 2, seed=3, threads=threads) for threads in (1, 3)]
    assert seen.count(4000) == 2 * 4
    assert set(seen) == {400, 4000}
    np.testing.assert_array_equal(parts[0][0], parts[1][0])
    assert len(parts[0][0]) == 4000
    assert parts[0][2] == parts[1][2] <= 1.05 * whole[2]
    for basis, own in zip(parts[0][1], parts[1][1], strict=True):
        assert basis.tobytes() == own.tobytes()


def test_more_terms_and_more_clusters_are_better(patchy_sample):
    sample = patchy_sample(regions=8, rank=6, shape=(20, 20))
    by_terms = [
        compress_local_pca(sample, clusters=4, components=n).about["rmse"] for n in (1, 3, 9)
    ]
    by_clusters = [
        compress_local_pca(sample, clusters=n, components=2).about["rmse"] for n in (1, 8, 32)
    ]
    for errors in (by_terms, by_clusters):
        assert all(later < earlier for earlier, later in itertools.pairwise(errors))


def test_a_database_evaluates_each_material_as_well_as_alone(patchy_sample):
    """As many clusters as both have alone cost little: clusters may be shared unevenly, the terms are as many.

    Each material alone has its own regions, which the joint clusters find too, so that only noise differs.
    """
    samples = [patchy_sample(shape=(12, 15)), patchy_sample(shape=(10, 9), toroidal=True)]
    alone = [compress_local_pca(s, clusters=3, components=2, precision="single") for s in samples]
    both = compress_local_pca(
        samples, clusters=6, components=2, precision="single", names=["wool", "felt"]
    )
    assert both.materials == ("wool", "felt")
    for name, sample, single in zip(both.materials, samples, alone, strict=True):
        model = both.material(name)
        assert model.shape == sample.shape
        assert model.toroidal == sample.toroidal
        error = np.sqrt(((matrix(model) - matrix(sample)) ** 2).mean())
        assert error <= 1.05 * single.about["rmse"]
        facts = both.about["materials"][both.materials.index(name)]
        assert facts["rmse"] == pytest.approx(error, rel=1e-5)
    values = np.concatenate([matrix(sample) for sample in samples])
    best = np.linalg.norm(naive(values, both.labels, 2) - values)
    assert both.about["rmse"] * np.sqrt(values.size) == pytest.approx(best, rel=1e-3)
    assert both.about["relative_error"] == pytest.approx(best / np.linalg.norm(values), rel=1e-3)


def test_equal_materials_share_their_clusters(patchy_sample):
    sample = patchy_sample()
    alone = compress_local_pca(sample, clusters=3, components=2, precision="single")
    both = compress_local_pca([sample, sample], clusters=3, components=2, precision="single")
    np.testing.assert_array_equal(both.labels[:180], both.labels[180:])
    for index in range(2):
        np.testing.assert_allclose(matrix(both.material(index)), matrix(alone), atol=2e-3)


def test_threads_and_memory_never_show(patchy_sample):
    samples = [patchy_sample(shape=(50, 47)), patchy_sample(shape=(12, 15))]
    models = [
        compress_local_pca(samples, clusters=7, components=3, threads=threads, memory=memory)
        for threads, memory in ((1, 2 << 30), (2, 2 << 30), (3, 116 << 20))
    ]
    for model in models[1:]:
        for name, array in model.arrays().items():
            assert array.tobytes() == models[0].arrays()[name].tobytes(), name
        assert model.about == models[0].about


def test_a_database_goes_through_its_file(patchy_sample, tmp_path):
    samples = [patchy_sample(texels_per_mm=7.5), patchy_sample(shape=(5, 6), absolute=True)]
    model = compress_local_pca(samples, clusters=4, components=3, names=["wool", "felt"])
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    assert isinstance(back, LocalPcaModel)
    assert (back.materials, back.shape, back.texels_per_mm) == (("wool", "felt"), (12, 15), 7.5)
    felt = back.material(1)
    assert (felt.shape, felt.texels_per_mm, felt.absolute) == ((5, 6), None, True)
    np.testing.assert_array_equal(matrix(felt), matrix(model.material("felt")))
    assert felt.material("wool").shape == (12, 15)
    felt.save(tmp_path / "felt_first.npz")
    assert open_appearance(tmp_path / "felt_first.npz").shape == (5, 6)
    stored = sum(array.nbytes for array in (back.bases, back.coordinates, back.labels))
    assert stored <= back.nbytes <= (tmp_path / "m.npz").stat().st_size
    for which in (1, "1", "felt"):
        assert open_appearance(tmp_path / "m.npz", which).shape == (5, 6)
    with pytest.raises(
        InputError, match=r"m\.npz: no material 2; the database holds 2: wool, felt"
    ):
        open_appearance(tmp_path / "m.npz", "2")
    for which in ("silk", 2, -1):
        with pytest.raises(
            InputError, match=f"no material {which!r}; the database holds 2: wool, felt"
        ):
            back.material(which)


def test_damaged_labels_and_descriptions_are_refused(patchy_sample, tmp_path):
    model = compress_local_pca(patchy_sample(), clusters=3, components=2)
    model.labels[5] = 9
    model.save(tmp_path / "m.npz")
    with pytest.raises(InputError, match="labels reach 9; expected less than 3 clusters"):
        open_appearance(tmp_path / "m.npz")
    model.about["materials"] = "wool"
    model.save(tmp_path / "m.npz")
    with pytest.raises(InputError, match="does not say which materials"):
        open_appearance(tmp_path / "m.npz")


def test_texels_and_pictures_agree(patchy_sample):
    samples = [patchy_sample(), patchy_sample(shape=(8, 7))]
    model = compress_local_pca(samples, clusters=4, components=3).material(1)
    pictures = model.pictures(slice(0, model.n_pairs))
    some = np.array([40, 3, 17, 16])
    np.testing.assert_array_equal(model.pictures(some), pictures[some])
    rows, cols = np.array([0, 3, 7]), np.array([1, 6, 2])
    np.testing.assert_allclose(
        model.texels(rows, cols), pictures[:, rows, cols].swapaxes(0, 1), atol=1e-5
    )


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("toroidal", [True, False])
def test_the_shader_blends_values_across_clusters(
    patchy_sample, blended_pictures, rng, toroidal, interpolation
):
    samples = [patchy_sample(), patchy_sample((6, 9), noise=0.3, toroidal=toroidal)]
    precision = "byte" if toroidal else "half"
    model = compress_local_pca(samples, clusters=9, components=3, precision=precision).material(1)
    labels = model.own_texels()[1].reshape(model.shape)
    assert (labels[:, 1:] != labels[:, :-1]).any()
    n = 60
    row, col = rng.uniform(-12, 20, (2, n))
    w_i, w_o = (from_angles(rng.uniform(0, 1.7, n), rng.uniform(0, 6.3, n)) for _ in range(2))
    found = model.evaluate(row, col, w_i, w_o, interpolation=interpolation)
    expected = blended_pictures(model, row, col, w_i, w_o, interpolation)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_clusters_follow_from_the_bytes(patchy_sample):
    sample = patchy_sample()
    one = compress_local_pca(sample, clusters=1, components=2).nbytes
    two = compress_local_pca(sample, clusters=2, components=2).nbytes
    for target, clusters in ((one, 1), (two - 1, 1), (two, 2), (two + 3 * (two - one), 5)):
        model = compress_local_pca(sample, components=2, target_bytes=target)
        assert model.n_clusters == clusters
        assert model.nbytes <= target
    with pytest.raises(
        InputError, match=rf"hold no cluster of 2 components; expected at least {one}\."
    ):
        compress_local_pca(sample, components=2, target_bytes=one - 1)
    # a huge target leaves no texels to themselves
    assert compress_local_pca(sample, components=2, target_bytes=1 << 40).n_clusters == 60


def test_by_default_clusters_are_as_many_as_in_the_paper():
    from types import SimpleNamespace

    from btfpipe.compression.local_pca import _cluster_count

    def count(materials, texels, directions):
        table = np.zeros((directions, 3))
        sample = SimpleNamespace(
            shape=(texels, texels), n_pairs=directions**2, light_directions=table, view_directions=table
        )  # fmt: skip
        return _cluster_count([sample] * materials, None, 8, None, "half")

    assert count(1, 128, 81) == 16
    assert abs(count(15, 128, 151) - 250) <= 5
    assert count(1, 4, 81) == 1


def test_terms_beyond_the_rank_are_left_out_with_a_warning(patchy_sample):
    model = compress_local_pca(patchy_sample(noise=0, rank=2), clusters=3, components=5)
    assert model.n_terms == 2
    assert model.about["warnings"] == [
        "the clusters have at most 2 terms beside their mean: 3 of the 5 components left out"
    ]


def test_terms_beyond_the_reduced_dimensions_are_not_blamed_on_the_clusters(make_sample, rng):
    sample = make_sample(16, 16)
    sample.codes = rng.random(sample.codes.shape, np.float32)
    model = compress_local_pca(sample, clusters=1, components=200)
    assert model.n_terms == 150
    assert model.about["warnings"] == [
        "clusters are found in the texels' first 150 dimensions and get no more terms beside their mean: 50 of the 200"
        " components left out"
    ]


def test_a_black_sample_becomes_a_black_model(patchy_sample):
    sample = patchy_sample()
    sample.codes = np.zeros_like(sample.codes)
    model = compress_local_pca([sample, sample], clusters=4)
    assert not matrix(model).any()
    assert model.about["rmse"] == model.about["relative_error"] == 0


def test_bytes_take_less_and_cost_little_more_than_their_rounding(patchy_sample, tmp_path):
    sample = patchy_sample(shape=(20, 20), noise=0.1)
    single, byte = (
        compress_local_pca(sample, clusters=4, components=5, precision=p)
        for p in ("single", "byte")
    )
    np.testing.assert_array_equal(byte.labels, single.labels)
    assert byte.bases.nbytes == single.bases.nbytes / 4
    # each number of a basis is off by up to half a step, evenly spread, times a coordinate
    squares = 1 + np.square(byte.coordinates.astype(float)).sum(axis=1)
    steps = byte.scales.astype(float)[byte.labels]
    rounding = (squares[:, None] * steps**2).mean() / 12
    expected = np.sqrt(single.about["rmse"] ** 2 + rounding)
    assert byte.about["rmse"] == pytest.approx(expected, rel=0.002)
    byte.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    np.testing.assert_array_equal(matrix(back), matrix(byte))
    rows, cols = np.array([0, 3, 7]), np.array([1, 6, 2])
    np.testing.assert_allclose(
        back.texels(rows, cols).reshape(3, -1), matrix(byte)[rows * 20 + cols], atol=1e-5
    )
    target = byte.nbytes
    assert (
        compress_local_pca(sample, components=5, target_bytes=target, precision="byte").n_clusters
        == 4
    )


def test_a_list_of_pairs_is_compressed_and_shaded(patchy_sample):
    whole = patchy_sample()
    some = np.array([5, 39, 7, 20, 21, 22, 30])
    sample = Sample(
        whole.codes[some], whole.light_directions, whole.view_directions,
        whole.light_index[some], whole.view_index[some],
    )  # fmt: skip
    model = compress_local_pca(sample, clusters=3, components=21, precision="single")
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-5)
    for pair in range(7):
        w_i = sample.light_directions[sample.light_index[pair]]
        w_o = sample.view_directions[sample.view_index[pair]]
        value = model.evaluate(2, 3, w_i, w_o)
        np.testing.assert_allclose(value[0], sample.pictures([pair])[0, 2, 3], rtol=2e-3, atol=1e-4)


def test_databases_of_different_directions_are_refused_by_name(patchy_sample):
    wool, felt = patchy_sample(), patchy_sample(n_lights=10)
    with pytest.raises(
        InputError, match=r"felt has 10 lights, wool has 11.*apart, or pass --resample\.$"
    ):
        compress_local_pca([wool, felt], names=["wool", "felt"])
    felt = patchy_sample()
    felt.view_directions[2] = from_angles(np.array([0.3]), np.array([1.0]))[0]
    with pytest.raises(InputError, match=r"felt has other views than wool: number 2 differs by"):
        compress_local_pca([wool, felt], names=["wool", "felt"])
    felt = patchy_sample()
    felt.light_index[[3, 4]] = felt.light_index[[4, 3]]
    with pytest.raises(
        InputError, match="material 1 has the same directions as material 0, but pairs"
    ):
        compress_local_pca([wool, felt])


def test_a_resampled_material_is_measured_against_its_resampled_pictures(patchy_sample):
    """The database is that of the resampled pictures written out, to the last byte; of one order, whatever the threads."""
    wool = patchy_sample()
    felt = patchy_sample(shape=(6, 9), n_lights=19, n_views=7, toroidal=True)
    jute = patchy_sample(shape=(5, 5))
    names = ["wool", "felt", "jute"]
    pictures = Resampled(felt, wool).pictures(slice(None))
    written = Sample(
        pictures, wool.light_directions, wool.view_directions, wool.light_index, wool.view_index,
        toroidal=True,
    )  # fmt: skip
    options = {"clusters": 5, "components": 3, "names": names}
    expected = compress_local_pca([wool, written, jute], **options)
    for threads in (1, 3):
        found = compress([wool, felt, jute], "local-pca", resample=True, threads=threads, **options)
        for name, array in found.arrays().items():
            assert array.tobytes() == expected.arrays()[name].tobytes(), name
    error = matrix(found.material("felt")) - matrix(written)
    facts = found.about["materials"]
    assert facts[1].pop("resampled_from") == {"lights": 19, "views": 7, "pairs": 133}
    assert facts == expected.about["materials"]
    assert facts[1]["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-5)


def test_samples_of_other_pairs_are_resampled_or_cannot_be(patchy_sample):
    wool, felt = patchy_sample(shape=(4, 5)), patchy_sample(shape=(4, 5), n_lights=4)
    some = np.array([5, 39, 7, 20, 21, 22, 30])
    few = Sample(
        wool.codes[some], wool.light_directions, wool.view_directions, wool.light_index[some],
        wool.view_index[some],
    )  # fmt: skip
    for first, other in ((few, felt), (felt, few)):
        database = compress_local_pca(
            [first, other], clusters=40, precision="single", resample=True
        )
        expected = Resampled(other, first).pictures(slice(None))
        np.testing.assert_allclose(database.material(1).pictures(slice(None)), expected, atol=1e-5)
    felt.view_directions[2] *= -1
    with pytest.raises(InputError, match=r"^felt: direction 2 points below the surface"):
        compress_local_pca([wool, felt], names=["wool", "felt"], resample=True)


def test_bad_input_is_refused_by_name(patchy_sample):
    sample = patchy_sample()
    for kwargs, message in (
        ({"clusters": 181}, "181 clusters for 180 texels; expected at most 180"),
        ({"clusters": 0}, "0 clusters asked for; expected at least 1"),
        ({"components": 0}, "0 components asked for; expected at least 1"),
        ({"clusters": 2, "target_bytes": 10**6}, "expected one of them"),
        ({"precision": "quarter"}, "expected half, single or byte"),
        ({"names": ["a", "b"]}, "1 samples have 2 different names"),
        ({"memory": 32 << 20}, r"need \d+ MB; --memory allows 32 MB"),
    ):
        with pytest.raises(InputError, match=message):
            compress_local_pca(sample, **kwargs)
    with pytest.raises(InputError, match="no samples given"):
        compress_local_pca([])
    with pytest.raises(InputError, match="2 samples have 1 different names"):
        compress_local_pca([sample, sample], names=["wool", "wool"])
    bright = patchy_sample()
    bright.codes = bright.codes * np.float32(1e9)
    with pytest.raises(InputError, match="--precision single"):
        compress_local_pca(bright, clusters=2)
    assert compress_local_pca(bright, clusters=2, precision="single").about["relative_error"] < 0.2
    broken = patchy_sample()
    broken.codes[7, 3, 4, 1] = np.nan
    with pytest.raises(InputError, match=r"^felt: the sample holds non-finite values"):
        compress_local_pca([sample, broken], names=["wool", "felt"])


def test_as_many_clusters_as_texels_give_the_sample_back(patchy_sample):
    sample = patchy_sample(shape=(4, 5))
    model = compress_local_pca(sample, clusters=20, precision="single")
    assert model.n_terms == 0
    np.testing.assert_allclose(matrix(model), matrix(sample), atol=1e-6)
    row, col = np.array([1.5, 2.0]), np.array([0.25, 3.0])
    light, view = bonn81()[3], bonn81()[2]
    picture = model.pictures([2 * 11 + 3])[0]
    expected = (0.75 * picture[1:3, 0] + 0.25 * picture[1:3, 1]).mean(axis=0), picture[2, 3]
    np.testing.assert_allclose(model.evaluate(row, col, light, view), expected, atol=1e-5)


def test_progress_ends_at_its_total(patchy_sample):
    seen = []
    compress_local_pca(
        [patchy_sample(), patchy_sample()],
        clusters=3,
        on_progress=lambda done, total: seen.append((done, total)),
    )
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert {total for _, total in seen} == {seen[-1][0]}
