"""Models of other simulators with motors: `prepare_model`.

mujoco_warp, mjlab and MJX run a MuJoCo model, but not our plugin. They get a changed model, which
has the motors' inertia and friction in its joints, and the motors themselves as a list.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, ActuatorSetting
from codrl_mj.engine.joint_dynamics import (
    describe_bypasses,
    describe_duplicate_dynamics,
    remove_dynamics,
    warn_once,
)
from codrl_mj.engine.matching import (
    AddedMotor,
    Pattern,
    check_motors,
    describe_actuator,
    motors_to_add,
)
from codrl_mj.engine.shafts import check_shafts
from codrl_mj.fields import check_joint_dynamics


class SimulatorMotor(NamedTuple):
    """Motor behind one actuator of a model."""

    actuator_index: int
    """Index of the model's actuator."""
    actuator: ActuatorModel
    """The motor."""
    min_force: float
    """Lowest force that the model's actuator delivers [N] or [N*m]; `-inf` without a limit."""
    max_force: float
    """Highest force that the model's actuator delivers [N] or [N*m]; `inf` without a limit."""


class SimulatorModel(NamedTuple):
    """Model for another simulator, and the motors that act in it."""

    spec: mujoco.MjSpec
    """Changed copy of the model, to be compiled for the simulator."""
    motors: tuple[SimulatorMotor, ...]
    """The motors, in ascending order of their actuators."""
    names: tuple[tuple[str, ...], ...]
    """Names that patterns can match, for each motor: the actuator's and the joint's."""
    timestep: float
    """Mechanical step [s] at which the motors were found to be stable."""
    integrator: int
    """MuJoCo's number of the integrator."""
    allow_unstable: bool
    """True if motors may be unstable at this step."""


def prepare_model(
    model: mujoco.MjSpec | str | Path,
    actuators: Mapping[Pattern, ActuatorSetting],
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
) -> SimulatorModel:
    """Put motors behind actuators of a model for another simulator.

    A motor's inertia and damping, times the square of the actuator's gear, and its friction are
    added to the joint, because MJX, and mujoco_warp before 4.0, ignore an actuator's `armature`.
    The model's actuator keeps its gain, bias and ranges. Its force is the command of the motor;
    behind a servo, it passes the control.

        >>> robot = prepare_model("robot.xml", {".*hip": "maxon-ec45-flat-50w", ".*knee": "lag"})
        >>> model = robot.spec.compile()

    Args:
        model: the model, which is not changed, or its XML file.
        actuators: pattern -> motor, as for `codrl_mj.add_motors`.
        allow_unstable: accept motors that are unstable at the model's step.
        joint_dynamics: as for `codrl_mj.add_motors`.

    Raises:
        ValueError: see `codrl_mj.add_motors`; or an actuator has a kind that the adapters refuse:
            it drives no joint, has activation dynamics, or shares its motor; or a motor shares
            its supply.
    """
    check_joint_dynamics(joint_dynamics)
    spec = _read_spec(model)
    compiled = spec.copy().compile()
    added = motors_to_add(spec, compiled, actuators)
    _check_kinds(spec, compiled, added)
    check_motors(spec, compiled, added, allow_unstable)
    motor_of = {motor.indices[0]: motor.actuator for motor in added}
    for index, actuator in motor_of.items() if joint_dynamics == "replace" else ():
        remove_dynamics(spec, compiled, index, actuator)
    motors = tuple(
        _add_to_joint(spec, compiled, index, actuator) for index, actuator in motor_of.items()
    )
    arms = {index: actuator.arm_radius for index, actuator in motor_of.items()}
    check_shafts(spec.copy().compile(), motor_of, arms, allow_unstable)
    texts = describe_bypasses(compiled, added)
    if joint_dynamics is None:
        texts += describe_duplicate_dynamics(compiled, motor_of)
    for text in texts:
        warn_once(f"the model {spec.modelname!r}: {text}")
    names = [
        (target.name, target.target) if target.name else (target.target,)
        for target in (spec.actuators[index] for index in motor_of)
    ]
    options = compiled.opt
    return SimulatorModel(
        spec, motors, tuple(names), options.timestep, int(options.integrator), allow_unstable
    )


