"""Threads whose number never shows in a result.

Work is cut into blocks of a fixed size, blocks go to a pool, results come back in block order.
Inside, BLAS runs on one thread: its sums change with its thread count.
"""

import collections
import contextlib
import os
from concurrent.futures import ThreadPoolExecutor


def available_threads():
    """Number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_map(function, items, threads=1, ahead=None):
    """Apply `function` to `items` on a pool and yield the results in the order of the items.

    Parameters
    ----------
    function : callable
        Must release the GIL in its heavy part, or nothing is gained.
    items : iterable
        Drawn as needed; at most `ahead` results wait at any time.
    threads : int
    ahead : int, optional
        Results in flight, by default ``2 * threads``; bounds the memory.
    """
    if threads <= 1:
        yield from map(function, items)
        return
    ahead = ahead or 2 * threads
    pending = collections.deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) >= ahead:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def blocks(total, size):
    """Slices of `size` that cover range(total); the size must not depend on the number of threads."""
    return [slice(start, min(start + size, total)) for start in range(0, total, size)]


@contextlib.contextmanager
def single_threaded_blas():
    """Run BLAS and OpenMP of the libraries inside the block on one thread."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield
