"""Passes over the pictures of samples whose texels are clustered: each cluster's PCA, out of core."""

import itertools
import math

import numpy as np

from btfpipe.compression.local_clusters import POINTS
from btfpipe.compression.model import comparison_bytes
from btfpipe.compression.svd import (
    _PROCESS_BYTES,
    LEAST_PICTURES,
    _require_range,
    planar_pictures,
)
from btfpipe.errors import InputError, too_little
from btfpipe.parallel import blocks, ordered_map

REDUCED_TERMS = 150  # of each sample, for the clustering
JOINT_TERMS = 512  # of several samples together
OVERSAMPLING = 6
TYPES = {  # of the bases and the coordinates
    "half": (np.dtype(np.float16), np.dtype(np.float16)),
    "single": (np.dtype(np.float32), np.dtype(np.float32)),
    "byte": (np.dtype(np.int8), np.dtype(np.float16)),
}
_GROUPS = 32  # partial sums a pass, added in order; fixed, so that threads and memory never show
_DECODED_BYTES = 6 << 20  # linear pictures in a thread's hands; fixed, as sums hang on it
_NOISE = 1e-6  # a singular value below this share of its cluster's norm is rounding


def plan(samples, clusters, components, precision, threads, memory):
    """Pairs decoded at a time, groups of them at once, and threads, so that all stays within the memory.

    Only the first has a part in the result, and it depends on the samples alone.
    """
    pairs, texels = samples[0].n_pairs, sum(math.prod(sample.shape) for sample in samples)
    step = max(LEAST_PICTURES, _DECODED_BYTES // (12 * texels))
    step = min(step, math.ceil(pairs / _GROUPS))
    width = components + OVERSAMPLING
    basis, coordinate = (dtype.itemsize for dtype in TYPES[precision])
    # frames, the sum, and one in double precision; the answer
    fixed = _PROCESS_BYTES + 4 * 4 * width * texels
    fixed += (1 + components) * (3 * pairs * clusters * basis + texels * coordinate)
    each = 4 * width * texels + 3 * 12 * step * texels  # a partial sum; pictures being decoded
    each = max(each, comparison_bytes(max(samples, key=lambda sample: math.prod(sample.shape))))
    need = max(fixed + each, *_reduced_bytes(samples, clusters * (1 + components)))
    if need > memory:
        raise InputError(
            f"{clusters} clusters of {components} components and {texels} texels need"
            f" {too_little(need, memory)}, or ask for fewer clusters."
        )
    at_once = int(min((memory - fixed) // each, 2 * threads))
    return step, at_once, min(threads, at_once)


def _reduced_bytes(samples, directions):
    """Private memory taken before the passes: to reduce the samples, to make points of that, to cluster them."""
    texels = [math.prod(sample.shape) for sample in samples]
    rows = 3 * samples[0].n_pairs
    terms = min(REDUCED_TERMS, max(texels), rows)
    several = len(samples) > 1
    kept = 4 * terms * (sum(texels) + rows * len(samples) * several)
    # four arrays of the largest one's columns, and six of the weights
    last = 4 * (terms + 10) * (4 * max(texels) + 6 * rows)
    points = 4 * sum(texels) * (min(JOINT_TERMS, terms * len(samples)) if several else terms)
    gram = 24 * (terms * len(samples)) ** 2 * several
    return (
        _PROCESS_BYTES + kept * several + last,
        _PROCESS_BYTES + kept + gram,
        _PROCESS_BYTES + 4 * terms * sum(texels) + points * (2 if several else 1),
        _PROCESS_BYTES + points + 12 * POINTS * directions,
    )


class Passes:
    """Passes over the pictures of all samples, their texels sorted by cluster.

    A cluster's matrix `A` has its texels for rows, pairs and channels for columns. Its *frame* is a few orthonormal
    columns over the texels, the first of them constant: ``A^T frame`` gives the mean and, as the others are orthogonal
    to the constant, centred sums.
    """

    def __init__(self, samples, labels, clusters, precision, planned, progress):
        self.samples, self.progress = samples, progress
        self.step, self.at_once, self.threads = planned
        self.dtypes = TYPES[precision]
        self.n_pairs = samples[0].n_pairs
        self.order = np.argsort(labels, kind="stable")
        ends = np.cumsum([0, *np.bincount(labels, minlength=clusters)])
        self.parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def _groups(self, work):
        """Apply `work` to the steps of each group of pairs; yields the results in order."""
        report = self.progress.part(self.n_pairs * len(self.samples))
        groups = blocks(self.n_pairs, math.ceil(self.n_pairs / _GROUPS))

        def run(group):
            return work(
                slice(start, min(start + self.step, group.stop))
                for start in range(group.start, group.stop, self.step)
            )

        results = ordered_map(run, groups, self.threads, ahead=self.at_once)
        for group, result in zip(groups, results, strict=True):
            yield result
            if report is not None:
                report(group.stop, self.n_pairs)

    def _values(self, pairs):
        """Linear values (3 * pairs, texels) float32, texels sorted by cluster."""
        values = [planar_pictures(sample, pairs) for sample in self.samples]
        values = values[0] if len(values) == 1 else np.concatenate(values, axis=1)
        return values[:, self.order]

    def frames(self, points, directions):
        """First frames, from the reduced texels and the principal directions of their clusters."""
        return [
            _frame(points[self.order[part]] @ basis)
            for part, basis in zip(self.parts, directions, strict=True)
        ]

    def improve(self, frames, components):
        """One power iteration on the original pictures.

        Returns
        -------
        list of (texels, 1 + components or fewer) float32
            Frames of the best directions in the span of each given frame, once more multiplied by ``A A^T``.
        """
        widths = [frame.shape[1] for frame in frames]
        image = np.zeros((len(self.order), max(widths) - 1), np.float32)
        grams = [np.zeros((width, width)) for width in widths]

        def work(steps):
            sums, squares = np.zeros_like(image), [np.zeros_like(gram) for gram in grams]
            for pairs in steps:
                values = self._values(pairs)
                for part, frame, square in zip(self.parts, frames, squares, strict=True):
                    own = values[:, part]
                    weights = own @ frame
                    square += weights.T @ weights
                    sums[part, : frame.shape[1] - 1] += own.T @ weights[:, 1:]
            return sums, squares

        for sums, squares in self._groups(work):
            image += sums
            for gram, square in zip(grams, squares, strict=True):
                gram += square
        improved = []
        for part, gram in zip(self.parts, grams, strict=True):
            values, turn = np.linalg.eigh(gram[1:, 1:])
            values, turn = values[::-1][:components], turn[:, ::-1][:, :components]
            kept = values > _NOISE**2 * np.trace(gram)
            improved.append(_frame(image[part, : len(gram) - 1] @ turn[:, kept]))
        return improved

    def project(self, frames, components):
        """Bases, their scales (None unless in bytes), and coordinates in the order of the texels."""
        bases = np.zeros((len(self.parts), self.n_pairs, 3, 1 + components), self.dtypes[0])
        scales = None
        if bases.dtype == np.int8:
            scales = np.zeros(bases.shape[:2], np.float16)
        coordinates = np.zeros((len(self.order), components), self.dtypes[1])
        scaled = []
        for part, frame in zip(self.parts, frames, strict=True):
            # coordinates of largest magnitude 1; `A^T` of the constant column is the mean times the root of n
            largest = np.abs(frame[:, 1:]).max(axis=0, initial=0)
            coordinates[self.order[part], : len(largest)] = frame[:, 1:] / largest
            scaled.append(frame * np.append(np.float32(1 / math.sqrt(len(frame))), largest))

        def work(steps):
            for pairs in steps:
                values = self._values(pairs)
                for cluster, (part, frame) in enumerate(zip(self.parts, scaled, strict=True)):
                    found = (values[:, part] @ frame).reshape(-1, 3, frame.shape[1])
                    if scales is None:
                        _require_range(bases.dtype, found)
                    else:
                        found, scales[cluster, pairs] = _bytes(found)
                    bases[cluster, pairs, :, : frame.shape[1]] = found

        for _ in self._groups(work):
            pass
        return bases, scales, coordinates


def _bytes(values):
    """Values (pairs, 3, n) in whole steps, -127 to 127, and the size of each pair's step, float16."""
    largest = np.abs(values).max(axis=(1, 2))
    _require_range(np.float16, largest / 127)
    steps = (largest / 127).astype(np.float16)
    size = np.where(steps > 0, steps, np.inf).astype(np.float32)[:, None, None]
    return np.clip(np.round(values / size), -127, 127), steps


def _frame(columns):
    """A constant column and an orthonormal basis of the columns made orthogonal to it, float32."""
    n = len(columns)
    columns = columns[:, : n - 1].astype(np.float64)
    constant = np.full((n, 1), 1 / math.sqrt(n))
    columns -= columns.mean(axis=0)
    basis = np.linalg.qr(np.concatenate([constant, columns], axis=1))[0]
    basis[:, 0] = constant[:, 0]
    return basis.astype(np.float32)
