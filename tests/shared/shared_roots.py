"""What a coded Model shows between its texels and directions, by the definition alone: for comparison."""

import numpy as np

from btfpipe.directions import Hemisphere
from btfpipe.directions.pairs import NearestPairs


def gain(vectors, weight):
    """Weighted mean of the squared lengths over the squared length of the mean."""
    kept = weight @ (vectors**2).sum(axis=1)
    return kept / ((weight @ vectors) ** 2).sum() if kept > 0 else 1.0


class NaiveRoots:
    """Evaluates a `CodedModel` query by query, whole vectors of roots in place of tables."""

    def __init__(self, model, interpolation="barycentric"):
        self.model = model
        self.texture = np.asarray(model.texture_factors, float)
        n = self.texture.shape[2]
        self.angular = np.zeros((model.n_pairs, 3, n))
        for c, part in enumerate(model.angular_factors):
            self.angular[:, c, : part.shape[1]] = part
        lights = model.light_directions[model.light_index]
        self.angular_over_root = (
            self.angular / np.sqrt(np.maximum(lights[:, 2], 0.01))[:, None, None]
        )
        # a pair's roots over all texels, as the orthogonal texture factors let them be compared
        self.pair_vectors = self.angular_over_root * np.sqrt((self.texture**2).sum(axis=(0, 1)))
        self.listed = not model.is_product or interpolation == "reciprocal"
        if self.listed:
            self.count = 4 if interpolation == "four" else 9
            views = model.view_directions[model.view_index]
            self.near = NearestPairs(lights, views, self.count, interpolation == "reciprocal")
        else:
            self.hemispheres = [
                Hemisphere(d, interpolation)
                for d in (model.light_directions, model.view_directions)
            ]
        self.texel_scale = np.sqrt((self.angular**2).sum(axis=(0, 1)))

    def __call__(self, row, col, w_i, w_o):
        if w_i[2] <= 0:
            return np.zeros(3)
        factors, brightness = self._texel(row, col)
        pairs, weight, more = self._pairs(w_i, w_o)
        roots = np.asarray(self.model.colour, float) @ (
            np.tensordot(weight, self.angular_over_root[pairs], 1) @ factors
        )
        return roots * np.abs(roots) * w_i[2] * brightness * more

    def _texel(self, row, col):
        rows, cols = self.model.shape
        if not self.model.toroidal:
            row, col = np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)
        i, j = int(np.floor(row)), int(np.floor(col))
        y, x = row - i, col - j
        near = np.array([self.texture[a % rows, b % cols] for a in (i, i + 1) for b in (j, j + 1)])
        weight = np.array([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x])
        return weight @ near, gain(near * self.texel_scale, weight)

    def _pairs(self, w_i, w_o):
        """Pairs, weights, and what the value is multiplied by for its brightness."""
        model = self.model
        if self.listed:
            pair, weight = (
                np.zeros((1, self.count), np.int32),
                np.zeros((1, self.count), np.float32),
            )
            self.near.find(w_i[None], w_o[None], pair, weight)
            vectors = self.pair_vectors[pair[0]].reshape(self.count, -1)
            return pair[0], weight[0], np.sqrt(gain(vectors, weight[0]))
        light, view = (
            [a[0] for a in hemisphere.weights(w[None])]
            for hemisphere, w in zip(self.hemispheres, (w_i, w_o), strict=True)
        )
        grid = self.pair_vectors.reshape(
            len(model.view_directions), len(model.light_directions), -1
        )
        of_lights = grid[:, light[0]].swapaxes(0, 1).reshape(4, -1)
        of_views = grid[view[0]].reshape(4, -1)
        pairs = (view[0][:, None] * len(model.light_directions) + light[0]).ravel()
        weight = np.multiply.outer(view[1], light[1]).ravel()
        return pairs, weight, np.sqrt(gain(of_lights, light[1]) * gain(of_views, view[1]))
