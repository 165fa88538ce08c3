"""What makes environments of whatever world: one, or many at once."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.worlds import VECTOR_ARGUMENTS, by_pattern, find_world
from codrl_mj.external_envs import environments


def make(
    env: str | EnvConfig | Callable[..., Any], actuator: Any = None, **arguments: Any
) -> "gymnasium.Env[Any, Any]":
    """An environment with motors behind its actuators.

        >>> env = codrl_mj.make("pendulum", "maxon-dcx22l")
        >>> env = codrl_mj.make("HalfCheetah-v5", {"b.*": "maxon-ec45-flat-50w", "f.*": "lag"})

    Processes are given functions that call this, such as `functools.partial(codrl_mj.make,
    "Hopper-v5", "lag")`.

    Args:
        env: a task's name or id, such as `pendulum`; the id of anybody's environment; `module:NAME`
            of a task or world of one's own; an `EnvConfig`; or a function or class that makes an
            environment, which needs no id.
        actuator: what its forces go through: a name, an actuator, or a mapping of patterns of
            motors to these; None: a task's own motor, and nothing at all elsewhere. With `"ideal"`
            an environment is, bit for bit, the one without motors.
        **arguments: other fields of `EnvConfig`, and options of the task, or of `gymnasium.make`
            and the environment, such as `render_mode` and `max_episode_steps`; of an `EnvConfig`,
            those of its `make`.

    Raises:
        gymnasium.error.UnregisteredEnv: there is no such environment.
        ValueError: names or arguments that are unknown, or do not go with each other; the message
            has the remedy.
    """
    given = {} if actuator is None else {"actuator": actuator}
    if isinstance(env, EnvConfig):
        return env.make(**arguments, **given)
    if isinstance(env, str):
        if env_id := find_world(env).env_id:
            return gymnasium.make(env_id, **given, **arguments)
        if ":" in env:
            config, arguments = _configured(env, actuator, arguments)
            return config.make(**arguments)
        arguments |= dict(arguments.pop("options", None) or {})
    return environments.make(
        env, by_pattern("default" if actuator is None else actuator), **arguments
    )


def make_vec(
    env: str | EnvConfig | Callable[..., Any],
    num_envs: int = 1,
    actuator: Any = None,
    **arguments: Any,
) -> "VectorEnv[Any, Any, Any]":
    """Many environments as one of Gymnasium's vectors, which is reset in the step that ends an episode.

        >>> envs = codrl_mj.make_vec("pendulum", 1024, "weak", randomize={"motor.resistance": "uniform(1, 2)"})

    Tasks on MuJoCo are stepped as a batch, in threads, also where they are rendered: an
    `ActuatedVectorEnv`. For everything else (environments of others, functions,
    `physics="analytic"`) a `SerialVectorEnv` is all there is, which steps one environment after the
    other. A warning says so where a task falls back to it: for `render_mode="human"`.

    Args:
        env: as for `make`.
        num_envs: how many, >= 1.
        actuator: as for `make`; or of a task a list with one for each environment.
        **arguments: as for `make`, and those of the vector: `num_threads` (of a batch),
            `autoreset_mode` (`SameStep` unless given), `render_mode`. They do the same beside a
            name and beside an `EnvConfig`.

    Raises:
        ValueError: see `make`; or more than memory holds.
    """
    if not isinstance(env, EnvConfig | str):
        own = {name: arguments.pop(name) for name in VECTOR_ARGUMENTS if name in arguments}
        return SerialVectorEnv(num_envs, functools.partial(make, env, actuator, **arguments), **own)
    config, arguments = _configured(env, actuator, arguments)
    vector: VectorEnv[Any, Any, Any] = config.make_vec(num_envs, **arguments)
    return vector


def _configured(
    env: str | EnvConfig, actuator: Any, arguments: dict[str, Any]
) -> tuple[EnvConfig, dict[str, Any]]:
    """Return the configuration of a name, and the arguments that its `make` or `make_vec` takes besides."""
    if isinstance(env, EnvConfig):
        config = env
    elif ":" in env and not find_world(env).env_id:
        # A world of one's own, or a package's environment: keyword arguments that are no fields are
        # its options.
        names = "max_episode_steps", "render_mode", *VECTOR_ARGUMENTS
        own = {name: arguments.pop(name) for name in names if name in arguments}
        return EnvConfig.of(env, "default" if actuator is None else actuator, arguments), own
    else:
        config = EnvConfig(env)
    return config, arguments if actuator is None else {**arguments, "actuator": actuator}
