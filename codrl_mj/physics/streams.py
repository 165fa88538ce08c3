"""Many NumPy generators drawn from at once, each exactly as if it were alone."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numba import types

from codrl_mj.compile_cache import external, njit

WORDS = 6
"""Numbers that hold one generator's state: PCG64's state and increment (two words each), and its spare 32 bits."""
_LOW = 2**64 - 1
_next_double = external(
    "next_double",
    ctypes.cast(np.random.PCG64(0).ctypes.next_double, ctypes.c_void_p),
    types.float64(types.uintp),
)
"""(address of a generator's state) -> the next number in [0, 1); NumPy's own."""


@njit
def _fill(addresses: np.ndarray, drawn: np.ndarray) -> None:
    """Fill rows from the generators at the given addresses."""
    for row in range(len(addresses)):
        for column in range(drawn.shape[1]):
            drawn[row, column] = _next_double(addresses[row])


class Streams:
    """N independent `numpy.random.Generator`s; stream i draws what the i-th generator alone would draw.

    The draws are NumPy's own: its `next_double` is called on each generator's state from compiled
    code.
    """

    def __init__(self, size: int) -> None:
        """Make `size` generators with seeds from the operating system."""
        self.generators = [seeding.np_random(None)[0] for _ in range(size)]
        self._bind()

    def _bind(self) -> None:
        addresses = [generator.bit_generator.ctypes.state_address for generator in self.generators]
        self._addresses = np.array(addresses, dtype=np.uintp)

    def __getstate__(self) -> dict[str, Any]:
        return {"generators": self.generators}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._bind()

    def seed(self, rows: np.ndarray, seeds: Sequence[int | None]) -> None:
        """Seed the streams `rows` (m,) as Gymnasium seeds an environment; None leaves a stream as it is."""
        for row, seed in zip(rows, seeds, strict=True):
            if seed is not None:
                self.generators[row] = seeding.np_random(seed)[0]
        self._bind()

    def random(self, rows: np.ndarray, count: int) -> np.ndarray:
        """The next `count` numbers in [0, 1) of each of the streams `rows` (m,), which are different: (m, count)."""
        drawn = np.empty((len(rows), count))
        _fill(self._addresses[rows], drawn)
        return drawn

    def state(self) -> np.ndarray:
        """Where every stream stands, shape (N, 6), uint64."""
        words = np.empty((len(self.generators), WORDS), dtype=np.uint64)
        for row, generator in zip(words, self.generators, strict=True):
            row[:] = generator_words(generator)
        return words

    def set_state(self, words: np.ndarray) -> None:
        """Continue from what `state` returned."""
        for row, generator in zip(words, self.generators, strict=True):
            set_generator_words(generator, row)


def generator_words(generator: np.random.Generator) -> np.ndarray:
    """Where a generator stands, shape (6,), uint64."""
    pcg: Any = generator.bit_generator.state
    if pcg["bit_generator"] != "PCG64":
        raise ValueError(
            f"np_random is a {pcg['bit_generator']}: must be a PCG64, as Gymnasium's reset makes it"
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
    """Let a PCG64 generator continue from what `generator_words` returned."""
    row = words.tolist()
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": row[0] << 64 | row[1], "inc": row[2] << 64 | row[3]},
        "has_uint32": row[4],
        "uinteger": row[5],
    }
