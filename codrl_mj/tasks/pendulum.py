"""Pendulum: swing a rod up and hold it there with a weak torque. Gymnasium's Pendulum-v1.

## Description

A uniform rod (1 kg, 1 m) hangs from a pivot under a gravity of 10 m/s^2. The actuator turns the
pivot, too weakly to lift the rod in one go.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `cos_angle`, height of the tip | -1 | 1 | m |
| 1 | `sin_angle`, position of the tip to the left | -1 | 1 | m |
| 2 | `angular_velocity` | -8 | 8 | rad/s |

The angle theta is 0 upright and grows counter-clockwise; in the state it is not wrapped.

## Action space

`Box(-2, 2, (1,), float32)`: the desired torque [N*m]; it saturates at +-2. To match
Gymnasium up to rounding errors, pass float64 actions.

## Reward

-(theta^2 + 0.1 theta_dot^2 + 0.001 torque^2), with theta wrapped to [-pi, pi) and theta_dot from
*before* the step, and the torque that the motor delivered *in* it.

## Start

theta uniform in [-pi, pi] rad, theta_dot in [-1, 1] rad/s. `reset(options={"x_init": ..., "y_init":
...})` sets the two bounds, as in Gymnasium.

## End

Never; truncated after 200 steps (10 s). An episode succeeds if over its last second the rod is
within 0.1 rad of upright and slower than 0.1 rad/s.

## Arguments

[The arguments of every environment](arguments.md); Gymnasium's `g` is the model's gravity.
The integrator is semi-implicit Euler, as in the installed Gymnasium (the paper says explicit).
"""

import math

import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import utils

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.tasks.attributes import GRAVITY, Fixed, Setting, center_of_mass, mass
from codrl_mj.tasks.base import Entries, Flags, NoOptions, ResetOptions, Task, Values
from codrl_mj.tasks.reference_env import GymnasiumReferenceEnv, ReferenceStates, values_around

# Constants of Gymnasium's Pendulum-v1.
MAX_TORQUE = 2.0  # N*m
MAX_SPEED = 8.0  # rad/s
# Our definition of upright and still, which Gymnasium does not have.
GOAL_ANGLE = 0.1  # rad
GOAL_SPEED = 0.1  # rad/s
GOAL_HOLD = 1.0  # s


def initial_bounds(options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
    """Return +-pi and +-1 for angle and speed, or the reset options' `x_init` and `y_init`."""
    values = options or {}
    high = np.array(
        [
            utils.verify_number_and_cast(values.get(*entry))
            for entry in (("x_init", np.pi), ("y_init", 1.0))
        ]
    )
    return -high, high


def initial_state(draws: Entries) -> tuple[Values, ...]:
    """Return the draws as the state."""
    return draws[0], draws[1]


def constrain(state: Entries, timestep: float) -> tuple[Values, ...]:
    """Limit the speed, and correct the angle as if the limited speed had moved it."""
    # minimum and maximum in this order pass NaN on.
    speed = np.minimum(np.maximum(state[1], -MAX_SPEED), MAX_SPEED)
    return state[0] - (state[1] - speed) * timestep, speed


def observation(state: Entries) -> tuple[Values, ...]:
    """Return cos(theta), sin(theta) and theta_dot."""
    return np.cos(state[0]), np.sin(state[0]), state[1]


def terminated(state: Entries) -> Flags:
    """Return False: an episode ends only by its time limit."""
    return False


def upright_angle(state: Entries) -> Values:
    """Return the rod's angle from upright [rad], wrapped to [-pi, pi)."""
    return (state[0] + np.pi) % (2 * np.pi) - np.pi


def goal(state: Entries) -> Flags:
    """Return True if the rod is upright and still."""
    is_upright: Flags = np.abs(upright_angle(state)) < GOAL_ANGLE
    is_still: Flags = np.abs(state[1]) < GOAL_SPEED
    return is_upright & is_still


def reward(state: Entries, force: Values, next_state: Entries, options: NoOptions) -> Values:
    """Return the negated cost of angle and speed before the step, and of the torque delivered."""
    angle, speed = upright_angle(state), state[1]
    return -(angle * angle + 0.1 * (speed * speed) + 0.001 * (force * force))


_HIGH = np.array([1.0, 1.0, MAX_SPEED], dtype=np.float32)


class ReferenceEnv(GymnasiumReferenceEnv):
    """Gymnasium's `PendulumEnv`, whose torque limit and time step are attributes."""

    env_id = "Pendulum-v1"

    def __call__(
        self, state: np.ndarray, force: float, timestep: float, integrator: str
    ) -> np.ndarray:
        """Take a `step` with the torque as a float64 action, which Gymnasium does not round."""
        # The environment has only one integrator.
        del integrator
        return self.state_after(state, np.array([force]), dt=timestep, max_torque=np.inf)


TASK = Task(
    name="pendulum",
    env_id="codrl_mj/Pendulum-v0",
    max_episode_steps=200,
    agent="ddpg",
    gymnasium_id="Pendulum-v1",
    reference_env=ReferenceEnv,
    asset="pendulum.xml",
    step_duration=0.05,
    motor_inner_steps=1,
    max_force=MAX_TORQUE,
    render_fps=30,
    integrators=("semi-implicit",),
    state_names=("theta [rad]", "theta_dot [rad/s]"),
    observation_names=("cos_angle", "sin_angle", "angular_velocity"),
    observation_space=spaces.Box(-_HIGH, _HIGH, dtype=np.float32),
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    constrain=constrain,
    goal=goal,
    goal_hold=GOAL_HOLD,
    # The gains and the arm are from the paper, Experimental Results; R, L, kT, kE are the defaults.
    paper=(DCMotorActuator(Motor(), CurrentLoop(kp=1.0, ki=20.0, kd=1e-6)),),
    attributes={
        "max_speed": Fixed(MAX_SPEED),
        "max_torque": Setting.LARGEST_FORCE,
        "dt": Setting.STEP,
        "g": GRAVITY,
        "m": mass("rod"),
        "l": center_of_mass("rod", 2.0),
    },
    reference_states=ReferenceStates(
        bounds=(2 * np.pi, MAX_SPEED),
        edges=(
            (*values_around(math.pi), 0.0, math.pi / 2, -2 * math.pi),
            (*values_around(MAX_SPEED), 0.0),
        ),
        # In this run the rod swings below the speed limit of 8 rad/s.
        start=(2.0, 0.5),
        steps=20,
        balanced_steps=8,
    ),
)
