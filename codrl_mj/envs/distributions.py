"""Distributions of a number, as pure functions of draws in [0, 1): a draw gives the same value wherever it is made.

`str` writes a distribution as `parse` reads it, exactly: `uniform(0.05, 0.2)`, `loguniform(0.1, 10.0)`, `choice(1, 2)`.
"""

import dataclasses
import math
import numbers
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from codrl_mj.fields import did_you_mean


def _plain(number: Any) -> bool | int | float:
    """A real number as Python's own bool, int or float."""
    if isinstance(number, bool | np.bool_):
        return bool(number)
    return int(number) if isinstance(number, numbers.Integral) else float(number)


def _check_bounds(distribution: Any, least: float | None) -> None:
    """Store `low` and `high` of a frozen distribution as floats, or raise `ValueError` naming value and bound."""
    kind = type(distribution).__name__
    for field in ("low", "high"):
        value = getattr(distribution, field)
        fine = isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
        if not fine or (least is not None and not value > least):
            bound = "" if least is None else f" > {least:g}"
            raise ValueError(f"{kind}.{field} = {value!r}: must be a finite number{bound}")
        object.__setattr__(distribution, field, float(value))
    if not distribution.low <= distribution.high:
        raise ValueError(f"{kind}.high = {distribution.high:g}: must be >= low = {distribution.low:g}")


@dataclasses.dataclass(frozen=True)
class Uniform:
    """Every number from `low` to `high` alike.

    Raises:
        ValueError: a bound is not a finite number, or high < low.
    """

    low: float
    """Smallest value, in the field's unit."""
    high: float
    """Largest value, >= low."""

    def __post_init__(self) -> None:
        """Validate."""
        _check_bounds(self, None)

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"uniform({self.low!r}, {self.high!r})"

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """The values low + (high - low) u.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        return np.minimum(self.low + (self.high - self.low) * draws, self.high)

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values whose being allowed means that all are."""
        return self.low, self.high


@dataclasses.dataclass(frozen=True)
class LogUniform:
    """Every ratio alike: the logarithm is uniform from that of `low` to that of `high`.

    Raises:
        ValueError: a bound is not a finite number > 0, or high < low.
    """

    low: float
    """Smallest value, > 0, in the field's unit."""
    high: float
    """Largest value, >= low."""

    def __post_init__(self) -> None:
        """Validate."""
        _check_bounds(self, 0.0)

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"loguniform({self.low!r}, {self.high!r})"

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """The values exp(log(low) + (log(high) - log(low)) u), within the bounds.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        low, high = math.log(self.low), math.log(self.high)
        return np.clip(np.exp(low + (high - low) * draws), self.low, self.high)

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values whose being allowed means that all are."""
        return self.low, self.high


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
        if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str) or len(given) == 0:
            raise ValueError(f"Choice.values = {given!r}: must be a sequence of one or more numbers")
        for value in given:
            if not isinstance(value, numbers.Real | np.bool_) or math.isnan(value):
                raise ValueError(f"Choice.values = {given!r}: {value!r} must be a number")
        object.__setattr__(self, "values", tuple(map(_plain, given)))

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

_FORMS = {"uniform": "uniform(LOW, HIGH)", "loguniform": "loguniform(LOW, HIGH)", "choice": "choice(VALUE, ...)"}


def parse(text: str) -> Distribution:
    """Read a distribution as `str` writes it; nothing is evaluated.

    Args:
        text: `uniform(LOW, HIGH)`, `loguniform(LOW, HIGH)` or `choice(VALUE, ...)`. A value is a number, `inf`, `True`
            or `False`; one without point and exponent is an integer.

    Raises:
        ValueError: an unknown distribution (the nearest is suggested), the wrong number of values, one that is no
            number, or impossible bounds; the message has the text.
    """
    match = re.fullmatch(r"\s*(\w+)\s*\(([^()]*)\)\s*", text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{text!r} is no distribution: must be {_expected()}")
    kind, inside = match.groups()
    if kind not in _FORMS:
        raise ValueError(f"{text!r} is no distribution: {did_you_mean(kind, _FORMS)}it must be {_expected()}")
    values = [_number(text, word.strip()) for word in inside.split(",")] if inside.strip() else []
    if len(values) != 2 and kind != "choice":
        raise ValueError(f"{text!r} has {len(values)} values: must be {_FORMS[kind]}")
    try:
        if kind == "choice":
            return Choice(values)
        return (Uniform if kind == "uniform" else LogUniform)(*values)
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}") from None


def _expected() -> str:
    *others, last = _FORMS.values()
    return f"{', '.join(others)} or {last}"


def _number(text: str, word: str) -> bool | int | float:
    if word in ("True", "False"):
        return word == "True"
    try:
        return int(word) if re.fullmatch(r"[+-]?\d+", word) else float(word)
    except ValueError:
        raise ValueError(f"{text!r}: {word!r} must be a number") from None
