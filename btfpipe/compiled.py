"""How inner kernels are compiled."""

from numba import njit


def leaf(function=None, *, fastmath=False):
    """Compile a kernel that allocates nothing and returns no array.

    Numba counts references to every array it takes out of a tuple, slices or hands on, each time with an atomic
    instruction: in a search that compares a few dozen numbers between two such events this costs more than the work. A
    kernel that only borrows arrays needs no counts, so they are switched off (``_nrt``, as in numba's own sources); one that
    allocates all the same does not compile. Division by zero gives inf or nan instead of raising, as in numpy.

    Parameters
    ----------
    function : callable
    fastmath : bool or set of str
        LLVM's flags.
    """
    compile_ = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath=fastmath)
    return compile_ if function is None else compile_(function)
