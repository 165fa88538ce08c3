"""Python's operators, its built-in functions and those of `math` and numpy, on symbols.

Operations on known numbers are computed at once. If all arguments of a function are known, Python's
own function is called.
"""

import ast
import functools
import operator
from collections.abc import Callable, Mapping
from typing import cast

import numpy as np

from codrl_mj.arrays.scalars import (
    Kind,
    Number,
    Operand,
    RefusedError,
    Scalar,
    ScalarBackend,
    describe,
    is_number,
    is_symbolic,
    kind_of,
    to_kind,
    widest,
)

BINARY: dict[type[ast.operator], tuple[str, Callable[..., object]]] = {
    ast.Add: ("add", operator.add),
    ast.Sub: ("sub", operator.sub),
    ast.Mult: ("mul", operator.mul),
    ast.Div: ("div", operator.truediv),
    ast.FloorDiv: ("floordiv", operator.floordiv),
    ast.Mod: ("mod", operator.mod),
    ast.Pow: ("pow", operator.pow),
    ast.LShift: ("shl", operator.lshift),
    ast.RShift: ("shr", operator.rshift),
    ast.BitAnd: ("and", operator.and_),
    ast.BitOr: ("or", operator.or_),
    ast.BitXor: ("xor", operator.xor),
}
"""Operators -> names of the operation, and Python's functions."""
COMPARISONS: dict[type[ast.cmpop], tuple[str, Callable[..., object]]] = {
    ast.Lt: ("lt", operator.lt),
    ast.LtE: ("le", operator.le),
    ast.Gt: ("gt", operator.gt),
    ast.GtE: ("ge", operator.ge),
    ast.Eq: ("eq", operator.eq),
    ast.NotEq: ("ne", operator.ne),
}
"""Comparisons -> names of the operation, and Python's functions."""
UNARY: dict[type[ast.unaryop], Callable[..., object]] = {
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
    ast.Invert: operator.inv,
}
"""Operators -> Python's functions."""
_BITWISE = ("shl", "shr", "and", "or", "xor")

REAL_FUNCTIONS = (
    *("exp", "expm1", "log", "log1p", "log2", "log10", "sqrt", "sin", "cos", "tan", "asin"),
    *("acos", "atan", "atan2", "sinh", "cosh", "tanh", "hypot", "pow", "fmod", "copysign"),
)
"""Functions of `math` from floats to a float, under their names in C."""
_NAMES_IN_NUMPY = {
    "arcsin": "asin",
    "arccos": "acos",
    "arctan": "atan",
    "arctan2": "atan2",
    "power": "pow",
    "float_power": "pow",
}
_TESTS = ("isinf", "isnan", "isfinite")
_ROUNDINGS = ("floor", "ceil", "trunc", "rint")


