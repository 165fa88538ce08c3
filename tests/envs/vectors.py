"""The vector environment beside Gymnasium's loop over single ones."""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import codrl_mj  # noqa: F401 - registers the environments
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv
from codrl_mj.tasks import TASKS

MODES = tuple(mode.value for mode in AutoresetMode)


def batched(task, num_envs, mode="NextStep", **arguments):
    """Ours, as a user makes it."""
    return gymnasium.make_vec(
        TASKS[task].env_id, num_envs, "vector_entry_point", autoreset_mode=mode, **arguments
    )


def looped(task, num_envs, mode="NextStep", **arguments):
    """Gymnasium's `SyncVectorEnv` of single environments."""
    actuators = arguments.pop("actuator", "default")
    if not isinstance(actuators, list):
        options = {"autoreset_mode": AutoresetMode(mode)}
        return gymnasium.make_vec(
            TASKS[task].env_id, num_envs, "sync", options, actuator=actuators, **arguments
        )
    single = TASKS[task].env_id
    makers = [
        lambda one=one: gymnasium.make(single, actuator=one, **arguments) for one in actuators
    ]
    return SyncVectorEnv(makers, autoreset_mode=mode)


def assert_same(ours, theirs, where=""):
    """Nested dictionaries, tuples and arrays that are equal bit for bit, types and shapes included."""
    if isinstance(theirs, dict):
        assert isinstance(ours, dict), where
        assert ours.keys() == theirs.keys(), where
        for name in theirs:
            assert_same(ours[name], theirs[name], f"{where}[{name!r}]")
    elif isinstance(theirs, tuple):
        assert len(ours) == len(theirs), where
        for index, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f"{where}[{index}]")
    elif theirs is None:
        assert ours is None, where
    else:
        assert isinstance(ours, np.ndarray), where
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), where
        if theirs.dtype == object:
            for index, (one, other) in enumerate(zip(ours, theirs, strict=True)):
                assert_same(one, other, f"{where}[{index}]")
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=where)


def random_actions(env, generator):
    """A batch of actions; continuous ones reach half as far again as the bounds."""
    space = env.single_action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return generator.integers(space.n, size=env.num_envs)
    return generator.uniform(
        1.5 * space.low, 1.5 * space.high, (env.num_envs, *space.shape)
    ).astype(np.float32)


def assert_equal_episodes(ours, theirs, steps, seed=0, masks=True):
    """Step both from the same seed, with resets of some environments now and then.

    Returns:
        How often each environment's episode ended, terminated and truncated: shape (N, 2).
    """
    assert isinstance(ours.unwrapped, ActuatedVectorEnv | SerialVectorEnv)
    generator = np.random.default_rng(seed)
    mode = ours.metadata["autoreset_mode"]
    ends = np.zeros((ours.num_envs, 2), dtype=int)
    assert_same(ours.reset(seed=seed), theirs.reset(seed=seed), "reset")
    for step in range(steps):
        actions = random_actions(ours, generator)
        one, other = ours.step(actions), theirs.step(actions)
        assert_same(one, other, f"step {step}")
        ends += np.stack([one[2], one[3]], axis=-1)
        mask = (
            generator.random(ours.num_envs) < 0.1
            if masks and step % 6 == 5
            else np.zeros(ours.num_envs, dtype=bool)
        )
        if mode == AutoresetMode.DISABLED:
            mask |= one[2] | one[3]
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
