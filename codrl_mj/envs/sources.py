"""Env sources: factories of environments to which motors are added.

A source represents a task or a Gymnasium id, or is a custom instance of an `EnvSource` subclass
with the name `module:NAME`. An `EnvConfig` names its source, and calls it for everything that
differs between kinds of environments. A custom source therefore needs no change in this package.
"""

import abc
import contextlib
import dataclasses
import functools
import importlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import IDEAL, ActuatorModel, is_family
from codrl_mj.tasks import TASKS, reference_of
from codrl_mj.user_code import load_object

ALL_MOTORS = ".*"
"""Pattern that matches all motors."""
COMMON_FIELDS = (
    *("task", "actuator", "action", "observe_actuator", "max_episode_steps", "allow_unstable"),
    *("disturbances", "randomize", "options"),
)
"""Fields of an `EnvConfig` that every source has."""
VECTOR_ARGUMENTS = ("num_threads", "autoreset_mode")
"""Keyword arguments of vector environments that a single environment does not have."""
_SOURCE_MODULES = ("codrl_mj.envs.task_source", "codrl_mj.external_envs.gymnasium_source")
"""Modules of the built-in kinds of sources. Each has `claims(name)` and `find(name)`."""
_UNITS = (
    (("m",) * 3 + ("1",) * 4, ("m/s",) * 3 + ("rad/s",) * 3),  # free
    (("1",) * 4, ("rad/s",) * 3),  # ball
    (("m",), ("m/s",)),  # slide
    (("rad",), ("rad/s",)),  # hinge
)
"""Units of the entries of `qpos` (with quaternions) and of `qvel`, by MuJoCo's type of joint."""


