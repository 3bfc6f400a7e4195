"""Writes a simulated CUReT set of any Appearance; `curet` reads it.

The sample stands alone on a dark background, turned as the robot turns it, before an orthographic camera. What CUReT leaves
to the mechanics (shifts, scales) can be put in, so that what a reader finds can be compared with what is there.
"""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.directions.curet import COUNT, curet205
from btfpipe.errors import InputError
from btfpipe.formats.compress_z import compress
from btfpipe.formats.images import encode_picture
from btfpipe.formats.writing import create_set
from btfpipe.parallel import ordered_map

SUFFIXES = (".bmp.Z", ".bmp", ".png")
_SAMPLES = 61
_FILL = 0.75  # of the frame's shorter side


def write_curet(
    path,
    appearance,
    sample_number=1,
    *,
    suffix=".bmp.Z",
    frame=(480, 640),
    side=None,
    centre=None,
    largest_value=None,
    offset=0.0,
    calibrated=None,
    shifts=None,
    camera_scale=None,
    height=0.0,
    numbers=None,
    threads=1,
    on_progress=None,
):
    """Write the pictures that CUReT would have of an Appearance, and its ``acal.dat``.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder; see `writing.create_set`.
    appearance : Appearance
        Evaluated at each pair's directions; seen whole, row 0 at the top.
    sample_number : int
        1 to 61; it names the files and decides on the lamp.
    suffix : str
        ``.bmp.Z``, ``.bmp`` or ``.png``.
    frame : (int, int)
        Rows and columns of the pictures.
    side : float, optional
        Pixels that the longer side of the patch has in a frontal view; by default 3/4 of the frame's shorter side.
    centre : (float, float), optional
        Row and column of the sample's middle; by default the frame's.
    largest_value : float, optional
        Value of code 255; what is brighter is clipped. By default the largest that is drawn, so that nothing is; and at
        least 1 if calibrated.
    offset : float
        Value of code 0.
    calibrated : bool, optional
        Write ``acal.dat``, by which codes are values; by default if the Appearance's scale is absolute.
    shifts : (205, 2), optional
        Rows and columns, in pixels, by which each picture is displaced.
    camera_scale : (7,), optional
        Scale of the pictures at each place of the camera.
    height : float
        Of the surface above the robot's axes, pixels.
    numbers : iterable of int, optional
        Pictures to write; by default all 205.
    threads : int
        Never changes the result.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).

    Returns
    -------
    dict
        Facts: pictures written, clipped pixels, largest_value, calibrated.

    Raises
    ------
    InputError
        If the number or suffix is unknown, values are not finite or all below `offset`, or the file cannot be written.
    """
    from btfpipe.formats.curet import irradiance

    e0 = irradiance(sample_number)
    if suffix not in SUFFIXES:
        raise InputError(f"{suffix}: no ending of CUReT; expected one of {', '.join(SUFFIXES)}.")
    rows, cols = frame
    pairs = curet205()
    patch_rows, patch_cols = appearance.shape
    texel = (side or _FILL * min(frame)) / max(appearance.shape)  # pixels
    middle = np.array(centre or ((rows - 1) / 2, (cols - 1) / 2), float)
    scales = np.ones(7) if camera_scale is None else np.asarray(camera_scale, float)
    shifts = np.zeros((COUNT, 2)) if shifts is None else np.asarray(shifts, float)
    shader = appearance.shader()
    at = np.indices(appearance.shape, np.float32).reshape(2, -1)
    wanted = range(1, COUNT + 1) if numbers is None else sorted(set(numbers))
    if calibrated is None:
        calibrated = bool(getattr(appearance, "absolute", False))

    def shade(number):
        k = number - 1
        values = np.zeros((patch_rows * patch_cols, 3), np.float32)
        light, view = (
            np.ascontiguousarray(np.broadcast_to(d[k].astype(np.float32), (len(values), 3)))
            for d in (pairs.light, pairs.view)
        )
        shader.shade(*at, light, view, values)
        return values

    if largest_value is None:
        # drawing only averages, so no pixel is brighter than the brightest texel
        brightest = ordered_map(lambda number: shade(number).max(), wanted, threads)
        largest = float(np.max([*brightest, np.float32(0)]))  # NaN stays, unlike in Python's max
        if not np.isfinite(largest):
            raise InputError("the sample holds non-finite values; `btfpipe info` counts them.")
        largest_value = max(largest, 1.0) if calibrated or largest == 0 else largest
    span = largest_value - offset
    if not span > 0:
        raise InputError(
            f"the largest value is {largest_value:g}, that of code 0 {offset:g}; expected a larger one."
        )

    def draw(number):
        k = number - 1
        values = shade(number)
        (right_s, right_t, right_n), (up_s, up_t, up_n) = pairs.projection[k]
        scale = scales[pairs.camera[k] - 1]
        # (col, -row) of the picture from (s, t), and back: then from picture to texel
        onto = scale * texel * np.array([[right_s, right_t], [up_s, up_t]])
        back = np.linalg.inv(onto)
        place = middle + shifts[k] + scale * height * np.array([-up_n, right_n])
        affine = np.array(
            [
                [back[1, 1], -back[1, 0], 0],
                [-back[0, 1], back[0, 0], 0],
            ]
        )
        affine[:, 2] = np.array([patch_rows - 1, patch_cols - 1]) / 2 - affine[:, :2] @ place
        finer = int(np.clip(np.ceil(2 * np.abs(affine[:, :2]).sum(axis=1).max()), 2, 8))
        picture = np.zeros((rows, cols, 3), np.float32)
        _project(values.reshape(patch_rows, patch_cols, 3), affine, finer, picture)
        codes = np.floor((picture - offset) / span * 255 + 0.5)
        clipped = int((codes.max(axis=2) > 255).sum())
        codes = np.clip(codes, 0, 255).astype(np.uint8)
        data = encode_picture(codes, ".png" if suffix == ".png" else ".bmp")
        return number, compress(data) if suffix == ".bmp.Z" else data, clipped

    facts = {
        "pictures": 0,
        "clipped_pixels": 0,
        "largest_value": largest_value,
        "calibrated": calibrated,
    }
    with create_set(path, {"layout": "CUReT"}) as put:
        if calibrated:
            gain, at_zero = span / 255 * e0 / np.pi, offset * e0 / np.pi
            lines = [
                f"{n} {gain:.9g} {at_zero:.9g}\n" if n == sample_number else f"{n} 1 0\n"
                for n in range(1, _SAMPLES + 1)
            ]
            put("acal.dat", "".join(lines).encode())
        for number, data, clipped in ordered_map(draw, wanted, threads):
            put(f"sample{sample_number:02d}/{sample_number:02d}-{number:03d}{suffix}", data)
            facts["pictures"] += 1
            facts["clipped_pixels"] += clipped
            if on_progress is not None:
                on_progress(facts["pictures"], len(wanted))
    return facts


