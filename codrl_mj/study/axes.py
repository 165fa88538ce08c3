"""Axes of the study, each one effect of an actuator, and arms trained and tested on them.

A severity is a dimensionless number with the same meaning on every task: times in policy steps,
forces in shares of the task's largest force, supplies in shares of the voltage that the task needs.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from codrl_mj.actuators import (
    IDEAL,
    ActuatorSetting,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    Lag,
    Motor,
    SampledLoop,
    Supply,
)
from codrl_mj.actuators.lag import HISTORY
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.boundary import Argument
from codrl_mj.disturbances import Disturbances, Joint
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import command
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
"""Task -> approximate time of a training [s of one core]; the keys are the study's tasks."""
BUDGETS: Mapping[str, int] = {"pendulum": 160_000}
"""Task -> environment steps of a training, if the agent's default is too short for some seeds."""
FLOORS: Mapping[str, float] = {
    "pendulum": -1223.0,
    "cartpole": 17.8,
    "acrobot": -499.8,
    "furuta": 3.1,
    "mountain_car": -200.0,
    "mountain_car_continuous": -32.9,
}
"""Task -> lower end of the span: mean return of random actions on ideal forces, 300 episodes."""
CENTER_RADIUS = 0.1
"""Distance from the center within which the paper's CartPole is rewarded [m]."""

REFERENCE_SPEEDS: Mapping[str, float] = {
    "pendulum": 6.0,
    "cartpole": 1.0,
    "acrobot": 8.0,
    "furuta": 15.0,
    "mountain_car": 0.05,
    "mountain_car_continuous": 0.05,
}
"""Task -> speed [rad/s or m/s] of the actuated joint at which a motor must still deliver force."""


def study_env(task: str, actuator: ActuatorSetting = IDEAL, **fields: Argument) -> EnvConfig:
    """Return a task's environment for the study, with >= 10 integration steps per policy step.

    Ideal and real actuators share the integration step, so that only the actuator differs.
    """
    # CartPole uses the paper's reward: with Gymnasium's, nearly every policy reaches the maximum
    # and differences disappear.
    options = {"center_radius": CENTER_RADIUS} if task == "cartpole" else {}
    return EnvConfig(task, actuator, timestep=timestep(task), options=options, **fields)


def timestep(task: str) -> float:
    """Return the integration step [s] of the study's environments of a task."""
    return find_task(task).step_duration / max(find_task(task).motor_inner_steps, 10)


def lag(task: str, severity: float) -> EnvConfig:
    """Return the task with a first-order lag; the severity is its time constant [policy steps]."""
    return study_env(task, Lag(severity * find_task(task).step_duration))


def weakness(task: str, severity: float) -> EnvConfig:
    """Return the task with a weaker actuator; the severity is the missing share of the force."""
    return study_env(task, Lag(0.0, gain=1.0 - severity))


def delay(task: str, severity: float) -> EnvConfig:
    """Return the task with delayed commands; the severity is the delay [policy steps]."""
    return study_env(
        task, disturbances=Disturbances(command_delay=severity * find_task(task).step_duration)
    )


def friction(task: str, severity: float) -> EnvConfig:
    """Return the task with Coulomb friction in the joint, as a share of the largest force."""
    return study_env(task, joint=Joint(friction=severity * find_task(task).max_force))


def motor_constant(task: str) -> float:
    """Return the torque constant [N*m/A] of the 1 ohm motor with the lowest voltage for a task.

    For the largest force F at the reference speed w, u = F/k + k*w is minimal at k = sqrt(F/w),
    where both terms are equal.
    """
    return math.sqrt(find_task(task).max_force / REFERENCE_SPEEDS[task])


def needed_voltage(task: str) -> float:
    """Return the voltage [V] that a motor with `motor_constant` needs at F and w: 2*sqrt(F*w)."""
    return 2.0 * math.sqrt(find_task(task).max_force * REFERENCE_SPEEDS[task])


def drive_on_supply(task: str, volts: float) -> Drive:
    """Return a drive with a 1 ohm motor, a loop faster than the integration step, and a supply."""
    step, constant = timestep(task), motor_constant(task)
    motor = GearMotor(1.0, step / 20.0, constant, constant, rotor_inertia=0.0)
    loop = SampledLoop(sample_rate=20.0 / step, max_current=find_task(task).max_force / constant)
    return Drive(motor, loop, Supply(volts))


def supply(task: str, severity: float) -> EnvConfig:
    """Return the task with a drive on a low supply; the severity is the missing voltage share."""
    return study_env(task, drive_on_supply(task, (1.0 - severity) * needed_voltage(task)))


def noise(task: str, severity: float) -> EnvConfig:
    """Return the task with a noisy current sensor.

    The severity is the standard deviation of the noise, as a share of the largest current.
    The winding's time constant is ten integration steps and the loop halves the error in one step,
    so half of each noise sample becomes torque.
    """
    step, constant = timestep(task), motor_constant(task)
    inductance, largest = 10.0 * step, find_task(task).max_force / constant
    kp = 0.5 * inductance / step
    loop = CurrentLoop(
        kp=kp,
        ki=kp / inductance,
        max_voltage=100.0 * needed_voltage(task),
        current_noise=severity * largest,
    )
    return study_env(task, DCMotorActuator(Motor(1.0, inductance, constant, constant), loop))


