"""MountainCarContinuous: rock a weak car out of a valley. Gymnasium's MountainCarContinuous-v0.

## Description

The car and the hill of [MountainCar](mountain_car.md), with a stronger motor. Its acceleration
along x is 0.0015 F - 0.0025 cos(3 x), in m/s^2 with F in N: a car of 666.7 kg.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `position` | -1.2 | 0.6 | m |
| 1 | `velocity` | -0.07 | 0.07 | m/s |

Only the observation is rounded to float32; Gymnasium rounds its state in every step.

## Action space

`Box(-1, 1, (1,), float32)`: the desired force [N]; it saturates at +-1.

## Reward

100 for the step that ends at the goal, minus 0.1 F^2 for the force F [N] that the motor delivered
at the end of the step. Gymnasium charges for the action.

## Start

x uniform in [-0.6, -0.4] m, v = 0. `reset(options={"low": ..., "high": ...})` sets the bounds of x.

## End

At the end of a step x >= 0.45 m with v >= 0, which is success. Truncated after 999 steps (999 s).

## Arguments

[The arguments of every environment](arguments.md); Gymnasium's `goal_velocity` is 0. The
integration is the same as in MountainCar.
"""

import dataclasses
import functools

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.tasks import mountain_car
from codrl_mj.tasks.attributes import Fixed
from codrl_mj.tasks.base import Entries, Flags, NoOptions, Values

# Constants of Gymnasium's MountainCarContinuous-v0.
FORCE = 1.0  # N
GOAL = 0.45  # m


def terminated(state: Entries) -> Flags:
    """Return True if the car is at the flag or beyond, and not rolling back."""
    return (state[0] >= GOAL) & (state[1] >= 0.0)


def reward(state: Entries, force: Values, next_state: Entries, options: NoOptions) -> Values:
    """Return 100 at the goal, minus 0.1 times the square of the delivered force."""
    return 100.0 * terminated(next_state) - 0.1 * (force * force)


TASK = dataclasses.replace(
    mountain_car.TASK,
    name="mountain_car_continuous",
    env_id="codrl_mj/MountainCarContinuous-v0",
    max_episode_steps=999,
    reward_threshold=90.0,
    agent="ddpg",
    gymnasium_id="MountainCarContinuous-v0",
    # Gymnasium's MountainCarContinuousEnv has the same equations, but its gravity is not an
    # attribute, so it cannot be scaled, and it rounds its state to float32.
    reference_env=functools.partial(mountain_car.ReferenceEnv, "MountainCarContinuous-v0", "power"),
    asset="mountain_car_continuous.xml",
    max_force=FORCE,
    forces=None,
    action_space=spaces.Box(-FORCE, FORCE, (1,), np.float32),
    reward=reward,
    terminated=terminated,
    goal=terminated,
    # The gains and the arm are from the paper, Experimental Results; R, L, kT, kE are the defaults.
    paper=(DCMotorActuator(Motor(), CurrentLoop(kp=0.1, ki=10.0, kd=1e-3)),),
    attributes={
        **mountain_car.attributes(GOAL, "power"),
        "min_action": Fixed(-FORCE),
        "max_action": Fixed(FORCE),
    },
)
