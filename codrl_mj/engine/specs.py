"""Puts actuators of ours into models of anybody's: `add_motors`."""

import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, JointAdditions, import_path, resolve
from codrl_mj.engine.families import load_family, user_head
from codrl_mj.engine.reading import check_shafts
from codrl_mj.fields import check_joint_dynamics, check_pattern, did_you_mean
from codrl_mj.plugin import FAMILY, NAME

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


class MotorWarning(UserWarning):
    """A model may contain its motors already, or move its joints past them."""


class AddedMotor(NamedTuple):
    """One motor, and the actuators of a model that ask it for a force."""

    pattern: str
    actuator: ActuatorModel
    indices: tuple[int, ...]
    """Several drive the same joint; the first delivers the motor's force, and the others deliver none."""


def add_motors(
    spec: mujoco.MjSpec,
    actuators: Mapping[Any, Any],
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
) -> mujoco.MjSpec:
    """Put actuators behind the actuators of a model: whatever force those ask for, these deliver as they can.

    An actuator keeps its gear, gain, bias, dynamics and ranges; the force that the engine would
    have produced by them becomes the desired force. Inertia and friction that ours bring are added,
    through the gear, to the joint.

        >>> spec = mujoco.MjSpec.from_file("half_cheetah.xml")
        >>> model = codrl_mj.add_motors(spec, {"b.*": my_motor, "f.*": "ideal"}).compile()

    Args:
        spec: the model; it is not changed.
        actuators: what goes where. Keys are regular expressions that an actuator's name, or the
            name of the joint, tendon or site that it drives, matches from beginning to end. Several
            of them, as a tuple or joined by `&`, put one motor behind several actuators of a joint:
            `("hip_p", "hip_v")`, `"hip_p & hip_v"`. Values are actuators, mappings of their fields,
            names of families, files, or `module:NAME`.
        allow_unstable: whether to let an actuator be that its family refuses at the model's step.
        joint_dynamics: what becomes of damping, armature and frictionloss that the model has at a
            motor's joint, tendon or actuator, where the motor brings the same. `keep` adds both;
            `replace` takes the model's out, for it is the motor's own. None keeps it, too, and
            warns.

    Returns:
        A new spec, to be compiled.

    Raises:
        ValueError: `spec` is none; a pattern matches nothing, or two match the same actuator; an
            actuator of the model cannot be driven like this; or one of ours is not valid, or not
            stable at the model's step.
    """
    if not isinstance(spec, mujoco.MjSpec):
        given = repr(str(spec)) if isinstance(spec, str | Path) else "FILE"
        raise ValueError(
            f"spec = {spec!r}: must be a mujoco.MjSpec, such as mujoco.MjSpec.from_file({given})"
        )
    check_joint_dynamics(joint_dynamics)
    new, model = spec.copy(), spec.copy().compile()
    # MuJoCo 3.17 copies default classes without their numbers, and forgets those that are added
    # then; this numbers them
    new.delete(new.add_default(NAME, new.default))
    mounted = _chosen(new, model, actuators)
    for pattern, actuator, indices in mounted:
        for index in indices:
            reason = _refusal(model, new.actuators[index], index, actuator)
            if reason:
                raise ValueError(
                    f"{_call(new.actuators[index], index)}: cannot be motorised: {reason}"
                )
        try:
            actuator.check_at(model.opt.timestep, allow_unstable)
        except ValueError as error:
            raise ValueError(f"{pattern!r}: {error}") from None
        load_family(type(actuator))
    driven = {index: actuator for _, actuator, indices in mounted for index in indices}
    for index, actuator in driven.items() if joint_dynamics == "replace" else ():
        _take_out(new, model, index, actuator)
    for each in mounted:
        _drive(new, model, each)
    new.nuser_actuator = -1  # as many as are needed
    if any(actuator.closes_loops for actuator in driven.values()):
        check_shafts(new.compile(), allow_unstable)
    for text in [
        *_past_motors(model, mounted),
        *(doubled(model, driven) if joint_dynamics is None else ()),
    ]:
        _warn(f"the model {spec.modelname!r}: {text}")
    return new


def _call(target: mujoco.MjsActuator, index: int) -> str:
    """An actuator as messages call it."""
    return f"actuator {target.name or index}" + (f" of {target.target}" if target.target else "")


def resolve_patterns(actuators: Mapping[str, Any], whose: str) -> dict[str, ActuatorModel]:
    """Pattern -> actuator, of whatever a user may write for either; messages call the model `whose`."""
    if not isinstance(actuators, Mapping):
        raise ValueError(
            f"actuators = {actuators!r}: must be a mapping of patterns, such as {{'.*': 'lag'}}"
        )
    texts = {
        " & ".join(key) if isinstance(key, tuple) else key: given
        for key, given in actuators.items()
    }
    for pattern in texts:
        check_pattern(pattern)
    return {pattern: resolve(given, None, whose) for pattern, given in texts.items()}


