"""The mapping of a file's columns to signals: `time=t:s,voltage=duty*vbus:V,current=-i:mA`."""

import ast
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping
from typing import cast

import numpy as np

from codrl_mj.catalogue.units import to_si
from codrl_mj.fields import check_names
from codrl_mj.identify.log import SIGNALS

COLUMN_UNITS: dict[str, str | None] = {
    "time": "s",
    **SIGNALS,
    "only": "",
}
"""Signal that columns can be mapped to -> its SI unit; None: any."""
OPEN_UNIT = "UNIT"
"""Placeholder in a proposed mapping for a unit that the user has to fill in."""
EXAMPLES = {
    "time": "s, ms or us",
    "voltage": "V or mV",
    "bus": "V or mV",
    "current": "A or mA",
    "position": "rad, deg or turn",
    "velocity": "rad/s, deg/s, rpm or turn/s",
    "torque": "N*m, mN*m or kgf*cm",
    "duty": "1 (a share) or percent",
    "temperature": "degC or K",
    "command": "rad, deg or turn",
    "only": "1",
}
"""Signal -> usual units of its columns."""
_EXAMPLE = "time=t:s,voltage=duty*vbus:V,current=i:A,position=q:rad"


Operand = float | np.ndarray
"""Value in a formula: a constant, or a column."""


def twos_complement(values: Operand, bits: float) -> np.ndarray:
    """Return unsigned numbers read as two's complement: 65535 with 16 bits is -1."""
    modulus = 2.0 ** float(bits)
    signed: np.ndarray = (np.asarray(values) + modulus / 2.0) % modulus - modulus / 2.0
    return signed


def sign_magnitude(values: Operand, bits: float) -> np.ndarray:
    """Return unsigned numbers read with a sign in the highest bit: 1324 with 11 bits is -300."""
    half = 2.0 ** (float(bits) - 1.0)
    return np.where(np.asarray(values) >= half, half - np.asarray(values), values)


FUNCTIONS: dict[str, tuple[int, Callable[..., Operand]]] = {
    "twos_complement": (2, twos_complement),
    "sign_magnitude": (2, sign_magnitude),
    "unwrap": (2, lambda values, period: np.unwrap(values, period=float(period))),
    "atan2": (2, np.arctan2),
    "abs": (1, np.abs),
    "sign": (1, np.sign),
    "sqrt": (1, np.sqrt),
}
"""Name of a function in formulas -> number of arguments, and the function.

A second argument must be a constant, except for atan2.
"""
_Value = Callable[[Mapping[str, Operand]], Operand]
_OPERATORS: dict[type, Callable[[Operand, Operand], Operand]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}


