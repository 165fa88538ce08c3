"""An environment's arguments, complete: what every face is built from, run folders store and flags are made of.

Light to import: nothing is compiled, and no engine loaded.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.actuators import ActuatorModel, mapping_of, combined_name
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint, resolve
from codrl_mj.envs.distributions import Distribution, paths_of
from codrl_mj.envs.worlds import EnvSource, find_world, options_mapping
from codrl_mj.fields import check_joint_dynamics, check_names


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """An environment but for its rendering, of whatever world; None leaves the world's default.

    Raises:
        ValueError: unknown task, actuator or option, a value out of bounds, or a field that the
            world does not have. What depends on several fields at once is checked when the
            environment is built.
    """

    task: str
    """Task name, such as `cartpole`; the Gymnasium id of an environment of others, such as
    `HalfCheetah-v5`, for which `package:ID` imports the package first; or `module:NAME` of a task
    or a world of one's own.
    """
    actuator: Any = "default"
    """What the force goes through: a name (`default`, the task's own: the paper's where there is
    one; `ideal`, `paper`, `weak`, `weaker`, `open_loop`, or a family's or a motor's), an
    `ActuatorModel`, a mapping of its fields (with a `name`, over that actuator's), a file of them,
    `module:NAME`, or None (ideal). With several motors all get it; or it is a mapping of patterns
    of their names to such, or of a task a list with one for each. Kept as an `ActuatorModel`, as a
    tuple of a task's several, or as a mapping of the patterns in an environment of others.
    """
    physics: str = "mujoco"
    """`mujoco`; `analytic`: Gymnasium's own equations, Furuta's closed form; or one's own, as registered."""
    integrator: str | None = None
    """One of the task's integrators (CartPole: `euler` or `semi-implicit`); the default is Gymnasium's."""
    inner_steps: int | None = None
    """Integration steps per environment step; the default is the paper's inner loop with a motor
    and Gymnasium's one without. Furuta: 10.
    """
    timestep: float | None = None
    """Instead of inner_steps, the integration step [s], which must divide the environment step."""
    action: str = "force"
    """What the agent commands: the desired `force` (the paper; in an environment of others its own
    actions), the reference `current`, or the terminal `voltage` past the controller; or what else
    the actuator's family takes.
    """
    levels: tuple[float, ...] | None = None
    """Discrete tasks that command a current [A] or a voltage [V]: the levels that the actions choose from."""
    observe_actuator: bool = False
    """Whether the agent also observes measured and reference current [A], or what else the motors' sensors say."""
    max_episode_steps: int | None = None
    """Time limit [environment steps], >= 1; the default is the environment's own."""
    allow_unstable: bool = False
    """Build the environment even if the current loop is unstable."""
    disturbances: Disturbances = NO_DISTURBANCES
    """Imperfections of the commands' way, and load pulses; each is off at 0."""
    joint: Joint = UNMODIFIED_JOINT
    """What is added to the actuated joints."""
    joint_dynamics: str | None = None
    """In an environment of others, damping, armature and frictionloss that its model has where
    motors bring the same: `keep` adds both, `replace` takes the model's out, for they are the
    motors' own; None keeps them and warns.
    """
    randomize: tuple[str, ...] | None = None
    """What to draw at every reset, as FIELD=DISTRIBUTION, such as 'motor.inductance=uniform(0.05,
    0.2)'; distributions are uniform(LOW, HIGH), loguniform(LOW, HIGH) and choice(VALUE, ...).
    Fields are the actuator's, in an environment of others with the pattern and a colon before it
    (leg.*:motor.inductance) those of some; and of the model model.mass.BODY, model.length.BODY,
    model.gravity and model.damping.JOINT. In Python and in files a mapping of fields to
    distributions will do as well. What was drawn is in the reset's info, `randomization`.
    """
    options: Any = None
    """The task's own options, a mapping (CartPole: `center_radius`, `sutton_barto_reward`), kept as
    the task's `NamedTuple`; of an environment of others the keyword arguments that make it, such as
    frame_skip.
    """

    def __post_init__(self) -> None:
        """Validate, and turn what files and users write into what it stands for, and numpy's values into Python's."""
        kept = {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)}
        world = find_world(kept["task"])
        kept |= {"task": world.reference, "joint": resolve(kept["joint"], UNMODIFIED_JOINT)}
        kept["disturbances"] = resolve(kept["disturbances"], NO_DISTURBANCES)
        for field in dataclasses.fields(self):
            if field.name not in world.fields and kept[field.name] != field.default:
                raise ValueError(
                    f"{field.name} = {kept[field.name]!r}: {world.name} has none: leave it out"
                )
        kept["actuator"] = world.actuators(kept["actuator"])
        if isinstance(kept["levels"], list | tuple):
            kept["levels"] = tuple(map(_plain, kept["levels"]))
        if kept["randomize"] is not None:
            kept["randomize"] = tuple(
                f"{path}={one}" for path, one in paths_of(kept["randomize"]).items()
            )
        kept["options"] = world.options(kept["options"])
        for name in ("observe_actuator", "allow_unstable"):
            if not isinstance(kept[name], bool):
                raise ValueError(f"{name} = {kept[name]!r}: must be true or false")
        check_joint_dynamics(kept["joint_dynamics"])
        limit = kept["max_episode_steps"]
        if limit is not None and (
            isinstance(limit, bool) or not isinstance(limit, int) or limit < 1
        ):
            raise ValueError(f"max_episode_steps = {limit!r}: must be an integer >= 1")
        vars(self).update(kept)

    @classmethod
    def of(cls, task: str, actuator: Any, arguments: Mapping[str, Any]) -> "EnvConfig":
        """The configuration that the keyword arguments of a face describe.

        Args:
            task: the world's name.
            actuator: as for the field.
            arguments: other fields, and the world's own options, one by one or as `options`; a time
                limit is the face's own matter.

        Raises:
            UnknownOptionError: neither has a name that is given.
            ValueError: as for the class.
        """
        # An environment of others may have an argument of its own with the name of a field that
        # only tasks have.
        names = {*find_world(task).fields} - {"options", "max_episode_steps"}
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

    def over(self, arguments: Mapping[str, Any]) -> tuple["EnvConfig", dict[str, Any]]:
        """Set fields and options, given by keyword, over this configuration's; return it and the other arguments."""
        world, rest = self.world, dict(arguments)
        fields = {name: rest.pop(name) for name in world.fields if name in rest}
        if options := {name: rest.pop(name) for name in world.option_names if name in rest}:
            given = (
                options_mapping(fields["options"])
                if "options" in fields
                else world.changed(self.options)
            )
            fields["options"] = {**given, **options}
        return dataclasses.replace(self, **fields), rest

    @property
    def world(self) -> EnvSource:
        """What the environment is of."""
        return find_world(self.task)

    @property
    def driven(self) -> dict[str, ActuatorModel]:
        """Motor, or pattern of motors, -> actuator."""
        return self.world.driven(self.actuator)

    @property
    def actuators(self) -> tuple[ActuatorModel, ...]:
        """The actuator of each motor, or pattern of motors."""
        return tuple(self.driven.values())

    @property
    def through(self) -> str:
        """What to call the actuators."""
        return combined_name(self.actuators, self.world.paper)

    @property
    def distributions(self) -> dict[str, Distribution]:
        """What is drawn at every reset, in this order."""
        return paths_of(self.randomize)

    @property
    def time_limit(self) -> int | None:
        """The longest episode [environment steps]; None for any."""
        return self.max_episode_steps or self.world.time_limit

    @property
    def action_space(self) -> "gymnasium.spaces.Space[Any]":
        """The world's own actions; commands have others of the same kind."""
        return self.world.action_space(self)

    @property
    def code(self) -> set[str | Path]:
        """Modules, by name, and files that decide on what it does: the world's and those of the actuators' families."""
        return {type(one).__module__ for one in self.actuators} | self.world.code(self.options)

    @property
    def policy_fields(self) -> dict[str, Any]:
        """The fields that say what a policy commands and observes: it can do nothing else once it is trained."""
        return {name: getattr(self, name) for name in ("action", "levels", "observe_actuator")}

    def as_arguments(self) -> dict[str, Any]:
        """The keyword arguments for `gymnasium.make` with a task's id, without those that are None or off."""
        names = [name for name in self.world.fields if name not in ("task", "options")]
        arguments = {name: getattr(self, name) for name in names} | {
            "randomize": self.distributions or None
        }
        given = {
            name: value
            for name, value in arguments.items()
            if value is not None and value not in (NO_DISTURBANCES, UNMODIFIED_JOINT)
        }
        return given | self.world.changed(self.options)

    def make(self, **view: Any) -> "gymnasium.Env[Any, Any]":
        """The environment.

        Args:
            **view: `render_mode`, and what else it takes for its rendering; of a task `width`,
                `height`, `camera` and `pretty`, as for `codrl_mj.envs.ActuatedEnv`. Or fields and
                options to set otherwise.

        Raises:
            ValueError: fields do not go with each other, or with the model.
        """
        config, view = self.over(view)
        made = config.world.make(config, **view)
        if not isinstance(made, gymnasium.Env):
            raise ValueError(
                f"{config.task}: its `make` returned {made!r}: must be a gymnasium.Env"
            )
        return made

    def make_vec(self, num_envs: int = 1, **arguments: Any) -> Any:
        """Build N environments as one of Gymnasium's vectors; arguments and errors as for `codrl_mj.make_vec`."""
        # A list is no value of the field: it has an actuator for each environment.
        each = {
            name: arguments.pop(name)
            for name in ("actuator",)
            if isinstance(arguments.get(name), list | tuple)
        }
        config, rest = self.over(arguments)
        return config.world.vector(config, num_envs, **each, **rest)

    def as_mapping(self) -> dict[str, Any]:
        """The configuration as JSON-serialisable values; `from_mapping` reads it."""
        # names of runs are hashes of this, and of those that do not have the field have to stay
        recent = {"joint_dynamics"} if self.joint_dynamics is None else {*()}
        return {
            **{
                one.name: getattr(self, one.name)
                for one in dataclasses.fields(self)
                if one.name not in recent
            },
            "actuator": _described(self.actuator),
            "disturbances": dataclasses.asdict(self.disturbances),
            "joint": dataclasses.asdict(self.joint),
            "options": self.world.changed(self.options),
        }

    @classmethod
    def from_mapping(cls, mapping: Any, base: "EnvConfig | None" = None) -> "EnvConfig":
        """The configuration that a mapping describes: `as_mapping`'s, or any part of it.

        Args:
            mapping: the fields; a task's own options may stand among them.
            base: what is not given is this one's; disturbances, joint and options by their fields.
                Of a base of another world, the actuator and whatever else has a default of the
                world's are the world's.

        Raises:
            ValueError: a key is unknown (the nearest known one is suggested), or a value out of
                bounds.
        """
        if not isinstance(mapping, Mapping):
            raise ValueError(f"env = {mapping!r}: must be a mapping of the environment's arguments")
        given = dict(mapping) if base is None else {"task": base.task, **mapping}
        if "task" not in given:
            raise ValueError("it has no task")
        world = find_world(given["task"])
        own = world.option_names
        check_names(
            given, [*(field.name for field in dataclasses.fields(cls)), *own], "key", "env."
        )
        if options := {name: given.pop(name) for name in own if name in given}:
            given["options"] = {**(given.get("options") or {}), **options}
        if base is None:
            return cls(**given)
        if world.reference != base.task:
            defaults: dict[str, Any] = {
                field.name: None for field in dataclasses.fields(cls) if field.default is None
            }
            defaults |= {"task": given["task"], "actuator": world.default_actuator}
            base = dataclasses.replace(base, **defaults)
        there = base.as_mapping()
        for name in ("disturbances", "joint", "options"):
            if isinstance(given.get(name), Mapping):
                given[name] = {**there[name], **given[name]}
        return dataclasses.replace(base, **given)


def _described(actuator: Any) -> Any:
    """Actuators, as a configuration keeps them, as JSON has them."""
    if isinstance(actuator, Mapping):
        return {pattern: mapping_of(one) for pattern, one in actuator.items()}
    return (
        [mapping_of(one) for one in actuator]
        if isinstance(actuator, tuple)
        else mapping_of(actuator)
    )


def _plain(value: Any) -> Any:
    """A number or an array of numpy's as Python's own number or list."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