def parts_of(pattern: str) -> list[str]:
    """Return the patterns that a pattern joins by `&`, to put one motor behind what they match; else itself alone."""
    return [part.strip() for part in re.split(r"(?<!\\)&", pattern)]


def names_of(model: mujoco.MjModel) -> list[list[str]]:
    """What patterns can match of each actuator of a compiled model: its name, and that of what it drives."""
    kinds = {mujoco.mjtTrn.mjTRN_TENDON: model.tendon, mujoco.mjtTrn.mjTRN_BODY: model.body}
    kinds |= dict.fromkeys(ON_JOINT, model.joint)
    kinds |= dict.fromkeys((mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK), model.site)
    names = []
    for index in range(model.nactuator):
        driven = kinds.get(mujoco.mjtTrn(model.actuator_trntype[index]))
        target = "" if driven is None else driven(model.actuator_trnid[index, 0]).name
        names.append([name for name in (model.actuator(index).name, target) if name])
    return names


def matched_by(pattern: str, names: list[list[str]], needed: bool = True) -> list[int]:
    """Indices of the actuators that a pattern matches, by their `names_of`: of one at least if it is `needed`.

    Of a pattern that joins several each has to match one.
    """
    matched = []
    for part in parts_of(pattern):
        own = [
            index
            for index, own in enumerate(names)
            if any(name == part or re.fullmatch(part, name) for name in own)
        ]
        if not own and not needed:
            return []
        if not own and not names:
            raise ValueError(
                f"{part!r}: the model has no actuators (MuJoCo reads none from a URDF, nor a"
                " transmission's mechanicalReduction, which is the motor's gear_ratio). Add one"
                " per joint: <actuator><motor name='JOINT' joint='JOINT'/></actuator>, or"
                " spec.add_actuator(name='JOINT', target='JOINT',"
                " trntype=mujoco.mjtTrn.mjTRN_JOINT)"
            )
        if not own:
            known = list(dict.fromkeys(name for own in names for name in own))
            raise ValueError(
                f"{part!r}: no actuator has such a name, nor drives anything that has; "
                f"{did_you_mean(part, known)}there are {', '.join(known) or 'none'}"
            )
        matched += own
    return sorted({*matched})


def _chosen(
    spec: mujoco.MjSpec, model: mujoco.MjModel, actuators: Mapping[Any, Any]
) -> list[AddedMotor]:
    """The motors, in the order of their actuators."""
    taken: dict[int, str] = {}
    found: list[AddedMotor] = []
    names = names_of(model)
    for pattern, actuator in resolve_patterns(actuators, f"the model {spec.modelname!r}").items():
        shafts: dict[str, list[int]] = {}
        for index in matched_by(pattern, names):
            target = spec.actuators[index]
            if index in taken:
                raise ValueError(
                    f"{_call(target, index)}: both {taken[index]!r} and {pattern!r} match it"
                )
            taken[index] = pattern
            shafts.setdefault(target.target, []).append(index)
        for indices in shafts.values():
            reason = _refusal_together(spec, model, indices, pattern, actuator)
            if reason:
                raise ValueError(f"{pattern!r} matches {reason}")
            # MuJoCo would limit the motor's force, too, by the range of the force that one actuator
            # asks it for
            ordered = sorted(
                indices,
                key=lambda index: len(indices) > 1 and bool(model.actuator_forcelimited[index]),
            )
            found.append(AddedMotor(pattern, actuator, tuple(ordered)))
    return sorted(found, key=lambda each: min(each.indices))


def _refusal_together(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    indices: Sequence[int],
    pattern: str,
    actuator: ActuatorModel,
) -> str:
    """Why a pattern cannot have what it matches at one joint; empty if it can."""
    called, together = (
        [_call(spec.actuators[index], index) for index in indices],
        len(parts_of(pattern)) > 1,
    )
    if len(indices) == 1:
        alone = (
            "alone of all that drives it: one motor stands behind several actuators of the same"
            " joint"
        )
        return f"{called[0]} {alone}" if together else ""
    both, names = " and ".join(called), [spec.actuators[index].name for index in indices]
    if not together:
        return (
            f"both {both}: each would be a motor of its own. For one motor behind all of them write"
            f" {' & '.join(names) if all(names) else 'NAME & NAME'!r}; give each a pattern of its"
            " own if several motors are meant"
        )
    each, outputs = list(indices), model.actuator_outadr[list(indices)]
    same = {"transmission": model.actuator_trntype[each], "group": model.actuator_group[each]}
    same["gear"] = model.actuator_gear[outputs]
    if actuator.MOTION:
        return (
            f"{both}, and a {type(actuator).__name__} is asked for one motion, not for the sum of"
            " several forces"
        )
    for field in (name for name, values in same.items() if (values != values[0]).any()):
        return f"{both}, whose {field} differs: one motor has one"
    if model.actuator_forcelimited[each].all():
        return (
            f"{both}, each with a forcerange, which would limit the motor as well: limit the joint,"
            " actuatorfrcrange"
        )
    return ""


