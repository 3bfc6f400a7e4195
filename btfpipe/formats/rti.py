"""Reflectance transformation imaging: pictures from one camera above the surface, and a list of light directions (``.lp``).

The list's first line is the number of pictures; then one line a picture, ``name x y z``, with the light's direction, x to the
right, y up the picture, z to the camera. A BTF of one view, along the normal. What is fitted to such pictures (``.ptm``,
``.rti``) is read by `ptm`.
"""

import contextlib
from pathlib import Path, PurePosixPath

import numpy as np

from btfpipe.errors import InputError
from btfpipe.formats.archive import is_hidden, open_archive
from btfpipe.formats.images import Decoder
from btfpipe.formats.picture_sets import beside, measurement_of_pictures, settings_beside
from btfpipe.formats.writing import Pictures, angles_deg, create_set

LIST = "lights.lp"
_MOST_LIST = 1 << 24  # bytes


def recognise(path):
    """Why a light list, or a folder or zip with some, is taken for RTI pictures, in words, or None.

    A first line that is a number is enough: what is wrong below it, the reader says.
    """
    try:
        source, wanted = _source(path, None)
        with open_archive(source) as archive:
            likely = {}
            for name in _lists(archive, wanted):
                with contextlib.suppress(InputError):
                    likely[name] = _lines(archive, name)[1]
    except (InputError, OSError):
        return None
    if not likely:
        return None
    if len(likely) > 1:
        return f"{len(likely)} lists of lights: {', '.join(likely)}"
    ((name, count),) = likely.items()
    return f"{name} lists {count} pictures with light directions"


@contextlib.contextmanager
def open_measurement(path, *, listing=None):
    """Open RTI pictures with their list of lights.

    Parameters
    ----------
    path : path-like
        Folder or zip that holds one list, or the list itself.
    listing : str, optional
        Which list, by its name in the folder or zip; needed where there are several.

    Yields
    ------
    Measurement
        A product of one view, along the normal, and the lights in the list's order.

    Raises
    ------
    InputError
        If there is no list, or one with wrong numbers, pictures that are not there, or a light twice.
    """
    source, wanted = _source(path, listing)
    with open_archive(source) as archive, Decoder() as decoder:
        lists = _lists(archive, wanted)
        if len(lists) != 1:
            which = " Say which with --listing." if lists else ""
            if wanted is not None:
                lists = _lists(archive, None)
                which = f" {wanted} is not there."
            raise InputError(
                f"{path}: expected one list of lights (.lp); found {', '.join(lists) or 'none'}.{which}"
            )
        names, lights = _parse(archive, lists[0])
        members = _members(archive, lists[0], names, archive.label(lists[0]))
        settings = settings_beside(archive, lists[0])
        strays = {*archive.names} - {*members, lists[0], *beside(archive, lists[0])}
        yield measurement_of_pictures(
            path,
            archive,
            decoder,
            members,
            settings,
            {"format": "RTI", "strays": sorted(strays)},
            light_directions=lights,
            view_directions=np.array([[0.0, 0.0, 1.0]]),
            light_index=np.arange(len(lights), dtype=np.int32),
            view_index=np.zeros(len(lights), np.int32),
        )


def _source(path, listing):
    path = Path(path)
    if path.suffix.lower() == ".lp" and not path.is_dir():
        return path.parent, path.name
    return path, listing


def _lists(archive, wanted):
    if wanted is not None:
        return [name for name in archive.names if name == wanted]
    return [name for name in archive.names if name.lower().endswith(".lp") and not is_hidden(name)]


def _lines(archive, name):
    """Lines (number, text) of a list that are not empty, and the number of pictures that the first of them says."""
    label = archive.label(name)
    text = archive.read(name, _MOST_LIST, "a list of lights")
    try:
        text = text.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = text.decode("latin-1")
    lines = [line.strip() for line in text.splitlines()]
    lines = [(number, line) for number, line in enumerate(lines, 1) if line]
    head = lines[0][1] if lines else ""
    if not (head.isascii() and head.isdigit() and len(head) < 10):
        raise InputError(f"{label}: begins with {head[:40]!r}; expected the number of pictures.")
    return lines, int(head)


