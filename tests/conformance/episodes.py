"""Random episodes through every interface, and their comparison bit for bit."""

import contextlib

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from codrl_mj import suite
from codrl_mj.envs import ActuatedEnv


def start_episode(env, seed=None):
    """Start an episode, with a seed if one is given; return what the interface returns."""
    if isinstance(env, suite.DmEnvironment):
        env.env.reset(seed=seed)
        return env.reset()
    if isinstance(env, VecEnv) and seed is not None:
        env.seed(seed)
    return env.reset(seed=seed) if isinstance(env, VectorEnv) or is_single(env) else env.reset()


def is_single(env):
    """Return True for a Gymnasium environment that is no vector."""
    return hasattr(env, "unwrapped") and not isinstance(
        env, VecEnv | VectorEnv | suite.DmEnvironment
    )


def is_reset_by_caller(env):
    """Return True for a vector whose environments are not reset automatically."""
    return getattr(env, "metadata", {}).get("autoreset_mode") == AutoresetMode.DISABLED


def action_space(env):
    """Return the action space of one environment; for dm_control a specification with bounds."""
    vector_space = getattr(env, "single_action_space", None)
    return vector_space or getattr(env, "action_space", None) or env.action_spec()


def random_actions(env, generator):
    """Return an action, or one for each environment; continuous ones exceed the bounds by half."""
    space = action_space(env)
    count = (env.num_envs,) if hasattr(env, "num_envs") else ()
    if isinstance(space, spaces.Discrete):
        return generator.integers(space.n, size=count or None)
    low, high = (
        (space.low, space.high) if isinstance(space, spaces.Box) else (space.minimum, space.maximum)
    )
    return generator.uniform(1.5 * low, 1.5 * high, (*count, *space.shape)).astype(space.dtype)


def info_of(env, outcome):
    """Return the signals of a step: `info`, or the arrays of a vector."""
    if isinstance(env, VecEnv | VectorEnv):
        return env.signals
    if is_single(env):
        return outcome[4]
    return env.info if isinstance(env, suite.DmEnvironment) else env.signals()


def observation_of(outcome):
    """Return the observation of the outcome of `reset` or `step`, as an array."""
    if hasattr(outcome, "observation"):
        return np.concatenate([np.ravel(values) for values in outcome.observation.values()])
    return outcome[0] if isinstance(outcome, tuple) else outcome


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
    """Return results and states of random steps, with a reset after each episode and in step 15.

    If `vandal` is True, all returned arrays and the actions are overwritten after each step.
    """
    generator = np.random.default_rng(seed)
    results, returned = [plain(env.randomization)], []
    for index in range(count):
        is_step = index % 15 != 14
        action = random_actions(env, generator)
        original_action = np.array(action)
        outcome = env.step(action) if is_step else start_episode(env)
        np.testing.assert_array_equal(action, original_action)
        values = [outcome, env.randomization]
        # States of third-party environments, and of a loop over them, are not attributes.
        with contextlib.suppress(AttributeError):
            values.append(env.get_attr("state") if hasattr(env, "num_envs") else env.state)
        if is_step and isinstance(env, ActuatedEnv):
            values.append(env.trace)
        if is_step and not is_single(env):
            values.append(info_of(env, outcome))
        # All others reset themselves after an episode.
        is_resettable = is_single(env) or is_reset_by_caller(env)
        if is_step and is_resettable and np.any(outcome[2] | outcome[3]):
            values.append(start_episode(env))
        results.append(plain(values))
        if vandal:
            for array in arrays((values, action)):
                array[...] = 1
        else:
            returned += [(array, array.copy()) for array in arrays(values)]
    # No later step may write into arrays that were returned earlier.
    for array, copied in returned:
        np.testing.assert_array_equal(array, copied)
    return tuple(results)


def assert_same(ours, theirs, path=""):
    """Assert that nested results are equal bit for bit, including their types and shapes."""
    if isinstance(theirs, dict):
        assert isinstance(ours, dict), path
        assert ours.keys() == theirs.keys(), path
        for name in theirs:
            assert_same(ours[name], theirs[name], f"{path}[{name!r}]")
    elif isinstance(theirs, tuple) or (isinstance(theirs, np.ndarray) and theirs.dtype.hasobject):
        assert isinstance(ours, type(theirs)), path
        assert len(ours) == len(theirs), path
        for index, (item, expected_item) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(item, expected_item, f"{path}[{index}]")
    elif theirs is None:
        assert ours is None, path
    else:
        assert isinstance(ours, np.ndarray), path
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), path
        np.testing.assert_array_equal(ours, theirs, err_msg=path)
