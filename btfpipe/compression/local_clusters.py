"""Clusters of points that lie near flat pieces of a few dimensions: local PCA (Kambhatla and Leen 1997).

Like k-means, but a cluster is a mean and a few principal directions, and a point belongs to the cluster that
reconstructs it best. Two steps in turn, neither of which can raise the error: each cluster is fitted to
its points, each point goes to its best cluster.

A round costs points times clusters, and large samples have more of both. Beyond some number of points a cluster, the
clusters are found from a random part of the points; a few rounds over all of them follow.
"""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.parallel import blocks, ordered_map, single_threaded_blas

POINTS = 2048  # compared with all clusters at a time; fixed, as rounding hangs on it
_MANY, _EACH = 1 << 16, 128  # more points than the first, and than so many a cluster, are too many
_LAST = 3  # rounds over all points then
_STARTS = 3  # the best of so many: the outcome varies by some per cent with the first means
_ROUNDS = 60
_OPENING = 16  # rounds in which the directions are let in
_SETTLED = 2e-4  # the rounds end when the error falls by less than this share


def local_clusters(points, clusters, terms, *, given=None, seed=0, threads=1, on_progress=None):
    """Divide points into clusters, each near its own mean and few principal directions.

    The directions are let in little by little over the first rounds: with all of them at once, the first, arbitrary
    clusters fit well enough to stay as they are.

    Parameters
    ----------
    points : (n, dimensions) float32
    clusters : int
        At most n.
    terms : int
        Directions a cluster by which points are assigned, 0 for k-means.
    given : int, optional
        Directions a cluster in the answer, by default `terms`.
    seed : int
        Of the first means.
    threads : int
        Never changes the result.
    on_progress : callable, optional
        Called with (rounds done, rounds at most).

    Returns
    -------
    labels : (n,) int32
        Every cluster has a point.
    bases : list of (dimensions, given or fewer) float32
        Orthonormal principal directions of each cluster's points.
    error : float
        Sum of squared distances of the points from what their clusters make of them.
    """
    rng = np.random.default_rng(seed)
    best = np.inf
    every, most = points, max(_MANY, _EACH * clusters)
    if len(points) > most:
        points = points[np.sort(rng.choice(len(points), most, replace=False))]
    with single_threaded_blas():
        for start in range(_STARTS if clusters > 1 else 1):

            def report(turn, start=start):
                if on_progress is not None:
                    on_progress(start * _ROUNDS + turn + 1, _STARTS * _ROUNDS)

            means = _first_means(points, clusters, rng)
            found, error = _alternate(points, means, terms, threads, report)
            if error < best:
                labels, best = found, error
        if len(every) > most:
            means, bases = _fit(points, labels, clusters, terms, threads)
            points, (labels, best) = every, _assign(every, means, bases, threads)
            for _ in range(_LAST):
                means, bases = _fit(points, labels, clusters, terms, threads)
                labels, best = _assign(points, means, bases, threads)
        bases = _fit(points, labels, clusters, terms if given is None else given, threads)[1]
    if on_progress is not None:
        on_progress(_STARTS * _ROUNDS, _STARTS * _ROUNDS)
    return labels, bases, best


