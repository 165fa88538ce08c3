"""Worlds: what environments are of, before motors are in them. Tasks of ours, anybody's environments, and one's own.

An `EnvConfig` names its world and asks it for everything in which worlds differ. One's own is an
instance of a subclass of `EnvSource`, found as `module:NAME`; no file of ours needs to know of it.
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

EVERY = ".*"
"""The pattern of all motors."""
COMMON = (
    *("task", "actuator", "action", "observe_actuator", "max_episode_steps", "allow_unstable"),
    *("disturbances", "randomize", "options"),
)
"""Fields of an `EnvConfig` that every world has."""
VECTOR_ARGUMENTS = ("num_threads", "autoreset_mode")
"""Keyword arguments of vectors of environments that a single environment does not have."""
_KINDS = ("codrl_mj.envs.task_world", "codrl_mj.external_envs.world")
"""Our kinds of worlds, a module each with `claims(name)`, `find(name)`: which names, and what is called so."""
_UNITS = (
    (("m",) * 3 + ("1",) * 4, ("m/s",) * 3 + ("rad/s",) * 3),  # free
    (("1",) * 4, ("rad/s",) * 3),  # ball
    (("m",), ("m/s",)),  # slide
    (("rad",), ("rad/s",)),  # hinge
)
"""Of the entries of `qpos`, quaternions among them, and of `qvel`, by the kind of joint."""


class EnvSource(abc.ABC):
    """What environments are of. One's own has a name, makes environments, and overrides what it knows better.

    What it makes are environments of Gymnasium's whose motors can be read, as `codrl_mj.make` makes
    them of any function that returns an environment with MuJoCo's `model` and `data`.
    """

    name: str
    """What messages call it."""
    fields: tuple[str, ...] = (*COMMON, "joint_dynamics")
    """Fields of an `EnvConfig` that it has; others have to be left at their defaults."""
    time_limit: int | None = None
    """The longest episode [environment steps]; None for any."""
    default_actuator: str = "ideal"
    """What its motors are unless something is said."""
    paper: tuple[Any, ...] = ()
    """The actuators of its motors of which `paper`, `weak` and so on are variations; none where there are none."""
    preset: str | None = None
    """The task for which settings of agents are known; None for what suits environments of any kind."""
    goal_hold: float = 0.0
    """How long an episode that succeeds has been at the goal when it ends [s]."""
    timed: bool = False
    """Whether its goal is reached at a time, and not kept all the time."""
    env_id: str = ""
    """Its id with Gymnasium, if `gymnasium.make` makes it with the fields of an `EnvConfig`."""
    option_names: tuple[str, ...] = ()
    """Names of options that it declares; none where they are what its environments take."""

    @abc.abstractmethod
    def make(self, config: Any, **view: Any) -> Any:
        """An environment.

        Args:
            config: its `EnvConfig`.
            **view: `render_mode`, and what else it takes for its rendering.

        Raises:
            ValueError: the configuration does not go with the model.
        """

    def vector(self, config: Any, num_envs: int, **arguments: Any) -> Any:
        """Some environments as one vector of Gymnasium's in `SAME_STEP` mode, here stepped one by one.

        Args:
            config: their `EnvConfig`.
            num_envs: how many, >= 1.
            **arguments: those of `EnvConfig.make`, and `VECTOR_ARGUMENTS`.

        Raises:
            ValueError: see `make`.
        """
        serial = importlib.import_module("codrl_mj.envs.serial")
        own = {name: arguments.pop(name) for name in VECTOR_ARGUMENTS if name in arguments}
        return serial.SerialVectorEnv(num_envs, functools.partial(config.make, **arguments), **own)

    # -- what is known without making one --------------------------------------------------------------------

    @property
    def posed(self) -> tuple[str, ...]:
        """Fields that an evaluation leaves at their defaults, whatever a training had: a time limit of its own."""
        return () if self.time_limit is None else ("max_episode_steps",)

    @property
    def reference(self) -> str:
        """What `find_world` finds it by in any process."""
        return reference_of(self, type(self).__module__)

    def code(self, options: Any) -> set[str | Path]:
        """Modules, by name, and files that decide on what it does: those among its options; others are not known."""
        given = [value for value in self.changed(options).values() if isinstance(value, str)]
        files = (Path(value).resolve() for value in given if os.path.isfile(value))  # noqa: PTH113 - or a long text
        return {type(self).__module__, *files}

    def options(self, given: Any) -> Any:
        """Options of its own, as a configuration keeps them: here keyword arguments that JSON can hold.

        Raises:
            ValueError: they are no such mapping.
        """
        try:
            kept = json.loads(json.dumps(dict(given or {})))
            if wrong := {"render_mode", *self.fields} & kept.keys():
                raise ValueError(f"{wrong.pop()!r} is no argument of the environment's")
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"options = {given!r}: must be a mapping that JSON can hold ({error}); register an"
                " environment of your own with whatever else it takes"
            ) from None
        return kept

    def changed(self, options: Any) -> dict[str, Any]:
        """Those of the options that are not at their defaults, by name."""
        return dict(options)

    def option_flags(self, config: Any) -> list[tuple[str, Any, str, Any]]:
        """Name, type, description and default of the flags for its options."""
        written = tuple(f"{name}={json.dumps(value)}" for name, value in config.options.items())
        about = (
            "Keyword arguments of the environment, such as frame_skip=2: their values as JSON, or"
            " else as text."
        )
        return [("options", tuple[str, ...], about, written)]

    def options_of(self, flags: Mapping[str, Any]) -> dict[str, Any]:
        """The options that its flags, by name, say.

        Raises:
            ValueError: one is not NAME=VALUE.
        """
        found = {}
        for item in flags["options"]:
            name, equals, text = item.partition("=")
            if not equals or not name:
                raise ValueError(f"--env.options {item}: must be NAME=VALUE")
            try:
                found[name] = json.loads(text)
            except ValueError:
                found[name] = text
        return found

    def actuators(self, given: Any) -> Any:
        """What a user wrote for the actuators, as a configuration keeps it: pattern of motors -> `ActuatorModel`.

        Raises:
            ValueError: it is none, or one of its values is out of bounds.
        """
        from codrl_mj.engine.specs import resolve_patterns

        return resolve_patterns(
            by_pattern(given, self.default_actuator), f"the environment {self.name}"
        )

    def driven(self, kept: Any) -> dict[str, ActuatorModel]:
        """Pattern -> actuator, of what `actuators` returned."""
        return dict(kept)

    def overlaid(self, config: Any, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Pattern -> what drives these motors: `patterns`, and what a configuration has for others, motor by motor."""
        from codrl_mj.engine.reading import actuators_sharing_motor
        from codrl_mj.engine.specs import match_pattern, matchable_names

        if all(one == IDEAL for one in config.actuators):
            return dict(patterns)
        with contextlib.closing(config.make()) as env:
            model = env.unwrapped.model
            names = matchable_names(model)
        taken = {index for pattern in patterns for index in match_pattern(pattern, names)}
        left = {
            " & ".join(
                re.escape(names[one][0])
                for one in actuators_sharing_motor(model, index)
                if one not in taken
            ): actuator
            for pattern, actuator in config.driven.items()
            for index in match_pattern(pattern, names)
            if index not in taken
        }
        return {**left, **patterns}

    @property
    def scripted(self) -> Any:
        """The task for which a controller is written, that shows what its motor has to do.

        Raises:
            ValueError: there is none.
        """
        raise ValueError(
            f"{self.name}: there is no scripted controller for it; train it with --actuator ideal"
            " and name the run"
        )

    def as_with_motors(self, config: Any) -> Any:
        """A configuration whose trace shows what motors would have to do: here each shows it."""
        return config

    # -- what is known of environments that are made ---------------------------------------------------------

    def action_space(self, config: Any) -> "spaces.Space[Any]":
        """Its own actions; commands have others of the same kind."""
        return _own_actions(self, json.dumps(self.changed(config.options)))

    def default_agent(self, config: Any) -> str:
        """Who is trained in it unless another is named."""
        return "sac" if isinstance(self.action_space(config), spaces.Box) else "ppo"

    def view(
        self,
        config: Any,  # noqa: ARG002
        width: int,  # noqa: ARG002
        height: int,  # noqa: ARG002
        camera: str | None,
    ) -> dict[str, Any] | None:
        """What `make` takes for images of that size [px]; None where they are drawn from an episode's states.

        Raises:
            ValueError: it has not this camera, or none that can be chosen.
        """
        if camera is not None:
            raise ValueError(
                f"camera = {camera!r}: {self.name} draws itself, by its own camera: leave it out"
            )
        return {"render_mode": "rgb_array"}

    def scene(self, config: Any) -> tuple[Any, Any, str | None]:
        """What an episode's states are shown in: a model; what poses it (state -> `MjData`), or None; a camera."""
        with contextlib.closing(config.make()) as env:
            return env.unwrapped.model, None, None

    def state_names(self, config: Any) -> tuple[str, ...]:
        """Names of the entries of an episode's states, with units: positions and speeds of the model's joints."""
        model = self.scene(config)[0]
        positions: list[str] = []
        speeds: list[str] = []
        for index, kind in enumerate(model.jnt_type.tolist()):
            joint = model.joint(index).name or f"joint {index}"
            for made, units in zip((positions, speeds), _UNITS[kind], strict=True):
                made += [
                    f"{joint}{f' {k}' if len(units) > 1 else ''} [{one}]"
                    for k, one in enumerate(units)
                ]
        return (*positions, *speeds)

    def interface(self, config: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """What passes between a policy and its environment, for whoever builds the other side of it.

        Returns:
            Entries of the observation, and of the action, in their order: `name`, `unit` (None
            where nobody knows) and the bounds `least` and `most`, None where there are none. A
            discrete action is one entry, with the `levels` that its indices stand for, if they are
            known.
        """
        with contextlib.closing(config.make()) as env:
            seen, acts = env.observation_space, env.action_space
            motors = env.get_wrapper_attr("recorder").motor_names
        if not isinstance(seen, spaces.Box) or len(seen.shape) != 1:
            raise ValueError(f"{self.name}: observations are {seen}: must be vectors")
        entries = described([f"observation {k}" for k in range(seen.shape[0])], seen)
        if isinstance(acts, spaces.Discrete):
            return entries, [{"name": "action", "unit": None}]
        if not isinstance(acts, spaces.Box) or len(acts.shape) != 1:
            raise ValueError(f"{self.name}: actions are {acts}: must be vectors, or Discrete")
        names = (
            motors
            if len(motors) == acts.shape[0]
            else [f"action {k}" for k in range(acts.shape[0])]
        )
        return entries, described(names, acts)

    def at_goal(self, episode: Any) -> np.ndarray | None:
        """Whether an episode is at the goal, before its first step and after each, (T+1,); None where nobody knows."""
        return None if episode.succeeded is None else np.full(len(episode.state), episode.succeeded)


def described(
    names: Sequence[str], box: spaces.Box, units: Sequence[str | None] | None = None
) -> list[dict[str, Any]]:
    """Entries of a box of vectors, as `EnvSource.interface` has them."""
    ends = (
        [float(end) if np.isfinite(end) else None for end in side] for side in (box.low, box.high)
    )
    columns = zip(names, units or [None] * len(names), *ends, strict=True)
    return [
        {"name": name, "unit": unit, "least": least, "most": most}
        for name, unit, least, most in columns
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
def _own_actions(world: EnvSource, options: str) -> "spaces.Space[Any]":
    config = importlib.import_module("codrl_mj.envs.config").EnvConfig(
        world.reference, options=json.loads(options)
    )
    with contextlib.closing(world.make(config)) as env:
        return env.action_space


def by_pattern(given: Any, default: str = "ideal") -> Mapping[str, Any]:
    """What a user wrote for the actuators of an environment, as pattern of motors -> what drives them."""
    if given in ({}, []) or isinstance(given, list | tuple):
        raise ValueError(
            f"actuator = {given!r}: must be one for all, or what drives what, such as {{'.*':"
            " 'lag'}"
        )
    return patterns_of(given) or {EVERY: default if given == "default" else given}


def patterns_of(given: Any) -> Mapping[str, Any] | None:
    """What a user wrote for actuators, if it is a mapping of patterns to them; None if it is one for all."""
    if not isinstance(given, Mapping) or {"family", "name"} & given.keys():
        return None
    for one in given.values():
        fields = one.items() if isinstance(one, Mapping) else ()
        of_actuator = any(
            name in ("family", "name")
            or dataclasses.is_dataclass(value)
            or isinstance(value, Mapping)
            for name, value in fields
        )
        if not (
            one is None
            or of_actuator
            or isinstance(one, str | Path | ActuatorModel)
            or is_family(one)
        ):
            return None
    return given or None


def is_world(word: str) -> bool:
    """Whether a word is the name of a world; of somebody's own any `module:NAME`.

    A folder's name may look like an environment's id, `runs/swing-v2`; then it is the folder's.
    """
    if word in TASKS or re.fullmatch(r"[\w.]+:[\w.]+", word) is not None:
        return True
    return (
        any(kind.claims(word) for kind in map(importlib.import_module, _KINDS))
        and not Path(word).is_dir()
    )


def find_world(name: Any) -> EnvSource:
    """The world called `name`: a task's name, an environment's id, or `module:NAME` of a world or a task."""
    if isinstance(name, str):
        for kind in map(importlib.import_module, _KINDS):
            if kind.claims(name):
                return kind.find(name)
        if ":" in name:
            return world_of(load_object(name))
    return importlib.import_module(_KINDS[0]).find(name)  # which refuses it, and says what there is


@functools.singledispatch
def world_of(thing: Any) -> EnvSource:
    """The world of what stands at `module:NAME`."""
    if isinstance(thing, type):
        raise ValueError(
            f"{thing.__qualname__}: must be an instance of it: {thing.__qualname__}(...)"
        )
    raise ValueError(f"{thing!r}: must be a codrl_mj.Task or a codrl_mj.World")


@world_of.register
def _(world: EnvSource) -> EnvSource:
    if not isinstance(getattr(world, "name", None), str):
        raise ValueError(
            f"{type(world).__qualname__}: must have a `name`, a text, which messages call it by"
        )
    return world
