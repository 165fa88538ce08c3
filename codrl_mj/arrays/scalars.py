"""Symbols, back ends and nested tuples: the values that the reader computes with.

The reader executes a function with symbols in place of numbers. A symbol is a `Scalar`. It has a
kind, and an operand that stands for it in a back end: in C the name of a variable, else an array.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, NoReturn, Protocol, TypeGuard, cast

import numpy as np

Kind = Literal["bool", "int", "float"]
"""Kind of a scalar. An int has 64 bits, a float is a double."""
_WIDENING: tuple[Kind, ...] = ("bool", "int", "float")
# Each back end represents a scalar in its own way, and the reader only passes it on.
Operand = Any
"""Scalar of a back end: the text of an expression, or an array."""


class UnsupportedError(ValueError):
    """The reader does not take a construct; the message has file, line, construct and remedy."""


class RefusedError(Exception):
    """A refused construct, before the reader adds file and line and raises `UnsupportedError`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scalar:
    """A number that is unknown while the source is read."""

    kind: Kind
    operand: Operand

    # Python code that is not read but executed, such as a property, would take every symbol for
    # true and every two symbols for different.
    def __bool__(self) -> bool:
        """Refuse: the value is unknown."""
        self._refuse()

    def __eq__(self, value: object) -> bool:
        """Refuse: the value is unknown."""
        self._refuse()

    __hash__ = object.__hash__
    __lt__ = __le__ = __gt__ = __ge__ = __eq__
    __add__ = __sub__ = __mul__ = __truediv__ = __radd__ = __rsub__ = __rmul__ = __eq__

    @staticmethod
    def _refuse() -> NoReturn:
        raise RefusedError("a number is used in Python code that is not read: use plain functions")


Number = Scalar | bool | int | float | np.generic
"""A symbol, or a number that is known while the source is read."""


class ScalarLoop(NamedTuple):
    """A loop over variables that are numbers."""

    initial: list[Operand]
    """Values of the variables before the loop."""
    kinds: list[Kind]
    """Kinds of the variables."""
    condition: Callable[[list[Operand]], Operand]
    """Function from the variables to a bool: another iteration follows."""
    body: Callable[[list[Operand]], list[Operand]]
    """Function from the variables to their values after an iteration."""
    iterations: int | None
    """Number of iterations; None if only the condition tells."""


class Replacement(NamedTuple):
    """Function of a back end that computes what a function of the source computes."""

    kinds: tuple[Kind, ...]
    """Kinds of the arguments."""
    result: Kind
    """Kind of the result."""
    function: Callable[..., Operand]
    """Function from operands to an operand."""


class ScalarBackend(Protocol):
    """Receiver of the scalar operations, branches and loops of a function."""

    @property
    def replacements(self) -> Mapping[Callable[..., object], Replacement]:
        """Functions of the source that are replaced instead of read."""

    def constant(self, value: float, kind: Kind) -> Operand:
        """Return a known number."""

    def operation(self, name: str, kind: Kind, *operands: Operand) -> Operand:
        """Return the result of an operation.

        Args:
            name: `add sub mul div floordiv mod pow shl shr and or xor`, `lt le gt ge eq ne`, `neg
                not abs min max`, `isinf isnan isfinite`, `floor ceil trunc rint`, or a function
                of `codrl_mj.arrays.functions.REAL_FUNCTIONS`.
            kind: kind of the operands, and of the result unless it is a comparison or a test.
            operands: the operands.
        """

    def convert(self, operand: Operand, old: Kind, new: Kind) -> Operand:
        """Return a scalar as another kind. A float is truncated; NaN becomes 0."""

    def branch(
        self,
        condition: Operand,
        then: Callable[[], list[Operand]],
        otherwise: Callable[[], list[Operand]],
        kinds: list[Kind],
    ) -> list[Operand]:
        """Return the results of one of two functions."""

    def loop(self, loop: ScalarLoop) -> list[Operand]:
        """Return the variables of a loop after its last iteration."""