@dataclasses.dataclass(frozen=True)
class Column:
    """A signal as a formula of a file's columns."""

    signal: str  # `time`, one of `SIGNALS`, or `only`: rows where it is 0 are left out
    # Expression of column names, numbers, `pi`, + - * / and `FUNCTIONS`. Names with spaces are in
    # quotes; column[0] is the first entry of a column of lists.
    formula: str
    # Unit of the formula's value. None means SI, and is allowed only if the formula is not a mere
    # column name.
    unit: str | None
    # True if a voltage is the mean until the next row; False if it is held until the next row.
    mean: bool = False

    def __post_init__(self) -> None:
        """Validate everything that does not depend on a file."""
        check_names([self.signal], COLUMN_UNITS, "signal")
        bare = self._formula[2]
        kind = COLUMN_UNITS[self.signal]
        if self.unit == OPEN_UNIT:
            remedy = f"write the unit of the column, such as {EXAMPLES[self.signal]}"
            raise self._error(f"the unit is not filled in; {remedy}. The file does not state it")
        if self.unit is not None:
            self._quantity(1.0)
        elif kind and bare:
            remedy = f"write {self.signal}={self.formula}:{kind} if it is in {kind}"
            raise self._error(f"has no unit, must have a unit of the same kind as {kind}; {remedy}")

    @property
    def text(self) -> str:
        """The mapping as the user writes it, for messages."""
        return f"{self.signal}={self.formula}" + (f":{self.unit}" if self.unit is not None else "")

    def _error(self, problem: str) -> ValueError:
        """Return an error that quotes the mapping."""
        return ValueError(f"columns: {self.text}: {problem}")

    @property
    def names(self) -> set[str]:
        """Names of the columns and constants that the formula reads."""
        return self._formula[1]

    def evaluate(self, table: Mapping[str, Operand | None]) -> Operand:
        """Return the signal in SI units, from a table of columns and constants.

        Columns that the formula does not read may be None.
        """
        for name in sorted(self.names - table.keys()):
            if width := sum(
                bool(re.fullmatch(re.escape(name) + r"\[\d+\]", known)) for known in table
            ):
                raise self._error(
                    f"{name} holds lists of {width} numbers; choose an entry, such as {name}[0]"
                )
        check_names(self.names, table, "column")
        operands = {name: value for name, value in table.items() if value is not None}
        # Rows without a finite value are left out later, with a finding.
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._quantity(self._formula[0]({"pi": math.pi, **operands}))

    @functools.cached_property
    def _formula(self) -> tuple[_Value, set[str], bool]:
        """Compiled formula, the names that it reads, and True if it is only a name."""
        try:
            body = ast.parse(self.formula.strip(), mode="eval").body
        except SyntaxError as error:
            raise ValueError(
                f"columns: {self.signal}={self.formula}: not a formula ({error.msg}); write the"
                f" name of a column, in quotes if it has spaces, as in {_EXAMPLE}"
            ) from None
        value, names = self._compile(body)
        return value, names - {"pi"}, isinstance(body, ast.Name | ast.Constant | ast.Subscript)

    def _compile(self, node: ast.AST) -> tuple[_Value, set[str]]:
        """Return a part of the formula as a function of a table, and the names that it reads."""
        # Only the listed kinds of nodes are allowed: a formula cannot execute other code.
        match node:
            case ast.Constant(value=str(name)) | ast.Name(id=name):
                return lambda table: table[name], {name}
            case ast.Subscript(
                value=ast.Name() | ast.Attribute() | ast.Constant(value=str()) as column,
                slice=ast.Name() | ast.Attribute() | ast.Constant(value=int() | str()) as entry,
            ):
                parts = (
                    str(part.value) if isinstance(part, ast.Constant) else ast.unparse(part)
                    for part in (column, entry)
                )
                listed = "{}[{}]".format(*parts)
                return lambda table: table[listed], {listed}
            case ast.Constant(value=literal):
                # For other literals than numbers, such as None, numpy raises an error.
                number = cast("float", literal)
                return lambda _: number, set()
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inner):
                value, names = self._compile(inner)
                return (lambda table: -value(table)) if isinstance(sign, ast.USub) else value, names
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
                (left_value, left_names) = self._compile(left)
                (right_value, right_names) = self._compile(right)
                apply = _OPERATORS[type(operator)]
                return (
                    lambda table: apply(left_value(table), right_value(table)),
                    left_names | right_names,
                )
            case ast.Call(func=ast.Name(id=function_name), args=arguments, keywords=[]):
                check_names([function_name], FUNCTIONS, "function")
                count, function = FUNCTIONS[function_name]
                if len(arguments) != count:
                    raise self._error(
                        f"{function_name} takes {count} arguments, not {len(arguments)}"
                    )
                values, names_read = zip(*map(self._compile, arguments), strict=True)
                if count == 2 and function_name != "atan2" and names_read[1] - {"pi"}:
                    raise self._error(
                        f"the second argument of {function_name} must be a number, such as 16"
                    )
                return lambda table: function(*(operand(table) for operand in values)), set().union(
                    *names_read
                )
        known = ", ".join(FUNCTIONS)
        raise self._error(
            f"{type(node).__name__} is not allowed; write names, numbers, + - * / and {known}"
        )

    def _quantity(self, value: Operand) -> Operand:
        """Return a value in SI units."""
        kind, unit = COLUMN_UNITS[self.signal], self.unit
        if unit is None or (not kind and unit in ("", "1")):
            return value

        try:
            return to_si(value, unit, kind, self.signal)
        except ValueError as error:
            raise self._error(
                f"{error}; write {kind or '1'}, or another unit of the same kind"
            ) from error


def parse_columns(mapping: str | Mapping[str, str]) -> dict[str, Column]:
    """Parse a mapping of signals, as a text `signal=formula:unit,...` or as a dictionary."""
    if isinstance(mapping, str):
        pairs = [_split(entry, "=") for entry in _split(mapping, ",") if entry.strip()]
    else:
        pairs = [[name, text] for name, text in mapping.items()]
    columns: dict[str, Column] = {}
    for pair in pairs:
        if len(pair) != 2:
            raise ValueError(
                f"columns: {'='.join(pair)!r}: must be signal=formula:unit, as in {_EXAMPLE}"
            )
        name, (formula, *unit) = pair[0].strip(), _split(pair[1], ":")
        if len(unit) > 1:
            raise ValueError(f"columns: {pair[1]!r}: has two colons; write formula:unit")
        if name in columns:
            raise ValueError(f"columns: {name} is given twice, must be given once; leave one out")
        formula = formula.strip()
        mean = re.fullmatch(r"mean\((.*)\)", formula) if name == "voltage" else None
        columns[name] = Column(
            name, mean[1] if mean else formula, unit[0].strip() if unit else None, mean is not None
        )
    if "time" not in columns:
        raise ValueError(f"columns: there is no time; write for instance {_EXAMPLE}")
    if not columns.keys() - {"time", "only"}:
        raise ValueError(
            f"columns: nothing but time is given; add signals ({', '.join(SIGNALS)}), as in"
            f" {_EXAMPLE}"
        )
    return columns


def _split(text: str, separator: str) -> list[str]:
    """Split a text at a separator that is outside quotes and brackets."""
    pieces, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter in "()[]":
            depth += 1 if letter in "([" else -1
        if letter == separator and depth == 0 and not quote:
            pieces.append("")
        else:
            pieces[-1] += letter
    return pieces
