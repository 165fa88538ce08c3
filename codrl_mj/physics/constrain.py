"""A task's bounds and the order of its state, compiled for one simulation; each compiled once a process.

The compiled functions take MuJoCo's `qpos` and `qvel` as pointers or as arrays, and change arrays in place.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types

from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, f64, floats, internal, read, tuple_of
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

    Raises:
        ValueError: `constrain` is not what numba compiles.
    """
    return None if task.constrain is None else _keeper(task.constrain, task.state_names, task.qpos, task.qvel)


class BatchKernels(NamedTuple):
    """Compiled functions of the rows of a batch; `qpos` is (N, nq), `qvel` (N, nv), and `moved` like `qpos`."""

    read: Compiled
    """(qpos, qvel, states (N, n)) -> nothing: fills `states`, in the task's order."""
    move: Compiled
    """(qpos, qvel, moved, integration step [s]) -> nothing: fills `moved`, where the present velocities lead."""
    correct: Compiled
    """(qpos, qvel, moved, integration step [s]) -> nothing: what follows a step of the engine. With explicit
    integration the positions become `moved`; bounds are kept."""


def compiled_batch(task: Task, explicit: bool) -> BatchKernels:
    """The functions for a task, with positions moved by the old velocity if `explicit`; compiled as they are used."""
    return _batch(compiled_reader(task), compiled_constrain(task), len(task.state_names), explicit)


@functools.cache
def _batch(read: Compiled, keep: Compiled | None, size: int, explicit: bool) -> BatchKernels:
    bounded, constrain = keep is not None, keep or _nothing

    @numba.njit(nogil=True, error_model="numpy")
    def read_all(qpos: np.ndarray, qvel: np.ndarray, states: np.ndarray) -> None:
        for row in range(len(qpos)):
            read(place(qpos, row), place(qvel, row), place(states, row))

    @numba.njit(nogil=True, error_model="numpy")
    def move(qpos: np.ndarray, qvel: np.ndarray, moved: np.ndarray, timestep: float) -> None:
        for row in range(len(qpos)):
            for entry in range(qpos.shape[1]):
                moved[row, entry] = qpos[row, entry] + timestep * qvel[row, entry]

    @numba.njit(nogil=True, error_model="numpy")
    def correct(qpos: np.ndarray, qvel: np.ndarray, moved: np.ndarray, timestep: float) -> None:
        state = np.empty(size)
        for row in range(len(qpos)):
            if explicit:
                for entry in range(qpos.shape[1]):
                    qpos[row, entry] = moved[row, entry]
            if bounded:
                constrain(place(qpos, row), place(qvel, row), state, timestep)

    return BatchKernels(read_all, move, correct)


@internal
def place(array: np.ndarray, row: int) -> Any:
    """Pointer to a row's entries, which are neighbours: a view costs several times what is done with it."""
    return f64(array.ctypes.data + row * array.strides[0])


@internal
def _nothing(qpos: Any, qvel: Any, state: np.ndarray, timestep: float) -> None:
    """Take the place of bounds where there are none."""


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

    @numba.njit(nogil=True, error_model="numpy")
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
