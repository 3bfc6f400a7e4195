"""Writing files and folders whole or not at all.

Links are followed: what they point to is replaced, not they. Devices, pipes and the like are not replaced.

A file is written as ``NAME.btfpipe-XXXXXXXX.part`` beside its target and moved into place when complete. What a killed run
left of that name, and nothing else, goes when the target is written again.
"""

import contextlib
import fcntl
import os
import re
import secrets
import shutil
import stat
from pathlib import Path

from btfpipe.errors import InputError


@contextlib.contextmanager
def whole(path, mode="wb"):
    """Open `path` for writing; it appears only if the block succeeds.

    Parameters
    ----------
    path : path-like
        Target; an existing file is replaced at the end, not before.
    mode : str
        As for `open`; text modes are UTF-8.

    Raises
    ------
    InputError
        If the folder does not exist, cannot be written, or runs full; if something else than a file is there.
    """
    path = _target(path, stat.S_ISREG)
    part = _new_part(path)
    try:
        try:
            _remove_stale(path)
            file = part.open(mode.replace("w", "x"), encoding=None if "b" in mode else "utf-8")
        except OSError as error:
            raise InputError(_cannot_write(path, error.strerror)) from error
        try:
            with file:
                _lock(file.fileno())
                yield file
            part.replace(path)
        except OSError as error:
            if error.filename not in (None, str(part), str(path)):
                raise  # some other file's trouble, met while writing this one
            raise InputError(_cannot_write(path, error.strerror)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_folder(path):
    """As `whole`, for a folder: gives one to fill, which replaces what is at `path` only if the block succeeds.

    Raises
    ------
    InputError
        If the folder around it does not exist, cannot be written, or runs full; if something else than a folder is there.
    """
    path = _target(path, stat.S_ISDIR)
    part = _new_part(path)
    try:
        _remove_stale(path)
        part.mkdir()
        handle = os.open(part, os.O_RDONLY)
        try:
            _lock(handle)
            yield part
            if path.exists():
                shutil.rmtree(path)
            part.replace(path)
        finally:
            os.close(handle)
    except OSError as error:
        raise InputError(_cannot_write(path, error.strerror)) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _target(path, *fits):
    """Where a result called `path` goes: to the end of its links; refused if what is there `fits` by none of some tests of modes."""
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except OSError as error:
        raise InputError(_cannot_write(path, error.strerror)) from error
    if not any(fit(mode) for fit in fits):
        regular = "a file" if stat.S_ISREG(mode) else "a device, a pipe or the like"
        found = "a folder" if stat.S_ISDIR(mode) else regular
        raise InputError(_cannot_write(path, f"{found} is there"))
    return target


def _new_part(path):
    """A name beside `path` that nobody else has, to write under until it is complete."""
    return path.with_name(f"{path.name}.btfpipe-{secrets.token_hex(4)}.part")


def _lock(handle):
    """Tell other runs that an open file or folder is in work: False if one of them has told so before.

    The system forgets it when this process ends, however it ends.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # some network file systems lock nothing
    return True


def _remove_stale(path):
    """Remove what killed runs left when they wrote `path`: names that only `_new_part` gives, and in nobody's work."""
    ours = re.compile(re.escape(path.name) + r"\.btfpipe-[0-9a-f]{8}\.part")
    with contextlib.suppress(OSError):  # a folder that may be written but not listed
        for name in os.listdir(path.parent):
            if ours.fullmatch(name):
                _remove_if_stale(path.with_name(name))


def _remove_if_stale(part):
    try:
        handle = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return
    try:
        if _lock(handle):
            if stat.S_ISDIR(os.fstat(handle).st_mode):
                shutil.rmtree(part)
            else:
                part.unlink()
    except OSError:
        pass  # not for us to remove
    finally:
        os.close(handle)


def _cannot_write(path, reason):
    return f"{path}: cannot be written ({reason}); choose another --out or make room there."


def check_writable(path, folder=False):
    """Find out before the work whether `whole` could write `path`.

    Parameters
    ----------
    path : path-like
    folder : bool
        Whether a folder of that name would be replaced.

    Raises
    ------
    InputError
        With the sentence that `whole` would give after the work.
    """
    path = _target(path, stat.S_ISREG, *([stat.S_ISDIR] if folder else []))
    part = _new_part(path)
    try:
        part.open("xb").close()
        part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(_cannot_write(path, error.strerror)) from error
