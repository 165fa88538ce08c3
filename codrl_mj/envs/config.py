"""Configuration of an environment, and the interface of the sources that build it.

    name, function or source -> EnvConfig -> build(): an environment with motors

The command line derives its flags from the fields of `EnvConfig`. Importing this module is fast: it
compiles nothing and does not load MuJoCo.
"""

import abc
import dataclasses
import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, combined_name, mapping_of
from codrl_mj.boundary import Argument, Info, Options
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint, resolve
from codrl_mj.envs.distributions import Distribution, parse_randomize
from codrl_mj.fields import check_joint_dynamics, check_names
from codrl_mj.tasks import TASKS, Task, find_task, reference_of
from codrl_mj.user_code import load_object

Env = gymnasium.Env[Any, Any]
"""Environment; observations and actions may be of any type."""
Space = gymnasium.spaces.Space[Any]
"""Space of actions or observations; its elements may be of any type."""
VecEnv = VectorEnv[Any, Any, Any]
"""Vector environment; observations, actions and their arrays may be of any type."""
StoredActuators = ActuatorModel | tuple[ActuatorModel, ...] | Mapping[str, ActuatorModel]
"""Value of `EnvConfig.actuator` after validation: one actuator, one for each motor of a task, or
patterns of motors' names with their actuators.
"""
COMMON_FIELDS = (
    *("task", "actuator", "action", "observe_actuator", "max_episode_steps", "allow_unstable"),
    *("disturbances", "randomize", "options"),
)
"""Fields of an `EnvConfig` that every source has."""


class EnvSource(abc.ABC):
    """Origin of environments: how to make them, and which actuators and options they have.

    A task, a Gymnasium id and a function that makes environments are sources of this package.
    """

    name: str
    """Name in messages."""
    fields: tuple[str, ...] = (*COMMON_FIELDS, "joint_dynamics")
    """Fields of an `EnvConfig` that it supports; others must stay at their defaults."""
    option_names: tuple[str, ...] = ()
    """Names of its options; empty if its environments take any keyword arguments."""
    time_limit: int | None = None
    """Maximum length of an episode [environment steps]; None for no limit."""
    default_actuator: str = "ideal"
    """Actuator of its motors if the configuration names none."""
    paper: tuple[DCMotorActuator, ...] = ()
    """Actuators from which the named ones (`paper`, `weak`, ...) are derived; empty if none."""
    task: Task | None = None
    """The task, if its environments are those of a task of this package."""

    @property
    def reference(self) -> str:
        """Name by which `find_source` finds it in any process."""
        return reference_of(self, type(self).__module__)

    @abc.abstractmethod
    def make(self, config: "EnvConfig", **arguments: Argument) -> Env:
        """Make an environment whose motors the package can record.

        Args:
            config: its configuration.
            **arguments: `render_mode`, and other arguments of the environment that are no fields of
                the configuration.

        Raises:
            ValueError: the configuration does not fit the model.
        """

    @abc.abstractmethod
    def make_vec(self, config: "EnvConfig", num_envs: int, **arguments: Argument) -> VecEnv:
        """Make a vector environment, by default in autoreset mode `SameStep`.

        Args:
            config: the configuration of its environments.
            num_envs: number of environments, >= 1.
            **arguments: those of `make`, and `num_threads` and `autoreset_mode`.

        Raises:
            ValueError: see `make`.
        """

    @abc.abstractmethod
    def action_space(self, config: "EnvConfig") -> Space:
        """Return the action space without motors; other commands change its bounds or size."""

    @abc.abstractmethod
    def actuators(self, actuator: object) -> "StoredActuators":
        """Return the user's `actuator` as the configuration stores it.

        Raises:
            ValueError: it is not an actuator, or one of its values is out of bounds.
        """

    @abc.abstractmethod
    def actuators_by_name(self, actuators: "StoredActuators") -> dict[str, ActuatorModel]:
        """Return motor, or pattern of motors, -> actuator from the result of `actuators`."""

    @abc.abstractmethod
    def override_actuators(self, config: "EnvConfig", patterns: Mapping[str, object]) -> Info:
        """Return motor, or pattern, -> actuator: `patterns`, and the configuration's for the rest.

        Args:
            config: the configuration.
            patterns: pattern of motors' names -> actuator that replaces the configuration's.
        """

    def options(self, options: Options) -> Options:
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

    def non_default_options(self, options: Options) -> Info:
        """Return the options that differ from their defaults, by name."""
        return dict(options)

    def code(self, options: Options) -> set[str | Path]:
        """Return names of modules and paths of files with its code; options may name files."""
        option_values = [
            value for value in self.non_default_options(options).values() if isinstance(value, str)
        ]
        # `Path.is_file` would raise for a long text, which is not a file name.
        files = (Path(value).resolve() for value in option_values if os.path.isfile(value))  # noqa: PTH113
        return {type(self).__module__, *files}


