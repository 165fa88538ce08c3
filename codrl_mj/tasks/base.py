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
    render_fps: int
    """Frames per second of a video with one frame a step, Gymnasium's; rarely real time."""
    integrators: tuple[str, ...]
    """Names of the integrators that can be chosen; the first is Gymnasium's."""
    state_names: tuple[str, ...]
    """Names of the state's entries, with units."""
    qpos: tuple[int, ...]
    """Which state entries are MuJoCo's `qpos`, in order; an arithmetic progression, as is `qvel`."""
    qvel: tuple[int, ...]
    """Which state entries are MuJoCo's `qvel`, in order."""
    action_space: spaces.Space[Any]
    """The action space, Gymnasium's."""
    observation_names: tuple[str, ...]
    """Names of the observation's entries."""
    observation_space: spaces.Box
    """The observation space, Gymnasium's."""
    options: type[Any]
    """The task's options: a `NamedTuple` class whose fields all have defaults."""
    initial_bounds: Callable[[dict[str, Any] | None], tuple[np.ndarray, np.ndarray]]
    """(reset options) -> lower and upper bounds, shape (k,) each, of the k numbers that Gymnasium draws at a reset."""
    initial_state: Callable[[np.ndarray], np.ndarray]
    """(numbers drawn uniformly within those bounds (N, k), or one draw (k,)) -> initial states (N, n), or one."""
    desired_force: Callable[[np.ndarray], np.ndarray]
    """(actions (N, *action shape), or one action) -> desired forces (N,), or one; a `Box`'s actions saturate."""
    observation: Callable[[np.ndarray], np.ndarray]
    """(states (N, n)) -> observations (N, k), float32."""
    reward: Callable[[np.ndarray, np.ndarray, np.ndarray, Options], np.ndarray]
    """(states before, forces delivered, states after, options) -> rewards (N,)."""
    terminated: Callable[[np.ndarray], np.ndarray]
    """(states) -> whether the episode ends there, (N,) bool."""
    constrain: Callable[[np.ndarray, float], np.ndarray] | None = None
    """(states (N, n) as integrated, integration step [s]) -> states within the bounds that Gymnasium's `step` keeps:
    speed limits, walls, wrapped angles. Applied after every integration step; None where there are no bounds. Plain
    Python on purpose: `codrl_mj.physics.constrain` compiles it. Must let NaN through."""
    goal: Callable[[np.ndarray], np.ndarray] | None = None
    """(states (N, n)) -> whether the task's goal is reached there, (N,) bool. An episode succeeds if it ends at the
    goal and has been there for `goal_hold`. None where the goal is to last: an episode then succeeds if it is not
    terminated before the time limit."""
    goal_hold: float = 0.0
    """How long an episode that succeeds has been at the goal when it ends [s]."""

    def initial(self, generator: np.random.Generator, options: dict[str, Any] | None) -> np.ndarray:
        """One initial state, shape (n,): the state that Gymnasium's environment draws from the same generator."""
        return self.initial_state(generator.uniform(*self.initial_bounds(options)))

    def check_action(self, action: Any) -> np.ndarray:
        """One action as an array, checked.

        An action of a `Box` may lie outside its bounds: the desired force saturates, as Gymnasium's does.

        Args:
            action: an element of a `Discrete` space, or an array of the `Box`'s shape and any floating-point type.

        Raises:
            ValueError: not an element; for a `Box` a wrong shape, a type that is not floating-point, or NaN.
        """
        array = np.asarray(action)
        if isinstance(self.action_space, spaces.Box):
            valid = array.dtype.kind == "f" and array.shape == self.action_space.shape and not np.isnan(array).any()
        else:
            valid = self.action_space.contains(action)
        if not valid:
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        return array
