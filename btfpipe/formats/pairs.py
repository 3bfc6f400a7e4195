"""Pictures of any names beside a list of their directions, as CSV or JSON: the layout for home-made and sparse captures.

The list has a row a picture: ``name``, relative to the list, and one of three sets of columns (`COLUMNS`): angles in degrees;
vectors to the light and to the eye; or positions of lamp and camera in cm, from the middle of the patch with x to the right, y
up the picture and z along the normal. Other columns are left alone. CSV is comma-, semicolon- or tab-separated with a header;
JSON is a list of objects, or an object with that list as ``pairs``. Settings (white or scale, transfer, toroidal,
texels_per_mm, patch_cm) stand in that object, or in ``btfpipe.json`` beside the list.

From positions the pictures, which must be frontal ones of the patch alone, are brought to one distant light a pair, the one in
the direction of the lamp from the patch's middle: see `correction`. Views are the camera's direction from there. How
far true directions stray from these over the patch is reported.
"""

import contextlib
import csv
import io
import json
import math
from collections import namedtuple
from pathlib import Path, PurePosixPath

import numpy as np

from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.formats import ubo
from btfpipe.formats.archive import is_hidden, is_zip, open_archive
from btfpipe.formats.images import Decoder
from btfpipe.formats.picture_sets import (
    SETTINGS,
    beside,
    check_settings,
    is_settings,
    measurement_of_pictures,
    settings_beside,
)
from btfpipe.formats.writing import Pictures, create_set

COLUMNS = {
    "angles": ("theta_l", "phi_l", "theta_v", "phi_v"),
    "vectors": ("lx", "ly", "lz", "vx", "vy", "vz"),
    "positions": ("lamp_x", "lamp_y", "lamp_z", "camera_x", "camera_y", "camera_z"),
}
LIST = "directions.csv"
_ENDINGS = (".csv", ".json")
_MOST_LIST = 1 << 24  # bytes
_MOST_SPREAD_DEG = 30  # over the patch, as far as directions of measured sets lie apart

# A list by its columns: member, which of COLUMNS it has, rows (where in the file, dict), settings.
_Table = namedtuple("_Table", "member kind rows settings")
# A list as read: member, which of COLUMNS it has, names of pictures, numbers (pairs, 4 or 6), settings.
_List = namedtuple("_List", "member kind names numbers settings")


def recognise(path):
    """Why a list, or a folder or zip with some, is taken for pictures with directions, in words, or None.

    Columns are enough: what is wrong below them, the reader says.
    """
    try:
        source, wanted = _source(path, None)
        if not (source.is_dir() or is_zip(source)):
            return None
        with open_archive(source) as archive:
            found, _ = _find(archive, wanted)
    except (InputError, OSError):
        return None
    if not found:
        return None
    if len(found) > 1:
        return (
            f"{len(found)} lists of pictures with directions: {', '.join(t.member for t in found)}"
        )
    return f"{found[0].member} lists {len(found[0].rows)} pictures with {found[0].kind}"


@contextlib.contextmanager
def open_measurement(path, *, listing=None, patch_cm=None):
    """Open pictures with a list of their directions.

    Parameters
    ----------
    path : path-like
        Folder or zip that holds one such list, or the list itself.
    listing : str, optional
        Which list, by its name in the folder or zip; needed where there are several.
    patch_cm : (float, float), optional
        Height and width of the patch that the pictures show; needed with positions, unless settings say it.

    Yields
    ------
    Measurement
        A product of views and lights in its order, if the pairs are one; else the pairs in the list's order.

    Raises
    ------
    InputError
        If there is no list, or one with wrong numbers, pictures that are not there, or a pair twice.
    """
    source, wanted = _source(path, listing)
    with open_archive(source) as archive, Decoder() as decoder:
        found, refused = _find(archive, wanted)
        if len(found) != 1:
            several = ", ".join(f.member for f in found) or "none"
            more = " Say which with --listing." if found else " ".join(["", *map(str, refused[:1])])
            raise InputError(
                f"{path}: expected one .csv or .json that lists names of pictures and their directions; found"
                f" {several}.{more}"
            )
        label = archive.label(found[0].member)
        listed = _read_list(found[0], label)
        settings = _settings(archive, listed, label)
        members = _members(archive, listed, label)
        lights, views = _directions(listed, label)
        facts = {
            "format": f"pairs ({listed.kind})",
            "strays": sorted(
                {*archive.names} - {*members, listed.member, *beside(archive, listed.member)}
            ),
        }
        lamps = None
        if listed.kind == "positions":
            patch_cm = patch_cm or settings.get("patch_cm")
            lamps, cameras = listed.numbers[:, :3], listed.numbers[:, 3:]
            if patch_cm is None:
                raise InputError(
                    f"{label}: positions need the patch's height and width in cm: give --patch-cm, or patch_cm in"
                    f" {SETTINGS}."
                )
            reference = float(np.median(np.linalg.norm(lamps, axis=1)))
            facts |= _spread(lamps, cameras, patch_cm, reference)
            warnings = [
                f"{name} directions differ by up to {facts[f'{name}_spread_deg']:.0f} degrees between the patch's middle and its"
                f" corners; expected at most {_MOST_SPREAD_DEG}. Check positions and --patch-cm, both in cm."
                for name in ("light", "view")
                if facts[f"{name}_spread_deg"] > _MOST_SPREAD_DEG
            ]
            if warnings:
                facts["warnings"] = warnings
        order, tables = _arrange(lights, views, listed.names, label)
        members = [members[i] for i in order]

        def correct(pair, picture):
            lamp = lamps[order[pair]]
            return picture * correction(picture.shape[:2], patch_cm, lamp, reference)[..., None]

        yield measurement_of_pictures(
            path,
            archive,
            decoder,
            members,
            settings,
            facts,
            correct=correct if lamps is not None else None,
            **tables,
        )


