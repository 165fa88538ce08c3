"""Comparison of the vector environment with Gymnasium's loop over single environments."""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

# The import registers the environments.
import codrl_mj  # noqa: F401
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv
from codrl_mj.tasks import TASKS
from tests.conformance.episodes import assert_same, random_actions

MODES = tuple(mode.value for mode in AutoresetMode)


def batched(task, num_envs, mode="NextStep", **arguments):
    """Make the batched vector environment by `gymnasium.make_vec`."""
    return gymnasium.make_vec(
        TASKS[task].env_id, num_envs, "vector_entry_point", autoreset_mode=mode, **arguments
    )


def looped(task, num_envs, mode="NextStep", **arguments):
    """Make Gymnasium's `SyncVectorEnv` of single environments."""
    actuators = arguments.pop("actuator", "default")
    if not isinstance(actuators, list):
        options = {"autoreset_mode": AutoresetMode(mode)}
        return gymnasium.make_vec(
            TASKS[task].env_id, num_envs, "sync", options, actuator=actuators, **arguments
        )
    single = TASKS[task].env_id
    env_functions = [
        lambda actuator=actuator: gymnasium.make(single, actuator=actuator, **arguments)
        for actuator in actuators
    ]
    return SyncVectorEnv(env_functions, autoreset_mode=mode)


def assert_equal_episodes(ours, theirs, steps, seed=0, masks=True):
    """Step both from the same seed, and reset some environments from time to time.

    Returns:
        Number of episodes of each environment that terminated and that were truncated: (N, 2).
    """
    assert isinstance(ours.unwrapped, ActuatedVectorEnv | SerialVectorEnv)
    generator = np.random.default_rng(seed)
    mode = ours.metadata["autoreset_mode"]
    ends = np.zeros((ours.num_envs, 2), dtype=int)
    assert_same(ours.reset(seed=seed), theirs.reset(seed=seed), "reset")
    for step in range(steps):
        actions = random_actions(ours, generator)
        outcome, expected = ours.step(actions), theirs.step(actions)
        assert_same(outcome, expected, f"step {step}")
        ends += np.stack([outcome[2], outcome[3]], axis=-1)
        mask = (
            generator.random(ours.num_envs) < 0.1
            if masks and step % 6 == 5
            else np.zeros(ours.num_envs, dtype=bool)
        )
        if mode == AutoresetMode.DISABLED:
            mask |= outcome[2] | outcome[3]
        if mask.any():
            seeds = [
                None if generator.random() < 0.5 else int(generator.integers(1000)) for _ in mask
            ]
            seeds = seeds if step % 4 == 1 else None
            resets = [
                env.reset(seed=seeds, options={"reset_mask": mask.copy()}) for env in (ours, theirs)
            ]
            assert_same(*resets, f"reset after step {step}")
    return ends
