"""Where a CUReT sample lies in its pictures: what the rule says, and what has to be fitted.

The model is an orthographic camera. With J the projection of a picture's pair (`directions.curet`), a point (s, t) of the
sample, in pixels of a frontal view and counted from the sample's middle, is seen at

    (x, y) = centre + k * (J (s, t, height)) + shift        x to the right, y up.

Known by rule: J. Fitted for a set: `centre`, a scale `k` for each of the seven places of the camera (1 where it is
within 1 % of the others), the `height` of the surface above the robot's axes, and the sample's width and height, all from
the sample's outline on the dark background. Fitted for a picture: `shift`, from its texture against that of the pictures with the
most similar light and view. Left out: perspective and the lens's distortion.
"""

from dataclasses import dataclass

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.parallel import ordered_map, single_threaded_blas

LARGEST_SHIFT = 0.08  # of the patch's side, that a picture is looked for
_FEWEST_OUTLINES = 5
_SAME_SCALE = 0.01  # outlines do not tell scales nearer than this
_REGISTERED_SIDE = 256  # texels; more cost time and gain little
_NEIGHBOURS = 6
_WHITENING = 0.75  # 1 is phase correlation: one frequency of a regular weave would drown in the noise of all others
_PEAK = 8.0  # standard deviations; of pictures without texture one in hundreds of comparisons gets there
_PULL = 0.01  # weight of "no shift" against one measured difference: the robot errs by pixels, a peak by tenths


@dataclass
class Geometry:
    """The fit of a set.

    Attributes
    ----------
    centre : (float, float)
        Row and column of the sample's middle.
    camera_scale : (8,) float64
        Scale of each place of the camera; index 0 is not used.
    height : float
        Of the surface above the robot's axes, pixels.
    sides : (float, float) or None
        Height and width of the whole sample, pixels of a frontal view; None if its outline is not seen.
    shear : float or None
        Shear of the outlines over what the rule says: about 1; -1 says that the pictures are mirrored.
    outlines : int
        Pictures whose outline was used.
    """

    centre: tuple
    camera_scale: np.ndarray
    height: float = 0.0
    sides: tuple | None = None
    shear: float | None = None
    outlines: int = 0

    def affine(self, projection, camera, texels, side):
        """Texel to pixel: (row, col) in the picture = affine (2, 3) @ (row, col, 1) in the patch.

        Parameters
        ----------
        projection : (2, 3)
            Of the picture's pair.
        camera : int
        texels : int
            Side of the patch in texels.
        side : float
            And in pixels of a frontal view.
        """
        scale = self.camera_scale[camera]
        (right_s, right_t, right_n), (up_s, up_t, up_n) = projection
        # s runs with columns, t against rows
        turn = scale * side / texels * np.array([[up_t, -up_s], [-right_t, right_s]])
        middle = np.array(self.centre) + scale * self.height * np.array([-up_n, right_n])
        return np.column_stack([turn, middle - turn @ np.full(2, (texels - 1) / 2)])

    def reach(self, projection, camera, side, shape):
        """Pixels by which the frame exceeds the projected patch on its tightest side (negative: it is cut)."""
        corners = np.array([[-0.5, -0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5], [1, 1, 1, 1]])
        affine = self.affine(projection, camera, 1, side)
        row, col = affine @ corners
        return min(row.min(), col.min(), shape[0] - 1 - row.max(), shape[1] - 1 - col.max()) + 0.5


@leaf
def resample(picture, affine, finer, out):
    """Fill `out` (rows, cols, channels) float32 with a picture (rows, cols, channels) seen through an affine map.

    Bilinear between pixels, at ``finer`` x ``finer`` places of each texel, whose mean is taken; the border repeats.
    """
    rows, cols, channels = picture.shape
    share = np.float32(1.0 / (finer * finer))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for c in range(channels):
                out[i, j, c] = 0.0
            for a in range(finer):
                y = i + (a + 0.5) / finer - 0.5
                for b in range(finer):
                    x = j + (b + 0.5) / finer - 0.5
                    row = affine[0, 0] * y + affine[0, 1] * x + affine[0, 2]
                    col = affine[1, 0] * y + affine[1, 1] * x + affine[1, 2]
                    row = min(max(row, 0.0), rows - 1.0)
                    col = min(max(col, 0.0), cols - 1.0)
                    r = min(int(row), rows - 2)
                    k = min(int(col), cols - 2)
                    v = np.float32(row - r)
                    u = np.float32(col - k)
                    for c in range(channels):
                        above = picture[r, k, c] * (1 - u) + picture[r, k + 1, c] * u
                        below = picture[r + 1, k, c] * (1 - u) + picture[r + 1, k + 1, c] * u
                        out[i, j, c] += share * (above * (1 - v) + below * v)


