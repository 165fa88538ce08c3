"""Environments of Gymnasium's, or of anybody's who registers with it, as worlds."""

import contextlib
import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium import spaces

from codrl_mj.envs.worlds import EnvSource
from codrl_mj.user_code import load_module

_ID = re.compile(r"(?:[\w.]+:)?(?:[\w-]+/)?[\w.-]+-v\d+")


class GymnasiumEnvSource(EnvSource):
    """The world of one environment of Gymnasium's registry."""

    def __init__(self, name: str) -> None:
        """Take its id, such as `HalfCheetah-v5`; of `module:ID` the module is imported first."""
        self.name = name
        if ":" in name:
            load_module(name)

    @property
    def reference(self) -> str:
        """The id."""
        return self.name

    @property
    def spec(self) -> gymnasium.envs.registration.EnvSpec:
        """What Gymnasium knows of it."""
        try:
            return gymnasium.spec(self.name.rpartition(":")[2])
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise ValueError(
                f"task = {self.name!r}: {error}; environments of packages that Gymnasium does not"
                " load by itself are named module:ID"
            ) from None

    @property
    def time_limit(self) -> int | None:  # type: ignore[override]
        """That which it was registered with."""
        return self.spec.max_episode_steps

    def code(self, options: Any) -> set[str | Path]:
        """Modules of what makes it, and the one that registers it; files among its options."""
        modules = getattr(self._creator, "__module__", ""), self.name.rpartition(":")[0]
        return super().code(options) | {name for name in modules if name}

    @property
    def _creator(self) -> Any:
        from gymnasium.envs.registration import load_env_creator

        entry = self.spec.entry_point
        return load_env_creator(entry) if isinstance(entry, str) else entry

    def make(self, config: Any, **view: Any) -> Any:
        """An environment.

        Raises:
            ValueError: see `codrl_mj.make`; or its episodes need not end.
        """
        from codrl_mj.external_envs.environments import make

        if config.time_limit is None:
            raise ValueError(
                f"max_episode_steps = None: {self.name} was registered without a time limit, and"
                " its episodes might never end: give one, in environment steps"
            )
        arguments = {**config.as_arguments(), "disable_env_checker": True, **view}
        with self._explaining(config):
            return make(self.spec.id, arguments.pop("actuator"), **arguments)

    def action_space(self, config: Any) -> "spaces.Space[Any]":
        """Its own actions."""
        with self._explaining(config):
            return _action_space(self.spec.id, json.dumps(config.options))

    @contextlib.contextmanager
    def _explaining(self, config: Any) -> Iterator[None]:
        """Say whose it is that does not go together in the block."""
        try:
            yield
        except (TypeError, ValueError) as error:
            asked = isinstance(error, TypeError) and config.options
            whose = (
                f"options = {config.options!r}: {self.name} does not take them"
                if asked
                else self.name
            )
            raise ValueError(f"{whose}: {error}") from error

    def view(self, config: Any, width: int, height: int, camera: str | None) -> dict[str, Any]:
        """In that size [px] and by that camera where Gymnasium's `MujocoEnv` draws them."""
        from gymnasium.envs.mujoco import MujocoEnv

        if not (isinstance(self._creator, type) and issubclass(self._creator, MujocoEnv)):
            return super().view(config, width, height, camera)  # type: ignore[return-value]
        chosen = {} if camera is None else {"camera_name": camera}
        return {"render_mode": "rgb_array", "width": width, "height": height, **chosen}


@functools.cache
def _action_space(env_id: str, options: str) -> "spaces.Space[Any]":
    env = gymnasium.make(env_id, disable_env_checker=True, **json.loads(options))
    space = env.action_space
    env.close()
    return space


def claims(name: str) -> bool:
    """Whether a name is that of an environment of somebody else's: `HalfCheetah-v5`, `package/Robot-v0`."""
    return _ID.fullmatch(name) is not None


find = functools.cache(GymnasiumEnvSource)
"""The world of an id."""
