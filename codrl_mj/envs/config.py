"""An environment's arguments, complete: what every face is built from, run folders store and flags are made of.

Light to import: nothing is compiled, and no engine loaded.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.actuators import ActuatorModel, mapping_of, names_of
from codrl_mj.disturbances import OFF, PLAIN, Disturbances, Joint, resolve_disturbances, resolve_joint
from codrl_mj.envs.distributions import Distribution, parse
from codrl_mj.fields import check_names
from codrl_mj.tasks import Task, find_task, reference_of, resolve_actuators
from codrl_mj.tasks.assets import asset_path


class UnknownOptionError(ValueError, TypeError):
    """A keyword that the environment does not have; a TypeError too, as Python's own is, and as TorchRL expects."""


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """An environment but for its rendering; None leaves the task's default.

    Raises:
        ValueError: unknown task, actuator or option, or a value out of bounds. What depends on several fields at once
            is checked when the environment is built.
    """

    task: str
    """Task name, such as `cartpole`; or `module:NAME` of one's own."""
    actuator: Any = "default"
    """What the force goes through: a name (`default`, the task's own: the paper's where there is one; `ideal`, `paper`,
    `weak`, `weaker`, `open_loop`, or a family's or a motor's), an `ActuatorModel`, a mapping of its fields (with a
    `name`, over that actuator's), a file of them, `module:NAME`, or None (ideal). With several motors all get it, or it
    is a list with one for each. Kept as an `ActuatorModel`, or as a tuple of several."""
    physics: str = "mujoco"
    """`mujoco`; `analytic`: Gymnasium's own equations, Furuta's closed form; or one's own, as registered."""
    integrator: str | None = None
    """One of the task's integrators (CartPole: `euler` or `semi-implicit`); the default is Gymnasium's."""
    inner_steps: int | None = None
    """Integration steps per environment step; the default is the paper's inner loop with a motor and Gymnasium's one
    without. Furuta: 10."""
    timestep: float | None = None
    """Instead of inner_steps, the integration step [s], which must divide the environment step."""
    action: str = "force"
    """What the agent commands: the desired `force` (the paper), the reference `current`, or the raw terminal `voltage`
    past the controller (end to end); or what else the actuator's family takes."""
    levels: tuple[float, ...] | None = None
    """Discrete tasks that command a current [A] or a voltage [V]: the levels that the actions choose from."""
    observe_actuator: bool = False
    """Whether the agent also observes measured and reference current [A]."""
    max_episode_steps: int | None = None
    """Time limit [environment steps], >= 1; the default is Gymnasium's."""
    allow_unstable: bool = False
    """Build the environment even if the current loop is unstable."""
    disturbances: Disturbances = OFF
    """Imperfections of the commands' way, and load pulses; each is off at 0."""
    joint: Joint = PLAIN
    """What is added to the actuated joints."""
    randomize: tuple[str, ...] | None = None
    """What to draw at every reset, as FIELD=DISTRIBUTION, such as 'motor.inductance=uniform(0.05, 0.2)'; distributions
    are uniform(LOW, HIGH), loguniform(LOW, HIGH) and choice(VALUE, ...). Fields are the actuator's, and of the model
    model.mass.BODY, model.length.BODY, model.gravity and model.damping.JOINT. In Python and in files a mapping of
    fields to distributions will do as well. What was drawn is in the reset's info, `randomization`."""
    options: Any = None
    """The task's own options, a mapping (CartPole: `center_radius`, `sutton_barto_reward`); kept as the task's
    `NamedTuple`."""

    def __post_init__(self) -> None:
        """Validate, and turn what files and users write into what it stands for, and numpy's values into Python's."""
        for field in dataclasses.fields(self):
            self._set(field.name, _plain(getattr(self, field.name)))
        task = find_task(self.task)
        self._set("task", reference_of(task))
        actuators = resolve_actuators(self.actuator, task)
        self._set("actuator", actuators[0] if len(actuators) == 1 else actuators)
        if isinstance(self.levels, list | tuple):
            self._set("levels", tuple(map(_plain, self.levels)))
        self._set("disturbances", resolve_disturbances(self.disturbances))
        self._set("joint", resolve_joint(self.joint))
        if self.randomize is not None:
            self._set("randomize", _written(self.randomize))
        given = _changed(self.options) if isinstance(self.options, tuple) else self.options
        self._set("options", _options(task, given or {}))
        limit = self.max_episode_steps
        if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
            raise ValueError(f"max_episode_steps = {limit!r}: must be an integer >= 1")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @classmethod
    def of(cls, task: str, actuator: Any, arguments: Mapping[str, Any]) -> "EnvConfig":
        """The configuration that the keyword arguments of a face describe.

        Args:
            task: the task's name.
            actuator: as for the field.
            arguments: other fields, and the task's own options; a time limit is the face's own matter.

        Raises:
            UnknownOptionError: neither has a name that is given.
            ValueError: as for the class.
        """
        names = {field.name for field in dataclasses.fields(cls)} - {"options", "max_episode_steps"}
        fields = {name: value for name, value in arguments.items() if name in names}
        options = {name: value for name, value in arguments.items() if name not in names}
        return cls(task, actuator, options=options, **fields)

    @property
    def actuators(self) -> tuple[ActuatorModel, ...]:
        """The actuator of each motor."""
        return self.actuator if isinstance(self.actuator, tuple) else (self.actuator,)

    @property
    def through(self) -> str:
        """What to call the actuators."""
        return names_of(self.actuators, find_task(self.task).paper)

    @property
    def distributions(self) -> dict[str, Distribution] | None:
        """What is drawn at every reset, in this order; None if nothing is."""
        return None if self.randomize is None else {name: parse(text) for name, text in map(_split, self.randomize)}

    @property
    def time_limit(self) -> int | None:
        """The longest episode [environment steps]; None for any."""
        return self.max_episode_steps or find_task(self.task).max_episode_steps

    @property
    def action_space(self) -> "gymnasium.spaces.Space[Any]":
        """The task's actions; commands have others of the same kind."""
        return find_task(self.task).action_space

    @property
    def as_posed(self) -> "EnvConfig":
        """The environment without changes of time limit and reward."""
        return dataclasses.replace(self, max_episode_steps=None, options=None)

    @property
    def modules(self) -> set[str]:
        """Names of the modules that decide on what it does."""
        return {type(self.actuators[0]).__module__, find_task(self.task).reward.__module__}

    @property
    def models(self) -> set[Path]:
        """Model files that decide on what it does."""
        return {asset_path(find_task(self.task).asset).resolve()}

    @property
    def interface(self) -> dict[str, Any]:
        """The fields that say what a policy commands and observes: it can do nothing else once it is trained."""
        return {name: getattr(self, name) for name in ("action", "levels", "observe_actuator")}

    def seen_as(self, trained: Any) -> "EnvConfig":
        """This environment with the actions and observations of another: those that a policy was trained with."""
        return dataclasses.replace(self, **trained.interface)

    def as_arguments(self) -> dict[str, Any]:
        """The keyword arguments for `gymnasium.make` with the task's id, without those left at their defaults."""
        arguments = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)[1:]}
        del arguments["options"]
        arguments["randomize"] = self.distributions
        given = {name: value for name, value in arguments.items() if value is not None and value not in (OFF, PLAIN)}
        return given | _changed(self.options)

    def make(self, **view: Any) -> "gymnasium.Env[Any, Any]":
        """The environment, made by Gymnasium.

        Args:
            **view: `render_mode`, `width`, `height`, `camera` and `pretty`, as for `codrl_mj.envs.ActuatedEnv`.
        """
        env_id = find_task(self.task).env_id
        return gymnasium.make(env_id, disable_env_checker=True, **self.as_arguments(), **view)

    def as_mapping(self) -> dict[str, Any]:
        """The configuration as JSON-serialisable values; `from_mapping` reads it."""
        described = [mapping_of(one) for one in self.actuators]
        return {
            **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)},
            "actuator": described if isinstance(self.actuator, tuple) else described[0],
            "disturbances": self.disturbances.as_mapping(),
            "joint": dataclasses.asdict(self.joint),
            "options": _changed(self.options),
        }

    @classmethod
    def from_mapping(cls, mapping: Any, base: "EnvConfig | None" = None) -> "EnvConfig":
        """The configuration that a mapping describes: `as_mapping`'s, or any part of it.

        Args:
            mapping: the fields; the task's own options may stand among them.
            base: what is not given is this one's; disturbances, joint and options by their fields. Of a base of another
                task, the actuator and whatever else has a default of the task's are the task's.

        Raises:
            ValueError: a key is unknown (the nearest known one is suggested), or a value out of bounds.
        """
        if not isinstance(mapping, Mapping):
            raise ValueError(f"env = {mapping!r}: must be a mapping of the environment's arguments")
        given = dict(mapping) if base is None else {"task": base.task, **mapping}
        if "task" not in given:
            raise ValueError("it has no task")
        task = find_task(given["task"])
        own = task.options._fields
        check_names(given, [*(field.name for field in dataclasses.fields(cls)), *own], "key", "env.")
        if options := {name: given.pop(name) for name in own if name in given}:
            given["options"] = {**(given.get("options") or {}), **options}
        if base is None:
            return cls(**given)
        if reference_of(task) != base.task:
            defaults: dict[str, Any] = {field.name: None for field in dataclasses.fields(cls) if field.default is None}
            defaults |= {"task": given["task"], "actuator": task.default_actuator}
            base = dataclasses.replace(base, **defaults)
        there = base.as_mapping()
        for name in ("disturbances", "joint", "options"):
            if isinstance(given.get(name), Mapping):
                given[name] = {**there[name], **given[name]}
        return dataclasses.replace(base, **given)