def outline(grey):
    """The sample's outline against a dark background.

    Parameters
    ----------
    grey : (rows, cols)

    Returns
    -------
    (row, col), (2, 2) or None
        Middle, and covariance of (x, y) with y up, both in pixels. None unless one bright parallelogram stands free
        of the frame.
    """
    from scipy import ndimage

    rows, cols = grey.shape
    border = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    dark = float(np.median(border))
    inside = grey[rows // 3 : -(rows // 3), cols // 3 : -(cols // 3)]
    bright = float(np.median(inside)) if inside.size else dark
    if bright - dark < 2 or np.percentile(border, 98) > dark + 0.5 * (bright - dark):
        return None
    # a fifth of the way: dark spots of the texture should not tear the outline
    lit = ndimage.binary_closing(np.pad(grey > dark + 0.2 * (bright - dark), 3), iterations=2)
    label, count = ndimage.label(ndimage.binary_fill_holes(lit))
    if count == 0:
        return None
    sizes = np.bincount(label.ravel())
    row, col = np.nonzero(label == 1 + np.argmax(sizes[1:]))
    row, col = row - 3.0, col - 3.0
    if min(row.min(), col.min()) < 1 or row.max() > rows - 2 or col.max() > cols - 2:
        return None
    area = len(row)
    # a pixel is a square, not a point: hence the twelfth
    covariance = np.cov(col, -row, ddof=0) + np.eye(2) / 12
    fill = area / (
        12 * np.sqrt(np.linalg.det(covariance))
    )  # 1 for a parallelogram, 1.05 for an ellipse
    if not 0.95 < fill < 1.03 or area < 100:
        return None
    return (float(row.mean()), float(col.mean())), covariance


def fit(outlines, projections, cameras, shape):
    """Fit a `Geometry` to outlines.

    Parameters
    ----------
    outlines : list
        Of `outline`, one a picture.
    projections : (n, 2, 3)
    cameras : (n,)
    shape : (int, int)
        Of the pictures, whose middle is taken as the centre if fewer than five outlines are seen.

    Returns
    -------
    Geometry
    """
    camera_scale = np.ones(8)
    middle = tuple((n - 1) / 2 for n in shape)
    seen = [i for i, found in enumerate(outlines) if found is not None]
    if len(seen) < _FEWEST_OUTLINES:
        return Geometry(middle, camera_scale, outlines=len(seen))
    projections, cameras = projections[seen], cameras[seen]
    plane = projections[:, :, :2]
    covariance = np.array([outlines[i][1] for i in seen])
    shear = np.array([c[0, 1] / c[1, 1] for c in covariance])
    by_rule = plane[:, 0, 1] / plane[:, 1, 1]
    slope = float(shear @ by_rule / max(by_rule @ by_rule, 1e-9)) if len(seen) > 1 else None
    if slope is not None and slope < 0:
        return Geometry(middle, camera_scale, shear=slope, outlines=len(seen))
    inverse = np.linalg.inv(plane)
    flat = 12 * inverse @ covariance @ inverse.swapaxes(1, 2)
    good = np.abs(flat[:, 0, 1]) < 0.1 * np.sqrt(flat[:, 0, 0] * flat[:, 1, 1])
    if good.sum() < _FEWEST_OUTLINES:
        return Geometry(middle, camera_scale, shear=slope, outlines=int(good.sum()))
    places = np.array([outlines[i][0] for i in seen])[good]
    projections, cameras, flat, plane = projections[good], cameras[good], flat[good], plane[good]
    across, down = np.sqrt(flat[:, 0, 0]), np.sqrt(flat[:, 1, 1])
    # a pixel at the border matters least where the sample is seen widest
    weight_across, weight_down = plane[:, 0, 0] ** 2, plane[:, 1, 1] ** 2
    width, height = _median(across, weight_across), _median(down, weight_down)
    for camera in range(1, 8):
        here = cameras == camera
        if here.sum() >= 3:
            ratios = np.concatenate([across[here] / width, down[here] / height])
            ratio = _median(ratios, np.concatenate([weight_across[here], weight_down[here]]))
            if abs(ratio - 1) > _SAME_SCALE:
                camera_scale[camera] = ratio
    # centre and height above the axes: least absolute deviation, by weighted least squares
    scale = camera_scale[cameras]
    n = len(places)
    terms = np.zeros((2 * n, 3))
    terms[:n, 0] = terms[n:, 1] = 1
    terms[:n, 2], terms[n:, 2] = -scale * projections[:, 1, 2], scale * projections[:, 0, 2]
    values, weight = places.T.ravel(), np.ones(2 * n)
    for _ in range(20):
        found = np.linalg.lstsq(terms * weight[:, None], values * weight, rcond=None)[0]
        weight = 1 / np.sqrt(np.maximum(np.abs(terms @ found - values), 0.1))
    row, col, above = (float(x) for x in found)
    return Geometry((row, col), camera_scale, above, (float(height), float(width)), slope, n)


def _median(values, weight):
    """Weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def find_shifts(greys, affines, light, view, texels, threads=1):
    """Shifts of pictures, from their textures.

    Each picture is compared, by phase correlation weakened a little, with the six of most similar light and view; all
    differences found are then brought together (least absolute deviation, with a slight pull to no shift), so that no chain of
    comparisons drifts. Only differences count: the weighted median of all shifts is taken as none.

    Parameters
    ----------
    greys : list of (rows, cols)
        Pictures as taken.
    affines : (n, 2, 3)
        Of `Geometry.affine` for a patch of `texels` texels.
    light, view : (n, 3)
    texels : int
    threads : int
        Never changes the result.

    Returns
    -------
    shifts : (n, 2) float64
        Rows and columns, in pixels of the pictures.
    registered : (n,) bool
        Whether a picture's texture was recognised in another; those that were not have no shift.
    """
    from scipy import fft, ndimage

    n = len(greys)
    shifts, registered = np.zeros((n, 2)), np.zeros(n, bool)
    size = min(texels, _REGISTERED_SIDE)
    if n < 2 or size < 16:
        return shifts, registered
    coarser = texels / size
    # texel centres of the coarser patch in the finer one
    zoom = np.array([[coarser, 0, (coarser - 1) / 2], [0, coarser, (coarser - 1) / 2], [0, 0, 1]])
    affines = np.asarray(affines) @ zoom
    turns = affines[:, :, :2]
    window = np.hanning(size + 2)[1:-1]
    window = window[:, None] * window

    def spectrum(item):
        grey, affine = item
        patch = np.empty((size, size, 1), np.float32)
        pixels = np.linalg.norm(affine[:, :2], axis=0).max()
        resample(grey[..., None], affine, max(int(np.ceil(pixels)), 1), patch)
        patch = patch[..., 0]
        # slow changes are the light's, not the texture's
        patch = patch - ndimage.gaussian_filter(patch, size / 16, mode="nearest")
        return fft.rfft2(patch * window).astype(np.complex64)

    spectra = list(ordered_map(spectrum, zip(greys, affines, strict=True), threads))
    directions = np.hstack([light, view])
    away = ((directions[:, None] - directions) ** 2).sum(axis=2)
    order = np.argsort(away, axis=1, kind="stable")[:, 1 : 1 + _NEIGHBOURS]
    edges = sorted({(min(i, j), max(i, j)) for i in range(n) for j in order[i].tolist() if i != j})
    square = np.fft.fftfreq(size)[:, None] ** 2 + np.fft.rfftfreq(size) ** 2
    reach = max(int(LARGEST_SHIFT * size), 2)
    # of the equal peaks of a texture that repeats, the one nearest to no shift
    likely = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * reach**2))
    likely = likely[:, None] * likely

    def difference(edge):
        """Shift of texture i against j in texels (row, col), and how far its peak stands out."""
        i, j = edge
        # what a foreshortened view cannot resolve is noise
        cut = max(0.2 * min(view[i, 2], view[j, 2]), 0.06)
        cross = spectra[i] * np.conj(spectra[j])
        cross *= np.exp(-square / (2 * cut * cut)) / np.maximum(np.abs(cross), 1e-20) ** _WHITENING
        surface = fft.irfft2(cross, (size, size))
        near = np.roll(surface, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        row, col = np.unravel_index(np.argmax(near * likely), near.shape)
        if not (0 < row < 2 * reach and 0 < col < 2 * reach):
            return 0.0, 0.0, 0.0
        fine = [_vertex(near[row - 1 : row + 2, col]), _vertex(near[row, col - 1 : col + 2])]
        stands_out = float(near[row, col] / max(surface.std(), 1e-30))
        return reach - row - fine[0], reach - col - fine[1], stands_out

    found = np.array(list(ordered_map(difference, edges, threads)))
    edges = np.array(edges)
    kept = found[:, 2] > _PEAK
    if not kept.any():
        return shifts, registered
    edges, measured = edges[kept], found[kept, :2]
    registered[edges.ravel()] = True
    offsets = _agree(edges, measured, n)
    middle = [_median(offsets[registered, axis], view[registered, 2]) for axis in range(2)]
    offsets[registered] -= middle
    shifts[registered] = -np.einsum("nij,nj->ni", turns[registered], offsets[registered])
    return shifts, registered


def _vertex(three):
    """Place of the peak of a bell through three values, from the middle one: exact for a Gaussian."""
    if three.min() <= 0:
        return 0.0
    low, middle, high = np.log(three)
    bend = low - 2 * middle + high
    return float(np.clip((low - high) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


def _agree(edges, measured, n):
    """Offsets (n, 2) whose differences along edges (m, 2) are nearest the measured ones (m, 2)."""
    first, second = edges.T
    weight = np.ones(len(edges))
    with single_threaded_blas():
        for _ in range(20):
            laplacian = np.zeros((n, n))
            np.add.at(laplacian, (first, first), weight)
            np.add.at(laplacian, (second, second), weight)
            np.add.at(laplacian, (first, second), -weight)
            np.add.at(laplacian, (second, first), -weight)
            right = np.zeros((n, 2))
            np.add.at(right, first, weight[:, None] * measured)
            np.add.at(right, second, -weight[:, None] * measured)
            offsets = np.linalg.solve(laplacian + _PULL * np.eye(n), right)
            error = np.linalg.norm(offsets[first] - offsets[second] - measured, axis=1)
            weight = 0.3 / np.maximum(error, 0.3)
    return offsets
