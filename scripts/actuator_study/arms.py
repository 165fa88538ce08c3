"""Who is trained on what, in the study of what an actuator costs. docs/results/plan.md has the reasons."""

import dataclasses
import functools
from typing import Any

from codrl_mj.actuators import Drive
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.bench import drive_with_designed_loop
from codrl_mj.study.axes import AXES, REAL, arm, ideal_trial
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import named_actuator

TRAINED = ("pendulum", "furuta")
"""The tasks on which doses are trained through: those whose score every dose moves, and that have
no ceiling nearby. (CartPole's is reached by ideal-trained policies under every dose but lag and
delay.)
"""
LOOPED = ("pendulum", "cartpole")
"""The tasks on which loops around the paper's motor are compared."""
DRAWN = ("lag", "weakness", "supply", "noise")
"""The axes that can be drawn anew for every episode; delay and friction are none of an actuator's numbers."""
GOOD: dict[str, dict[str, Any]] = {
    "pendulum": {"name": "maxon-dcx22l", "motor": {"gear_ratio": 59.0}},
    "cartpole": {"name": "maxon-dcx22l", "motor": {"gear_ratio": 605.0}},
    "acrobot": {"name": "cubemars-ak80-6", "motor": {"gear_ratio": 6.0}},
    "furuta": {"name": "quanser-qube-servo-2", "motor": {"gear_ratio": 1.0}},
    "mountain_car": {"name": "faulhaber-1331-006", "motor": {"gear_ratio": 1039.0}},
    "mountain_car_continuous": {"name": "faulhaber-1331-006", "motor": {"gear_ratio": 1038.0}},
}
"""Task -> the smallest motor of the catalogue that `codrl-mj motor choose` finds sufficient, with its gear."""
MARGINAL: dict[str, dict[str, Any]] = {
    task: known["marginal motor"] for task, known in REAL.items()
}
"""Task -> a motor that it calls `try it`."""


def otherwise(env: EnvConfig, **fields: Any) -> EnvConfig:
    """An environment whose actuator is otherwise in some fields of its parts, such as motor__resistance."""
    changes = {name.replace("__", "."): value for name, value in fields.items()}
    return dataclasses.replace(env, actuator=env.actuator.replaced(changes))


@functools.cache
def drawn(task: str, axis: str, trained: float | None = None) -> Arm:
    """Trained on doses that are drawn anew for every episode, evenly from none to `drawn_up_to`.

    `trained` is the dose that others are trained through, where it is not the axis' own.
    """
    most = AXES[axis].make_env(
        task, drawn_up_to(axis, AXES[axis].training_severity[task] if trained is None else trained)
    )
    none, actuator = AXES[axis].make_env(task, 0.0).actuator, most.actuator
    text = {
        "lag": lambda: f"time_constant=uniform(0, {actuator.time_constant:g})",
        "weakness": lambda: f"gain=uniform({actuator.gain:g}, 1)",
        "supply": lambda: (
            f"supply.voltage=uniform({actuator.supply.voltage:g}, {none.supply.voltage:g})"
        ),
        "noise": lambda: (
            f"controller.current_noise=uniform(0, {actuator.controller.current_noise:g})"
        ),
    }[axis]()
    return arm(task, f"{axis}, drawn", dataclasses.replace(most, randomize=(text,)))


def drawn_up_to(axis: str, trained: float) -> float:
    """The largest dose that is drawn: twice the one that others are trained through, or the largest that is tested."""
    return min(2.0 * trained, AXES[axis].severities[-1])


def designed(task: str) -> Drive:
    """The paper's motor and supply under a designed loop."""
    return drive_with_designed_loop(named_actuator("paper", task), task)


@functools.cache
def matched(task: str, axis: str) -> Arm:
    """Trained through one dose of one thing."""
    return arm(task, axis, AXES[axis].make_env(task, AXES[axis].training_severity[task]))


def dosed(arm: Arm, axis: str, dose: float) -> Trial:
    """Policies tested on a dose."""
    return Trial(arm, f"{axis} {dose:g}", AXES[axis].make_env(arm.task, dose))


def undosed(arm: Arm, axis: str) -> Trial:
    """Policies tested on none of it: on ideal forces, or on the axis' motor."""
    return dosed(arm, axis, 0.0) if AXES[axis].motor_at_zero else ideal_trial(arm)
