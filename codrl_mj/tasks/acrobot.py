"""Acrobot: swing up a chain of two links by a motor between them. Gymnasium's Acrobot-v1.

## Description

Two links (1 kg, 1 m each, center of mass in the middle, 1 kg m^2 about it) hang from a fixed
shoulder under a gravity of 9.8 m/s^2. The actuator turns the elbow. These are Gymnasium's "book"
dynamics, without its torque noise.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `cos_angle_1` | -1 | 1 | |
| 1 | `sin_angle_1` | -1 | 1 | |
| 2 | `cos_angle_2` | -1 | 1 | |
| 3 | `sin_angle_2` | -1 | 1 | |
| 4 | `velocity_1` | -4 pi | 4 pi | rad/s |
| 5 | `velocity_2` | -9 pi | 9 pi | rad/s |

Angle 1 is that of the first link, 0 when it hangs down; angle 2 is that of the second link relative
to the first. Both grow counter-clockwise and are wrapped to [-pi, pi].

## Action space

`Discrete(3)`: the desired torque at the elbow is -1, 0 or 1 N m.

## Reward

-1 a step; 0 for the step that reaches the goal.

## Start

All four state entries uniform in [-0.1, 0.1], in float32. `reset(options={"low": ..., "high":
...})` sets the bounds.

## End

The tip is more than 1 m above the shoulder, which is success: -cos(angle 1) - cos(angle 1 + angle
2) > 1. Truncated after 500 steps (100 s).

## Arguments

[The arguments of every environment](arguments.md). The integrator is RK4, as in Gymnasium. With a
motor an environment step has ten integration steps, as in the paper.
"""

import math

import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import utils

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.tasks.attributes import Fixed, ModelNumber, Setting, center_of_mass, mass
from codrl_mj.tasks.base import Entries, Flags, NoOptions, ResetOptions, Task, Values
from codrl_mj.tasks.reference_env import GymnasiumReferenceEnv, ReferenceStates, values_around

# Constants of Gymnasium's Acrobot-v1.
TORQUE = 1.0  # N*m
MAX_SPEED_1 = 4 * math.pi  # rad/s
MAX_SPEED_2 = 9 * math.pi  # rad/s
GOAL_HEIGHT = 1.0  # m above the shoulder


