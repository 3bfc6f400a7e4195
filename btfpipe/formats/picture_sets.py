"""What readers of sets share: a folder or zip with one picture a pair, and perhaps settings (``btfpipe.json``)."""

import json
from pathlib import Path, PurePosixPath

from btfpipe.errors import InputError
from btfpipe.formats.images import colours, is_mislabelled
from btfpipe.sample.measurement import Measurement
from btfpipe.sample.transfer import TRANSFERS
from btfpipe.store import check_fact

SETTINGS = "btfpipe.json"
# What settings may be called; `title` and `layout` are for readers of the file alone, the last two for one format each.
_KNOWN = (
    "white", "scale", "transfer", "toroidal", "texels_per_mm", "title", "layout", "colour", "patch_cm",
)  # fmt: skip
_MOST_SETTINGS = 1 << 20  # bytes


def measurement_of_pictures(
    path, archive, decoder, members, settings, facts, *, curve="srgb", rgb=colours, **tables
):
    """Give the pictures of a set as a `Measurement`.

    Parameters
    ----------
    path : path-like
    archive : Folder or Zip
    decoder : Decoder
    members : list of str
        Name in the archive of each pair's picture.
    settings : dict
        As in ``btfpipe.json``, checked; what they do not say stays open.
    facts : dict
        For the summary; gets ``mislabelled``, the set of members that were, and perhaps ``warnings``.
    curve : str
        Transfer curve of pictures with integers, where settings name no other; floats are linear.
    rgb : function
        ``rgb(picture, label)`` gives the three colour channels of a `Picture`.
    **tables
        Other attributes: directions, their indices, and ``correct``.
    """
    labels = [archive.label(name) for name in members]
    facts["mislabelled"] = set()
    unknown = unknown_settings(settings)
    if unknown:
        facts["warnings"] = [*facts.get("warnings", []), *unknown]

    def read(pair):
        picture = decoder.decode(archive.read(members[pair]), labels[pair])
        if is_mislabelled(members[pair], picture.suffix):
            facts["mislabelled"].add(members[pair])
        return rgb(picture, labels[pair])

    def transfer(picture):
        return "linear" if picture.dtype.kind == "f" else settings.get("transfer") or curve

    return Measurement(
        source=Path(path),
        names=labels,
        read=read,
        transfer=transfer,
        white=settings.get("white"),
        scale=settings.get("scale") or 1.0,
        toroidal=settings.get("toroidal"),
        texels_per_mm=settings.get("texels_per_mm"),
        facts=facts,
        **tables,
    )


def read_settings(archive, name):
    """Settings of a set that btfpipe wrote, checked."""
    label = archive.label(name)
    try:
        settings = json.loads(archive.read(name, _MOST_SETTINGS, "settings of a set"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{label}: not JSON ({error}).") from error
    if not isinstance(settings, dict):
        raise InputError(f"{label}: holds no mapping of settings.")
    return check_settings(settings, label)


def is_settings(name):
    """Whether a file in a folder or zip is a set's settings, in letters of either case, as other systems change them."""
    return PurePosixPath(name).name.lower() == SETTINGS


def beside(archive, member):
    """Names of the settings of a list of pictures, which are in its folder: one or none."""
    folder = PurePosixPath(member).parent
    found = (name for name in archive.names if is_settings(name))
    return [name for name in found if PurePosixPath(name).parent == folder][:1]


def settings_beside(archive, member):
    """Settings beside a list of pictures; none if there is no such file."""
    names = beside(archive, member)
    return read_settings(archive, names[0]) if names else {}


def unknown_settings(settings):
    """Warnings, as a list of sentences, of settings that nothing reads, which may be misspelt."""
    unknown = [repr(key) for key in settings if key not in _KNOWN]
    if not unknown:
        return []
    return [f"unknown settings {', '.join(unknown)} in {SETTINGS}; expected {', '.join(_KNOWN)}."]


def check_settings(settings, label):
    """Refuse wrong values of those that all sets share; `label` is what messages call their file."""
    transfer, toroidal = settings.get("transfer"), settings.get("toroidal")
    for key in ("white", "scale", "texels_per_mm"):
        if settings.get(key) is not None:
            check_fact(settings[key], "positive", f"{label}: {key}")
    if transfer is not None and transfer not in TRANSFERS:
        raise InputError(
            f"{label}: transfer is {transfer!r}; expected one of {', '.join(TRANSFERS)}."
        )
    if toroidal is not None and not isinstance(toroidal, bool):
        raise InputError(f"{label}: toroidal is {toroidal!r}; expected true or false.")
    return settings
