"""Every face of an environment, set up and driven alike; run as a program, it goes on from what another one left."""

import math
import sys
from pathlib import Path

import gymnasium
import numpy as np
from safetensors.numpy import load_file, save_file
from stable_baselines3.common.vec_env import VecEnv

from codrl_mj import Choice, LogUniform, Uniform, make_sb3_vec_env, suite
from codrl_mj.envs import ActuatedEnv, SerialVectorEnv
from codrl_mj.physics.variation import bare_model, variable_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.engine.models import FULL, changed
from tests.envs.vectors import batched

PHYSICS = ("mujoco", "analytic")
MOTOR = changed(FULL, inductance=0.2, substeps=3)
"""A motor whose every constant differs from 1, slow enough for the longest step, 0.05 s."""
LIMIT = {task: {"current": TASKS[task].max_force * 0.5 / 0.8, "voltage": 4.0} for task in TASKS}
"""Largest command by task and kind, for `MOTOR`: arm 0.5, kT 0.8 N m/A, 4 V."""
DRIVE = {
    "controller.kp": LogUniform(
        0.3, 15.0
    ),  # straddles instability on every task; such draws are rejected
    "motor.inductance": Uniform(0.05, 0.2),
    "motor.torque_constant": Uniform(0.5, 1.5),
    "motor.arm_radius": Uniform(0.2, 1.2),
    "controller.max_voltage": Choice([3.0, 12.0, math.inf]),
    "controller.substeps": Choice([1, 2, 3]),
    "controller.bemf_compensation": Choice([True, False]),
}
"""Of the motor, drawn."""


# -- set-ups ------------------------------------------------------------------------------------------------


def commanded(task, command):
    """Arguments for a command of `MOTOR`; discrete tasks get four uneven levels."""
    arguments = {"actuator": MOTOR, "action": command}
    if command != "force" and isinstance(TASKS[task].action_space, gymnasium.spaces.Discrete):
        limit = LIMIT[task][command]
        arguments["levels"] = (-limit, -limit / 3, limit / 7, limit)
    return arguments


def scales(task):
    """Every scale factor of a task's model, drawn."""
    return {name: Uniform(0.6, 1.7) for name in variable_names(bare_model(task)) if "damping" not in name}


def everything(task, physics):
    """Arguments with every disturbance, and every field drawn, that the physics has."""
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
    """An environment's, by the set-up's name."""
    if setup == "ideal":
        return {"actuator": "ideal"}
    if setup == "everything":
        return everything(task, physics)
    drawn = {"randomize": {"motor.inductance": Uniform(0.15, 0.3)}} if setup == "voltage" else {}
    return commanded(task, setup) | {"observe_actuator": setup != "force"} | drawn


# -- faces --------------------------------------------------------------------------------------------------


LIMITED = {"max_episode_steps": 11}
FACES = {
    "one": ActuatedEnv,
    "one, analytic": lambda task, **given: ActuatedEnv(task, physics="analytic", **given),
    "many, NextStep": lambda task, **given: (
        batched(task, 3, "NextStep", **LIMITED, **given).unwrapped
    ),
    "many, SameStep": lambda task, **given: (
        batched(task, 3, "SameStep", **LIMITED, **given).unwrapped
    ),
    "serial, analytic": lambda task, **given: SerialVectorEnv(
        3, task, physics="analytic", **LIMITED, **given
    ),
    "Stable-Baselines3": lambda task, **given: make_sb3_vec_env(
        TASKS[task].env_id, 3, **LIMITED, **given
    ),
    "dm_control": lambda task, **given: suite.load(task, **LIMITED, **given),
}


def made(face, task, setup):
    """An environment."""
    return FACES[face](
        task, **arguments(task, setup, "analytic" if "analytic" in face else "mujoco")
    )


def begun(env, seed=None):
    """What the start of an episode returns, of a seed if one is given."""
    if isinstance(env, suite.DmEnvironment):
        env.env.reset(seed=seed)
        return env.reset()
    if not isinstance(env, VecEnv):
        return env.reset(seed=seed)
    if seed is not None:
        env.seed(seed)
    return env.reset()


def plain(value):
    """Nested results as dictionaries, tuples and arrays of their own, without the times that things took."""
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items() if name != "t"}
    if isinstance(value, tuple | list):
        return tuple(map(plain, value))
    if isinstance(value, np.ndarray) and value.dtype == object:
        return tuple(map(plain, value))
    return None if value is None else np.array(value)


def arrays(value):
    """Every numeric array in nested results."""
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [array for one in value for array in arrays(one)]
    return [value] if isinstance(value, np.ndarray) else []


def run(env, count, seed, vandal=False):
    """All that random steps return and leave, with a new episode after each that ended and after every 40th.

    A vandal writes into all that it was given, and into the actions that were taken.
    """
    generator = np.random.default_rng(seed)
    several, found, kept, over = hasattr(env, "num_envs"), [plain(env.randomization)], [], False
    space, shape = (
        getattr(env, "single_action_space", env.action_space),
        (env.num_envs,) if several else (),
    )
    for index in range(count):
        if hasattr(space, "n"):
            action = generator.integers(space.n, size=shape or None)
        else:
            action = (space.high * generator.uniform(-1.5, 1.5, (*shape, *space.shape))).astype(
                np.float32
            )
        given = np.array(action)
        seen = begun(env) if over or index % 40 == 39 else env.step(action)
        np.testing.assert_array_equal(action, given)
        stepped = isinstance(env, ActuatedEnv) and len(seen) == 5
        over = stepped and seen[2]
        states = env.get_attr("state") if several else env.state
        found.append(plain((seen, states, env.randomization, env.trace if stepped else None)))
        if vandal:
            for array in arrays((seen, states, action)):
                array[...] = 1
        else:
            kept += [(array, array.copy()) for array in arrays((seen, states))]
    for array, copied in kept:  # no later step has written into what was returned
        np.testing.assert_array_equal(array, copied)
    return tuple(found)


def main(folder):
    """Restore every snapshot that is in a folder, and leave beside each the one that follows from it."""
    for file in sorted(Path(folder).glob("*.before")):
        env = made("Stable-Baselines3", file.stem, "everything")
        env.restore(load_file(file))
        run(env, 60, seed=1)
        save_file(env.snapshot(), file.with_suffix(".after"))


if __name__ == "__main__":
    main(sys.argv[1])
