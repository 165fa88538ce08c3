"""Fields of an actuator family as numbers: dotted paths, values and parameters of `advance`."""

import dataclasses
import functools
import itertools
from collections import namedtuple
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol, Self, TypeVar, cast

from codrl_mj import fields

Owner = TypeVar("Owner")
"""Class of an object with fields: a family, or a nested part."""
# A field holds a number, a flag, a word, a nested part or None. The path that is looked up at run
# time determines which, so a type checker cannot know it.
FieldValue = Any
"""Value of a field."""


class Parameters(Protocol):
    """Parameters of an actuator: a named tuple of floats, whose class `parameters_type` creates."""

    _fields: ClassVar[tuple[str, ...]]

    def __init__(self, *numbers: float) -> None:
        """Create the named tuple from the numbers in the order of `parameter_paths`."""

    def __getattr__(self, name: str) -> float: ...
    def __iter__(self) -> Iterator[float]: ...
    def _replace(self, **changes: float) -> Self: ...


def family_of(actuator: object) -> type:
    """Return the family of an actuator; a family is returned as it is."""
    return actuator if isinstance(actuator, type) else type(actuator)


@functools.cache
def _fields(cls: type) -> dict[str, dataclasses.Field[FieldValue]]:
    """Return the fields of a dataclass by name.

    The result is cached: an environment with several motors needs it thousands of times.
    """
    return {field.name: field for field in dataclasses.fields(cls)}


def value_at(owner: object, path: str) -> FieldValue:
    """Return the value at a dotted path: a word's index, or the default of a part that is None."""
    for name in path.split("."):
        known, value = _fields(family_of(owner)), getattr(owner, name)
        metadata = known[name].metadata if name in known else {}
        if "options" in metadata:
            return metadata["options"].index(value)
        owner = metadata.get("absent") if value is None else value
    return owner


def to_field_type(cls: type, name: str, value: FieldValue) -> FieldValue:
    """Convert a number to the type of a field; arrays hold integers, flags and words as floats."""
    field = _fields(cls)[name]
    default, options = field.default, field.metadata.get("options", ())
    if options and not isinstance(value, str) and value in range(len(options)):
        return options[int(value)]
    if isinstance(default, bool) and value in (0.0, 1.0):
        return bool(value)
    if isinstance(default, int) and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def from_values(cls: type[Owner], values: Mapping[str, FieldValue], prefix: str = "") -> Owner:
    """Build a dataclass from values by dotted path; nested ones equal to their default are None."""
    kind: type = cls
    nested = fields.nested_types(kind)
    values_by_field: dict[str, FieldValue] = {}
    for field in _fields(kind).values():
        if field.name in nested:
            inner: object = from_values(nested[field.name], values, f"{prefix}{field.name}.")
            values_by_field[field.name] = None if inner == field.metadata.get("absent") else inner
        else:
            values_by_field[field.name] = to_field_type(
                kind, field.name, values[f"{prefix}{field.name}"]
            )
    return cls(**values_by_field)


def field_values(actuator: object) -> tuple[float, ...]:
    """Return the values of all fields in the order of `field_paths`: words and flags as numbers."""
    return tuple(float(value_at(actuator, path)) for path in field_paths(family_of(actuator)))


def from_array(cls: type[Owner], values: Iterable[float]) -> Owner:
    """Build an actuator from a vector of field values without validation, ten times faster."""
    # `object.__new__` skips `__post_init__`, and writing to `vars` is how a frozen dataclass can be
    # filled without its `__setattr__`.
    kind: type = cls
    remaining, actuator = iter(values), object.__new__(cls)
    for name, part in _outline(kind):
        vars(actuator)[name] = next(remaining) if part is None else from_array(part, remaining)
    return actuator


@functools.cache
def _outline(cls: type) -> tuple[tuple[str, type | None], ...]:
    """Return the fields of a dataclass, each with the class of a nested part or with None."""
    part_types = fields.nested_types(cls)
    return tuple((field.name, part_types.get(field.name)) for field in _fields(cls).values())


def choices_of(cls: type, path: str) -> tuple[str, ...]:
    """Return the words that a field at a dotted path accepts; empty if the field is a number."""
    *parts, last = path.split(".")
    for part in parts:
        cls = fields.nested_types(cls)[part]
    words: tuple[str, ...] = _fields(cls)[last].metadata.get("options", ())
    return words


def is_arm(path: str) -> bool:
    """Return True if a path is that of the arm, which is not a parameter of `advance`."""
    return path.rpartition(".")[2] == "arm_radius"


@functools.cache
def field_paths(cls: type) -> tuple[str, ...]:
    """Return the dotted paths of all fields of a family, including nested ones."""
    inner: Iterable[list[str]] = (
        [f"{name}.{path}" for path in field_paths(part)] if part else [name]
        for name, part in _outline(cls)
    )
    return tuple(itertools.chain.from_iterable(inner))


@functools.cache
def parameter_paths(cls: type) -> Mapping[str, str]:
    """Return names and dotted paths of the parameters of `advance`: all fields except the arm.

    The arm is left out because it is the actuator's gear in the model. A parameter has the name of
    its field; in a part that may be None, the name is the part's, an underscore and the field's.

    Raises:
        ValueError: two parameters have the same name.
    """
    optional = {field.name for field in dataclasses.fields(cls) if "absent" in field.metadata}
    paths = [path for path in field_paths(cls) if not is_arm(path)]
    paths_by_name = {
        path.replace(".", "_") if path.split(".")[0] in optional else path.rpartition(".")[2]: path
        for path in paths
    }
    if len(paths_by_name) < len(paths):
        twice = [path for path in paths if path not in paths_by_name.values()]
        raise ValueError(
            f"{cls.__name__}: another parameter has the same name as {', '.join(twice)}: rename one"
        )
    return paths_by_name


@functools.cache
def parameters_type(cls: type) -> type[Parameters]:
    """Return the type of the named tuple of parameters that a family's `advance` takes."""
    tuple_type = namedtuple("Parameters", parameter_paths(cls))  # type: ignore[misc]
    # The type is created at run time, so pickle cannot find it by name.
    tuple_type.__reduce__ = lambda self: (_parameters, (cls, *self))  # type: ignore
    return cast(type[Parameters], tuple_type)


def _parameters(cls: type, *numbers: float) -> Parameters:
    return parameters_type(cls)(*numbers)
