"""Counter-based random numbers: the same key and counter always give the same number.

A sensor that is read inside MuJoCo's callback is read again by every `mj_forward`, in any thread
and by copies of the data. Numbers drawn from a generator would differ each time; these do not. The
functions are plain Python on purpose: the same source runs in Python and, compiled by numba, in the
callback, because every intermediate result is reduced to its low 64 bits in both cases.
"""

import math

# Multipliers of Philox4x32.
_MASK = 0xFFFFFFFF
_EVEN, _ODD = 0xD2511F53, 0xCD9E8D57
# Increments of the key in each round: the golden ratio and sqrt(3) - 1.
_STEP_0 = 0x9E3779B9
_STEP_1 = 0xBB67AE85

SENSOR_STREAM, LOAD_STREAM = 0, 1
"""Values of the last counter word. Streams with the same key share no numbers."""

MAX_KEY = 2**53
"""Exclusive upper bound of the keys, which are whole numbers >= 0: a float64 holds each of them
exactly.
"""


def philox(c0: int, c1: int, c2: int, c3: int, key: int) -> tuple[int, int, int, int]:
    """Compute Philox4x32-10: four 32-bit words from a counter of four words and a 64-bit key.

    Words come with the low one first. Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers:
    as easy as 1, 2, 3" (2011).
    """
    k0, k1 = key & _MASK, (key >> 32) & _MASK
    for _ in range(10):
        even, odd = _EVEN * c0, _ODD * c2
        c0, c2 = ((odd >> 32) & _MASK) ^ c1 ^ k0, ((even >> 32) & _MASK) ^ c3 ^ k1
        c1, c3 = odd & _MASK, even & _MASK
        k0, k1 = (k0 + _STEP_0) & _MASK, (k1 + _STEP_1) & _MASK
    return c0, c1, c2, c3


def uniform(high: int, low: int) -> float:
    """Return a number uniform in (0, 1], with 53 bits, from two words of `philox`."""
    # The added 1 excludes 0, of which a logarithm is taken.
    return ((high << 21) + (low >> 11) + 1) * 2.0**-53


def standard_normal(key: float, step: int, index: int) -> float:
    """Return a standard normal number for a key, an integration step and an electrical substep.

    The method is Box and Muller's. Keys must be below `MAX_KEY`.
    """
    w0, w1, w2, w3 = philox(step & _MASK, (step >> 32) & _MASK, index, SENSOR_STREAM, int(key))
    return math.sqrt(-2.0 * math.log(uniform(w0, w1))) * math.cos(2.0 * math.pi * uniform(w2, w3))
