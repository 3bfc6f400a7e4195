"""Where compiled code is kept: one folder for each state of the package's sources.

Numba notices when the file of a kernel changes, and not when a helper in another file does that was
compiled into it. So code compiled from other sources lies in another folder, named by a digest of
all of them. The folder lies beside the package, in its ``__pycache__``, so that it goes with the
checkout and no other touches it; if that cannot be written, under the user's cache.
``BTFPIPE_CACHE``, or else ``NUMBA_CACHE_DIR``, names a place instead.

A process holds a shared lock on its folder until it ends. When a new folder is made, old ones that
nobody holds go: all but the last few of this copy of the package, and those of other copies in the
same place that were not used for a month.
"""

import contextlib
import hashlib
import os
import re
import shutil
import tempfile
import time
import warnings
from pathlib import Path

from btfpipe.provenance import code_digest

try:
    import fcntl
except ImportError:  # where there are no such locks, old folders go by their age alone
    fcntl = None

_PACKAGE = Path(__file__).resolve().parent
_LOCK = "held"  # a file in each folder; its time says when the folder was last used
_KEPT = 3  # folders of other states of this copy, for going back and forth between two
_MONTH = 30 * 24 * 3600
_NAMES = re.compile(r"[0-9a-f]{8}-[0-9a-f]{12}(\.old-\d+)?")


def cache_folder():
    """Make and hold the folder of compiled code for the sources as they are.

    Returns
    -------
    Path or None
        None if no place can be written, which is said in a warning.
    """
    name = f"{_copy()}-{code_digest()}"
    bases = _bases()
    for base in bases:
        with contextlib.suppress(OSError):
            folder, new = _hold(base / name)
            if new:
                _remove_old(folder)
            return folder
    warnings.warn(
        f"compiled code cannot be kept in {' or '.join(map(str, bases))}, so every run compiles"
        " anew for up to a minute;"
        " name a folder that can be written in BTFPIPE_CACHE.",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _copy():
    """Names this copy of the package among others that share a place."""
    return hashlib.sha256(os.fsencode(_PACKAGE)).hexdigest()[:8]


def _bases():
    """Places for the folder, the first that can be written to be taken."""
    for variable in ("BTFPIPE_CACHE", "NUMBA_CACHE_DIR"):
        if os.environ.get(variable):
            return [Path(os.environ[variable]).absolute()]
    bases = [_PACKAGE / "__pycache__"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        caches = os.environ.get("XDG_CACHE_HOME")
        bases.append((Path(caches) if caches else Path.home() / ".cache") / "btfpipe")
    return bases


def _hold(folder):
    """Make a folder if needed and lock it while this process lives; the folder, and whether it is new.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    while True:
        new = not folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            held = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # removed at this very moment
            continue
        if fcntl is not None:
            with contextlib.suppress(OSError):  # file systems without locks
                fcntl.flock(held, fcntl.LOCK_SH)
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(held), os.stat(folder / _LOCK)):
                break
        os.close(held)
    os.utime(folder / _LOCK)
    tempfile.TemporaryFile(dir=folder).close()
    return folder, new


def _remove_old(folder):
    """Remove what nobody needs of the folders beside a new one."""
    ages = {}
    with contextlib.suppress(OSError):
        for other in folder.parent.iterdir():
            if other != folder and _NAMES.fullmatch(other.name):
                with contextlib.suppress(OSError):
                    ages[other] = time.time() - _last_use(other)
    copy = folder.name[:8]
    own = [other for other in ages if other.name.startswith(copy) and not other.suffix]
    kept = sorted(own, key=ages.get)[:_KEPT]
    for other, age in ages.items():
        if other.suffix:  # left half removed
            shutil.rmtree(other, ignore_errors=True)
        elif other not in kept and (other in own or age > _MONTH):
            _remove(other, age)


def _last_use(folder):
    try:
        return os.stat(folder / _LOCK).st_mtime
    except FileNotFoundError:
        return os.stat(folder).st_mtime


def _remove(folder, age):
    """Remove a folder unless it is held or, where locks do not say, was used within a month."""
    with contextlib.suppress(OSError):
        held = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if _is_free(held, age):
                # out of the way first: who waits for the lock then finds that the folder is gone
                gone = folder.with_name(f"{folder.name}.old-{os.getpid()}")
                folder.rename(gone)
                shutil.rmtree(gone, ignore_errors=True)
        finally:
            os.close(held)


def _is_free(held, age):
    if fcntl is not None:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            return False
        except OSError:
            pass
    return age > _MONTH
