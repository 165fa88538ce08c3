"""Complete configuration of an environment; it builds environments and is stored in run folders.

The command line derives its flags from the fields. Importing this module is fast: it compiles
nothing and does not load MuJoCo.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.actuators import ActuatorModel, combined_name, mapping_of
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint, resolve
from codrl_mj.envs.distributions import Distribution, parse_randomize
from codrl_mj.envs.sources import EnvSource, find_source, options_mapping
from codrl_mj.fields import check_joint_dynamics, check_names


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """Settings of an environment, except rendering. None selects the environment's default.

    Raises:
        ValueError: unknown task, actuator or option, a value out of bounds, or a field that this
            kind of environment does not have. Conditions on several fields are checked when the
            environment is built.
    """

    task: str
    """Task name, such as `cartpole`; the Gymnasium id of a third-party environment, such as
    `HalfCheetah-v5` (`package:ID` imports the package first); or `module:NAME` of a custom task or
    env source.
    """
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
    options: Any = None
    """Options of the task, a mapping (CartPole: `center_radius`, `sutton_barto_reward`), stored as
    the task's `NamedTuple`; for a third-party environment the keyword arguments of its constructor,
    such as frame_skip.
    """

    def __post_init__(self) -> None:
        """Validate, and convert values from files and numpy to the types of the fields."""
        values = {
            field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)
        }
        source = find_source(values["task"])
        values |= {"task": source.reference, "joint": resolve(values["joint"], UNMODIFIED_JOINT)}
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
    def from_arguments(cls, task: str, actuator: Any, arguments: Mapping[str, Any]) -> "EnvConfig":
        """Create a configuration from keyword arguments of an environment class.

        Args:
            task: name of the task or env source.
            actuator: value of the field of this name.
            arguments: other fields, and options, by name or in the mapping `options`. The time
                limit must not be among them: the caller applies it.

        Raises:
            UnknownOptionError: a name is neither a field nor an option.
            ValueError: as for the class.
        """
        # A third-party environment may have an argument with the name of a field that only tasks
        # have; it belongs to the options.
        names = {*find_source(task).fields} - {"options", "max_episode_steps"}
        fields = {name: value for name, value in arguments.items() if name in names}
        options = {
            name: value for name, value in arguments.items() if name not in (*names, "options")
        }
        return cls(
            task,
            actuator,
            options={**options_mapping(arguments.get("options")), **options},
            **fields,
        )

    def override(self, arguments: Mapping[str, Any]) -> tuple["EnvConfig", dict[str, Any]]:
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
        return dataclasses.replace(self, **fields), remaining

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
    def action_space(self) -> "gymnasium.spaces.Space[Any]":
        """Action space without motors; other commands change its bounds or size, not its type."""
        return self.source.action_space(self)

    @property
    def code(self) -> set[str | Path]:
        """Names of modules, and paths of files, with the code of the environment and actuators."""
        return {type(actuator).__module__ for actuator in self.actuators} | self.source.code(
            self.options
        )

    @property
    def policy_fields(self) -> dict[str, Any]:
        """Fields that define a policy's actions and observations; they cannot change later."""
        return {name: getattr(self, name) for name in ("action", "levels", "observe_actuator")}

    def as_arguments(self) -> dict[str, Any]:
        """Return keyword arguments for `gymnasium.make`, without those that are None or off."""
        names = [name for name in self.source.fields if name not in ("task", "options")]
        arguments = {name: getattr(self, name) for name in names} | {
            "randomize": self.distributions or None
        }
        set_arguments = {
            name: value
            for name, value in arguments.items()
            if value is not None and value not in (NO_DISTURBANCES, UNMODIFIED_JOINT)
        }
        return set_arguments | self.source.non_default_options(self.options)

    def make(self, **view: Any) -> "gymnasium.Env[Any, Any]":
        """Build the environment.

        Args:
            **view: `render_mode` and other rendering settings; for a task `width`, `height`,
                `camera` and `pretty`, as for `codrl_mj.envs.ActuatedEnv`. Fields and options given
                here replace those of the configuration.

        Raises:
            ValueError: fields contradict each other, or do not fit the model.
        """
        config, view = self.override(view)
        env = config.source.make(config, **view)
        if not isinstance(env, gymnasium.Env):
            raise ValueError(f"{config.task}: its `make` returned {env!r}: must be a gymnasium.Env")
        return env

    def make_vec(self, num_envs: int = 1, **arguments: Any) -> Any:
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

    def as_mapping(self) -> dict[str, Any]:
        """Return the configuration as JSON-serializable values; `from_mapping` reads it."""
        # Names of runs are hashes of this mapping. A field that was added later is left out at its
        # default, so that the names of existing runs stay valid.
        omitted = {"joint_dynamics"} if self.joint_dynamics is None else {*()}
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
    def from_mapping(cls, mapping: Any, base: "EnvConfig | None" = None) -> "EnvConfig":
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
            defaults: dict[str, Any] = {
                field.name: None for field in dataclasses.fields(cls) if field.default is None
            }
            defaults |= {"task": fields["task"], "actuator": source.default_actuator}
            base = dataclasses.replace(base, **defaults)
        base_values = base.as_mapping()
        for name in ("disturbances", "joint", "options"):
            if isinstance(fields.get(name), Mapping):
                fields[name] = {**base_values[name], **fields[name]}
        return dataclasses.replace(base, **fields)


def _to_json_values(actuator: Any) -> Any:
    """Convert the field `actuator` to values that JSON can hold."""
    if isinstance(actuator, Mapping):
        return {pattern: mapping_of(each_actuator) for pattern, each_actuator in actuator.items()}
    return (
        [mapping_of(each_actuator) for each_actuator in actuator]
        if isinstance(actuator, tuple)
        else mapping_of(actuator)
    )


def _plain(value: Any) -> Any:
    """Return numpy's numbers and arrays as Python's numbers and lists."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
