"""Environments with all that a snapshot must hold, and what they do after it; also run as a program of its own."""

import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save_file

from codrl_mj import Choice, LogUniform, Uniform, make_sb3_vec_env
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics.variation import bare_model, variable
from codrl_mj.tasks import TASKS, named_actuator
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.envs.vectors import random_actions
from tests.tasks.faces import actions

PHYSICS = ("mujoco", "analytic")
STEPS = 120
NUM_ENVS = 3
DRIVE = {
    "controller.kp": LogUniform(0.3, 15.0),  # some draws are unstable, and rejected
    "motor.inductance": Uniform(0.05, 0.2),
    "motor.arm_radius": Uniform(0.2, 1.2),
    "controller.substeps": Choice([1, 2, 3]),
    "controller.bemf_compensation": Choice([True, False]),
}


def everything(task, physics):
    """Arguments with every disturbance, and every field drawn, that the physics has."""
    model = {} if physics == "analytic" else dict.fromkeys(variable(bare_model(task)), Uniform(0.6, 1.7))
    model = {name: drawn for name, drawn in model.items() if "damping" not in name}  # the joint has it
    return {
        "actuator": imperfect(named_actuator("paper", task).as_mapping()),
        "physics": physics,
        "randomize": DRIVE | model,
        "disturbances": MOST,
        "joint": None if physics == "analytic" else RUBBED,
        "observe_actuator": True,
    }


def single(task, physics):
    """One environment."""
    return ActuatedEnv(task, **everything(task, physics))


def several(task, physics):
    """Environments as Stable-Baselines3 knows them, with episodes short enough to end by time too."""
    return make_sb3_vec_env(TASKS[task].env_id, NUM_ENVS, max_episode_steps=23, **everything(task, physics))


def run_single(env, count, seed):
    """Step with given actions, restarting every 40 steps and at ends; everything that is returned, as arrays."""
    found = {"observations": [], "rewards": [], "signals": [], "drawn": [], "states": []}
    for index, action in enumerate(actions(env.task.name, seed, count)):
        if index % 40 == 39:
            observation, info = env.reset()
            found["drawn"].append(list(info["randomization"].values()))
        else:
            observation, reward, terminated, _, info = env.step(action)
            found["rewards"].append(reward)
            found["signals"].append(list(info.values()))
            if terminated:
                env.reset()
        found["observations"].append(observation)
        found["states"].append(env.state)
    return {name: np.array(values) for name, values in found.items()}


def run_several(envs, count, seed):
    """The same of a `VecEnv`, with its episodes' records."""
    found = {"observations": [], "rewards": [], "dones": [], "signals": [], "ended": [], "last": [], "drawn": []}
    generator = np.random.default_rng(seed)
    space = envs.action_space
    for _ in range(count):
        batch = random_actions(envs.env, generator)
        batch = batch if hasattr(space, "n") else np.clip(batch, space.low, space.high)
        observations, rewards, dones, infos = envs.step(batch)
        found["observations"].append(observations)
        found["rewards"].append(rewards)
        found["dones"].append(dones)
        found["signals"].append(np.array(list(envs.signals.values())))
        found["drawn"].append(np.array(list(envs.randomization.values())))
        for info in infos:
            if info:
                found["ended"].append([info["episode"]["r"], info["episode"]["l"], info["TimeLimit.truncated"]])
                found["last"].append(info["terminal_observation"])
    return {name: np.array(values) for name, values in found.items()}


def main(folder):
    """Restore every snapshot that is in a folder, and leave beside each what follows."""
    for file in sorted(Path(folder).glob("*.before")):
        envs = several(*file.stem.split("-"))
        envs.restore(load_file(file))
        save_file(run_several(envs, STEPS, 1), file.with_suffix(".after"))


if __name__ == "__main__":
    main(sys.argv[1])
