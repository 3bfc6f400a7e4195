"""A Sample or Model at the directions of another: its pictures interpolated as they are asked for."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.parallel import blocks
from btfpipe.sample.appearance import Appearance
from btfpipe.sample.shading import PairWeights

_SOURCE_BYTES = 2 << 20  # linear pictures of the source held at a time


class Resampled(Appearance):
    """An Appearance at the directions of another one, as rendering would interpolate it there.

    A picture is the weighted sum of the few pictures of the source whose directions are nearest (`PairWeights`): over
    light value / cos(theta_i) is interpolated and multiplied by the true cosine. A Lambertian material stays exact, and
    at a direction that the source holds its picture is kept. Anything else has the error of interpolation, at every pair
    and before any compression: highlights and edges of shadows that move between two directions of the source are
    blended, and parallax is blurred. Directions outside the source's hull repeat what is at its edge. What lies between
    the new directions is lost where they are fewer, and nothing is gained where they are more.

    Parameters
    ----------
    source : Appearance
        A product or a list of pairs. Gives the texels.
    target : Appearance
        A product or a list of pairs. Gives directions and index tables alone; its size may be another.
    interpolation : str
        See `PairWeights`.

    Raises
    ------
    InputError
        If a direction of the source points below the surface, or the interpolation is unknown.
    """

    def __init__(self, source, target, interpolation="barycentric"):
        self.source = source
        for name in ("light_directions", "view_directions", "light_index", "view_index"):
            setattr(self, name, getattr(target, name))
        for name in ("shape", "toroidal", "texels_per_mm", "mask"):
            setattr(self, name, getattr(source, name))
        self.absolute = getattr(source, "absolute", False)
        self.about = dict(getattr(source, "about", {}))
        self._pair, self._share = _weights(source, self, interpolation)

    def pictures(self, pairs):
        """See `Appearance.pictures`; each picture of the source that takes part is read once, a few at a time."""
        pair, share = self._pair[pairs], self._share[pairs]
        out = np.zeros((len(pair), *self.shape, 3), np.float32)
        wanted = np.unique(pair[share != 0])
        place = np.empty(self.source.n_pairs, np.int32)
        for part in blocks(len(wanted), max(1, _SOURCE_BYTES // max(1, out[:1].nbytes))):
            some = wanted[part]
            place[:] = -1
            place[some] = np.arange(len(some))
            values = np.ascontiguousarray(self.source.pictures(some), np.float32)
            _add(values.reshape(len(some), -1), place[pair], share, out.reshape(len(pair), -1))
        return out

    def texels(self, rows, cols):
        values = np.asarray(self.source.texels(rows, cols), np.float32).swapaxes(0, 1)
        out = np.zeros((self.n_pairs, *values.shape[1:]), np.float32)
        values = np.ascontiguousarray(values).reshape(len(values), -1)
        _add(values, self._pair, self._share, out.reshape(self.n_pairs, -1))
        return np.ascontiguousarray(out.swapaxes(0, 1))

    def shader(self, interpolation="barycentric"):
        """The source's own: between the new directions there is no need to interpolate twice."""
        return self.source.shader(interpolation)

    @property
    def nbytes(self):
        tables = (self.light_directions, self.view_directions, self._pair, self._share)
        return int(self.source.nbytes + sum(table.nbytes for table in tables))


def _weights(source, target, interpolation):
    """Pairs of the source (pairs, m) int32 that make each pair of the target, ascending, and shares float32."""
    weights = PairWeights(source, interpolation)
    w_i = np.asarray(target.light_directions, np.float64)[target.light_index]
    w_o = np.asarray(target.view_directions, np.float64)[target.view_index]
    pair = np.empty((len(w_i), weights.most), np.int32)
    share = np.empty(pair.shape, np.float32)
    for part, found, shares in weights.blocks(w_i, w_o):
        pair[part], share[part] = found, shares
    # at a direction of the source the other shares are rounding: their pictures need not be read
    share[np.abs(share) < 1e-7 * share.max(axis=1, keepdims=True)] = 0
    # sums are taken in this order, however the pairs are cut into blocks
    order = np.argsort(pair, axis=1, kind="stable")
    return np.take_along_axis(pair, order, 1), np.take_along_axis(share, order, 1)


@njit(cache=True, nogil=True)
def _add(values, place, share, out):
    """Add to each row of ``out`` (n, k) its rows ``place`` (n, m) of ``values``, times ``share``; -1: not there."""
    for q in range(out.shape[0]):
        for p in range(place.shape[1]):
            at = place[q, p]
            w = share[q, p]
            if at < 0 or w == 0.0:
                continue
            for k in range(out.shape[1]):
                out[q, k] += w * values[at, k]
