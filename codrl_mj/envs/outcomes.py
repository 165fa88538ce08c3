"""What a task makes of its states, compiled: observation, reward and end.

There is one compiled form of a task's functions, and every face calls it: a library's cosine may differ from another's
in the last bit.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.np.unsafe.ndarray import to_fixed_tuple

from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import entries_type, floats, internal, read, tuple_of
from codrl_mj.kept import njit
from codrl_mj.physics.constrain import Compiled
from codrl_mj.tasks import Task


class Outcomes(NamedTuple):
    """Compiled functions.

    States are float64 arrays (n,). Observations are float32 arrays (k,); entries beyond the task's own are left alone.
    `options` is the vector of the task's options.
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
    reward_of = compiled_function(reward, "", "Task.reward", state, force, state, tuple_of(options_type))
    terminated_at = compiled_function(terminated, "", "Task.terminated", state)

    @internal
    def of(state: np.ndarray) -> Any:
        return read(state.ctypes.data, entries)

    @compiled
    def observe(state: np.ndarray, observation: np.ndarray) -> None:
        seen = floats(observation_of(of(state)))
        for entry in range(len(seen)):
            observation[entry] = seen[entry]

    @compiled
    def rewarded(before: np.ndarray, force: Any, after: np.ndarray, options: np.ndarray) -> float:
        options_given = options_type(*to_fixed_tuple(options, options_count))
        return float(reward_of(of(before), force, of(after), options_given))

    @compiled
    def ended(state: np.ndarray) -> bool:
        return bool(terminated_at(of(state)))

    return Outcomes(observe, rewarded, ended)
