"""Addition of our actuators to any MuJoCo model: `add_motors`."""

import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, ActuatorSetting, JointAdditions, import_path, resolve
from codrl_mj.engine.families import load_family, user_header
from codrl_mj.engine.reading import check_shafts
from codrl_mj.fields import check_joint_dynamics, check_pattern, did_you_mean
from codrl_mj.plugin import FAMILY, NAME

NO_ACTUATORS_READ = (
    "MuJoCo reads none from a URDF, nor a transmission's mechanicalReduction, which is the motor's"
    " gear_ratio"
)
ON_JOINT = {mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT}
"""Transmissions of actuators that drive a joint."""
_JOINTS = {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
_WRAPPING = mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER
_SHAFTS = {
    *ON_JOINT,
    mujoco.mjtTrn.mjTRN_TENDON,
    mujoco.mjtTrn.mjTRN_SLIDERCRANK,
    mujoco.mjtTrn.mjTRN_SITE,
}
_DYNAMICS = {
    mujoco.mjtDyn.mjDYN_NONE,
    mujoco.mjtDyn.mjDYN_INTEGRATOR,
    mujoco.mjtDyn.mjDYN_FILTER,
    mujoco.mjtDyn.mjDYN_FILTEREXACT,
}
_GAINS = {mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE}
_BIASES = {mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE}

Pattern = TypeVar("Pattern", bound=str | tuple[str, ...])
"""A regular expression for names of actuators, or several of them."""


class MotorWarning(UserWarning):
    """Warning that a model already has a motor's dynamics, or forces that bypass a motor."""


class AddedMotor(NamedTuple):
    """Motor that was added to a model, and the model's actuators whose force it delivers."""

    pattern: str
    actuator: ActuatorModel
    indices: tuple[int, ...]
    """Indices of actuators of one joint; the first delivers the motor's force, the others none."""


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
    added = _motors_to_add(result, model, actuators)
    for pattern, actuator, indices in added:
        for index in indices:
            reason = _refusal(model, result.actuators[index], index, actuator)
            if reason:
                raise ValueError(
                    f"{_describe(result.actuators[index], index)}: cannot have a motor: {reason}"
                )
        try:
            actuator.check_at(model.opt.timestep, allow_unstable)
        except ValueError as error:
            raise ValueError(f"{pattern!r}: {error}") from None
        load_family(type(actuator))
    motor_of = {index: actuator for _, actuator, indices in added for index in indices}
    for index, actuator in motor_of.items() if joint_dynamics == "replace" else ():
        _remove_dynamics(result, model, index, actuator)
    for motor in added:
        _add_motor(result, model, motor)
    # With -1 the compiler computes the number of user entries that the motors need.
    result.nuser_actuator = -1
    if any(actuator.closes_loops for actuator in motor_of.values()):
        check_shafts(result.compile(), allow_unstable)
    for text in [
        *_describe_bypasses(model, added),
        *(describe_duplicate_dynamics(model, motor_of) if joint_dynamics is None else ()),
    ]:
        _warn(f"the model {spec.modelname!r}: {text}")
    return result


def _describe(target: mujoco.MjsActuator, index: int) -> str:
    """Return an actuator's name for messages."""
    return f"actuator {target.name or index}" + (f" of {target.target}" if target.target else "")


def resolve_patterns(
    actuators: Mapping[Pattern, ActuatorSetting], owner: str
) -> dict[str, ActuatorModel]:
    """Return pattern -> actuator from a user's mapping.

    Args:
        actuators: as for `add_motors`.
        owner: name of the model in messages.
    """
    if not isinstance(actuators, Mapping):
        raise ValueError(
            f"actuators = {actuators!r}: must be a mapping of patterns, such as {{'.*': 'lag'}}"
        )
    texts = {
        " & ".join(key) if isinstance(key, tuple) else key: actuator
        for key, actuator in actuators.items()
    }
    for pattern in texts:
        check_pattern(pattern)
    return {pattern: resolve(actuator, None, owner) for pattern, actuator in texts.items()}


def split_pattern(pattern: str) -> list[str]:
    """Split a pattern at `&` into the patterns that it joins."""
    # A regular expression may contain an ampersand as "\\&".
    return [part.strip() for part in re.split(r"(?<!\\)&", pattern)]


def matchable_names(model: mujoco.MjModel) -> list[list[str]]:
    """Return for each actuator the names that patterns can match: its own and its target's."""
    kinds = {mujoco.mjtTrn.mjTRN_TENDON: model.tendon, mujoco.mjtTrn.mjTRN_BODY: model.body}
    kinds |= dict.fromkeys(ON_JOINT, model.joint)
    kinds |= dict.fromkeys((mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK), model.site)
    names = []
    for index in range(model.nactuator):
        elements = kinds.get(mujoco.mjtTrn(model.actuator_trntype[index]))
        target = "" if elements is None else elements(model.actuator_trnid[index, 0]).name
        names.append([name for name in (model.actuator(index).name, target) if name])
    return names


def match_pattern(pattern: str, names: list[list[str]], needed: bool = True) -> list[int]:
    """Return the indices of the actuators that a pattern matches.

    Args:
        pattern: a pattern; if it joins several by `&`, each of them has to match an actuator.
        names: `matchable_names` of the model.
        needed: raise an error if nothing matches; otherwise return an empty list.

    Raises:
        ValueError: nothing matches a pattern that is needed; the nearest known name is suggested.
    """
    matched = []
    for part in split_pattern(pattern):
        matches = [
            index
            for index, candidates in enumerate(names)
            if any(name == part or re.fullmatch(part, name) for name in candidates)
        ]
        if not matches and not needed:
            return []
        if not matches and not names:
            raise ValueError(
                f"{part!r}: the model has no actuators ({NO_ACTUATORS_READ}). Add one"
                " per joint: <actuator><motor name='JOINT' joint='JOINT'/></actuator>, or"
                " spec.add_actuator(name='JOINT', target='JOINT',"
                " trntype=mujoco.mjtTrn.mjTRN_JOINT)"
            )
        if not matches:
            known = list(dict.fromkeys(name for candidates in names for name in candidates))
            raise ValueError(
                f"{part!r}: no actuator has such a name, nor drives a target of this name; "
                f"{did_you_mean(part, known)}there are {', '.join(known) or 'none'}"
            )
        matched += matches
    return sorted({*matched})


def _motors_to_add(
    spec: mujoco.MjSpec, model: mujoco.MjModel, actuators: Mapping[Pattern, ActuatorSetting]
) -> list[AddedMotor]:
    """Return the motors to add, in the order of their actuators."""
    matched: dict[int, str] = {}
    motors: list[AddedMotor] = []
    names = matchable_names(model)
    for pattern, actuator in resolve_patterns(actuators, f"the model {spec.modelname!r}").items():
        shafts: dict[str, list[int]] = {}
        for index in match_pattern(pattern, names):
            target = spec.actuators[index]
            if index in matched:
                raise ValueError(
                    f"{_describe(target, index)}: both {matched[index]!r} and {pattern!r} match it"
                )
            matched[index] = pattern
            shafts.setdefault(target.target, []).append(index)
        for indices in shafts.values():
            reason = _refusal_together(spec, model, indices, pattern, actuator)
            if reason:
                raise ValueError(f"{pattern!r} matches {reason}")
            # The first actuator delivers the motor's force, and MuJoCo limits it by this actuator's
            # forcerange. Actuators without a forcerange therefore come first.
            ordered = sorted(
                indices,
                key=lambda index: len(indices) > 1 and bool(model.actuator_forcelimited[index]),
            )
            motors.append(AddedMotor(pattern, actuator, tuple(ordered)))
    return sorted(motors, key=lambda motor: min(motor.indices))


def _refusal_together(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    indices: Sequence[int],
    pattern: str,
    actuator: ActuatorModel,
) -> str:
    """Return why the actuators that a pattern matches at a joint cannot share a motor, or ""."""
    descriptions, is_joined = (
        [_describe(spec.actuators[index], index) for index in indices],
        len(split_pattern(pattern)) > 1,
    )
    if len(indices) == 1:
        detail = (
            "alone: a pattern with & must match several actuators of the same joint, which then"
            " share one motor"
        )
        return f"{descriptions[0]} {detail}" if is_joined else ""
    both, names = " and ".join(descriptions), [spec.actuators[index].name for index in indices]
    if not is_joined:
        return (
            f"both {both}: each would get a separate motor. For one motor behind all of them write"
            f" {' & '.join(names) if all(names) else 'NAME & NAME'!r}; for several motors write a"
            " pattern for each"
        )
    rows, outputs = list(indices), model.actuator_outadr[list(indices)]
    shared = {"transmission": model.actuator_trntype[rows], "group": model.actuator_group[rows]}
    shared["gear"] = model.actuator_gear[outputs]
    if actuator.MOTION:
        return (
            f"{both}, but the command of a {type(actuator).__name__} is one motion, not the sum of"
            " several forces"
        )
    for field in (name for name, values in shared.items() if (values != values[0]).any()):
        return f"{both}, whose {field} differs: actuators that share a motor must have the same"
    if model.actuator_forcelimited[rows].all():
        return (
            f"{both}, each with a forcerange, which would limit the motor as well: limit the joint"
            " instead, with actuatorfrcrange"
        )
    return ""


def _refusal(
    model: mujoco.MjModel, target: mujoco.MjsActuator, index: int, actuator: ActuatorModel
) -> str:
    """Return why an actuator of a model cannot have a motor; empty if it can."""
    transmission, dynamics = (
        mujoco.mjtTrn(model.actuator_trntype[index]),
        mujoco.mjtDyn(model.actuator_dyntype[index]),
    )
    gain, bias = (
        mujoco.mjtGain(model.actuator_gaintype[index]),
        mujoco.mjtBias(model.actuator_biastype[index]),
    )
    first, second = model.actuator_trnid[index]
    if target.plugin.active:
        return f"it is a plugin, {target.plugin.plugin_name}"
    for kind, known in (
        (dynamics, _DYNAMICS),
        (gain, _GAINS),
        (bias, _BIASES),
        (transmission, _SHAFTS),
    ):
        if kind not in known:
            return f"its force must be gain*input + bias at one shaft, but it has {kind.name}"
    if model.actuator_ctrlnum[index] != 1 or model.actuator_outnum[index] != 1:
        return (
            f"it has {model.actuator_ctrlnum[index]} controls and {model.actuator_outnum[index]}"
            " forces, not one"
        )
    if transmission in ON_JOINT and mujoco.mjtJoint(model.jnt_type[first]) not in _JOINTS:
        return "its joint is neither a hinge nor a slide"
    if transmission == mujoco.mjtTrn.mjTRN_SITE and second >= 0:
        return "its site has a reference site"
    if transmission == mujoco.mjtTrn.mjTRN_TENDON and model.tendon_actfrclimited[first]:
        return (
            "its tendon limits the force of its actuators (actuatorfrclimited), which MuJoCo does"
            " not do for plugins"
        )
    if transmission == mujoco.mjtTrn.mjTRN_TENDON and actuator.additions.armature:
        path = range(model.tendon_adr[first], model.tendon_adr[first] + model.tendon_num[first])
        for geom in (
            model.wrap_objid[wrap]
            for wrap in path
            if mujoco.mjtWrap(model.wrap_type[wrap]) in _WRAPPING
        ):
            return (
                f"its tendon wraps around geom {model.geom(geom).name or geom}, where MuJoCo has no"
                " armature for its motor's rotor: set motor.rotor_inertia = 0, or drive the joint"
                " itself"
            )
    if model.actuator_delay[index]:
        return "its control is delayed (delay), and plugins do not get the delayed control"
    if actuator.MOTION and dynamics != mujoco.mjtDyn.mjDYN_NONE:
        return "its control is filtered (dyntype), but a servo needs the control itself"
    commands, (stiffness, damping) = (
        actuator.commands() if actuator.MOTION else {},
        model.actuator_biasprm[index, 1:3],
    )
    servo = "position" if stiffness else "velocity" if damping else None
    if servo and commands and servo not in commands:
        return (
            f"its control is a {servo}, but its motor's command is a {', '.join(commands)}: set"
            " loop.controls"
        )
    if actuator.additions.friction and transmission not in (*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON):
        return (
            "it drives neither a joint nor a tendon, to which MuJoCo could add its motor's friction"
        )
    if model.actuator_user[index].any():
        return "it has user data, which its motor needs for its parameters"
    return ""


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


_DYNAMICS_NAMES = "armature", "damping", "frictionloss"
"""MuJoCo's names for the entries of `JointAdditions`."""
_NEGLIGIBLE = 0.05
"""Largest ratio of the model's value to the motor's that causes no warning.

So small a value is probably the bearing's, and counting it twice changes little.
"""


def _added_dynamics(actuator: ActuatorModel, gear: float = 1.0) -> JointAdditions:
    """Return the motor's additions at its joint, beyond a gear; back-EMF counts as damping."""
    armature, damping, friction = actuator.additions
    return JointAdditions(
        gear**2 * armature, gear**2 * (damping + actuator.back_emf_damping), abs(gear) * friction
    )


def _remove_dynamics(
    spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, actuator: ActuatorModel
) -> None:
    """Remove from a spec the armature, damping and friction that a motor replaces."""
    target, transmission = spec.actuators[index], mujoco.mjtTrn(model.actuator_trntype[index])
    elements = [target]
    if transmission in (*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON):
        elements.append((spec.joint if transmission in ON_JOINT else spec.tendon)(target.target))
    for element in elements:
        for name, value in zip(_DYNAMICS_NAMES, _added_dynamics(actuator), strict=True):
            if value and hasattr(element, name):
                setattr(element, name, [0.0] * 3 if name == "damping" else 0.0)


def describe_duplicate_dynamics(
    model: mujoco.MjModel, motors: Mapping[int, ActuatorModel]
) -> list[str]:
    """Describe the model's damping, armature and friction that a motor probably adds again.

    Args:
        model: the model without its motors' additions.
        motors: index of an actuator -> motor.

    Returns:
        A list with the text of the warning, or an empty list.
    """
    descriptions: dict[str, str] = {}
    for index, motor in motors.items():
        target, gear = (
            model.actuator_trnid[index, 0],
            float(model.actuator_gear[model.actuator_outadr[index], 0]),
        )
        values = model.actuator_armature[index], model.actuator_damping[index], 0.0
        elements = {f"actuator {model.actuator(index).name or index}": (values, 1.0)}
        if mujoco.mjtTrn(model.actuator_trntype[index]) in ON_JOINT:
            dof = model.jnt_dofadr[target]
            values = model.dof_armature[dof], model.dof_damping[dof], model.dof_frictionloss[dof]
            elements[f"joint {model.joint(target).name}"] = values, gear
        elif mujoco.mjtTrn(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_TENDON:
            values = (
                model.tendon_armature[target],
                model.tendon_damping[target],
                model.tendon_frictionloss[target],
            )
            elements[f"tendon {model.tendon(target).name}"] = values, gear
        for element, (values, ratio) in elements.items():
            rows = list(zip(_DYNAMICS_NAMES, values, _added_dynamics(motor, ratio), strict=True))
            if any(value > _NEGLIGIBLE * added > 0.0 for _, value, added in rows):
                texts = [
                    f"{name} {value:.3g} (the motor's is {added:.3g})"
                    for name, value, added in rows
                    if value > 0.0
                ]
                descriptions[element] = f"{element} has {', '.join(texts)}"
    remedy = (
        "If these numbers describe the motor, they count twice: joint_dynamics='replace'"
        " (--env.joint-dynamics replace) removes from the model what its motor adds; 'keep' keeps"
        " both, without this warning"
    )
    return [f"{'; '.join(descriptions.values())}. {remedy}"] if descriptions else []


def _describe_bypasses(model: mujoco.MjModel, added: Sequence[AddedMotor]) -> list[str]:
    """Describe forces that bypass the motors of their joints, and supplies that are not shared."""
    names = [model.actuator(index).name or str(index) for index in range(model.nactuator)]
    joints = [
        int(target) if mujoco.mjtTrn(kind) in ON_JOINT else None
        for kind, target in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    ]
    with_motor = {index for motor in added for index in motor.indices}
    texts = []
    for first, joint in [(motor.indices[0], joints[motor.indices[0]]) for motor in added]:
        beside = [
            names[index]
            for index, other_joint in enumerate(joints)
            if other_joint == joint and index not in with_motor
        ]
        if joint is not None and beside:
            texts.append(
                f"actuator {beside[0]} drives the joint of {names[first]} without its motor:"
                f" '{names[first]} & {beside[0]}' puts one motor behind both; the motor 'ideal' for"
                f" {beside[0]} leaves it as it is, without this warning"
            )
        if joint is not None and model.jnt_actgravcomp[joint] and model.body_gravcomp.any():
            texts.append(
                f"joint {model.joint(joint).name}: actuatorgravcomp: its gravity compensation"
                " passes through no motor; remove it from the model, and command it at actuator"
                f" {names[first]}"
            )
    supplies = {names[motor.indices[0]]: getattr(motor.actuator, "supply", None) for motor in added}
    sagging = [name for name, supply in supplies.items() if getattr(supply, "resistance", 0.0)]
    if len(sagging) > 1:
        texts.append(
            f"supply.resistance: each of the motors {', '.join(sagging)} has a separate supply: on"
            " one battery the current of each would lower the voltage of all"
        )
    return texts


_WARNED: set[str] = set()
"""Texts of the warnings that this process has shown."""
_INNER_PACKAGES = {"codrl_mj", "gymnasium", "dm_control", "contextlib"}
"""Packages whose frames lie between a user's line and `_warn`."""


def _warn(text: str) -> None:
    """Warn once per process, at the user's line."""
    # Environments build the same model repeatedly, and Python's filter counts by line.
    frame, level = sys._getframe(), 1
    while (
        frame.f_back is not None
        and str(frame.f_globals.get("__name__")).partition(".")[0] in _INNER_PACKAGES
    ):
        frame, level = frame.f_back, level + 1
    if text not in _WARNED:
        warnings.warn(text, MotorWarning, stacklevel=level)
        _WARNED.add(text)
