"""Random numbers as a function of (seed, item, draw): the same for any order and number of threads."""

import numpy as np
from numba import uint64

from btfpipe.compiled import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)


@njit(cache=True, inline="always")
def mix(x):
    """One step of splitmix64 (Steele, Lea and Flood 2014): uint64 to well-mixed uint64."""
    x = uint64(x) + _GOLDEN
    x = (x ^ (x >> uint64(30))) * _M1
    x = (x ^ (x >> uint64(27))) * _M2
    return x ^ (x >> uint64(31))


@njit(cache=True, inline="always")
def uniform(seed, item, draw):
    """A float64 in [0, 1) that depends on the three integers only."""
    x = mix(uint64(seed) ^ mix(uint64(item) ^ mix(uint64(draw))))
    return (x >> uint64(11)) * (1.0 / 9007199254740992.0)
