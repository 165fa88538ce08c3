"""What can be drawn, and from what: a mapping of paths to distributions, in the order in which they are drawn.

A path is `[PATTERN:]FIELD` of actuators (without a pattern, of all) or `model.FIELD`. A
distribution is a pure function of draws in [0, 1): a draw gives the same value wherever it is made.
`str` writes it as `parse` reads it, exactly: `uniform(0.05, 0.2)`, `loguniform(0.1, 10.0)`,
`choice(1, 2)`.
"""

import dataclasses
import math
import numbers
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from codrl_mj.fields import check_pattern, did_you_mean

MODEL = "model."
"""What paths of the model's fields begin with."""


@dataclasses.dataclass(frozen=True)
class _Range:
    """Numbers from `low` to `high`."""

    low: float
    """Smallest value, in the field's unit."""
    high: float
    """Largest value, >= low."""

    _LEAST: ClassVar[float | None] = None
    """Bounds are larger."""

    def __post_init__(self) -> None:
        """Validate, and store the bounds as floats."""
        kind, least = type(self).__name__, self._LEAST
        for field in ("low", "high"):
            value = getattr(self, field)
            fine = (
                isinstance(value, numbers.Real)
                and not isinstance(value, bool)
                and math.isfinite(value)
            )
            if not fine or (least is not None and not value > least):
                bound = "" if least is None else f" > {least:g}"
                raise ValueError(f"{kind}.{field} = {value!r}: must be a finite number{bound}")
            object.__setattr__(self, field, float(value))
        if not self.low <= self.high:
            raise ValueError(f"{kind}.high = {self.high:g}: must be >= low = {self.low:g}")

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"{type(self).__name__.lower()}({self.low!r}, {self.high!r})"

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values whose being allowed means that all are."""
        return self.low, self.high


@dataclasses.dataclass(frozen=True)
class Uniform(_Range):
    """Every number from `low` to `high` alike.

    Raises:
        ValueError: a bound is not a finite number, or high < low.
    """

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """The values low + (high - low) u.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        return np.minimum(self.low + (self.high - self.low) * draws, self.high)


