"""Puts actuators of ours into models of anybody's: `motorise`."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, reference, resolve
from codrl_mj.engine.families import load_family, user_head
from codrl_mj.engine.reading import check_shafts
from codrl_mj.fields import check_pattern, did_you_mean
from codrl_mj.plugin import FAMILY, NAME

ON_JOINT = {mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT}
"""Transmissions of actuators that drive a joint."""
_JOINTS = {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
_SHAFTS = {*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON, mujoco.mjtTrn.mjTRN_SLIDERCRANK, mujoco.mjtTrn.mjTRN_SITE}
_DYNAMICS = {
    mujoco.mjtDyn.mjDYN_NONE,
    mujoco.mjtDyn.mjDYN_INTEGRATOR,
    mujoco.mjtDyn.mjDYN_FILTER,
    mujoco.mjtDyn.mjDYN_FILTEREXACT,
}
_GAINS = {mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE}
_BIASES = {mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE}


def motorise(spec: mujoco.MjSpec, actuators: Mapping[str, Any], allow_unstable: bool = False) -> mujoco.MjSpec:
    """Put actuators behind the actuators of a model: whatever force those ask for, these deliver as they can.

    An actuator keeps its gear, gain, bias, dynamics and ranges; the force that the engine would have produced by them
    becomes the desired force. Inertia and friction that ours bring are added, through the gear, to the joint.

        >>> spec = mujoco.MjSpec.from_file("half_cheetah.xml")
        >>> model = codrl_mj.motorise(spec, {"b.*": my_motor, "f.*": "ideal"}).compile()

    Args:
        spec: the model; it is not changed.
        actuators: what goes where. Keys are regular expressions that an actuator's name, or the name of the joint,
            tendon or site that it drives, matches from beginning to end. Values are actuators, mappings of their
            fields, names of families, files, or `module:NAME`.
        allow_unstable: whether to let an actuator be that its family refuses at the model's step.

    Returns:
        A new spec, to be compiled.

    Raises:
        ValueError: `spec` is none; a pattern matches nothing, or two match the same actuator; an actuator of the model
            cannot be driven like this; or one of ours is not valid, or not stable at the model's step.
    """
    if not isinstance(spec, mujoco.MjSpec):
        given = repr(str(spec)) if isinstance(spec, str | Path) else "FILE"
        raise ValueError(f"spec = {spec!r}: must be a mujoco.MjSpec, such as mujoco.MjSpec.from_file({given})")
    new, model = spec.copy(), spec.copy().compile()
    # MuJoCo 3.17 copies default classes without their numbers, and forgets those that are added then; this numbers them
    new.delete(new.add_default(NAME, new.default))
    chosen = _chosen(new, model, actuators)
    for index, (pattern, actuator) in sorted(chosen.items()):
        reason = _refusal(model, new.actuators[index], index, actuator)
        if reason:
            raise ValueError(f"{_call(new.actuators[index], index)}: cannot be motorised: {reason}")
        try:
            actuator.check_at(model.opt.timestep, allow_unstable)
        except ValueError as error:
            raise ValueError(f"{pattern!r}: {error}") from None
        load_family(type(actuator))
        _drive(new, model, index, actuator)
    new.nuser_actuator = -1  # as many as are needed
    if any(actuator.closes_loops for _, actuator in chosen.values()):
        check_shafts(new.compile(), allow_unstable)
    return new


def _call(target: mujoco.MjsActuator, index: int) -> str:
    """An actuator as messages call it."""
    return f"actuator {target.name or index}" + (f" of {target.target}" if target.target else "")


def resolve_patterns(actuators: Mapping[str, Any], whose: str) -> dict[str, ActuatorModel]:
    """Pattern -> actuator, of whatever a user may write for either; messages call the model `whose`."""
    if not isinstance(actuators, Mapping):
        raise ValueError(f"actuators = {actuators!r}: must be a mapping of patterns, such as {{'.*': 'lag'}}")
    for pattern in actuators:
        check_pattern(pattern)
    return {pattern: resolve(given, None, whose) for pattern, given in actuators.items()}


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
    """Indices of the actuators that a pattern matches, by their `names_of`: of one at least if it is `needed`."""
    matched = [
        index for index, own in enumerate(names) if any(name == pattern or re.fullmatch(pattern, name) for name in own)
    ]
    if needed and not matched:
        known = list(dict.fromkeys(name for own in names for name in own))
        raise ValueError(
            f"{pattern!r}: no actuator has such a name, nor drives anything that has; "
            f"{did_you_mean(pattern, known)}there are {', '.join(known) or 'none'}"
        )
    return matched


def _chosen(
    spec: mujoco.MjSpec, model: mujoco.MjModel, actuators: Mapping[str, Any]
) -> dict[int, tuple[str, ActuatorModel]]:
    """Index -> (pattern, actuator)."""
    found: dict[int, tuple[str, ActuatorModel]] = {}
    names = names_of(model)
    for pattern, actuator in resolve_patterns(actuators, f"the model {spec.modelname!r}").items():
        joints: dict[str, int] = {}
        for index in matched_by(pattern, names):
            target = spec.actuators[index]
            if index in found:
                raise ValueError(f"{_call(target, index)}: both {found[index][0]!r} and {pattern!r} match it")
            if joints.setdefault(target.target, index) != index:
                other = joints[target.target]
                raise ValueError(
                    f"{pattern!r} matches both {_call(spec.actuators[other], other)} and {_call(target, index)}: each "
                    "would be a motor of its own. Give each a pattern of its own if that is meant"
                )
            found[index] = pattern, actuator
    return found


def _refusal(model: mujoco.MjModel, target: mujoco.MjsActuator, index: int, actuator: ActuatorModel) -> str:
    """Why an actuator of a model cannot be motorised; empty if it can."""
    transmission, dynamics = mujoco.mjtTrn(model.actuator_trntype[index]), mujoco.mjtDyn(model.actuator_dyntype[index])
    gain, bias = mujoco.mjtGain(model.actuator_gaintype[index]), mujoco.mjtBias(model.actuator_biastype[index])
    first, second = model.actuator_trnid[index]
    if target.plugin.active:
        return f"it is a plugin, {target.plugin.plugin_name}"
    for kind, known in ((dynamics, _DYNAMICS), (gain, _GAINS), (bias, _BIASES), (transmission, _SHAFTS)):
        if kind not in known:
            return f"its force is not gain*input + bias over one shaft, but {kind.name}"
    if model.actuator_ctrlnum[index] != 1 or model.actuator_outnum[index] != 1:
        return f"it has {model.actuator_ctrlnum[index]} controls and {model.actuator_outnum[index]} forces, not one"
    if transmission in ON_JOINT and mujoco.mjtJoint(model.jnt_type[first]) not in _JOINTS:
        return "its joint is neither a hinge nor a slide"
    if transmission == mujoco.mjtTrn.mjTRN_SITE and second >= 0:
        return "its site has a reference site"
    if transmission == mujoco.mjtTrn.mjTRN_TENDON and model.tendon_actfrclimited[first]:
        return "its tendon limits the force of its actuators (actuatorfrclimited), which MuJoCo does not do for plugins"
    if model.actuator_delay[index]:
        return "its control is delayed (delay), which MuJoCo does not tell plugins"
    if actuator.MOTION and dynamics != mujoco.mjtDyn.mjDYN_NONE:
        return "its control is filtered before it becomes what a servo is asked for"
    if actuator.additions.friction and transmission not in (*ON_JOINT, mujoco.mjtTrn.mjTRN_TENDON):
        return "it drives neither a joint nor a tendon, which the friction that its motor brings would need"
    if model.actuator_user[index].any():
        return "it has user data, where its motor's parameters have to go"
    return ""


def _drive(spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> None:
    """Make an actuator of a spec one of ours.

    The old `model` is compiled: it has what defaults, `inheritrange` and automatic limits come to.
    """
    target, name = spec.actuators[index], f"{NAME}.{index}"
    if actuator.MOTION:  # its own loops take the place of the model's
        target.gaintype, target.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        target.gainprm[:], target.biasprm[:] = [1.0] + [0.0] * (mujoco.mjNGAIN - 1), 0.0
    # XML has no other place for gain and bias of a plugin's actuator than a default class: without them a saved model
    # would have other forces, and other derivatives of them in the implicit integrators. A class that differs in
    # nothing from its parent is not saved: then it is the parent
    default, fields = spec.default, ("gaintype", "gainprm", "biastype", "biasprm")
    if not all(np.array_equal(getattr(target, field), getattr(default.actuator, field)) for field in fields):
        default = spec.add_default(name, default)
        for field in fields:
            setattr(default.actuator, field, getattr(target, field))
    target.classname = default
    control = model.actuator_ctrladr[index]
    target.inheritrange = 0.0
    target.ctrllimited, target.ctrlrange = int(model.actuator_ctrllimited[control]), model.actuator_ctrlrange[control]
    target.forcelimited, target.forcerange = int(model.actuator_forcelimited[index]), model.actuator_forcerange[index]
    target.actlimited, target.actrange = int(model.actuator_actlimited[index]), model.actuator_actrange[index]
    spec.activate_plugin(NAME)
    spec.add_plugin(name=name, plugin_name=NAME).config = {FAMILY: reference(type(actuator))}
    target.plugin.plugin_name, target.plugin.name, target.plugin.active = NAME, name, True
    target.userdata = [*user_head(type(actuator)), actuator.arm_radius, *actuator.numbers]
    added = actuator.additions
    target.armature += added.armature
    target.damping[0] += added.damping
    if added.friction:
        on_joint = mujoco.mjtTrn(model.actuator_trntype[index]) in ON_JOINT
        driven = spec.joint(target.target) if on_joint else spec.tendon(target.target)
        driven.frictionloss += added.friction * abs(model.actuator_gear[model.actuator_outadr[index], 0])