def initial_bounds(options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
    """Return -0.1 and 0.1 for all four entries, or the reset options' `low` and `high`."""
    low, high = utils.maybe_parse_reset_bounds(options, -0.1, 0.1)
    return np.full(4, low), np.full(4, high)


def initial_state(draws: Entries) -> tuple[Values, ...]:
    """Return the draws rounded to float32, as Gymnasium does."""
    return _rounded(draws[0]), _rounded(draws[1]), _rounded(draws[2]), _rounded(draws[3])


def _rounded(number: Values) -> Values:
    return np.float64(np.float32(number))


def constrain(state: Entries, timestep: float) -> tuple[Values, ...]:
    """Wrap the angles and limit the speeds."""
    speed_1 = np.minimum(np.maximum(state[2], -MAX_SPEED_1), MAX_SPEED_1)
    speed_2 = np.minimum(np.maximum(state[3], -MAX_SPEED_2), MAX_SPEED_2)
    return _wrapped(state[0]), _wrapped(state[1]), speed_1, speed_2


def _wrapped(angle: Values) -> Values:
    """Return an angle, wrapped to [-pi, pi] by whole turns."""
    # A modulo would round angles that are within the range already, and Gymnasium does not.
    turn = 2 * math.pi
    angle = angle - turn * np.maximum(np.ceil((angle - math.pi) / turn), 0.0)
    return angle + turn * np.maximum(np.ceil((-math.pi - angle) / turn), 0.0)


def observation(state: Entries) -> tuple[Values, ...]:
    """Return the cosines and sines of the angles, and the speeds."""
    return (
        np.cos(state[0]),
        np.sin(state[0]),
        np.cos(state[1]),
        np.sin(state[1]),
        state[2],
        state[3],
    )


def terminated(state: Entries) -> Flags:
    """Return True if the tip is above the goal line."""
    is_above: Flags = -np.cos(state[0]) - np.cos(state[1] + state[0]) > GOAL_HEIGHT
    return is_above


def reward(state: Entries, force: Values, next_state: Entries, options: NoOptions) -> Values:
    """Return -1, or 0 for the step that reaches the goal."""
    return -1.0 + terminated(next_state)


_HIGH = np.array([1.0, 1.0, 1.0, 1.0, MAX_SPEED_1, MAX_SPEED_2], dtype=np.float32)


class ReferenceEnv(GymnasiumReferenceEnv):
    """Gymnasium's `AcrobotEnv`, whose available torques and time step are attributes."""

    env_id = "Acrobot-v1"
    _MAX_IMPULSE = 400.0  # N*m*s^2

    def __call__(
        self, state: np.ndarray, force: float, timestep: float, integrator: str
    ) -> np.ndarray:
        """Take a `step` with the torque as the only one available."""
        # The environment has only one integrator.
        del integrator
        # Gymnasium wraps angles by one turn at a time; after a huge step that loop would not end.
        if not abs(force) * timestep**2 < self._MAX_IMPULSE:
            return np.full(4, np.nan)
        return self.state_after(state, 0, AVAIL_TORQUE=[force], dt=timestep)

    def derivative(self, state: np.ndarray, force: float) -> np.ndarray:
        """Return the state's time derivative by the environment's equations of motion."""
        return np.array(self.env._dsdt([*state, force]))[: len(state)]


_MASS_ONLY = ("body_mass",)
_CENTER_ONLY = ("body_ipos",)


TASK = Task(
    name="acrobot",
    env_id="codrl_mj/Acrobot-v0",
    max_episode_steps=500,
    reward_threshold=-100.0,
    agent="dqn",
    gymnasium_id="Acrobot-v1",
    reference_env=ReferenceEnv,
    asset="acrobot.xml",
    step_duration=0.2,
    motor_inner_steps=10,
    max_force=TORQUE,
    forces=(-TORQUE, 0.0, TORQUE),
    render_fps=15,
    integrators=("rk4",),
    state_names=("theta1 [rad]", "theta2 [rad]", "theta1_dot [rad/s]", "theta2_dot [rad/s]"),
    observation_names=(
        "cos_angle_1",
        "sin_angle_1",
        "cos_angle_2",
        "sin_angle_2",
        "velocity_1",
        "velocity_2",
    ),
    observation_space=spaces.Box(-_HIGH, _HIGH, dtype=np.float32),
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    constrain=constrain,
    goal=terminated,
    # The gains and the arm are from the paper, Experimental Results; R, L, kT, kE are the defaults.
    paper=(DCMotorActuator(Motor(), CurrentLoop(kp=1.0, ki=10.0, kd=1e-6)),),
    wrapped=(0, 1),
    attributes={
        "dt": Setting.STEP,
        "LINK_LENGTH_1": ModelNumber(
            *("body_pos", "lower", 2, -1.0),
            varies=("model.length.upper",),
            only=("body_pos", "geom_pos", "geom_size"),
        ),
        "LINK_LENGTH_2": Fixed(1.0, "only the picture depends on it, in Gymnasium too"),
        "LINK_MASS_1": mass("upper", only=_MASS_ONLY),
        "LINK_MASS_2": mass("lower", only=_MASS_ONLY),
        "LINK_COM_POS_1": center_of_mass("upper", -1.0, only=_CENTER_ONLY),
        "LINK_COM_POS_2": center_of_mass("lower", -1.0, only=_CENTER_ONLY),
        "LINK_MOI": ModelNumber(
            *("body_inertia", "upper", 1),
            varies=("model.mass.upper", "model.mass.lower"),
            only=("body_inertia",),
        ),
        "MAX_VEL_1": Fixed(MAX_SPEED_1),
        "MAX_VEL_2": Fixed(MAX_SPEED_2),
        "AVAIL_TORQUE": Setting.FORCES,
        "torque_noise_max": Fixed(0.0, "make an environment with disturbances"),
        "book_or_nips": Fixed("book", "the MuJoCo model has only the dynamics of the book"),
    },
    reference_states=ReferenceStates(
        # Speeds are about half the task's limits: at the limits, an RK4 step of Gymnasium amplifies
        # rounding errors to 1e-12.
        bounds=(np.pi, np.pi, 2 * np.pi, 4 * np.pi),
        # Angles at the wrap, and speeds with which the first link exceeds its limit after the step.
        edges=(
            (*values_around(math.pi), 0.0),
            (*values_around(math.pi), 0.0),
            (-4 * math.pi, -1.0, 4 * math.pi),
            (-6.0, 6.0),
        ),
        # In this run angles stay within half a turn and speeds below 4 pi.
        start=(2.0, 0.5, 0.0, 0.0),
        steps=7,
        balanced_steps=5,
        horizon=100,
    ),
)