@leaf
def _project(values, affine, finer, out):
    """Draw a patch (rows, cols, 3) into a picture of zeros, through the affine map from picture to patch."""
    rows, cols = values.shape[0], values.shape[1]
    share = np.float32(1.0 / (finer * finer))
    # how far from its middle a pixel reaches, in texels
    high = 0.5 + 0.5 * (abs(affine[0, 0]) + abs(affine[0, 1]))
    wide = 0.5 + 0.5 * (abs(affine[1, 0]) + abs(affine[1, 1]))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            row = affine[0, 0] * i + affine[0, 1] * j + affine[0, 2]
            col = affine[1, 0] * i + affine[1, 1] * j + affine[1, 2]
            if row < -high or col < -wide or row > rows - 1 + high or col > cols - 1 + wide:
                continue
            for a in range(finer):
                y = i + (a + 0.5) / finer - 0.5
                for b in range(finer):
                    x = j + (b + 0.5) / finer - 0.5
                    row = affine[0, 0] * y + affine[0, 1] * x + affine[0, 2]
                    col = affine[1, 0] * y + affine[1, 1] * x + affine[1, 2]
                    if row < -0.5 or col < -0.5 or row >= rows - 0.5 or col >= cols - 0.5:
                        continue
                    row = min(max(row, 0.0), rows - 1.0)
                    col = min(max(col, 0.0), cols - 1.0)
                    r = int(row)
                    k = int(col)
                    r1 = min(r + 1, rows - 1)
                    k1 = min(k + 1, cols - 1)
                    v = np.float32(row - r)
                    u = np.float32(col - k)
                    for c in range(3):
                        above = values[r, k, c] * (1 - u) + values[r, k1, c] * u
                        below = values[r1, k, c] * (1 - u) + values[r1, k1, c] * u
                        out[i, j, c] += share * (above * (1 - v) + below * v)
