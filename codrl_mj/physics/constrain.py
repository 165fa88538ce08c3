"""A task's bounds and the order of its state, compiled for one simulation; each compiled once a process.

The compiled functions take MuJoCo's `qpos` and `qvel` as pointers or as arrays, and change arrays in place.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types

from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, floats, internal, read, tuple_of
from codrl_mj.kept import njit
from codrl_mj.physics.base import LARGEST
from codrl_mj.tasks import Task

Compiled = Callable[..., Any]


def compiled_reader(task: Task) -> Compiled:
    """(qpos, qvel, state (n,)) -> nothing: fills `state`, in the task's order."""
    return _reader(task.qpos, task.qvel)


def compiled_constrain(task: Task) -> Compiled | None:
    """(qpos, qvel, scratch (n,), integration step [s]) -> nothing: the task's `constrain`, applied in place.

    None for a task without bounds. A state beyond `LARGEST` becomes NaN in all its entries, to be noticed: within its
    bounds it would look like any other.
    """
    return None if task.constrain is None else _keeper(task.constrain, task.state_names, task.qpos, task.qvel)


@functools.cache
def _reader(positions: tuple[int, ...], velocities: tuple[int, ...]) -> Compiled:
    @internal
    def read(qpos: Any, qvel: Any, state: np.ndarray) -> None:
        for entry in range(len(positions)):
            state[positions[entry]] = qpos[entry]
        for entry in range(len(velocities)):
            state[velocities[entry]] = qvel[entry]

    return read


@functools.cache
def _keeper(
    constrain: Callable[..., Any], names: tuple[str, ...], positions: tuple[int, ...], velocities: tuple[int, ...]
) -> Compiled:
    fill, entries = _reader(positions, velocities), entries_type(len(names))
    bounded = compiled_function(constrain, names, "Task.state_names", tuple_of(entries), types.float64)

    @njit(nogil=True, error_model="numpy")
    def keep(qpos: Any, qvel: Any, state: np.ndarray, timestep: float) -> None:
        fill(qpos, qvel, state)
        if not is_fine(state):
            state[:] = np.nan
        kept = floats(bounded(read(state.ctypes.data, entries), timestep))
        for entry in range(len(positions)):
            qpos[entry] = kept[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = kept[velocities[entry]]

    return keep


@internal
def is_fine(state: np.ndarray) -> bool:
    """Whether every entry of a state (n,) is a number, and at most `LARGEST`."""
    fine = True
    for entry in range(len(state)):
        fine &= abs(state[entry]) <= LARGEST
    return fine