class EnvSource(abc.ABC):
    """Source of environments; a subclass defines `name` and `make`, and may override the rest.

    `make` returns a Gymnasium environment whose motors can be recorded. `codrl_mj.make` creates it
    from any function that returns an environment with MuJoCo's `model` and `data`.
    """

    name: str
    """Name in messages."""
    fields: tuple[str, ...] = (*COMMON_FIELDS, "joint_dynamics")
    """Fields of an `EnvConfig` that it supports; others must stay at their defaults."""
    time_limit: int | None = None
    """Maximum length of an episode [environment steps]; None for no limit."""
    default_actuator: str = "ideal"
    """Actuator of its motors if the configuration names none."""
    paper: tuple[Any, ...] = ()
    """Actuators from which the named ones (`paper`, `weak`, ...) are derived; empty if none."""
    preset: str | None = None
    """Task whose tuned agent settings are the defaults; None for general settings."""
    goal_hold: float = 0.0
    """Minimum time at the goal at the end of a successful episode [s]."""
    timed: bool = False
    """True if the time to reach the goal is reported; False if success is not to terminate."""
    env_id: str = ""
    """Gymnasium id, if `gymnasium.make` accepts the fields of an `EnvConfig` for it."""
    option_names: tuple[str, ...] = ()
    """Names of its options; empty if its environments take any keyword arguments."""

    @abc.abstractmethod
    def make(self, config: Any, **view: Any) -> Any:
        """Make an environment.

        Args:
            config: its `EnvConfig`.
            **view: `render_mode`, and other rendering settings of the environment.

        Raises:
            ValueError: the configuration does not fit the model.
        """

    def make_vec(self, config: Any, num_envs: int, **arguments: Any) -> Any:
        """Make a Gymnasium vector environment in `SAME_STEP` mode; by default stepped one by one.

        Args:
            config: their `EnvConfig`.
            num_envs: number of environments, >= 1.
            **arguments: those of `EnvConfig.make`, and `VECTOR_ARGUMENTS`.

        Raises:
            ValueError: see `make`.
        """
        # A direct import would be circular: `codrl_mj.envs.serial` imports this module.
        serial = importlib.import_module("codrl_mj.envs.serial")
        vector_arguments = {
            name: arguments.pop(name) for name in VECTOR_ARGUMENTS if name in arguments
        }
        return serial.SerialVectorEnv(
            num_envs, functools.partial(config.make, **arguments), **vector_arguments
        )

    # -- properties that need no environment --------------------------------------------------

    @property
    def evaluation_overrides(self) -> tuple[str, ...]:
        """Fields that evaluation resets to their defaults, for example a training's time limit."""
        return () if self.time_limit is None else ("max_episode_steps",)

    @property
    def reference(self) -> str:
        """Name by which `find_source` finds it in any process."""
        return reference_of(self, type(self).__module__)

    def code(self, options: Any) -> set[str | Path]:
        """Return names of modules and paths of files with its code; options may name files."""
        option_values = [
            value for value in self.non_default_options(options).values() if isinstance(value, str)
        ]
        # `Path.is_file` would raise for a long text, which is not a file name.
        files = (Path(value).resolve() for value in option_values if os.path.isfile(value))  # noqa: PTH113
        return {type(self).__module__, *files}

    def options(self, options: Any) -> Any:
        """Return options as the configuration stores them: as a mapping that JSON can hold.

        Raises:
            ValueError: the options are not such a mapping.
        """
        try:
            json_options = json.loads(json.dumps(dict(options or {})))
            if reserved_names := {"render_mode", *self.fields} & json_options.keys():
                raise ValueError(f"{reserved_names.pop()!r} is not an argument of the environment")
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"options = {options!r}: must be a mapping that JSON can hold ({error}); register"
                " an environment that needs other arguments under its own id"
            ) from None
        return json_options

    def non_default_options(self, options: Any) -> dict[str, Any]:
        """Return the options that differ from their defaults, by name."""
        return dict(options)

    def option_flags(self, config: Any) -> list[tuple[str, Any, str, Any]]:
        """Return name, type, description and default of each flag for the options."""
        values = tuple(f"{name}={json.dumps(value)}" for name, value in config.options.items())
        description = (
            "Keyword arguments of the environment, such as frame_skip=2: their values as JSON, or"
            " else as text."
        )
        return [("options", tuple[str, ...], description, values)]

    def options_of(self, flags: Mapping[str, Any]) -> dict[str, Any]:
        """Parse the options from the values of their flags.

        Raises:
            ValueError: an item is not NAME=VALUE.
        """
        options = {}
        for item in flags["options"]:
            name, separator, text = item.partition("=")
            if not separator or not name:
                raise ValueError(f"--env.options {item}: must be NAME=VALUE")
            try:
                options[name] = json.loads(text)
            except ValueError:
                options[name] = text
        return options

    def actuators(self, actuator: Any) -> Any:
        """Return the actuators as the configuration stores them: pattern -> `ActuatorModel`.

        Raises:
            ValueError: it is not an actuator, or one of its values is out of bounds.
        """
        from codrl_mj.engine.specs import resolve_patterns

        return resolve_patterns(
            actuators_by_pattern(actuator, self.default_actuator), f"the environment {self.name}"
        )

    def actuators_by_name(self, actuators: Any) -> dict[str, ActuatorModel]:
        """Return pattern -> actuator from the result of `actuators`."""
        return dict(actuators)

    def override_actuators(self, config: Any, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Return pattern -> actuator: those in `patterns`, else the configured ones."""
        from codrl_mj.engine.reading import actuators_sharing_motor
        from codrl_mj.engine.specs import match_pattern, matchable_names

        if all(configured == IDEAL for configured in config.actuators):
            return dict(patterns)
        with contextlib.closing(config.make()) as env:
            model = env.unwrapped.model
            names = matchable_names(model)
        overridden = {index for pattern in patterns for index in match_pattern(pattern, names)}
        remaining = {
            " & ".join(
                re.escape(names[motor][0])
                for motor in actuators_sharing_motor(model, index)
                if motor not in overridden
            ): actuator
            for pattern, actuator in config.actuators_by_name.items()
            for index in match_pattern(pattern, names)
            if index not in overridden
        }
        return {**remaining, **patterns}

    @property
    def scripted_task(self) -> Any:
        """The task whose scripted controller shows what its motor must do.

        Raises:
            ValueError: there is no such controller.
        """
        raise ValueError(
            f"{self.name}: there is no scripted controller for it; train it with --actuator ideal"
            " and name the run"
        )

    def with_motor_steps(self, config: Any) -> Any:
        """Return a configuration with the time resolution that motors would need."""
        return config

    # -- properties that are read from an environment -----------------------------------------

    def action_space(self, config: Any) -> "spaces.Space[Any]":
        """Return the action space without motors; other commands change its bounds or size."""
        return _original_action_space(self, json.dumps(self.non_default_options(config.options)))

    def default_agent(self, config: Any) -> str:
        """Return the name of the agent that is trained by default."""
        return "sac" if isinstance(self.action_space(config), spaces.Box) else "ppo"

    def view(
        self,
        config: Any,  # noqa: ARG002
        width: int,  # noqa: ARG002
        height: int,  # noqa: ARG002
        camera: str | None,
    ) -> dict[str, Any] | None:
        """Return arguments of `make` for rendering; None if recorded states are rendered instead.

        Raises:
            ValueError: it has no such camera, or no choice of cameras.
        """
        if camera is not None:
            raise ValueError(
                f"camera = {camera!r}: {self.name} always renders with its own camera: leave it out"
            )
        return {"render_mode": "rgb_array"}

    def scene(self, config: Any) -> tuple[Any, Any, str | None]:
        """Return the model to render, a function (state) -> `MjData` or None, a camera or None."""
        with contextlib.closing(config.make()) as env:
            return env.unwrapped.model, None, None

    def state_names(self, config: Any) -> tuple[str, ...]:
        """Return names and units of the recorded states: positions and speeds of the joints."""
        model = self.scene(config)[0]
        positions: list[str] = []
        speeds: list[str] = []
        for index, kind in enumerate(model.jnt_type.tolist()):
            joint = model.joint(index).name or f"joint {index}"
            for names, units in zip((positions, speeds), _UNITS[kind], strict=True):
                names += [
                    f"{joint}{f' {k}' if len(units) > 1 else ''} [{unit}]"
                    for k, unit in enumerate(units)
                ]
        return (*positions, *speeds)

    def interface(self, config: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Describe the observations and actions that a policy and its environment exchange.

        Returns:
            Entries of the observation, and of the action, in order: `name`, `unit` (None if
            unknown) and the bounds `least` and `most`, None if unbounded. A discrete action is one
            entry, with the `levels` of its indices, if they are known.
        """
        with contextlib.closing(config.make()) as env:
            observation_space, action_space = env.observation_space, env.action_space
            motors = env.get_wrapper_attr("recorder").motor_names
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ValueError(f"{self.name}: observations are {observation_space}: must be vectors")
        observations = describe_box(
            [f"observation {k}" for k in range(observation_space.shape[0])], observation_space
        )
        if isinstance(action_space, spaces.Discrete):
            return observations, [{"name": "action", "unit": None}]
        if not isinstance(action_space, spaces.Box) or len(action_space.shape) != 1:
            raise ValueError(
                f"{self.name}: actions are {action_space}: must be vectors, or Discrete"
            )
        names = (
            motors
            if len(motors) == action_space.shape[0]
            else [f"action {k}" for k in range(action_space.shape[0])]
        )
        return observations, describe_box(names, action_space)

    def at_goal(self, episode: Any) -> np.ndarray | None:
        """Return a bool array (T+1,), True for states at the goal; None if unknown."""
        return None if episode.succeeded is None else np.full(len(episode.state), episode.succeeded)


def describe_box(
    names: Sequence[str], box: spaces.Box, units: Sequence[str | None] | None = None
) -> list[dict[str, Any]]:
    """Describe the entries of a vector box, as in `EnvSource.interface`."""
    bounds = (
        [float(bound) if np.isfinite(bound) else None for bound in side]
        for side in (box.low, box.high)
    )
    columns = zip(names, units or [None] * len(names), *bounds, strict=True)
    return [
        {"name": name, "unit": unit, "least": lower, "most": upper}
        for name, unit, lower, upper in columns
    ]


def options_mapping(options: Any) -> dict[str, Any]:
    """Return options as keyword arguments, from a mapping, a task's `NamedTuple` or None."""
    try:
        return options._asdict() if hasattr(options, "_asdict") else dict(options or {})
    except (TypeError, ValueError):
        raise ValueError(
            f"options = {options!r}: must be a mapping of option names to values"
        ) from None


@functools.cache
def _original_action_space(source: EnvSource, options: str) -> "spaces.Space[Any]":
    """Return the action space of a source without motors; options are JSON text, to be hashable."""
    config = importlib.import_module("codrl_mj.envs.config").EnvConfig(
        source.reference, options=json.loads(options)
    )
    with contextlib.closing(source.make(config)) as env:
        return env.action_space


def actuators_by_pattern(actuator: Any, default: str = "ideal") -> Mapping[str, Any]:
    """Return pattern -> actuator, from a user's value of `actuator`."""
    if actuator in ({}, []) or isinstance(actuator, list | tuple):
        raise ValueError(
            f"actuator = {actuator!r}: must be one actuator for all motors, or a mapping of"
            " patterns to actuators, such as {'.*': 'lag'}"
        )
    return pattern_mapping(actuator) or {ALL_MOTORS: default if actuator == "default" else actuator}


def pattern_mapping(actuator: Any) -> Mapping[str, Any] | None:
    """Return a user's `actuator` if it is a mapping of patterns to actuators; otherwise None."""
    if not isinstance(actuator, Mapping) or {"family", "name"} & actuator.keys():
        return None
    for value in actuator.values():
        fields = value.items() if isinstance(value, Mapping) else ()
        is_actuator_mapping = any(
            name in ("family", "name")
            or dataclasses.is_dataclass(field_value)
            or isinstance(field_value, Mapping)
            for name, field_value in fields
        )
        if not (
            value is None
            or is_actuator_mapping
            or isinstance(value, str | Path | ActuatorModel)
            or is_family(value)
        ):
            return None
    return actuator or None


def is_source_name(name: str) -> bool:
    """Return True if a text has the form of a source's name, such as any `module:NAME`.

    The path of a folder does not, even if it looks like a Gymnasium id (`runs/swing-v2`).
    """
    if name in TASKS or re.fullmatch(r"[\w.]+:[\w.]+", name) is not None:
        return True
    return (
        any(kind.claims(name) for kind in map(importlib.import_module, _SOURCE_MODULES))
        and not Path(name).is_dir()
    )


def find_source(name: Any) -> EnvSource:
    """Find a source: a task's name, an environment's id, or `module:NAME` of a source or task."""
    if isinstance(name, str):
        for source_module in map(importlib.import_module, _SOURCE_MODULES):
            if source_module.claims(name):
                return source_module.find(name)
        if ":" in name:
            return source_of(load_object(name))
    # The task module's `find` raises an error that lists the known tasks.
    return importlib.import_module(_SOURCE_MODULES[0]).find(name)


@functools.singledispatch
def source_of(target: Any) -> EnvSource:
    """Return the source for an object that was loaded from `module:NAME`."""
    if isinstance(target, type):
        raise ValueError(
            f"{target.__qualname__}: must be an instance of it: {target.__qualname__}(...)"
        )
    raise ValueError(f"{target!r}: must be a codrl_mj.Task or a codrl_mj.EnvSource")


@source_of.register
def _(source: EnvSource) -> EnvSource:
    if not isinstance(getattr(source, "name", None), str):
        raise ValueError(
            f"{type(source).__qualname__}: must have a `name`, the text that messages use"
        )
    return source