def _options(task: Task, given: Mapping[str, Any]) -> Any:
    """The task's options, checked.

    Raises:
        UnknownOptionError: unknown option.
        ValueError: one that is not a number > 0, or not True or False where its default is either.
    """
    known = task.options._fields
    plain = {name: _plain(value) for name, value in given.items()}
    for name, value in plain.items():
        if name not in known:
            has = ", ".join(known) or "none"
            raise UnknownOptionError(
                f"unknown option {name!r} of {task.name}: it has {has} (unexpected keyword argument {name!r})"
            )
        flag = isinstance(task.options._field_defaults[name], bool)
        if isinstance(value, bool) != flag or not isinstance(value, int | float) or not (flag or value > 0):
            raise ValueError(f"{name} = {value!r}: must be {'True or False' if flag else 'a number > 0'}")
    return task.options(**{name: value if isinstance(value, bool) else float(value) for name, value in plain.items()})


def _plain(value: Any) -> Any:
    """A number or an array of numpy's as Python's own number or list."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _changed(options: Any) -> dict[str, Any]:
    """Those of a task's options that are not at their defaults."""
    return {name: value for name, value in options._asdict().items() if value != options._field_defaults[name]}


def _written(randomize: Any) -> tuple[str, ...]:
    """Fields and distributions as hashable, JSON-serialisable text, in the order in which they are drawn.

    Args:
        randomize: a mapping of fields to distributions or their text, or a sequence of 'FIELD=DISTRIBUTION'.

    Raises:
        ValueError: it is neither or empty, a field is named twice, or a distribution is none.
    """
    if isinstance(randomize, str) or not isinstance(randomize, Mapping | list | tuple) or not randomize:
        raise ValueError(
            f"randomize = {randomize!r}: must be one or more of FIELD=DISTRIBUTION, or a mapping of fields to these"
        )
    pairs = randomize.items() if isinstance(randomize, Mapping) else map(_split, randomize)
    written: dict[str, str] = {}
    for name, distribution in pairs:
        if name in written:
            raise ValueError(f"randomize: {name} is named twice: give it one distribution")
        try:
            written[name] = str(distribution if isinstance(distribution, Distribution) else parse(distribution))
        except ValueError as error:
            raise ValueError(f"randomize: {name}: {error}") from None
    return tuple(f"{name}={text}" for name, text in written.items())


def _split(item: Any) -> tuple[str, str]:
    """Field and distribution of 'FIELD=DISTRIBUTION'.

    Raises:
        ValueError: it has no field or no '='.
    """
    name, equals, text = item.partition("=") if isinstance(item, str) else ("", "", "")
    if not equals or not name.strip():
        raise ValueError(
            f"randomize: {item!r}: must be FIELD=DISTRIBUTION, such as 'motor.inductance=uniform(0.05, 0.2)'"
        )
    return name.strip(), text
