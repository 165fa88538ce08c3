"""Dataclass fields with bounds and units, and checks of names, memory and other settings."""

import ast
import dataclasses
import difflib
import functools
import inspect
import itertools
import math
import numbers
import re
import shlex
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

Kind = TypeVar("Kind")
"""Dataclass that a mapping describes."""
# A dataclass annotates a field with the type of its values and assigns the field to it, so type
# checkers must accept a field as a value of any type.
DeclaredField = Any
"""Field of a dataclass."""


def real(
    default: float | None,
    above: float | None = None,
    minimum: float | None = None,
    below: float | None = None,
    maximum: float | None = None,
    optional: bool = False,
    unit: str = "",
    infinite: bool = False,
) -> DeclaredField:
    """Return a field for a finite number within bounds, stored as a float.

    Args:
        default: default value.
        above: exclusive lower bound.
        minimum: inclusive lower bound.
        below: exclusive upper bound.
        maximum: inclusive upper bound.
        optional: allow None; a default of None does so, too.
        unit: unit, for tables and documentation.
        infinite: allow infinity.
    """
    limits = [("> ", above), (">= ", minimum), ("< ", below), ("<= ", maximum)]
    kind = "a number" if infinite else "a finite number"
    text = " ".join(
        [kind, " and ".join(f"{sign}{limit:g}" for sign, limit in limits if limit is not None)]
    ).strip()

    def is_valid(value: object) -> bool:
        return (
            _is_real(value, infinite)
            and (above is None or value > above)
            and (minimum is None or value >= minimum)
            and (below is None or value < below)
            and (maximum is None or value <= maximum)
        )

    low, high = (
        next((limit for limit in pair if limit is not None), None)
        for pair in ((above, minimum), (below, maximum))
    )
    return _bounded(default, is_valid, text, optional, unit, float, (low, high))


def integer(
    default: int | None,
    minimum: int,
    optional: bool = False,
    unit: str = "",
    maximum: float = math.inf,
) -> DeclaredField:
    """Return a field for an integer >= `minimum`.

    None is allowed with `optional` or a default of None.
    """
    return _bounded(
        default,
        lambda value: _is_integer(value) and minimum <= value <= maximum,
        f"an integer >= {minimum}"
        if maximum == math.inf
        else f"an integer from {minimum} to {maximum}",
        optional,
        unit,
        int,
        (minimum, None),
    )


def flag(default: bool) -> DeclaredField:
    """Return a field for True or False."""
    return _bounded(default, lambda value: isinstance(value, bool), "true or false")


def choice(default: str, *options: str) -> DeclaredField:
    """Return a field for one of several options; parameter vectors store the option's index."""
    field = _bounded(default, lambda value: value in options, f"one of {', '.join(options)}")
    return dataclasses.field(default=default, metadata={**field.metadata, "options": options})


def positive_integers(default: tuple[int, ...]) -> DeclaredField:
    """Return a field for a tuple of positive integers, such as the sizes of hidden layers."""

    def is_valid(value: object) -> bool:
        return isinstance(value, tuple) and all(
            _is_integer(count) and count >= 1 for count in value
        )

    return _bounded(default, is_valid, "a tuple of integers >= 1")


def positive_reals(default: tuple[float, ...] | None = None) -> DeclaredField:
    """Return an optional field for a tuple of finite numbers > 0."""

    def is_valid(value: object) -> bool:
        return isinstance(value, tuple) and all(_is_real(number) and number > 0 for number in value)

    return _bounded(default, is_valid, "a tuple of finite numbers > 0")


def reals(default: tuple[float, ...] | None = None) -> DeclaredField:
    """Return an optional field for a tuple of finite numbers."""

    def is_valid(value: object) -> bool:
        return isinstance(value, tuple) and all(_is_real(number) for number in value)

    return _bounded(default, is_valid, "a tuple of finite numbers")


@dataclasses.dataclass(frozen=True)
class Checked:
    """Base class that validates the fields that are declared with the functions above.

    Raises:
        ValueError: a field is out of bounds; the message has its name, its value and the bound.
    """

    def __post_init__(self) -> None:
        """Raise if a field is out of bounds; convert numbers to Python's own types."""
        for field in dataclasses.fields(self):
            if "bound" not in field.metadata:
                continue
            is_valid, text, optional, kind = field.metadata["bound"]
            value = getattr(self, field.name)
            if value is None and optional:
                continue
            if not is_valid(value):
                or_none = " or none" if optional else ""
                raise ValueError(
                    f"{type(self).__name__}.{field.name} = {value!r}: must be {text}{or_none}"
                )
            # Frozen dataclasses reject plain assignment. NumPy's numbers are converted so that
            # settings can be serialized.
            if kind is not None:
                object.__setattr__(self, field.name, kind(value))


