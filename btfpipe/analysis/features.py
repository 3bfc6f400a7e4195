"""Features: what makes two texels alike, level by level."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError


@dataclass
class FeatureLevel:
    """Features of one pyramid level of a sample; level 0 is the finest.

    A texel's feature vector is ``vectors[labels[row, col]]``. Textons share vectors; a plain feature image has
    one vector a texel.

    Attributes
    ----------
    labels : (rows, cols) int32
    vectors : (n + 1, d) float32
        Feature vectors, compared by Euclidean distance. The last one is the default, for places that
        belong to nothing: invalid texels have its label, n.
    gram : (n + 1, n + 1) float32, optional
        Dot products of the full vectors that `vectors` stands for (the paper's dot-product matrix), default included.
    neighbours : (rows, cols, k) int32, optional
        Texels (``row * cols + col``) whose neighbourhoods are nearest to this one's, the texel itself first.
        The neighbourhood has one level on the coarsest level and two levels elsewhere.
    """

    labels: np.ndarray
    vectors: np.ndarray
    gram: np.ndarray | None = None
    neighbours: np.ndarray | None = None

    @property
    def shape(self):
        return self.labels.shape

    @property
    def valid(self):
        """Which texels may be shown (rows, cols) bool."""
        return np.asarray(self.labels) < len(self.vectors) - 1


@dataclass
class Features:
    """Feature levels of one sample, finest first.

    `about` records: ``toroidal``, ``neighbourhood`` (side of the square neighbourhood in texels that the lists were
    made with), ``coarse_neighbourhood`` (side on the next coarser level), ``sample_digest``.
    """

    levels: list[FeatureLevel]
    about: dict = field(default_factory=dict)

    @property
    def toroidal(self):
        return bool(self.about.get("toroidal", False))

    @classmethod
    def open(cls, path):
        """Map Features from their file, checking labels, shapes and finiteness."""
        from btfpipe.analysis.pyramid import check_pyramid, largest_feature

        reader = store.read(path, "features")
        sides = [reader.fact(name, "count") for name in ("neighbourhood", "coarse_neighbourhood")]
        reader.fact("toroidal", "flag", False)
        levels = []
        for i in range(reader.fact("levels", "count")):
            p = f"level{i}_"
            labels = reader.require(p + "labels", (None, None), "i")
            vectors = reader.require(p + "vectors", (None, None), "f")
            n, dimensions = vectors.shape
            most = largest_feature(max(dimensions, 1), *sides)
            reader.require(p + "vectors", vectors.shape, most=most)
            if labels.size == 0 or labels.min() < 0 or labels.max() > n - 1:
                raise InputError(f"{path}: labels of level {i} do not fit its {n - 1} vectors.")
            level = FeatureLevel(labels, vectors)
            if p + "gram" in reader:
                level.gram = reader.require(p + "gram", (n, n), "f", most=dimensions * most**2)
            if p + "neighbours" in reader:
                level.neighbours = reader.require(p + "neighbours", (*labels.shape, None), "i")
                low, high = level.neighbours.min(initial=0), level.neighbours.max(initial=0)
                if low < 0 or high >= labels.size:
                    raise InputError(f"{path}: neighbour lists of level {i} leave the sample.")
            if i and labels.shape != tuple(n >> i for n in levels[0].shape):
                raise InputError(
                    f"{path}: level {i} has {labels.shape} texels; expected the halves of the one before."
                )
            levels.append(level)
        check_pyramid(levels[0].shape, len(levels), *sides, str(path))
        return cls(levels, reader.about)

    def save(self, path):
        """Write the Features."""
        arrays = {}
        for i, level in enumerate(self.levels):
            for name in ("labels", "vectors", "gram", "neighbours"):
                if getattr(level, name) is not None:
                    arrays[f"level{i}_{name}"] = getattr(level, name)
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        store.write(path, "features", arrays, **(about | {"levels": len(self.levels)}))
