"""Flags of an environment and its actuators, generated from the dataclasses of the Python API."""

import argparse
import dataclasses
import itertools
import json
import typing
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self, TypeVar

import tyro

from codrl_mj.actuators import (
    FAMILIES,
    NAMED,
    ActuatorSetting,
    DCMotorActuator,
    Ideal,
    Supply,
    find_family,
    identified_ranges,
    override_actuator,
)
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.boundary import Argument
from codrl_mj.cli.parsing import Annotation
from codrl_mj.envs.config import EnvConfig, EnvSource, find_source, is_source_name
from codrl_mj.fields import field_docs, nested_types
from codrl_mj.runs import CONFIG
from codrl_mj.tasks import TASKS
from codrl_mj.user_code import allow_imports_from_files, read_yaml

# The dataclasses of the flags are built at run time, from fields that depend on the line.
Flags = Any
"""Instance of a dataclass that `flag_dataclass` built."""
FlagField = tuple[str, Annotation] | tuple[str, Annotation, FieldValue]
"""Name, type and default of a field, as for `dataclasses.make_dataclass`."""


class EnvironmentFlags:
    """Verb with the fields of `environment_fields`."""

    env: Flags
    """Settings of the environment."""
    actuators: tuple[str, ...]
    """Actuators of individual motors, as PATTERN=NAME or as files."""
    actuator_fields: Flags
    """Fields that override those of the named actuator; None for the others."""


class EnvironmentVerb(EnvironmentFlags):
    """Verb with flags for an environment, which `with_environment_flags` adds."""

    line: ClassVar[tuple[str, ...]]
    """Words of the command line after the verb."""

    @classmethod
    def for_line(cls, arguments: Sequence[str]) -> "type[Self]":
        """Return the class with its flags for a command line."""
        return with_environment_flags(cls, arguments)


EnvironmentVerbKind = TypeVar("EnvironmentVerbKind", bound=EnvironmentVerb)


def flag_dataclass(
    kind: type,
    defaults: object = None,
    exclude: tuple[str, ...] = (),
    extra_fields: Sequence[FlagField] = (),
) -> type[Flags]:
    """Return a copy of a dataclass and of its nested ones, without validation, for tyro's flags.

    The verb validates the values when it builds the real dataclass. Without `defaults` all fields
    are optional: they override values that are known only later.

    Args:
        kind: the dataclass.
        defaults: an instance with the default values.
        exclude: names of fields without a flag.
        extra_fields: further fields, as for `dataclasses.make_dataclass`.
    """
    docs, hints, nested = field_docs(kind), typing.get_type_hints(kind), nested_types(kind)
    fields: list[FlagField] = []
    for name in (field.name for field in dataclasses.fields(kind) if field.name not in exclude):
        annotation, value = hints[name], getattr(defaults, name, None)
        setting: dict[str, Argument] = {"help": docs.get(name, "")}
        # The verbs about motors call these flags --gear-ratio and --voltage: accept the short names
        # too.
        if name == "gear_ratio" or (kind is Supply and name == "voltage"):
            setting["aliases"] = (f"--{name.replace('_', '-')}",)
        if name in nested:
            annotation = flag_dataclass(nested[name], value)
            value = annotation()
        elif defaults is None:
            annotation = annotation | None
            text = f"{setting['help']} Default: the named actuator's.".strip()
            setting |= {"help": text, "help_behavior_hint": ""}
        fields.append((name, Annotated[annotation, tyro.conf.arg(**setting)], value))
    return dataclasses.make_dataclass(
        f"{kind.__name__}Fields", [*fields, *extra_fields], frozen=True
    )


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="Actuator between the policy's force and the joint. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + "; a family with its defaults:"
        f" {', '.join(name for name in FAMILIES if name not in NAMED)}; an off-the-shelf motor"
        " (codrl-mj motor list), or a TOML file with its datasheet; a YAML file with the fields"
        " of an actuator; or your own actuator as module:NAME.",
    ),
]

Actuators = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="PATTERN=NAME",
        help=(
            "Actuators of individual motors, which override --actuator and take the same names."
            " PATTERN is a regular expression that must match the whole name of the motor or its"
            " joint. Join patterns by & to give several actuators of one joint a common motor."
            " Instead of pairs, you can name a YAML file of patterns and actuators, such as"
            " codrl-mj motor choose writes."
        ),
    ),
]
FAMILY = "actuator.family"
"""Name of the flag for the family of an actuator, for `scan_flags`."""
_FAMILY_HELP = (
    "Another family for the same motor: `servo` turns a motor or a datasheet into a servo, which"
    " takes a position as its command; `pwm_servo` into one without a current loop, as bus servos"
    " and hobby servos are."
)
AS_TRAINED, AS_CONFIGURED = "as-trained", "as-configured"
"""Defaults of --actuator that do not name an actuator: the actuator of the policy's training, and
the actuator of the configuration file or run.
"""


