"""What stands between a command and its force, in doses: one thing at a time; and policies trained and tested on it.

Every dose is a pure number that means the same on every task: times in steps of the policy, forces
in shares of the task's largest one, supplies in shares of what the task's motor needs.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

from codrl_mj.actuators import (
    IDEAL,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    Lag,
    Motor,
    SampledLoop,
    Supply,
)
from codrl_mj.disturbances import Disturbances, Joint
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig

SECONDS: Mapping[str, float] = {
    "pendulum": 22.0,
    "cartpole": 11.0,
    "acrobot": 35.0,
    "furuta": 40.0,
    "mountain_car": 4.0,
    "mountain_car_continuous": 25.0,
}
"""Task -> a training's computing time [s of one core], about. The tasks of the study."""
BUDGETS: Mapping[str, int] = {"pendulum": 160_000}
"""Task -> environment steps of a training, where the agent's default budget leaves some seeds short."""
FLOORS: Mapping[str, float] = {
    "pendulum": -1223.0,
    "cartpole": 17.8,
    "acrobot": -499.8,
    "furuta": 3.1,
    "mountain_car": -200.0,
    "mountain_car_continuous": -32.9,
}
"""Task -> mean return of random actions on ideal forces, over 300 episodes: the lower end of the task's span."""
CENTRE_RADIUS = 0.1
"""How near to the centre the paper's CartPole is rewarded [m]."""

REFERENCE_SPEEDS: Mapping[str, float] = {
    "pendulum": 6.0,
    "cartpole": 1.0,
    "acrobot": 8.0,
    "furuta": 15.0,
    "mountain_car": 0.05,
    "mountain_car_continuous": 0.05,
}
"""Task -> speed [rad/s or m/s] of the actuated joint that a motor for it must still push at."""


def posed(task: str, actuator: Any = IDEAL, **fields: Any) -> EnvConfig:
    """The task as every arm and test of the study has it: at least ten integration steps to a step of the policy.

    Ideal and real actuators are integrated alike, so that the actuator alone makes the difference.
    """
    # CartPole by the paper's reward: by Gymnasium's nearly every policy is at the ceiling, and
    # nothing told apart
    options = {"center_radius": CENTRE_RADIUS} if task == "cartpole" else {}
    return EnvConfig(task, actuator, timestep=timestep(task), options=options, **fields)


def timestep(task: str) -> float:
    """Integration step [s] of the study's environments of a task."""
    return find_task(task).step_duration / max(find_task(task).motor_inner_steps, 10)


def lag(task: str, dose: float) -> EnvConfig:
    """A time constant of so many steps of the policy, and nothing lost in the end."""
    return posed(task, Lag(dose * find_task(task).step_duration))


def weakness(task: str, dose: float) -> EnvConfig:
    """Forces that come short by a share, at once."""
    return posed(task, Lag(0.0, gain=1.0 - dose))


def delay(task: str, dose: float) -> EnvConfig:
    """Commands that come so many steps of the policy late."""
    return posed(
        task, disturbances=Disturbances(command_delay=dose * find_task(task).step_duration)
    )


def friction(task: str, dose: float) -> EnvConfig:
    """Coulomb friction in the actuated joint, in shares of the largest force."""
    return posed(task, joint=Joint(friction=dose * find_task(task).max_force))


def motor_constant(task: str) -> float:
    """Torque constant [N*m/A] of a motor of 1 ohm that asks for the least voltage at the task's reference point.

    Largest force F at the reference speed w: u = F/k + k*w is least for k = sqrt(F/w), where both
    terms are equal.
    """
    return math.sqrt(find_task(task).max_force / REFERENCE_SPEEDS[task])


def needed_voltage(task: str) -> float:
    """Voltage [V] that this motor takes for the largest force at the reference speed: 2*sqrt(F*w)."""
    return 2.0 * math.sqrt(find_task(task).max_force * REFERENCE_SPEEDS[task])


def supplied(task: str, volts: float) -> Drive:
    """A motor of 1 ohm whose loop settles in a fraction of an integration step, on a supply."""
    step, constant = timestep(task), motor_constant(task)
    motor = GearMotor(1.0, step / 20.0, constant, constant, rotor_inertia=0.0)
    loop = SampledLoop(sample_rate=20.0 / step, max_current=find_task(task).max_force / constant)
    return Drive(motor, loop, Supply(volts))


def supply(task: str, dose: float) -> EnvConfig:
    """A drive with anti-windup and a current limit, on a supply that comes short by a share of what is needed."""
    return posed(task, supplied(task, (1.0 - dose) * needed_voltage(task)))


def noise(task: str, dose: float) -> EnvConfig:
    """A loop whose current sensor is noisy, with a standard deviation in shares of the largest current.

    The winding's time constant is ten integration steps and half the error is gone after one, so
    that half of a sample's noise becomes torque.
    """
    step, constant = timestep(task), motor_constant(task)
    inductance, largest = 10.0 * step, find_task(task).max_force / constant
    kp = 0.5 * inductance / step
    loop = CurrentLoop(
        kp=kp,
        ki=kp / inductance,
        max_voltage=100.0 * needed_voltage(task),
        current_noise=dose * largest,
    )
    return posed(task, DCMotorActuator(Motor(1.0, inductance, constant, constant), loop))


