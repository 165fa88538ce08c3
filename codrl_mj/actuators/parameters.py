"""A family's fields as numbers: their dotted paths, their values, and the named tuple that its `advance` takes."""

import dataclasses
import functools
import itertools
from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from codrl_mj import fields


def family_of(actuator: Any) -> Any:
    """The family of an actuator, or of itself."""
    return actuator if isinstance(actuator, type) else type(actuator)


@functools.cache
def _fields(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """The fields of a dataclass by name: an environment with several motors asks some thousand times."""
    return {field.name: field for field in dataclasses.fields(cls)}


def value_at(owner: Any, path: str) -> Any:
    """What stands at a dotted path, a word as its number; in a part that is None, what stands for it."""
    for name in path.split("."):
        known, value = _fields(family_of(owner)), getattr(owner, name)
        metadata = known[name].metadata if name in known else {}
        if "options" in metadata:
            return metadata["options"].index(value)
        owner = metadata.get("absent") if value is None else value
    return owner


def as_kind(cls: type, name: str, value: Any) -> Any:
    """A number as the field's own type: whole numbers, flags and words come as floats from arrays."""
    field = _fields(cls)[name]
    default, options = field.default, field.metadata.get("options", ())
    if options and not isinstance(value, str) and value in range(len(options)):
        return options[int(value)]
    if isinstance(default, bool) and value in (0.0, 1.0):
        return bool(value)
    if isinstance(default, int) and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def from_values(cls: type, values: Mapping[str, Any], prefix: str = "") -> Any:
    """Build a dataclass from values by dotted path; a part whose values stand for None is None."""
    nested, made = fields.parts(cls), {}
    for field in _fields(cls).values():
        if field.name in nested:
            inner = from_values(nested[field.name], values, f"{prefix}{field.name}.")
            made[field.name] = None if inner == field.metadata.get("absent") else inner
        else:
            made[field.name] = as_kind(cls, field.name, values[f"{prefix}{field.name}"])
    return cls(**made)


def field_values(actuator: Any) -> tuple[float, ...]:
    """The values of all fields, in the order of `field_paths`: words as their numbers, flags as 0 and 1."""
    return tuple(float(value_at(actuator, path)) for path in field_paths(family_of(actuator)))


def from_array(cls: Any, values: Iterable[float]) -> Any:
    """An actuator of numbers as they are, for what follows from them: a tenth of the time of one that is checked."""
    left, made = iter(values), object.__new__(cls)
    for name, part in _outline(cls):
        vars(made)[name] = next(left) if part is None else from_array(part, left)
    return made


@functools.cache
def _outline(cls: Any) -> tuple[tuple[str, Any], ...]:
    """The fields of a dataclass, each with its class where it is a part, else with None."""
    nested = fields.parts(cls)
    return tuple((field.name, nested.get(field.name)) for field in _fields(cls).values())


def choices_of(cls: type, path: str) -> tuple[str, ...]:
    """The words that a field at a dotted path can be; empty if it is a number."""
    owner: Any = cls
    for name in path.split("."):
        field = next(field for field in dataclasses.fields(owner) if field.name == name)
        owner = fields.parts(owner).get(name)
    words: tuple[str, ...] = field.metadata.get("options", ())
    return words


def is_arm(path: str) -> bool:
    """Whether a path is that of the arm, which is no parameter."""
    return path.rpartition(".")[2] == "arm_radius"


@functools.cache
def field_paths(cls: type) -> tuple[str, ...]:
    """Dotted paths of all fields of a family, those of its parts too."""
    inner = (
        [f"{name}.{path}" for path in field_paths(part)] if part else [name]
        for name, part in _outline(cls)
    )
    return tuple(itertools.chain.from_iterable(inner))


@functools.cache
def parameter_paths(cls: type) -> Mapping[str, str]:
    """Name -> dotted path of the fields that are parameters of `advance`: all but the arm, which is the gear's.

    A parameter is called as its field is, and in a part that may be None by the part's name and the
    field's.

    Raises:
        ValueError: two of them have the same name.
    """
    optional = {field.name for field in dataclasses.fields(cls) if "absent" in field.metadata}
    paths = [path for path in field_paths(cls) if not is_arm(path)]
    named = {
        path.replace(".", "_") if path.split(".")[0] in optional else path.rpartition(".")[2]: path
        for path in paths
    }
    if len(named) < len(paths):
        twice = [path for path in paths if path not in named.values()]
        raise ValueError(
            f"{cls.__name__}: another parameter has the same name as {', '.join(twice)}: rename one"
        )
    return named


@functools.cache
def parameters_type(cls: type) -> Any:
    """The named tuple that a family's `advance` takes its parameters in."""
    make: Callable[..., Any] = namedtuple  # mypy wants the names of a named tuple as a literal
    made = make("Parameters", parameter_paths(cls))
    made.__reduce__ = lambda self: (_parameters, (cls, *self))  # to be pickled
    return made


def _parameters(cls: type, *numbers: float) -> Any:
    return parameters_type(cls)(*numbers)
