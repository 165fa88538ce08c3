"""CartPole: keep a pole upright on a cart that is pushed left or right. Gymnasium's CartPole-v1.

## Description

A cart (1 kg) slides on a track under a gravity of 9.8 m/s^2; a uniform pole (0.1 kg, 1 m) stands on
it on a hinge. There is no friction. The actuator pushes the cart.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `cart_position`, positive to the right | -4.8 | 4.8 | m |
| 1 | `cart_velocity` | -inf | inf | m/s |
| 2 | `pole_angle`, 0 upright, positive to the right | -0.4189 (24 deg) | 0.4189 (24 deg) | rad |
| 3 | `pole_velocity` | -inf | inf | rad/s |

## Action space

`Discrete(2)`: the desired force on the cart is -10 N (left) or 10 N (right).

## Reward

1 a step, the last one included. With `center_radius` a step that ends farther than that from the
center earns 0, and the episode goes on. With `sutton_barto_reward` the step that ends the episode
earns -1, and so does, with `center_radius`, a step that ends outside that radius; all others earn
0.

## Start

All four state entries uniform in [-0.05, 0.05]. `reset(options={"low": ..., "high": ...})` sets the
bounds.

## End

The cart is more than 2.4 m from the center, or the pole leans by more than 12 degrees. Truncated
after 500 steps (10 s), which is success.

## Arguments

[The arguments of every environment](arguments.md), and two more: `center_radius` [m], > 0, no limit
by default, 0.1 in the paper's training; and Gymnasium's `sutton_barto_reward`. The integrator
`euler` is explicit and, as in Gymnasium, the default.
"""

import math
import operator
from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import utils

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.tasks.attributes import GRAVITY, Derived, Fixed, Setting, center_of_mass, mass
from codrl_mj.tasks.base import Entries, Flags, ResetOptions, Task, Values
from codrl_mj.tasks.reference_env import GymnasiumReferenceEnv, ReferenceStates, values_around

# Constants of Gymnasium's CartPole-v1.
FORCE = 10.0  # N
X_LIMIT = 2.4  # m
ANGLE_LIMIT = 12 * 2 * np.pi / 360  # rad


class Options(NamedTuple):
    """Options of CartPole."""

    center_radius: float = np.inf
    """Distance from the center [m] beyond which a step earns nothing; the paper uses 0.1."""
    sutton_barto_reward: bool = False
    """Gymnasium's option: -1 for the terminating step and 0 for all others, instead of 1."""


def initial_bounds(options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
    """Return -0.05 and 0.05 for all four entries, or the reset options' `low` and `high`."""
    low, high = utils.maybe_parse_reset_bounds(options, -0.05, 0.05)
    return np.full(4, low), np.full(4, high)


def initial_state(draws: Entries) -> tuple[Values, ...]:
    """Return the draws as the state."""
    return draws[0], draws[1], draws[2], draws[3]


def observation(state: Entries) -> tuple[Values, ...]:
    """Return the state."""
    return state[0], state[1], state[2], state[3]


def terminated(state: Entries) -> Flags:
    """Return True if the cart is off the track or the pole leans by more than 12 degrees."""
    is_out: Flags = (np.abs(state[0]) > X_LIMIT) | (np.abs(state[2]) > ANGLE_LIMIT)
    return is_out


def reward(state: Entries, force: Values, next_state: Entries, options: Options) -> Values:
    """Return 1, or 0 outside `center_radius`.

    With `sutton_barto_reward`, return -1 for the terminating step and outside the radius, else 0.
    """
    outside: Flags = np.abs(next_state[0]) > options.center_radius
    if options.sutton_barto_reward:
        return 0.0 - (terminated(next_state) | outside)
    return 1.0 - outside


_HIGH = np.array([X_LIMIT * 2, np.inf, ANGLE_LIMIT * 2, np.inf], dtype=np.float32)


class ReferenceEnv(GymnasiumReferenceEnv):
    """Gymnasium's `CartPoleEnv`, whose force, time step and integrator are attributes."""

    env_id = "CartPole-v1"

    def __call__(
        self, state: np.ndarray, force: float, timestep: float, integrator: str
    ) -> np.ndarray:
        """Take a `step` with `force_mag` set to the force."""
        # Gymnasium warns of steps after a termination, unless it is reset.
        settings = {
            "tau": timestep,
            "kinematics_integrator": integrator,
            "steps_beyond_terminated": None,
        }
        return self.state_after(state, 1, force_mag=force, **settings)


TASK = Task(
    name="cartpole",
    env_id="codrl_mj/CartPole-v0",
    max_episode_steps=500,
    reward_threshold=475.0,
    agent="ppo",
    gymnasium_id="CartPole-v1",
    reference_env=ReferenceEnv,
    asset="cartpole.xml",
    step_duration=0.02,
    motor_inner_steps=1,
    max_force=FORCE,
    forces=(-FORCE, FORCE),
    integrators=("euler", "semi-implicit"),
    state_names=("x [m]", "x_dot [m/s]", "theta [rad]", "theta_dot [rad/s]"),
    qpos=(0, 2),
    qvel=(1, 3),
    observation_names=("cart_position", "cart_velocity", "pole_angle", "pole_velocity"),
    observation_space=spaces.Box(-_HIGH, _HIGH, dtype=np.float32),
    options=Options,
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    # The gains and the arm are from the paper, Experimental Results; R, L, kT, kE are the defaults.
    paper=(DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=4.3, ki=1.0, kd=1e-6, kff=0.6)),),
    attributes={
        "gravity": GRAVITY,
        "masscart": mass("cart"),
        "masspole": mass("pole"),
        "total_mass": Derived(("masscart", "masspole"), operator.add),
        "length": center_of_mass("pole"),
        "polemass_length": Derived(("masspole", "length"), operator.mul),
        "force_mag": Setting.LARGEST_FORCE,
        "tau": Setting.STEP,
        "kinematics_integrator": Setting.INTEGRATOR,
        "theta_threshold_radians": Fixed(ANGLE_LIMIT),
        "x_threshold": Fixed(X_LIMIT),
    },
    reference_states=ReferenceStates(
        # Beyond what an episode can reach: all angles, and the speeds of a falling pole.
        bounds=(4.8, 10.0, np.pi, 10.0),
        edges=(
            (-4.8, -2.4, 0.0, 2.4, 4.8),
            (-10.0, 0.0, 10.0),
            (*values_around(math.pi), 0.0, math.pi / 2, 0.2094),
            (-10.0, 0.0, 10.0),
        ),
        # In this run the pole falls by about a right angle.
        start=(0.1, -0.2, 0.1, 0.3),
        steps=30,
        balanced_steps=10,
    ),
)
