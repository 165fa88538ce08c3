"""Normal random numbers on arrays of JAX without 64-bit integers.

`codrl_mj.actuators.noise` multiplies words of 32 bits to products of 64 bits. Here, products are
computed from halves of words, and the result is the same but for the rounding of float32.
"""

import math
from typing import Any

# As in `codrl_mj.arrays.array_code`: array modules have no common types.
Array = Any
ArrayModule = Any

_EVEN, _ODD = 0xD2511F53, 0xCD9E8D57
_STEP_0, _STEP_1 = 0x9E3779B9, 0xBB67AE85
"""Constants of Philox, as in `codrl_mj.actuators.noise`."""


def standard_normal(module: ArrayModule, key: Array, step: Array, index: Array) -> Array:
    """Return the numbers of `codrl_mj.actuators.noise.standard_normal` in float32.

    Args:
        module: jax.numpy.
        key: whole numbers as float32. Above 2**24 float32 has not every whole number.
        step: integration step, int32.
        index: electrical substep, int32.
    """
    high_key = module.floor(key / 2.0**32)
    k0 = (key - high_key * 2.0**32).astype(module.uint32)
    k1 = high_key.astype(module.uint32)
    # The upper words of the 64-bit counters contain copies of the sign.
    c0, c1 = step.astype(module.uint32), (step >> 31).astype(module.uint32)
    c2, c3 = index.astype(module.uint32), module.zeros_like(c0)
    for _ in range(10):
        (even_high, even_low), (odd_high, odd_low) = _product(_EVEN, c0), _product(_ODD, c2)
        c0, c1, c2, c3 = odd_high ^ c1 ^ k0, odd_low, even_high ^ c3 ^ k1, even_low
        k0, k1 = k0 + module.uint32(_STEP_0), k1 + module.uint32(_STEP_1)
    angle = 2.0 * math.pi * _uniform(module, c2, c3)
    return module.sqrt(-2.0 * module.log(_uniform(module, c0, c1))) * module.cos(angle)


def _product(constant: int, word: Array) -> tuple[Array, Array]:
    """Return the high and the low word of a product of two words."""
    a_high, a_low = constant >> 16, constant & 0xFFFF
    b_high, b_low = word >> 16, word & 0xFFFF
    low = a_low * b_low
    middle = a_high * b_low + (low >> 16)
    cross = a_low * b_high + (middle & 0xFFFF)
    high = a_high * b_high + (middle >> 16) + (cross >> 16)
    return high, (cross << 16) | (low & 0xFFFF)


def _uniform(module: ArrayModule, high: Array, low: Array) -> Array:
    """Return numbers in (0, 1] from two words."""
    # A conversion rounds to 24 significant bits, so small numbers are as exact as large ones.
    words = high.astype(module.float32), low.astype(module.float32)
    return (words[0] + (words[1] + 1.0) * 2.0**-32) * 2.0**-32
