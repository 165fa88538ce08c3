"""Parts of the reader: frames, locations of errors, and the constructs that it refuses."""

import ast
import dataclasses
from collections.abc import Mapping
from types import FunctionType, TracebackType
from typing import NamedTuple, cast

from codrl_mj.arrays.scalars import (
    RefusedError,
    UnsupportedError,
    is_number,
    is_symbolic,
    kind_of,
)
from codrl_mj.user_code import source_location

REFUSED: Mapping[type[ast.AST], str] = {
    ast.List: "a list: use a tuple",
    ast.ListComp: "a list comprehension: use a loop, or write a tuple",
    ast.GeneratorExp: "a generator: use a loop, or write a tuple",
    ast.Dict: "a dictionary: use a named tuple",
    ast.DictComp: "a dictionary: use a named tuple",
    ast.Set: "a set: use a tuple",
    ast.SetComp: "a set: use a tuple",
    ast.JoinedStr: "a formatted string: advance computes with numbers only",
    ast.Lambda: "a lambda: define a function with def outside of this function",
    ast.FunctionDef: "a function in a function: define it outside of this function",
    ast.ClassDef: "a class in a function: define it outside of this function",
    ast.Import: "an import in a function: import at the top of the file",
    ast.ImportFrom: "an import in a function: import at the top of the file",
    ast.Raise: "raise: check fields in the dataclass, and limit values with min and max",
    ast.Assert: "assert: check fields in the dataclass, and limit values with min and max",
    ast.Try: "try: avoid the error with a condition",
    ast.With: "with: advance computes with numbers only",
    ast.Match: "match: use if and elif",
    ast.Global: "global: keep the value in the State",
    ast.Nonlocal: "nonlocal: keep the value in the State",
    ast.Delete: "del: leave it out",
    ast.Yield: "yield: use return",
    ast.YieldFrom: "yield: use return",
    ast.Await: "await: advance computes with numbers only",
}
"""Constructs that the reader does not take, each with a remedy."""


class AfterLoop:
    """Placeholder for the variable of a loop after the loop, where its value may be unknown."""


AFTER_LOOP = AfterLoop()
"""The only placeholder."""


class Returned(NamedTuple):
    """Value that a function has returned."""

    value: object


@dataclasses.dataclass(frozen=True)
class Range:
    """Arguments of `range`."""

    start: object
    stop: object
    step: int

    @property
    def iterations(self) -> int | None:
        """Number of iterations; None if start or stop is unknown."""
        if is_symbolic(self.start) or is_symbolic(self.stop):
            return None
        return len(range(cast(int, self.start), cast(int, self.stop), self.step))

    @classmethod
    def of(cls, arguments: tuple[object, ...]) -> "Range":
        """Return the range with the arguments of Python's `range`.

        Raises:
            RefusedError: an argument is not an int, or the step is unknown.
        """
        if not all(is_number(value) and kind_of(value) != "float" for value in arguments):
            raise RefusedError("range of a float: convert it with int(...)")
        start, stop, step = (0, *arguments, 1) if len(arguments) == 1 else (*arguments, 1)[:3]
        if is_symbolic(step):
            raise RefusedError("a range with an unknown step: use a while loop")
        return cls(start, stop, cast(int, step))


@dataclasses.dataclass
class Frame:
    """A function that is being read."""

    function: FunctionType
    variables: dict[str, object]
    names: Mapping[str, object]
    """Names from outside the function: of its closure, its module and Python."""

    def copy(self, changes: Mapping[str, object] = {}) -> "Frame":
        """Return a frame with its own variables, some of them changed."""
        return Frame(self.function, {**self.variables, **changes}, self.names)


class Location:
    """Context that adds the file and the line of a node to errors.

    Args:
        node: statement or expression.
        frame: function that contains it.
    """

    def __init__(self, node: ast.stmt | ast.expr, frame: Frame) -> None:
        """Store node and frame."""
        self.node, self.frame = node, frame

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Raise an error with the location, unless the error already has one.

        Raises:
            UnsupportedError: with the location and the message of the error.
        """
        # Python's own errors are mistakes in the source, such as an attribute that does not exist.
        mistakes = (RefusedError, AttributeError, TypeError, ValueError, LookupError)
        if not isinstance(error, mistakes) or isinstance(error, UnsupportedError):
            return
        text = f"{error}" if isinstance(error, RefusedError) else f"{type(error).__name__}: {error}"
        location = source_location(self.frame.function, self.node.lineno)
        raise UnsupportedError(f"{location}: {text}") from error


def refuse_assignments(*nodes: ast.expr) -> None:
    """Raise if an expression that does not always run assigns a name.

    Raises:
        RefusedError: it contains `:=`.
    """
    if any(isinstance(inner, ast.NamedExpr) for node in nodes for inner in ast.walk(node)):
        raise RefusedError(":= in a condition that may not run: assign in a statement before it")
