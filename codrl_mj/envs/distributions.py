"""Distributions of randomized fields, and parsing of the argument `randomize`.

The argument becomes a mapping from paths to distributions, in the order in which they are drawn. A
path is `[PATTERN:]FIELD` for actuators (all of them if there is no pattern) or `model.FIELD`. A
distribution is a pure function of draws in [0, 1): the same draw always gives the same value.
`str` returns a distribution as text that `parse` reads: `uniform(0.05, 0.2)`, `loguniform(0.1,
10.0)`, `choice(1, 2)`.
"""

import dataclasses
import math
import numbers
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np

from codrl_mj.fields import check_pattern, did_you_mean

MODEL = "model."
"""Prefix of paths to the model's fields."""


@dataclasses.dataclass(frozen=True)
class _Range:
    """Range of numbers from `low` to `high`."""

    low: float
    """Smallest value, in the field's unit."""
    high: float
    """Largest value, >= low."""

    _LOWER_BOUND: ClassVar[float | None] = None
    """Exclusive lower bound of `low` and `high`; None if there is none."""

    def __post_init__(self) -> None:
        """Validate, and store the bounds as floats."""
        kind, lower_bound = type(self).__name__, self._LOWER_BOUND
        for field in ("low", "high"):
            value = getattr(self, field)
            is_valid = (
                isinstance(value, numbers.Real)
                and not isinstance(value, bool)
                and math.isfinite(value)
            )
            if not is_valid or (lower_bound is not None and not value > lower_bound):
                bound = "" if lower_bound is None else f" > {lower_bound:g}"
                raise ValueError(f"{kind}.{field} = {value!r}: must be a finite number{bound}")
            object.__setattr__(self, field, float(value))
        if not self.low <= self.high:
            raise ValueError(f"{kind}.high = {self.high:g}: must be >= low = {self.low:g}")

    def __str__(self) -> str:
        """Return the distribution as text that `parse` reads."""
        return f"{type(self).__name__.lower()}({self.low!r}, {self.high!r})"

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values to check: if a field allows these, it allows all values of the distribution."""
        return self.low, self.high


@dataclasses.dataclass(frozen=True)
class Uniform(_Range):
    """Uniform distribution of numbers from `low` to `high`.

    Raises:
        ValueError: a bound is not a finite number, or high < low.
    """

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """Return the values low + (high - low) u.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        # Rounding of the sum could exceed `high` by one unit in the last place.
        return np.minimum(self.low + (self.high - self.low) * draws, self.high)


@dataclasses.dataclass(frozen=True)
class LogUniform(_Range):
    """Log-uniform distribution: the logarithm is uniform from log(low) to log(high).

    Raises:
        ValueError: a bound is not a finite number > 0, or high < low.
    """

    _LOWER_BOUND = 0.0

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """Return the values exp(log(low) + (log(high) - log(low)) u), within the bounds.

        Args:
            draws: numbers u in [0, 1), shape (m,), contiguous.
        """
        low, high = math.log(self.low), math.log(self.high)
        return np.clip(np.exp(low + (high - low) * draws), self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Choice:
    """Discrete uniform distribution over a list of values.

    Raises:
        ValueError: no values, or one that is not a number.
    """

    values: Sequence[float]
    """The values, in the field's unit; a value that is listed twice is twice as likely."""

    def __post_init__(self) -> None:
        """Validate."""
        values = self.values
        if (
            not isinstance(values, Sequence | np.ndarray)
            or isinstance(values, str)
            or len(values) == 0
        ):
            raise ValueError(
                f"Choice.values = {values!r}: must be a sequence of one or more numbers"
            )
        for value in values:
            if not isinstance(value, numbers.Real | np.bool_) or math.isnan(value):
                raise ValueError(f"Choice.values = {values!r}: {value!r} must be a number")
        python_values = (
            value.item() if isinstance(value, np.generic) else value for value in values
        )
        # Integers stay integers, because fields may be counts; a float would be refused there.
        converted_values = (
            number if isinstance(number, bool | int) else float(number) for number in python_values
        )
        object.__setattr__(self, "values", tuple(converted_values))

    def __str__(self) -> str:
        """Return the distribution as text that `parse` reads."""
        return f"choice({', '.join(map(repr, self.values))})"

    def transform(self, draws: np.ndarray) -> np.ndarray:
        """Return the values at the indices floor(n u), as floats.

        Args:
            draws: numbers u in [0, 1), shape (m,).
        """
        table = np.array(self.values, dtype=np.float64)
        return table[np.minimum((len(table) * draws).astype(np.int64), len(table) - 1)]

    @property
    def extremes(self) -> tuple[float, ...]:
        """Values to check: if a field allows these, it allows all values of the distribution."""
        return tuple(self.values)


Distribution = Uniform | LogUniform | Choice
"""Distributions that a field can be drawn from."""

_FORMS = {
    "uniform": "uniform(LOW, HIGH)",
    "loguniform": "loguniform(LOW, HIGH)",
    "choice": "choice(VALUE, ...)",
}


def parse(text: str) -> Distribution:
    """Parse the text of a distribution, as `str` returns it, without evaluating it as code.

    Args:
        text: `uniform(LOW, HIGH)`, `loguniform(LOW, HIGH)` or `choice(VALUE, ...)`. A value is a
            number, `inf`, `True` or `False`; one without point and exponent is an integer.
    """
    match = re.fullmatch(r"\s*(\w+)\s*\(([^()]*)\)\s*", text) if isinstance(text, str) else None
    *other_forms, last_form = _FORMS.values()
    expected = f"{', '.join(other_forms)} or {last_form}"
    if match is None:
        raise ValueError(f"{text!r} is no distribution: must be {expected}")
    kind, arguments = match.groups()
    if kind not in _FORMS:
        raise ValueError(
            f"{text!r} is no distribution: {did_you_mean(kind, _FORMS)}it must be {expected}"
        )
    values = (
        [_parse_number(text, word.strip()) for word in arguments.split(",")]
        if arguments.strip()
        else []
    )
    if len(values) != 2 and kind != "choice":
        raise ValueError(f"{text!r} has {len(values)} values: must be {_FORMS[kind]}")
    try:
        if kind == "choice":
            return Choice(values)
        return (Uniform if kind == "uniform" else LogUniform)(*values)
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}") from None