def environment_fields(
    defaults: EnvConfig, chosen: argparse.Namespace, task: str
) -> list[FlagField]:
    """Return dataclass fields for the flags of an environment: actuators, settings, options.

    The flags of single actuator fields are those of the family that `--actuator` or
    `--actuator.family` names. The ideal family gets those of a current loop, so that each of them
    is refused with a clear message. If the actuator cannot be built, its flags are unknown, so this
    function raises the error.

    Args:
        defaults: configuration with the default values.
        chosen: the flags `--actuator` and `--actuator.family`, as `scan_flags` returns them.
        task: the environment's name.
    """
    source, all_names = defaults.source, (field.name for field in dataclasses.fields(EnvConfig))
    excluded = tuple(
        name
        for name in all_names
        if name not in source.fields or name in ("task", "actuator", "options")
    )
    options = [
        (
            option,
            Annotated[
                hint,
                tyro.conf.arg(help=text, metavar="NAME=VALUE" if option == "options" else None),
            ],
            value,
        )
        for option, hint, text, value in _option_flags(defaults)
    ]
    env_flags = flag_dataclass(EnvConfig, defaults, excluded, options)
    family = type(defaults.actuators[0])
    actuator, family_name = chosen.actuator, getattr(chosen, FAMILY)
    if actuator not in (None, AS_TRAINED, AS_CONFIGURED):
        try:
            family = type(EnvConfig(task, actuator).actuators[0])
        except ValueError as error:
            remedy = f"; for a file of patterns and actuators use --actuators {actuator}"
            raise ValueError(
                f"{error}{remedy if str(actuator).endswith(('.yaml', '.yml')) else ''}"
            ) from None
    family = family if family_name is None else find_family(family_name)
    family_field = (
        "family",
        Annotated[
            str | None, tyro.conf.arg(metavar="FAMILY", help=_FAMILY_HELP, help_behavior_hint="")
        ],
        None,
    )
    # The ideal actuator has no fields. It gets the flags of a current loop, so that
    # `override_actuator` can explain why each of them is refused.
    actuator_flags = flag_dataclass(
        DCMotorActuator if issubclass(family, Ideal) else family, extra_fields=[family_field]
    )
    return [
        ("actuators", Actuators, ()),
        (
            "actuator_fields",
            Annotated[
                actuator_flags,
                tyro.conf.arg(
                    name="actuator",
                    help="Individual fields, which override those of the named actuator.",
                ),
            ],
            actuator_flags(),
        ),
        ("env", Annotated[env_flags, tyro.conf.arg(help="The environment.")], env_flags()),
    ]


