"""Actuators in a task's MJCF model, for the control-callback backend."""

import mujoco

from codrl_mj import engine
from codrl_mj.actuators import ActuatorModel, Ideal, JointAdditions
from codrl_mj.engine.families import SIGNATURE, slot_size, user_header
from codrl_mj.engine.hill import HILL_NAMES
from codrl_mj.engine.mounting import is_in_callback
from codrl_mj.engine.reading import motors
from codrl_mj.physics.base import SimulationConfig
from codrl_mj.tasks.base import INTEGRATORS
from codrl_mj.user_code import asset_path


def configure_actuator(
    target: mujoco.MjsActuator, actuator: ActuatorModel, max_force: float | None
) -> None:
    """Configure an actuator of an `MjSpec` for the callback backend; if ideal, as a `<motor>`.

    Its gear, control, dynamics, gain and bias are overwritten. `max_force` limits the desired force
    [N] or torque [N*m] at the joint.
    """
    ideal, family, arm = isinstance(actuator, Ideal), type(actuator), actuator.arm_radius
    target.gear = [1.0 / arm, 0, 0, 0, 0, 0]
    target.ctrllimited = int(max_force is not None)
    target.ctrlrange = [0.0, 0.0] if max_force is None else [-max_force * arm, max_force * arm]
    target.dyntype = mujoco.mjtDyn.mjDYN_NONE if ideal else mujoco.mjtDyn.mjDYN_USER
    target.actdim = 0 if ideal else slot_size(family)
    target.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    target.gainprm = [float(ideal)] + [0.0] * (mujoco.mjNGAIN - 1)
    target.biastype = mujoco.mjtBias.mjBIAS_NONE if ideal else mujoco.mjtBias.mjBIAS_USER
    target.userdata = [] if ideal else [*user_header(family), *actuator.parameter_values]


def hills(model: mujoco.MjModel) -> list[int]:
    """Return the slide joints of a model that follow a hill, see `codrl_mj.engine.hill`.

    Raises:
        ValueError: a joint's user data has this package's signature, but is no valid hill.
    """
    joints = []
    for index in range(model.njnt):
        user = model.jnt_user[index]
        if len(user) < 2 or tuple(user[:2]) != SIGNATURE:
            continue
        name = model.joint(index).name or f"joint {index}"
        if len(user) < len(HILL_NAMES):
            raise ValueError(
                f"{name}: user = {list(user)}: a hill of codrl_mj needs {', '.join(HILL_NAMES)}"
            )
        if model.jnt_type[index] != mujoco.mjtJoint.mjJNT_SLIDE or list(model.jnt_axis[index]) != [
            1.0,
            0.0,
            0.0,
        ]:
            raise ValueError(f'{name}: a hill of codrl_mj needs type="slide" and axis="1 0 0"')
        joints.append(index)
    return joints


