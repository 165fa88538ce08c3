"""What a task makes of its states, compiled: observation, reward and end, of one state or of many.

There is one compiled form of a task's functions, and every face calls it: a library's cosine may differ from another's
in the last bit.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.np.unsafe.ndarray import to_fixed_tuple

from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, floats, internal, read, tuple_of
from codrl_mj.physics.constrain import Compiled, is_fine
from codrl_mj.tasks import Task


class Outcomes(NamedTuple):
    """Compiled functions.

    States are float64 arrays (n,), or (N, n) with rows whose entries are neighbours. Observations are float32 arrays
    (k,), or (N, k); entries beyond the task's own are left alone. `options` is the vector of the task's options.
    """

    observe: Compiled
    """(state, observation) -> nothing: fills the observation."""
    reward: Compiled
    """(state before, force delivered, state after, options) -> reward."""
    terminated: Compiled
    """(state) -> whether the episode ends there."""
    observe_all: Compiled
    """(states, observations) -> nothing."""
    reward_all: Compiled
    """(states before, forces (N,), states after, options, rewards (N,)) -> nothing: fills the rewards."""
    terminated_all: Compiled
    """(states, terminated (N,) bool) -> nothing: fills it."""
    judge: Compiled
    """(states before, forces (N,), states after, options, elapsed (N,), limit, stepping (N,) bool, observations,
    rewards (N,), terminated (N,) bool, truncated (N,) bool) -> the first row that is stepping and whose state is no
    longer fine, or -1: all the others at once, and `elapsed` counted on. Rows that are not stepping earn nothing and do
    not end."""


def compiled_outcomes(task: Task) -> Outcomes:
    """The functions of a task; its own are compiled at once, ours as they are used, once a process.

    Raises:
        ValueError: one of its own is not what numba compiles.
    """
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
    compiled = numba.njit(nogil=True, error_model="numpy")
    options_count, entries = len(options_type._fields), entries_type(size)
    state, force = tuple_of(entries), types.float64[::1] if several else types.float64
    observation_of = compiled_function(observation, names, "Task.observation_names", state)
    reward_of = compiled_function(reward, "", "Task.reward", state, force, state, tuple_of(options_type))
    terminated_at = compiled_function(terminated, "", "Task.terminated", state)

    @internal
    def of(state: np.ndarray) -> Any:
        return read(state.ctypes.data, entries)

    @internal
    def observe(state: np.ndarray, observation: np.ndarray) -> None:
        seen = floats(observation_of(of(state)))
        for entry in range(len(seen)):
            observation[entry] = seen[entry]

    @internal
    def rewarded(before: Any, force: float, after: Any, options: np.ndarray) -> float:
        return float(reward_of(before, force, after, options_type(*to_fixed_tuple(options, options_count))))

    @internal
    def rewarded_step(before: np.ndarray, force: float, after: np.ndarray, options: np.ndarray) -> float:
        return rewarded(of(before), force, of(after), options)

    @internal
    def ended(state: np.ndarray) -> bool:
        return bool(terminated_at(of(state)))

    @internal
    def of_row(states: np.ndarray, row: int) -> Any:  # entries instead of a view, which costs several times the rest
        return read(states.ctypes.data + row * states.strides[0], entries)

    @internal
    def observe_row(state: Any, observations: np.ndarray, row: int) -> None:
        seen = floats(observation_of(state))
        for entry in range(len(seen)):
            observations[row, entry] = seen[entry]

    @compiled
    def observe_all(states: np.ndarray, observations: np.ndarray) -> None:
        for row in range(len(states)):
            observe_row(of_row(states, row), observations, row)

    @compiled
    def reward_all(
        before: np.ndarray, forces: np.ndarray, after: np.ndarray, options: np.ndarray, rewards: np.ndarray
    ) -> None:
        for row in range(len(before)):
            rewards[row] = rewarded(of_row(before, row), forces[row], of_row(after, row), options)

    @compiled
    def terminated_all(states: np.ndarray, terminated: np.ndarray) -> None:
        for row in range(len(states)):
            terminated[row] = bool(terminated_at(of_row(states, row)))

    @compiled
    def judge(
        before: np.ndarray,
        forces: np.ndarray,
        after: np.ndarray,
        options: np.ndarray,
        elapsed: np.ndarray,
        limit: float,
        stepping: np.ndarray,
        observations: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
    ) -> int:
        broken = -1
        for row in range(len(before)):
            elapsed[row] += 1
            state = of_row(after, row)
            observe_row(state, observations, row)
            if not stepping[row]:
                rewards[row], terminated[row], truncated[row] = 0.0, False, False
                continue
            if broken < 0 and not is_fine(state):
                broken = row
            rewards[row] = rewarded(of_row(before, row), forces[row], state, options)
            terminated[row] = bool(terminated_at(state))
            truncated[row] = elapsed[row] >= limit
        return broken

    return Outcomes(observe, rewarded_step, ended, observe_all, reward_all, terminated_all, judge)
