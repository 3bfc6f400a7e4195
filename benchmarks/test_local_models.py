"""Per-view PCA and clustered local PCA against the textbook ways, in one run, and their private memory.

The samples are those of the SVD's benchmark: 81 x 81 pairs whose spectrum falls like a measured cloth's, as 8-bit
codes. The textbook ways get the linear values as one float32 array and all BLAS threads: for per-view PCA
`numpy.linalg.svd` of each view (nine of the 81, the seconds multiplied), for local PCA scikit-learn's `KMeans` of the texels' 150 principal coordinates (from
its `PCA` with the randomised solver) and its `PCA` of each cluster.
"""

import importlib.util
import math
import sys
import time
from pathlib import Path

import numpy as np
from shared_memory import peak_private_mb

from btfpipe.compression.local_pca import compress_local_pca
from btfpipe.compression.view_pca import compress_view_pca
from btfpipe.parallel import available_threads
from btfpipe.sample import Sample

_spec = importlib.util.spec_from_file_location("svd_bench", Path(__file__).with_name("test_svd.py"))
svd_bench = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(svd_bench)

_MEMORY = """
import sys
from btfpipe.compression.{module} import {function}
from btfpipe.sample import Sample
{function}(Sample.open(sys.argv[1]), threads=2).save(sys.argv[2])
"""


def seconds(function, *args, **kwargs):
    """What the function returns, and the seconds it took."""
    start = time.perf_counter()
    result = function(*args, **kwargs)
    return result, time.perf_counter() - start


def view_svds(sample, components, views):
    """Squared error of per-view PCA by LAPACK's SVD of the views' matrices, lights x (texels and channels)."""
    lights, squared = len(sample.light_directions), 0.0
    for view in views:
        values = sample.pictures(slice(view * lights, (view + 1) * lights)).reshape(lights, -1)
        values = values - values.mean(axis=0)
        left, singular, right = np.linalg.svd(values, full_matrices=False)
        values -= (left[:, :components] * singular[:components]) @ right[:components]
        squared += float(np.vecdot(values, values).sum(dtype=np.float64))
    return squared


def squared_error(model, sample, views):
    """The Model's own squared error in these views."""
    lights, squared = len(sample.light_directions), 0.0
    for view in views:
        pairs = slice(view * lights, (view + 1) * lights)
        squared += float(
            np.square(model.pictures(pairs) - sample.pictures(pairs), dtype=np.float64).sum()
        )
    return squared


def textbook_local_pca(sample, clusters, components):
    """RMSE of k-means over principal coordinates and a PCA of each cluster, by scikit-learn."""
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    whole = svd_bench.linear_matrix(sample)
    points = PCA(150, svd_solver="randomized", random_state=0).fit_transform(whole)
    labels = KMeans(clusters, n_init=3, random_state=0).fit(points).labels_
    squared = 0.0
    for cluster in range(clusters):
        own = whole[labels == cluster]
        pca = PCA(components, svd_solver="randomized", random_state=0)
        own -= pca.inverse_transform(pca.fit_transform(own))
        squared += float(np.vecdot(own, own).sum(dtype=np.float64))
    return np.sqrt(squared / whole.size)


def test_view_pca_against_svds_of_the_views(benchmark, tmp_path):
    sample = Sample.open(svd_bench.write_sample(tmp_path / "s.npz", 128, 128))
    threads = available_threads()
    compress_view_pca(sample, 1, threads=threads)  # compiles
    model, first = seconds(compress_view_pca, sample, threads=threads)
    views = range(0, 81, 9)
    squared, textbook = seconds(view_svds, sample, 5, views)
    textbook *= 81 / len(views)
    again = seconds(compress_view_pca, sample, threads=threads)[1]
    benchmark.pedantic(lambda: None, rounds=1)
    ours = min(first, again)
    facts = {
        "textbook_seconds": textbook,
        "seconds": ours,
        "ratio": textbook / ours,
        "error_over_textbook": math.sqrt(squared_error(model, sample, views) / squared),
        "relative_error": model.about["relative_error"],
    }
    benchmark.extra_info |= facts
    svd_bench.say("view-pca, 128 x 128 x 6561, 5 terms: " + _listed(facts))
    assert facts["error_over_textbook"] < 1.001


def test_local_pca_against_kmeans_and_pca(benchmark, tmp_path):
    sample = Sample.open(svd_bench.write_sample(tmp_path / "s.npz", 128, 128))
    threads = available_threads()
    compress_local_pca(sample, clusters=1, components=1, threads=threads)  # compiles
    model, ours = seconds(compress_local_pca, sample, threads=threads)
    rmse, textbook = seconds(textbook_local_pca, sample, model.n_clusters, model.n_terms)
    benchmark.pedantic(lambda: None, rounds=1)
    facts = {
        "clusters": model.n_clusters,
        "textbook_seconds": textbook,
        "seconds": ours,
        "ratio": textbook / ours,
        "error_over_textbook": model.about["rmse"] / rmse,
        "relative_error": model.about["relative_error"],
    }
    benchmark.extra_info |= facts
    svd_bench.say("local-pca, 128 x 128 x 6561, 8 terms: " + _listed(facts))
    assert facts["error_over_textbook"] < 1.01


def test_private_memory(benchmark, tmp_path):
    small = Sample.open(svd_bench.write_sample(tmp_path / "small.npz", 64, 64))
    path = svd_bench.write_tiled(tmp_path / "s.npz", small, 4)
    for module in ("view_pca", "local_pca"):
        code = _MEMORY.format(module=module, function=f"compress_{module}")
        command = [sys.executable, "-c", code, str(path), str(tmp_path / "m.npz")]
        peak, took = seconds(peak_private_mb, command)
        benchmark.extra_info[module] = {"peak_private_mb": peak, "seconds": took}
        svd_bench.say(f"{module}, 256 x 256 x 6561: peak private {peak:.0f} MB, {took:.1f} s")
        assert peak < 2048
    benchmark.pedantic(lambda: None, rounds=1)


def _listed(facts):
    return ", ".join(f"{name} {value:.4g}" for name, value in facts.items())
