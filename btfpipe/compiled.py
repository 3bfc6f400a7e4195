"""How kernels are compiled, and where their code is kept."""

import contextlib
import functools
import threading

import numba

from btfpipe.code_cache import cache_folder

_FOLDER = cache_folder()
_CHANGING = threading.RLock()


def njit(function=None, **options):
    """Numba's ``njit``; with ``cache=True`` code is kept by the state of the sources (`code_cache`).

    Parameters
    ----------
    function : callable
    **options
        As numba has them.
    """
    if function is None:
        return functools.partial(njit, **options)
    if options.get("cache"):
        with _kept():
            # numba refuses to cache where its folder has become unwritable
            with contextlib.suppress(RuntimeError):
                if _FOLDER is not None:
                    return numba.njit(**options)(function)
        options = options | {"cache": False}
    return numba.njit(**options)(function)


@contextlib.contextmanager
def _kept():
    """Make numba keep what is declared inside in our folder, and nothing else."""
    with _CHANGING:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(_FOLDER or before)
        try:
            yield
        finally:
            numba.config.CACHE_DIR = before


def leaf(function=None, *, fastmath=False):
    """Compile a kernel that allocates nothing and returns no array.

    Numba counts references to every array it takes out of a tuple, slices or hands on, each time
    with an atomic instruction: in a search that compares a few dozen numbers between two such
    events this costs more than the work. A kernel that only borrows arrays needs no counts, so they
    are switched off (``_nrt``, as in numba's own sources); one that allocates all the same does not
    compile. Division by zero gives inf or nan instead of raising, as in numpy.

    Parameters
    ----------
    function : callable
    fastmath : bool or set of str
        LLVM's flags.
    """
    compile_ = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath=fastmath)
    return compile_ if function is None else compile_(function)