def correction(shape, patch_cm, lamp, reference):
    """What to multiply a linear picture by, so that a near lamp lights it like a distant one.

    A small lamp lights the texel at distance d from it with an irradiance of ``cos / d^2 = z / d^3``. The factor brings
    each texel to the irradiance of the patch's middle, cosine included (d / d_0)^3, and that to the `reference` distance,
    (d_0 / reference)^2, so that all pairs share one light.

    Parameters
    ----------
    shape : (int, int)
        Rows and cols of the picture.
    patch_cm : (float, float)
        Height and width that it shows.
    lamp : (3,)
        Position in cm.
    reference : float
        Distance in cm.

    Returns
    -------
    (rows, cols) float32
    """
    rows, cols = shape
    y = (0.5 - (np.arange(rows) + 0.5) / rows) * patch_cm[0]
    x = ((np.arange(cols) + 0.5) / cols - 0.5) * patch_cm[1]
    square = (lamp[0] - x) ** 2 + (lamp[1] - y[:, None]) ** 2 + lamp[2] ** 2
    middle = float(np.dot(lamp, lamp))
    return ((square / middle) ** 1.5 * (middle / reference**2)).astype(np.float32)


def _spread(lamps, cameras, patch_cm, reference):
    """How far directions stray from those of the patch's middle, and how much is corrected."""
    height, width = patch_cm
    corners = np.array([[x * width / 2, y * height / 2, 0] for x in (-1, 1) for y in (-1, 1)])
    facts = {}
    for name, positions in (("light", lamps), ("view", cameras)):
        to = positions[:, None] - corners
        cosine = np.einsum("pcd,pd->pc", to, positions)
        cosine /= np.linalg.norm(to, axis=2) * np.linalg.norm(positions, axis=1)[:, None]
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).max(axis=1)
        facts[f"{name}_spread_deg"] = float(angle.max())
        facts[f"median_{name}_spread_deg"] = float(np.median(angle))
    distance = np.linalg.norm(lamps, axis=1)
    # a corner is the farthest from a lamp; the nearest may lie between
    nearest = np.clip(lamps * [1, 1, 0], corners.min(axis=0), corners.max(axis=0))
    places = np.concatenate(
        [np.broadcast_to(corners, (len(lamps), 4, 3)), nearest[:, None]], axis=1
    )
    across = (np.linalg.norm(lamps[:, None] - places, axis=2) / distance[:, None]) ** 3
    facts |= {
        "patch_cm": (float(height), float(width)),
        "lamp_distance_cm": (float(distance.min()), float(distance.max())),
        "reference_distance_cm": reference,
        "correction_over_patch": (float(across.min()), float(across.max())),
    }
    return facts


def _source(path, listing):
    """Folder or zip to open, and the name of the list in it, if known."""
    path = Path(path)
    if path.suffix.lower() in _ENDINGS and not path.is_dir():
        return path.parent, path.name
    return path, listing


