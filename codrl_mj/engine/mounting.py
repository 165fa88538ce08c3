"""The connection of a motor to its joint in a model: its arm, its gear, and what it adds.

The two backends differ here. In a model of the control callback, MuJoCo's gear of the actuator
contains the motor's arm. In a model of the plugin, the actuator keeps its own gear.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.engine.families import slot_size


def is_in_callback(model: mujoco.MjModel, index: int) -> bool:
    """Return True if the control callback drives an actuator; False for the plugin."""
    return bool(model.actuator_plugin[index] < 0)


def arm_outside_gear(model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> float:
    """Return a motor's arm [m] where the gear of its actuator does not contain it; otherwise 1."""
    return 1.0 if is_in_callback(model, index) else actuator.arm_radius


def set_arm_in_gear(model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> None:
    """Write a motor's arm into the gear of its actuator if the gear contains it."""
    if is_in_callback(model, index):
        model.actuator_gear[model.actuator_outadr[index], 0] = 1.0 / actuator.arm_radius


def desired_input(
    model: mujoco.MjModel, index: int, actuator: ActuatorModel, slot: np.ndarray, command: float
) -> float:
    """Return the input of a motor's `advance` in the last step: a torque [N*m], or a motion.

    Args:
        model: the model.
        index: index of the actuator.
        actuator: the motor.
        slot: its state in the simulation; see `codrl_mj.engine.reading.motor_slots`.
        command: the actuator's control, within its range.
    """
    arm = arm_outside_gear(model, index, actuator)
    if is_in_callback(model, index) or actuator.MOTION:
        return command / arm
    # The plugin takes the force that the model's actuator would deliver by itself.
    return float(slot[slot_size(type(actuator))]) * arm


class JointAddress(NamedTuple):
    """Address of the model entry to which a motor adds one of its `JointAdditions`."""

    field: str
    """Name of the model field."""
    field_index: int
    """Index in the field."""
    scale: float
    """Factor from the motor's value to the model's value."""


def joint_addresses(model: mujoco.MjModel, index: int) -> tuple[JointAddress | None, ...]:
    """Return the addresses of an actuator's `JointAdditions`; None for one that the model lacks.

    In the callback backend, all three are fields of the joint. In the plugin backend, inertia and
    damping are fields of the actuator, which has its own gear.
    """
    kind, target = mujoco.mjtTrn(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    friction_address: JointAddress | None = None
    scale = abs(float(model.actuator_gear[model.actuator_outadr[index], 0]))
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        dof = int(model.jnt_dofadr[target])
        if is_in_callback(model, index):
            return tuple(
                JointAddress(f"dof_{name}", dof, 1.0)
                for name in ("armature", "damping", "frictionloss")
            )
        friction_address = JointAddress("dof_frictionloss", dof, scale)
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        friction_address = JointAddress("tendon_frictionloss", target, scale)
    return (
        JointAddress("actuator_armature", index, 1.0),
        JointAddress("actuator_damping", index, 1.0),
        friction_address,
    )
