"""Pictures and shading from clusters of texels, each with its own basis."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.sample.shading import PairShader, corners


class LocalPcaShader(PairShader):
    """Evaluates a `LocalPcaModel` between its texels, lights and views.

    Coordinates are blended only among those of the four texels that share a cluster; the values of different clusters
    are blended, as their bases have nothing in common.

    Parameters
    ----------
    model : LocalPcaModel
    interpolation : str
        See `PairWeights`.
    """

    def __init__(self, model, interpolation="barycentric"):
        super().__init__(model, interpolation)
        self.coordinates, self.labels = model.own_texels()
        self.bases = model.bases_of(slice(None)).reshape(model.n_clusters, model.n_pairs, -1)

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part, pair, share in self.pairs.blocks(w_i, w_o):
            _shade(
                self.coordinates, self.labels, self.bases, self.rows, self.cols, self.toroidal,
                row[part], col[part], pair, share, out[part],
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _shade(coordinates, labels, bases, rows, cols, toroidal, row, col, pair, share, out):
    terms = coordinates.shape[1]
    width = 1 + terms
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    local = np.zeros(width, np.float32)
    blended = np.zeros(3 * width, np.float32)
    for q in range(len(row)):
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        out[q, :] = 0.0
        for first in range(4):
            # a texel's share becomes 0 when its cluster is done
            if bilinear[first] == 0.0:
                continue
            cluster = labels[texel[first]]
            local[:] = 0.0
            for b in range(first, 4):
                if labels[texel[b]] == cluster:
                    w = bilinear[b]
                    bilinear[b] = 0.0
                    own = coordinates[texel[b]]
                    local[0] += w
                    for k in range(terms):
                        local[1 + k] += w * own[k]
            blended[:] = 0.0
            for p in range(pair.shape[1]):
                basis = bases[cluster, pair[q, p]]
                w = share[q, p]
                for k in range(3 * width):
                    blended[k] += w * basis[k]
            for c in range(3):
                total = np.float32(0)
                at = c * width
                for k in range(width):
                    total += local[k] * blended[at + k]
                out[q, c] += total


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def fill_pictures(coordinates, labels, bases, out):
    """Fill `out` (n, texels, 3) with pictures.

    `coordinates` (texels, terms), `labels` (texels,), `bases` (clusters, n, 3, 1 + terms), the mean first.
    """
    terms = coordinates.shape[1]
    for p in range(out.shape[0]):
        for t in range(out.shape[1]):
            basis = bases[labels[t], p]
            own = coordinates[t]
            red = basis[0, 0]
            green = basis[1, 0]
            blue = basis[2, 0]
            for k in range(terms):
                red += own[k] * basis[0, 1 + k]
                green += own[k] * basis[1, 1 + k]
                blue += own[k] * basis[2, 1 + k]
            out[p, t, 0] = red
            out[p, t, 1] = green
            out[p, t, 2] = blue
