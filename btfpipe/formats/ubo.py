"""UBO2003, the layout of Bonn's measurements: one picture a pair, its angles in its name.

Names look like ``00008 tl000 pl000 tv030 pv030.jpg``: light and view, polar angle and azimuth, degrees; folders are
named after the view. Only the keyed angles count.
"""

import re

_KEYS = re.compile(r"(?<![a-z])(tl|pl|tv|pv)[ _]?(-?\d+(?:\.\d+)?)", re.IGNORECASE)


def parse_name(name):
    """Light and view angles ((theta, phi), (theta, phi)) in degrees from a base name, or None."""
    found = {key.lower(): float(value) for key, value in _KEYS.findall(name)}
    if len(found) != 4:
        return None
    return (found["tl"], found["pl"]), (found["tv"], found["pv"])


def pair_name(number, light_deg, view_deg, suffix):
    """Path of a pair inside the layout, with decimals only where the angles have them."""
    (tl, pl), (tv, pv) = ([_angle(a) for a in pair] for pair in (light_deg, view_deg))
    return f"tv{tv}_pv{pv}/{number:05d} tl{tl} pl{pl} tv{tv} pv{pv}{suffix}"


def _angle(value):
    """Three digits before the point, as many after it as needed."""
    whole, _, part = f"{value:.6f}".partition(".")
    part = part.rstrip("0")
    return f"{int(whole):03d}" + (f".{part}" if part else "")