def _parse(archive, name):
    """Names of pictures and unit vectors (n, 3) of a list."""
    label = archive.label(name)
    lines, count = _lines(archive, name)
    if count != len(lines) - 1 or len(lines) < 2:
        raise InputError(
            f"{label}: announces {count} pictures and lists {len(lines) - 1}; expected one line a picture."
        )
    names, lights = [], []
    for number, line in lines[1:]:
        words = line.rsplit(None, 3)
        try:
            light = np.array([float(word) for word in words[1:]])
        except ValueError:
            light = np.zeros(0)
        with np.errstate(over="ignore"):  # what is too long is refused below
            length = np.linalg.norm(light) if len(light) == 3 else np.nan
        if not 1e-6 < length < 1e6:
            long = (
                " of a length between 1e-6 and 1e6"
                if np.isfinite(light).all() and len(light) == 3
                else ""
            )
            raise InputError(
                f"{label}, line {number}: {line[:80]!r}; expected a name and x y z{long}."
            )
        if light[2] < 0:
            raise InputError(
                f"{label}, line {number}: the light is below the surface; expected z to the camera, positive."
            )
        names.append(words[0].strip("\"'"))
        lights.append(light / length)
    lights = np.array(lights)
    order = np.lexsort(np.round(lights, 9).T)
    same = np.flatnonzero((np.diff(np.round(lights, 9)[order], axis=0) == 0).all(axis=1))
    if len(same):
        first, second = (names[i] for i in sorted(order[same[0] : same[0] + 2]))
        raise InputError(
            f"{label}: {first!r} and {second!r} have the same light; remove one and lower the first line's number."
        )
    return names, lights


def _members(archive, listing, names, label):
    """Members that a list names: at the place it says, or else the one of that base name, as lists are moved about."""
    folder, there = PurePosixPath(listing).parent, set(archive.names)
    by_base = {}
    for member in archive.names:
        by_base.setdefault(PurePosixPath(member).name.lower(), []).append(member)
    members = []
    for name in names:
        slashed = name.replace("\\", "/")
        exact = (folder / slashed).as_posix()
        alike = by_base.get(slashed.rpartition("/")[2].lower(), [])
        if exact in there:
            members.append(exact)
        elif len(alike) == 1:
            members.append(alike[0])
        else:
            found = f"there are {len(alike)} of that name" if alike else "it is not there"
            raise InputError(f"{label}: lists the picture {name!r}, but {found}.")
    if len(set(members)) != len(members):
        twice = next(name for i, name in enumerate(members) if name in members[:i])
        raise InputError(f"{label}: lists the picture {twice!r} twice.")
    return members


def write_lp(path, appearance, suffix=".jpg", *, transfer="srgb", on_progress=None, **options):
    """Write the pictures of one view with a list of their lights.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder.
    appearance : Appearance
        The view nearest the normal is written, as seen along the normal.
    suffix : str
        ``.jpg``, ``.png`` or ``.exr``; few other readers of ``.lp`` take the last.
    transfer : str
        Curve of eight-bit pictures.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).
    **options
        precision, quality, threads; see `writing.Pictures`.

    Returns
    -------
    dict
        Facts for a summary, with the view taken (``view_deg``) and how many were left out.

    Raises
    ------
    InputError
        If it cannot be written; see `writing.Pictures`.
    """
    view = int(np.argmax(appearance.view_directions[:, 2]))
    pairs = np.flatnonzero(np.asarray(appearance.view_index) == view)
    if not len(pairs):
        raise InputError("the view nearest the normal has no pictures.")
    pictures = Pictures(appearance, suffix, transfer=transfer, pairs=pairs, **options)
    lights = appearance.light_directions[np.asarray(appearance.light_index)[pairs]]
    digits = len(str(len(pairs) - 1))
    names = [f"{i:0{digits}d}{suffix}" for i in range(len(pairs))]
    lines = [str(len(pairs))]
    lines += [
        " ".join((name, *(f"{x:.12g}" for x in light)))
        for name, light in zip(names, lights.tolist(), strict=True)
    ]
    with create_set(path, pictures.settings) as add:
        add(LIST, ("\n".join(lines) + "\n").encode())
        for name, (_, data) in zip(names, pictures.encoded(on_progress), strict=True):
            add(name, data)
    return pictures.facts | {
        "format": "RTI",
        "view_deg": angles_deg(appearance.view_directions[view : view + 1])[0],
        "views_left_out": len(appearance.view_directions) - 1,
    }