def free_memory() -> int | None:
    """Return the free memory [bytes]; None if it is unknown, as on systems other than Linux."""
    meminfo = Path("/proc/meminfo")
    free = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text() if meminfo.exists() else "")
    return 1024 * int(free[1]) if free else None


def check_memory(size: float, purpose: str, remedy: str) -> None:
    """Raise if more memory is required than is free.

    Args:
        size: required memory [bytes].
        purpose: setting that requires it, with its value, such as `buffer_size = 1,000`.
        remedy: instruction at the end of the message, such as `lower it`.
    """
    if (available := free_memory()) is not None and size > available:
        raise ValueError(
            f"{purpose}: needs about {size / 1e9:,.3g} GB of memory, but only"
            f" {available / 1e9:.3g} GB are free; {remedy}"
        )


def check_names(
    names: Iterable[object],
    known: Iterable[str],
    label: str,
    prefix: str = "",
    list_all: bool = False,
    listed_by: str = "",
    nested: Iterable[str] = (),
) -> None:
    """Raise if a name is unknown; the message suggests the nearest known names.

    Args:
        names: names to check.
        known: known names.
        label: kind of name, such as `actuator field`.
        prefix: text before each name in the message.
        list_all: list all known names even if there are similar ones, for names that other programs
            spell differently.
        listed_by: command that lists the known names, if they are too many for the message.
        nested: dotted names of nested fields, suggested if a name lacks the part before the dot.
    """
    known, nested = list(known), list(nested)
    for name in names:
        if name not in known:
            near = [
                nested_name for nested_name in nested if nested_name.rpartition(".")[2] == name
            ][:3] or _nearest(name, known)
            near = near or _nearest(name, nested)
            hints = (
                [f"did you mean {' or '.join(f'{prefix}{nearest_name}' for nearest_name in near)}?"]
                if near
                else []
            )
            if list_all or not near:
                hints.append(
                    f"`{listed_by}` lists the known ones"
                    if listed_by
                    else f"known: {', '.join(known)}"
                )
            raise ValueError(f"unknown {label} {prefix}{name}; {' '.join(hints)}")


