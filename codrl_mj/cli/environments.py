"""The flags of an environment and its actuators, made from the dataclasses that Python uses; and what they describe."""

import argparse
import dataclasses
import itertools
import typing
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import (
    FAMILIES,
    NAMED,
    DCMotorActuator,
    Ideal,
    Supply,
    override_actuator,
    find_family,
    identified_ranges,
)
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.worlds import find_world, is_world
from codrl_mj.fields import field_docs, parts
from codrl_mj.runs import CONFIG
from codrl_mj.user_code import read_yaml, trusting_files


def flags(
    kind: type, defaults: Any = None, leaving_out: tuple[str, ...] = (), adding: Sequence[Any] = ()
) -> Any:
    """A dataclass, and those in its fields, without validation, which the verb makes up for, to make flags from.

    Without an instance with the defaults all are optional: set over what is known only later.
    """
    docs, hints, nested = field_docs(kind), typing.get_type_hints(kind), parts(kind)
    fields: list[Any] = []
    for name in (field.name for field in dataclasses.fields(kind) if field.name not in leaving_out):
        hint, value = hints[name], getattr(defaults, name, None)
        setting: dict[str, Any] = {"help": docs.get(name, "")}
        if name == "gear_ratio" or (kind is Supply and name == "voltage"):
            setting["aliases"] = (
                f"--{name.replace('_', '-')}",
            )  # as the verbs about motors call it
        if name in nested:
            hint = flags(nested[name], value)
            value = hint()
        elif defaults is None:
            hint, text = hint | None, f"{setting['help']} Default: the named actuator's.".strip()
            setting |= {"help": text, "help_behavior_hint": ""}
        fields.append((name, Annotated[hint, tyro.conf.arg(**setting)], value))
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", [*fields, *adding], frozen=True)


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="What the force goes through. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + "; a family with its defaults:"
        f" {', '.join(name for name in FAMILIES if name not in NAMED)}; an off-the-shelf motor"
        " (codrl-mj motor list), or a TOML file with its datasheet; a YAML file with the fields"
        " of an actuator; or module:NAME of your own.",
    ),
]

Actuators = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="PATTERN=NAME",
        help=(
            "What single motors go through, over --actuator: names as there, for the motors whose"
            " names, or whose joints', the regular expression matches from beginning to end;"
            " patterns joined by & put one motor behind several actuators of a joint. Or a YAML"
            " file of patterns and actuators, such as codrl-mj motor choose writes."
        ),
    ),
]
FAMILY = "actuator.family"
"""Flag that `scan` is asked for besides `actuator`."""
_FAMILY_HELP = (
    "Another family for the same motor: `servo` makes a motor or datasheet one that is asked for"
    " positions."
)
AS_TRAINED, AS_CONFIGURED = "as-trained", "as-configured"
"""Instead of a name: the actuator that the policy was trained on; that of the configuration file or run."""


def environment_fields(defaults: EnvConfig, chosen: argparse.Namespace, task: str) -> list[Any]:
    """Flags for an environment: single fields over its actuators, all else that its world has, and its options.

    The family of what `--actuator` names, or `--actuator.family`, has the fields, of the ideal one
    a current loop, to be refused. What cannot be made is refused here: its flags would be unknown.
    `environment` reads what `dataclasses.make_dataclass` makes; `chosen` is what `scan` found of
    the two.
    """
    world, every = defaults.world, (field.name for field in dataclasses.fields(EnvConfig))
    without = tuple(
        one for one in every if one not in world.fields or one in ("task", "actuator", "options")
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
        for option, hint, text, value in world.option_flags(defaults)
    ]
    env, family = flags(EnvConfig, defaults, without, options), type(defaults.actuators[0])
    name, wanted = chosen.actuator, getattr(chosen, FAMILY)
    if name not in (None, AS_TRAINED, AS_CONFIGURED):
        try:
            family = type(EnvConfig(task, name).actuators[0])
        except ValueError as error:
            several = f"; a file of patterns and actuators goes by --actuators {name}"
            raise ValueError(
                f"{error}{several if str(name).endswith(('.yaml', '.yml')) else ''}"
            ) from None
    family = family if wanted is None else find_family(wanted)
    as_family = (
        "family",
        Annotated[
            str | None, tyro.conf.arg(metavar="FAMILY", help=_FAMILY_HELP, help_behavior_hint="")
        ],
        None,
    )
    over = flags(DCMotorActuator if issubclass(family, Ideal) else family, adding=[as_family])
    return [
        ("actuators", Actuators, ()),
        (
            "actuator_fields",
            Annotated[over, tyro.conf.arg(name="actuator", help="Single fields over it.")],
            over(),
        ),
        ("env", Annotated[env, tyro.conf.arg(help="The environment.")], env()),
    ]


