"""Which format a source has: told by looking, in one table that `ingest` and `info` share."""

import contextlib
import importlib
from collections import namedtuple
from pathlib import Path

from btfpipe.errors import InputError
from btfpipe.formats.archive import is_hidden, is_zip, names_in
from btfpipe.formats.picture_sets import is_settings
from btfpipe.sample.measurement import Measurement

# A format that can be read. `module` holds recognise(path), which gives a reason in words or None, and `opener`: a context manager that
# yields a Measurement, or a function that gives one, or a Model. `options`: the opener's arguments that a user may set.
Format = namedtuple("Format", "module opener options")

# In the order of asking: the particular before the general.
FORMATS = {
    "btf": Format("btfpipe.formats.btf", "read_btf", ("cosine",)),
    "ptm": Format("btfpipe.formats.ptm", "read_model", ("transfer",)),
    "rti": Format("btfpipe.formats.rti", "open_measurement", ("listing",)),
    "pairs": Format("btfpipe.formats.pairs", "open_measurement", ("listing", "patch_cm")),
    "utia": Format("btfpipe.formats.utia", "open_measurement", ("pairs", "directions", "colour")),
    "ubo": Format("btfpipe.formats.ubo", "open_measurement", ("pairs",)),
    "curet": Format("btfpipe.formats.curet", "open_measurement", ("sample_number",)),
    "picture": Format("btfpipe.formats.pictures", "open_measurement", ()),
}


_ENDINGS = {".btf": "btf", ".ptm": "ptm", ".rti": "ptm"}  # of single files
_LISTS = {".lp": "rti", ".csv": "pairs", ".json": "pairs"}  # endings of lists of directions

_SINGLE = ("btf", "ptm", "picture")  # formats of which a source is one file


def recognise(path):
    """The format of a file, folder or zip, and why: (str, str).

    What nothing recognises is taken for the format that its name or a list in it ends like, or else for the most general
    format of its kind, whose reader says what is wrong with it.
    """
    for name, format_ in FORMATS.items():
        reason = importlib.import_module(format_.module).recognise(path)
        if reason:
            return name, reason
    ending = Path(path).suffix.lower()
    if ending in _ENDINGS and not Path(path).is_dir():
        return _ENDINGS[ending], f"nothing else fits, and its name ends in {ending}"
    names = [name for name in names_in(path) or [Path(path).name] if not is_hidden(name)]
    for ending, format_ in _LISTS.items():
        lists = [name for name in names if name.lower().endswith(ending) and not is_settings(name)]
        if lists:
            return format_, f"nothing else fits, and {lists[0]} is there"
    general = "ubo" if Path(path).is_dir() or is_zip(path) else "picture"
    return general, "no format fits"


def open_source(path, name, **options):
    """Open a source as the named format.

    Returns
    -------
    context manager of a Measurement, or Model

    Raises
    ------
    InputError
        If a folder is to be of a format whose sources are single files; or as the format's opener.
    """
    if name in _SINGLE and Path(path).is_dir():
        raise InputError(f"{path}: a folder; format {name} expects one file. Name the file itself.")
    format_ = FORMATS[name]
    opened = getattr(importlib.import_module(format_.module), format_.opener)(path, **options)
    return contextlib.nullcontext(opened) if isinstance(opened, Measurement) else opened
