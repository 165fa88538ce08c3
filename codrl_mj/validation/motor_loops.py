"""The current loops that are checked, and a way to run one in MuJoCo on a rotor at a held speed."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from codrl_mj.tasks import OURS
from codrl_mj.validation.rotors import HELD, Record, drive, motors_on


class Loop(NamedTuple):
    """A motor under its current loop, and the step at which it is sampled."""

    actuator: Actuator
    """Motor and gains."""
    timestep: float
    """Mechanical step [s]."""


EVERY_FEATURE = Loop(
    Actuator(
        Motor(resistance=1.2, inductance=0.05, torque_constant=0.8, back_emf_constant=0.7, arm_radius=0.5),
        CurrentLoop(
            kp=2.0,
            ki=5.0,
            kd=1e-3,
            kff=0.4,
            bemf_compensation=False,
            substeps=2,
            integral_leak=0.3,
            derivative_time_constant=0.01,
        ),
    ),
    0.01,
)
"""A loop in which every parameter counts; nothing hides its back-EMF."""


def standard_loops() -> dict[str, Loop]:
    """The paper's loop of each of our tasks at the task's inner step, and one with every feature."""
    paper = {task.name: Loop(task.paper[0], task.step_duration / task.motor_inner_steps) for task in OURS}
    return {**paper, "every feature": EVERY_FEATURE}


def unlimited(loop: Loop, substeps: int) -> Actuator:
    """The loop's actuator where it is linear: without limit and sensor errors, with so many electrical substeps."""
    controller = dataclasses.replace(
        loop.actuator.controller, substeps=substeps, max_voltage=math.inf, current_bias=0.0, current_noise=0.0
    )
    return dataclasses.replace(loop.actuator, controller=controller, supply=None)


def run(actuator: Actuator, timestep: float, torques: np.ndarray, speeds: np.ndarray) -> Record:
    """Drive one motor in MuJoCo with desired joint torques at joint speeds."""
    return drive(motors_on(HELD, [actuator], timestep), torques * actuator.motor.arm_radius, speeds)
