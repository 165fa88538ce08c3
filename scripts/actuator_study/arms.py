"""Training arms of the study of the cost of an actuator; docs/results/plan.md gives the reasons."""

import dataclasses
import functools
from typing import Any

from codrl_mj.actuators import Drive
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import AXES, REAL, ideal_trial, make_arm
from codrl_mj.study.bench import drive_with_designed_loop
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import named_actuator

TRAINED = ("pendulum", "furuta")
"""Tasks with policies trained at a severity: all axes change their scores, far from a ceiling.

CartPole's ceiling is reached by ideal-trained policies under every severity but lag and delay.
"""
LOOPED = ("pendulum", "cartpole")
"""Tasks on which current loops around the paper's motor are compared."""
DRAWN = ("lag", "weakness", "supply", "noise")
"""Axes that can be randomized per episode; delay and friction are not fields of an actuator."""
GOOD: dict[str, dict[str, Any]] = {
    "pendulum": {"name": "maxon-dcx22l", "motor": {"gear_ratio": 59.0}},
    "cartpole": {"name": "maxon-dcx22l", "motor": {"gear_ratio": 605.0}},
    "acrobot": {"name": "cubemars-ak80-6", "motor": {"gear_ratio": 6.0}},
    "furuta": {"name": "quanser-qube-servo-2", "motor": {"gear_ratio": 1.0}},
    "mountain_car": {"name": "faulhaber-1331-006", "motor": {"gear_ratio": 1039.0}},
    "mountain_car_continuous": {"name": "faulhaber-1331-006", "motor": {"gear_ratio": 1038.0}},
}
"""Task -> smallest motor, with gear, that `codrl-mj motor choose` finds sufficient."""
MARGINAL: dict[str, dict[str, Any]] = {
    task: known["marginal motor"] for task, known in REAL.items()
}
"""Task -> motor for which `codrl-mj motor choose` answers `try it`."""


def with_fields(env: EnvConfig, **fields: Any) -> EnvConfig:
    """Return an environment with other values of actuator fields, such as motor__resistance=1.0."""
    changes = {name.replace("__", "."): value for name, value in fields.items()}
    return dataclasses.replace(env, actuator=env.actuator.replaced(changes))


@functools.cache
def drawn(task: str, axis: str, trained: float | None = None) -> Arm:
    """Return the arm trained on severities drawn per episode, uniformly from none to `drawn_up_to`.

    Args:
        task: task name.
        axis: axis of the severities.
        trained: severity of the `matched` arm, half of the largest one drawn; None: the axis' own.
    """
    largest_env = AXES[axis].make_env(
        task, drawn_up_to(axis, AXES[axis].training_severity[task] if trained is None else trained)
    )
    zero_env, actuator = AXES[axis].make_env(task, 0.0).actuator, largest_env.actuator
    text = {
        "lag": lambda: f"time_constant=uniform(0, {actuator.time_constant:g})",
        "weakness": lambda: f"gain=uniform({actuator.gain:g}, 1)",
        "supply": lambda: (
            f"supply.voltage=uniform({actuator.supply.voltage:g}, {zero_env.supply.voltage:g})"
        ),
        "noise": lambda: (
            f"controller.current_noise=uniform(0, {actuator.controller.current_noise:g})"
        ),
    }[axis]()
    return make_arm(task, f"{axis}, drawn", dataclasses.replace(largest_env, randomize=(text,)))


def drawn_up_to(axis: str, trained: float) -> float:
    """Return the largest drawn severity: twice the trained one, at most the largest tested one."""
    return min(2.0 * trained, AXES[axis].severities[-1])


def designed(task: str) -> Drive:
    """Return the paper's motor and supply with a designed current loop."""
    return drive_with_designed_loop(named_actuator("paper", task), task)


@functools.cache
def matched(task: str, axis: str) -> Arm:
    """Return the arm trained at a fixed severity of one axis."""
    return make_arm(task, axis, AXES[axis].make_env(task, AXES[axis].training_severity[task]))


def trial_at(arm: Arm, axis: str, severity: float) -> Trial:
    """Return the test of an arm's policies at a severity."""
    return Trial(arm, f"{axis} {severity:g}", AXES[axis].make_env(arm.task, severity))


def trial_at_zero(arm: Arm, axis: str) -> Trial:
    """Return the test of an arm's policies at severity 0: on ideal forces or the axis' motor."""
    return trial_at(arm, axis, 0.0) if AXES[axis].motor_at_zero else ideal_trial(arm)
