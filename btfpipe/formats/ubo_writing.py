"""Writes UBO2003's layout, as a zip or a folder; `ubo` reads it."""

import contextlib
import json
import shutil
import zipfile
from pathlib import Path

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.formats.ubo import SETTINGS, pair_name


@contextlib.contextmanager
def create_measurement(path, settings):
    """Open a set of pictures for writing; it appears at `path` only if the block succeeds.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip`` (members stored, dated with the zip's epoch), else a folder.
    settings : dict
        For ``btfpipe.json``: white (linear value, 1 for the largest code, of a perfect white diffuser lit along the
        normal), transfer, toroidal, texels_per_mm; others are for people.

    Yields
    ------
    function
        ``put(number, light_deg, view_deg, suffix, data)`` adds one picture.

    Raises
    ------
    InputError
        If it cannot be written, or a folder of that name is there that is no such set.
    """
    path = Path(path)
    about = (json.dumps(settings, indent=2, default=store._plain) + "\n").encode()
    if path.suffix.lower() == ".zip":
        with store.whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:

            def add(name, data):
                info = zipfile.ZipInfo(name)
                info.external_attr = 0o644 << 16
                archive.writestr(info, data)

            add(SETTINGS, about)
            yield lambda number, light, view, suffix, data: add(
                pair_name(number, light, view, suffix), data
            )
        return
    if path.exists() and not (path / SETTINGS).is_file():
        raise InputError(
            f"{path}: is there and was not written by btfpipe (no {SETTINGS} in it); choose another --out."
        )
    part = path.with_name(path.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        try:
            part.mkdir()
            (part / SETTINGS).write_bytes(about)

            def put(number, light, view, suffix, data):
                target = part / pair_name(number, light, view, suffix)
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(data)

            yield put
            if path.exists():
                shutil.rmtree(path)
            part.replace(path)
        except OSError as error:
            raise InputError(store._cannot_write(path, error)) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
