"""Fields of frozen dataclasses that know their own bounds and units: the one place where settings are checked."""

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
from typing import Any


def real(
    default: float | None,
    above: float | None = None,
    minimum: float | None = None,
    below: float | None = None,
    maximum: float | None = None,
    optional: bool = False,
    unit: str = "",
    infinite: bool = False,
) -> Any:
    """A field for a finite number within bounds, stored as a float.

    Args:
        default: its default.
        above: it must be greater than this.
        minimum: it must be at least this.
        below: it must be less than this.
        maximum: it must be at most this.
        optional: let it be None; so does a default of None.
        unit: for tables and documentation.
        infinite: let it be infinite.
    """
    limits = [("> ", above), (">= ", minimum), ("< ", below), ("<= ", maximum)]
    kind = "a number" if infinite else "a finite number"
    text = " ".join(
        [kind, " and ".join(f"{sign}{limit:g}" for sign, limit in limits if limit is not None)]
    ).strip()

    def holds(value: Any) -> bool:
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
    return _bounded(default, holds, text, optional, unit, float, (low, high))


def integer(
    default: int | None, minimum: int, optional: bool = False, unit: str = "", maximum: float = math.inf
) -> Any:
    """A field for an integer of at least `minimum`; `optional`, or a default of None, lets it be None."""
    return _bounded(
        default,
        lambda value: _is_integer(value) and minimum <= value <= maximum,
        f"an integer >= {minimum}" if maximum == math.inf else f"an integer from {minimum} to {maximum}",
        optional,
        unit,
        int,
        (minimum, None),
    )


def flag(default: bool) -> Any:
    """A field for True or False."""
    return _bounded(default, lambda value: isinstance(value, bool), "true or false")


def choice(default: str, *options: str) -> Any:
    """A field for one of some words; where it has to be a number, its place among them."""
    made = _bounded(default, lambda value: value in options, f"one of {', '.join(options)}")
    return dataclasses.field(default=default, metadata={**made.metadata, "options": options})


def positive_integers(default: tuple[int, ...]) -> Any:
    """A field for the units of a network's hidden layers."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(
            _is_integer(count) and count >= 1 for count in value
        )

    return _bounded(default, holds, "a tuple of integers >= 1")


def positive_reals(default: tuple[float, ...] | None = None) -> Any:
    """An optional field for finite numbers > 0, one for each entry of something."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(_is_real(factor) and factor > 0 for factor in value)

    return _bounded(default, holds, "a tuple of finite numbers > 0")


def reals(default: tuple[float, ...] | None = None) -> Any:
    """An optional field for finite numbers, one for each entry of something."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(_is_real(one) for one in value)

    return _bounded(default, holds, "a tuple of finite numbers")


@dataclasses.dataclass(frozen=True)
class Checked:
    """Base of dataclasses whose fields are made with the functions above.

    Raises:
        ValueError: a field is out of bounds; the message names it, its value and the bound.
    """

    def __post_init__(self) -> None:
        """Refuse a field out of bounds, and store numbers as Python's own."""
        for field in dataclasses.fields(self):
            if "bound" not in field.metadata:
                continue
            holds, text, optional, kind = field.metadata["bound"]
            value = getattr(self, field.name)
            if value is None and optional:
                continue
            if not holds(value):
                none = " or none" if optional else ""
                raise ValueError(
                    f"{type(self).__name__}.{field.name} = {value!r}: must be {text}{none}"
                )
            if kind is not None:
                object.__setattr__(self, field.name, kind(value))


def free_memory() -> int | None:
    """Return the memory [bytes] that is free; None where the system does not say, as others than Linux."""
    meminfo = Path("/proc/meminfo")
    free = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text() if meminfo.exists() else "")
    return 1024 * int(free[1]) if free else None


def check_memory(size: float, what: str, remedy: str) -> None:
    """Refuse what takes more memory than is free.

    Args:
        size: of the memory [bytes].
        what: it is for, with how many, for the message.
        remedy: what to change.
    """
    if (room := free_memory()) is not None and size > room:
        raise ValueError(
            f"{what}: about {size / 1e9:,.3g} GB of memory, of which {room / 1e9:.3g} are free;"
            f" {remedy}"
        )