def _find(archive, wanted):
    """Lists in an archive, by their columns, and errors of what ends like one; the `wanted` one must be a list."""
    if wanted is not None and wanted not in archive.names:
        there = [name for name in archive.names if _may_be_list(name)]
        raise InputError(
            f"{archive.path}: holds no {wanted}; of .csv and .json it has {', '.join(there) or 'none'}."
        )
    if wanted is not None:
        return [_read_table(archive, wanted)], []
    found, refused = [], []
    for name in archive.names:
        if _may_be_list(name):
            try:
                found.append(_read_table(archive, name))
            except InputError as error:
                refused.append(error)
    return found, refused


def _may_be_list(name):
    likely = name.lower().endswith(_ENDINGS) and not is_settings(name)
    return likely and not is_hidden(name)


def _read_table(archive, name):
    """A list, its rows not looked at yet."""
    label = archive.label(name)
    data = archive.read(name, _MOST_LIST, "a list of pictures")
    try:
        read = _json if name.lower().endswith(".json") else _csv
        header, rows, settings = read(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{label}: not a list of pictures: its text is not UTF-8.") from error
    except (ValueError, csv.Error, RecursionError) as error:
        raise InputError(f"{label}: not a list of pictures ({error}).") from error
    kind = next((k for k, c in COLUMNS.items() if {"name", *c} <= header), None)
    if kind is None:
        columns = "; ".join(", ".join(c) for c in COLUMNS.values())
        seen = _shown(", ".join(sorted(header - {""}))) if header - {""} else "none"
        raise InputError(
            f"{label}: not a list of pictures; expected the columns name and one of: {columns}. Found {seen}."
        )
    return _Table(name, kind, rows, settings)


def _read_list(table, label):
    """The list that a table is, every number looked at; `label` is what messages call its file."""
    if not table.rows:
        raise InputError(f"{label}: lists no pictures; expected a row a picture.")
    names, numbers = [], []
    for where, row in table.rows:
        picture = row.get("name")
        if not isinstance(picture, str) or not picture.strip():
            raise InputError(f"{label}, {where}: has no name of a picture ({picture!r}).")
        values = [_number(row.get(c)) for c in COLUMNS[table.kind]]
        if not np.isfinite(values).all():
            wrong = COLUMNS[table.kind][int(np.argmin(np.isfinite(values)))]
            raise InputError(
                f"{label}, {where} ({picture!r}): {wrong} is {_shown(row.get(wrong))}; expected a number for each of"
                f" {', '.join(COLUMNS[table.kind])}."
            )
        names.append(picture.strip())
        numbers.append(values)
    return _List(table.member, table.kind, names, np.array(numbers), table.settings)


def _shown(value):
    """A cell in a message, cut short."""
    if value is None or value == "":
        return "missing"
    shown = repr(value)
    return shown if len(shown) <= 40 else shown[:40] + "..."


def _csv(text):
    """Columns of a CSV, in lower case; rows (where, dict); and settings, of which there are none."""
    before = len(text) - len(text.lstrip())
    text, above = text[before:], text[:before].count("\n")
    head = text.partition("\n")[0]
    delimiter = next((d for d in ",;\t" if d in head), ",")
    lines = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
    header = [cell.strip().lower() for cell in next(lines, [])]
    if len(set(header)) != len(header):
        raise ValueError(f"line 1 is {_shown(head)}, where a column comes twice; expected a header")
    rows = []
    for cells in lines:
        if any(cells):
            cells += [""] * (len(header) - len(cells))
            row = dict(zip(header, cells, strict=False))
            rows.append((f"line {above + lines.line_num}", row))
    return set(header), rows, {}


def _json(text):
    """Columns, rows (where, dict) and settings of a JSON list."""
    whole = json.loads(text)
    rows = whole.get("pairs") if isinstance(whole, dict) else whole
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("expected a list of objects, or an object with that as 'pairs'")
    settings = {k: v for k, v in whole.items() if k != "pairs"} if isinstance(whole, dict) else {}
    rows = [{key.lower(): value for key, value in row.items()} for row in rows]
    return set().union(*rows), [(f"picture {i}", row) for i, row in enumerate(rows, 1)], settings


def _number(value):
    """A number from a cell, NaN if it is none."""
    try:
        return float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _settings(archive, listed, label):
    """Settings from the list and from ``btfpipe.json`` beside it; the list's go first."""
    settings = settings_beside(archive, listed.member)
    settings |= check_settings(listed.settings, label)
    size = settings.get("patch_cm")
    if size is not None:
        good = isinstance(size, list) and len(size) == 2 and all(0 < _number(s) < 1e6 for s in size)
        if not good:
            raise InputError(
                f"{label}: patch_cm is {size!r}; expected the patch's height and width in cm."
            )
        settings["patch_cm"] = [float(s) for s in size]
    return settings


def _members(archive, listed, label):
    """Members of the archive that the list names."""
    folder, there = PurePosixPath(listed.member).parent, set(archive.names)
    members = [(folder / name.replace("\\", "/")).as_posix() for name in listed.names]
    lost = [name for name, member in zip(listed.names, members, strict=True) if member not in there]
    if lost:
        raise InputError(
            f"{label}: {len(lost)} of {len(members)} pictures are not there (first: {lost[0]!r}); names are relative"
            " to the list."
        )
    if len(set(members)) != len(members):
        twice = next(name for i, name in enumerate(members) if name in members[:i])
        raise InputError(f"{label}: lists {twice!r} twice.")
    return members


def _directions(listed, label):
    """Unit vectors (pairs, 3) to light and eye."""
    numbers = listed.numbers
    if listed.kind == "angles":
        angles = [[ubo.direction(row[i : i + 2], label) for row in numbers] for i in (0, 2)]
        return [from_angles(*np.radians(a).T) for a in angles]
    vectors = []
    for what, part in (("light", numbers[:, :3]), ("view", numbers[:, 3:])):
        with np.errstate(over="ignore"):  # what is too long is refused below
            length = np.linalg.norm(part, axis=1)
        bad = np.flatnonzero(~((length > 1e-9) & (length < 1e12) & (part[:, 2] >= 0)))
        if listed.kind == "positions":
            bad = np.union1d(bad, np.flatnonzero(part[:, 2] <= 0))
        if len(bad):
            raise InputError(
                f"{label}: the {what} of {listed.names[bad[0]]!r} is at {part[bad[0]].tolist()}; expected one above"
                " the surface (z positive)."
            )
        vectors.append(part / length[:, None])
    return vectors


def _arrange(lights, views, names, label):
    """Order of the pairs, and the tables of a `Measurement`: directions once each, as they come first."""
    tables, index = [], []
    for directions in (lights, views):
        at, table, where = {}, [], []
        for direction in directions:
            key = tuple(np.round(direction, 9) + 0.0)
            if key not in at:
                at[key] = len(table)
                table.append(direction)
            where.append(at[key])
        tables.append(np.array(table))
        index.append(np.array(where, np.int32))
    number = index[1].astype(np.int64) * len(tables[0]) + index[0]
    order = np.argsort(number, kind="stable")
    same = np.flatnonzero(np.diff(number[order]) == 0)
    if len(same):
        first, second = (names[i] for i in order[same[0] : same[0] + 2])
        raise InputError(
            f"{label}: {len(same)} pairs are there twice (first: {first!r} and {second!r}); remove one of each."
        )
    if len(number) != len(tables[0]) * len(tables[1]):
        order = np.arange(len(number))
    return order, {
        "light_directions": tables[0],
        "view_directions": tables[1],
        "light_index": index[0][order],
        "view_index": index[1][order],
    }


def write_pairs(path, appearance, suffix=".exr", *, on_progress=None, **options):
    """Write pictures with a CSV of their directions.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder.
    appearance : Appearance
        A product or a list of pairs.
    suffix : str
        ``.exr``, ``.png`` or ``.jpg``.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).
    **options
        transfer, precision, quality, threads; see `writing.Pictures`.

    Returns
    -------
    dict
        Facts for a summary.

    Raises
    ------
    InputError
        If it cannot be written; see `writing.Pictures`.
    """
    pictures = Pictures(appearance, suffix, **options)
    lights = appearance.light_directions[appearance.light_index]
    views = appearance.view_directions[appearance.view_index]
    digits = len(str(appearance.n_pairs - 1))
    names = [f"{pair:0{digits}d}{suffix}" for pair in range(appearance.n_pairs)]
    text = ",".join(("name", *COLUMNS["vectors"])) + "\n"
    for name, light, view in zip(names, lights, views, strict=True):
        text += ",".join((name, *(repr(float(x)) for x in (*light, *view)))) + "\n"
    with create_set(path, pictures.settings) as add:
        add(LIST, text.encode())
        for pair, data in pictures.encoded(on_progress):
            add(names[pair], data)
    return pictures.facts | {"format": "pairs"}
