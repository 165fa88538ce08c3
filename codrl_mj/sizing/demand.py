"""What a task asks of an actuator: the joint's torque and speed at every integration step of runs on the ideal one."""

import dataclasses
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import Ideal
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, run_episodes
from codrl_mj.sizing.scripted import Scripted, StateObserved
from codrl_mj.sizing.swing import Swing
from codrl_mj.tasks import Task, find_task

EPISODES = 10
"""Episodes that a demand is taken from unless told otherwise."""


@dataclasses.dataclass(frozen=True)
class Demand:
    """The operating points of one joint over T steps; of a slide in N, m/s and m/s^2.

    Where the task stops the joint, at walls and limits of its speed, `acceleration` is that of the stop: it asks the
    motor for more than the wall would.
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
    swing: Swing | None = None
    """The pendulum, where the task is to swing one up."""


def demand_of(what: str | Path, episodes: int = EPISODES, seed: int = 0, trust: bool = False) -> Demand:
    """What a task, a trained run or a recording asks of an actuator.

    Args:
        what: a task's name, which a scripted controller drives; the folder of a run that was trained on the ideal
            actuator; or an `.npz` file with the arrays `time` [s], `torque` [N*m] and `speed` [rad/s] at the joint.
        episodes: runs to take it from.
        seed: of the first of them.
        trust: whether to import the modules of a run folder's task or agent if they are somebody's own.

    Raises:
        ValueError: it is none of these; the run was trained on another actuator; the task has several motors.
    """
    path = Path(what)
    if path.suffix == ".npz":
        return _read(path)
    if path.is_dir():
        return _of_run(path, episodes, seed, trust)
    task = find_task(str(what))
    _alone(task)
    env = _resolved(EnvConfig(str(what), "ideal"))
    policy = Scripted(task)
    ran = run_episodes(policy, lambda: StateObserved(env.make()), episodes, seed)
    return _gathered(f"{policy.description} of {task.name}", env, ran)


def recorded(time: Any, torque: Any, speed: Any, source: str = "a recording") -> Demand:
    """A demand from arrays of one's own, to be delivered as it is.

    Args:
        time: [s], shape (T,), T >= 2, increasing.
        torque: at the joint [N*m], shape (T,).
        speed: of the joint [rad/s], shape (T,).
        source: where it is from.

    Raises:
        ValueError: shapes differ, a value is not finite, or time does not increase.
    """
    arrays = {name: np.asarray(given, float) for name, given in (("time", time), ("torque", torque), ("speed", speed))}
    for name, array in arrays.items():
        if array.ndim != 1 or len(array) < 2 or array.shape != arrays["time"].shape:
            raise ValueError(f"{name}: shape {array.shape}: must be (T,), T >= 2, the same for time, torque and speed")
        if not np.isfinite(array).all():
            where = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ValueError(f"{name}[{where}] = {array[where]}: must be finite; leave out what was not measured")
    steps = np.diff(arrays["time"])
    if not (steps > 0.0).all():
        where = int(np.flatnonzero(steps <= 0.0)[0]) + 1
        raise ValueError(f"time[{where}] = {arrays['time'][where]:g} s: must be above the one before; sort the samples")
    acceleration = np.gradient(arrays["speed"], arrays["time"])
    duration = np.append(steps, steps[-1])
    return Demand(source, duration, arrays["torque"], arrays["speed"], acceleration, exact=True)


def _read(path: Path) -> Demand:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return recorded(archive["time"], archive["torque"], archive["speed"], f"the recording {path.name}")
    except (KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no recording of the arrays time, torque and speed: {error}") from None


def _of_run(path: Path, episodes: int, seed: int, trust: bool) -> Demand:
    from codrl_mj.runs.policies import load_policy
    from codrl_mj.training.folder import load_config

    env = load_config(path, trust).env
    _alone(find_task(env.task))
    if not isinstance(env.actuator, Ideal):
        raise ValueError(
            f"{path}: was trained on {env.actuator.family}: must be ideal, whose torques are the task's and not a "
            "motor's; train it with --actuator ideal, or name the task instead"
        )
    env = _resolved(env)
    ran = run_episodes(load_policy(path, trust), env.make, episodes, seed)
    return _gathered(f"the policy {path.name} of {env.task}", env, ran)


def _alone(task: Task) -> None:
    if len(task.motors) > 1:
        raise ValueError(
            f"task {task.name!r} has {len(task.motors)} motors: must have one; record time, torque and speed of each "
            "joint, and give them as .npz files"
        )


def _resolved(env: EnvConfig) -> EnvConfig:
    """The environment in the engine, with the integration steps that a motor would have."""
    if env.inner_steps is None and env.timestep is None:
        env = dataclasses.replace(env, inner_steps=find_task(env.task).motor_inner_steps)
    return dataclasses.replace(env, physics="mujoco")


def _gathered(source: str, env: EnvConfig, ran: list[Episode]) -> Demand:
    task = find_task(env.task)
    before = [np.append(one.state[0, task.speeds[0]], one.trace["speed"]) for one in ran]
    reached = sum(_reaches(task, one) for one in ran)
    made = env.make()
    core: Any = made.unwrapped
    swing = None
    if task.name == "pendulum":
        length = core.l
        inertia, gravity = core.m * length**2 / 3.0 + env.joint.armature, core.m * core.g * length / 2.0
        swing = Swing(inertia, gravity, float(task.max_forces[0]), env.joint.damping, env.joint.friction)
    model, _ = core.physics.scene
    import mujoco

    joint = model.actuator(task.motors[0]).trnid[0]
    made.close()
    return Demand(
        source=f"{source}, {reached} of {len(ran)} episodes at the goal",
        duration=np.full(sum(len(one) - 1 for one in before), ran[0].timestep),
        torque=np.concatenate([one.trace["actual_force"] for one in ran]),
        speed=np.concatenate([one[:-1] for one in before]),
        acceleration=np.concatenate([np.diff(one) / ran[0].timestep for one in before]),
        episodes=len(ran),
        linear=bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE),
        swing=swing,
    )


def _reaches(task: Task, episode: Episode) -> bool:
    """Whether an episode ends at the goal; where that is to last, at the time limit."""
    return not episode.terminated if task.goal is None else bool(np.asarray(task.goal(episode.state[-1])))
