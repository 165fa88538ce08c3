"""Flags made from the dataclasses that Python uses: their names, docstrings and defaults."""

import argparse
import ast
import contextlib
import dataclasses
import functools
import inspect
import itertools
import re
import textwrap
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import FAMILIES, NAMED, Actuator, Family, Ideal, actuator_over
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import parts
from codrl_mj.runs.layout import CONFIG
from codrl_mj.tasks import TASKS, find_task, named_actuator, resolve_actuators


def is_task(word: str) -> bool:
    """Whether a word is a task's name, or `module:NAME`, as one of somebody's own is named."""
    return word in TASKS or re.fullmatch(r"[\w.]+:[\w.]+", word) is not None


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


def optional(kind: type, otherwise: str) -> Any:
    """The dataclass with every field optional, also in its parts: what a user may set over what is known only later.

    Args:
        kind: the dataclass.
        otherwise: what an unset field is, for the help.
    """
    docs, hints, nested = field_docs(kind), typing.get_type_hints(kind), parts(kind)
    fields: list[Any] = []
    for field in dataclasses.fields(kind):
        text = docs.get(field.name, "")
        if field.name in nested:
            inner = optional(nested[field.name], otherwise)
            fields.append((field.name, Annotated[inner, tyro.conf.arg(help=text)], inner()))
        else:
            setting = tyro.conf.arg(help=f"{text} Default: {otherwise}.".strip(), help_behavior_hint="")
            fields.append((field.name, Annotated[hints[field.name] | None, setting], None))
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", fields, frozen=True)


def unchecked(defaults: Any, leaving_out: tuple[str, ...] = (), adding: Sequence[Any] = ()) -> Any:
    """An instance's dataclass without its validation, which the verb makes up for: errors while parsing look like bugs.

    Args:
        defaults: the instance: its values are the defaults; fields that are dataclasses are treated likewise.
        leaving_out: names of fields that get no flag.
        adding: fields to come last, as `dataclasses.make_dataclass` takes them.
    """
    docs, hints = field_docs(type(defaults)), typing.get_type_hints(type(defaults))  # type: ignore[arg-type]
    fields: list[Any] = []
    for field in dataclasses.fields(defaults):
        value = getattr(defaults, field.name)
        if field.name in leaving_out:
            continue
        if dataclasses.is_dataclass(value):
            nested = unchecked(value)
            fields.append((field.name, Annotated[nested, tyro.conf.arg(help=docs.get(field.name, ""))], nested()))
        else:
            fields.append(
                (field.name, Annotated[hints[field.name], tyro.conf.arg(help=docs.get(field.name, ""))], value)
            )
    return dataclasses.make_dataclass(f"{type(defaults).__name__}Fields", [*fields, *adding], frozen=True)


def env_fields(defaults: EnvConfig) -> Any:
    """Flags for an environment but its task and actuator, and for the options of all tasks."""
    options = defaults.as_mapping()["options"]
    return unchecked(
        defaults,
        ("task", "actuator", "options"),
        [
            (name, Annotated[float | None, tyro.conf.arg(help=text)], options.get(name))
            for name, text in _task_options().items()
        ],
    )


def _task_options() -> dict[str, str]:
    """Name -> description of every option that a task has."""
    kinds: dict[str, Any] = {name: task.options for name, task in TASKS.items()}
    return {option: f"{task}: {field_docs(kind)[option]}" for task, kind in kinds.items() for option in kind._fields}


def environment(fields: Any, task: str, actuator: Any) -> EnvConfig:
    """The environment that the flags describe.

    Raises:
        ValueError: a value is out of bounds.
    """
    given: dict[str, Any] = dict(vars(fields))
    nested: dict[str, Any] = {name: vars(given.pop(name)) for name in ("disturbances", "joint")}
    options = {name: value for name in _task_options() if (value := given.pop(name, None)) is not None}
    return EnvConfig(task, actuator, options=options, **given, **nested)


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="What the force goes through. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + f"; a family with its defaults: {', '.join(name for name in FAMILIES if name not in NAMED)}; a YAML file "
        "with the fields of an actuator; or module:NAME of your own.",
    ),
]