class Arithmetic:
    """Python's operators and functions on known and unknown numbers.

    Args:
        backend: receiver of the operations on unknown numbers.
    """

    def __init__(self, backend: ScalarBackend) -> None:
        """Store the back end."""
        self.backend = backend

    def operand(self, value: object, kind: Kind) -> Operand:
        """Return a number as the back end represents it.

        Raises:
            RefusedError: the value is not a number.
        """
        if not is_number(value):
            raise RefusedError(f"{describe(value)} is used as a number")
        if not isinstance(value, Scalar):
            return self.backend.constant(to_kind(value, kind), kind)
        if value.kind == kind:
            return value.operand
        return self.backend.convert(value.operand, value.kind, kind)

    def operation(self, name: str, result: Kind, kind: Kind, *values: object) -> Scalar:
        """Return the result of an operation on numbers that are first converted to a kind."""
        operands = [self.operand(value, kind) for value in values]
        return Scalar(result, self.backend.operation(name, kind, *operands))

    def to_int(self, value: object, rounding: str = "trunc") -> Scalar:
        """Return a number rounded to an int."""
        if kind_of(cast(Number, value)) != "float":
            return Scalar("int", self.operand(value, "int"))
        rounded = self.operation(rounding, "float", "float", value)
        return Scalar("int", self.backend.convert(rounded.operand, "float", "int"))

    def binary(self, kind: type[ast.operator], left: object, right: object) -> object:
        """Return the result of a binary operator.

        Raises:
            RefusedError: an operand is not a number, or has the wrong kind.
        """
        if kind not in BINARY:
            raise RefusedError(f"the operator {kind.__name__}: not supported")
        name, function = BINARY[kind]
        if not (is_symbolic(left) or is_symbolic(right)):
            return _compute(function, left, right)
        # `+` of two tuples joins them.
        if isinstance(left, tuple) and isinstance(right, tuple) and name == "add":
            return left + right
        if not (is_number(left) and is_number(right)):
            raise RefusedError(
                f"{name} of {describe(left)} and {describe(right)}: both must be numbers"
            )
        common = widest("int", kind_of(left), kind_of(right))
        if name in _BITWISE:
            if common == "float":
                raise RefusedError(f"bitwise {name} of a float: convert it with int(...)")
            return self.operation(name, common, common, left, right)
        if name == "pow" and not isinstance(right, Scalar) and right == 2:
            # numba compiles a square to a product, which is exact to the last bit.
            return self.operation("mul", common, common, left, left)
        if name in ("div", "pow"):
            common = "float"
        return self.operation(name, common, common, left, right)

    def compare(self, kind: type[ast.cmpop], left: object, right: object) -> object:
        """Return the result of a comparison.

        Raises:
            RefusedError: an operand is not a number, or the comparison is not supported.
        """
        if issubclass(kind, ast.Is | ast.IsNot):
            # A symbol is a number, and never None or another object.
            return (left is right) == issubclass(kind, ast.Is)
        if kind not in COMPARISONS:
            raise RefusedError("the operator `in`: compare with each number instead")
        name, function = COMPARISONS[kind]
        if not (is_symbolic(left) or is_symbolic(right)):
            return _compute(function, left, right)
        if not (is_number(left) and is_number(right)):
            raise RefusedError(
                f"{describe(left)} compared with {describe(right)}: compare numbers only"
            )
        return self.operation(
            name, "bool", widest("int", kind_of(left), kind_of(right)), left, right
        )

    def unary(self, kind: type[ast.unaryop], value: object) -> object:
        """Return the result of a unary operator on a number."""
        if not is_symbolic(value):
            return _compute(UNARY[kind], value)
        if kind is ast.Not:
            truth = self.truth(value)
            if not isinstance(truth, Scalar):
                return not truth
            return self.operation("not", "bool", "bool", truth)
        if not isinstance(value, Scalar):
            raise RefusedError(f"{describe(value)} is used as a number")
        common = widest("int", value.kind)
        if kind is ast.Invert:
            if common == "float":
                raise RefusedError("~ of a float: convert it with int(...)")
            return self.operation("xor", "int", "int", value, -1)
        if kind is ast.UAdd:
            return Scalar(common, self.operand(value, common))
        return self.operation("neg", common, common, value)

    def truth(self, value: object) -> bool | Scalar:
        """Return whether a value counts as true; an unknown number becomes an unknown bool."""
        if not isinstance(value, Scalar):
            return bool(value)
        return value if value.kind == "bool" else self.operation("ne", "bool", value.kind, value, 0)

    def both(self, left: object, right: object) -> object:
        """Return `left and right` of two bools."""
        if not isinstance(left, Scalar):
            return right if left else left
        if not isinstance(right, Scalar):
            return left if right else right
        return self.operation("and", "bool", "bool", left, right)

    def call(
        self, function: object, arguments: tuple[object, ...], keywords: Mapping[str, object]
    ) -> object:
        """Return the result of a built-in function, or of one of `math` or numpy.

        Raises:
            RefusedError: the function is not supported, or not for unknown numbers.
        """
        if not is_supported(function):
            raise RefusedError(
                f"{_name(function)} is not supported: use arithmetic, functions of math, and your"
                " own functions made of these"
            )
        python_function = cast(Callable[..., object], function)
        if function in _ON_TUPLES:
            return _compute(lambda: python_function(*arguments, **keywords))
        if keywords:
            raise RefusedError(f"keyword arguments of {_name(function)}: pass them by position")
        if not any(map(is_symbolic, arguments)):
            return _compute(python_function, *arguments)
        values = arguments
        if function in (min, max, sum) and len(arguments) == 1:
            values = cast(tuple[object, ...], arguments[0])
        if not all(map(is_number, values)):
            raise RefusedError(f"{_name(function)}: takes numbers, or one tuple of numbers")
        if function is sum:
            return functools.reduce(functools.partial(self.binary, ast.Add), values)
        if function in (min, max, np.minimum, np.maximum):
            return self._extremum(_name(function)[:3], values)
        return self._numeric(function, values)

    def _extremum(self, name: str, values: tuple[object, ...]) -> object:
        """Return the smallest or the largest of some numbers; Python's order decides about NaN."""
        result = values[0]
        for value in values[1:]:
            kind = widest("int", kind_of(cast(Number, value)), kind_of(cast(Number, result)))
            result = self.operation(name, kind, kind, result, value)
        return result

    def _numeric(self, function: object, values: tuple[object, ...]) -> object:
        """Return the result of a function of one or two numbers."""
        name = _name(function)
        name = _NAMES_IN_NUMPY.get(name, name)
        if function is float or name == "float64":
            return Scalar("float", self.operand(values[0], "float"))
        if function is bool:
            return self.truth(values[0])
        if function is round and len(values) > 1:
            raise RefusedError("round to digits: multiply, round and divide instead")
        if function is round:
            return self.to_int(values[0], "rint")
        if function is int:
            return self.to_int(values[0])
        if function is pow:
            return self.binary(ast.Pow, *values)
        if name in _ROUNDINGS:
            # Functions of `math` return an int, numpy's a float.
            if not isinstance(function, np.ufunc):
                return self.to_int(values[0], name)
            return self.operation(name, "float", "float", values[0])
        if name in ("abs", "absolute", "fabs"):
            kind = "float" if name == "fabs" else widest("int", kind_of(cast(Number, values[0])))
            return self.operation("abs", kind, kind, values[0])
        return self.operation(name, "bool" if name in _TESTS else "float", "float", *values)


