"""Compiled functions of a task: outcomes, bounds, and the conversion of MuJoCo's state.

All environments call the same compiled observation, reward and termination, because the cosines of
two libraries may differ in the last bit. `qpos` and `qvel` may be pointers or arrays.
"""

import functools
from typing import NamedTuple

import numpy as np
from numba import types
from numba.np.unsafe.ndarray import to_fixed_tuple

from codrl_mj.compile_cache import njit
from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, internal, named_tuple_type, read_row, to_floats
from codrl_mj.physics.base import MAX_STATE, Compiled, Force, NumbaTuple
from codrl_mj.tasks import Task


@functools.cache
def compiled_reader(positions: tuple[int, ...], velocities: tuple[int, ...]) -> Compiled:
    """Return a function (qpos, qvel, state (n,)) -> None that fills `state` in the task's order."""

    @internal
    def read(qpos: NumbaTuple, qvel: NumbaTuple, state: np.ndarray) -> None:
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
    """Return a function (qpos, qvel, scratch (n,), timestep [s]) -> None that applies `constrain`.

    It changes `qpos` and `qvel` in place. The result is None for a task without bounds. If an entry
    of the state exceeds `MAX_STATE`, all entries become NaN, because the bounds would otherwise
    make a diverged state look valid.
    """
    if constrain is None:
        return None
    fill, entries = compiled_reader(positions, velocities), entries_type(len(names))
    constrain_state = compiled_function(
        constrain, names, "Task.state_names", named_tuple_type(entries), types.float64
    )

    @njit(nogil=True, error_model="numpy")
    def apply_bounds(
        qpos: NumbaTuple, qvel: NumbaTuple, state: np.ndarray, timestep: float
    ) -> None:
        fill(qpos, qvel, state)
        if not is_finite_state(state):
            state[:] = np.nan
        constrained = to_floats(constrain_state(read_row(state, entries), timestep))
        for entry in range(len(positions)):
            qpos[entry] = constrained[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = constrained[velocities[entry]]

    return apply_bounds


@internal
def is_finite_state(state: np.ndarray) -> bool:
    """Return True if all entries of a state (n,) are numbers within `MAX_STATE`."""
    is_valid = True
    for entry in range(len(state)):
        is_valid &= abs(state[entry]) <= MAX_STATE
    return is_valid


class Outcomes(NamedTuple):
    """Compiled functions of a task.

    States are float64 arrays (n,). Observations are float32 arrays (k,) whose entries beyond the
    task's own are not written. `options` is the vector of the task's options.
    """

    observe: Compiled
    """Function (state, observation) -> None that fills the observation."""
    reward: Compiled
    """Function (state before, delivered force, state after, options) -> reward."""
    terminated: Compiled
    """Function (state) -> True if the episode terminates in that state."""


def compiled_outcomes(task: Task) -> Outcomes:
    """Return the compiled functions of a task; functions of built-in tasks compile on first use."""
    size, has_several_motors = len(task.state_names), len(task.motors) > 1
    functions = task.observation, task.reward, task.terminated
    return _compiled(*functions, task.options, size, task.observation_names, has_several_motors)  # type: ignore[arg-type]


@functools.cache
def _compiled(
    observation: Compiled,
    reward: Compiled,
    terminated: Compiled,
    options_type: type[NamedTuple],
    size: int,
    names: tuple[str, ...],
    has_several_motors: bool,
) -> Outcomes:
    compiled = njit(nogil=True, error_model="numpy")
    options_count, entries = len(options_type._fields), entries_type(size)
    state, force = (
        named_tuple_type(entries),
        types.float64[::1] if has_several_motors else types.float64,
    )
    observation_of = compiled_function(observation, names, "Task.observation_names", state)
    reward_of = compiled_function(
        reward, "", "Task.reward", state, force, state, named_tuple_type(options_type)
    )
    terminated_at = compiled_function(terminated, "", "Task.terminated", state)

    @compiled
    def observe(state: np.ndarray, observation: np.ndarray) -> None:
        values = to_floats(observation_of(read_row(state, entries)))
        for entry in range(len(values)):
            observation[entry] = values[entry]

    @compiled
    def reward_after(
        before: np.ndarray, force: Force, after: np.ndarray, options: np.ndarray
    ) -> float:
        option_tuple = options_type(*to_fixed_tuple(options, options_count))
        return float(
            reward_of(read_row(before, entries), force, read_row(after, entries), option_tuple)
        )

    @compiled
    def is_terminated(state: np.ndarray) -> bool:
        return bool(terminated_at(read_row(state, entries)))

    return Outcomes(observe, reward_after, is_terminated)
