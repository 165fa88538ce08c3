"""Test bench: small MuJoCo models of codrl_mj's and MuJoCo's motors, and current loops to test."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, Motor
from codrl_mj.engine.families import signals_offset, slot_size
from codrl_mj.physics import install_callbacks, mjcf
from codrl_mj.tasks import PAPER_TASKS


@dataclasses.dataclass(frozen=True)
class Rotor:
    """Load of a motor in a test."""

    name: str
    """Name in reports."""
    inertia: float
    """Inertia about the joint's axis, without the eccentric mass [kg*m^2]."""
    eccentric: bool = False
    """True if a mass of 0.5 kg hangs 0.2 m off the axis, under gravity."""


LOCKED_ROTOR = Rotor("locked rotor", 1e15)
"""Rotor of constant speed: a torque of 1 N*m over 100 s changes it by 1e-13 rad/s."""
FREE_ROTOR = Rotor("free spinning", 0.2)
"""Rotor without a load."""
ECCENTRIC_ROTOR = Rotor("swinging load", 0.2, eccentric=True)
"""Rotor with an eccentric mass, under gravity."""


_BODY_INERTIA = 0.01
"""Part of the rotor's inertia that the body has [kg*m^2]; the rest is the joint's armature."""


class Record(NamedTuple):
    """Quantities after each step, each of shape (steps, motors)."""

    angle: np.ndarray
    """Joint angles [rad]."""
    speed: np.ndarray
    """Joint speeds [rad/s]."""
    current: np.ndarray
    """Motor currents [A]."""
    torque: np.ndarray
    """Torques on the joints *during* the step [N*m], the engine's `qfrc_actuator`."""


def build_rotors(
    rotor: Rotor,
    motors: Sequence[ActuatorModel | Motor],
    timestep: float,
    integrator: str = "Euler",
) -> mujoco.MjModel:
    """Return a model of motors, each on a separate rotor, with the callbacks installed.

    An actuator becomes a codrl_mj motor. A `Motor` becomes MuJoCo's `<dcmotor>`, whose control is
    the terminal voltage [V].
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


def voltage_actuator(motor: Motor, substeps: int = 1) -> DCMotorActuator:
    """Return a codrl_mj motor whose control is its terminal voltage."""
    # The reference current is the control over kT, so a feed-forward gain of kT gives the control
    # itself as the voltage.
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


def simulate(
    model: mujoco.MjModel, controls: np.ndarray, speeds: np.ndarray | None = None
) -> Record:
    """Simulate a model of `build_rotors` from rest and record it.

    Args:
        model: a model in which every motor has a current.
        controls: controls, shape (steps,) for all motors or (steps, motors).
        speeds: joint speeds [rad/s], shape (steps,) or (steps, motors), set before each step; None
            leaves them to the engine.
    """
    data = mujoco.MjData(model)
    # The current is the first signal in a slot of codrl_mj, and the only activation of a native
    # <dcmotor>.
    entry = (
        signals_offset(DCMotorActuator)
        if model.na == model.nactuator * slot_size(DCMotorActuator)
        else 0
    )
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


# -- current loops ---------------------------------------------------------------------------------


class Loop(NamedTuple):
    """A motor with its current loop, and the step at which it is simulated."""

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
"""Loop in which every parameter matters and no compensation hides the back-EMF."""


def standard_loops() -> dict[str, Loop]:
    """Return the paper's loop of each built-in task at its inner step, and `EVERY_FEATURE`."""
    paper = {
        task.name: Loop(task.paper[0], task.step_duration / task.motor_inner_steps)
        for task in PAPER_TASKS
    }
    return {**paper, "every feature": EVERY_FEATURE}


def linear_actuator(loop: Loop, substeps: int) -> DCMotorActuator:
    """Return the loop's actuator without limits and sensor errors, with a number of substeps."""
    linear = {
        "substeps": substeps,
        "max_voltage": math.inf,
        "current_bias": 0.0,
        "current_noise": 0.0,
    }
    changes = {f"controller.{name}": value for name, value in linear.items()}
    return loop.actuator.replaced({**changes, "supply": None})


def simulate_torques(
    actuator: DCMotorActuator, timestep: float, torques: np.ndarray, speeds: np.ndarray
) -> Record:
    """Simulate one motor in MuJoCo under desired joint torques at joint speeds."""
    return simulate(
        build_rotors(LOCKED_ROTOR, [actuator], timestep),
        torques * actuator.motor.arm_radius,
        speeds,
    )
