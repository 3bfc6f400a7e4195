"""The protocol of Sample and Model: what a texel looks like, for any light and view.

Every stage takes either; a new compression is one module with a class that derives from `Appearance`
and fills in `pictures`, `texels`, `shader` and `nbytes`.
"""

from collections import namedtuple

import numpy as np

from btfpipe.errors import InputError

# Private bytes of shading: kept by the shader with what it stands on, further ones while that is opened and made, and those of
# a look-up's slice from so many lights on (see `Appearance.shader`). What would take less, if there is something. And bytes of the
# levels of detail, kept and while they are made.
ShadingNeeds = namedtuple(
    "ShadingNeeds",
    "kept loading slice_bytes many_lights instead levels making_levels",
    defaults=(0, 0, 0, 0, "", 0, 0),
)


def svd_levels(texels, pairs):
    """Bytes of levels of detail that are an SVD of averaged pictures, as keywords of `ShadingNeeds`."""
    terms = min(512, texels // 4 + 1, 3 * pairs)
    vectors = 4 * terms * (texels // 4 + 1)
    kept = 4 * terms * (texels // 3 + 1 + 3 * pairs)
    # more vectors, sums over pictures, weights in double precision, and pictures being averaged
    return {"levels": kept, "making_levels": 6 * vectors + 24 * terms * pairs + 300 * texels}


def light_cosines(light_directions):
    """Cosines (n,) float64 that values are divided by between measured lights; 0.01 at the least."""
    return np.maximum(np.asarray(light_directions, float)[:, 2], 0.01)


class Appearance:
    """A BTF over one flat patch.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of texels.
    light_directions, view_directions : (n, 3) float64
        Unit vectors towards the light and the eye.
    light_index, view_index : (pairs,) int32
        Light and view of each pair.
    toroidal : bool
        Whether the patch continues at the opposite border.
    texels_per_mm : float or None
    mask : (rows, cols) bool or None
        Valid texels; None if all are. What is measured over values leaves the others out, and synthesis never places them.
    """

    mask = None

    @property
    def n_invalid(self):
        """Number of texels that the mask leaves out."""
        return 0 if self.mask is None else int(np.size(self.mask) - np.count_nonzero(self.mask))

    @property
    def n_pairs(self):
        return len(self.light_index)

    @property
    def is_product(self):
        """Whether pair ``view * lights + light`` exists for every view and light, in that order."""
        lights, views = len(self.light_directions), len(self.view_directions)
        if self.n_pairs != lights * views:
            return False
        pair = np.asarray(self.view_index, np.int64) * lights + self.light_index
        return bool((pair == np.arange(self.n_pairs)).all())

    def require_product(self, what):
        """Refuse a list of pairs for a method that needs every view under every light."""
        if not self.is_product:
            raise InputError(
                f"{what} needs every view under every light; this sample is a list of {self.n_pairs} pairs"
                f" of {len(self.view_directions)} views and {len(self.light_directions)} lights."
            )

    def pictures(self, pairs):
        """Linear pictures (n, rows, cols, 3) float32 of the given pairs (a slice or indices)."""
        raise NotImplementedError

    def texels(self, rows, cols):
        """Linear values (n, pairs, 3) float32 of the given texels (two index arrays (n,))."""
        raise NotImplementedError

    def shader(self, interpolation="barycentric"):
        """An object whose ``shade(row, col, w_i, w_o, out)`` fills ``out`` (n, 3) float32 with values.

        `row`, `col` (n,) float32 are texel coordinates, read bilinearly (wrapping if toroidal, else clamped);
        `w_i`, `w_o` (n, 3) float32 are unit vectors in the sample's own frame. The call releases the GIL and may
        run on several threads at once. Between measured lights value / cos(theta_i) is interpolated and
        multiplied by the true cosine; a light below the horizon gives 0.

        A shader may share the work of many lights: ``slices(row, col, w_o)`` is then what look-ups show whatever the light,
        and its ``shade(chosen, w_i, out)`` fills ``out`` with the values of look-ups (m,) of them under a light each. It takes
        ``slice_bytes`` a look-up and is faster from ``many_lights`` lights on. Call it with BLAS on one thread.
        """
        raise NotImplementedError

    @classmethod
    def shading_needs(cls, reader):
        """Memory that shading from a file takes, told by the shapes in it, before it is opened as one of these.

        Parameters
        ----------
        reader : store.Reader
            Its arrays are mapped, and what is used as it is mapped does not count.

        Returns
        -------
        ShadingNeeds
        """
        return ShadingNeeds()

    @property
    def nbytes(self):
        """Bytes that the representation takes, tables of directions included."""
        raise NotImplementedError

    def evaluate(self, row, col, w_i, w_o, *, interpolation="barycentric"):
        """Values at any texel coordinate, light and view.

        Parameters
        ----------
        row, col : (n,) or scalar
            Texel coordinates; texel (i, j) is centred at row i, col j.
        w_i, w_o : (n, 3) or (3,)
            Unit vectors to the light and to the eye, in the sample's frame (s, t, n).
        interpolation : str
            Between measured directions: ``barycentric``, ``four``, ``nearest`` or ``reciprocal``; see
            `btfpipe.sample.shading.PairWeights`.

        Returns
        -------
        (n, 3) float32
            Reflected radiance relative to a perfect white diffuser lit at normal incidence.
        """
        row, col, w_i, w_o = (np.asarray(a, np.float32) for a in (row, col, w_i, w_o))
        n = max(row.size, col.size, w_i.size // 3, w_o.size // 3)
        arrays = [np.ascontiguousarray(np.broadcast_to(a, (n,))) for a in (row, col)]
        arrays += [np.ascontiguousarray(np.broadcast_to(a, (n, 3))) for a in (w_i, w_o)]
        out = np.zeros((n, 3), np.float32)
        self.shader(interpolation).shade(*arrays, out)
        return out
