"""Gymnasium environments, built-in or registered by other packages, as env sources."""

import contextlib
import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium import spaces

from codrl_mj.envs.sources import EnvSource
from codrl_mj.user_code import load_module

_ID = re.compile(r"(?:[\w.]+:)?(?:[\w-]+/)?[\w.-]+-v\d+")


class GymnasiumEnvSource(EnvSource):
    """Env source of one environment in Gymnasium's registry."""

    def __init__(self, name: str) -> None:
        """Take an id such as `HalfCheetah-v5`; `module:ID` imports the module first."""
        self.name = name
        if ":" in name:
            load_module(name)

    @property
    def reference(self) -> str:
        """Id of the environment."""
        return self.name

    @property
    def spec(self) -> gymnasium.envs.registration.EnvSpec:
        """Specification in Gymnasium's registry."""
        try:
            return gymnasium.spec(self.name.rpartition(":")[2])
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise ValueError(
                f"task = {self.name!r}: {error}; if Gymnasium does not load the environment's"
                " package by itself, write module:ID"
            ) from None

    @property
    def time_limit(self) -> int | None:  # type: ignore[override]
        """Time limit of the registration [environment steps]; None if there is none."""
        return self.spec.max_episode_steps

    def code(self, options: Any) -> set[str | Path]:
        """Return the modules of the class and of the registration, and files named in options."""
        modules = getattr(self._creator, "__module__", ""), self.name.rpartition(":")[0]
        return super().code(options) | {name for name in modules if name}

    @property
    def _creator(self) -> Any:
        from gymnasium.envs.registration import load_env_creator

        entry = self.spec.entry_point
        return load_env_creator(entry) if isinstance(entry, str) else entry

    def make(self, config: Any, **view: Any) -> Any:
        """Make an environment.

        Raises:
            ValueError: see `codrl_mj.make`; or there is no time limit, so episodes may never end.
        """
        from codrl_mj.external_envs.environments import make

        if config.time_limit is None:
            raise ValueError(
                f"max_episode_steps = None: {self.name} was registered without a time limit, and"
                " its episodes might never end: give one, in environment steps"
            )
        arguments = {**config.as_arguments(), "disable_env_checker": True, **view}
        with self._with_name_in_errors(config):
            return make(self.spec.id, arguments.pop("actuator"), **arguments)

    def action_space(self, config: Any) -> "spaces.Space[Any]":
        """Return the action space of the environment without motors."""
        with self._with_name_in_errors(config):
            return _action_space(self.spec.id, json.dumps(config.options))

    @contextlib.contextmanager
    def _with_name_in_errors(self, config: Any) -> Iterator[None]:
        """Put the environment's name, or its options, in front of errors in a `with` block."""
        try:
            yield
        except (TypeError, ValueError) as error:
            is_option_error = isinstance(error, TypeError) and config.options
            subject = (
                f"options = {config.options!r}: {self.name} does not take them"
                if is_option_error
                else self.name
            )
            raise ValueError(f"{subject}: {error}") from error

    def view(self, config: Any, width: int, height: int, camera: str | None) -> dict[str, Any]:
        """Return arguments for a size [px] and camera, which a Gymnasium `MujocoEnv` accepts."""
        from gymnasium.envs.mujoco import MujocoEnv

        if not (isinstance(self._creator, type) and issubclass(self._creator, MujocoEnv)):
            return super().view(config, width, height, camera)  # type: ignore[return-value]
        camera_argument = {} if camera is None else {"camera_name": camera}
        return {"render_mode": "rgb_array", "width": width, "height": height, **camera_argument}


@functools.cache
def _action_space(env_id: str, options: str) -> "spaces.Space[Any]":
    """Return the action space of an id; options are JSON text, to be hashable for the cache."""
    env = gymnasium.make(env_id, disable_env_checker=True, **json.loads(options))
    space = env.action_space
    env.close()
    return space


def claims(name: str) -> bool:
    """Return True if a name is a third-party id: `HalfCheetah-v5`, `package/Robot-v0`."""
    return _ID.fullmatch(name) is not None


find = functools.cache(GymnasiumEnvSource)
"""Function that returns the env source of an id, always the same object for the same id."""
