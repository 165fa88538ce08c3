"""MountainCar: rock a weak car out of a valley by three forces. Gymnasium's MountainCar-v0.

## Description

A car on a hill of the shape sin(3 x) is too weak to drive up, and has to rock. Its acceleration
along x is 0.001 F - 0.0025 cos(3 x), in m/s^2 with F in N: a car of 1000 kg.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `position` | -1.2 | 0.6 | m |
| 1 | `velocity` | -0.07 | 0.07 | m/s |

These bounds hold after every integration step; the left wall stops the car.

## Action space

`Discrete(3)`: the desired force is -1, 0 or 1 N.

## Reward

-1 a step.

## Start

x uniform in [-0.6, -0.4] m, v = 0. `reset(options={"low": ..., "high": ...})` sets the bounds of x.

## End

At the end of a step x >= 0.5 m with v >= 0, which is success. Truncated after 200 steps (200 s).

## Arguments

[The arguments of every environment](arguments.md); Gymnasium's `goal_velocity` is 0. The integrator
is semi-implicit Euler, as in Gymnasium. With a motor an environment step has twenty integration
steps, as in the paper.
"""

import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import utils

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.tasks.attributes import Attribute, Fixed, ModelNumber, mass
from codrl_mj.tasks.base import Entries, Flags, NoOptions, ResetOptions, Task, Values
from codrl_mj.tasks.reference_env import (
    GymnasiumReferenceEnv,
    ReferenceStates,
    make_gymnasium_env,
    values_around,
)

# Constants of Gymnasium's MountainCar-v0 and, except for the goal, of MountainCarContinuous-v0.
FORCE = 1.0  # N
MIN_POSITION, MAX_POSITION = -1.2, 0.6  # m
MAX_SPEED = 0.07  # m/s
GOAL = 0.5  # m


def initial_bounds(options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
    """Return -0.6 and -0.4 for the position, or the reset options' `low` and `high`."""
    low, high = utils.maybe_parse_reset_bounds(options, -0.6, -0.4)
    return np.array([low]), np.array([high])


def initial_state(draws: Entries) -> tuple[Values, ...]:
    """Return the drawn position, at rest."""
    return draws[0], 0.0 * draws[0]


def constrain(state: Entries, timestep: float) -> tuple[Values, ...]:
    """Limit the speed and the position; stop the car at the left wall."""
    # Gymnasium limits the speed before it moves the car, so the position is corrected.
    speed = np.minimum(np.maximum(state[1], -MAX_SPEED), MAX_SPEED)
    position = state[0] - (state[1] - speed) * timestep
    speed = speed - np.minimum(speed, 0.0) * (position <= MIN_POSITION)
    return np.minimum(np.maximum(position, MIN_POSITION), MAX_POSITION), speed


def observation(state: Entries) -> tuple[Values, ...]:
    """Return the state."""
    return state[0], state[1]


def terminated(state: Entries) -> Flags:
    """Return True if the car is at the flag or beyond, and not rolling back."""
    return (state[0] >= GOAL) & (state[1] >= 0.0)


def reward(state: Entries, force: Values, next_state: Entries, options: NoOptions) -> Values:
    """Return -1 for every step."""
    return -1.0


_LOW, _HIGH = np.array([[MIN_POSITION, -MAX_SPEED], [MAX_POSITION, MAX_SPEED]], dtype=np.float32)


class ReferenceEnv(GymnasiumReferenceEnv):
    """Gymnasium's `MountainCarEnv`, whose force, gravity and speed limit are attributes.

    Its step has no duration: v += force - gravity cos(3 x), x += v. With v dt in place of v, and
    with force and gravity multiplied by dt^2, it becomes a step of any duration dt.
    """

    env_id = "MountainCar-v0"

    def __init__(self, source: str = env_id, strength: str = "force") -> None:
        """Create the Gymnasium environment.

        Args:
            source: id of the environment from which the strength is taken.
            strength: name of its attribute for the acceleration per force [m/s^2 per N].
        """
        super().__init__()
        self._strength = strength
        setattr(self.env, strength, getattr(make_gymnasium_env(source), strength))

    def __call__(
        self, state: np.ndarray, force: float, timestep: float, integrator: str
    ) -> np.ndarray:
        """Take a `step` to the right, with `force` set to the acceleration of either sign."""
        # The environment has only one integrator.
        del integrator
        position, change = self.state_after(
            (state[0], state[1] * timestep),
            2,
            force=force * getattr(self.env, self._strength) * timestep**2,
            gravity=self.env.gravity * timestep**2,
            max_speed=self.env.max_speed * timestep,
        )
        return np.array([position, change / timestep])


def attributes(goal: float, strength: str) -> dict[str, Attribute]:
    """Return the attributes of a mountain car; the one named `strength` is 1/mass [1/kg]."""
    return {
        "min_position": Fixed(MIN_POSITION),
        "max_position": Fixed(MAX_POSITION),
        "max_speed": Fixed(MAX_SPEED),
        "goal_position": Fixed(goal),
        "goal_velocity": Fixed(0.0),
        strength: mass("car", inverse=True),
    }


TASK = Task(
    name="mountain_car",
    env_id="codrl_mj/MountainCar-v0",
    max_episode_steps=200,
    reward_threshold=-110.0,
    agent="sarsa",
    gymnasium_id="MountainCar-v0",
    reference_env=ReferenceEnv,
    asset="mountain_car.xml",
    step_duration=1.0,
    motor_inner_steps=20,
    max_force=FORCE,
    forces=(-FORCE, 0.0, FORCE),
    render_fps=30,
    integrators=("semi-implicit",),
    state_names=("x [m]", "x_dot [m/s]"),
    observation_names=("position", "velocity"),
    observation_space=spaces.Box(_LOW, _HIGH, dtype=np.float32),
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    constrain=constrain,
    goal=terminated,
    # The gains and the arm are from the paper, Experimental Results; R, L, kT, kE are the defaults.
    paper=(DCMotorActuator(Motor(), CurrentLoop(kp=1.0, ki=1.0, kd=1e-2)),),
    attributes={**attributes(GOAL, "force"), "gravity": ModelNumber("jnt_user", "slider", 2)},
    reference_states=ReferenceStates(
        bounds=(1.2, MAX_SPEED),
        edges=(
            (-1.2, -1.2 + 1e-9, -1.19, -0.5, 0.0, 0.5, 0.59, 0.6),
            (*values_around(MAX_SPEED), 1e-9, -1e-9, 0.0),
        ),
        # This run stays between the walls and below 0.07 m/s.
        start=(-0.5, 0.02),
        steps=12,
        balanced_steps=2,
    ),
)
