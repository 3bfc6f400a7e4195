"""A plain picture: a BTF of one view and one light, both along the normal."""

import contextlib
from pathlib import Path

import numpy as np

from btfpipe.formats.images import colours, open_picture, picture_suffix
from btfpipe.sample.measurement import Measurement


def recognise(path):
    """Why a file is taken for a picture, in words, or None."""
    try:
        with Path(path).open("rb") as file:
            suffix = picture_suffix(file.read(16))
    except OSError:
        return None
    return suffix and f"begins as a picture does ({suffix[1:]})"


@contextlib.contextmanager
def open_measurement(path):
    """Open a picture file as a `Measurement` of one pair.

    Raises
    ------
    InputError
        If it is missing, empty, truncated, or not a picture.
    """
    picture = open_picture(path)
    values = colours(picture, path)
    normal = np.array([[0.0, 0.0, 1.0]])
    yield Measurement(
        source=Path(path),
        light_directions=normal,
        view_directions=normal,
        light_index=np.zeros(1, np.int32),
        view_index=np.zeros(1, np.int32),
        names=[str(path)],
        read=lambda pair: values,
        transfer=lambda picture: "linear" if picture.dtype.kind == "f" else "srgb",
        facts={"format": f"picture ({picture.suffix[1:]})"},
    )