def check_names(
    given: Iterable[Any],
    known: Iterable[str],
    what: str,
    prefix: str = "",
    list_all: bool = False,
    listed_by: str = "",
    nested: Iterable[str] = (),
) -> None:
    """Refuse names that are not known; the nearest known ones are suggested.

    Args:
        given: the names.
        known: what they may be.
        what: what to call them, such as `actuator field`.
        prefix: stands before each of them in the message.
        list_all: list the known ones beside the nearest, too: for names that somebody else has for the
            same.
        listed_by: the command that lists them, where they are many.
        nested: dotted names of what is in their parts, to be suggested to whoever leaves the part
            out.
    """
    known, nested = list(known), list(nested)
    for name in given:
        if name not in known:
            near = [one for one in nested if one.rpartition(".")[2] == name][:3] or _nearest(
                name, known
            )
            near = near or _nearest(name, nested)
            hints = (
                [f"did you mean {' or '.join(f'{prefix}{one}' for one in near)}?"] if near else []
            )
            if list_all or not near:
                hints.append(
                    f"`{listed_by}` lists the known ones"
                    if listed_by
                    else f"known: {', '.join(known)}"
                )
            raise ValueError(f"unknown {what} {prefix}{name}; {' '.join(hints)}")


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """What nested mappings hold, by dotted names."""
    found: dict[str, Any] = {}
    for key, value in mapping.items():
        found |= (
            flatten(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return found


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """What two mappings have otherwise, by dotted names: both values, `absent` where one has none."""
    mine, others = flatten(one), flatten(other)
    pairs = {
        name: (mine.get(name, "absent"), others.get(name, "absent")) for name in [*mine, *others]
    }
    return {name: pair for name, pair in pairs.items() if repr(pair[0]) != repr(pair[1])}


def check_pattern(pattern: str) -> None:
    """Refuse what is no regular expression of names."""
    try:
        re.compile(pattern)
    except (re.error, TypeError) as error:
        raise ValueError(
            f"{pattern!r}: must be a regular expression ({error}); '.*' is any name, 'leg.*' those"
            " of a leg"
        ) from None


def check_joint_dynamics(value: Any) -> None:
    """Refuse what `joint_dynamics` of `codrl_mj.add_motors` cannot be."""
    if value not in (None, "keep", "replace"):
        raise ValueError(
            f"joint_dynamics = {value!r}: must be keep or replace; None keeps, and warns"
        )


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """A question with the nearest known names and a space, for the message about an unknown one; or nothing."""
    near = _nearest(name, known)
    return f"did you mean {' or '.join(map(repr, near))}? " if near else ""


def _nearest(name: object, known: Iterable[str]) -> list[str]:
    """Return the few names that begin with a name or have all of its words, or else the one that is most like it.

    Of dotted names only the last parts are compared where the parts before it are known: what two
    names begin with alike makes them no more similar.
    """
    text, spelt = str(name).lower(), {one.lower(): one for one in known}
    begun = [spelt[one] for one in spelt if len(text) > 2 and one.startswith(text)]
    if 0 < len(begun) < 4:
        return begun
    start, dot, last = text.rpartition(".")
    ends = {one[len(start + dot) :]: one for one in spelt if dot and one.startswith(start + dot)}
    if not ends:
        ends, last = {one: one for one in spelt}, text
    words = _words(last)
    same = [
        spelt[one] for end, one in ends.items() if words and words <= _words(end.rpartition(".")[2])
    ]
    if 0 < len(same) < 4:
        return same
    beside = [end for end in ends if last == text or "." not in end]
    return [spelt[ends[one]] for one in difflib.get_close_matches(last, beside, n=1)]


def _words(name: str) -> set[str]:
    """Return the words of a name or a flag."""
    return set(re.findall(r"[a-z0-9]{3,}", name.replace("_", " ")))


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


def build(cls: type, mapping: object, what: str, prefix: str = "") -> Any:
    """Build a dataclass, and those in its fields, from nested mappings; absent fields take their defaults."""
    if not isinstance(mapping, Mapping):
        raise ValueError(
            f"{what} {prefix.rstrip('.')!r} = {mapping!r}: must be a mapping of {cls.__name__}'s"
            " fields"
        )
    nested = parts(cls)
    absent = {
        field.name: field.metadata["absent"]
        for field in dataclasses.fields(cls)
        if "absent" in field.metadata
    }
    inner = [
        f"{name}.{field.name}"
        for name, kind in nested.items()
        for field in dataclasses.fields(kind)
    ]
    check_names(
        mapping, (field.name for field in dataclasses.fields(cls)), what, prefix, nested=inner
    )

    def built(key: str, value: Any) -> Any:
        """Return a part of a mapping as its dataclass; one that is a dataclass already stays."""
        if key not in nested or value is None or isinstance(value, nested[key]):
            return value
        if (
            isinstance(value, Mapping) and key in absent
        ):  # over what stands for the part where it is left out
            value = {**dataclasses.asdict(absent[key]), **value}
        return build(nested[key], value, what, f"{prefix}{key}.")

    return cls(**{key: built(key, value) for key, value in mapping.items()})


def part(absent: Any) -> Any:
    """A field for an optional dataclass, None by default."""
    return dataclasses.field(default=None, metadata={"absent": absent})


def parts(cls: type) -> dict[str, type]:
    """The fields of a dataclass that hold dataclasses, and which."""
    found = {}
    for field in dataclasses.fields(cls):
        if "absent" in field.metadata:
            found[field.name] = type(field.metadata["absent"])
        elif dataclasses.is_dataclass(field.default):
            found[field.name] = type(field.default)
    return found


@functools.cache
def declared_parts(cls: Any) -> dict[str, Any]:
    """The `parts` of a dataclass that are declared as a class, or a union of some: as what."""
    try:
        hints = typing.get_type_hints(cls)
    except NameError:  # names that only a type checker sees
        return {}
    declared = {name: hints[name] for name in parts(cls) if hints[name] is not Any}
    return {
        name: hint for name, hint in declared.items() if isinstance(hint, type | types.UnionType)
    }


def _bounded(
    default: Any,
    holds: Callable[[Any], bool],
    text: str,
    optional: bool = False,
    unit: str = "",
    kind: type | None = None,
    between: tuple[float | None, float | None] = (None, None),
) -> Any:
    metadata = {
        "bound": (holds, text, optional or default is None, kind),
        "unit": unit,
        "between": between,
    }
    return dataclasses.field(default=default, metadata=metadata)


def _is_real(value: Any, infinite: bool = False) -> bool:
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return real and (math.isfinite(value) or (infinite and math.isinf(value)))


def _is_integer(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def command(*words: object, trust: bool = False) -> str:
    """Return a command line of this program, quoted for a shell."""
    return shlex.join(["codrl-mj", *map(str, words), *["--trust"] * trust])
