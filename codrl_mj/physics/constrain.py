"""Compiles a task's bounds, so that keeping them costs little next to an integration step."""

import functools
from collections.abc import Callable

import numba
import numpy as np

Constrain = Callable[[np.ndarray, float], np.ndarray]


@functools.cache
def compiled_constrain(constrain: Constrain) -> Constrain:
    """The compiled form of a `Task.constrain`; made once a process, and called for whole batches of states.

    Args:
        constrain: (states (N, n), integration step [s]) -> states inside the task's bounds.
    """
    state = numba.types.Array(numba.float64, 2, "C")
    return numba.njit(state(state, numba.float64), nogil=True, error_model="numpy")(constrain)
