"""What a task is: a model file, a few numbers, and pure functions of arrays with a leading batch axis."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

Options = Any
"""A task's options: a `NamedTuple` of floats whose fields have defaults."""


@dataclass(frozen=True)
class Task:
    """One task, defined once; every face (single, batched, analytic, dm_control) is built from it.

    States are float64 arrays of shape (N, n) in Gymnasium's own order; forces are float64 arrays of shape (N,).
    """

    name: str
    """Name on the command line, such as `cartpole`."""
    gymnasium_id: str
    """Id of the Gymnasium environment that this task rebuilds."""
    asset: str
    """MJCF file name."""
    step_duration: float
    """Duration of one environment step [s]."""
    motor_inner_steps: int
    """Integration steps per environment step when a motor is in the loop; one when the actuator is ideal."""
    max_force: float
    """Largest desired force [N] or torque [N*m] of any action."""
    integrators: tuple[str, ...]
    """Names of the integrators that can be chosen; the first is Gymnasium's."""
    state_names: tuple[str, ...]
    """Names of the state's entries, with units."""
    qpos: tuple[int, ...]
    """Which state entries are MuJoCo's `qpos`, in order."""
    qvel: tuple[int, ...]
    """Which state entries are MuJoCo's `qvel`, in order."""
    action_space: spaces.Space[Any]
    """The action space, Gymnasium's."""
    observation_space: spaces.Box
    """The observation space, Gymnasium's."""
    options: type[Any]
    """The task's options: a `NamedTuple` class whose fields all have defaults."""
    initial: Callable[[np.random.Generator, dict[str, Any] | None], np.ndarray]
    """(generator, reset options) -> one initial state, shape (n,); draws what Gymnasium draws."""
    desired_force: Callable[[np.ndarray], np.ndarray]
    """(actions (N, ...)) -> desired forces (N,)."""
    observation: Callable[[np.ndarray], np.ndarray]
    """(states (N, n)) -> observations (N, k), float32."""
    reward: Callable[[np.ndarray, np.ndarray, np.ndarray, Options], np.ndarray]
    """(states before, forces delivered, states after, options) -> rewards (N,)."""
    terminated: Callable[[np.ndarray], np.ndarray]
    """(states) -> whether the episode ends there, (N,) bool."""
