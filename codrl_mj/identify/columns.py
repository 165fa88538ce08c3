"""Which columns of a file are which signals: `time=t:s,voltage=duty*vbus:V,current=-i:mA`. Nothing is guessed."""

import ast
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codrl_mj.fields import check_names
from codrl_mj.identify.log import SIGNALS

KINDS: dict[str, str | None] = {
    "time": "s",
    **SIGNALS,
    "only": "",
}  # what columns may be -> its SI unit; None: any
OPEN_UNIT = "UNIT"
"""Stands for the unit that a person has to fill in, in a proposal."""
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
"""Signal -> units that its columns often have."""
_EXAMPLE = "time=t:s,voltage=duty*vbus:V,current=i:A,position=q:rad"


def twos_complement(values: Any, bits: Any) -> Any:
    """Whole numbers that a register shows without their sign, with it: 65535 of 16 bits is -1."""
    whole = 2.0 ** float(bits)
    return (np.asarray(values) + whole / 2.0) % whole - whole / 2.0


def sign_magnitude(values: Any, bits: Any) -> Any:
    """Return whole numbers of which the highest bit is the sign, with it: 1324 of 11 bits is -300."""
    half = 2.0 ** (float(bits) - 1.0)
    return np.where(np.asarray(values) >= half, half - np.asarray(values), values)


FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "twos_complement": (2, twos_complement),
    "sign_magnitude": (2, sign_magnitude),
    "unwrap": (2, lambda values, period: np.unwrap(values, period=float(period))),
    "atan2": (2, np.arctan2),
    "abs": (1, np.abs),
    "sign": (1, np.sign),
    "sqrt": (1, np.sqrt),
}
"""What a formula may call -> number of arguments, function. A second one is a number, but of atan2."""
_Value = Callable[[Mapping[str, Any]], Any]
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}


