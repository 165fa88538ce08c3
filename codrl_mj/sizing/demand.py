"""Demand of a task on a motor: torque and speed of the joint in runs on the ideal actuator."""

import contextlib
import dataclasses
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, at_goal, run_episodes
from codrl_mj.fields import did_you_mean
from codrl_mj.runs.policies import load_policy
from codrl_mj.sizing.joint_demand import Demand, demand_from_arrays
from codrl_mj.sizing.scripted import Scripted, observe_state
from codrl_mj.sizing.swing import Swing
from codrl_mj.tasks import Task
from codrl_mj.training.folder import load_config

EPISODES = 10
"""Default number of episodes for a demand."""


def demand_of(
    subject: str | Path,
    episodes: int = EPISODES,
    seed: int = 0,
    trust: bool = False,
    motor: str | None = None,
) -> Demand:
    """Return the demand on one motor of a task, run or recording; arguments as in `demands_of`.

    Raises:
        ValueError: as in `demands_of`; or `motor` is unknown, or missing if there are several.
    """
    demands = demands_of(subject, episodes, seed, trust)
    if motor is None and len(demands) > 1:
        raise ValueError(
            f"{subject} has {len(demands)} motors: motor must be one of {', '.join(demands)}"
        )
    if motor is None:
        return next(iter(demands.values()))
    if motor not in demands:
        names = (
            ", ".join(name for name in demands if name)
            or "only motors without a name: leave it out"
        )
        raise ValueError(f"motor = {motor!r}: {did_you_mean(motor, demands)}there are {names}")
    return demands[motor]


def demands_of(
    subject: str | Path, episodes: int = EPISODES, seed: int = 0, trust: bool = False
) -> dict[str, Demand]:
    """Return motor -> demand of a task, run or recording; a single motor has an empty name.

    Args:
        subject: name of a task, which a scripted controller runs; folder of a run that was trained
            on the ideal actuator; or an `.npz` file with the arrays `time` [s], `torque` [N*m] and
            `speed` [rad/s] at the joint.
        episodes: number of episodes.
        seed: seed of the first episode.
        trust: True to import the custom modules of a run folder's task or agent.

    Raises:
        ValueError: the subject is none of these; the run was trained on another actuator; the task
            has no scripted controller.
    """
    path = Path(subject)
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                demand = demand_from_arrays(
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
        return {"": demand}

    if path.is_dir():
        env = load_config(path, trust).env
        if other_families := [actuator.family for actuator in env.actuators if actuator != IDEAL]:
            raise ValueError(
                f"{path}: was trained on {other_families[0]}: must be ideal, so that no motor"
                " limits the torques; train it with --actuator ideal, or name the task instead"
            )
        env = with_motor_steps(env)
        episodes_run = run_episodes(load_policy(path, trust), env.build, episodes, seed)
        return _demands_from_episodes(f"the policy {path.name} of {env.task}", env, episodes_run)

    env = EnvConfig(str(subject), "ideal")
    policy, env = Scripted(scripted_task(env)), with_motor_steps(env)
    episodes_run = run_episodes(policy, lambda: observe_state(env.build()), episodes, seed)
    return _demands_from_episodes(f"{policy.description} of {env.source.name}", env, episodes_run)


def scripted_task(env: EnvConfig) -> Task:
    """Return an environment's task, whose scripted controller shows what its motor must do.

    Raises:
        ValueError: there is no such controller: it needs a task with a single motor.
    """
    source, task = env.source, env.source.task
    if task is None:
        raise ValueError(
            f"{source.name}: there is no scripted controller for it; train it with --actuator ideal"
            " and name the run"
        )
    if len(task.motors) > 1:
        raise ValueError(
            f"task {task.name!r} has {len(task.motors)} motors: there is no scripted controller;"
            " train it with --actuator ideal and name the run, or give time, torque and speed of"
            " each joint as .npz files"
        )
    return task


def with_motor_steps(env: EnvConfig) -> EnvConfig:
    """Return a configuration on MuJoCo, with the integration steps that a motor would need."""
    task = env.source.task
    if task is None:
        return env
    if env.inner_steps or env.timestep:
        return dataclasses.replace(env, physics="mujoco")
    return dataclasses.replace(env, physics="mujoco", inner_steps=task.motor_inner_steps)


def _demands_from_episodes(
    source: str, env: EnvConfig, episodes: Sequence[Episode]
) -> dict[str, Demand]:
    """Return the demands on all motors from episodes of one environment."""
    import mujoco

    from codrl_mj.engine.matching import ON_JOINT
    from codrl_mj.engine.reading import motors

    swing, goal_masks = None, [at_goal(env.source.task, episode) for episode in episodes]
    if all(mask is not None for mask in goal_masks):
        source = (
            f"{source}, {sum(bool(mask[-1]) for mask in goal_masks if mask is not None)} of"
            f" {len(episodes)} episodes at the goal"
        )
    with contextlib.closing(env.build()) as opened_env:
        # The model, and the pendulum's properties, are attributes of the environment's own class.
        core: Any = opened_env.unwrapped
        if env.task == "pendulum":
            # A thin uniform rod about its end: inertia m*l^2/3, center of mass at l/2.
            length = core.l
            inertia = core.m * length**2 / 3.0 + env.joint.armature
            gravity_torque = core.m * core.g * length / 2.0
            swing = Swing(
                inertia,
                gravity_torque,
                float(core.task.max_forces[0]),
                env.joint.damping,
                env.joint.friction,
            )
        model = core.model
        actuator_ids = list(motors(model)) or [
            model.actuator(name).id for name in opened_env.get_wrapper_attr("recorder").motor_names
        ]
    speeds, forces = (
        [np.column_stack([episode.trace[name]]) for episode in episodes]
        for name in ("speed", "actual_force")
    )
    demands = {}
    for motor_index, actuator_id in enumerate(actuator_ids):
        name = episodes[0].motors[motor_index] if episodes[0].motors else ""
        start_speeds = [
            np.append(episode.first_speeds[motor_index], episode_speeds[:, motor_index])
            for episode, episode_speeds in zip(episodes, speeds, strict=True)
        ]
        kind = mujoco.mjtTrn(model.actuator_trntype[actuator_id])
        joint = model.actuator_trnid[actuator_id, 0]
        sliding = kind in ON_JOINT and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        gear = abs(float(model.actuator_gear[model.actuator_outadr[actuator_id], 0])) or 1.0
        demands[name] = Demand(
            source=f"{source}: {name}" if name else source,
            duration=np.full(
                sum(len(episode) - 1 for episode in start_speeds), episodes[0].timestep
            ),
            torque=gear * np.concatenate([force[:, motor_index] for force in forces]),
            speed=np.concatenate([episode[:-1] for episode in start_speeds]) / gear,
            acceleration=np.concatenate(
                [np.diff(episode) / episodes[0].timestep for episode in start_speeds]
            )
            / gear,
            episodes=len(episodes),
            linear=bool(sliding),
            servo=bool(np.any(model.actuator_biasprm[actuator_id, 1:3])),
            swing=swing,
            model_gear=gear,
        )
    return demands
