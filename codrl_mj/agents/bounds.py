"""Fields of settings that know their own bounds."""

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import Any


def real(
    default: float | None,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    optional: bool = False,
) -> Any:
    """A field for a finite number within bounds; `optional`, or a default of None, lets it be None."""
    limits = [("> ", above), (">= ", least), ("< ", below), ("<= ", most)]
    text = "a finite number " + " and ".join(f"{sign}{limit:g}" for sign, limit in limits if limit is not None)

    def holds(value: Any) -> bool:
        return (
            _is_real(value)
            and (above is None or value > above)
            and (least is None or value >= least)
            and (below is None or value < below)
            and (most is None or value <= most)
        )

    return _bounded(default, holds, text, optional)


def integer(default: int | None, least: int, optional: bool = False) -> Any:
    """A field for an integer of at least `least`; `optional`, or a default of None, lets it be None."""
    return _bounded(default, lambda value: _is_integer(value) and value >= least, f"an integer >= {least}", optional)


def flag(default: bool) -> Any:
    """A field for True or False."""
    return _bounded(default, lambda value: isinstance(value, bool), "true or false")


def choice(default: str, *options: str) -> Any:
    """A field for one of some words."""
    return _bounded(default, lambda value: value in options, f"one of {', '.join(options)}")


def units(default: tuple[int, ...]) -> Any:
    """A field for the units of a network's hidden layers."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(_is_integer(count) and count >= 1 for count in value)

    return _bounded(default, holds, "a tuple of integers >= 1")


def factors(default: tuple[float, ...] | None = None) -> Any:
    """An optional field for finite numbers > 0, one for each entry of something."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(_is_real(factor) and factor > 0 for factor in value)

    return _bounded(default, holds, "a tuple of finite numbers > 0")


def reals(default: tuple[float, ...] | None = None) -> Any:
    """An optional field for finite numbers, one for each entry of something."""

    def holds(value: Any) -> bool:
        return isinstance(value, tuple) and all(_is_real(one) for one in value)

    return _bounded(default, holds, "a tuple of finite numbers")


def check(settings: Any) -> None:
    """Check every field of a dataclass made with the functions above.

    Raises:
        ValueError: a field is out of bounds; the message names it, its value and the bound.
    """
    for field in dataclasses.fields(settings):
        if "bound" not in field.metadata:
            continue
        holds, text, optional = field.metadata["bound"]
        value = getattr(settings, field.name)
        if not (holds(value) or (optional and value is None)):
            none = " or none" if optional else ""
            raise ValueError(f"{type(settings).__name__}.{field.name} = {value!r}: must be {text}{none}")


def _bounded(default: Any, holds: Callable[[Any], bool], text: str, optional: bool = False) -> Any:
    return dataclasses.field(default=default, metadata={"bound": (holds, text, optional or default is None)})


def _is_real(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
