"""What a task is: a model file, a few numbers, and pure functions of a state's entries."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

Options = Any
"""A task's options: a `NamedTuple` of floats whose fields have defaults."""
Entries = Any
"""A sequence of numbers, or of arrays with one number for each of N states."""


@dataclass(frozen=True)
class Task:
    """One task, defined once; every face (single, batched, analytic, dm_control) is built from it.

    A function of a state takes the state's entries, in Gymnasium's own order: `state[0]`, `state[1]` and so on, each a
    number, or an array with a number for each of N states (`states.T` of states (N, n)). What is the same for all
    states may be returned as a single number. These functions are plain Python that numba compiles as it stands
    (`codrl_mj.envs.outcomes`); every face runs the compiled form. Helpers of theirs are `register_jitable`.
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
    """Largest desired force [N] or torque [N*m] of any action; where the action is the force, it saturates here."""
    forces: tuple[float, ...] | None
    """Desired forces [N] or torques [N*m] of the discrete actions, in order; None where the action is the force."""
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
    initial_state: Callable[[Entries], tuple[Any, ...]]
    """(k numbers drawn uniformly within those bounds) -> entries of the initial state."""
    observation: Callable[[Entries], tuple[Any, ...]]
    """(state) -> entries of the observation, to be rounded to float32."""
    reward: Callable[[Entries, Any, Entries, Options], Any]
    """(state before, force delivered, state after, options) -> reward."""
    terminated: Callable[[Entries], Any]
    """(state) -> whether the episode ends there."""
    constrain: Callable[[Entries, float], tuple[Any, ...]] | None = None
    """(state as integrated, integration step [s]) -> entries of the state within the bounds that Gymnasium's `step`
    keeps: speed limits, walls, wrapped angles. Applied after every integration step; None where there are no bounds.
    Must let NaN through."""
    goal: Callable[[Entries], Any] | None = None
    """(state) -> whether the task's goal is reached there. An episode succeeds if it ends at the goal and has been
    there for `goal_hold`. None where the goal is to last: an episode then succeeds if it is not terminated before the
    time limit."""
    goal_hold: float = 0.0
    """How long an episode that succeeds has been at the goal when it ends [s]."""

    def initial(self, generator: np.random.Generator, options: dict[str, Any] | None) -> np.ndarray:
        """One initial state, shape (n,): the state that Gymnasium's environment draws from the same generator."""
        return np.array(self.initial_state(generator.uniform(*self.initial_bounds(options))))

    def initial_states(self, draws: np.ndarray) -> np.ndarray:
        """Initial states, shape (N, n), from numbers drawn within the bounds, (N, k)."""
        return np.stack(self.initial_state(draws.T), axis=-1)

    def desired_force(self, actions: np.ndarray) -> np.ndarray:
        """Desired forces, shape (N,), of actions (N, *action shape); or the force of one action."""
        if self.forces is not None:
            return np.asarray(self.forces)[actions]
        return np.clip(actions[..., 0].astype(np.float64), -self.max_force, self.max_force)
