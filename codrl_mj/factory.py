"""Creation of single and vectorized environments."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.sources import VECTOR_ARGUMENTS, actuators_by_pattern, find_source
from codrl_mj.external_envs import environments


def make(
    env: str | EnvConfig | Callable[..., Any], actuator: Any = None, **arguments: Any
) -> "gymnasium.Env[Any, Any]":
    """Create an environment with motors behind its actuators.

        >>> env = codrl_mj.make("pendulum", "maxon-dcx22l")
        >>> env = codrl_mj.make("HalfCheetah-v5", {"b.*": "maxon-ec45-flat-50w", "f.*": "lag"})

    For a library that makes environments in other processes, pass a function, such as
    `functools.partial(codrl_mj.make, "Hopper-v5", "lag")`.

    Args:
        env: a task's name or id, such as `pendulum`; the id of a third-party environment;
            `module:NAME` of a custom task or env source; an `EnvConfig`; or a function or class
            that makes an environment, which needs no id.
        actuator: actuator that delivers the forces: a name, an `ActuatorModel`, or a mapping from
            patterns of motor names to these. None selects the default motor of a task, and no motor
            in other environments. With `"ideal"`, an environment behaves, bit for bit, as it does
            without motors.
        **arguments: other fields of `EnvConfig`, options of the task or of the environment's
            constructor, and arguments of `gymnasium.make`, such as `render_mode` and
            `max_episode_steps`. With an `EnvConfig`, the arguments of `EnvConfig.make`.

    Raises:
        gymnasium.error.UnregisteredEnv: there is no such environment.
        ValueError: a name or an argument is unknown, or arguments contradict each other; the
            message has the remedy.
    """
    actuator_argument = {} if actuator is None else {"actuator": actuator}
    if isinstance(env, EnvConfig):
        return env.make(**arguments, **actuator_argument)
    if isinstance(env, str):
        if env_id := find_source(env).env_id:
            return gymnasium.make(env_id, **actuator_argument, **arguments)
        if ":" in env:
            config, arguments = _resolve_config(env, actuator, arguments)
            return config.make(**arguments)
        arguments |= dict(arguments.pop("options", None) or {})
    return environments.make(
        env, actuators_by_pattern("default" if actuator is None else actuator), **arguments
    )


def make_vec(
    env: str | EnvConfig | Callable[..., Any],
    num_envs: int = 1,
    actuator: Any = None,
    **arguments: Any,
) -> "VectorEnv[Any, Any, Any]":
    """Create a Gymnasium vector environment, by default in autoreset mode `SameStep`.

        >>> randomize = {"motor.resistance": "uniform(1, 2)"}
        >>> envs = codrl_mj.make_vec("pendulum", 1024, "weak", randomize=randomize)

    A task on MuJoCo becomes an `ActuatedVectorEnv`, which steps all environments as a batch, in
    threads. Everything else (third-party environments, functions, `physics="analytic"`) becomes a
    `SerialVectorEnv`, which steps one environment after the other. So does a task on MuJoCo with
    `render_mode="human"`, and a warning says that this is slow.

    Args:
        env: as for `make`.
        num_envs: number of environments, >= 1.
        actuator: as for `make`; for a task also a list with one actuator for each environment.
        **arguments: as for `make`, and arguments of the vector environment: `num_threads` (only for
            a batch), `autoreset_mode`, `render_mode`. They have the same meaning with a name and
            with an `EnvConfig`.

    Raises:
        ValueError: see `make`; or there is too little memory.
    """
    if not isinstance(env, EnvConfig | str):
        vector_arguments = {
            name: arguments.pop(name) for name in VECTOR_ARGUMENTS if name in arguments
        }
        return SerialVectorEnv(
            num_envs, functools.partial(make, env, actuator, **arguments), **vector_arguments
        )
    config, arguments = _resolve_config(env, actuator, arguments)
    envs: VectorEnv[Any, Any, Any] = config.make_vec(num_envs, **arguments)
    return envs


def _resolve_config(
    env: str | EnvConfig, actuator: Any, arguments: dict[str, Any]
) -> tuple[EnvConfig, dict[str, Any]]:
    """Return a configuration, and the remaining arguments for its `make` or `make_vec`."""
    if isinstance(env, EnvConfig):
        config = env
    elif ":" in env and not find_source(env).env_id:
        # For `module:NAME` and `package:ID`, keyword arguments that are not fields are options.
        names = "max_episode_steps", "render_mode", *VECTOR_ARGUMENTS
        remaining_arguments = {name: arguments.pop(name) for name in names if name in arguments}
        return EnvConfig.from_arguments(
            env, "default" if actuator is None else actuator, arguments
        ), remaining_arguments
    else:
        config = EnvConfig(env)
    return config, arguments if actuator is None else {**arguments, "actuator": actuator}