def _parse_number(text: str, word: str) -> bool | int | float:
    """Return the value of one argument in a distribution's text."""
    if word in ("True", "False"):
        return word == "True"
    try:
        return int(word) if re.fullmatch(r"[+-]?\d+", word) else float(word)
    except ValueError:
        raise ValueError(f"{text!r}: {word!r} must be a number") from None


def split_pattern(path: str) -> tuple[str, str]:
    """Split a path into its pattern, which may be empty, and its field."""
    pattern, _, field = ("", "", path) if path.startswith(MODEL) else path.rpartition(":")
    return pattern, field


def parse_randomize(randomize: object) -> dict[str, Distribution]:
    """Return path -> distribution, in the order of drawing.

    Args:
        randomize: a mapping of paths to distributions or their text; or a mapping of patterns to
            such mappings; or a sequence of 'PATH=DISTRIBUTION'; or None, which randomizes nothing.
            A path is FIELD, PATTERN:FIELD or model.FIELD.
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
    distributions: dict[str, Distribution] = {}
    for path, value in (
        _flatten(randomize) if isinstance(randomize, Mapping) else map(_split_item, randomize)
    ):
        if path in distributions:
            raise ValueError(f"randomize: {path} is named twice: give it one distribution")
        pattern, field = split_pattern(path)
        try:
            if pattern and field.startswith(MODEL):
                raise ValueError(f"{field} is the model's, not a motor's: leave {pattern!r} out")
            check_pattern(pattern)
            distributions[path] = value if isinstance(value, Distribution) else parse(value)  # type: ignore[arg-type]
        except ValueError as error:
            raise ValueError(f"randomize: {path}: {error}") from None
    return distributions


def _flatten(randomize: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Yield path and distribution, with the pattern in front of the field in nested mappings."""
    for name, value in randomize.items():
        if (
            isinstance(value, Mapping)
            and value
            and all(isinstance(text, str | Distribution) for text in value.values())
        ):
            yield from ((f"{name}:{field}", text) for field, text in value.items())
        else:
            yield str(name), value


def _split_item(item: object) -> tuple[str, str]:
    """Split 'PATH=DISTRIBUTION' into its two parts; a pattern may itself contain '='."""
    match = re.fullmatch(r"\s*((?:.*:)?[^:=]+?)\s*=(.*)", item) if isinstance(item, str) else None
    if match is None:
        raise ValueError(
            f"randomize: {item!r}: must be FIELD=DISTRIBUTION, such as"
            " 'motor.inductance=uniform(0.05, 0.2)'"
        )
    return match[1], match[2]
