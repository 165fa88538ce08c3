"""Batch of NumPy generators that gives the same numbers as drawing from them one by one."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numba import types

from codrl_mj.boundary import PickledState
from codrl_mj.compile_cache import external_function, njit

WORDS = 6
"""Length of a generator's state: state and increment of PCG64 (two words each), and the flag and
value of its spare 32 bits.
"""
_LOW = 2**64 - 1
_next_double = external_function(
    "next_double",
    ctypes.cast(np.random.PCG64(0).ctypes.next_double, ctypes.c_void_p),
    types.float64(types.uintp),
)
"""(address of a generator's state) -> the next number in [0, 1), by NumPy's own function."""


@njit
def _fill(addresses: np.ndarray, drawn: np.ndarray) -> None:
    """Fill rows with numbers from the generators at these addresses."""
    for row in range(len(addresses)):
        for column in range(drawn.shape[1]):
            drawn[row, column] = _next_double(addresses[row])


class Streams:
    """N independent `numpy.random.Generator`s that are drawn from at once.

    Stream i gives the same numbers as the i-th generator would alone: compiled code calls NumPy's
    own `next_double` on each generator's state.
    """

    def __init__(self, size: int) -> None:
        """Create `size` generators with seeds from the operating system."""
        self.generators = [seeding.np_random(None)[0] for _ in range(size)]
        self._bind()

    def _bind(self) -> None:
        addresses = [generator.bit_generator.ctypes.state_address for generator in self.generators]
        # Copies and seeds replace the generators, so their addresses are read again.
        self._addresses = np.array(addresses, dtype=np.uintp)

    def __getstate__(self) -> PickledState:
        return {"generators": self.generators}

    def __setstate__(self, state: PickledState) -> None:
        self.__dict__.update(state)
        self._bind()

    def seed(self, rows: np.ndarray, seeds: Sequence[int | None]) -> None:
        """Seed the streams `rows` (m,) like Gymnasium; None leaves a stream unchanged."""
        for row, seed in zip(rows, seeds, strict=True):
            if seed is not None:
                self.generators[row] = seeding.np_random(seed)[0]
        self._bind()

    def random(self, rows: np.ndarray, count: int) -> np.ndarray:
        """Return the next numbers in [0, 1) of the streams `rows` (m,), shape (m, count).

        The rows must be different.
        """
        drawn = np.empty((len(rows), count))
        _fill(self._addresses[rows], drawn)
        return drawn

    def state(self) -> np.ndarray:
        """Return the states of all streams, shape (N, 6), uint64."""
        words = np.empty((len(self.generators), WORDS), dtype=np.uint64)
        for row, generator in zip(words, self.generators, strict=True):
            row[:] = generator_words(generator)
        return words

    def set_state(self, words: np.ndarray) -> None:
        """Continue from the result of `state`."""
        for row, generator in zip(words, self.generators, strict=True):
            set_generator_words(generator, row)


def generator_words(generator: np.random.Generator) -> np.ndarray:
    """Return the state of a generator, shape (6,), uint64."""
    # A mapping of names to numbers, words and mappings.
    pcg: Any = generator.bit_generator.state
    if pcg["bit_generator"] != "PCG64":
        raise ValueError(
            f"np_random is a {pcg['bit_generator']}: must be a PCG64, as Gymnasium's reset creates"
        )
    state, increment = pcg["state"]["state"], pcg["state"]["inc"]
    words = [
        state >> 64,
        state & _LOW,
        increment >> 64,
        increment & _LOW,
        pcg["has_uint32"],
        pcg["uinteger"],
    ]
    return np.array(words, dtype=np.uint64)


def set_generator_words(generator: np.random.Generator, words: np.ndarray) -> None:
    """Set the state of a PCG64 generator to a result of `generator_words`."""
    row = words.tolist()
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": row[0] << 64 | row[1], "inc": row[2] << 64 | row[3]},
        "has_uint32": row[4],
        "uinteger": row[5],
    }
