"""Strokes: a small YAML file that says where the sample's right-hand direction should point."""

import math
from pathlib import Path

from btfpipe.description import read_description
from btfpipe.errors import InputError
from btfpipe.surface.surface import EXTENTS

_LARGEST = EXTENTS[1]  # of a coordinate; meshes reach no farther
_FORM = "strokes: [{point: [x, y, z], vector: [x, y, z]}, ...]"


def read_strokes(path):
    """Read strokes, a list of (point, vector), tuples of three floats in the mesh's frame and unit.

    Raises
    ------
    InputError
        For a file that is not YAML, an unknown or missing key (named), and anything but three finite numbers.
    """
    path = Path(path)
    thing = read_description(path, "strokes", f" Expected {_FORM}.")
    _check_keys(path, "the file", thing, {"strokes"})
    strokes = thing["strokes"]
    if not isinstance(strokes, list) or not strokes:
        raise InputError(f"{path}: strokes is not a list of at least one stroke. Expected {_FORM}.")
    return [_stroke(path, i, stroke) for i, stroke in enumerate(strokes, 1)]


def _stroke(path, i, stroke):
    _check_keys(path, f"stroke {i}", stroke, {"point", "vector"})
    for key in ("point", "vector"):
        numbers = stroke[key]
        if not (
            isinstance(numbers, list)
            and len(numbers) == 3
            and all(type(x) in (int, float) and abs(x) <= _LARGEST for x in numbers)
        ):
            raise InputError(
                f"{path}: stroke {i}: {key} is {numbers!r:.80}; expected three numbers of at most {_LARGEST:g}."
            )
    if math.hypot(*stroke["vector"]) < 1 / _LARGEST:
        raise InputError(f"{path}: stroke {i}: vector has no length; give a direction.")
    return tuple(map(float, stroke["point"])), tuple(map(float, stroke["vector"]))


def _check_keys(path, where, thing, keys):
    found = set(thing) if isinstance(thing, dict) else set()
    for key in sorted(found - keys, key=str):
        raise InputError(f"{path}: {where} has the unknown key {key!r}. Expected {_FORM}.")
    for key in sorted(keys - found):
        raise InputError(f"{path}: {where} lacks {key}. Expected {_FORM}.")