def flatten(mapping: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Return the values in nested mappings by dotted names."""
    values: dict[str, object] = {}
    for key, value in mapping.items():
        values |= (
            flatten(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return values


def differences(
    first: Mapping[str, object], second: Mapping[str, object]
) -> dict[str, tuple[object, object]]:
    """Return the values in which two mappings differ, by dotted names.

    Each is a pair; `absent` stands for a missing value.
    """
    first_values, second_values = flatten(first), flatten(second)
    pairs = {
        name: (first_values.get(name, "absent"), second_values.get(name, "absent"))
        for name in [*first_values, *second_values]
    }
    # Values are compared as text, because NaN does not equal itself, and 1 equals True.
    return {name: pair for name, pair in pairs.items() if repr(pair[0]) != repr(pair[1])}


def check_pattern(pattern: str) -> None:
    """Raise if a text is not a regular expression for names."""
    try:
        re.compile(pattern)
    except (re.error, TypeError) as error:
        raise ValueError(
            f"{pattern!r}: must be a regular expression ({error}); '.*' matches any name, 'leg.*'"
            " names that begin with leg"
        ) from None


def check_joint_dynamics(value: object) -> None:
    """Raise if a value is not valid for `joint_dynamics` of `codrl_mj.add_motors`."""
    if value not in (None, "keep", "replace"):
        raise ValueError(
            f"joint_dynamics = {value!r}: must be keep, replace, or None (keep, with a warning)"
        )


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return a question that suggests the nearest known names, or an empty text."""
    near = _nearest(name, known)
    return f"did you mean {' or '.join(map(repr, near))}? " if near else ""


def _nearest(name: object, known: Iterable[str]) -> list[str]:
    """Return up to three known names that begin with a name or contain all its words.

    If there are none, or more than three, the closest known name is returned. If the part before
    the last dot is known, only the last part is compared, because a common prefix does not make two
    names more similar.
    """
    text, originals = str(name).lower(), {known_name.lower(): known_name for known_name in known}
    completions = [
        originals[lowered] for lowered in originals if len(text) > 2 and lowered.startswith(text)
    ]
    if 0 < len(completions) < 4:
        return completions
    parent, dot, last = text.rpartition(".")
    ends = {
        lowered[len(parent + dot) :]: lowered
        for lowered in originals
        if dot and lowered.startswith(parent + dot)
    }
    if not ends:
        ends, last = {lowered: lowered for lowered in originals}, text
    words = _words(last)
    with_same_words = [
        originals[lowered]
        for end, lowered in ends.items()
        if words and words <= _words(end.rpartition(".")[2])
    ]
    if 0 < len(with_same_words) < 4:
        return with_same_words
    candidates = [end for end in ends if last == text or "." not in end]
    return [originals[ends[match]] for match in difflib.get_close_matches(last, candidates, n=1)]


def _words(name: str) -> set[str]:
    """Return the words of a name or a flag that have three or more characters."""
    return set(re.findall(r"[a-z0-9]{3,}", name.replace("_", " ")))


@functools.cache
def field_docs(kind: type) -> Mapping[str, str]:
    """Return the docstring below each field of a class and of its bases.

    A class without a source file has none.
    """
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


def build(cls: type[Kind], mapping: object, label: str, prefix: str = "") -> Kind:
    """Build a dataclass, with nested ones, from nested mappings; missing fields take defaults."""
    kind: type = cls
    if not isinstance(mapping, Mapping):
        raise ValueError(
            f"{label} {prefix.rstrip('.')!r} = {mapping!r}: must be a mapping of {cls.__name__}'s"
            " fields"
        )
    nested = nested_types(kind)
    absent = {
        field.name: field.metadata["absent"]
        for field in dataclasses.fields(kind)
        if "absent" in field.metadata
    }
    inner = [
        f"{name}.{field.name}"
        for name, part in nested.items()
        for field in dataclasses.fields(part)
    ]
    check_names(
        mapping, (field.name for field in dataclasses.fields(kind)), label, prefix, nested=inner
    )

    def convert(key: str, value: object) -> object:
        """Return a nested mapping as its dataclass; other values are returned unchanged."""
        if key not in nested or value is None or isinstance(value, nested[key]):
            return value
        if isinstance(value, Mapping) and key in absent:
            # The mapping changes only some values of the part, so the others come from its default.
            value = {**dataclasses.asdict(absent[key]), **value}
        part: object = build(nested[key], value, label, f"{prefix}{key}.")
        return part

    return cls(**{key: convert(key, value) for key, value in mapping.items()})


def optional_nested(absent: object) -> DeclaredField:
    """Return a field for an optional nested dataclass; None, the default, stands for `absent`."""
    return dataclasses.field(default=None, metadata={"absent": absent})


def nested_types(cls: type) -> dict[str, type]:
    """Return field -> class, for the nested dataclasses of a dataclass."""
    types_by_name = {}
    for field in dataclasses.fields(cls):
        if "absent" in field.metadata:
            types_by_name[field.name] = type(field.metadata["absent"])
        elif dataclasses.is_dataclass(field.default):
            types_by_name[field.name] = type(field.default)
    return types_by_name


@functools.cache
def declared_nested_types(cls: type) -> dict[str, type | types.UnionType]:
    """Return field -> declared type, for nested dataclasses declared as a class or a union."""
    # Names that only a type checker imports cannot be resolved at run time.
    try:
        hints = typing.get_type_hints(cls)
    except NameError:
        return {}
    declared = {name: hints[name] for name in nested_types(cls) if hints[name] is not Any}
    return {
        name: hint for name, hint in declared.items() if isinstance(hint, type | types.UnionType)
    }


def _bounded(
    default: object,
    is_valid: Callable[[object], bool],
    text: str,
    optional: bool = False,
    unit: str = "",
    kind: type | None = None,
    between: tuple[float | None, float | None] = (None, None),
) -> DeclaredField:
    """Return a field with its check, its unit and its range as metadata."""
    metadata = {
        "bound": (is_valid, text, optional or default is None, kind),
        "unit": unit,
        "between": between,
    }
    return dataclasses.field(default=default, metadata=metadata)


def _is_real(value: object, infinite: bool = False) -> TypeGuard[float]:
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    return math.isfinite(value) or (infinite and math.isinf(value))


def _is_integer(value: object) -> TypeGuard[int]:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def command(*words: object, trust: bool = False) -> str:
    """Return a command line of this program, quoted for a shell."""
    return shlex.join(["codrl-mj", *map(str, words), *["--trust"] * trust])