class DryRun:
    """Back end without results: the reader uses it to find out kinds and structures."""

    replacements: Mapping[Callable[..., object], Replacement] = {}

    def constant(self, value: float, kind: Kind) -> None:
        """Return nothing."""

    def operation(self, name: str, kind: Kind, *operands: Operand) -> None:
        """Return nothing."""

    def convert(self, operand: Operand, old: Kind, new: Kind) -> None:
        """Return nothing."""

    def branch(
        self,
        condition: Operand,  # noqa: ARG002
        then: Callable[[], list[Operand]],  # noqa: ARG002
        otherwise: Callable[[], list[Operand]],  # noqa: ARG002
        kinds: list[Kind],
    ) -> list[Operand]:
        """Return nothing for each result; the reader has already read both functions."""
        return [None] * len(kinds)

    def loop(self, loop: ScalarLoop) -> list[Operand]:
        """Return nothing for each variable; the reader has already read condition and body."""
        return [None] * len(loop.kinds)


def is_number(value: object) -> TypeGuard[Number]:
    """Return True if a value is a known or an unknown number."""
    return isinstance(value, Scalar | bool | int | float | np.bool_ | np.integer | np.floating)


def kind_of(number: Number) -> Kind:
    """Return the kind of a number."""
    if isinstance(number, Scalar):
        return number.kind
    if isinstance(number, bool | np.bool_):
        return "bool"
    return "int" if isinstance(number, int | np.integer) else "float"


def widest(*kinds: Kind) -> Kind:
    """Return the kind that can represent numbers of all these kinds."""
    return max(kinds, key=_WIDENING.index)


def leaves(tree: object) -> list[Number]:
    """Return the numbers of a nested tuple in order; other values, such as functions, are none."""
    if is_number(tree):
        return [tree]
    return [leaf for branch in tree for leaf in leaves(branch)] if isinstance(tree, tuple) else []


def with_leaves(tree: object, numbers: Iterator[object]) -> object:
    """Return a nested tuple with its numbers replaced in order."""
    if is_number(tree):
        return next(numbers)
    if not isinstance(tree, tuple):
        return tree
    branches = [with_leaves(branch, numbers) for branch in tree]
    # A named tuple takes its entries as arguments, a tuple takes an iterable.
    make = cast(Callable[..., object], type(tree))
    return make(*branches) if hasattr(tree, "_fields") else tuple(branches)


def symbols(tree: object, kinds: Sequence[Kind], operands: Sequence[Operand]) -> object:
    """Return a nested tuple with its numbers replaced by symbols."""
    return with_leaves(tree, iter([Scalar(*pair) for pair in zip(kinds, operands, strict=True)]))


def kinds_of(tree: object) -> list[Kind]:
    """Return the kinds of the numbers of a nested tuple."""
    return [kind_of(number) for number in leaves(tree)]


def zeros_like(tree: object) -> object:
    """Return a nested tuple with zeros in place of its numbers."""
    zeros: dict[Kind, Number] = {"bool": False, "int": 0, "float": 0.0}
    return with_leaves(tree, iter([zeros[kind] for kind in kinds_of(tree)]))


def is_symbolic(value: object) -> bool:
    """Return True if a number in a value is unknown."""
    return any(isinstance(leaf, Scalar) for leaf in leaves(value))


def same_structure(left: object, right: object) -> bool:
    """Return True if two values differ in their numbers only."""
    if is_number(left) or is_number(right):
        return is_number(left) and is_number(right)
    if isinstance(left, tuple) and isinstance(right, tuple):
        return len(left) == len(right) and all(map(same_structure, left, right))
    return left is right or (type(left) is type(right) and bool(left == right))


def describe(value: object) -> str:
    """Return a description of a value's structure, for messages."""
    if is_number(value):
        return "a number"
    if isinstance(value, tuple):
        name = "a tuple" if type(value) is tuple else f"a {type(value).__name__}"
        return f"{name} of {len(value)}"
    return repr(value)


def to_kind(number: bool | int | float | np.generic, kind: Kind) -> float:
    """Return a known number as Python's own type of a kind."""
    if kind == "bool":
        return bool(number)
    return int(number) if kind == "int" else float(number)
