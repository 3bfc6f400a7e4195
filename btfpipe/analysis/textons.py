"""Surface textons (Tong et al. 2002, section 4): a small vocabulary of what a texel can look like.

A texel's full vector is the response of 48 filters on every colour channel of every representative picture: up to
57,600 numbers. It is never formed. Filtering is linear, so the pictures' responses are a combination of those of
the n eigen-textures of an SVD: with ``R[p, f]`` (n) a texel's responses and ``A[picture, channel]`` (n) the
pictures' weights, the dot product of two full vectors is the sum over filters of ``R[p, f] M R[q, f]^T``, where
``M`` (n, n) is the sum of ``A A^T``. Filtering eigen-textures turned by a square root of ``M`` therefore gives
vectors of 48 n numbers with the same lengths and distances; everything below happens in that space.

One choice is not the paper's: on all levels but the coarsest, each filter is scaled so that its responses vary alike over the
sample. The coarsest level lays out the large structure, and there filters keep their own strength; on the others the
layout is given, and Gaussians, whose responses vary up to 30 times as much as those of the finest derivatives, would smear
the detail: grown over a plane, a fifth of CORDUROY's texels repeated their neighbour's, now one in a hundred.

Invalid texels repeat the nearest valid one before anything is filtered, as beyond the border; they take no part in the
clustering, and have the default texton.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from btfpipe.analysis.features import FeatureLevel, Features
from btfpipe.analysis.filters import N_FILTERS, base_sigma, filter_pictures, leung_malik
from btfpipe.analysis.neighbours import add_neighbour_lists
from btfpipe.analysis.pyramid import (
    check_pyramid,
    fill_invalid,
    halve,
    require_finite,
    valid_pyramid,
)
from btfpipe.compression.svd import SvdModel, compress_svd
from btfpipe.errors import InputError, too_little
from btfpipe.parallel import blocks, single_threaded_blas

_SVD_TERMS = 40  # Zhou et al. 2005; used where the input is no SVD already
_BLOCK = 4096  # texels a matrix product, fixed so that sums never depend on threads
_CLUSTER_DIMENSIONS = 64
_FAINT = 0.02  # filters fainter than this share of the strongest are not lifted to it: rounding is no texture
_FACTOR_LOSS = 1e-6  # share of the textons' squared distances that `vectors` may lose
_GRID = 16  # places along the shorter side that stand for a picture


def texton_features(
    appearance, *, levels=3, n_textons=400, n_pictures=400, neighbourhood=5, coarse_neighbourhood=3, k=20,
    seed=0, threads=1, memory=2 << 30, on_progress=None,
):  # fmt: skip
    """Texton pyramid of a Sample or Model, with neighbour lists.

    Parameters
    ----------
    appearance : Appearance
        An SVD Model is used as it is; of anything else an SVD of 40 terms is made first.
    levels : int
        Levels of the pyramid.
    n_textons : int
        Textons of the finest level, a quarter a level from there on; never more than half the level's texels.
    n_pictures : int
        Representative pictures; all, if there are fewer.
    neighbourhood, coarse_neighbourhood, k : int
        See `add_neighbour_lists`.
    seed, threads : int
        The result does not depend on `threads`.
    memory : int
        Bytes that the responses may take.
    on_progress : callable, optional
        Called with (steps done, steps).

    Returns
    -------
    Features
        Its ``about`` also holds, level by level, ``n_textons``, ``inertia`` (mean squared distance of a texel's full
        vector from its texton, as a share of that from the mean vector) and ``dimensions`` of the vectors; and, of a
        sample with a mask, ``invalid_texels``.

    Raises
    ------
    InputError
        If the sample is too small for its levels and neighbourhoods, or too little of it is valid, if it holds NaN or
        infinity, or needs more memory.
    """
    report = on_progress or (lambda done, total: None)
    steps = 2 * levels + 3
    check_pyramid(appearance.shape, levels, neighbourhood, coarse_neighbourhood)
    valid = valid_pyramid(appearance.mask, levels, appearance.toroidal)
    textures, angular = eigen_textures(appearance, seed=seed, threads=threads, memory=memory)
    need = 4 * N_FILTERS * textures.size * 3 // 2
    if need > memory:
        raise InputError(
            f"filter responses of {textures.shape[0]} x {textures.shape[1]} texels and {textures.shape[2]} SVD"
            f" terms need {too_little(need, memory)}, or use a Model of fewer"
            " terms (`btfpipe compress --components`)."
        )
    report(1, steps)
    with single_threaded_blas():
        pictures = representative_pictures(
            textures, angular, appearance.toroidal, n_pictures, seed, threads
        )
        report(2, steps)
        image = textures @ picture_weights(angular[pictures])
        made, facts = [], []
        for level in range(levels):
            if level:
                image = halve(image, appearance.toroidal)
            responses = appearance_vectors(image, appearance.toroidal, threads)
            if valid[level] is not None:
                responses = responses[valid[level].ravel()]
            if level < levels - 1:
                equalise(responses)
            report(2 * level + 3, steps)
            count = min(max(2, n_textons // 4**level), max(1, len(responses) // 2))
            textons = cluster(responses, count, seed)
            made.append(texton_level(textons, image.shape[:2], valid[level]))
            facts.append((textons, made[-1].vectors.shape[1]))
            del responses
            report(2 * level + 4, steps)
    about = {
        "toroidal": bool(appearance.toroidal),
        "shape": list(appearance.shape),
        "pictures": len(pictures),
        "svd_terms": textures.shape[2],
        "n_textons": [len(t.centres) for t, _ in facts],
        "inertia": [t.inertia for t, _ in facts],
        "cluster_share": [t.share for t, _ in facts],
        "dimensions": [d for _, d in facts],
    }
    if appearance.mask is not None:
        about["invalid_texels"] = [int(np.count_nonzero(~mask)) for mask in valid]
    features = Features(made, about)
    add_neighbour_lists(features, k, neighbourhood, coarse_neighbourhood, threads)
    report(steps, steps)
    return features


def eigen_textures(appearance, *, seed=0, threads=1, memory=2 << 30):
    """Eigen-textures (rows, cols, n) and angular factors (pairs, 3, n), both float32, of any Appearance.

    Invalid texels repeat the nearest valid one.
    """
    mask = appearance.mask
    if not isinstance(appearance, SvdModel):
        terms = min(_SVD_TERMS, appearance.shape[0] * appearance.shape[1], 3 * appearance.n_pairs)
        appearance = compress_svd(
            appearance, terms, precision="single", seed=seed, threads=threads, memory=memory
        )
    textures = np.asarray(appearance.texture_factors, np.float32)
    if mask is not None:
        textures = fill_invalid(textures, mask, appearance.toroidal)
    angular = np.asarray(appearance.angular_factors, np.float32)
    require_finite(textures, "the sample")
    if not np.isfinite(angular).all():
        pair = int(np.argwhere(~np.isfinite(angular))[0][0])
        raise InputError(f"the sample's angular factors are not finite, first for pair {pair}.")
    return textures, angular


def feature_image(appearance, dimensions=None, *, seed=0, threads=1, memory=2 << 30):
    """Vectors of the texels of any Appearance, whose Euclidean distance is that of the texels' values under all pairs.

    Parameters
    ----------
    appearance : Appearance
        An SVD Model is used as it is; of anything else an SVD of 40 terms is made first, which leaves its error out.
    dimensions : int, optional
        Keep only so many, of the largest extent.
    seed, threads, memory
        As in `texton_features`.

    Returns
    -------
    (rows, cols, n) float32
        Without a mean removed. Invalid texels repeat the nearest valid one.
    """
    textures, angular = eigen_textures(appearance, seed=seed, threads=threads, memory=memory)
    with single_threaded_blas():
        return textures @ picture_weights(angular)[:, :dimensions]


def picture_weights(angular):
    """A square root (n, n) of ``M``, the sum of ``A A^T`` over pictures and channels; columns by falling weight."""
    rows = np.asarray(angular, np.float64).reshape(-1, angular.shape[-1])
    return _root(rows.T @ rows).astype(np.float32)


def _root(matrix):
    """X with ``X X^T = matrix``, columns by falling length."""
    values, axes = np.linalg.eigh(matrix)
    return (axes * np.sqrt(np.maximum(values, 0)))[:, ::-1]


def appearance_vectors(image, toroidal, threads=1):
    """Filter responses (texels, 48 n) float32 of a feature image (rows, cols, n), filter by filter."""
    rows, cols, n = image.shape
    pictures = np.ascontiguousarray(image.transpose(2, 0, 1))
    kernels = leung_malik(base_sigma(rows, cols))
    out = np.empty((rows * cols, N_FILTERS, n), np.float32)
    for i, response in enumerate(filter_pictures(pictures, kernels, toroidal, threads)):
        out[:, i] = response.reshape(n, -1).T
    return out.reshape(rows * cols, -1)


def equalise(vectors):
    """Scale the filters' shares of full vectors (texels, 48 n), in place, to equal variance over the texels.

    Returns
    -------
    (48,) float32
        The factors, the strongest filter keeping its own responses; a filter fainter than 2 % of the strongest gets the factor of one of 2 %.
    """
    shares = vectors.reshape(len(vectors), N_FILTERS, -1)
    squares = np.zeros(shares.shape[1:])
    mean = shares.mean(axis=0, dtype=np.float64).astype(np.float32)
    for part in blocks(len(shares), _BLOCK):
        squares += np.square(shares[part] - mean).sum(axis=0, dtype=np.float64)
    energies = squares.sum(axis=1)
    strongest = energies.max()
    if strongest == 0:
        return np.ones(N_FILTERS, np.float32)
    factors = np.sqrt(strongest / np.maximum(energies, _FAINT**2 * strongest)).astype(np.float32)
    shares *= factors[:, None]
    return factors


def representative_pictures(textures, angular, toroidal, count, seed=0, threads=1):
    """Indices of the pictures that stand for all, by K-means over picture appearance vectors.

    A picture's appearance vector holds its filter responses, channel by channel, on a regular grid of places, 16 along
    the shorter side. Of each cluster the picture nearest to its centre is taken.

    Parameters
    ----------
    textures : (rows, cols, n) float32
    angular : (pairs, 3, n) float32
    toroidal : bool
    count : int

    Returns
    -------
    (min(count, pairs),) int
        In ascending order; fewer if pictures coincide.
    """
    if count >= len(angular):
        return np.arange(len(angular))
    # counted before any arithmetic: products of equal rows may differ by their rounding
    count = min(count, len(np.unique(angular.reshape(len(angular), -1), axis=0)))
    rows, cols, n = textures.shape
    step = max(1, min(rows, cols) // _GRID)
    pictures = np.ascontiguousarray(textures.transpose(2, 0, 1))
    matrix = np.zeros((n, n))
    for response in filter_pictures(
        pictures, leung_malik(base_sigma(rows, cols)), toroidal, threads
    ):
        grid = response[:, step // 2 :: step, step // 2 :: step].reshape(n, -1).astype(np.float64)
        matrix += grid @ grid.T
    vectors = (angular @ _root(matrix).astype(np.float32)).reshape(len(angular), -1)
    reduced, _ = reduce(vectors, _CLUSTER_DIMENSIONS, seed)
    found, labels = _kmeans(reduced, count, seed)
    centres = _means(vectors, labels, found)
    distance = _distances_to(vectors, centres, labels)
    order = np.lexsort((distance, labels))
    first = np.concatenate([[True], labels[order][1:] != labels[order][:-1]])
    return np.sort(order[first])


@dataclass
class Textons:
    """A vocabulary in the space of full vectors.

    Attributes
    ----------
    centres : (n, d) float64
        Means of the clusters.
    members : (texels,) int
        Cluster of each texel.
    labels : (texels,) int32
        Nearest centre of each texel, the texton map; here and there another than its cluster's.
    inertia : float
        Mean squared distance of texels to their nearest centre, as a share of their variance.
    share : float
        Share of the variance that the clustering saw.
    """

    centres: np.ndarray
    members: np.ndarray
    labels: np.ndarray
    inertia: float
    share: float


def cluster(vectors, count, seed=0):
    """Cluster full vectors by K-means, found in fewer dimensions and finished in all.

    K-means runs on the leading principal components. Its clusters' means in the full space are the textons, to which
    every vector is then assigned anew: labels are nearest centres in the full space.

    Parameters
    ----------
    vectors : (texels, d) float32
    count : int
        Clusters, at most the number of texels.
    seed : int

    Returns
    -------
    Textons
    """
    reduced, share = reduce(vectors, _CLUSTER_DIMENSIONS, seed)
    count, members = _kmeans(reduced, count, seed)
    centres = _means(vectors, members, count)
    labels, squares = _nearest(vectors, centres)
    mean = vectors.mean(axis=0, dtype=np.float64)
    total = sum(
        float(np.square(vectors[b].astype(np.float64) - mean).sum()) for b in blocks(len(vectors), _BLOCK)
    )  # fmt: skip
    inertia = squares / total if total > 0 else 0.0
    return Textons(centres, members, labels, inertia, share)


def reduce(vectors, dimensions, seed=0):
    """Leading principal components of vectors, by randomised subspace iteration.

    Returns
    -------
    (n, min(dimensions, d)) float32
        Coordinates: an orthogonal projection of the vectors less their mean.
    float
        Share of the variance that they keep.
    """
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    parts = blocks(len(vectors), _BLOCK)
    n, d = vectors.shape
    width = min(dimensions + 16, n, d)
    basis = np.random.default_rng(seed).standard_normal((d, width), np.float32)
    for _ in range(3):
        basis = np.linalg.qr(basis)[0]
        image = np.zeros((d, width), np.float32)
        for part in parts:
            centred = vectors[part] - mean
            image += centred.T @ (centred @ basis)
        basis = image
    basis = np.linalg.qr(basis)[0]
    coordinates = np.concatenate([(vectors[part] - mean) @ basis for part in parts])
    double = coordinates.astype(np.float64)
    values, axes = np.linalg.eigh(double.T @ double)
    axes = axes[:, ::-1][:, :dimensions]
    total = sum(float(np.square(vectors[part] - mean, dtype=np.float64).sum()) for part in parts)
    kept = float(values[::-1][:dimensions].sum() / total) if total > 0 else 1.0
    return (double @ axes).astype(np.float32), min(kept, 1.0)


def _kmeans(vectors, count, seed):
    """Number of clusters found (fewer if vectors coincide) and labels (n,) int."""
    import warnings

    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        # where containers hide them; one thread is used whatever their number
        warnings.filterwarnings("ignore", "Could not find the number of physical cores")
        labels = KMeans(count, n_init=1, random_state=seed).fit(vectors).labels_
    used, labels = np.unique(labels, return_inverse=True)
    return len(used), labels.astype(np.int64)


def _means(vectors, labels, count):
    """Means (count, d) float64 of the vectors of each label."""
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(count + 1))
    return np.stack(
        [vectors[order[a:b]].mean(axis=0, dtype=np.float64) for a, b in pairwise(starts)]
    )  # fmt: skip


def _nearest(vectors, centres):
    """Labels (n,) int32 of the nearest centres and the sum of squared distances to them."""
    origin = centres.mean(axis=0)
    centred = (centres - origin).astype(np.float32)
    squares = np.square(centred).sum(axis=1)
    labels, total = [], 0.0
    for part in blocks(len(vectors), _BLOCK):
        block = vectors[part] - origin.astype(np.float32)
        distance = squares - 2 * (block @ centred.T)
        label = distance.argmin(axis=1)
        labels.append(label.astype(np.int32))
        total += float(np.square(block - centred[label], dtype=np.float64).sum())
    return np.concatenate(labels), total


def _distances_to(vectors, centres, labels):
    """Squared distance of each vector to its own centre."""
    return np.square(vectors - centres[labels]).sum(axis=1)


def texton_level(textons, shape, valid=None):
    """FeatureLevel of a vocabulary: texton map, dot-product matrix and its Euclidean factor, default texton last.

    `valid` (rows, cols) bool says which texels the vocabulary's labels are of; all by default.

    Dot products are taken from the default texton, the mean of all: weights of a combination of textons sum to
    1, so distances do not depend on the origin, and single precision loses least there.
    """
    centres = np.concatenate([textons.centres, textons.centres.mean(axis=0, keepdims=True)])
    centres -= centres[-1]
    gram = centres @ centres.T
    gram = (gram + gram.T) / 2
    values, axes = np.linalg.eigh(gram)
    values, axes = np.maximum(values[::-1], 0), axes[:, ::-1]
    left = values.sum() - np.cumsum(values)
    d = int(np.argmax(left <= _FACTOR_LOSS * values.sum())) + 1
    vectors = axes[:, :d] * np.sqrt(values[:d])
    labels = textons.labels
    if valid is not None:
        labels = np.full(shape, len(textons.centres), np.int32)
        labels[valid] = textons.labels
    return FeatureLevel(
        labels.reshape(shape),
        (vectors - vectors[-1]).astype(np.float32),
        gram.astype(np.float32),
    )
