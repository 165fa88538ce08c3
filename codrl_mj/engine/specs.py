"""Addition of our actuators to any MuJoCo model: `add_motors`."""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorSetting, import_path
from codrl_mj.engine.families import load_family, user_header
from codrl_mj.engine.joint_dynamics import (
    describe_bypasses,
    describe_duplicate_dynamics,
    remove_dynamics,
    warn_once,
)
from codrl_mj.engine.matching import (
    ON_JOINT,
    AddedMotor,
    Pattern,
    check_motors,
    motors_to_add,
)
from codrl_mj.engine.reading import check_shafts
from codrl_mj.fields import check_joint_dynamics
from codrl_mj.plugin import FAMILY, NAME


def add_motors(
    spec: mujoco.MjSpec,
    actuators: Mapping[Pattern, ActuatorSetting],
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
) -> mujoco.MjSpec:
    """Add motors to the actuators of a model.

    A motor delivers the forces of its actuators within its limits. The model's actuators keep their
    gear, gain, bias, dynamics and ranges; the force that the engine would have computed from them
    becomes the motor's desired force. The motor's inertia and friction are added to the joint,
    through the gear.

        >>> spec = mujoco.MjSpec.from_file("half_cheetah.xml")
        >>> model = codrl_mj.add_motors(spec, {"b.*": my_motor, "f.*": "ideal"}).compile()

    Args:
        spec: the model; it is not changed.
        actuators: pattern -> motor. A pattern is a regular expression that must match the whole
            name of an actuator, or of the joint, tendon or site that it drives. Several patterns,
            as a tuple or joined by `&`, put one motor behind several actuators of a joint:
            `("hip_p", "hip_v")`, `"hip_p & hip_v"`. A motor is an actuator, a mapping of its
            fields, the name of a family, a file, or `module:NAME`.
        allow_unstable: accept motors that are unstable at the model's step.
        joint_dynamics: treatment of the model's damping, armature and frictionloss at a motor's
            joint, tendon or actuator, if the motor has the same quantity. `keep` adds both;
            `replace` removes the model's, if it describes the motor. None adds both and warns.

    Returns:
        A new spec, not compiled yet.

    Raises:
        ValueError: `spec` is not a spec; a pattern matches nothing, or two match the same actuator;
            an actuator of the model cannot have a motor; or a motor is not valid, or not stable at
            the model's step.
    """
    if not isinstance(spec, mujoco.MjSpec):
        path = repr(str(spec)) if isinstance(spec, str | Path) else "FILE"
        raise ValueError(
            f"spec = {spec!r}: must be a mujoco.MjSpec, such as mujoco.MjSpec.from_file({path})"
        )
    check_joint_dynamics(joint_dynamics)
    result, model = spec.copy(), spec.copy().compile()
    # MuJoCo 3.17 copies default classes without their numbers, and loses classes that are added
    # afterwards. Adding and deleting a class numbers them.
    result.delete(result.add_default(NAME, result.default))
    added = motors_to_add(result, model, actuators)
    check_motors(result, model, added, allow_unstable)
    for _, actuator, _ in added:
        load_family(type(actuator))
    motor_of = {index: actuator for _, actuator, indices in added for index in indices}
    for index, actuator in motor_of.items() if joint_dynamics == "replace" else ():
        remove_dynamics(result, model, index, actuator)
    for motor in added:
        _add_motor(result, model, motor)
    # With -1 the compiler computes the number of user entries that the motors need.
    result.nuser_actuator = -1
    if any(actuator.closes_loops for actuator in motor_of.values()):
        check_shafts(result.compile(), allow_unstable)
    for text in [
        *describe_bypasses(model, added),
        *(describe_duplicate_dynamics(model, motor_of) if joint_dynamics is None else ()),
    ]:
        warn_once(f"the model {spec.modelname!r}: {text}")
    return result


def _add_motor(spec: mujoco.MjSpec, model: mujoco.MjModel, added: AddedMotor) -> None:
    """Add a motor to a spec.

    `model` is compiled from the original spec, so that the values of its default classes,
    `inheritrange` and automatic limits are resolved.
    """
    actuator, index, instance = added.actuator, added.indices[0], f"{NAME}.{added.indices[0]}"
    spec.activate_plugin(NAME)
    spec.add_plugin(name=instance, plugin_name=NAME).config = {FAMILY: import_path(type(actuator))}
    for partner in added.indices:
        _connect(spec, model, partner, instance, actuator.MOTION)
    target, additions = spec.actuators[index], actuator.additions
    target.userdata = [
        *user_header(type(actuator)),
        actuator.arm_radius,
        *actuator.parameter_values,
    ]
    target.armature += additions.armature
    target.damping[0] += additions.damping
    if additions.friction:
        on_joint = mujoco.mjtTrn(model.actuator_trntype[index]) in ON_JOINT
        element = spec.joint(target.target) if on_joint else spec.tendon(target.target)
        element.frictionloss += additions.friction * abs(
            model.actuator_gear[model.actuator_outadr[index], 0]
        )


def _connect(
    spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, instance: str, is_motion: bool
) -> None:
    """Connect an actuator of a spec to an instance of the plugin."""
    target, name = spec.actuators[index], f"{NAME}.{index}"
    if is_motion:
        # The control passes unchanged, because the servo's loops replace the model's gain and bias.
        target.gaintype, target.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        target.gainprm[:], target.biasprm[:] = [1.0] + [0.0] * (mujoco.mjNGAIN - 1), 0.0
    # In XML a plugin's actuator can have gain and bias only through a default class. Without them a
    # saved model would have other forces, and in the implicit integrators other derivatives of
    # forces. MuJoCo does not save a class that equals its parent, so the parent is used then.
    default, fields = spec.default, ("gaintype", "gainprm", "biastype", "biasprm")
    if not all(
        np.array_equal(getattr(target, field), getattr(default.actuator, field)) for field in fields
    ):
        default = spec.add_default(name, default)
        for field in fields:
            setattr(default.actuator, field, getattr(target, field))
    target.classname = default
    control = model.actuator_ctrladr[index]
    target.inheritrange = 0.0
    target.ctrllimited, target.ctrlrange = (
        int(model.actuator_ctrllimited[control]),
        model.actuator_ctrlrange[control],
    )
    target.forcelimited, target.forcerange = (
        int(model.actuator_forcelimited[index]),
        model.actuator_forcerange[index],
    )
    target.actlimited, target.actrange = (
        int(model.actuator_actlimited[index]),
        model.actuator_actrange[index],
    )
    target.plugin.plugin_name, target.plugin.name, target.plugin.active = NAME, instance, True
