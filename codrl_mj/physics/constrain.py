"""Compiles a task's bounds, so that keeping them costs little next to an integration step."""

import functools
from collections.abc import Callable

import numba
import numpy as np

from codrl_mj.physics.base import LARGEST
from codrl_mj.tasks import Task

Keep = Callable[[np.ndarray, np.ndarray, float], None]


def compiled_constrain(task: Task) -> Keep | None:
    """The compiled form of the task's `constrain`, applied in place to MuJoCo's arrays; compiled once a process.

    Args:
        task: the task.

    Returns:
        (qpos (N, nq), qvel (N, nv), integration step [s]) -> nothing; None for a task without bounds. A state beyond
        `LARGEST` becomes NaN in all its entries, to be noticed: within its bounds it would look like any other.
    """
    return None if task.constrain is None else _compiled(task.constrain, task.qpos, task.qvel)


@functools.cache
def _compiled(
    constrain: Callable[[np.ndarray, float], np.ndarray], positions: tuple[int, ...], velocities: tuple[int, ...]
) -> Keep:
    bounded = numba.njit(nogil=True, error_model="numpy")(constrain)
    array = numba.types.Array(numba.float64, 2, "A")  # a batch's are views of its state rows

    @numba.njit(numba.void(array, array, numba.float64), nogil=True, error_model="numpy")
    def keep(qpos: np.ndarray, qvel: np.ndarray, timestep: float) -> None:
        state = np.empty((len(qpos), len(positions) + len(velocities)))
        for row in range(len(qpos)):  # scalar loops: numba compiles them several times faster than slices
            for entry in range(len(positions)):
                state[row, positions[entry]] = qpos[row, entry]
            for entry in range(len(velocities)):
                state[row, velocities[entry]] = qvel[row, entry]
            lost = False
            for entry in range(state.shape[1]):
                lost |= not abs(state[row, entry]) <= LARGEST
            if lost:
                state[row] = np.nan
        state = bounded(state, timestep)
        for row in range(len(qpos)):
            for entry in range(len(positions)):
                qpos[row, entry] = state[row, positions[entry]]
            for entry in range(len(velocities)):
                qvel[row, entry] = state[row, velocities[entry]]

    return keep
