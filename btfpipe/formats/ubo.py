"""UBO2003, the layout of Bonn's measurements: one picture a pair, its angles in its name.

Names look like ``00008 tl000 pl000 tv030 pv030.jpg``: light and view, polar angle and azimuth, degrees; folders are
named after the view. Only the keyed angles count. A set that was simulated carries ``btfpipe.json``, which says what
Bonn's sets leave open: white or scale, transfer, toroidal, texels_per_mm.
"""

import contextlib
import math
import re
from pathlib import PurePosixPath

import numpy as np

from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.formats.archive import COPY, is_hidden, names_in, open_archive
from btfpipe.formats.images import Decoder
from btfpipe.formats.picture_sets import is_settings, measurement_of_pictures, read_settings

_ENDINGS = (".jpg", ".jpeg", ".png", ".exr", ".hdr")
_KEYS = re.compile(r"(?<![a-z])(tl|pl|tv|pv)[ _=:]?(-?\d+(?:\.\d+)?)", re.IGNORECASE)


def parse_name(name):
    """Light and view angles ((theta, phi), (theta, phi)) in degrees from a base name, or None.

    Each key must occur exactly once; their order, case and what stands between them do not matter.
    """
    found = [(key.lower(), float(value)) for key, value in _KEYS.findall(name)]
    angles = dict(found)
    if len(found) != 4 or len(angles) != 4:
        return None
    return (angles["tl"], angles["pl"]), (angles["tv"], angles["pv"])


def pair_name(number, light_deg, view_deg, suffix):
    """Path of a pair inside the layout, with decimals only where the angles have them."""
    (tl, pl), (tv, pv) = ([_angle(a) for a in pair] for pair in (light_deg, view_deg))
    return f"tv{tv}_pv{pv}/{number:05d} tl{tl} pl{pl} tv{tv} pv{pv}{suffix}"


def _angle(value):
    """Three digits before the point, as many after it as needed."""
    whole, _, part = f"{value:.6f}".partition(".")
    part = part.rstrip("0")
    return f"{int(whole):03d}" + (f".{part}" if part else "")


class Listing:
    """What the names in a folder or zip say, before any picture is read.

    Attributes
    ----------
    pairs : dict
        Name of each (view, light), both (theta, phi) in degrees, in order of view, then light.
    duplicates : list of (str, str)
        Names that stand for one pair; the first is the one in `pairs`.
    strays : list of str
        Files that are no pictures of a pair.
    settings : dict
        Of a simulated set's ``btfpipe.json``.
    """

    def __init__(self, archive):
        pairs, self.duplicates, self.strays, self.settings = {}, [], [], {}
        for name in archive.names:
            base = COPY.sub("", PurePosixPath(name).name)
            angles = parse_name(base)
            if is_settings(base):
                self.settings = read_settings(archive, name)
            elif angles is None or is_hidden(name) or not base.lower().endswith(_ENDINGS):
                self.strays.append(name)
            else:
                light, view = (direction(a, archive.label(name)) for a in angles)
                if (view, light) in pairs:
                    self.duplicates.append((pairs[view, light], name))
                else:
                    pairs[view, light] = name
        self.strays += archive.others
        self.strays += [
            name
            for name in archive.folders
            if name.lower().endswith(_ENDINGS) and parse_name(PurePosixPath(name).name) is not None
        ]
        self.pairs = dict(sorted(pairs.items()))
        self.views = sorted({view for view, _ in pairs})
        self.lights = sorted({light for _, light in pairs})

    def missing(self):
        """Yield the (view, light) in degrees that a product of these views and lights lacks: many, for a list of pairs."""
        for view in self.views:
            for light in self.lights:
                if (view, light) not in self.pairs:
                    yield view, light

    def require_whole(self, path, any_pairs=False):
        """Check that there are pairs, none of them twice, which are a product of views and lights unless `any_pairs`.

        Raises
        ------
        InputError
            If not.
        """
        if not self.pairs:
            seen = (
                f"{len(self.strays)} other files, first {self.strays[0]}" if self.strays else "none"
            )
            raise InputError(
                f"{path}: holds no pictures with light and view angles in their names ({seen}); expected names such"
                " as '00008 tl000 pl000 tv030 pv030.jpg', or beside the pictures a CSV with the columns name, theta_l, phi_l, theta_v,"
                " phi_v, or an .lp list; a picture by itself is ingested by naming it."
            )
        if self.duplicates:
            first, second = self.duplicates[0]
            raise InputError(
                f"{path}: {len(self.duplicates)} pairs are there twice (first: {first!r} and {second!r});"
                " remove one of each."
            )
        whole = len(self.views) * len(self.lights)
        if len(self.pairs) < whole and not any_pairs:
            (tv, pv), (tl, pl) = next(self.missing())
            raise InputError(
                f"{path}: {whole - len(self.pairs)} of {whole} view/light pairs are missing"
                f" (first: tl{tl:g} pl{pl:g} tv{tv:g} pv{pv:g}). Add them, or pass --pairs to keep"
                f" the {len(self.pairs)} there are as a list of pairs."
            )