@dataclasses.dataclass(frozen=True)
class Column:
    """A signal as a formula of a file's columns."""

    signal: str  # `time`, one of `SIGNALS`, or `only`: rows where it is 0 are left out
    # columns (one with spaces in quotes, column[0] of a list), numbers, `pi`, + - * / and
    # `FUNCTIONS`
    formula: str
    unit: (
        str | None
    )  # of the formula's value; None: SI, which only a formula of more than a name may leave out
    # of a voltage: whether it is the mean from its row to the next, not what holds from its row on
    mean: bool = False

    def __post_init__(self) -> None:
        """Validate, without a file."""
        check_names([self.signal], KINDS, "signal")
        bare = self._formula[2]
        kind = KINDS[self.signal]
        if self.unit == OPEN_UNIT:
            remedy = f"write the column's own, such as {EXAMPLES[self.signal]}"
            raise self._wrong(f"the unit is not filled in; {remedy}. The file does not state it")
        if self.unit is not None:
            self._quantity(1.0)
        elif kind and bare:
            remedy = f"write {self.signal}={self.formula}:{kind} if it is in {kind}"
            raise self._wrong(f"has no unit, must have one that is of {kind}; {remedy}")

    @property
    def text(self) -> str:
        """As it is written, for messages."""
        return f"{self.signal}={self.formula}" + (f":{self.unit}" if self.unit is not None else "")

    def _wrong(self, what: str) -> ValueError:
        return ValueError(f"columns: {self.text}: {what}")

    @property
    def names(self) -> set[str]:
        """The columns and constants that it reads."""
        return self._formula[1]

    def value(self, table: Mapping[str, Any]) -> Any:
        """The signal in SI, by a table of columns and constants."""
        for name in sorted(self.names - table.keys()):
            if width := sum(
                bool(re.fullmatch(re.escape(name) + r"\[\d+\]", known)) for known in table
            ):
                raise self._wrong(
                    f"{name} holds lists of {width} numbers; write the one you want, such as"
                    f" {name}[0]"
                )
        check_names(self.names, table, "column")
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._quantity(self._formula[0]({"pi": math.pi, **table}))

    @functools.cached_property
    def _formula(self) -> tuple[_Value, set[str], bool]:
        """Its value by a table, before the unit; the names that it reads; whether it is but a name or number."""
        try:
            body = ast.parse(self.formula.strip(), mode="eval").body
        except SyntaxError as error:
            raise ValueError(
                f"columns: {self.signal}={self.formula}: no formula ({error.msg}); write a column's"
                f" name, in quotes if it has spaces, as in {_EXAMPLE}"
            ) from None
        value, names = self._made(body)
        return value, names - {"pi"}, isinstance(body, ast.Name | ast.Constant | ast.Subscript)

    def _made(self, node: ast.AST) -> tuple[_Value, set[str]]:
        """A part of the formula: its value by a table, and the names that it reads."""
        match node:
            case ast.Constant(value=str(name)) | ast.Name(id=name):
                return lambda table: table[name], {name}
            case ast.Subscript(
                value=ast.Name() | ast.Attribute() | ast.Constant(value=str()) as column,
                slice=ast.Name() | ast.Attribute() | ast.Constant(value=int() | str()) as entry,
            ):
                parts = (
                    str(x.value) if isinstance(x, ast.Constant) else ast.unparse(x)
                    for x in (column, entry)
                )
                listed = "{}[{}]".format(*parts)
                return lambda table: table[listed], {listed}
            case ast.Constant(value=number):
                return lambda _: number, set()
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inner):
                value, names = self._made(inner)
                return (lambda table: -value(table)) if isinstance(sign, ast.USub) else value, names
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
                (one, names), (other, more), apply = (
                    self._made(left),
                    self._made(right),
                    _OPERATORS[type(operator)],
                )
                return lambda table: apply(one(table), other(table)), names | more
            case ast.Call(func=ast.Name(id=called), args=arguments, keywords=[]):
                check_names([called], FUNCTIONS, "function")
                needed, function = FUNCTIONS[called]
                if len(arguments) != needed:
                    raise self._wrong(f"{called} takes {needed} arguments, not {len(arguments)}")
                values, read = zip(*map(self._made, arguments), strict=True)
                if needed == 2 and called != "atan2" and read[1] - {"pi"}:
                    raise self._wrong(
                        f"the second argument of {called} must be a number, such as 16"
                    )
                return lambda table: function(*(one(table) for one in values)), set().union(*read)
        known = ", ".join(FUNCTIONS)
        raise self._wrong(
            f"{type(node).__name__} is not allowed; write names, numbers, + - * / and {known}"
        )

    def _quantity(self, value: Any) -> Any:
        """A value in SI."""
        kind, unit = KINDS[self.signal], self.unit
        if unit is None or (not kind and unit in ("", "1")):
            return value
        from codrl_mj.catalogue.units import to_si

        try:
            return to_si(value, unit, kind, self.signal)
        except ValueError as error:
            raise self._wrong(f"{error}; write {kind or '1'}, or another unit of that") from error


def parse_columns(given: str | Mapping[str, str]) -> dict[str, Column]:
    """Signal -> what it is made of."""
    if isinstance(given, str):
        pairs = [_split(entry, "=") for entry in _split(given, ",") if entry.strip()]
    else:
        pairs = [[name, text] for name, text in given.items()]
    found: dict[str, Column] = {}
    for pair in pairs:
        if len(pair) != 2:
            raise ValueError(
                f"columns: {'='.join(pair)!r}: must be signal=formula:unit, as in {_EXAMPLE}"
            )
        name, (formula, *unit) = pair[0].strip(), _split(pair[1], ":")
        if len(unit) > 1:
            raise ValueError(f"columns: {pair[1]!r}: has two colons; write formula:unit")
        if name in found:
            raise ValueError(f"columns: {name} is given twice, must be given once; leave one out")
        formula = formula.strip()
        mean = re.fullmatch(r"mean\((.*)\)", formula) if name == "voltage" else None
        found[name] = Column(
            name, mean[1] if mean else formula, unit[0].strip() if unit else None, mean is not None
        )
    if "time" not in found:
        raise ValueError(f"columns: there is no time; write for instance {_EXAMPLE}")
    if not found.keys() - {"time", "only"}:
        raise ValueError(
            f"columns: nothing but time is given; add signals ({', '.join(SIGNALS)}), as in"
            f" {_EXAMPLE}"
        )
    return found


def _split(text: str, separator: str) -> list[str]:
    """Split, but not within quotes or brackets."""
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
