"""The bench: small MuJoCo models of motors, ours and MuJoCo's own, current loops to try, and a way to drive them."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, Motor
from codrl_mj.engine.families import signals_at, slot_size
from codrl_mj.physics import install_callbacks, mjcf
from codrl_mj.tasks import OURS


@dataclasses.dataclass(frozen=True)
class Rotor:
    """What a motor turns in a test of it."""

    name: str
    """Its name in reports."""
    inertia: float
    """About the joint's axis, without the eccentric mass [kg*m^2]."""
    eccentric: bool = False
    """Whether 0.5 kg hang 0.2 m off the axis, under gravity."""


HELD = Rotor("locked rotor", 1e15)
"""Keeps its speed, whatever the torque: 1 N*m over 100 s changes it by 1e-13 rad/s."""
FREE = Rotor("free spinning", 0.2)
"""A rotor and nothing else."""
SWINGING = Rotor("swinging load", 0.2, eccentric=True)
"""A rotor with a bob, under gravity."""


_BODY_INERTIA = 0.01  # kg*m^2, part of the rotor's


class Record(NamedTuple):
    """What was seen after each step, shape (steps, motors)."""

    angle: np.ndarray
    """Joint angles [rad]."""
    speed: np.ndarray
    """Joint speeds [rad/s]."""
    current: np.ndarray
    """Motor currents [A]."""
    torque: np.ndarray
    """Torques that the engine applied to the joints *during* the step [N*m], its `qfrc_actuator`."""


def motors_on(
    rotor: Rotor,
    motors: Sequence[ActuatorModel | Motor],
    timestep: float,
    integrator: str = "Euler",
) -> mujoco.MjModel:
    """Motors, each on a rotor of its own: ours, with the callbacks installed, or MuJoCo's `<dcmotor>` of a winding.

    Where a `Motor` is given in the place of an actuator, it is MuJoCo's, and its control is the
    terminal voltage [V].
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    for index, motor in enumerate(motors):
        body = spec.worldbody.add_body(name=f"rotor{index}")
        body.explicitinertial = True
        body.mass, body.inertia = 0.5, [_BODY_INERTIA] * 3
        body.ipos = [0.0, 0.0, -0.2 if rotor.eccentric else 0.0]
        body.add_joint(name=f"hinge{index}", axis=[0, 1, 0], armature=rotor.inertia - _BODY_INERTIA)
        driver = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"hinge{index}")
        if isinstance(motor, Motor):
            driver.set_to_dcmotor(
                motorconst=[motor.torque_constant, motor.back_emf_constant],
                resistance=motor.resistance,
                inductance=[motor.inductance, 0.0],
                ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
            )
        else:
            mjcf.configure_actuator(driver, motor, None)
    model = spec.compile()
    if not all(isinstance(motor, Motor) for motor in motors):
        install_callbacks(model)
    return model


def driven_by_voltage(motor: Motor, substeps: int = 1) -> DCMotorActuator:
    """A motor of ours whose control is its terminal voltage: a feed-forward of kT*i_ref, which is the control."""
    return DCMotorActuator(
        motor,
        CurrentLoop(
            kp=0.0,
            kff=motor.torque_constant,
            max_voltage=math.inf,
            bemf_compensation=False,
            substeps=substeps,
        ),
    )


def drive(model: mujoco.MjModel, controls: np.ndarray, speeds: np.ndarray | None = None) -> Record:
    """Run a model of this module from rest, of motors with a current.

    Controls are of shape (steps,) for all alike or (steps, motors); joint speeds [rad/s], shape
    (steps,), are set before each step, or left to the engine.
    """
    data = mujoco.MjData(model)
    entry = (
        signals_at(DCMotorActuator)
        if model.na == model.nactuator * slot_size(DCMotorActuator)
        else 0
    )  # current comes first
    currents = np.asarray(model.actuator_actadr) + entry
    rows = np.empty((len(controls), 4, model.nv))
    for row, control, speed in zip(
        rows, controls, controls if speeds is None else speeds, strict=True
    ):
        data.ctrl[:] = control
        if speeds is not None:
            data.qvel[:] = speed
        mujoco.mj_step(model, data)
        row[0], row[1], row[2], row[3] = (
            data.qpos,
            data.qvel,
            data.act[currents],
            data.qfrc_actuator,
        )
    return Record(*rows.swapaxes(0, 1))


# -- current loops --------------------------------------------------------------------------------------------


class Loop(NamedTuple):
    """A motor under its current loop, and the step at which it is sampled."""

    actuator: DCMotorActuator
    """Motor and gains."""
    timestep: float
    """Mechanical step [s]."""


EVERY_FEATURE = Loop(
    DCMotorActuator(
        Motor(
            resistance=1.2,
            inductance=0.05,
            torque_constant=0.8,
            back_emf_constant=0.7,
            arm_radius=0.5,
        ),
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
    paper = {
        task.name: Loop(task.paper[0], task.step_duration / task.motor_inner_steps) for task in OURS
    }
    return {**paper, "every feature": EVERY_FEATURE}


def unlimited(loop: Loop, substeps: int) -> DCMotorActuator:
    """The loop's actuator where it is linear: without limit and sensor errors, with so many electrical substeps."""
    linear = {
        "substeps": substeps,
        "max_voltage": math.inf,
        "current_bias": 0.0,
        "current_noise": 0.0,
    }
    changes = {f"controller.{name}": value for name, value in linear.items()}
    return loop.actuator.replaced({**changes, "supply": None})


def run(
    actuator: DCMotorActuator, timestep: float, torques: np.ndarray, speeds: np.ndarray
) -> Record:
    """Drive one motor in MuJoCo with desired joint torques at joint speeds."""
    return drive(motors_on(HELD, [actuator], timestep), torques * actuator.motor.arm_radius, speeds)