_ON_TUPLES = (len, tuple, enumerate, zip, reversed)
"""Functions that only arrange the entries of tuples."""
_BUILT_IN = (*_ON_TUPLES, min, max, sum, abs, int, float, bool, round, pow, np.float64)
_OF_MATH = {*REAL_FUNCTIONS, *_TESTS, *_ROUNDINGS, *_NAMES_IN_NUMPY, "fabs", "absolute"}


def is_supported(function: object) -> bool:
    """Return True if `Arithmetic.call` takes a function."""
    if isinstance(function, np.ufunc):
        return function in (np.minimum, np.maximum) or _name(function) in _OF_MATH
    if getattr(function, "__module__", None) == "math":
        return _name(function) in _OF_MATH
    return any(function is supported for supported in _BUILT_IN)


def _name(function: object) -> str:
    return str(getattr(function, "__name__", function))


def refuse_random(function: object) -> None:
    """Raise if a function draws random numbers, which the same state would not repeat.

    Raises:
        RefusedError: with a remedy.
    """
    owner = type(getattr(function, "__self__", None))
    modules = f"{getattr(function, '__module__', '')} {owner.__module__}".split()
    if any(module.removeprefix("numpy.").partition(".")[0] == "random" for module in modules):
        raise RefusedError(
            f"{_name(function)} draws random numbers: use codrl_mj.actuators.noise.standard_normal"
        )


def _compute(function: Callable[..., object], *arguments: object) -> object:
    """Return the result of a function of known numbers, with NaN and infinity instead of errors.

    The function may be in a branch that never runs with these numbers, so an error in the
    mathematical sense is none in the source.
    """
    try:
        with np.errstate(all="ignore"):
            result = function(*arguments)
    except (ValueError, OverflowError, ZeroDivisionError):
        result = _compute_ieee(function, *arguments)
    if isinstance(result, enumerate | zip | reversed):
        return tuple(result)
    if not (is_number(result) or isinstance(result, tuple | range)):
        raise RefusedError(f"{_name(function)} returns {describe(result)}: must be a number")
    return result


def _compute_ieee(function: Callable[..., object], *arguments: object) -> object:
    """Return the result by numpy's rules, under which a division by 0 is infinite."""
    name = _name(function)
    array_names = {value: key for key, value in _NAMES_IN_NUMPY.items()}
    array_function = getattr(
        np, {"truediv": "true_divide"}.get(name, array_names.get(name, name)), None
    )
    if array_function is None or not all(map(is_number, arguments)):
        raise RefusedError(f"{name} of these numbers is not defined")
    with np.errstate(all="ignore"):
        return float(array_function(*(np.float64(cast(float, argument)) for argument in arguments)))
