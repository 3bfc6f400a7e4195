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
        reader = store.read(path, "features")
        levels = []
        for i in range(reader.about["levels"]):
            p = f"level{i}_"
            labels = reader.require(p + "labels", (None, None), "i")
            vectors = reader.require(p + "vectors", (None, None), "f")
            n = len(vectors)
            if labels.size == 0 or labels.min() < 0 or labels.max() > n - 1:
                raise InputError(f"{path}: labels of level {i} do not fit its {n - 1} vectors.")
            level = FeatureLevel(labels, vectors)
            if p + "gram" in reader:
                level.gram = reader.require(p + "gram", (n, n), "f")
            if p + "neighbours" in reader:
                level.neighbours = reader.require(p + "neighbours", (*labels.shape, None), "i")
                if level.neighbours.min() < 0 or level.neighbours.max() >= labels.size:
                    raise InputError(f"{path}: neighbour lists of level {i} leave the sample.")
            levels.append(level)
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
