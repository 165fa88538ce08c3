"""Actuators of a model that get motors: patterns of names, and reasons against a motor.

The module needs no numba, so that adapters to other simulators can use it where numba is missing.
"""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import mujoco

from codrl_mj.actuators import ActuatorModel, ActuatorSetting, resolve
from codrl_mj.fields import check_pattern, did_you_mean

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


class AddedMotor(NamedTuple):
    """Motor that was added to a model, and the model's actuators whose force it delivers."""

    pattern: str
    actuator: ActuatorModel
    indices: tuple[int, ...]
    """Indices of actuators of one joint; the first delivers the motor's force, the others none."""


def describe_actuator(target: mujoco.MjsActuator, index: int) -> str:
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


def motors_to_add(
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
                    f"{describe_actuator(target, index)}: both {matched[index]!r} and {pattern!r}"
                    " match it"
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
        [describe_actuator(spec.actuators[index], index) for index in indices],
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


def check_motors(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    added: Sequence[AddedMotor],
    allow_unstable: bool,
) -> None:
    """Raise if an actuator of a model cannot have its motor, or a motor is unstable by itself.

    Raises:
        ValueError: the message names the actuator, or the pattern, and the reason.
    """
    for pattern, actuator, indices in added:
        for index in indices:
            target = spec.actuators[index]
            reason = _refusal(model, target, index, actuator)
            if reason:
                raise ValueError(
                    f"{describe_actuator(target, index)}: cannot have a motor: {reason}"
                )
        try:
            actuator.check_at(model.opt.timestep, allow_unstable)
        except ValueError as error:
            raise ValueError(f"{pattern!r}: {error}") from None


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
