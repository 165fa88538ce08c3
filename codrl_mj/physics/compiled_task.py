"""A task's functions, compiled, once a process: what it makes of its states, their bounds and their order.

There is one compiled form of observation, reward and end, and every face calls it: a library's
cosine may differ from another's in the last bit. What has to do with MuJoCo's `qpos` and `qvel`
takes them as pointers or as arrays.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.np.unsafe.ndarray import to_fixed_tuple

from codrl_mj.compile_cache import njit
from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, floats, internal, row_as, tuple_of
from codrl_mj.physics.base import MAX_STATE
from codrl_mj.tasks import Task

Compiled = Callable[..., Any]


@functools.cache
def compiled_reader(positions: tuple[int, ...], velocities: tuple[int, ...]) -> Compiled:
    """(qpos, qvel, state (n,)) -> nothing: fills `state`, in the order of a task with such `qpos` and `qvel`."""

    @internal
    def read(qpos: Any, qvel: Any, state: np.ndarray) -> None:
        for entry in range(len(positions)):
            state[positions[entry]] = qpos[entry]
        for entry in range(len(velocities)):
            state[velocities[entry]] = qvel[entry]

    return read


@functools.cache
def compiled_constrain(
    constrain: Compiled | None,
    names: tuple[str, ...],
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
) -> Compiled | None:
    """(qpos, qvel, scratch (n,), integration step [s]) -> nothing: a task's `constrain`, applied in place.

    None for a task without bounds. A state beyond `MAX_STATE` becomes NaN in all its entries, to be
    noticed: within its bounds it would look like any other.
    """
    if constrain is None:
        return None
    fill, entries = compiled_reader(positions, velocities), entries_type(len(names))
    bounded = compiled_function(
        constrain, names, "Task.state_names", tuple_of(entries), types.float64
    )

    @njit(nogil=True, error_model="numpy")
    def keep(qpos: Any, qvel: Any, state: np.ndarray, timestep: float) -> None:
        fill(qpos, qvel, state)
        if not is_finite_state(state):
            state[:] = np.nan
        kept = floats(bounded(row_as(state, entries), timestep))
        for entry in range(len(positions)):
            qpos[entry] = kept[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = kept[velocities[entry]]

    return keep


@internal
def is_finite_state(state: np.ndarray) -> bool:
    """Whether every entry of a state (n,) is a number, and at most `MAX_STATE`."""
    fine = True
    for entry in range(len(state)):
        fine &= abs(state[entry]) <= MAX_STATE
    return fine


class Outcomes(NamedTuple):
    """Compiled functions.

    States are float64 arrays (n,). Observations are float32 arrays (k,); entries beyond the task's
    own are left alone. `options` is the vector of the task's options.
    """

    observe: Compiled
    """(state, observation) -> nothing: fills the observation."""
    reward: Compiled
    """(state before, force delivered, state after, options) -> reward."""
    terminated: Compiled
    """(state) -> whether the episode ends there."""


def compiled_outcomes(task: Task) -> Outcomes:
    """The functions of a task; its own are compiled at once, ours as they are used, once a process."""
    size, several = len(task.state_names), len(task.motors) > 1
    functions = task.observation, task.reward, task.terminated
    return _compiled(*functions, task.options, size, task.observation_names, several)  # type: ignore[arg-type]


@functools.cache
def _compiled(
    observation: Callable[..., Any],
    reward: Callable[..., Any],
    terminated: Callable[..., Any],
    options_type: Any,
    size: int,
    names: tuple[str, ...],
    several: bool,
) -> Outcomes:
    compiled = njit(nogil=True, error_model="numpy")
    options_count, entries = len(options_type._fields), entries_type(size)
    state, force = tuple_of(entries), types.float64[::1] if several else types.float64
    observation_of = compiled_function(observation, names, "Task.observation_names", state)
    reward_of = compiled_function(
        reward, "", "Task.reward", state, force, state, tuple_of(options_type)
    )
    terminated_at = compiled_function(terminated, "", "Task.terminated", state)

    @compiled
    def observe(state: np.ndarray, observation: np.ndarray) -> None:
        seen = floats(observation_of(row_as(state, entries)))
        for entry in range(len(seen)):
            observation[entry] = seen[entry]

    @compiled
    def rewarded(before: np.ndarray, force: Any, after: np.ndarray, options: np.ndarray) -> float:
        options_given = options_type(*to_fixed_tuple(options, options_count))
        return float(
            reward_of(row_as(before, entries), force, row_as(after, entries), options_given)
        )

    @compiled
    def ended(state: np.ndarray) -> bool:
        return bool(terminated_at(row_as(state, entries)))

    return Outcomes(observe, rewarded, ended)