@dataclasses.dataclass(frozen=True)
class LogUniform(_Range):
    """Every ratio alike: the logarithm is uniform from that of `low` to that of `high`.

    Raises:
        ValueError: a bound is not a finite number > 0, or high < low.
    """

    _LEAST = 0.0

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """The values exp(log(low) + (log(high) - log(low)) u), within the bounds.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        low, high = math.log(self.low), math.log(self.high)
        return np.clip(np.exp(low + (high - low) * draws), self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Choice:
    """One of some values, each as likely as another.

    Raises:
        ValueError: no values, or one that is not a number.
    """

    values: Sequence[float]
    """The values, in the field's unit; named twice, one is twice as likely."""

    def __post_init__(self) -> None:
        """Validate."""
        given = self.values
        if (
            not isinstance(given, Sequence | np.ndarray)
            or isinstance(given, str)
            or len(given) == 0
        ):
            raise ValueError(
                f"Choice.values = {given!r}: must be a sequence of one or more numbers"
            )
        for value in given:
            if not isinstance(value, numbers.Real | np.bool_) or math.isnan(value):
                raise ValueError(f"Choice.values = {given!r}: {value!r} must be a number")
        plain = (value.item() if isinstance(value, np.generic) else value for value in given)
        kept = (one if isinstance(one, bool | int) else float(one) for one in plain)
        object.__setattr__(self, "values", tuple(kept))

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"choice({', '.join(map(repr, self.values))})"

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """The values at floor(n u), as floats.

        Args:
            draws: numbers u in [0, 1), shape (m,).
        """
        table = np.array(self.values, dtype=np.float64)
        return table[np.minimum((len(table) * draws).astype(np.int64), len(table) - 1)]

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values whose being allowed means that all are."""
        return tuple(self.values)


Distribution = Uniform | LogUniform | Choice
"""What a field can be drawn from."""

_FORMS = {
    "uniform": "uniform(LOW, HIGH)",
    "loguniform": "loguniform(LOW, HIGH)",
    "choice": "choice(VALUE, ...)",
}


def parse(text: str) -> Distribution:
    """Read a distribution as `str` writes it; nothing is evaluated.

    Args:
        text: `uniform(LOW, HIGH)`, `loguniform(LOW, HIGH)` or `choice(VALUE, ...)`. A value is a
            number, `inf`, `True` or `False`; one without point and exponent is an integer.
    """
    match = re.fullmatch(r"\s*(\w+)\s*\(([^()]*)\)\s*", text) if isinstance(text, str) else None
    *others, last = _FORMS.values()
    expected = f"{', '.join(others)} or {last}"
    if match is None:
        raise ValueError(f"{text!r} is no distribution: must be {expected}")
    kind, inside = match.groups()
    if kind not in _FORMS:
        raise ValueError(
            f"{text!r} is no distribution: {did_you_mean(kind, _FORMS)}it must be {expected}"
        )
    values = [_number(text, word.strip()) for word in inside.split(",")] if inside.strip() else []
    if len(values) != 2 and kind != "choice":
        raise ValueError(f"{text!r} has {len(values)} values: must be {_FORMS[kind]}")
    try:
        if kind == "choice":
            return Choice(values)
        return (Uniform if kind == "uniform" else LogUniform)(*values)
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}") from None


def _number(text: str, word: str) -> bool | int | float:
    if word in ("True", "False"):
        return word == "True"
    try:
        return int(word) if re.fullmatch(r"[+-]?\d+", word) else float(word)
    except ValueError:
        raise ValueError(f"{text!r}: {word!r} must be a number") from None


def split_path(path: str) -> tuple[str, str]:
    """Pattern and field of a path; the pattern is empty where there is none."""
    pattern, _, field = ("", "", path) if path.startswith(MODEL) else path.rpartition(":")
    return pattern, field


def paths_of(randomize: Any) -> dict[str, Distribution]:
    """Path -> distribution, in the order in which they are drawn.

    Args:
        randomize: a mapping of paths to distributions or their text, of patterns to such mappings,
            or a sequence of 'PATH=DISTRIBUTION'; a path is FIELD, PATTERN:FIELD or model.FIELD.
            None is for nothing.
    """
    if randomize is None:
        return {}
    if (
        isinstance(randomize, str)
        or not isinstance(randomize, Mapping | list | tuple)
        or not randomize
    ):
        raise ValueError(
            f"randomize = {randomize!r}: must be one or more of FIELD=DISTRIBUTION, or a mapping of"
            " fields to these"
        )
    found: dict[str, Distribution] = {}
    for path, one in _flat(randomize) if isinstance(randomize, Mapping) else map(_split, randomize):
        if path in found:
            raise ValueError(f"randomize: {path} is named twice: give it one distribution")
        pattern, field = split_path(path)
        try:
            if pattern and field.startswith(MODEL):
                raise ValueError(f"{field} is the model's, not a motor's: leave {pattern!r} out")
            check_pattern(pattern)
            found[path] = one if isinstance(one, Distribution) else parse(one)
        except ValueError as error:
            raise ValueError(f"randomize: {path}: {error}") from None
    return found


def _flat(randomize: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Path and distribution of each, of mappings of patterns the pattern before the field."""
    for name, one in randomize.items():
        if (
            isinstance(one, Mapping)
            and one
            and all(isinstance(text, str | Distribution) for text in one.values())
        ):
            yield from ((f"{name}:{field}", text) for field, text in one.items())
        else:
            yield str(name), one


def _split(item: Any) -> tuple[str, str]:
    """Path and distribution of 'PATH=DISTRIBUTION'; a pattern may hold '=' itself."""
    match = re.fullmatch(r"\s*((?:.*:)?[^:=]+?)\s*=(.*)", item) if isinstance(item, str) else None
    if match is None:
        raise ValueError(
            f"randomize: {item!r}: must be FIELD=DISTRIBUTION, such as"
            " 'motor.inductance=uniform(0.05, 0.2)'"
        )
    return match[1], match[2]
