"""Weights between measured pairs of light and view that are no product: nearest pairs in light-view space.

A pair is a point (w_i, w_o) in six dimensions, and two pairs are as far apart as their chords together:
``d^2 = |w_i - w_i'|^2 + |w_o - w_o'|^2``. The weights are those of the four nearest pictures of a product: they fall to zero at the
distance of the first pair left out (Shepard 1968, Franke and Little), so that values change continuously, and a
measured pair returns itself.
"""

import numpy as np

from btfpipe.errors import InputError

_SAME = 1e-6  # distance within which a query is a measured pair: single precision of directions


class NearestPairs:
    """Interpolates over a list of pairs.

    Parameters
    ----------
    lights, views : (pairs, 3) float
        Unit vectors of each pair, on the upper hemisphere.
    count : int
        Pairs that share a query.
    reciprocal : bool
        Every pair also stands for the one with light and view exchanged (Helmholtz: value / cos(theta_i) is the same), unless
        that one is measured, too. On a flat patch seen with parallax that holds for the material, not texel by texel.

    Raises
    ------
    InputError
        If a direction points below the surface.
    """

    def __init__(self, lights, views, count, reciprocal=False):
        from scipy.spatial import cKDTree

        points = np.concatenate([lights, views], axis=1).astype(np.float64)
        if min(points[:, 2].min(), points[:, 5].min()) < -1e-6:
            raise InputError(
                "a pair's light or view points below the surface; only the upper hemisphere can be interpolated."
            )
        self._pair = np.arange(len(points))  # of each point
        if reciprocal:
            exchanged = points[:, [3, 4, 5, 0, 1, 2]]
            new = cKDTree(points).query(exchanged)[0] > _SAME
            points = np.concatenate([points, exchanged[new]])
            self._pair = np.concatenate([self._pair, self._pair[new]])
        self.count = min(count, len(points))
        self._tree = cKDTree(points)
        # with all pairs in use none is left out: none is farther than the diameter of both spheres
        self._all = len(points) == self.count

    def find(self, w_i, w_o, pair, weight):
        """Fill `pair` (n, m) int32 and `weight` (n, m) float32, m >= `count`, for queries (n, 3).

        Weights add up to 1. Directions below the surface are taken at the horizon.
        """
        queries = np.concatenate([lifted(w_i), lifted(w_o)], axis=1, dtype=np.float64)
        distance, index = self._tree.query(queries, k=range(1, self.count + 1 + (not self._all)))
        radius = np.full((len(queries), 1), 2 * np.sqrt(2)) if self._all else distance[:, -1:]
        distance, index = distance[:, : self.count], index[:, : self.count]
        near = np.maximum(distance, _SAME)
        shares = np.square(np.maximum(1 / near - 1 / np.maximum(radius, _SAME), 0))
        # pairs all equally far away: an even share each
        shares[shares.sum(axis=1) == 0] = 1
        exact = distance[:, 0] <= _SAME
        shares[exact] = 0
        shares[exact, 0] = 1
        pair[:, : self.count] = self._pair[index]
        weight[:, : self.count] = shares / shares.sum(axis=1, keepdims=True)
        pair[:, self.count :] = 0
        weight[:, self.count :] = 0


def lifted(directions):
    """Directions (n, 3), those below the surface turned up to the horizon."""
    below = directions[:, 2] < 0
    if not below.any():
        return directions
    out = np.array(directions)
    out[below, 2] = 0
    out[below] /= np.maximum(np.linalg.norm(out[below], axis=1, keepdims=True), 1e-30)
    return out
