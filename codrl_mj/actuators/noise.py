"""Random numbers that are a function of their place: the same key and counter give the same number, whoever asks.

A sensor that is read inside MuJoCo's callback is read again by every `mj_forward`, in any thread
and by copies of the data. Numbers drawn from a generator would differ each time; these do not.
Plain Python on purpose: the same source runs in Python and, compiled by numba, in the callback,
because every intermediate keeps its low 64 bits either way.
"""

import math

_MASK = 0xFFFFFFFF
_EVEN, _ODD = 0xD2511F53, 0xCD9E8D57  # Philox4x32's multipliers
_STEP_0, _STEP_1 = (
    0x9E3779B9,
    0xBB67AE85,
)  # and what its key grows by: the golden ratio and sqrt(3) - 1

SENSOR_STREAM, LOAD_STREAM = 0, 1
"""The last counter word: streams of one key that share no number."""

MAX_KEY = 2**53
"""Keys are whole numbers from 0 up to, but not including, this: a float64 holds each of them exactly."""


def philox(c0: int, c1: int, c2: int, c3: int, key: int) -> tuple[int, int, int, int]:
    """Philox4x32-10: four words of 32 bits from four such and a key of 64, the low word first.

    Salmon, Moraes, Dror, Shaw: "Parallel random numbers: as easy as 1, 2, 3" (2011).
    """
    k0, k1 = key & _MASK, (key >> 32) & _MASK
    for _ in range(10):
        even, odd = _EVEN * c0, _ODD * c2
        c0, c2 = ((odd >> 32) & _MASK) ^ c1 ^ k0, ((even >> 32) & _MASK) ^ c3 ^ k1
        c1, c3 = odd & _MASK, even & _MASK
        k0, k1 = (k0 + _STEP_0) & _MASK, (k1 + _STEP_1) & _MASK
    return c0, c1, c2, c3


def uniform(high: int, low: int) -> float:
    """A number uniform in (0, 1], of 53 bits, from two words of `philox`."""
    return ((high << 21) + (low >> 11) + 1) * 2.0**-53


def standard_normal(key: float, step: int, index: int) -> float:
    """A standard normal number (Box and Muller's) of a key < `MAX_KEY`, integration step and electrical substep."""
    w0, w1, w2, w3 = philox(step & _MASK, (step >> 32) & _MASK, index, SENSOR_STREAM, int(key))
    return math.sqrt(-2.0 * math.log(uniform(w0, w1))) * math.cos(2.0 * math.pi * uniform(w2, w3))
