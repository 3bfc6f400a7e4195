"""CUReT, the Columbia-Utrecht database: 61 samples of 205 pictures, each sample tilted before the camera.

A set is a folder or zip of 24-bit pictures (``.bmp``, ``.bmp.Z`` or ``.png``); the last number in a name is that of the
pair (`directions.curet`). The sample is seen foreshortened; `curet_geometry` says how pictures are brought to the
frontal view, and with what approximations. Codes are linear in radiance.

Radiometry: with ``ccal.dat`` (a gain and an offset for each of red, green and blue) or ``acal.dat`` (one gain and offset)
beside the pictures or beside the set, radiance = gain * code + offset in W/(sr m^2), and value = pi * radiance / E0, where E0 is the
irradiance of the lamp that lit this sample. So values are absolute. The published E0 is that of the whole spectrum; that
channels of ``ccal.dat`` go by the same E0 is an assumption. Without these files the scale is unknown.
To check a calibrated set against the BRDFs that the database's authors measured (``abrdf.dat``), see `brdf_ratios`.

Assumptions that real sets should be checked for: the sample's frame in the table has s to the right and t up in an upright
picture (``shear`` among the facts is about 1 then, -1 if pictures are mirrored, which is refused; pictures upside down
cannot be told); file names end in the number.

References
----------
Dana, van Ginneken, Nayar, Koenderink 1999, Reflectance and Texture of Real-World Surfaces.
"""

import contextlib
import re
import struct
from pathlib import Path, PurePosixPath

import numpy as np

from btfpipe.directions.curet import COUNT, curet205
from btfpipe.errors import InputError
from btfpipe.formats.archive import COPY, is_zip, open_archive, read_file
from btfpipe.formats.compress_z import MAGIC, decompress
from btfpipe.formats.curet_geometry import LARGEST_SHIFT, find_shifts, fit, outline, resample
from btfpipe.formats.curet_writing import write_curet
from btfpipe.formats.images import Decoder, colours, is_mislabelled
from btfpipe.formats.picture_sets import is_settings
from btfpipe.formats.ubo import parse_name
from btfpipe.parallel import ordered_map
from btfpipe.sample.measurement import Measurement

__all__ = [
    "brdf_ratios", "irradiance", "open_measurement", "read_brdf_table", "recognise", "write_curet",
]  # fmt: skip

VIEW_LIMIT_DEG = 75.0
_ENDINGS = (".bmp", ".bmp.z", ".png")
_NAME = re.compile(r"^\d{1,2}[-_ ]\d{1,3}\.(bmp|bmp\.z|png)$", re.IGNORECASE)
_FOLDER = re.compile(r"sample[-_ ]?(\d{1,2})(?!\d)", re.IGNORECASE)
_CALIBRATIONS = {"ccal.dat": 6, "acal.dat": 2}  # numbers a sample; the first found counts
_MARGIN = 0.9  # of the sample's shorter side, kept by default
_HEADER = 54
_MAX_PICTURE = 2**28
_PADDING = 4096  # bytes after the pixels, which some writers leave
_SAMPLES = 61
_MOST_TABLE = 1 << 20  # bytes


def irradiance(sample_number):
    """Irradiance E0 on a surface that faces the lamp, W/m^2: three lamps were used in turn."""
    if not 1 <= sample_number <= _SAMPLES:
        raise InputError(f"sample number is {sample_number}; CUReT has 1 to {_SAMPLES}.")
    return 9.56379 if sample_number <= 8 else 57.664 if sample_number <= 44 else 13.0799


