"""Dynamics that a model and its motors may both have, and forces that bypass the motors.

The module needs no numba, so that adapters to other simulators can use it where numba is missing.
"""

import sys
import warnings
from collections.abc import Mapping, Sequence

import mujoco

from codrl_mj.actuators import ActuatorModel, JointAdditions
from codrl_mj.engine.matching import ON_JOINT, AddedMotor

_DYNAMICS_NAMES = "armature", "damping", "frictionloss"
"""MuJoCo's names for the entries of `JointAdditions`."""
_NEGLIGIBLE = 0.05
"""Largest ratio of the model's value to the motor's that causes no warning.

So small a value is probably the bearing's, and counting it twice changes little.
"""


class MotorWarning(UserWarning):
    """Warning that a model already has a motor's dynamics, or forces that bypass a motor."""


def _added_dynamics(actuator: ActuatorModel, gear: float = 1.0) -> JointAdditions:
    """Return the motor's dynamics at its joint, beyond a gear; back-EMF counts as damping."""
    armature, damping, friction = actuator.additions
    delivered = actuator.delivered_friction
    damping += delivered.damping + actuator.back_emf_damping
    return JointAdditions(
        gear**2 * armature, gear**2 * damping, abs(gear) * (friction + delivered.friction)
    )


def remove_dynamics(
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


def describe_bypasses(model: mujoco.MjModel, added: Sequence[AddedMotor]) -> list[str]:
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
    supplies = {
        names[motor.indices[0]]: getattr(motor.actuator, "supply", None)
        for motor in added
        if not motor.actuator.SHARES_SUPPLY
    }
    sagging = [name for name, supply in supplies.items() if getattr(supply, "resistance", 0.0)]
    if len(sagging) > 1:
        texts.append(
            f"supply.resistance: each of the motors {', '.join(sagging)} has a separate supply: on"
            " one battery the current of each would lower the voltage of all, as it does with the"
            " family shared_drive"
        )
    return texts


_WARNED: set[str] = set()
"""Texts of the warnings that this process has shown."""
_INNER_PACKAGES = {"codrl_mj", "gymnasium", "dm_control", "contextlib"}
"""Packages whose frames lie between a user's line and `warn_once`."""


def warn_once(text: str) -> None:
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
