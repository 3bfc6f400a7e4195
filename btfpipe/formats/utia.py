"""UTIA's layout: Bonn's, with underscores, and with floating-point pictures in CIE XYZ (D65).

Names look like ``tl015_pl060_tv030_pv090.png`` below ``tv030_pv090/``. Eight-bit pictures are sRGB.

Where light and view coincide the camera would stand in the light, so the true light stood a little aside; a list of
directions that comes with a set (columns: number, Theta, Phi, ThetaS, PhiS) says where, while the names keep the nominal
angle. With that list the coincident pairs get lights of their own, and the set becomes a list of pairs, because a shifted light
exists for one view only. Without it the nominal angles are kept, the set stays a product, and `warnings` says so; but names in a set that
`write_utia` wrote say true angles.
"""

import contextlib
import re
from pathlib import PurePosixPath

import numpy as np

from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.formats import ubo
from btfpipe.formats.archive import names_in, open_archive, read_file
from btfpipe.formats.images import Decoder, colours
from btfpipe.formats.picture_sets import SETTINGS, measurement_of_pictures
from btfpipe.formats.writing import Pictures, angles_deg, create_set
from btfpipe.sample.colour import rgb_to_xyz, xyz_to_rgb

COLOURS = ("xyz", "rgb")
_NUMBER = r"-?\d+(?:\.\d+)?"
_NAME = re.compile(rf"tl{_NUMBER}_pl{_NUMBER}_tv{_NUMBER}_pv{_NUMBER}\.(png|exr)", re.IGNORECASE)
_MOST_LIST = 1 << 20  # bytes
_LAYOUT = "UTIA"  # as our own sets say it


def recognise(path):
    """Why a folder or zip is taken for UTIA's layout, in words, or None."""
    names = [PurePosixPath(name).name for name in names_in(path)]
    found = [name for name in names if _NAME.fullmatch(name)]
    if not found:
        return None
    return f"{len(found)} pictures have names in UTIA's way, such as {found[0]!r}"


def pair_name(light_deg, view_deg, suffix):
    """Path of a pair inside the layout."""
    folder, _, name = ubo.pair_name(0, light_deg, view_deg, suffix).partition("/")
    return f"{folder}/{name.partition(' ')[2].replace(' ', '_')}"


def read_shifts(path):
    """True light of each direction at which light and view coincide.

    Parameters
    ----------
    path : path-like
        Text with five columns (number, Theta, Phi, ThetaS, PhiS; degrees) between blanks, commas or semicolons. Lines that
        do not begin with a number are left out.

    Returns
    -------
    dict
        (theta, phi) to (theta, phi) of the shifted light, degrees.

    Raises
    ------
    InputError
        If it cannot be read, has no such line, a wrong one, or one direction twice.
    """
    text = read_file(path, _MOST_LIST, "a list of directions")
    shifts = {}
    for number, line in enumerate(text.decode("latin-1").splitlines(), 1):
        words = re.split(r"[\s,;]+", line.strip())
        if not re.fullmatch(r"\d+\.?0*", words[0]):
            continue
        label = f"{path}, line {number}"
        try:
            nominal = [float(word) for word in words[1:5]]
        except ValueError:
            nominal = []
        if len(nominal) != 4 or len(words) != 5 or not np.isfinite(nominal).all():
            raise InputError(
                f"{label}: {line.strip()!r}; expected five numbers (number, Theta, Phi, ThetaS, PhiS)."
            )
        at, shifted = ubo.direction(nominal[:2], label), ubo.direction(nominal[2:], label)
        if shifts.setdefault(at, shifted) != shifted:
            raise InputError(f"{label}: the direction {at[0]:g} {at[1]:g} comes twice.")
    if not shifts:
        raise InputError(
            f"{path}: holds no directions; expected lines of five numbers (number, Theta, Phi, ThetaS, PhiS)."
        )
    return shifts


