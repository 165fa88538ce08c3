"""One description of an environment of somebody else's with motors, as run folders keep it."""

import contextlib
import dataclasses
import functools
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, mapping_of, names_of
from codrl_mj.actuators.model import load_module
from codrl_mj.disturbances import OFF, Disturbances, resolve_disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.distributions import Distribution, parse
from codrl_mj.fields import check_names
from codrl_mj.tasks import TASKS

EVERY = ".*"
"""The pattern of all actuators of a model."""
PREFIX = "model."
"""Of the fields that are the model's."""
_ID = re.compile(r"(?:[\w.]+:)?(?:[\w-]+/)?[\w.-]+-v\d+")


def is_gymnasium_id(name: Any) -> bool:
    """Whether a name is that of an environment of somebody else's: `HalfCheetah-v5`, `package/Robot-v0`."""
    return isinstance(name, str) and _ID.fullmatch(name) is not None


@dataclasses.dataclass(frozen=True)
class ForeignConfig:
    """An environment of Gymnasium's, or of anybody's who registers with it, with motors; but for its rendering.

    Raises:
        ValueError: a value is out of bounds. What depends on the model is checked when the environment is made.
    """

    task: str
    """Gymnasium id, such as `HalfCheetah-v5`; `module:ID` imports the module first."""
    actuators: Any = dataclasses.field(default_factory=lambda: {EVERY: "ideal"})
    """Pattern of names -> what is behind these actuators: as for `codrl_mj.motorise`. Kept as `ActuatorModel`s."""
    action: str = "force"
    """What the agent commands: `force`: the environment's own actions, whose forces are what is desired; or what the
    actuators take besides, such as `current` and `voltage`."""
    observe_actuator: bool = False
    """Whether the agent also observes what the motors' sensors say."""
    max_episode_steps: int | None = None
    """Time limit [environment steps], >= 1; the default is the environment's own."""
    allow_unstable: bool = False
    """Build the environment even if a motor is unstable at the model's step."""
    disturbances: Disturbances = OFF
    """Imperfections of the commands' way, once an environment step; each is off at 0."""
    randomize: Any = None
    """What to draw at every reset, as PATTERN:FIELD=DISTRIBUTION, such as '.*:motor.resistance=uniform(0.4, 0.6)';
    without a pattern, for all of them; or of the model, model.gravity, model.mass.BODY, model.damping.JOINT. In Python
    and in files a mapping of patterns to mappings of fields to distributions, and of the model's fields, as it is kept.
    """
    options: Any = dataclasses.field(default_factory=dict)
    """Keyword arguments of the environment, such as frame_skip; JSON has to hold them."""

    def __post_init__(self) -> None:
        """Validate, and turn what files and users write into what it stands for."""
        from codrl_mj.specs import resolve_patterns

        if not is_gymnasium_id(self.task):
            raise ValueError(f"task = {self.task!r}: must be the id of an environment, such as HalfCheetah-v5")
        if ":" in self.task:
            load_module(self.task)
        if not self.actuators:
            raise ValueError(f"actuators = {self.actuators!r}: must name what drives what, such as {{'.*': 'lag'}}")
        self._set("actuators", resolve_patterns(self.actuators, f"the environment {self.task}"))
        self._set("disturbances", resolve_disturbances(self.disturbances))
        for name in ("observe_actuator", "allow_unstable"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be true or false")
        limit = self.max_episode_steps
        if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
            raise ValueError(f"max_episode_steps = {limit!r}: must be an integer >= 1")
        if self.randomize is not None:
            self._set("randomize", _distributions(self.randomize, tuple(self.actuators)))
        taken = {"env_id", "disable_env_checker", "render_mode", *(field.name for field in dataclasses.fields(self))}
        try:
            self._set("options", json.loads(json.dumps(dict(self.options))))
            if wrong := taken & self.options.keys():
                raise ValueError(f"{wrong.pop()!r} is no argument of the environment's")
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"options = {self.options!r}: must be a mapping that JSON can hold ({error}); register an environment "
                "of your own with whatever else it takes"
            ) from None

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @property
    def actuator(self) -> tuple[ActuatorModel, ...]:
        """The actuator of each pattern."""
        return tuple(self.actuators.values())

    @property
    def through(self) -> str:
        """What to call the actuators."""
        return names_of(self.actuator)

    @property
    def spec(self) -> gymnasium.envs.registration.EnvSpec:
        """What Gymnasium knows of the environment.

        Raises:
            ValueError: there is no such environment; Gymnasium's message suggests one.
        """
        try:
            return gymnasium.spec(self.task.rpartition(":")[2])
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise ValueError(
                f"task = {self.task!r}: {error}; environments of packages that Gymnasium does not load by itself are "
                "named module:ID"
            ) from None

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The environment's own actions; commands have others of the same kind."""
        with self._saying_so():
            return _action_space(self.spec.id, json.dumps(self.options))

    @property
    def time_limit(self) -> int | None:
        """The longest episode [environment steps]; None for any."""
        return self.max_episode_steps or self.spec.max_episode_steps

    @property
    def as_posed(self) -> "ForeignConfig":
        """The environment with the time limit that it was registered with, if with any."""
        return self if self.spec.max_episode_steps is None else dataclasses.replace(self, max_episode_steps=None)

    @property
    def modules(self) -> set[str]:
        """Names of the modules that decide on what it does: of the environment and the actuators' families."""
        own = getattr(self._creator, "__module__", ""), self.task.rpartition(":")[0]
        return {type(one).__module__ for one in self.actuator} | {name for name in own if name}

    @property
    def models(self) -> set[Path]:
        """Files among its options, such as `xml_file`; what else the environment reads is not known."""
        given = (Path(value) for value in self.options.values() if isinstance(value, str))
        return {path.resolve() for path in given if path.is_file()}

    @property
    def _creator(self) -> Any:
        from gymnasium.envs.registration import load_env_creator

        entry = self.spec.entry_point
        return load_env_creator(entry) if isinstance(entry, str) else entry

    def view(self, width: int, height: int, camera: str | None = None) -> dict[str, Any]:
        """What `make` takes for images: in that size [px] and by that camera where Gymnasium's `MujocoEnv` draws them.

        Raises:
            ValueError: a camera is named, and the environment is none of these.
        """
        from gymnasium.envs.mujoco import MujocoEnv

        chosen = {} if camera is None else {"camera_name": camera}
        if isinstance(self._creator, type) and issubclass(self._creator, MujocoEnv):
            return {"render_mode": "rgb_array", "width": width, "height": height, **chosen}
        if camera is not None:
            raise ValueError(f"camera = {camera!r}: {self.task} draws itself, by its own camera: leave it out")
        return {"render_mode": "rgb_array"}

    @property
    def interface(self) -> dict[str, Any]:
        """The fields that say what a policy commands and observes: it can do nothing else once it is trained."""
        return {name: getattr(self, name) for name in ("action", "observe_actuator")}

    def seen_as(self, trained: Any) -> "ForeignConfig":
        """This environment with the actions and observations of another: those that a policy was trained with."""
        return dataclasses.replace(self, **trained.interface)

    def make(self, **view: Any) -> "gymnasium.Env[Any, Any]":
        """The environment.

        Args:
            **view: `render_mode`, and what else the environment takes for its rendering.

        Raises:
            ValueError: see `codrl_mj.make`.
        """
        from codrl_mj.foreign.environments import make

        self.check_limit()
        names = ("action", "observe_actuator", "randomize", "allow_unstable")
        limit: dict[str, Any] = {}
        if self.max_episode_steps is not None:
            limit = {"max_episode_steps": self.max_episode_steps}
        with self._saying_so():
            return make(
                self.spec.id,
                self.actuators,
                **{name: getattr(self, name) for name in names},
                disturbances=None if self.disturbances == OFF else self.disturbances,
                disable_env_checker=True,
                **limit,
                **{**self.options, **view},
            )

    @contextlib.contextmanager
    def _saying_so(self) -> Iterator[None]:
        """Name the environment in errors of making it, and its options where it does not take them."""
        try:
            yield
        except TypeError as error:
            raise ValueError(f"options = {self.options!r}: {self.task} does not take them: {error}") from None
        except ValueError as error:
            raise ValueError(f"{self.task}: {error}") from None

    def check_limit(self) -> None:
        """Refuse an environment whose episodes need not end.

        Raises:
            ValueError: it has no time limit.
        """
        if self.time_limit is None:
            raise ValueError(
                f"max_episode_steps = None: {self.task} was registered without a time limit, and its episodes might "
                "never end: give one, in environment steps"
            )

    def make_sb3(self, num_envs: int) -> Any:
        """Some of the environments, stepped one by one, as one Stable-Baselines3 `VecEnv`.

        Raises:
            ValueError: see `codrl_mj.make`; or observations are no vector.
        """
        from codrl_mj.envs.sb3 import make_sb3_vec_env

        return make_sb3_vec_env(self.make, num_envs)

    def as_mapping(self) -> dict[str, Any]:
        """The configuration as JSON-serialisable values; `from_mapping` reads it."""
        return {
            **vars(self),
            "actuators": {pattern: mapping_of(one) for pattern, one in self.actuators.items()},
            "disturbances": self.disturbances.as_mapping(),
        }

    @classmethod
    def from_mapping(cls, mapping: Any, base: "ForeignConfig | None" = None) -> "ForeignConfig":
        """The configuration that a mapping describes: `as_mapping`'s, or any part of it.

        Args:
            mapping: the fields; `actuator` is one for all of a model's.
            base: what is not given is this one's.

        Raises:
            ValueError: a key is unknown (the nearest known one is suggested), or a value out of bounds.
        """
        given = dict(mapping)
        check_names(given, [*(field.name for field in dataclasses.fields(cls)), "actuator"], "key", "env.")
        if "actuator" in given:
            if "actuators" in given:
                raise ValueError("env.actuator: there are env.actuators too; give one of them")
            one = given.pop("actuator")
            given["actuators"] = {EVERY: "ideal" if one == "default" else one}
        return cls(**given) if base is None else dataclasses.replace(base, **given)


