"""What a task asks of an actuator: the joint's torque and speed at every integration step of runs on the ideal one."""

import contextlib
import dataclasses
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.fields import did_you_mean
from codrl_mj.sizing.swing import Swing

EPISODES = 10
"""Episodes that a demand is taken from unless told otherwise."""


@dataclasses.dataclass(frozen=True)
class Demand:
    """The operating points of one joint over T steps; of a slide in N, m/s and m/s^2.

    Where the task stops the joint, at walls and limits of its speed, `acceleration` is that of the
    stop: it asks the motor for more than the wall would.
    """

    source: str
    """Where it is from, in words."""
    duration: np.ndarray
    """Of each step [s], shape (T,)."""
    torque: np.ndarray
    """Torque at the joint [N*m], shape (T,)."""
    speed: np.ndarray
    """Speed of the joint [rad/s] at the step's start, shape (T,): what a drive sees in it."""
    acceleration: np.ndarray
    """Of the joint [rad/s^2], by differences, shape (T,)."""
    episodes: int = 1
    """How many runs it holds."""
    exact: bool = False
    """Whether it has to be delivered as it is; otherwise another policy may do the task with less."""
    linear: bool = False
    """Whether the joint is a slide."""
    servo: bool = False
    """True if the model's own position or velocity servo makes the torque; with less torque it arrives later."""
    swing: Swing | None = None
    """The pendulum, where the task is to swing one up."""
    model_gear: float = 1.0
    """Of the model's actuator, of somebody else's: what turns its force into the joint's torque;
    the motor's gear, and what is asked of it, are at the joint.
    """


def demand_of(
    what: str | Path,
    episodes: int = EPISODES,
    seed: int = 0,
    trust: bool = False,
    motor: str | None = None,
) -> Demand:
    """What a task, a trained run or a recording asks of an actuator: `demands_of`, of the `motor` that is named.

    Raises:
        ValueError: as `demands_of`; or there are several motors and none of them is named, or
            another.
    """
    found = demands_of(what, episodes, seed, trust)
    if motor is None and len(found) > 1:
        raise ValueError(f"{what} has {len(found)} motors: motor must be one of {', '.join(found)}")
    if motor is None:
        return next(iter(found.values()))
    if motor not in found:
        names = ", ".join(name for name in found if name) or "none that has a name: leave it out"
        raise ValueError(f"motor = {motor!r}: {did_you_mean(motor, found)}there are {names}")
    return found[motor]