@contextlib.contextmanager
def open_measurement(path, *, pairs=False, directions=None, colour=None):
    """Open a folder or zip in UTIA's layout.

    Parameters
    ----------
    path : path-like
    pairs : bool
        As for `ubo.open_measurement`.
    directions : path-like, optional
        List of directions with the shifted lights; see `read_shifts`. The result is then a list of pairs.
    colour : str, optional
        Colour space of floating-point pictures: ``xyz`` (brought to linear Rec. 709) or ``rgb``. By default what
        ``btfpipe.json`` in the set says, else ``xyz``.

    Yields
    ------
    Measurement

    Raises
    ------
    InputError
        If there are no pictures, a pair is missing or there twice, or the list of directions does not fit.
    """
    if colour not in (None, *COLOURS):
        raise InputError(f"colour {colour!r}; expected xyz or rgb.")
    with open_archive(path) as archive, Decoder() as decoder:
        listing = ubo.Listing(archive)
        listing.require_whole(path, pairs)
        settings = listing.settings
        colour = colour or settings.get("colour") or "xyz"
        if colour not in COLOURS:
            raise InputError(f"{path}: colour is {colour!r} in {SETTINGS}; expected xyz or rgb.")
        lights, views, light_index, view_index = ubo.tables(listing.pairs)
        facts = {"format": "UTIA", "strays": listing.strays}
        facts["coincident_pairs"] = sum(view == light for view, light in listing.pairs)
        if directions is not None:
            shifts = read_shifts(directions)
            lights, light_index, facts["shifted_lights"] = _shift(listing.pairs, shifts, directions)
        elif facts["coincident_pairs"] and settings.get("layout") != _LAYOUT:
            facts["warnings"] = [
                f"{facts['coincident_pairs']} pairs have their light where their view is; their true lights stood"
                " aside, as the set's list of directions says. Without it (--directions LIST) the nominal ones are kept."
            ]

        def rgb(picture, label):
            if picture.values.dtype.kind != "f":
                return colours(picture, label)
            facts["colour"] = f"floating-point pictures are taken as {colour}"
            return _to_rgb(picture, colour, label)

        yield measurement_of_pictures(
            path,
            archive,
            decoder,
            list(listing.pairs.values()),
            settings,
            facts,
            rgb=rgb,
            light_directions=from_angles(*np.radians(np.array(lights).T)),
            view_directions=from_angles(*np.radians(np.array(views).T)),
            light_index=light_index,
            view_index=view_index,
        )


def _shift(chosen, shifts, path):
    """Lights, index and count after the light of coincident pairs is moved; nominal lights come first."""
    moved = {}
    for view, light in chosen:
        if view == light:
            if light not in shifts:
                raise InputError(
                    f"{path}: has no line for the direction {light[0]:g} {light[1]:g}, where light and view of a"
                    " picture coincide; expected the list that came with the set."
                )
            if shifts[light] != light:
                moved[light] = shifts[light]
    true = [
        moved.get(light, light) if view == light else light  # only this view's light moved
        for view, light in chosen
    ]
    nominal = {light for view, light in chosen if view != light or light not in moved}
    lights = [*sorted(nominal), *sorted(set(true) - nominal)]
    at = {light: i for i, light in enumerate(lights)}
    return lights, np.array([at[light] for light in true], np.int32), len(moved)


def _to_rgb(picture, colour, label):
    """Linear Rec. 709 of a floating-point picture, in its own precision."""
    channels = [c.upper() for c in picture.channels]
    named = all(c in channels for c in "XYZ")
    if named:
        values = picture.values[..., [channels.index(c) for c in "XYZ"]]
    else:
        values = colours(picture, label)
    if colour == "rgb" and not named:
        return values
    with np.errstate(over="ignore", invalid="ignore"):  # shows in the picture
        converted = xyz_to_rgb(values)
    if values.dtype != np.float16 or not np.isfinite(values).all():
        return converted.astype(values.dtype)
    largest = float(np.abs(converted).max())
    if largest > 65504:
        raise InputError(
            f"{label}: its colours reach {largest:.3g} in Rec. 709, beyond half precision; store the set with 32-bit"
            " floats."
        )
    return converted.astype(np.float16)


def write_utia(path, appearance, suffix=".png", *, colour="xyz", on_progress=None, **options):
    """Write a Sample or Model in UTIA's layout.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder.
    appearance : Appearance
        A product or a list of pairs; names say the true angles, shifted lights included.
    suffix : str
        ``.png`` (sRGB) or ``.exr``.
    colour : str
        Of ``.exr``: ``xyz`` (CIE XYZ, D65) or ``rgb`` (linear Rec. 709).
    on_progress : callable, optional
        Called with (pictures done, pictures in all).
    **options
        precision, threads; see `writing.Pictures`.

    Returns
    -------
    dict
        Facts for a summary.

    Raises
    ------
    InputError
        If it cannot be written; see `writing.Pictures`.
    """
    if suffix not in (".png", ".exr"):
        raise InputError(f"pictures ending in {suffix!r}; UTIA's layout has .png or .exr.")
    if colour not in COLOURS:
        raise InputError(f"colour {colour!r}; expected xyz or rgb.")
    convert = rgb_to_xyz if colour == "xyz" else None
    pictures = Pictures(appearance, suffix, transfer="srgb", convert=convert, **options)
    lights = angles_deg(appearance.light_directions)
    views = angles_deg(appearance.view_directions)
    settings = pictures.settings | {"layout": _LAYOUT}
    if suffix == ".exr":
        settings["colour"] = colour
    with create_set(path, settings) as add:
        for pair, data in pictures.encoded(on_progress):
            light, view = appearance.light_index[pair], appearance.view_index[pair]
            add(pair_name(lights[light], views[view], suffix), data)
    return pictures.facts | {"format": "UTIA"}
