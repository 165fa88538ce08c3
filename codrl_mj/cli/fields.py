"""Flags made from the dataclasses that Python uses: their names, docstrings and defaults."""

import argparse
import ast
import contextlib
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

from codrl_mj.actuators import FAMILIES, NAMED, Actuator, Ideal
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import parts
from codrl_mj.foreign.config import EVERY, ForeignConfig, is_gymnasium_id
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
    """A dataclass without its validation, which the verb makes up for: errors while parsing look like bugs.

    Args:
        kind: the dataclass; its fields that are dataclasses are treated likewise.
        defaults: its instance with the default values; None makes all optional: set over what is known only later.
        leaving_out: names of fields that get no flag.
        adding: fields to come last, as `dataclasses.make_dataclass` takes them.
    """
    docs, hints, nested = field_docs(kind), typing.get_type_hints(kind), parts(kind)
    fields: list[Any] = []
    for name in (field.name for field in dataclasses.fields(kind) if field.name not in leaving_out):
        hint, value = hints[name], getattr(defaults, name, None)
        setting: dict[str, Any] = {"help": docs.get(name, "")}
        if name in nested:
            hint = flags(nested[name], value)
            value = hint()
        elif defaults is None:
            hint, text = hint | None, f"{setting['help']} Default: the named actuator's.".strip()
            setting = {"help": text, "help_behavior_hint": ""}
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

    Args:
        defaults: the environment whose values are the defaults.
        name: what `--actuator` says; None if it is not there. Its family has the fields, of the ideal one a current
            loop, to be refused.
        task: the task whose actuators the names vary.

    Returns:
        Fields for `dataclasses.make_dataclass`; `environment` reads them.
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
        with contextlib.suppress(ValueError, OSError):  # the verb says so better
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
    if is_gymnasium_id(task):
        return ForeignConfig(task, {EVERY: name}).actuator
    return resolve_actuators(name, find_task(task))


def scan(arguments: Sequence[str], *names: str) -> argparse.Namespace:
    """What decides on other flags and their defaults; the rest is left to the real parser.

    Args:
        arguments: the command line.
        names: of flags with a value, whose values are wanted; None where they are not there.

    Returns:
        The values, `task`, None if none is named, and `trust`.
    """
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
    """A verb about a run, with flags for environment and actuator.

    Args:
        verb: its dataclass.
        arguments: what follows the verb.
    """
    from codrl_mj.training.folder import load_config

    chosen = scan(arguments, "actuator")
    task = chosen.task or "cartpole"
    known: Any = EnvConfig("cartpole", Actuator())
    with contextlib.suppress(ValueError):  # the verb says so better
        if is_gymnasium_id(task):
            known = ForeignConfig(task)
        else:
            find_task(task)  # its options are flags
    for run in map(Path, arguments):
        if (run / CONFIG).is_file():
            with contextlib.suppress(ValueError, OSError):  # the verb says so better
                known = load_config(run, chosen.trust).evaluation_env
    fields = environment_fields(known, chosen.actuator, known.task if isinstance(known, ForeignConfig) else task)
    made: Any = dataclasses.make_dataclass(verb.__name__, fields, bases=(verb,), frozen=True)
    made.__doc__, made.line = verb.__doc__, tuple(arguments)
    return made