AS_TRAINED, AS_CONFIGURED = "as-trained", "as-configured"
"""Instead of a name: the actuator that the policy was trained on; that of the configuration file or run."""


def actuator_fields(chosen: Family) -> Any:
    """Flags for single fields over an actuator of a family; over the ideal one those of a current loop, to be refused.

    Returns:
        The field for `dataclasses.make_dataclass`.
    """
    fields = optional(Actuator if issubclass(chosen, Ideal) else chosen, "the named actuator's")
    return "actuator_fields", Annotated[fields, tyro.conf.arg(name="actuator", help="Single fields over it.")], fields()


def family(name: str | None, task: str, known: Family = Actuator) -> Family:
    """The family of the actuator that a command line names.

    Args:
        name: what `--actuator` says; None if it is not there.
        task: the task whose actuators the names vary.
        known: what it is where the name does not say it, or is none: the verb refuses that later.
    """
    if name not in (None, AS_TRAINED, AS_CONFIGURED):
        with contextlib.suppress(ValueError, OSError):
            return type(resolve_actuators(name, find_task(task))[0])
    return known


def scan(arguments: Sequence[str], *names: str) -> argparse.Namespace:
    """What decides on other flags and their defaults; the rest is left to the real parser.

    Args:
        arguments: the command line.
        names: of flags with a value, whose values are wanted; None where they are not there.

    Returns:
        The values, `task`, None if none is named, and `trust`.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(f"--{name}")
    parser.add_argument("--trust", action="store_true")
    try:
        chosen, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:  # a flag without its value: the real parser says so better
        chosen = argparse.Namespace(**dict.fromkeys(names), trust=False)
    behind = itertools.pairwise(["", *arguments])
    chosen.task = next((word for flag, word in behind if is_task(word) and not flag.startswith("--")), None)
    return chosen


def with_environment(verb: Any, arguments: Sequence[str]) -> Any:
    """A verb about a run, with flags for environment and actuator.

    Args:
        verb: its dataclass.
        arguments: what follows the verb.
    """
    from codrl_mj.training.folder import load_config

    chosen, known = scan(arguments, "actuator"), FAMILIES[Actuator.family]
    with contextlib.suppress(ValueError):  # the verb says so better
        find_task(chosen.task or "cartpole")  # its options are flags
    for run in map(Path, arguments):
        if (run / CONFIG).is_file():
            with contextlib.suppress(ValueError, OSError):  # the verb says so better
                known = type(load_config(run, chosen.trust).env.actuators[0])
    env = env_fields(EnvConfig(next(iter(TASKS))))
    fields = [
        actuator_fields(family(chosen.actuator, chosen.task or "cartpole", known)),
        ("env", Annotated[env, tyro.conf.arg(help="The environment.")], env()),
    ]
    made = dataclasses.make_dataclass(verb.__name__, fields, bases=(verb,), frozen=True)
    made.__doc__ = verb.__doc__
    return made


def actuator(name: str, fields: Any, task: str, known: Any = None) -> Any:
    """The actuator that the flags describe.

    Args:
        name: a named actuator, or `AS_TRAINED` or `AS_CONFIGURED`.
        fields: single fields over it.
        task: the task whose actuators the names vary.
        known: what `AS_TRAINED` or `AS_CONFIGURED` stands for.

    Raises:
        ValueError: unknown name, value out of bounds, or fields set over the ideal actuator, which has none.
    """
    base = known if name in (AS_TRAINED, AS_CONFIGURED) else named_actuator(name, task)
    if isinstance(base, tuple):
        return tuple(actuator_over(one, _given(fields)) for one in base)
    return actuator_over(base, _given(fields))


def _given(fields: Any) -> dict[str, Any]:
    """What was set, nested."""
    return {
        name: _given(value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(fields).items()
        if value is not None
    }