def _alternate(points, means, terms, threads, report):
    """Fit and assign in turn until settled: labels (n,) and the sum of squared errors."""
    clusters = len(means)
    bases = [np.zeros((points.shape[1], 0), np.float32)] * clusters
    error = np.inf
    labels = _assign(points, means, bases, threads)[0]
    for turn in range(_ROUNDS):
        now = min(turn * max(8, terms) // _OPENING, terms)
        means, bases = _fit(points, labels, clusters, now, threads)
        before, last = labels, error
        labels, error = _assign(points, means, bases, threads)
        report(turn)
        if now == terms and ((labels == before).all() or error > (1 - _SETTLED) * last):
            break
    return labels, error


def _first_means(points, clusters, rng):
    """Points far from each other: drawn with their squared distance from those drawn before (k-means++)."""
    squares = np.vecdot(points, points).astype(np.float64)
    nearest = np.full(len(points), np.inf)
    chosen = [int(rng.integers(len(points)))]
    for _ in range(clusters - 1):
        last = points[chosen[-1]]
        distances = np.maximum(squares - 2.0 * (points @ last) + squares[chosen[-1]], 0)
        distances[chosen[-1]] = 0
        nearest = np.minimum(nearest, distances)
        sums = np.cumsum(nearest)
        if sums[-1] > 0:
            chosen.append(
                min(int(np.searchsorted(sums, rng.random() * sums[-1], "right")), len(points) - 1)
            )
        else:
            chosen.append(int(rng.integers(len(points))))
    return points[chosen].astype(np.float64)


def _assign(points, means, bases, threads):
    """The best cluster of each point, (n,) int32, none left empty, and the sum of squared errors."""
    widths = np.array([basis.shape[1] for basis in bases])
    frame = np.concatenate([means.astype(np.float32).T, *bases], axis=1)
    offsets = [mean @ basis for mean, basis in zip(means, bases, strict=True)]
    offsets = np.concatenate(offsets).astype(np.float32)
    mean_squares = np.vecdot(means, means)
    ends = len(means) + np.cumsum([0, *widths])
    clusters = len(means)

    def work(part):
        some = points[part]
        labels = np.zeros(len(some), np.int32)
        errors = np.vecdot(some, some).astype(np.float64)
        _nearest(some @ frame, mean_squares, offsets, ends, labels, errors)
        return labels, errors

    results = list(ordered_map(work, blocks(len(points), POINTS), threads))
    labels, errors = (np.concatenate(parts) for parts in zip(*results, strict=True))
    _fill_empty(labels, errors, clusters)
    return labels, float(errors.sum())


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(inner, mean_squares, offsets, ends, labels, errors):
    """Fill the best cluster of each point and its squared error; `errors` come as the points' squares.

    `inner` (n, clusters + directions) are inner products with the means and with the directions of all clusters, cluster k's
    from ``ends[k]`` on; `offsets` those of its mean with them.
    """
    clusters = len(mean_squares)
    for p in range(len(labels)):
        least = np.inf
        for k in range(clusters):
            error = errors[p] - 2.0 * inner[p, k] + mean_squares[k]
            along = np.float32(0)
            for j in range(ends[k], ends[k + 1]):
                d = inner[p, j] - offsets[j - clusters]
                along += d * d
            error -= along
            if error < least:
                least = error
                labels[p] = k
        errors[p] = max(least, 0.0)


def _fill_empty(labels, errors, clusters):
    """Give each empty cluster the worst of the points that are not alone in theirs; in place."""
    counts = np.bincount(labels, minlength=clusters)
    for cluster in np.flatnonzero(counts == 0):
        point = int(np.where(counts[labels] > 1, errors, -1).argmax())
        counts[labels[point]] -= 1
        counts[cluster] = 1
        labels[point] = cluster
        errors[point] = 0


def _fit(points, labels, clusters, terms, threads):
    """Means (clusters, dimensions) float64 and principal directions of each cluster's points."""
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(np.bincount(labels, minlength=clusters))

    def work(cluster):
        first = ends[cluster - 1] if cluster else 0
        members = points[order[first : ends[cluster]]].astype(np.float64)
        mean = members.mean(axis=0)
        return mean, principal_directions(members - mean, terms).astype(np.float32)

    means, bases = zip(*ordered_map(work, range(clusters), threads), strict=True)
    return np.stack(means), list(bases)


def principal_directions(centred, terms):
    """The first principal directions (dimensions, terms or fewer) of centred points (n, dimensions)."""
    n, dimensions = centred.shape
    terms = min(terms, n - 1, dimensions)
    if terms < 1:
        return np.zeros((dimensions, 0))
    if n < dimensions:
        values, left = np.linalg.eigh(centred @ centred.T)
        values, left = values[::-1][:terms], left[:, ::-1][:, :terms]
        kept = values > 1e-14 * max(values[0], 1e-300)
        return (centred.T @ left[:, kept]) / np.sqrt(values[kept])
    return np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :terms]