def demands_of(
    what: str | Path, episodes: int = EPISODES, seed: int = 0, trust: bool = False
) -> dict[str, Demand]:
    """What a task, a trained run or a recording asks of its motors, by their names; of a single one the name is empty.

    Args:
        what: a task's name, which a scripted controller drives; the folder of a run that was
            trained on the ideal actuator, of a task or of an environment of somebody else's; or an
            `.npz` file with the arrays `time` [s], `torque` [N*m] and `speed` [rad/s] at the joint.
        episodes: runs to take it from.
        seed: of the first of them.
        trust: whether to import the modules of a run folder's task or agent if they are somebody's
            own.

    Raises:
        ValueError: it is none of these; the run was trained on another actuator; there is no
            scripted controller.
    """
    path = Path(what)
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                found = demand_from_arrays(
                    archive["time"],
                    archive["torque"],
                    archive["speed"],
                    f"the recording {path.name}",
                )
        except (
            KeyError,
            ValueError,
            EOFError,
            NotImplementedError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise ValueError(
                f"{path}: no recording of the arrays time, torque and speed: {error}"
            ) from None
        return {"": found}
    from codrl_mj.envs.config import EnvConfig
    from codrl_mj.evaluation import run_episodes

    if path.is_dir():
        from codrl_mj.runs.policies import load_policy
        from codrl_mj.training.folder import load_config

        env = load_config(path, trust).env
        if others := [one.family for one in env.actuators if one != IDEAL]:
            raise ValueError(
                f"{path}: was trained on {others[0]}: must be ideal, whose torques are the task's"
                " and not a motor's; train it with --actuator ideal, or name the task instead"
            )
        env = env.world.as_with_motors(env)
        ran = run_episodes(load_policy(path, trust), env.make, episodes, seed)
        return _gathered(f"the policy {path.name} of {env.task}", env, ran)
    from codrl_mj.sizing.scripted import Scripted, observe_state

    env = EnvConfig(str(what), "ideal")
    policy, env = Scripted(env.world.scripted), env.world.as_with_motors(env)
    ran = run_episodes(policy, lambda: observe_state(env.make()), episodes, seed)
    return _gathered(f"{policy.description} of {env.world.name}", env, ran)


def demand_from_arrays(time: Any, torque: Any, speed: Any, source: str = "a recording") -> Demand:
    """A demand from arrays of one's own, to be delivered as it is.

    Args:
        time: [s], shape (T,), T >= 2, increasing.
        torque: at the joint [N*m], shape (T,).
        speed: of the joint [rad/s], shape (T,).
        source: where it is from.

    Raises:
        ValueError: shapes differ, a value is not finite, or time does not increase.
    """
    arrays = {
        name: np.asarray(given, float)
        for name, given in (("time", time), ("torque", torque), ("speed", speed))
    }
    for name, array in arrays.items():
        if array.ndim != 1 or len(array) < 2 or array.shape != arrays["time"].shape:
            raise ValueError(
                f"{name}: shape {array.shape}: must be (T,), T >= 2, the same for time, torque and"
                " speed"
            )
        if not np.isfinite(array).all():
            where = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ValueError(
                f"{name}[{where}] = {array[where]}: must be finite; leave out what was not measured"
            )
    steps = np.diff(arrays["time"])
    if not (steps > 0.0).all():
        where = int(np.flatnonzero(steps <= 0.0)[0]) + 1
        raise ValueError(
            f"time[{where}] = {arrays['time'][where]:g} s: must be above the one before; sort the"
            " samples"
        )
    acceleration = np.gradient(arrays["speed"], arrays["time"])
    duration = np.append(steps, steps[-1])
    return Demand(source, duration, arrays["torque"], arrays["speed"], acceleration, exact=True)


def _gathered(source: str, env: Any, ran: Sequence[Any]) -> dict[str, Demand]:
    """The demands on all motors, from episodes of one environment."""
    import mujoco

    from codrl_mj.engine.reading import motors
    from codrl_mj.engine.specs import ON_JOINT

    swing, ends = None, [env.world.at_goal(one) for one in ran]
    if all(end is not None for end in ends):
        source = (
            f"{source}, {sum(bool(end[-1]) for end in ends if end is not None)} of {len(ran)}"
            " episodes at the goal"
        )
    with contextlib.closing(env.make()) as made:
        core: Any = made.unwrapped
        if env.task == "pendulum":
            length = core.l
            inertia, gravity = (
                core.m * length**2 / 3.0 + env.joint.armature,
                core.m * core.g * length / 2.0,
            )
            swing = Swing(
                inertia,
                gravity,
                float(core.task.max_forces[0]),
                env.joint.damping,
                env.joint.friction,
            )
        model = core.model
        driven = list(motors(model)) or [
            model.actuator(name).id for name in made.get_wrapper_attr("recorder").motor_names
        ]
    speeds, forces = (
        [np.column_stack([one.trace[name]]) for one in ran] for name in ("speed", "actual_force")
    )
    found = {}
    for number, index in enumerate(driven):
        name = ran[0].motors[number] if ran[0].motors else ""
        before = [
            np.append(one.first_speeds[number], each[:, number])
            for one, each in zip(ran, speeds, strict=True)
        ]
        kind, joint = mujoco.mjtTrn(model.actuator_trntype[index]), model.actuator_trnid[index, 0]
        sliding = kind in ON_JOINT and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        gear = abs(float(model.actuator_gear[model.actuator_outadr[index], 0])) or 1.0
        found[name] = Demand(
            source=f"{source}: {name}" if name else source,
            duration=np.full(sum(len(one) - 1 for one in before), ran[0].timestep),
            torque=gear * np.concatenate([force[:, number] for force in forces]),
            speed=np.concatenate([one[:-1] for one in before]) / gear,
            acceleration=np.concatenate([np.diff(one) / ran[0].timestep for one in before]) / gear,
            episodes=len(ran),
            linear=bool(sliding),
            servo=bool(np.any(model.actuator_biasprm[index, 1:3])),
            swing=swing,
            model_gear=gear,
        )
    return found
