"""Flags made from the dataclasses that Python uses: their names, docstrings and defaults."""

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import json
import re
import textwrap
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import FAMILIES, NAMED, Actuator, Ideal, Supply
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import parts
from codrl_mj.foreign.config import EVERY, ForeignConfig, environment_from, is_gymnasium_id
from codrl_mj.runs.layout import CONFIG
from codrl_mj.tasks import TASKS, find_task, resolve_actuators


def is_task(word: str) -> bool:
    """Whether a word is a task's name, `module:NAME`, as one of somebody's own is named, or an id of Gymnasium's.

    A folder's name may look like an id, `runs/swing-v2`; then it is the folder's.
    """
    if word in TASKS or re.fullmatch(r"[\w.]+:[\w.]+", word) is not None:
        return True
    return is_gymnasium_id(word) and not Path(word).is_dir()


@functools.cache
def field_docs(kind: type) -> Mapping[str, str]:
    """The docstring below each field of a class, inherited ones included; none of a class without a source file."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        except (OSError, TypeError):
            continue
        docs |= {
            ast.unparse(field.target): " ".join(ast.literal_eval(doc.value).split())
            for field, doc in itertools.pairwise(body)
            if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr)
        }
    return docs


def flags(kind: type, defaults: Any = None, leaving_out: tuple[str, ...] = (), adding: Sequence[Any] = ()) -> Any:
    """A dataclass, and those in its fields, without validation, which the verb makes up for, to make flags from.

    Without an instance with the defaults all are optional: set over what is known only later.
    """
    docs, hints, nested = field_docs(kind), typing.get_type_hints(kind), parts(kind)
    fields: list[Any] = []
    for name in (field.name for field in dataclasses.fields(kind) if field.name not in leaving_out):
        hint, value = hints[name], getattr(defaults, name, None)
        setting: dict[str, Any] = {"help": docs.get(name, "")}
        if name == "gear_ratio" or (kind is Supply and name == "voltage"):
            setting["aliases"] = (f"--{name.replace('_', '-')}",)  # as the verbs about motors call it
        if name in nested:
            hint = flags(nested[name], value)
            value = hint()
        elif defaults is None:
            hint, text = hint | None, f"{setting['help']} Default: the named actuator's.".strip()
            setting |= {"help": text, "help_behavior_hint": ""}
        fields.append((name, Annotated[hint, tyro.conf.arg(**setting)], value))
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", [*fields, *adding], frozen=True)


def task_options() -> dict[str, tuple[Any, str]]:
    """Name -> type and description of every option that a task has."""
    kinds: dict[str, Any] = {name: task.options for name, task in TASKS.items()}
    return {
        option: (hint, f"{task}: {field_docs(kind)[option]}")
        for task, kind in kinds.items()
        for option, hint in typing.get_type_hints(kind).items()
    }


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="What the force goes through. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + f"; a family with its defaults: {', '.join(name for name in FAMILIES if name not in NAMED)}; "
        "a motor that one can buy (codrl-mj motor list), or a TOML file with its datasheet; "
        "a YAML file with the fields of an actuator; or module:NAME of your own.",
    ),
]

Actuators = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="PATTERN=NAME",
        help="What single motors go through, over --actuator: names as there, for the motors whose names, or whose "
        "joints', the regular expression matches from beginning to end. Or a YAML file of patterns and actuators, such "
        "as codrl-mj motor choose writes.",
    ),
]
AS_TRAINED, AS_CONFIGURED = "as-trained", "as-configured"
"""Instead of a name: the actuator that the policy was trained on; that of the configuration file or run."""


def environment_fields(defaults: EnvConfig | ForeignConfig, name: str | None, task: str) -> list[Any]:
    """Flags for an environment: single fields over its actuators, all else but its task, and the options of all tasks.

    The family of what `--actuator` names has the fields, of the ideal one a current loop, to be refused. What cannot be
    made is refused here: its flags would be unknown. `environment` reads what `dataclasses.make_dataclass` makes.
    """
    if isinstance(defaults, ForeignConfig):
        env, family = _foreign_flags(defaults), type(defaults.actuator[0])
    else:
        options = defaults.as_mapping()["options"]
        of_tasks = [
            (option, Annotated[hint | None, tyro.conf.arg(help=text)], options.get(option))
            for option, (hint, text) in task_options().items()
        ]
        env = flags(EnvConfig, defaults, ("task", "actuator", "options"), of_tasks)
        family = type(defaults.actuators[0])
    if name not in (None, AS_TRAINED, AS_CONFIGURED):
        family = type(named_actuators(str(name), task)[0])
    over = flags(Actuator if issubclass(family, Ideal) else family)
    return [
        ("actuators", Actuators, ()),
        ("actuator_fields", Annotated[over, tyro.conf.arg(name="actuator", help="Single fields over it.")], over()),
        ("env", Annotated[env, tyro.conf.arg(help="The environment.")], env()),
    ]


def _foreign_flags(defaults: ForeignConfig) -> Any:
    """Flags for an environment of somebody else's."""
    docs = field_docs(ForeignConfig)
    draws = defaults.randomize or {}
    written = tuple(
        f"{name}={one}" if isinstance(one, str) else f"{name}:{field}={text}"
        for name, one in draws.items()
        for field, text in ({"": one} if isinstance(one, str) else one).items()
    )
    options = tuple(f"{name}={json.dumps(value)}" for name, value in defaults.options.items())
    about = "Keyword arguments of the environment, such as frame_skip=2: their values as JSON, or else as text."
    adding = [
        ("randomize", Annotated[tuple[str, ...] | None, tyro.conf.arg(help=docs["randomize"])], written or None),
        ("options", Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE", help=about)], options),
    ]
    return flags(ForeignConfig, defaults, ("task", "actuators", "randomize", "options"), adding)


def named_actuators(name: str, task: str) -> tuple[Any, ...]:
    """The actuators that a name stands for in a task, or in an environment of somebody else's."""
    try:
        if is_gymnasium_id(task):
            return ForeignConfig(task, {EVERY: name}).actuator
        return resolve_actuators(name, find_task(task))
    except ValueError as error:
        hint = (
            f"; a file of patterns and actuators goes by --actuators {name}" if name.endswith((".yaml", ".yml")) else ""
        )
        raise ValueError(f"{error}{hint}") from None


def refuse_task(word: str) -> None:
    """Refuse a word that is no task's name, as it stands."""
    try:
        find_task(word)
    except ValueError as error:
        others = "an environment of Gymnasium's goes by its id, such as HalfCheetah-v5"
        raise ValueError(f"{error}; {others}") from None


def scan(arguments: Sequence[str], *names: str) -> argparse.Namespace:
    """The values of some flags, None where they are not there, `task` and `trust`: what decides on other flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in (*names, "task"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--trust", action="store_true")
    try:
        chosen, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:  # a flag without its value: the real parser says so better
        chosen = argparse.Namespace(**dict.fromkeys((*names, "task")), trust=False)
    behind = itertools.pairwise(["", *arguments])
    chosen.task = chosen.task or next(
        (word for flag, word in behind if is_task(word) and not flag.startswith("--")), None
    )
    return chosen


def with_environment(verb: Any, arguments: Sequence[str]) -> Any:
    """A verb about a run, with flags for environment and actuator: those of the first run that the line names."""
    from codrl_mj.training.folder import load_config

    chosen = scan(arguments, "actuator")
    known: Any = EnvConfig("cartpole", Actuator())
    run = next((run for run in map(Path, arguments) if (run / CONFIG).is_file()), None)
    if run is not None:
        known = load_config(run, chosen.trust).evaluation_env
    elif chosen.task is not None:
        known = environment_from({"task": chosen.task, "actuator": Actuator()})
    fields = environment_fields(known, chosen.actuator, known.task)
    made: Any = dataclasses.make_dataclass(verb.__name__, fields, bases=(verb,), frozen=True)
    made.__doc__, made.line = verb.__doc__, tuple(arguments)
    return made