_LOOPS = {"weaker": "weaker", "paper": "paper"}
REAL: Mapping[str, Mapping[str, Any]] = {
    "pendulum": {
        "marginal motor": {"name": "quanser-srv02", "motor": {"gear_ratio": 70.0}},
        **_LOOPS,
    },
    "cartpole": {
        "marginal motor": {"name": "lego-ev3-large", "motor": {"gear_ratio": 44.2}},
        **_LOOPS,
    },
    "acrobot": {"marginal motor": {"name": "pololu-37d-30", "motor": {"gear_ratio": 30.0}}},
    "furuta": {
        "marginal motor": {
            "name": "quanser-qube-servo-2",
            "motor": {"gear_ratio": 1.0},
            "supply": {"voltage": 6.0},
        }
    },
}
"""Task -> drives that policies were trained through, each by the name of its arm and of its test: a
motor that `codrl-mj motor choose` calls `try it`, for some bound says that it does not suffice (on
the cars there is none), and the paper's under two loops.
"""


@dataclasses.dataclass(frozen=True)
class Axis:
    """One thing that an actuator may do to a command."""

    title: str
    """What it is."""
    unit: str
    """What its doses are in."""
    doses: tuple[float, ...]
    """Six of them, the first is none."""
    trained: Mapping[str, float]
    """Task -> the one of them that is trained through, chosen before: in a pilot with others, or by a plan's rule."""
    at: Callable[[str, float], EnvConfig]
    """(task, dose) -> the environment."""
    own_motor: bool = False
    """Whether the first dose, too, is a motor of its own, and not ideal forces."""


AXES: Mapping[str, Axis] = {
    "lag": Axis(
        "Lag",
        "time constant [policy steps]",
        (0.0, 0.25, 0.5, 1.0, 2.0, 4.0),
        {"pendulum": 2.0, "furuta": 0.5, "acrobot": 2.0},
        lag,
    ),
    "weakness": Axis(
        "Weakness",
        "missing share of the force",
        (0.0, 0.1, 0.25, 0.4, 0.55, 0.7),
        {"pendulum": 0.25, "furuta": 0.55, "acrobot": 0.4},
        weakness,
    ),
    "supply": Axis(
        "Supply",
        "missing share of the voltage",
        (0.0, 0.2, 0.35, 0.5, 0.6, 0.7),
        {"pendulum": 0.35, "furuta": 0.6, "acrobot": 0.5},
        supply,
        own_motor=True,
    ),
    "delay": Axis(
        "Delay",
        "delay [policy steps]",
        (0.0, 0.5, 1.0, 2.0, 3.0, 4.0),
        {"pendulum": 2.0, "furuta": 0.5, "acrobot": 3.0},
        delay,
    ),
    "friction": Axis(
        "Friction",
        "Coulomb friction [largest force]",
        (0.0, 0.02, 0.05, 0.1, 0.2, 0.3),
        {"pendulum": 0.1, "furuta": 0.2, "acrobot": 0.3},
        friction,
    ),
    "noise": Axis(
        "Noise",
        "current noise [largest current]",
        (0.0, 0.1, 0.2, 0.4, 0.8, 1.6),
        {"pendulum": 0.8, "furuta": 0.8, "acrobot": 1.6},
        noise,
        own_motor=True,
    ),
}
"""The axes by name."""


def arm(task: str, name: str, env: EnvConfig) -> Arm:
    """The arm of the task's agent in an environment: default settings, and nothing is evaluated on the way."""
    agent = "sarsa" if task == "mountain_car" else "ppo"
    changes: dict[str, Any] = {"total_steps": BUDGETS[task]} if task in BUDGETS else {}
    base = TrainConfig.preset(task, agent, **changes)
    never = 10**9
    config = dataclasses.replace(
        base, env=env, evaluation_interval=never, checkpoint_interval=never
    )
    return Arm(f"{task}: {name}", config, SECONDS[task])


@functools.cache
def ideal(task: str) -> Arm:
    """Trained on forces that come as they are asked for."""
    return arm(task, "ideal", posed(task))


def generic(base: Arm) -> Arm:
    """Trained without a model of the motor, as is common: random strength, lag, delay, and random pushes.

    Args:
        base: the arm of a task of ours on ideal forces, of which all else is kept.
    """
    env, definition = base.config.env, find_task(base.task)
    step, pulse = definition.step_duration, 0.25 * definition.max_force
    ranges = (
        f"time_constant=uniform(0, {2 * step:g})",
        f"delay=uniform(0, {8 * timestep(base.task):g})",
    )
    pushes = Disturbances(pulse_force=pulse, pulse_duration=step, pulse_interval=10 * step)
    randomized = dataclasses.replace(
        env, actuator=Lag(), randomize=(*ranges, "gain=uniform(0.5, 1.25)"), disturbances=pushes
    )
    config = dataclasses.replace(base.config, env=randomized)
    return dataclasses.replace(base, name=f"{base.task}: generic", config=config)


def at_home(arm: Arm) -> Trial:
    """Policies tested on ideal forces."""
    return Trial(arm, "ideal", posed(arm.task))
