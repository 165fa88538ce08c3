"""Flags made from the dataclasses that Python uses: their names, docstrings and defaults."""

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.registration import ENVIRONMENTS
from codrl_mj.motor import NAMED, Actuator, CurrentLoop, Motor

TaskName = Literal[tuple(ENVIRONMENTS)]  # type: ignore[valid-type]


@functools.cache
def _field_docs(kind: type) -> Mapping[str, str]:
    """The docstring below each field of a dataclass, inherited ones included."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        docs |= {
            ast.unparse(field.target): " ".join(ast.literal_eval(doc.value).split())
            for field, doc in itertools.pairwise(body)
            if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr)
        }
    return docs


def optional(kind: type, otherwise: str) -> Any:
    """The dataclass with every field optional: what a user may set over values that are known only later.

    Args:
        kind: the dataclass.
        otherwise: what an unset field is, for the help.
    """
    docs = _field_docs(kind)
    fields = [
        (
            field.name,
            Annotated[
                field.type | None,  # type: ignore[operator]
                tyro.conf.arg(help=f"{docs[field.name]} Default: {otherwise}.", help_behavior_hint=""),
            ],
            dataclasses.field(default=None),
        )
        for field in dataclasses.fields(kind)
    ]
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", fields, frozen=True)


def unchecked(defaults: Any, leaving_out: tuple[str, ...] = ()) -> Any:
    """An instance's dataclass without its validation, which the verb makes up for: errors while parsing look like bugs.

    Args:
        defaults: the instance: its values are the defaults; fields that are dataclasses are treated likewise.
        leaving_out: names of fields that get no flag.
    """
    docs = _field_docs(type(defaults))  # type: ignore[arg-type]
    fields: list[Any] = []
    for field in dataclasses.fields(defaults):
        value = getattr(defaults, field.name)
        if field.name in leaving_out:
            continue
        if dataclasses.is_dataclass(value):
            nested = unchecked(value)
            fields.append((field.name, Annotated[nested, tyro.conf.arg(help=docs[field.name])], nested()))
        else:
            fields.append((field.name, Annotated[field.type, tyro.conf.arg(help=docs[field.name])], value))
    return dataclasses.make_dataclass(f"{type(defaults).__name__}Fields", fields, frozen=True)


EnvFields = unchecked(EnvConfig())


def environment(fields: Any) -> EnvConfig:
    """The environment's arguments that the flags describe.

    Raises:
        ValueError: a value is out of bounds.
    """
    return EnvConfig(**vars(fields) | {"disturbances": Disturbances(**vars(fields.disturbances))})


_MotorFields = optional(Motor, "the named actuator's")
_LoopFields = optional(CurrentLoop, "the named actuator's")


@dataclasses.dataclass(frozen=True)
class ActuatorFields:
    """Single fields over the named actuator's."""

    motor: _MotorFields = _MotorFields()  # type: ignore[valid-type]
    """The motor and its arm."""
    controller: _LoopFields = _LoopFields()  # type: ignore[valid-type]
    """The current loop."""


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="What the force goes through. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + ".",
    ),
]
Fields = Annotated[ActuatorFields, tyro.conf.arg(name="actuator")]

AS_TRAINED, AS_CONFIGURED = "as-trained", "as-configured"
"""Instead of a name: the actuator that the policy was trained on; that of the configuration file or run."""


def actuator(name: str, fields: ActuatorFields, task: str, known: Actuator | None = None) -> Actuator | None:
    """The actuator that the flags describe.

    Args:
        name: a named actuator, or `AS_TRAINED` or `AS_CONFIGURED`.
        fields: single fields over it.
        task: the task whose paper actuator the names vary.
        known: what `AS_TRAINED` or `AS_CONFIGURED` stands for.

    Raises:
        ValueError: unknown name, value out of bounds, or fields set over the ideal actuator, which has none.
    """
    from codrl_mj.motor import actuator_over, named_actuator

    base = known if name in (AS_TRAINED, AS_CONFIGURED) else named_actuator(name, task)
    changes = {
        part: {field: value for field, value in vars(getattr(fields, part)).items() if value is not None}
        for part in ("motor", "controller")
    }
    return actuator_over(base, changes)
