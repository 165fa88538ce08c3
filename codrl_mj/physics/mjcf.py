"""Puts an `Actuator` into an MJCF actuator, and reads it back."""

import mujoco
import numpy as np

from codrl_mj import callbacks
from codrl_mj.callbacks import ACT_NAMES, HILL_NAMES, IMPERFECT_ACT_NAMES
from codrl_mj.disturbances import OFF, Disturbances
from codrl_mj.motor import Actuator, from_vector, to_vector
from codrl_mj.motor.parameters import IMPERFECTION_NAMES, PARAMETER_NAMES, SIGNATURE
from codrl_mj.tasks import Task
from codrl_mj.tasks.assets import asset_path


def set_actuator(
    target: mujoco.MjsActuator, actuator: Actuator | None, max_force: float | None, disturbances: Disturbances = OFF
) -> None:
    """Make an actuator of an `MjSpec` one of our motors, or an ideal one.

    Call `install_callbacks` before simulating a model that holds our motors.

    Args:
        target: the actuator, with its joint transmission set; its gear, dynamics, gain, bias, range and user data are
            overwritten.
        actuator: motor and current loop; None makes a plain `<motor>` of gear 1.
        max_force: limit of the desired force [N] or torque [N*m] at the joint; None for no limit.
        disturbances: bias and noise of the current sensor and resistance of the supply; the others are not the
            actuator's.

    Raises:
        ValueError: an ideal actuator has no sensor and no supply.
    """
    if actuator is None and disturbances.of_motor:
        raise ValueError(f"{disturbances}: the ideal actuator has no current sensor and no supply")
    ideal = actuator is None
    arm = 1.0 if actuator is None else actuator.motor.arm_radius
    target.gear = [1.0 / arm, 0, 0, 0, 0, 0]
    target.ctrllimited = int(max_force is not None)
    target.ctrlrange = [0.0, 0.0] if max_force is None else [-max_force * arm, max_force * arm]
    target.dyntype = mujoco.mjtDyn.mjDYN_NONE if ideal else mujoco.mjtDyn.mjDYN_USER
    target.actdim = 0 if ideal else len(IMPERFECT_ACT_NAMES if disturbances.of_motor else ACT_NAMES)
    target.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    target.gainprm = [float(ideal)] + [0.0] * (mujoco.mjNGAIN - 1)
    target.biastype = mujoco.mjtBias.mjBIAS_NONE if ideal else mujoco.mjtBias.mjBIAS_USER
    target.userdata = [] if actuator is None else to_vector(actuator) + imperfections(disturbances)


def imperfections(disturbances: Disturbances) -> list[float]:
    """What follows the parameter vector in the `user` data, as in `IMPERFECTION_NAMES`; nothing if all is perfect."""
    return [getattr(disturbances, name) for name in IMPERFECTION_NAMES] if disturbances.of_motor else []


def _is_imperfect(model: mujoco.MjModel, index: int) -> bool:
    return model.actuator_actnum[index] == len(IMPERFECT_ACT_NAMES)


def motors(model: mujoco.MjModel) -> dict[int, Actuator]:
    """Our motors in a compiled model.

    Args:
        model: any MuJoCo model.

    Returns:
        The actuator (motor, arm, controller) by actuator index, in order.

    Raises:
        ValueError: an actuator carries our signature but not our layout, or a parameter out of bounds; or it uses
            MuJoCo's actuator delay, which the callback does not see, a gain, which would add to the motor's torque, or
            limits of its activations, which are the motor's state.
    """
    found = {}
    for index in range(model.nactuator):
        user = model.actuator_user[index]
        if len(user) == 0 or user[0] != SIGNATURE:
            continue
        name = model.actuator(index).name or f"actuator {index}"
        act_size = len(IMPERFECT_ACT_NAMES if _is_imperfect(model, index) else ACT_NAMES)
        user_size = len(PARAMETER_NAMES) + len(IMPERFECTION_NAMES)
        if _is_imperfect(model, index) and not (
            len(user) >= user_size and np.isfinite(user[len(PARAMETER_NAMES) : user_size]).all()
        ):
            raise ValueError(
                f"{name}: user = {list(user)}: a motor of codrl_mj with {len(IMPERFECT_ACT_NAMES)} activations needs "
                f"{user_size} numbers, the last of them {', '.join(IMPERFECTION_NAMES)}, finite"
            )
        expected = {
            "dyntype": (model.actuator_dyntype[index], mujoco.mjtDyn.mjDYN_USER, 'dyntype="user"'),
            "biastype": (model.actuator_biastype[index], mujoco.mjtBias.mjBIAS_USER, 'biastype="user"'),
            "actdim": (model.actuator_actnum[index], act_size, f'actdim="{act_size}"'),
            "delay": (model.actuator_delay[index], 0.0, 'delay="0"'),
            "gaintype": (model.actuator_gaintype[index], mujoco.mjtGain.mjGAIN_FIXED, 'gaintype="fixed"'),
            "gainprm": (model.actuator_gainprm[index, 0], 0.0, 'gainprm="0"'),
            "actlimited": (model.actuator_actlimited[index], False, 'actlimited="false"'),
        }
        for field, (value, wanted, remedy) in expected.items():
            if value != wanted:
                raise ValueError(f"{name}: {field} = {value:g}: a motor of codrl_mj needs {remedy}")
        gear = model.actuator_gear[model.actuator_outadr[index]]
        if not gear[0] > 0 or np.any(gear[1:]):
            raise ValueError(f"{name}: gear = {gear}: a motor of codrl_mj needs gear = 1/arm > 0 and no other entry")
        try:
            found[index] = from_vector(user[: len(PARAMETER_NAMES)], 1.0 / gear[0])
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    return found