def direction(angles, label):
    """Angles in degrees, one way of writing each direction."""
    theta, phi = angles
    if not 0 <= theta <= 90:
        raise InputError(
            f"{label}: polar angle {theta:g} degrees; expected 0 to 90, a direction above the surface."
        )
    if not math.isfinite(phi):
        raise InputError(f"{label}: azimuth {phi:g} degrees; expected a finite number.")
    return (theta, round(phi % 360, 6) % 360 if theta > 0 else 0.0)


def recognise(path):
    """Why a folder or zip is taken for UBO2003's layout, in words, or None."""
    names = [name for name in names_in(path) if name.lower().endswith(_ENDINGS)]
    names = [name for name in names if parse_name(PurePosixPath(name).name) is not None]
    if not names:
        return None
    return (
        f"{len(names)} pictures have light and view angles in their names, such as"
        f" {PurePosixPath(names[0]).name!r}"
    )


@contextlib.contextmanager
def open_measurement(path, *, pairs=False):
    """Open a folder or zip in UBO2003's layout.

    Parameters
    ----------
    path : path-like
        Folder or zip; see `Listing` for what is read.
    pairs : bool
        Accept pairs that are not a product of views and lights.

    Yields
    ------
    Measurement

    Raises
    ------
    InputError
        If there are no pictures, a pair is missing or there twice.
    """
    with open_archive(path) as archive, Decoder() as decoder:
        listing = Listing(archive)
        listing.require_whole(path, pairs)
        lights, views, light_index, view_index = tables(listing.pairs)
        members = list(listing.pairs.values())
        # Bonn states no response curve; users of its JPEGs invert gamma 2.2
        jpeg = members[0].lower().endswith((".jpg", ".jpeg"))
        yield measurement_of_pictures(
            path,
            archive,
            decoder,
            members,
            listing.settings,
            {"format": "UBO2003", "strays": listing.strays},
            curve="gamma2.2" if jpeg else "srgb",
            light_directions=from_angles(*np.radians(np.array(lights).T)),
            view_directions=from_angles(*np.radians(np.array(views).T)),
            light_index=light_index,
            view_index=view_index,
        )


def tables(pairs):
    """Sorted lights and views (lists of (theta, phi) in degrees) of (view, light) pairs, and each pair's index in them."""
    views = sorted({view for view, _ in pairs})
    lights = sorted({light for _, light in pairs})
    view_at, light_at = ({a: i for i, a in enumerate(table)} for table in (views, lights))
    light_index = np.array([light_at[light] for _, light in pairs], np.int32)
    view_index = np.array([view_at[view] for view, _ in pairs], np.int32)
    return lights, views, light_index, view_index
