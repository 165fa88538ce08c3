"""Who is trained on what, in the study of what an actuator costs. docs/results/plan.md has the reasons."""

import dataclasses
from typing import Any

from codrl_mj.actuators import Drive, Lag
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.advice import redesigned
from codrl_mj.study.doses import AXES, arm, posed, timestep
from codrl_mj.study.trials import Arm
from codrl_mj.tasks import find_task, named_actuator

TRAINED = ("pendulum", "furuta")
"""The tasks on which doses are trained through: those whose score every dose moves, and that have no ceiling nearby.
(CartPole's is reached by ideal-trained policies under every dose but lag and delay.)"""
LOOPED = ("pendulum", "cartpole")
"""The tasks on which loops around the paper's motor are compared."""
DRAWN = ("lag", "weakness", "supply", "noise")
"""The axes that can be drawn anew for every episode; delay and friction are none of an actuator's numbers."""
GOOD: dict[str, dict[str, Any]] = {
    "pendulum": {"name": "maxon-dcx22l", "gear": 59.0},
    "cartpole": {"name": "maxon-dcx22l", "gear": 605.0},
    "acrobot": {"name": "cubemars-ak80-6", "gear": 6.0},
    "furuta": {"name": "quanser-qube-servo-2", "gear": 1.0},
    "mountain_car": {"name": "faulhaber-1331-006", "gear": 1039.0},
    "mountain_car_continuous": {"name": "faulhaber-1331-006", "gear": 1038.0},
}
"""Task -> the smallest motor of the catalogue that `codrl-mj motor choose` finds sufficient, with its gear."""
MARGINAL: dict[str, dict[str, Any]] = {
    "pendulum": {"name": "quanser-srv02", "gear": 70.0},
    "cartpole": {"name": "lego-ev3-large", "gear": 44.2},
    "acrobot": {"name": "pololu-37d-30", "gear": 30.0},
    "furuta": {"name": "quanser-qube-servo-2", "gear": 1.0, "voltage": 6.0},
}
"""Task -> a motor that it calls `try it`: some bound says that it does not suffice. On the cars there is none."""


def drawn(task: str, axis: str) -> Arm:
    """Trained on doses that are drawn anew for every episode, evenly from none to `drawn_up_to`."""
    most = AXES[axis].at(task, drawn_up_to(task, axis))
    none, actuator = AXES[axis].at(task, 0.0).actuator, most.actuator
    text = {
        "lag": lambda: f"time_constant=uniform(0, {actuator.time_constant:g})",
        "weakness": lambda: f"gain=uniform({actuator.gain:g}, 1)",
        "supply": lambda: f"supply.voltage=uniform({actuator.supply.voltage:g}, {none.supply.voltage:g})",
        "noise": lambda: f"controller.current_noise=uniform(0, {actuator.controller.current_noise:g})",
    }[axis]()
    return arm(task, f"{axis}, drawn", dataclasses.replace(most, randomize=(text,)))


def drawn_up_to(task: str, axis: str) -> float:
    """The largest dose that is drawn: twice the one that others are trained through, or the largest that is tested."""
    return min(2.0 * AXES[axis].trained[task], AXES[axis].doses[-1])


def generic(task: str) -> Arm:
    """Trained without any model of a motor, as is common: random strength, lag and delay, and random pushes."""
    definition = find_task(task)
    step, pulse = definition.step_duration, 0.25 * definition.max_force

    return arm(
        task,
        "generic",
        posed(
            task,
            Lag(),
            randomize=(
                f"time_constant=uniform(0, {2 * step:g})",
                f"delay=uniform(0, {8 * timestep(task):g})",
                "gain=uniform(0.5, 1.25)",
            ),
            disturbances=Disturbances(pulse_force=pulse, pulse_duration=step, pulse_interval=10 * step),
        ),
    )


def designed(task: str) -> Drive:
    """The paper's motor and supply under a designed loop."""
    return redesigned(named_actuator("paper", task), task)


def motor(task: str, chosen: dict[str, Any]) -> EnvConfig:
    """A motor of the catalogue under the drive that it gets there, at a gear, on its nominal or another voltage."""
    named = {"name": chosen["name"], "motor": {"gear_ratio": chosen["gear"]}}
    if "voltage" in chosen:
        named["supply"] = {"voltage": chosen["voltage"]}
    return posed(task, named)