def hills(model: mujoco.MjModel) -> list[int]:
    """The joints of a compiled model that run over one of our hills (see `codrl_mj.callbacks.hill`).

    Raises:
        ValueError: a joint carries our signature but not our layout.
    """
    found = []
    for index in range(model.njnt):
        user = model.jnt_user[index]
        if len(user) == 0 or user[0] != SIGNATURE:
            continue
        name = model.joint(index).name or f"joint {index}"
        if len(user) < len(HILL_NAMES):
            raise ValueError(f"{name}: user = {list(user)}: a hill of codrl_mj needs {', '.join(HILL_NAMES)}")
        if model.jnt_type[index] != mujoco.mjtJoint.mjJNT_SLIDE or list(model.jnt_axis[index]) != [1.0, 0.0, 0.0]:
            raise ValueError(f'{name}: a hill of codrl_mj needs type="slide" and axis="1 0 0"')
        found.append(index)
    return found


def needed_callbacks(model: mujoco.MjModel) -> tuple[str, ...]:
    """The parts of our callbacks that a compiled model needs, as `codrl_mj.callbacks.install` takes them.

    Raises:
        ValueError: an actuator or joint carries our signature but not our layout.
    """
    found = motors(model)
    motor = "imperfect_motor" if any(_is_imperfect(model, index) for index in found) else "motor"
    return tuple(part for part, needed in ((motor, found), ("hill", hills(model))) if needed)


def install_callbacks(model: mujoco.MjModel) -> None:
    """Install those of our callbacks that the model needs, which may be none.

    Args:
        model: any MuJoCo model.

    Raises:
        ValueError: an actuator or joint carries our signature but not our layout.
        CallbackInUseError: one of them is somebody else's; nothing was changed.
    """
    parts = needed_callbacks(model)
    if parts:
        callbacks.install(*parts)


def task_model(
    task: Task,
    actuator: Actuator | None,
    timestep: float,
    max_force: float | None = None,
    explicit: bool = False,
    disturbances: Disturbances = OFF,
) -> mujoco.MjModel:
    """Compile a task's model.

    A diverging simulation is left to diverge, so that it can be reported, instead of being reset by the engine. Where
    the Euler integrator is made `explicit`, joint damping is explicit too.

    Joint friction is a constraint of MuJoCo's: for it the solver, which the models switch off, is switched on, and
    starts from nothing at each step, so that a step depends on the state alone.

    Args:
        task: the task.
        actuator: motor and current loop; None is the ideal actuator.
        timestep: integration step [s].
        max_force: limit of the desired force [N] or torque [N*m]; None is the task's.
        explicit: whether the positions will be moved by the old velocity.
        disturbances: of sensor, supply and joint; the others are not the model's.
    """
    spec = mujoco.MjSpec.from_file(str(asset_path(task.asset)))
    spec.option.timestep = timestep
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if explicit:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    motor = spec.actuator("motor")
    set_actuator(motor, actuator, task.max_force if max_force is None else max_force, disturbances)
    joint = spec.joint(motor.target)
    if disturbances.joint_damping:
        joint.damping[0] = disturbances.joint_damping
    if disturbances.joint_friction:
        joint.frictionloss = disturbances.joint_friction
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return spec.compile()