def _refusal(
    model: mujoco.MjModel, target: mujoco.MjsActuator, index: int, actuator: ActuatorModel
) -> str:
    """Why an actuator of a model cannot be motorised; empty if it can."""
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
            return f"its force is not gain*input + bias over one shaft, but {kind.name}"
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
            model.wrap_objid[at] for at in path if mujoco.mjtWrap(model.wrap_type[at]) in _WRAPPING
        ):
            return (
                f"its tendon wraps around geom {model.geom(geom).name or geom}, where MuJoCo has no"
                " armature for its motor's rotor: set motor.rotor_inertia = 0, or drive the joint"
                " itself"
            )
    if model.actuator_delay[index]:
        return "its control is delayed (delay), which MuJoCo does not tell plugins"
    if actuator.MOTION and dynamics != mujoco.mjtDyn.mjDYN_NONE:
        return "its control is filtered before it becomes what a servo is asked for"
    asked, (stiffness, damping) = (
        actuator.commands() if actuator.MOTION else {},
        model.actuator_biasprm[index, 1:3],
    )
    own = "position" if stiffness else "velocity" if damping else None
    if own and asked and own not in asked:
        return (
            f"its control is a {own}, and its motor is asked for a {', '.join(asked)}: set"
            " loop.controls"
        )
    if actuator.additions.friction and transmission not in (*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON):
        return (
            "it drives neither a joint nor a tendon, which the friction that its motor brings would"
            " need"
        )
    if model.actuator_user[index].any():
        return "it has user data, where its motor's parameters have to go"
    return ""


def _drive(spec: mujoco.MjSpec, model: mujoco.MjModel, mounted: AddedMotor) -> None:
    """Put a motor behind actuators of a spec.

    The old `model` is compiled: it has what defaults, `inheritrange` and automatic limits come to.
    """
    actuator, index, instance = mounted.actuator, mounted.indices[0], f"{NAME}.{mounted.indices[0]}"
    spec.activate_plugin(NAME)
    spec.add_plugin(name=instance, plugin_name=NAME).config = {FAMILY: import_path(type(actuator))}
    for each in mounted.indices:
        _connect(spec, model, each, instance, actuator.MOTION)
    target, added = spec.actuators[index], actuator.additions
    target.userdata = [*user_head(type(actuator)), actuator.arm_radius, *actuator.parameter_values]
    target.armature += added.armature
    target.damping[0] += added.damping
    if added.friction:
        on_joint = mujoco.mjtTrn(model.actuator_trntype[index]) in ON_JOINT
        driven = spec.joint(target.target) if on_joint else spec.tendon(target.target)
        driven.frictionloss += added.friction * abs(
            model.actuator_gear[model.actuator_outadr[index], 0]
        )


def _connect(
    spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, instance: str, motion: bool
) -> None:
    """Connect an actuator of a spec to an instance of the plugin."""
    target, name = spec.actuators[index], f"{NAME}.{index}"
    if motion:  # its own loops take the place of the model's
        target.gaintype, target.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        target.gainprm[:], target.biasprm[:] = [1.0] + [0.0] * (mujoco.mjNGAIN - 1), 0.0
    # XML has no other place for gain and bias of a plugin's actuator than a default class: without
    # them a saved model would have other forces, and other derivatives of them in the implicit
    # integrators. A class that differs in nothing from its parent is not saved: then it is the
    # parent
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
"""MuJoCo's names of the entries of `JointAdditions`."""
_NEGLIGIBLE = 0.05
"""Share of what a motor brings below which a model's own is taken for a bearing's: it changes little."""


def _brought(actuator: ActuatorModel, gear: float = 1.0) -> JointAdditions:
    """Return what a motor brings to its joint through a gear: its back-EMF counts as damping."""
    armature, damping, friction = actuator.additions
    return JointAdditions(
        gear**2 * armature, gear**2 * (damping + actuator.back_emf_damping), abs(gear) * friction
    )