class SourceKind(NamedTuple):
    """Kind of env sources; `SOURCE_KINDS` has the built-in ones."""

    claims: Callable[[str], bool]
    """Function that returns True if a name is of this kind, such as a Gymnasium id."""
    find: Callable[[str], EnvSource]
    """Function that returns the source of a name that the kind claims."""
    wrap: Callable[[object, str | None], EnvSource | None]
    """Function that returns the source of an object, such as a task; None if it is of another kind.
    Its second argument is the object's `module:NAME`, if it was loaded by it.
    """


SOURCE_KINDS: list[SourceKind] = []
"""Kinds of sources. `import codrl_mj` imports the modules that register them, because these modules
import this one.
"""


def find_source(env: object) -> EnvSource:
    """Return the source of an environment.

    Args:
        env: a task's name, an environment's id, `module:NAME` of a task, a source or a function
            that makes environments; or such an object itself.

    Raises:
        ValueError: there is no such source.
    """
    target, name = env, None
    if isinstance(env, str):
        for kind in SOURCE_KINDS:
            if kind.claims(env):
                return kind.find(env)
        # An unknown name without a colon is taken for a task's: the error lists the tasks.
        target, name = (load_object(env) if ":" in env else find_task(env)), env
    if isinstance(target, EnvSource):
        if not isinstance(getattr(target, "name", None), str):
            raise ValueError(
                f"{type(target).__qualname__}: must have a `name`, the text that messages use"
            )
        return target
    if isinstance(target, type) and issubclass(target, EnvSource | Task):
        raise ValueError(
            f"{target.__qualname__}: must be an instance of it: {target.__qualname__}(...)"
        )
    for kind in SOURCE_KINDS:
        if (source := kind.wrap(target, name)) is not None:
            return source
    raise ValueError(
        f"env = {target!r}: must be a task's name, the id of an environment, module:NAME, a"
        " codrl_mj.Task, a codrl_mj.EnvSource, or a function or class that makes an environment;"
        " pass a function instead of an environment, such as lambda: gymnasium.make(ID)"
    )


def is_source_name(name: str) -> bool:
    """Return True if a text has the form of a source's name, such as any `module:NAME`.

    The path of an existing folder does not count, even if it looks like a Gymnasium id
    (`runs/swing-v2`); the name of a task does.
    """
    if name in TASKS or re.fullmatch(r"[\w.]+:[\w.]+", name) is not None:
        return True
    return not Path(name).is_dir() and any(kind.claims(name) for kind in SOURCE_KINDS)