_LOOPS = {"weaker": "weaker", "paper": "paper"}
REAL: Mapping[str, Mapping[str, FieldValue]] = {
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
"""Task -> name of arm and test -> drive. `marginal motor` is a motor that `codrl-mj motor choose`
judges `try it`, because it misses a bound; there is none for Mountain Car. The others are the
paper's motor with two current loops.
"""


@dataclasses.dataclass(frozen=True)
class Axis:
    """One effect of an actuator on a command, with its tested severities."""

    title: str
    """Title in tables and figures."""
    unit: str
    """Unit of the severity."""
    severities: tuple[float, ...]
    """Six tested severities; the first is 0."""
    training_severity: Mapping[str, float]
    """Task -> severity in training, chosen in a pilot study or by the rule of the study's plan."""
    make_env: Callable[[str, float], EnvConfig]
    """Function (task, severity) -> environment."""
    motor_at_zero: bool = False
    """True if the test at severity 0 has a motor without the effect, instead of ideal forces."""


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
        motor_at_zero=True,
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
        motor_at_zero=True,
    ),
}
"""The axes by name."""


def make_arm(task: str, name: str, env: EnvConfig) -> Arm:
    """Return the arm that trains a task's agent, with default settings, in an environment."""
    agent = "sarsa" if task == "mountain_car" else "ppo"
    changes: dict[str, Argument] = {"total_steps": BUDGETS[task]} if task in BUDGETS else {}
    base = TrainConfig.preset(task, agent, **changes)
    # Evaluations and checkpoints during training would only cost time.
    never = 10**9
    config = dataclasses.replace(
        base, env=env, evaluation_interval=never, checkpoint_interval=never
    )
    return Arm(f"{task}: {name}", config, SECONDS[task])


@functools.cache
def ideal_arm(task: str) -> Arm:
    """Return the arm trained on ideal forces."""
    return make_arm(task, "ideal", study_env(task))


class RandomRanges(NamedTuple):
    """Ranges of random actuators, from which a lag is drawn for every episode.

    Time constant and delay lie between 0 and `lag` or `delay` [policy steps], the delivered share
    of the commanded force between `weakest` and `strongest`.
    """

    lag: float
    weakest: float
    strongest: float
    delay: float


RANDOM_RANGES: Mapping[str, RandomRanges] = {
    "pendulum": RandomRanges(1.0, 0.9, 1.1, 1.0),
    "furuta": RandomRanges(0.5, 0.8, 1.2, 0.5),
    "acrobot": RandomRanges(2.0, 0.8, 1.2, 2.0),
}
"""Task -> ranges of the arm `random` of the second study (docs/results/insurance_plan.md)."""


def generic_ranges(task: str) -> RandomRanges:
    """Return the ranges of the arm `generic` of the first study, a common practice."""
    longest_delay = HISTORY * timestep(task) / find_task(task).step_duration
    return RandomRanges(2.0, 0.5, 1.25, longest_delay)


def random_ranges(task: str) -> RandomRanges:
    """Return the ranges that are recommended and measured on a built-in task: the latest tested."""
    return RANDOM_RANGES.get(task, generic_ranges(task))


def random_arm(base: Arm, ranges: RandomRanges) -> Arm:
    """Return the arm trained on random actuators and pushes, from one on a built-in task."""
    env, step = base.config.env, find_task(base.task).step_duration
    drawn = (
        f"time_constant=uniform(0, {ranges.lag * step:g})",
        f"delay=uniform(0, {ranges.delay * step:g})",
        f"gain=uniform({ranges.weakest:g}, {ranges.strongest:g})",
    )
    pulse = 0.25 * find_task(base.task).max_force
    pushes = Disturbances(pulse_force=pulse, pulse_duration=step, pulse_interval=10 * step)
    randomized = dataclasses.replace(env, actuator=Lag(), randomize=drawn, disturbances=pushes)
    # A lag stores the commands of a few integration steps only: long delays need long steps.
    shortest = ranges.delay * step / HISTORY
    if shortest > 1.001 * (env.timestep or timestep(base.task)):
        randomized = dataclasses.replace(randomized, timestep=shortest)
    config = dataclasses.replace(base.config, env=randomized)
    return dataclasses.replace(base, name=f"{base.task}: generic", config=config)


def random_training(task: str) -> str:
    """Return the command that trains as in the studies on the actuators of `random_ranges`."""
    config = random_arm(ideal_arm(task), random_ranges(task)).config
    env, pushes = config.env, config.env.disturbances
    budget = [] if config.total_steps is None else ["--total-steps", config.total_steps]
    return command(
        *("train", task, "--agent", config.agent.name, *budget),
        *("--actuator", "lag", "--env.timestep", f"{env.timestep:g}"),
        *("--env.randomize", *(env.randomize or ())),
        *("--env.disturbances.pulse-force", f"{pushes.pulse_force:g}"),
        *("--env.disturbances.pulse-duration", f"{pushes.pulse_duration:g}"),
        *("--env.disturbances.pulse-interval", f"{pushes.pulse_interval:g}"),
        *("--out", "runs/random"),
    )


def ideal_trial(arm: Arm) -> Trial:
    """Return the test of an arm's policies on ideal forces."""
    return Trial(arm, "ideal", study_env(arm.task))
