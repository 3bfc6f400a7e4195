"""The patch that is measured: one tile of a toroidal triangle mesh with its materials."""

from dataclasses import dataclass

import numpy as np

from btfpipe.errors import InputError
from btfpipe.sample.orientation import texels_to_step

DEEPEST = 20  # sides of a tile: rays run through the copies around it, as many as it is deep


@dataclass
class Patch:
    """One period of a meso-structure, in units of texels.

    The reference plane is n = 0; the tile covers s in [0, cols) and t in [0, rows), and what sticks out belongs to
    the neighbouring tile just as well.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of texels of the tile: its period.
    vertices : (n, 3) float32
        Positions (s, t, n).
    faces : (m, 3) int32
        Vertices of each triangle, counter-clockwise seen from outside.
    source : (n,) int32
        Row of the tables below that holds each vertex; vertices one period apart share one.
    normals : (k, 3) float32
        Unit shading normals.
    albedo : (k, 3) float32
        Diffuse albedo, linear Rec. 709.
    roughness : (k,) float32
        GGX roughness; the distribution's alpha is its square.
    f0 : (k, 3) float32
        Specular reflectance at normal incidence; 0 switches the specular part off at every angle.
    """

    shape: tuple
    vertices: np.ndarray
    faces: np.ndarray
    source: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    roughness: np.ndarray
    f0: np.ndarray

    def __post_init__(self):
        with np.errstate(over="ignore", invalid="ignore"):  # shows below
            self.vertices = np.ascontiguousarray(self.vertices, np.float32)
        for name in ("normals", "albedo", "roughness", "f0"):
            array = np.ascontiguousarray(getattr(self, name), np.float32)
            if not np.isfinite(array).all():
                raise InputError(f"{name} of the meso-structure holds NaN or infinite values.")
            setattr(self, name, array)
        self.faces = np.ascontiguousarray(self.faces, np.int32)
        self.source = np.ascontiguousarray(self.source, np.int32)
        if not np.isfinite(self.vertices).all():
            raise InputError("the meso-structure's vertices hold NaN or infinite values.")
        depth = float(np.ptp(self.vertices[:, 2].astype(float)))
        if depth > DEEPEST * max(self.shape):
            raise InputError(
                f"the meso-structure is {depth:.3g} texels deep over a tile of {' x '.join(map(str, self.shape))}; expected at"
                f" most {DEEPEST} times its side. Check heights and texels_per_mm."
            )

    @property
    def table_faces(self):
        """Rows of the tables at each triangle's corners (m, 3) int32."""
        return self.source[self.faces]

    @property
    def table_vertices(self):
        """One position (k, 3) for each row of the tables."""
        positions = np.zeros((len(self.normals), 3), np.float32)
        positions[self.source[::-1]] = self.vertices[::-1]
        return positions


def texel_positions(rows, cols, row, col):
    """Points (s, t) of texel coordinates on the reference plane of a (rows, cols) patch, in texels."""
    ds, dt = texels_to_step(
        np.asarray(row, float) - (rows - 0.5), np.asarray(col, float) + 0.5, 0.0
    )
    return ds, dt


def height_field(heights, albedo, roughness, f0, shape):
    """Make a Patch of a toroidal height field.

    Parameters
    ----------
    heights : (a, b) array
        Heights in texels over an even grid, row 0 at t = 0 (so upwards, unlike pictures); a and b vertices per
        period. The mean is subtracted: the reference plane lies at mean height.
    albedo : (a, b, 3) array
    roughness : (a, b) array
    f0 : (a, b, 3) array
    shape : (int, int)
        Rows and columns of texels.
    """
    heights = np.asarray(heights, np.float64)
    if not np.isfinite(heights).all():
        raise InputError("the height field holds NaN or infinite values.")
    heights = heights - heights.mean()
    n_t, n_s = heights.shape
    step_t, step_s = shape[0] / n_t, shape[1] / n_s
    i, j = np.meshgrid(np.arange(n_t + 1), np.arange(n_s + 1), indexing="ij")
    wrapped = np.pad(heights, ((0, 1), (0, 1)), mode="wrap")
    vertices = np.stack([j * step_s, i * step_t, wrapped], axis=-1).reshape(-1, 3)
    source = ((i % n_t) * n_s + j % n_s).ravel()
    corner = (np.arange(n_t)[:, None] * (n_s + 1) + np.arange(n_s)).ravel()
    # the diagonal that bends less: ridges and grooves are not sawn
    a, b, c, d = (source[corner + k] for k in (0, 1, n_s + 2, n_s + 1))
    flat = heights.ravel()
    rising = np.abs(flat[a] - flat[c]) <= np.abs(flat[b] - flat[d])
    first = np.where(rising[:, None], corner[:, None] + [0, 1, n_s + 2],
                     corner[:, None] + [0, 1, n_s + 1])  # fmt: skip
    second = np.where(rising[:, None], corner[:, None] + [0, n_s + 2, n_s + 1],
                      corner[:, None] + [1, n_s + 2, n_s + 1])  # fmt: skip
    faces = np.stack([first, second], axis=1).reshape(-1, 3)
    slope_s = (np.roll(heights, -1, 1) - np.roll(heights, 1, 1)) / (2 * step_s)
    slope_t = (np.roll(heights, -1, 0) - np.roll(heights, 1, 0)) / (2 * step_t)
    normals = np.stack([-slope_s, -slope_t, np.ones_like(heights)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Patch(
        tuple(shape), vertices, faces, source, normals.reshape(-1, 3),
        np.reshape(albedo, (-1, 3)), np.reshape(roughness, -1), np.reshape(f0, (-1, 3)),
    )  # fmt: skip