def _take_out(
    spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, actuator: ActuatorModel
) -> None:
    """Take out of a spec the armature, damping and friction of which a motor brings its own."""
    target, transmission = spec.actuators[index], mujoco.mjtTrn(model.actuator_trntype[index])
    elements = [target]
    if transmission in (*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON):
        elements.append((spec.joint if transmission in ON_JOINT else spec.tendon)(target.target))
    for element in elements:
        for name, brought in zip(_DYNAMICS_NAMES, _brought(actuator), strict=True):
            if brought and hasattr(element, name):
                setattr(element, name, [0.0] * 3 if name == "damping" else 0.0)


def doubled(model: mujoco.MjModel, motors: Mapping[int, ActuatorModel]) -> list[str]:
    """Describe the damping, armature and friction of a model that may be a motor's already.

    Args:
        model: the model without what its motors add.
        motors: index of an actuator -> motor.
    """
    found: dict[str, str] = {}
    for index, motor in motors.items():
        driven, gear = (
            model.actuator_trnid[index, 0],
            float(model.actuator_gear[model.actuator_outadr[index], 0]),
        )
        own = model.actuator_armature[index], model.actuator_damping[index], 0.0
        places = {f"actuator {model.actuator(index).name or index}": (own, 1.0)}
        if mujoco.mjtTrn(model.actuator_trntype[index]) in ON_JOINT:
            dof = model.jnt_dofadr[driven]
            own = model.dof_armature[dof], model.dof_damping[dof], model.dof_frictionloss[dof]
            places[f"joint {model.joint(driven).name}"] = own, gear
        elif mujoco.mjtTrn(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_TENDON:
            own = (
                model.tendon_armature[driven],
                model.tendon_damping[driven],
                model.tendon_frictionloss[driven],
            )
            places[f"tendon {model.tendon(driven).name}"] = own, gear
        for place, (values, ratio) in places.items():
            rows = list(zip(_DYNAMICS_NAMES, values, _brought(motor, ratio), strict=True))
            if any(value > _NEGLIGIBLE * its > 0.0 for _, value, its in rows):
                numbers = [
                    f"{name} {value:.3g} (the motor's is {its:.3g})"
                    for name, value, its in rows
                    if value > 0.0
                ]
                found[place] = f"{place} has {', '.join(numbers)}"
    remedy = (
        "If these numbers are the motor's own, they count twice: joint_dynamics='replace'"
        " (--env.joint-dynamics replace) takes out of the model what its motor brings; 'keep' keeps"
        " both, without this warning"
    )
    return [f"{'; '.join(found.values())}. {remedy}"] if found else []


def _past_motors(model: mujoco.MjModel, mounted: Sequence[AddedMotor]) -> list[str]:
    """Describe what moves the joints of motors past these, and what motors do not share."""
    called = [model.actuator(index).name or str(index) for index in range(model.nactuator)]
    joints = [
        int(driven) if mujoco.mjtTrn(kind) in ON_JOINT else None
        for kind, driven in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    ]
    behind = {index for each in mounted for index in each.indices}
    found = []
    for first, joint in [(each.indices[0], joints[each.indices[0]]) for each in mounted]:
        beside = [
            called[index]
            for index, other in enumerate(joints)
            if other == joint and index not in behind
        ]
        if joint is not None and beside:
            found.append(
                f"actuator {beside[0]} drives the joint of {called[first]} past its motor:"
                f" '{called[first]} & {beside[0]}' puts one motor behind both; 'ideal' leaves it as"
                " it is, without this warning"
            )
        if joint is not None and model.jnt_actgravcomp[joint] and model.body_gravcomp.any():
            found.append(
                f"joint {model.joint(joint).name}: actuatorgravcomp: its gravity compensation"
                " passes through no motor; take it out of the model, and ask actuator"
                f" {called[first]} for it"
            )
    supplies = {called[each.indices[0]]: getattr(each.actuator, "supply", None) for each in mounted}
    sagging = [name for name, supply in supplies.items() if getattr(supply, "resistance", 0.0)]
    if len(sagging) > 1:
        found.append(
            f"supply.resistance: each of the motors {', '.join(sagging)} has a supply of its own:"
            " on one battery the current of each would lower the voltage of all"
        )
    return found


_WARNED: set[str] = set()
"""Warnings that this process has shown."""
_BETWEEN = {"codrl_mj", "gymnasium", "dm_control", "contextlib"}
"""Packages between a user's line and a model that is built for it."""


def _warn(text: str) -> None:
    """Warn once a process, at the user's line: environments build the same model again and again."""
    frame, level = sys._getframe(), 1
    while (
        frame.f_back is not None
        and str(frame.f_globals.get("__name__")).partition(".")[0] in _BETWEEN
    ):
        frame, level = frame.f_back, level + 1
    if text not in _WARNED:
        warnings.warn(text, MotorWarning, stacklevel=level)
        _WARNED.add(text)
