"""A custom task: hold a two-link arm with two motors out to the side."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from codrl_mj import Task
from codrl_mj.tasks.attributes import GRAVITY, Fixed, Setting, mass

MAX_TORQUES = (8.0, 3.0)  # N*m


class Options(NamedTuple):
    """Options of the task."""

    effort_weight: float = 0.01
    """Cost of a squared torque [1/(N*m)^2]."""


def initial_bounds(options: dict[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of a state in which the arm hangs down."""
    del options
    return np.full(4, -0.1), np.full(4, 0.1)


def initial_state(draws: Any) -> tuple[Any, ...]:
    """Return the draws as the state."""
    return draws[0], draws[1], draws[2], draws[3]


def observation(state: Any) -> tuple[Any, ...]:
    """Return cosines and sines of the angles, and the scaled speeds."""
    return (
        np.cos(state[0]),
        np.sin(state[0]),
        np.cos(state[1]),
        np.sin(state[1]),
        0.1 * state[2],
        0.1 * state[3],
    )


def error(state: Any) -> Any:
    """Return the deviation of the hand from the stretched position."""
    return 2.0 - np.sin(-state[0]) - np.cos(state[1])


def reward(state: Any, force: Any, next_state: Any, options: Options) -> Any:
    """Return the negative sum of the error and the effort of both motors."""
    return -error(next_state) - options.effort_weight * (force[0] * force[0] + force[1] * force[1])


def terminated(state: Any) -> Any:
    """Return True if the arm spins too fast."""
    return np.abs(state[2]) > 50.0


TASK = Task(
    name="arm",
    env_id="own_project/Arm-v0",
    max_episode_steps=50,
    asset=str(Path(__file__).with_name("arm.xml")),
    step_duration=0.05,
    motor_inner_steps=5,
    max_force=MAX_TORQUES,
    forces=None,
    render_fps=20,
    integrators=("rk4",),
    state_names=("shoulder [rad]", "elbow [rad]", "shoulder_dot [rad/s]", "elbow_dot [rad/s]"),
    qpos=(0, 1),
    qvel=(2, 3),
    action_space=spaces.Box(-np.array(MAX_TORQUES, np.float32), np.array(MAX_TORQUES, np.float32)),
    observation_names=("cos_1", "sin_1", "cos_2", "sin_2", "speed_1", "speed_2"),
    observation_space=spaces.Box(-np.inf, np.inf, (6,), np.float32),
    options=Options,
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    motors=("shoulder", "elbow"),
    attributes={
        "gravity": GRAVITY,
        "upper_mass": mass("upper"),
        "largest_torques": Setting.LARGEST_FORCE,
        "reach": Fixed(0.9),
    },
)