def _read_spec(model: mujoco.MjSpec | str | Path) -> mujoco.MjSpec:
    """Return a copy of a spec, or the spec of an XML file."""
    if isinstance(model, mujoco.MjSpec):
        return model.copy()
    if isinstance(model, str | Path) and Path(model).is_file():
        return mujoco.MjSpec.from_file(str(model))
    raise ValueError(f"model = {model!r}: must be a mujoco.MjSpec, or the path of an XML file")


def _check_kinds(spec: mujoco.MjSpec, model: mujoco.MjModel, added: Sequence[AddedMotor]) -> None:
    """Raise if the adapters refuse the kind of a model or of one of its actuators."""
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        raise ValueError(
            f"the model {spec.modelname!r} lets bodies sleep, which was not tested with motors of"
            " other simulators: remove the flag 'sleep'"
        )
    for motor in added:
        index = motor.indices[0]
        description = describe_actuator(spec.actuators[index], index)
        if len(motor.indices) > 1:
            raise ValueError(
                f"{motor.pattern!r}: several actuators cannot share a motor in another simulator:"
                " drive the joint by one actuator"
            )
        if motor.actuator.SHARES_SUPPLY:
            raise ValueError(
                f"{description}: its motor is a {type(motor.actuator).__name__}, whose supply no"
                " other simulator shares among motors: use the family drive, or add_motors"
            )
        if reason := _refused_kind(model, index):
            raise ValueError(f"{description}: cannot have a motor in another simulator: {reason}")


def _refused_kind(model: mujoco.MjModel, index: int) -> str:
    """Return why the adapters refuse an actuator of a model; empty if they take it."""
    transmission = mujoco.mjtTrn(model.actuator_trntype[index])
    dynamics = mujoco.mjtDyn(model.actuator_dyntype[index])
    group = int(model.actuator_group[index])
    if transmission != mujoco.mjtTrn.mjTRN_JOINT:
        return f"it drives no joint but has {transmission.name}; use codrl_mj.add_motors"
    if dynamics != mujoco.mjtDyn.mjDYN_NONE:
        return f"it has activation dynamics, {dynamics.name}; use codrl_mj.add_motors"
    if model.actuator_armature[index] or np.any(model.actuator_damping[index]):
        return (
            "it has an armature or a damping of its own, which some simulators ignore: move them to"
            " the joint, times the square of the gear"
        )
    if 0 <= group < mujoco.mjNGROUP and model.opt.disableactuator >> group & 1:
        return f"its group {group} is disabled"
    return ""


def _add_to_joint(
    spec: mujoco.MjSpec, model: mujoco.MjModel, index: int, actuator: ActuatorModel
) -> SimulatorMotor:
    """Add a motor's inertia and friction to the joint of its actuator, and return the motor."""
    target, additions = spec.actuators[index], actuator.additions
    gear = abs(float(model.actuator_gear[model.actuator_outadr[index], 0]))
    joint = spec.joint(target.target)
    joint.armature += additions.armature * gear**2
    joint.damping[0] += additions.damping * gear**2
    joint.frictionloss += additions.friction * gear
    low, high = -np.inf, np.inf
    if model.actuator_forcelimited[index]:
        low, high = map(float, model.actuator_forcerange[index])
    if actuator.MOTION:
        # The servo's loops replace the model's gain and bias, and its control is no force.
        target.gaintype, target.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        target.gainprm[:], target.biasprm[:] = [1.0] + [0.0] * (mujoco.mjNGAIN - 1), 0.0
        target.forcelimited = int(mujoco.mjtLimited.mjLIMITED_FALSE)
    return SimulatorMotor(index, actuator, low, high)