def needed_callbacks(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the groups of callbacks, as in `codrl_mj.engine.install`, that a model needs.

    Raises:
        ValueError: the user data of an actuator or joint has this package's signature, but not its
            layout.
    """
    callback_motors = [index for index in motors(model) if is_in_callback(model, index)]
    return tuple(
        group for group, needed in (("motor", callback_motors), ("hill", hills(model))) if needed
    )


def install_callbacks(model: mujoco.MjModel) -> None:
    """Compile the families of a model's actuators, and install the callbacks that it needs.

    A model without actuators or hills of this package needs none.

    Args:
        model: any MuJoCo model.

    Raises:
        ValueError: the user data of an actuator or joint has this package's signature, but not its
            layout.
        CallbackInUseError: another library installed a callback; nothing was changed.
    """
    for actuator in motors(model).values():
        engine.load_family(type(actuator))
    groups = needed_callbacks(model)
    if groups:
        engine.install(*groups)


def task_model(simulation: SimulationConfig) -> mujoco.MjModel:
    """Compile the model of a simulation.

    MuJoCo's automatic reset is disabled, so that a divergence can be detected and reported.
    With the explicit Euler integrator, joint damping is explicit, too.
    """
    task = simulation.task
    try:
        spec = mujoco.MjSpec.from_file(str(asset_path(task.asset)))
    except ValueError as error:
        raise ValueError(f"{task.asset}: {' '.join(str(error).split())}") from error
    if unsupported := [
        name for name in task.integrators if INTEGRATORS[name] != spec.option.integrator
    ]:
        kind = mujoco.mjtIntegrator(spec.option.integrator).name.removeprefix("mjINT_")
        raise ValueError(
            f"{task.asset}: its <option> has integrator {kind}, so Task.integrators cannot have"
            f" {', '.join(unsupported)}"
        )
    if task.apply_options is not None:
        task.apply_options(spec, simulation.options)
    spec.option.timestep = simulation.timestep
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if simulation.integrator == "euler":
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    joint = JointAdditions(
        simulation.joint.armature, simulation.joint.damping, simulation.joint.friction
    )
    for name, actuator, limit in zip(
        task.motors, simulation.actuators, simulation.max_forces.tolist(), strict=True
    ):
        motor = spec.actuator(name)
        if motor is None:
            names = ", ".join(repr(a.name) for a in spec.actuators) or "none"
            raise ValueError(
                f"{task.asset} has no actuator {name!r}; its actuators are {names}:"
                " rename it, or set Task.motors"
            )
        joint_driven = (
            spec.joint(motor.target) if motor.trntype == mujoco.mjtTrn.mjTRN_JOINT else None
        )
        if joint_driven is None or joint_driven.type not in _SCALAR_JOINTS:
            raise ValueError(f"{task.asset}: actuator {name!r} must drive a hinge or a slide joint")
        _check_direct_drive(task.asset, spec.option, motor, joint_driven)
        configure_actuator(motor, actuator, limit)
        for added in (joint, actuator.additions):
            joint_driven.armature += added.armature
            joint_driven.damping[0] += added.damping
            if added.friction:
                joint_driven.frictionloss += added.friction
                spec.option.disableflags = flags_with_friction(spec.option.disableflags)
    # Without a skybox the background would be black.
    if all(texture.type != mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        kind, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        sky = spec.add_texture(type=kind, builtin=gradient, width=64, height=64)
        sky.rgb1, sky.rgb2 = [0.93, 0.95, 0.97], [0.76, 0.82, 0.88]
    model = spec.compile()
    if (model.nq, model.nv) != (len(task.qpos), len(task.qvel)):
        raise ValueError(
            f"{task.asset} has {model.nq} positions and {model.nv} velocities, but {task.name}'s"
            f" state_names have {len(task.qpos)} and {len(task.qvel)} of them:"
            f" {', '.join(task.state_names)}"
        )
    return model


def _check_direct_drive(
    asset: str, option: mujoco.MjOption, motor: mujoco.MjsActuator, joint: mujoco.MjsJoint
) -> None:
    """Raise if the model itself changes the motor's force, which no signal would show."""
    elements = {
        "its gear": (
            list(motor.gear) != [1, 0, 0, 0, 0, 0] and tuple(motor.userdata)[:2] != SIGNATURE
        ),
        "its forcerange": any(motor.forcerange),
        "its delay": motor.delay,
        "its group, which <option> disables": option.disableactuator >> motor.group & 1,
        f"the actuatorfrcrange of joint {joint.name!r}": any(joint.actfrcrange),
    }
    for element in (element for element, is_set in elements.items() if is_set):
        raise ValueError(
            f"{asset}: actuator {motor.name!r}: leave out {element}; set gears and limits in the"
            " actuator (gear_ratio, arm_radius, max_current) and in Task.max_force"
        )


_SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def flags_with_friction(flags: int) -> int:
    """Return `disableflags` changed so that joints can have friction.

    In MuJoCo friction is a constraint and needs the solver, which the tasks' models disable. Warm
    starts are disabled, so that a step depends on the state alone.
    """
    return flags & ~int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) | int(
        mujoco.mjtDisableBit.mjDSBL_WARMSTART
    )
