"""What makes environments of whatever world: one, or many at once."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.worlds import by_pattern, find_world
from codrl_mj.foreign import environments


def make(
    env: str | EnvConfig | Callable[..., Any], actuator: Any = None, **arguments: Any
) -> "gymnasium.Env[Any, Any]":
    """An environment with motors behind its actuators.

        >>> env = codrl_mj.make("pendulum", "maxon-dcx22l")
        >>> env = codrl_mj.make("HalfCheetah-v5", {"b.*": "maxon-ec45-flat-50w", "f.*": "lag"})

    Processes are given functions that call this, such as `functools.partial(codrl_mj.make, "Hopper-v5", "lag")`.

    Args:
        env: a task's name or id, such as `pendulum`; the id of anybody's environment; `module:NAME` of a task or world
            of one's own; an `EnvConfig`; or a function or class that makes an environment, which needs no id.
        actuator: what its forces go through: a name, an actuator, or a mapping of patterns of motors to these; None: a
            task's own motor, and nothing at all elsewhere. With `"ideal"` an environment is, bit for bit, the one
            without motors.
        **arguments: other fields of `EnvConfig`, and options of the task, or of `gymnasium.make` and the environment,
            such as `render_mode` and `max_episode_steps`; of an `EnvConfig`, those of its `make`.

    Raises:
        gymnasium.error.UnregisteredEnv: there is no such environment.
        ValueError: names or arguments that are unknown, or do not go with each other; the message has the remedy.
    """
    if hasattr(env, "make"):
        return env.make(**arguments, **({} if actuator is None else {"actuator": actuator}))
    env_id = find_world(env).env_id if isinstance(env, str) else ""
    if env_id:
        given = {} if actuator is None else {"actuator": actuator}
        return gymnasium.make(env_id, **given, **arguments)
    if isinstance(env, str) and ":" in env:
        view = {name: arguments.pop(name) for name in ("render_mode",) if name in arguments}
        limit = arguments.pop("max_episode_steps", None)
        config = EnvConfig.of(env, "default" if actuator is None else actuator, arguments)
        return dataclasses.replace(config, max_episode_steps=limit).make(**view)
    return environments.make(env, by_pattern("default" if actuator is None else actuator), **arguments)


def make_vec(
    env: str | EnvConfig | Callable[..., Any], num_envs: int = 1, actuator: Any = None, **arguments: Any
) -> "VectorEnv[Any, Any, Any]":
    """Many environments as one of Gymnasium's vectors, which is reset in the step that ends an episode.

        >>> envs = codrl_mj.make_vec("pendulum", 1024, "weak", randomize={"motor.resistance": "uniform(1, 2)"})

    Tasks on MuJoCo are stepped as a batch, in threads; whatever else there is, one by one.

    Args:
        env: as for `make`.
        num_envs: how many, >= 1.
        actuator: as for `make`.
        **arguments: as for `make`; of an `EnvConfig`, fields to set otherwise, and those of the vector, such as
            `num_threads`.

    Raises:
        ValueError: see `make`; or more than memory holds.
    """
    if callable(env) or "render_mode" in arguments:
        return SerialVectorEnv(num_envs, functools.partial(make, env, actuator, **arguments))
    if isinstance(env, str):
        limit = {name: arguments.pop(name) for name in ("max_episode_steps",) if name in arguments}
        chosen = find_world(env).default_actuator if actuator is None else actuator
        env, arguments = EnvConfig.of(env, chosen, arguments), limit
    elif actuator is not None:
        arguments["actuator"] = actuator
    vector: VectorEnv[Any, Any, Any] = env.world.vector(env, num_envs, **arguments)
    return vector