class Listing:
    """What the names in a folder or zip say, before any picture is read.

    Attributes
    ----------
    pictures : dict
        Name of each picture number, in order; of numbers there twice, the first.
    duplicates : list of (str, str)
    outside : list of str
        Pictures whose number is not 1 to 205.
    calibrations : dict
        Names of ``acal.dat`` and ``ccal.dat``.
    strays : list of str
        Everything else.
    sample_number : int or None
        From names ``NN-KKK`` that agree, or ``sampleNN`` of the set or a folder in it.
    """

    def __init__(self, archive):
        pictures, self.duplicates, self.outside, self.strays = {}, [], [], []
        self.calibrations = {}
        leading, folders = set(), set(_FOLDER.findall(archive.path.name))
        self.typical = 0
        for name in archive.names:
            path = PurePosixPath(COPY.sub("", name))
            base, parts = path.name, path.parts[:-1]
            if is_settings(base):
                continue
            hidden = any(part.startswith(".") or part == "__MACOSX" for part in path.parts)
            stem = _stem(base) if parse_name(base) is None else None
            numbers = re.findall(r"\d+", stem) if stem is not None else []
            if hidden or not numbers:
                if base.lower() in _CALIBRATIONS and not hidden:
                    self.calibrations.setdefault(base.lower(), name)
                else:
                    self.strays.append(name)
                continue
            self.typical += bool(_NAME.match(base)) or base.lower().endswith(".z")
            number = int(numbers[-1][-9:])
            if not 1 <= number <= COUNT:
                self.outside.append(name)
            elif number in pictures:
                self.duplicates.append((pictures[number], name))
            else:
                pictures[number] = name
            if len(numbers) == 2:
                leading.add(numbers[0])
            folders.update(found for part in parts for found in _FOLDER.findall(part))
        self.strays += archive.others
        self.pictures = dict(sorted(pictures.items()))
        self.sample_number = None
        for found in (leading, folders):
            found = {int(number) for number in found}
            if len(found) == 1 and 1 <= min(found) <= _SAMPLES:
                self.sample_number = found.pop()
                break


def _stem(base):
    """A picture's name without its ending, or None for what is no picture."""
    ending = next((e for e in _ENDINGS if base.lower().endswith(e)), None)
    return None if ending is None else base[: -len(ending)]