def environment_from(mapping: Any, base: Any = None) -> "EnvConfig | ForeignConfig":
    """The environment that a mapping describes, a task's or somebody else's, as its `task` says.

    Args:
        mapping: as for `EnvConfig.from_mapping` and `ForeignConfig.from_mapping`.
        base: what is not given is this one's, if it is of the same kind.

    Raises:
        ValueError: as for these.
    """
    if not isinstance(mapping, Mapping):
        raise ValueError(f"env = {mapping!r}: must be a mapping of the environment's arguments")
    given, ours = dict(mapping), {task.env_id: name for name, task in TASKS.items()}
    task = given.get("task", None if base is None else base.task)
    if task in ours:
        given["task"] = task = ours[task]
    kind: Any = ForeignConfig if is_gymnasium_id(task) else EnvConfig
    return kind.from_mapping(given, base if isinstance(base, kind) else None)


@functools.cache
def _action_space(task: str, options: str) -> spaces.Space[Any]:
    env = gymnasium.make(task, disable_env_checker=True, **json.loads(options))
    space = env.action_space
    env.close()
    return space


def _distributions(given: Any, patterns: tuple[str, ...]) -> dict[str, Any]:
    """Pattern -> field -> text of a distribution; and field of the model -> text.

    Raises:
        ValueError: it is neither a mapping of mappings nor a list of PATTERN:FIELD=DISTRIBUTION, or a text is none.
    """
    if not isinstance(given, Mapping):
        given = _spread(given, patterns)
    of_model = {name: one for name, one in given.items() if str(name).startswith(PREFIX)}
    of_motors = {pattern: each for pattern, each in given.items() if pattern not in of_model}
    if not given or not all(isinstance(each, Mapping) for each in of_motors.values()):
        raise ValueError(
            f"randomize = {given!r}: must be a mapping of the actuators' patterns to mappings of fields to "
            f"distributions, such as {{{patterns[0]!r}: {{'motor.resistance': 'uniform(0.4, 0.6)'}}}}"
        )
    try:
        return {pattern: {name: _text(one) for name, one in each.items()} for pattern, each in of_motors.items()} | {
            name: _text(one) for name, one in of_model.items()
        }
    except ValueError as error:
        raise ValueError(f"randomize: {error}") from None


def _text(distribution: Any) -> str:
    return str(distribution if isinstance(distribution, Distribution) else parse(distribution))


def _spread(items: Any, patterns: tuple[str, ...]) -> dict[str, Any]:
    """What a list of [PATTERN:]FIELD=DISTRIBUTION says of each pattern, and of the model."""
    found: dict[str, Any] = {}
    for item in [items] if isinstance(items, str) else items:
        match = re.fullmatch(r"(?:(.*):)?\s*([^:=]+?)\s*=\s*(\w+\(.*\))\s*", str(item))
        if match is None:
            raise ValueError(
                f"randomize: {item!r}: must be [PATTERN:]FIELD=DISTRIBUTION, such as "
                "'.*:motor.resistance=uniform(0.4, 0.6)'"
            )
        pattern, name, text = match.groups()
        if pattern is None and name.startswith(PREFIX):
            if name in found:
                raise ValueError(f"randomize: {name} is named twice: give it one distribution")
            found[name] = text
            continue
        for one in patterns if pattern is None else (pattern,):
            if name in found.setdefault(one, {}):
                raise ValueError(f"randomize: {name} is named twice for {one!r}: give it one distribution")
            found[one][name] = text
    return found