def options_mapping(options: Options) -> Info:
    """Return options as keyword arguments, from a mapping, a task's `NamedTuple` or None."""
    try:
        return options._asdict() if hasattr(options, "_asdict") else dict(options or {})
    except (TypeError, ValueError):
        raise ValueError(
            f"options = {options!r}: must be a mapping of option names to values"
        ) from None


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """Settings of an environment, except rendering. None selects the environment's default.

    Raises:
        ValueError: unknown task, actuator or option, a value out of bounds, or a field that this
            kind of environment does not have. Conditions on several fields are checked when the
            environment is built.
    """

    task: Any
    """Task name, such as `cartpole`; the Gymnasium id of a third-party environment, such as
    `HalfCheetah-v5` (`package:ID` imports the package first); or `module:NAME` of a custom task, of
    a function that makes environments, or of an env source. In Python also such an object itself.
    """
    # A user's value of any documented form; after validation it is a `StoredActuators`.
    actuator: Any = "default"
    """Actuator that delivers the force. A name (`default`: the task's default, which is the paper's
    actuator if there is one; `ideal`, `paper`, `weak`, `weaker`, `open_loop`; or the name of a
    family or a motor), an `ActuatorModel`, a mapping of its fields (`name` selects the actuator
    that they modify), a file with such a mapping, `module:NAME`, or None (ideal). One actuator
    applies to all motors. A mapping from patterns of motor names to actuators, or for a task a list
    with one actuator for each motor, assigns different ones. Stored as an `ActuatorModel`, as a
    tuple for a task with several motors, or as a mapping of patterns for a third-party environment.
    """
    physics: str = "mujoco"
    """`mujoco`; `analytic` (Gymnasium's equations; Furuta: a closed form); or the name of a
    registered physics.
    """
    integrator: str | None = None
    """One of the task's integrators (CartPole: `euler`, `semi-implicit`); default: Gymnasium's."""
    inner_steps: int | None = None
    """Integration steps per environment step. The default is the paper's inner loop with a motor,
    and Gymnasium's single step without one. Furuta: 10.
    """
    timestep: float | None = None
    """Integration step [s], instead of inner_steps; it must divide the environment step."""
    action: str = "force"
    """Meaning of the agent's action: the desired `force` (as in the paper; actions of a third-party
    environment stay unchanged), the reference `current`, the terminal `voltage` without the
    controller, or another command of the actuator's family.
    """
    levels: tuple[float, ...] | None = None
    """Levels of current [A] or voltage [V] that the actions of a discrete task choose from."""
    observe_actuator: bool = False
    """True to append the motors' sensors to observations: for a current loop, the measured and the
    reference current [A].
    """
    max_episode_steps: int | None = None
    """Time limit [environment steps], >= 1; default: the environment's own."""
    allow_unstable: bool = False
    """Build the environment even if the current loop is unstable."""
    disturbances: Disturbances = NO_DISTURBANCES
    """Imperfections of the command path, and load pulses; each is off at 0."""
    joint: Joint = UNMODIFIED_JOINT
    """Damping, friction and armature that are added to the actuated joints."""
    joint_dynamics: str | None = None
    """Treatment of damping, armature and frictionloss in a third-party model if its motors have the
    same quantities: `keep` adds both; `replace` removes the model's values; None adds both and
    warns.
    """
    randomize: tuple[str, ...] | None = None
    """Fields to draw at every reset, as FIELD=DISTRIBUTION, such as
    'motor.inductance=uniform(0.05, 0.2)'; distributions are uniform(LOW, HIGH), loguniform(LOW,
    HIGH) and choice(VALUE, ...). Fields are the actuator's (in a third-party environment, a pattern
    and a colon in front of the field select motors: leg.*:motor.inductance), or the model's:
    model.mass.BODY, model.length.BODY, model.gravity and model.damping.JOINT. In Python and in
    files, a mapping of fields to distributions is also accepted. The drawn values are in the
    reset's info, `randomization`.
    """
    options: Options = None
    """Options of the task, a mapping (CartPole: `center_radius`, `sutton_barto_reward`; Furuta:
    `rod_length` and others of its rig), stored as the task's `NamedTuple`; for a third-party
    environment the keyword arguments of its constructor, such as frame_skip.
    """

    def __post_init__(self) -> None:
        """Validate, and convert values from files and numpy to the types of the fields."""
        values = {
            field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)
        }
        source = find_source(values["task"])
        # Only a function or a source may have no name, and is stored itself.
        is_named = isinstance(values["task"], str) or source.task is not None
        task = source.reference if is_named else values["task"]
        values |= {"task": task, "joint": resolve(values["joint"], UNMODIFIED_JOINT)}
        values["disturbances"] = resolve(values["disturbances"], NO_DISTURBANCES)
        for field in dataclasses.fields(self):
            if field.name not in source.fields and values[field.name] != field.default:
                raise ValueError(
                    f"{field.name} = {values[field.name]!r}: {source.name} has no such field: leave"
                    " it out"
                )
        values["actuator"] = source.actuators(values["actuator"])
        if isinstance(values["levels"], list | tuple):
            values["levels"] = tuple(map(_plain, values["levels"]))
        if values["randomize"] is not None:
            values["randomize"] = tuple(
                f"{path}={distribution}"
                for path, distribution in parse_randomize(values["randomize"]).items()
            )
        values["options"] = source.options(values["options"])
        for name in ("observe_actuator", "allow_unstable"):
            if not isinstance(values[name], bool):
                raise ValueError(f"{name} = {values[name]!r}: must be true or false")
        check_joint_dynamics(values["joint_dynamics"])
        limit = values["max_episode_steps"]
        if limit is not None and (
            isinstance(limit, bool) or not isinstance(limit, int) or limit < 1
        ):
            raise ValueError(f"max_episode_steps = {limit!r}: must be an integer >= 1")
        vars(self).update(values)

    @classmethod
    def of(
        cls, env: object, actuator: object = None, arguments: Mapping[str, Argument] | None = None
    ) -> tuple["EnvConfig", Info]:
        """Return an environment's configuration, and the arguments that are not part of it.

        Args:
            env: a configuration, or a value of `task`.
            actuator: value of the field of this name; None leaves it as it is.
            arguments: other fields, and options; and arguments of the environment's constructor,
                such as `render_mode`, which are returned.

        Raises:
            ValueError: as for the class.
        """
        config = env if isinstance(env, EnvConfig) else cls(env)
        fields = {} if actuator is None else {"actuator": actuator}
        return config.override({**fields, **(arguments or {})})

    def override(
        self, arguments: Mapping[str, Argument]
    ) -> tuple["EnvConfig", dict[str, Argument]]:
        """Return a copy with fields and options replaced, and the arguments that are neither."""
        source, remaining = self.source, dict(arguments)
        fields = {name: remaining.pop(name) for name in source.fields if name in remaining}
        if options := {
            name: remaining.pop(name) for name in source.option_names if name in remaining
        }:
            present_options = (
                options_mapping(fields["options"])
                if "options" in fields
                else source.non_default_options(self.options)
            )
            fields["options"] = {**present_options, **options}
        return (dataclasses.replace(self, **fields) if fields else self), remaining

    @property
    def source(self) -> EnvSource:
        """Source of the environment: a task, a Gymnasium id or a custom `EnvSource`."""
        return find_source(self.task)

    @property
    def actuators_by_name(self) -> dict[str, ActuatorModel]:
        """Name of a motor, or pattern of names, -> actuator."""
        return self.source.actuators_by_name(self.actuator)

    @property
    def actuators(self) -> tuple[ActuatorModel, ...]:
        """Actuator of each motor, or of each pattern of motors."""
        return tuple(self.actuators_by_name.values())

    @property
    def actuator_label(self) -> str:
        """Display name of the actuators."""
        return combined_name(self.actuators, self.source.paper)

    @property
    def distributions(self) -> dict[str, Distribution]:
        """Path -> distribution of the fields to draw at every reset, in the order of drawing."""
        return parse_randomize(self.randomize)

    @property
    def time_limit(self) -> int | None:
        """Maximum length of an episode [environment steps]; None if there is no limit."""
        return self.max_episode_steps or self.source.time_limit

    @property
    def action_space(self) -> Space:
        """Action space without motors; other commands change its bounds or size, not its type."""
        return self.source.action_space(self)

    @property
    def code(self) -> set[str | Path]:
        """Names of modules, and paths of files, with the code of the environment and actuators."""
        return {type(actuator).__module__ for actuator in self.actuators} | self.source.code(
            self.options
        )

    @property
    def policy_fields(self) -> Info:
        """Fields that define a policy's actions and observations; they cannot change later."""
        return {name: getattr(self, name) for name in ("action", "levels", "observe_actuator")}

    def build(self, **arguments: Argument) -> Env:
        """Build the environment.

        Args:
            **arguments: `render_mode` and other rendering settings; for a task `width`, `height`,
                `camera` and `pretty`, as for `codrl_mj.envs.ActuatedEnv`; otherwise arguments of
                `gymnasium.make` and of the environment. Fields and options given here replace those
                of the configuration.

        Raises:
            ValueError: fields contradict each other, or do not fit the model.
        """
        config, remaining = self.override(arguments)
        env = config.source.make(config, **remaining)
        if not isinstance(env, gymnasium.Env):
            raise ValueError(
                f"{config.source.name}: its `make` returned {env!r}: must be a gymnasium.Env"
            )
        return env

    def build_vec(self, num_envs: int = 1, **arguments: Argument) -> VecEnv:
        """Build N environments as a Gymnasium vector environment; see `codrl_mj.make_vec`."""
        # A list holds one actuator per environment, so it is not a value of the field `actuator`
        # and bypasses `override`.
        actuators_per_env = {
            name: arguments.pop(name)
            for name in ("actuator",)
            if isinstance(arguments.get(name), list | tuple)
        }
        config, remaining = self.override(arguments)
        return config.source.make_vec(config, num_envs, **actuators_per_env, **remaining)

    def as_mapping(self) -> Info:
        """Return the configuration as JSON-serializable values; `from_mapping` reads it."""
        # Names of runs are hashes of this mapping. A field that was added later is left out at its
        # default, so that the names of existing runs stay valid.
        omitted = {"joint_dynamics"} if self.joint_dynamics is None else {*()}
        if not isinstance(self.task, str):
            raise ValueError(
                f"task = {self.task!r}: must be a name to be written to a file: register the"
                " environment, or name the function as module:NAME"
            )
        return {
            **{
                field.name: getattr(self, field.name)
                for field in dataclasses.fields(self)
                if field.name not in omitted
            },
            "actuator": _to_json_values(self.actuator),
            "disturbances": dataclasses.asdict(self.disturbances),
            "joint": dataclasses.asdict(self.joint),
            "options": self.source.non_default_options(self.options),
        }

    @classmethod
    def from_mapping(cls, mapping: object, base: "EnvConfig | None" = None) -> "EnvConfig":
        """Create a configuration from a mapping of all fields or some of them.

        Args:
            mapping: the fields; options of a task may be listed among them.
            base: configuration with the values of missing fields; disturbances, joint and options
                are merged field by field. If it has another env source, the actuator and all fields
                whose default depends on the source are reset.

        Raises:
            ValueError: a key is unknown (the message suggests the nearest), or a value is out of
                bounds.
        """
        if not isinstance(mapping, Mapping):
            raise ValueError(f"env = {mapping!r}: must be a mapping of the environment's arguments")
        fields = dict(mapping) if base is None else {"task": base.task, **mapping}
        if "task" not in fields:
            raise ValueError("env.task: is missing: name a task, such as 'cartpole'")
        source = find_source(fields["task"])
        option_names = source.option_names
        check_names(
            fields,
            [*(field.name for field in dataclasses.fields(cls)), *option_names],
            "key",
            "env.",
        )
        if options := {name: fields.pop(name) for name in option_names if name in fields}:
            fields["options"] = {**(fields.get("options") or {}), **options}
        if base is None:
            return cls(**fields)
        if source.reference != base.task:
            defaults: Info = {
                field.name: None for field in dataclasses.fields(cls) if field.default is None
            }
            defaults |= {"task": fields["task"], "actuator": source.default_actuator}
            base = dataclasses.replace(base, **defaults)
        base_values = base.as_mapping()
        for name in ("disturbances", "joint", "options"):
            if isinstance(fields.get(name), Mapping):
                fields[name] = {**base_values[name], **fields[name]}
        return dataclasses.replace(base, **fields)


def _to_json_values(actuator: "StoredActuators") -> object:
    """Convert the field `actuator` to values that JSON can hold."""
    if isinstance(actuator, Mapping):
        return {pattern: mapping_of(each_actuator) for pattern, each_actuator in actuator.items()}
    return (
        [mapping_of(each_actuator) for each_actuator in actuator]
        if isinstance(actuator, tuple)
        else mapping_of(actuator)
    )


def _plain(value: object) -> object:
    """Return numpy's numbers and arrays as Python's numbers and lists."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def check_time_limit(env: EnvConfig) -> None:
    """Raise ValueError if an environment has no time limit, so that episodes might never end."""
    if env.time_limit is None:
        raise ValueError(
            f"max_episode_steps = None: {env.source.name} was registered without a time limit, and"
            " its episodes might never end: give one, in environment steps"
        )