def scan_flags(arguments: Sequence[str], *flag_names: str) -> argparse.Namespace:
    """Return the values of some flags, without parsing the others; None for those that are absent.

    The result also has `task`, `options` and `trust`. The other flags and their defaults depend on
    these values.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in (*flag_names, "task"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--env.options", dest="options", nargs="*")
    parser.add_argument("--trust", action="store_true")
    try:
        chosen, _ = parser.parse_known_args(arguments)
    # A flag has no value. The real parser reports it later, with a better message.
    except argparse.ArgumentError:
        chosen = argparse.Namespace(**dict.fromkeys((*flag_names, "task", "options")), trust=False)
    word_pairs = itertools.pairwise(["", *arguments])
    chosen.task = chosen.task or next(
        (word for flag, word in word_pairs if is_source_name(word) and not flag.startswith("--")),
        None,
    )
    return chosen


def with_environment_flags(
    verb: type[EnvironmentVerbKind], arguments: Sequence[str]
) -> type[EnvironmentVerbKind]:
    """Return a verb with additional flags for environment and actuator.

    The defaults of the flags come from the first run folder that the command line names.
    """
    from codrl_mj.training.folder import load_config

    chosen = scan_flags(arguments, "actuator", FAMILY)
    defaults = EnvConfig("cartpole", DCMotorActuator())
    run = next((run for run in map(Path, arguments) if (run / CONFIG).is_file()), None)
    if run is not None:
        defaults = load_config(run, chosen.trust).evaluation_env
    elif chosen.task is not None:
        defaults = EnvConfig(chosen.task, DCMotorActuator())
    fields = environment_fields(defaults, chosen, defaults.task)
    extended_verb: type[EnvironmentVerbKind] = dataclasses.make_dataclass(
        verb.__name__, fields, bases=(verb,), frozen=True
    )
    extended_verb.__doc__, extended_verb.line = verb.__doc__, tuple(arguments)
    return extended_verb


def build_env_config(
    verb: EnvironmentFlags, task: str, name: str, defaults: EnvConfig
) -> EnvConfig:
    """Return the environment that a verb's flags describe.

    Args:
        verb: the parsed verb, with the flags of `environment_fields`.
        task: the environment's name.
        name: value of --actuator.
        defaults: configuration with the default values.
    """
    is_default = name in (AS_TRAINED, AS_CONFIGURED)
    if (
        not is_default
        and defaults.randomize
        and tuple(verb.env.randomize or ()) == tuple(defaults.randomize)
    ):
        drawn_fields = [
            text.partition("=")[0] for text in defaults.randomize if not text.startswith("model.")
        ]
        if drawn_fields:
            warnings.warn(
                f"{', '.join(drawn_fields)} of {name} are drawn from the training's distributions:"
                f" add --env.randomize None to use the values of {name}",
                stacklevel=2,
            )
    source, env_flags = find_source(task), dict(vars(verb.env))
    names = [field.name for field in dataclasses.fields(EnvConfig) if field.name != "options"]
    fields = {name: env_flags.pop(name) for name in names if name in env_flags}
    fields |= {
        nested_part: vars(fields[nested_part])
        for nested_part in ("disturbances", "joint")
        if nested_part in fields
    }
    options = parse_options(source, env_flags)
    patterns = _patterns(verb.actuators)
    fields["randomize"] = _ranges(fields["randomize"], name, patterns)
    actuators = (
        defaults.actuators_by_name
        if is_default
        else dict.fromkeys(defaults.actuators_by_name, name)
    )
    config = EnvConfig(task, actuators, options=options)
    if patterns:
        config = EnvConfig(task, source.override_actuators(config, patterns), options=options)
    actuator_fields = _set_fields(verb.actuator_fields)
    overridden = {
        pattern: override_actuator(actuator, actuator_fields)
        for pattern, actuator in config.actuators_by_name.items()
    }
    return EnvConfig(task, overridden, options=options, **fields)


def _patterns(items: Sequence[str]) -> dict[str, ActuatorSetting]:
    """Return pattern -> actuator from items PATTERN=NAME and from YAML files."""
    from codrl_mj.engine.matching import resolve_patterns

    actuators: dict[str, ActuatorSetting] = {}
    for item in items:
        if "=" not in item and Path(item).suffix in (".yaml", ".yml", ".json"):
            try:
                content = read_yaml(Path(item))
                if not isinstance(content, Mapping):
                    raise ValueError("must be a mapping of patterns to actuators")
                with allow_imports_from_files():
                    actuators |= resolve_patterns(content, f"the file {item}")
            except ValueError as error:
                raise ValueError(f"--actuators {item}: {error}") from None
        else:
            # Split at the last equals sign: a regular expression may contain others.
            pattern, equals, name = item.rpartition("=")
            if not equals or not pattern:
                raise ValueError(f"--actuators {item}: must be PATTERN=NAME, or a YAML file")
            actuators[pattern] = name
    return actuators


def _ranges(
    randomize: tuple[str, ...] | None, actuator: str, patterns: Mapping[str, ActuatorSetting]
) -> tuple[str, ...] | None:
    """Return `--env.randomize` with `identified` replaced by the intervals of actuator files."""
    if randomize is None or "identified" not in randomize:
        return randomize
    specs = [spec for spec in randomize if spec != "identified"]
    spec_names = {spec.partition("=")[0].strip() for spec in specs}
    for prefix, spec in [(f"{pattern}:", str(spec)) for pattern, spec in patterns.items()] or [
        ("", actuator)
    ]:
        if Path(spec).suffix not in (".yaml", ".yml", ".json"):
            raise ValueError(
                f"--env.randomize identified: needs the intervals of an actuator file: {spec!r}"
                " must be a file that `codrl-mj identify` wrote"
            )
        ranges = {f"{prefix}{name}": text for name, text in identified_ranges(spec).items()}
        specs += [f"{name}={text}" for name, text in ranges.items() if name not in spec_names]
    return tuple(specs)


def _set_fields(fields: Flags) -> dict[str, FieldValue]:
    """Return the fields of a nested dataclass that are not None, as nested mappings."""
    return {
        name: _set_fields(value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(fields).items()
        if value is not None
    }


class OptionFlag(NamedTuple):
    """Flag of an environment's option."""

    name: str
    annotation: Annotation
    """Type of its value, as for tyro."""
    help: str
    default: FieldValue


def _option_flags(config: EnvConfig) -> list[OptionFlag]:
    """Return the flags of all tasks' options, or the single flag of a third-party environment's.

    A task has the flags of all tasks, so that messages can name another task's flag.
    """
    options = config.source.non_default_options(config.options)
    if config.source.task is None:
        values = tuple(f"{name}={json.dumps(value)}" for name, value in options.items())
        description = (
            "Keyword arguments of the environment, such as frame_skip=2: their values as JSON, or"
            " else as text."
        )
        return [OptionFlag("options", tuple[str, ...], description, values)]
    option_types: dict[str, type] = {name: task.options for name, task in TASKS.items()}
    return [
        OptionFlag(
            option,
            hint | None,
            f"{name}: {field_docs(option_type)[option]}",
            options.get(option),
        )
        for name, option_type in option_types.items()
        for option, hint in typing.get_type_hints(option_type).items()
    ]


def parse_options(source: EnvSource, flags: Mapping[str, FieldValue]) -> dict[str, FieldValue]:
    """Return the options from the values of their flags.

    Raises:
        ValueError: an item is not NAME=VALUE.
    """
    if source.task is not None:
        return {name: value for name, value in flags.items() if value is not None}
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