def recognise(path):
    """Why a folder or zip is taken for a CUReT set, in a few words; None if it is not."""
    path = Path(path)
    if not path.is_dir() and not is_zip(path):
        return None
    try:
        with open_archive(path) as archive:
            listing = Listing(archive)
    except InputError:
        return None  # whoever opens it says what is wrong
    count = len(listing.pictures)
    # a table of directions beside the pictures belongs to another format
    if count == 0 or any(name.lower().endswith((".lp", ".csv")) for name in listing.strays):
        return None
    if listing.typical >= max(1, count // 2):
        first = next(iter(listing.pictures.values()))
        return f"{count} pictures numbered as CUReT's, such as {PurePosixPath(first).name}"
    named = _FOLDER.search(path.name) or any(_FOLDER.search(n) for n in listing.pictures.values())
    if named and not listing.outside:
        return f"{count} pictures numbered within 1 to {COUNT} under a name such as sampleNN"
    return None


@contextlib.contextmanager
def open_measurement(
    path,
    *,
    size=None,
    rectify=True,
    register=True,
    centre=None,
    side=None,
    view_limit_deg=VIEW_LIMIT_DEG,
    sample_number=None,
    threads=1,
):
    """Open a CUReT set: a list of pairs, of which any may be missing.

    Parameters
    ----------
    path : path-like
        Folder or zip.
    size : int, optional
        Texels a side of the square patch; by default one a pixel of the frontal view. Texels larger than a pixel
        take the mean over their area.
    rectify : bool
        Bring pictures to the frontal view. If not, all pictures are given whole, as they are.
    register : bool
        Find a residual shift for each picture; see `curet_geometry.find_shifts`.
    centre : (float, float), optional
        Row and column of the sample's middle; by default fitted to the sample's outline.
    side : float, optional
        Side of the patch in pixels of a frontal view; by default 90 % of the outline's shorter side, or what
        fits the frame in all views used if no outline is seen.
    view_limit_deg : float
        Views further from the normal are left out and counted: what they show is too foreshortened (75 degrees: by 3.9).
    sample_number : int, optional
        1 to 61, for the radiometry; by default from names.
    threads : int
        For the fit; never changes the result.

    Yields
    ------
    Measurement
        Whose ``read(pair)`` gives float32 pictures: values if calibrated, else codes over 255. Only pictures that are neither
        rectified nor calibrated come as stored.

    Raises
    ------
    InputError
        If there are no pictures, a number is there twice or outside 1 to 205, pictures differ in size, a picture or a
        calibration is damaged, or the patch leaves the frame.
    """
    with open_archive(path) as archive, Decoder() as decoder:
        listing = Listing(archive)
        _require_sound(path, listing)
        pairs = curet205()
        numbers = list(listing.pictures)
        limit = np.cos(np.radians(view_limit_deg))
        used = [n for n in numbers if not rectify or pairs.view[n - 1, 2] >= limit - 1e-9]
        if not used:
            raise InputError(
                f"{path}: none of its {len(numbers)} pictures is seen within {view_limit_deg:g} degrees of the"
                " normal. Allow more, or add pictures."
            )
        calibration, source = _calibration(
            Path(path), archive, listing, sample_number or listing.sample_number
        )
        mislabelled = set()

        def load(number):
            name = listing.pictures[number]
            label = archive.label(name)
            data = archive.read(name)
            if data[:2] == MAGIC:
                data = unpack_bmp(data, label)
                name = re.sub(r"\.z$", "", name, flags=re.IGNORECASE)
            picture = decoder.decode(data, label)
            if is_mislabelled(COPY.sub("", name), picture.suffix):
                mislabelled.add(listing.pictures[number])
            values = colours(picture, label)
            if values.dtype != np.uint8:
                raise InputError(
                    f"{label}: holds {values.dtype} values; expected 8 bits a channel."
                )
            return np.ascontiguousarray(values)

        members = [archive.label(listing.pictures[number]) for number in used]
        index = np.array(used) - 1
        light, view = pairs.light[index], pairs.view[index]
        gain, offset = calibration if calibration is not None else (1 / 255, 0.0)
        gain, offset = np.float32(gain), np.float32(offset)
        facts = {
            "format": "CUReT",
            "sample_number": sample_number or listing.sample_number,
            "radiometry": source,
            "missing": sorted(set(range(1, COUNT + 1)) - set(numbers)),
            "dropped": sorted(set(numbers) - set(used)),
            "strays": listing.strays,
            "mislabelled": mislabelled,
        }
        if rectify:
            read, found = _rectifier(
                path, load, used, members, pairs, size, centre, side, register, gain, offset, threads
            )  # fmt: skip
            facts |= {"view_limit_deg": view_limit_deg} | found
        else:

            def read(pair):
                codes = load(used[pair])
                return codes if calibration is None else codes * gain + offset

        lights, light_index = _distinct(light)
        views, view_index = _distinct(view)
        yield Measurement(
            source=Path(path),
            light_directions=lights,
            view_directions=views,
            light_index=light_index,
            view_index=view_index,
            names=members,
            read=read,
            transfer=lambda picture: "linear",
            white=None if calibration is None else 1.0,
            toroidal=False,
            facts=facts,
        )


def _require_sound(path, listing):
    if listing.outside:
        raise InputError(
            f"{path}: {len(listing.outside)} pictures end in a number that is none of CUReT's 1 to {COUNT} (first:"
            f" {listing.outside[0]!r}); remove or rename them."
        )
    if not listing.pictures:
        seen = f"{len(listing.strays)} other files" if listing.strays else "none"
        raise InputError(
            f"{path}: holds no numbered pictures ({seen}); expected names such as '01-001.bmp.Z'."
        )
    if listing.duplicates:
        first, second = listing.duplicates[0]
        raise InputError(
            f"{path}: {len(listing.duplicates)} picture numbers are there twice (first: {first!r} and {second!r});"
            " remove one of each."
        )


def unpack_bmp(data, label):
    """A BMP out of a ``.bmp.Z``, no longer than its own header says.

    Raises
    ------
    InputError
        If it is no BMP, or is longer or shorter than it should be.
    """
    head = decompress(data, _HEADER, label, start_only=True)
    if len(head) < _HEADER or head[:2] != b"BM":
        raise InputError(f"{label}: truncated, or no BMP inside (starts with {head[:2]!r}).")
    (start,) = struct.unpack_from("<I", head, 10)
    cols, rows, _, bits = struct.unpack_from("<iiHH", head, 18)
    needed = start + (abs(cols) * bits + 31) // 32 * 4 * abs(rows)
    if not 0 < needed <= _MAX_PICTURE:
        raise InputError(
            f"{label}: declares {abs(rows)} x {abs(cols)} pixels of {bits} bits; expected a picture of at most"
            f" {_MAX_PICTURE} bytes."
        )
    whole = decompress(data, needed + _PADDING, label)
    if len(whole) < needed:
        raise InputError(
            f"{label}: truncated; holds {len(whole)} of {needed} bytes. Fetch it again."
        )
    return whole


def _rectifier(path, load, used, names, pairs, size, centre, side, register, gain, offset, threads):
    """Fit the geometry; return ``read(pair)`` and facts."""
    index = np.array(used) - 1
    projection, camera = pairs.projection[index], pairs.camera[index]

    def look(number):
        picture = load(number)
        grey = (picture.astype(np.uint16).sum(axis=2) // 3).astype(np.uint8)
        full = picture == 255
        clipped = int(np.count_nonzero(full[..., 0] | full[..., 1] | full[..., 2]))
        return grey, outline(grey), clipped

    greys, outlines, clipped = zip(*ordered_map(look, used, threads), strict=True)
    shape = greys[0].shape
    for grey, name in zip(greys, names, strict=True):
        if grey.shape != shape:
            raise InputError(
                f"{name}: has {grey.shape[0]} x {grey.shape[1]} pixels; the first picture, {names[0]}, has"
                f" {shape[0]} x {shape[1]}. All pictures of a set must agree."
            )
    if min(shape) < 2:
        raise InputError(
            f"{names[0]}: has {shape[0]} x {shape[1]} pixels; expected at least 2 x 2."
        )
    geometry = fit(outlines, projection, camera, shape)
    if geometry.shear is not None and geometry.shear < -0.5 and geometry.outlines >= 5:
        raise InputError(
            f"{path}: its pictures are mirrored: the sample leans the other way than CUReT's table says. Mirror them, or"
            " read them with rectify=False."
        )
    if centre is not None:
        geometry.centre = tuple(float(x) for x in centre)

    def reach(side):
        return [geometry.reach(p, c, side, shape) for p, c in zip(projection, camera, strict=True)]

    if side is None:
        side = _MARGIN * min(geometry.sides) if geometry.sides else _largest_inside(reach, shape)
        if geometry.sides and min(reach(side)) < 0:
            side = min(side, _largest_inside(reach, shape))
    if not side >= 2:
        raise InputError(
            f"{path}: a patch of {side:g} pixels a side cannot be cut out; the sample's middle is taken to be at row"
            f" {geometry.centre[0]:.1f}, column {geometry.centre[1]:.1f} of {shape[0]} x {shape[1]}. Give centre and side."
        )
    worst = int(np.argmin(reach(side)))
    if reach(side)[worst] < -1:
        raise InputError(
            f"{names[worst]}: the patch of {side:.1f} pixels a side leaves the picture by {-reach(side)[worst]:.1f}"
            " pixels; choose a smaller side, another centre or fewer views."
        )
    texels = int(size or max(side // 2 * 2, 2))
    affines = np.array(
        [geometry.affine(p, c, texels, side) for p, c in zip(projection, camera, strict=True)]
    )
    shifts, registered = np.zeros((len(used), 2)), np.zeros(len(used), bool)
    if register:
        shifts, registered = find_shifts(
            greys, affines, pairs.light[index], pairs.view[index], texels, threads
        )
    affines[:, :, 2] += shifts
    finer = [max(int(np.ceil(np.linalg.norm(a[:, :2], axis=0).max() - 0.01)), 1) for a in affines]

    def read(pair):
        out = np.empty((texels, texels, 3), np.float32)
        resample(load(used[pair]), affines[pair], finer[pair], out)
        return out * gain + offset

    facts = {
        "source_rows": shape[0],
        "source_cols": shape[1],
        "centre_row": geometry.centre[0],
        "centre_col": geometry.centre[1],
        "sample_rows_pixels": geometry.sides[0] if geometry.sides else None,
        "sample_cols_pixels": geometry.sides[1] if geometry.sides else None,
        "surface_height_pixels": geometry.height,
        "camera_scale": {str(k): float(geometry.camera_scale[k]) for k in range(1, 8)},
        "outlines": geometry.outlines,
        "shear": geometry.shear,
        "patch_side_pixels": float(side),
        "registered": int(registered.sum()),
        "largest_shift_pixels": float(np.linalg.norm(shifts, axis=1).max()),
        "rms_shift_pixels": float(np.sqrt((shifts**2).sum(axis=1).mean())),
        "shifts": [[n, *q] for n, q in zip(used, shifts.tolist(), strict=True)],
        "source_clipped_pixels": sum(clipped),
    }
    return read, facts


def _largest_inside(reach, shape):
    """Largest side of a patch that stays in the frame in all views, with room for shifts."""
    low, high = 0.0, float(max(shape))
    for _ in range(40):
        middle = (low + high) / 2
        if min(reach(middle)) >= LARGEST_SHIFT / 2 * middle:
            low = middle
        else:
            high = middle
    return low


def _distinct(directions):
    """Distinct directions, in order of their first use, and the index of each."""
    _, first, index = np.unique(
        np.round(directions, 9), axis=0, return_index=True, return_inverse=True
    )
    rank = np.argsort(np.argsort(first))
    return directions[np.sort(first)], rank[index.ravel()].astype(np.int32)


def _calibration(path, archive, listing, sample_number):
    """Gain and offset (1 or 3,) from code to value, or None; and a word on where they come from."""
    for base, columns in _CALIBRATIONS.items():
        beside = path.parent / base
        if base in listing.calibrations:
            label = archive.label(listing.calibrations[base])
            data = archive.read(listing.calibrations[base], _MOST_TABLE, "a table of numbers")
        elif beside.is_file():
            label, data = str(beside), read_file(beside, _MOST_TABLE, "a table of numbers")
        else:
            continue
        if sample_number is None:
            raise InputError(
                f"{path}: {label} is there, but no name tells which of CUReT's {_SAMPLES} samples this is; name the"
                " folder sampleNN or give the sample's number."
            )
        row = _row(_table(data, label), sample_number, columns, label)
        factor = np.pi / irradiance(sample_number)
        gain, offset = row[0::2] * factor, row[1::2] * factor
        if (gain <= 0).any():
            raise InputError(
                f"{label}: the gain of sample {sample_number} is {row[0]:g}; expected > 0."
            )
        return (gain, offset), base
    return None, "none"


def _table(data, label):
    """Rows of numbers of a text file."""
    try:
        rows = [line.split() for line in data.decode("ascii").splitlines()]
        rows = [[float(x) for x in row] for row in rows if row]
    except ValueError as error:
        raise InputError(f"{label}: not a table of numbers ({error}).") from error
    if not rows or len({len(row) for row in rows}) != 1 or not np.isfinite(rows).all():
        raise InputError(f"{label}: damaged; expected rows of finite numbers, all of one length.")
    return np.array(rows)


def _row(table, sample_number, columns, label):
    """The row of a sample: by the number it begins with, if there is one, else by its place."""
    if table.shape[1] == columns + 1:
        at = np.flatnonzero(table[:, 0] == sample_number)
        rows = table[at, 1:]
    elif table.shape[1] == columns:
        rows = table[sample_number - 1 : sample_number]
    else:
        raise InputError(
            f"{label}: has {table.shape[1]} numbers a row; expected {columns}, perhaps after the sample's number."
        )
    if len(rows) != 1:
        raise InputError(f"{label}: has {len(rows)} rows for sample {sample_number}; expected one.")
    return rows[0]


def read_brdf_table(path):
    """The BRDFs of ``abrdf.dat`` or its kin: dict of sample number to (205,) values, 1/sr."""
    table = _table(read_file(path, _MOST_TABLE, "a table of numbers"), path)
    if table.shape[1] != 1 + COUNT:
        raise InputError(f"{path}: has {table.shape[1]} numbers a row; expected {1 + COUNT}.")
    return {int(row[0]): row[1:] for row in table}


def brdf_ratios(measurement, brdf):
    """How a calibrated measurement compares with published mean BRDFs.

    The published ones are means over the sample and the three channels, f = radiance / (E0 cos theta_i). A reader that is right, on
    a set whose calibration is known, has ratios near 1 throughout::

        with open_measurement("sample11.zip") as measurement:
            ratios = brdf_ratios(measurement, read_brdf_table("abrdf.dat")[11])

    Ratios that are all alike but not 1 point to the gain or E0; ratios that run with the light's angle to the cosine; ratios that
    scatter to the order of directions.

    Parameters
    ----------
    measurement : Measurement
        Rectified and calibrated.
    brdf : (205,)
        Of the sample, in order of picture number.

    Returns
    -------
    (pairs,) float64
        Mean of value / (pi cos theta_i) over the patch, over the published one.
    """
    pairs = curet205()
    both = np.hstack(
        [
            measurement.light_directions[measurement.light_index],
            measurement.view_directions[measurement.view_index],
        ]
    )
    known = np.hstack([pairs.light, pairs.view])
    number = np.argmax(both @ known.T, axis=1)
    means = [float(measurement.read(i).mean(dtype=np.float64)) for i in range(len(both))]
    return np.array(means) / (np.pi * both[:, 2]) / np.asarray(brdf, float)[number]
