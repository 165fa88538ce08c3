"""All interfaces of an environment, built and stepped alike; as a program, it resumes snapshots."""

import math
import sys
from pathlib import Path

import gymnasium
import numpy as np
from safetensors.numpy import load_file, save_file
from stable_baselines3.common.vec_env import VecEnv

from codrl_mj import Choice, LogUniform, Uniform, make_sb3_vec_env, suite
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics.variation import bare_model, variable_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.engine.models import FULL, changed
from tests.envs.vectors import batched, serial

PHYSICS = ("mujoco", "analytic")
MOTOR = changed(FULL, inductance=0.2, substeps=3)
"""A motor whose every constant differs from 1, slow enough for the longest step, 0.05 s."""
COMMAND_LIMITS = {
    task: {"current": TASKS[task].max_force * 0.5 / 0.8, "voltage": 4.0} for task in TASKS
}
"""Largest command by task and kind, for `MOTOR`: arm 0.5, kT 0.8 N m/A, 4 V."""
DRIVE = {
    # The range includes unstable gains on every task; such draws are rejected.
    "controller.kp": LogUniform(0.3, 15.0),
    "motor.inductance": Uniform(0.05, 0.2),
    "motor.torque_constant": Uniform(0.5, 1.5),
    "motor.arm_radius": Uniform(0.2, 1.2),
    "controller.max_voltage": Choice([3.0, 12.0, math.inf]),
    "controller.substeps": Choice([1, 2, 3]),
    "controller.bemf_compensation": Choice([True, False]),
}
"""Randomized fields of the motor."""


# -- arguments ------------------------------------------------------------------------------------


def commanded(task, command):
    """Return arguments for a command of `MOTOR`; discrete tasks get four uneven levels."""
    arguments = {"actuator": MOTOR, "action": command}
    if command != "force" and isinstance(TASKS[task].action_space, gymnasium.spaces.Discrete):
        limit = COMMAND_LIMITS[task][command]
        arguments["levels"] = (-limit, -limit / 3, limit / 7, limit)
    return arguments


def scales(task):
    """Return a distribution for each scale factor of a task's model."""
    return {
        name: Uniform(0.6, 1.7)
        for name in variable_names(bare_model(task))
        if "damping" not in name
    }


def everything(task, physics):
    """Return arguments with every disturbance and every random field that the physics supports."""
    model = {} if physics == "analytic" else scales(task)
    return {
        "actuator": imperfect(named_actuator("paper", task).as_mapping()),
        "randomize": DRIVE | model,
        "disturbances": MOST,
        "joint": None if physics == "analytic" else RUBBED,
        "observe_actuator": True,
    }


SETUPS = ("ideal", "force", "current", "voltage", "everything")


def arguments(task, setup, physics="mujoco"):
    """Return the arguments of a setup by its name."""
    if setup == "ideal":
        return {"actuator": "ideal"}
    if setup == "everything":
        return everything(task, physics)
    drawn = {"randomize": {"motor.inductance": Uniform(0.15, 0.3)}} if setup == "voltage" else {}
    return commanded(task, setup) | {"observe_actuator": setup != "force"} | drawn


# -- interfaces -----------------------------------------------------------------------------------


LIMITED = {"max_episode_steps": 11}
FACES = {
    "one": ActuatedEnv,
    "one, analytic": lambda task, **options: ActuatedEnv(task, physics="analytic", **options),
    "many, NextStep": lambda task, **options: (
        batched(task, 3, "NextStep", **LIMITED, **options).unwrapped
    ),
    "many, SameStep": lambda task, **options: (
        batched(task, 3, "SameStep", **LIMITED, **options).unwrapped
    ),
    "serial, analytic": lambda task, **options: serial(
        3, task, physics="analytic", **LIMITED, **options
    ),
    "Stable-Baselines3": lambda task, **options: make_sb3_vec_env(
        TASKS[task].env_id, 3, **LIMITED, **options
    ),
    "dm_control": lambda task, **options: suite.load(task, **LIMITED, **options),
}


def make_face(face, task, setup):
    """Make an environment with an interface."""
    return FACES[face](
        task, **arguments(task, setup, "analytic" if "analytic" in face else "mujoco")
    )


def start_episode(env, seed=None):
    """Start an episode, with a seed if one is given; return what the interface returns."""
    if isinstance(env, suite.DmEnvironment):
        env.env.reset(seed=seed)
        return env.reset()
    if not isinstance(env, VecEnv):
        return env.reset(seed=seed)
    if seed is not None:
        env.seed(seed)
    return env.reset()


def plain(value):
    """Return nested results as dictionaries, tuples and copied arrays, without measured times."""
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items() if name != "t"}
    if isinstance(value, tuple | list):
        return tuple(map(plain, value))
    if isinstance(value, np.ndarray) and value.dtype == object:
        return tuple(map(plain, value))
    return None if value is None else np.array(value)


def arrays(value):
    """Return all numeric arrays in nested results."""
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [array for item in value for array in arrays(item)]
    return [value] if isinstance(value, np.ndarray) else []


def run(env, count, seed, vandal=False):
    """Return results and states of random steps; reset after an episode and every 40th step.

    If `vandal` is True, all returned arrays and the actions are overwritten after each step.
    """
    generator = np.random.default_rng(seed)
    is_vector, results, returned, ended = (
        hasattr(env, "num_envs"),
        [plain(env.randomization)],
        [],
        False,
    )
    space, shape = (
        getattr(env, "single_action_space", env.action_space),
        (env.num_envs,) if is_vector else (),
    )
    for index in range(count):
        if hasattr(space, "n"):
            action = generator.integers(space.n, size=shape or None)
        else:
            action = (space.high * generator.uniform(-1.5, 1.5, (*shape, *space.shape))).astype(
                np.float32
            )
        original_action = np.array(action)
        outcome = start_episode(env) if ended or index % 40 == 39 else env.step(action)
        np.testing.assert_array_equal(action, original_action)
        is_step = isinstance(env, ActuatedEnv) and len(outcome) == 5
        ended = is_step and outcome[2]
        states = env.get_attr("state") if is_vector else env.state
        results.append(plain((outcome, states, env.randomization, env.trace if is_step else None)))
        if vandal:
            for array in arrays((outcome, states, action)):
                array[...] = 1
        else:
            returned += [(array, array.copy()) for array in arrays((outcome, states))]
    # No later step may write into arrays that were returned earlier.
    for array, copied in returned:
        np.testing.assert_array_equal(array, copied)
    return tuple(results)


def main(folder):
    """Restore every snapshot in a folder, continue, and write the next snapshot beside it."""
    for file in sorted(Path(folder).glob("*.before")):
        env = make_face("Stable-Baselines3", file.stem, "everything")
        env.restore(load_file(file))
        run(env, 60, seed=1)
        save_file(env.snapshot(), file.with_suffix(".after"))


if __name__ == "__main__":
    main(sys.argv[1])