def scan(arguments: Sequence[str], *names: str) -> argparse.Namespace:
    """The values of some flags, None where they are not there, `task`, `options`, `trust`: what decides on others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in (*names, "task"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--env.options", dest="options", nargs="*")
    parser.add_argument("--trust", action="store_true")
    try:
        chosen, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:  # a flag without its value: the real parser says so better
        chosen = argparse.Namespace(**dict.fromkeys((*names, "task", "options")), trust=False)
    behind = itertools.pairwise(["", *arguments])
    chosen.task = chosen.task or next(
        (word for flag, word in behind if is_world(word) and not flag.startswith("--")), None
    )
    return chosen


def with_environment(verb: Any, arguments: Sequence[str]) -> Any:
    """A verb about a run, with flags for environment and actuator: those of the first run that the line names."""
    from codrl_mj.training.folder import load_config

    chosen = scan(arguments, "actuator", FAMILY)
    known = EnvConfig("cartpole", DCMotorActuator())
    run = next((run for run in map(Path, arguments) if (run / CONFIG).is_file()), None)
    if run is not None:
        known = load_config(run, chosen.trust).evaluation_env
    elif chosen.task is not None:
        known = EnvConfig(chosen.task, DCMotorActuator())
    fields = environment_fields(known, chosen, known.task)
    made: Any = dataclasses.make_dataclass(verb.__name__, fields, bases=(verb,), frozen=True)
    made.__doc__, made.line = verb.__doc__, tuple(arguments)
    return made


def environment(verb: Any, task: str, name: str, known: EnvConfig) -> EnvConfig:
    """The environment that a verb's flags, those of `environment_fields`, describe; `known` has their defaults."""
    as_known = name in (AS_TRAINED, AS_CONFIGURED)
    if (
        not as_known
        and known.randomize
        and tuple(verb.env.randomize or ()) == tuple(known.randomize)
    ):
        drawn = [
            text.partition("=")[0] for text in known.randomize if not text.startswith("model.")
        ]
        if drawn:
            warnings.warn(
                f"{', '.join(drawn)} of {name} are drawn as in the training, whatever {name} has"
                f" there: for {name} as it is add --env.randomize None",
                stacklevel=2,
            )
    world, flags = find_world(task), dict(vars(verb.env))
    names = [field.name for field in dataclasses.fields(EnvConfig) if field.name != "options"]
    fields = {name: flags.pop(name) for name in names if name in flags}
    fields |= {part: vars(fields[part]) for part in ("disturbances", "joint") if part in fields}
    options = world.options_of(flags)
    patterns = _patterns(verb.actuators)
    fields["randomize"] = _ranges(fields["randomize"], name, patterns)
    named = known.driven if as_known else dict.fromkeys(known.driven, name)
    config = EnvConfig(task, named, options=options)
    if patterns:
        config = EnvConfig(task, world.overlaid(config, patterns), options=options)
    over = _given(verb.actuator_fields)
    changed = {pattern: override_actuator(one, over) for pattern, one in config.driven.items()}
    return EnvConfig(task, changed, options=options, **fields)


def _patterns(items: Sequence[str]) -> dict[str, Any]:
    """Pattern -> what is behind these actuators, of PATTERN=NAME and of files."""
    from codrl_mj.engine.specs import resolve_patterns

    found: dict[str, Any] = {}
    for item in items:
        if "=" not in item and Path(item).suffix in (".yaml", ".yml", ".json"):
            try:
                content = read_yaml(Path(item))
                if not isinstance(content, Mapping):
                    raise ValueError("must be a mapping of patterns to actuators")
                with trusting_files():
                    found |= resolve_patterns(content, f"the file {item}")
            except ValueError as error:
                raise ValueError(f"--actuators {item}: {error}") from None
        else:
            pattern, equals, name = item.rpartition(
                "="
            )  # the last: a regular expression may have its own
            if not equals or not pattern:
                raise ValueError(f"--actuators {item}: must be PATTERN=NAME, or a YAML file")
            found[pattern] = name
    return found


def _ranges(randomize: Any, actuator: str, patterns: Mapping[str, Any]) -> Any:
    """What `--env.randomize` says, `identified` replaced by the intervals that the actuators' files have."""
    if randomize is None or "identified" not in randomize:
        return randomize
    others = [one for one in randomize if one != "identified"]
    named = {one.partition("=")[0].strip() for one in others}
    for before, one in [(f"{pattern}:", str(one)) for pattern, one in patterns.items()] or [
        ("", actuator)
    ]:
        if Path(one).suffix not in (".yaml", ".yml", ".json"):
            raise ValueError(
                "--env.randomize identified: draws within the intervals of a file; --actuator is"
                f" {one!r}, must be one that `codrl-mj identify` wrote"
            )
        ranges = {f"{before}{name}": text for name, text in identified_ranges(one).items()}
        others += [f"{name}={text}" for name, text in ranges.items() if name not in named]
    return tuple(others)


def _given(fields: Any) -> dict[str, Any]:
    """What was set, nested."""
    return {
        name: _given(value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(fields).items()
        if value is not None
    }
