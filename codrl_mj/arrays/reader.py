"""Reader of a function's source: it executes the source with symbols in place of numbers.

Named tuples, function calls, keyword arguments, constants and modules vanish while the source is
executed. What remains are operations on scalars, branches and loops, which a back end receives:
see `codrl_mj.arrays.scalars.ScalarBackend`.
"""

import ast
import builtins
import collections
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import FunctionType, MethodType
from typing import TypeVar, cast

from codrl_mj.arrays.frames import (
    AFTER_LOOP,
    REFUSED,
    AfterLoop,
    Frame,
    Location,
    Range,
    Returned,
    refuse_assignments,
)
from codrl_mj.arrays.functions import Arithmetic, refuse_random
from codrl_mj.arrays.loops import LoopVariables
from codrl_mj.arrays.scalars import (
    DryRun,
    Kind,
    Number,
    Operand,
    RefusedError,
    Scalar,
    ScalarBackend,
    ScalarLoop,
    describe,
    is_number,
    kind_of,
    leaves,
    same_structure,
    symbols,
    widest,
    zeros_like,
)
from codrl_mj.arrays.syntax import assigned_names, contains, definition, stop_flag

Result = TypeVar("Result")
Thunk = Callable[[], object]
"""Function that reads one side of a condition."""
MAX_DEPTH = 25
"""Largest number of nested calls. More are taken for a recursion without an end."""
_COUNTER, _ITEM = "loop counter", "loop item"
"""Variables of loops. No name in the source has a space."""


class Reader(Arithmetic):
    """Executor of functions with symbols.

    Args:
        backend: receiver of the operations on symbols.
    """

    def __init__(self, backend: ScalarBackend) -> None:
        """Store the back end."""
        super().__init__(backend)
        self._depth = 0

    def read(
        self,
        function: object,
        arguments: tuple[object, ...],
        keywords: Mapping[str, object] | None = None,
    ) -> object:
        """Return the result of a function for arguments that contain symbols.

        Args:
            function: a function in plain Python or compiled by numba, a supported function of
                Python, `math` or numpy, or a named tuple.
            arguments: its arguments: nested tuples of numbers, or objects that are only passed on.
            keywords: its keyword arguments.

        Raises:
            RefusedError: the function itself is not supported.
            UnsupportedError: its source contains a construct that is not supported.
        """
        function, keywords = getattr(function, "py_func", function), keywords or {}
        refuse_random(function)
        if function is range:
            return Range.of(arguments)
        if isinstance(function, FunctionType):
            if function in self.backend.replacements:
                return self._replace(function, arguments, keywords)
            return self._read_source(function, arguments, keywords)
        owner = getattr(function, "__self__", None)
        is_tuple = isinstance(function, type) and hasattr(function, "_fields")
        # These methods of named tuples only arrange their arguments.
        if is_tuple or (
            hasattr(owner, "_fields") and getattr(function, "__name__", "") in ("_make", "_replace")
        ):
            return cast(Callable[..., object], function)(*arguments, **keywords)
        if isinstance(function, MethodType):
            return self.read(function.__func__, (owner, *arguments), keywords)
        return self.call(function, arguments, keywords)

    def _replace(
        self,
        function: FunctionType,
        arguments: tuple[object, ...],
        keywords: Mapping[str, object],
    ) -> Scalar:
        """Return the result of a function that the back end replaces."""
        replacement = self.backend.replacements[function]
        values = inspect.signature(function).bind(*arguments, **keywords).args
        operands = map(self.operand, values, replacement.kinds)
        return Scalar(replacement.result, replacement.function(*operands))

    def _read_source(
        self,
        function: FunctionType,
        arguments: tuple[object, ...],
        keywords: Mapping[str, object],
    ) -> object:
        """Return the result of a function from its source."""
        if self._depth >= MAX_DEPTH:
            raise RefusedError(f"{function.__name__} calls itself: use a loop")
        node = definition(function)
        bound = inspect.signature(function).bind(*arguments, **keywords)
        bound.apply_defaults()
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        closure = {name: cell.cell_contents for name, cell in cells}
        names = collections.ChainMap(closure, function.__globals__, vars(builtins))
        self._depth += 1
        try:
            returned = self.run(node.body, Frame(function, dict(bound.arguments), names))
        finally:
            self._depth -= 1
        return None if returned is None else returned.value

    # Statements

    def run(self, body: list[ast.stmt], frame: Frame) -> Returned | None:
        """Execute statements; return what they return, or None if they do not return."""
        for index, statement in enumerate(body):
            with Location(statement, frame):
                returned = self._statement(statement, body[index + 1 :], frame)
            if returned is not None:
                return returned
        return None

    def _statement(
        self, statement: ast.stmt, rest: list[ast.stmt], frame: Frame
    ) -> Returned | None:
        match statement:
            case ast.Return(value=value):
                return Returned(None if value is None else self.value(value, frame))
            case ast.If(test=test, body=then, orelse=otherwise):
                condition = self.truth(self.value(test, frame))
                if not isinstance(condition, Scalar):
                    return self.run(then if condition else otherwise, frame)
                if contains(statement, ast.Return):
                    return self._return_from(condition, statement, rest, frame)
                self._branch(condition, statement, frame)
            case ast.For(orelse=[]):
                self._for(statement, frame)
            case ast.While(orelse=[]):
                self._loop(statement, frame, None)
            case ast.For() | ast.While():
                raise RefusedError("else of a loop: use a flag")
            case ast.Assign(targets=targets, value=value):
                result = self.value(value, frame)
                for target in targets:
                    self.bind(target, result, frame)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self.bind(target, self.value(value, frame), frame)
            case ast.AugAssign(target=ast.Name(id=name) as target, op=op, value=value):
                before, change = self._variable(name, frame), self.value(value, frame)
                self.bind(target, self.binary(type(op), before, change), frame)
            case ast.AugAssign(target=target):
                self.bind(target, 0.0, frame)
            case ast.Expr(value=value):
                self.value(value, frame)
            case ast.Pass() | ast.AnnAssign():
                pass
            case _:
                raise RefusedError(REFUSED.get(type(statement), type(statement).__name__))
        return None

    def bind(self, target: ast.expr, value: object, frame: Frame) -> None:
        """Assign a value to a name, or the entries of a tuple to several."""
        match target:
            case ast.Name(id=name):
                frame.variables[name] = value
            case ast.Starred(value=inner):
                self.bind(inner, value, frame)
            case ast.Tuple(elts=targets) | ast.List(elts=targets):
                if not isinstance(value, tuple):
                    raise RefusedError(f"{describe(value)} is assigned to several names")
                entries: list[object] = list(value)
                stars = [k for k, inner in enumerate(targets) if isinstance(inner, ast.Starred)]
                for star in stars:
                    end = len(entries) - (len(targets) - star - 1)
                    entries[star:end] = [tuple(entries[star:end])]
                for inner, entry in zip(targets, entries, strict=True):
                    self.bind(inner, entry, frame)
            case ast.Subscript():
                raise RefusedError("an element is assigned: make a new tuple, or use several names")
            case _:
                raise RefusedError("an attribute is assigned: make a new tuple with _replace")

    def _return_from(
        self, condition: Scalar, statement: ast.If, rest: list[ast.stmt], frame: Frame
    ) -> Returned:
        """Return the result of a function that may return in a branch.

        The statements after the branch belong to each of its sides that does not return.
        """

        def side(body: list[ast.stmt]) -> object:
            returned = self.run([*body, *rest], frame.copy())
            if returned is None:
                raise RefusedError("a function returns in some cases only: return in all cases")
            return returned.value

        return Returned(
            self._select(condition, lambda: side(statement.body), lambda: side(statement.orelse))
        )

    def _branch(self, condition: Scalar, statement: ast.If, frame: Frame) -> None:
        """Execute both sides of a branch, and choose the values of the names that they assign."""

        def side(body: list[ast.stmt]) -> dict[str, object]:
            inner = frame.copy()
            self.run(body, inner)
            return inner.variables

        then, otherwise = self._dry_run(lambda: (side(statement.body), side(statement.orelse)))
        names = [name for name in assigned_names([statement]) if name in {**then, **otherwise}]
        # A name that only one side assigns is used only if that side ran. So on the other side it
        # may have any value.
        stand_ins = {name: zeros_like(then.get(name, otherwise.get(name))) for name in names}
        unusable = [
            name
            for name in names
            if isinstance(then.get(name), AfterLoop) or isinstance(otherwise.get(name), AfterLoop)
        ]

        def values(variables: Mapping[str, object]) -> tuple[object, ...]:
            return tuple(
                AFTER_LOOP if name in unusable else variables.get(name, stand_ins[name])
                for name in names
            )

        results = self._choose(
            condition,
            (values(then), values(otherwise)),
            lambda: values(side(statement.body)),
            lambda: values(side(statement.orelse)),
        )
        frame.variables.update(zip(names, cast(tuple[object, ...], results), strict=True))

    def _select(self, condition: Scalar, then: Thunk, otherwise: Thunk) -> object:
        """Return a structure whose numbers are chosen from two sides by a condition."""
        sides = self._dry_run(lambda: (then(), otherwise()))
        return self._choose(condition, sides, then, otherwise)

    def _choose(
        self, condition: Scalar, sides: tuple[object, object], then: Thunk, otherwise: Thunk
    ) -> object:
        """Let the back end choose between two sides, whose structures are known."""
        if not same_structure(*sides):
            raise RefusedError(
                f"the two sides of a condition are {describe(sides[0])} and {describe(sides[1])}:"
                " make them alike"
            )
        pairs = zip(leaves(sides[0]), leaves(sides[1]), strict=True)
        kinds = [widest(kind_of(left), kind_of(right)) for left, right in pairs]

        def operands(side: Thunk) -> Callable[[], list[Operand]]:
            return lambda: self._operands(leaves(side()), kinds)

        results = self.backend.branch(condition.operand, operands(then), operands(otherwise), kinds)
        return symbols(sides[0], kinds, results)

    def _operands(self, numbers: list[Number], kinds: list[Kind]) -> list[Operand]:
        return [self.operand(number, kind) for number, kind in zip(numbers, kinds, strict=True)]

    def _dry_run(self, thunk: Callable[[], Result]) -> Result:
        """Return the result of reading something without the back end, for kinds and structure."""
        backend, self.backend = self.backend, DryRun()
        try:
            return thunk()
        finally:
            self.backend = backend

    # Loops

    def _for(self, loop: ast.For, frame: Frame) -> None:
        """Execute a loop over a range, or over the entries of a tuple one by one."""
        items = self.value(loop.iter, frame)
        if isinstance(items, Range):
            self._loop(loop, frame, items)
            return
        if not isinstance(items, tuple):
            raise RefusedError(f"a loop over {describe(items)}: use a range or a tuple")
        stop = stop_flag(loop)
        for item in items:
            if stop is None:
                self.bind(loop.target, item, frame)
                self.run(loop.body, frame)
                continue
            # The iteration runs only if no earlier one has ended the loop.
            frame.variables[_ITEM] = item
            assignment = ast.Assign([loop.target], ast.Name(_ITEM, ast.Load()))
            test = ast.UnaryOp(ast.Not(), ast.Name(stop, ast.Load()))
            guarded = ast.copy_location(ast.If(test, [assignment, *loop.body], []), loop)
            self.run([ast.fix_missing_locations(guarded)], frame)

    def _loop(self, loop: ast.For | ast.While, frame: Frame, counter: Range | None) -> None:
        """Execute a loop whose number of iterations may be unknown.

        Args:
            loop: the loop.
            frame: function that contains it.
            counter: range of the loop; None for `while`.
        """
        if isinstance(loop, ast.While) and contains(loop.test, ast.NamedExpr):
            raise RefusedError("an assignment in a while condition: assign in the loop's body")
        iterations = None if counter is None or stop_flag(loop) else counter.iterations
        if iterations == 0:
            return
        target = loop.target if isinstance(loop, ast.For) else None
        hidden = [] if target is None else assigned_names([ast.Expr(target)])
        names = [name for name in assigned_names([loop]) if name not in hidden]
        variables = LoopVariables(names, frame.variables)
        if counter is not None:
            variables.initial[_COUNTER] = counter.start

        def condition(values: Mapping[str, object]) -> object:
            if isinstance(loop, ast.While):
                holds: object = self.truth(self.value(loop.test, frame.copy(values)))
            elif counter is not None:
                comparison = ast.Lt if counter.step > 0 else ast.Gt
                holds = self.compare(comparison, values[_COUNTER], counter.stop)
            stop = stop_flag(loop)
            return holds if stop is None else self.both(self.unary(ast.Not, values[stop]), holds)

        def body(values: Mapping[str, object]) -> Mapping[str, object]:
            inner = frame.copy(values)
            if counter is not None and target is not None:
                self.bind(target, values[_COUNTER], inner)
            self.run(loop.body, inner)
            if counter is not None:
                after = self.binary(ast.Add, values[_COUNTER], counter.step)
                inner.variables[_COUNTER] = after
            return inner.variables

        self._dry_run(lambda: variables.settle(condition, body))
        kinds = variables.all_kinds
        results = self.backend.loop(
            ScalarLoop(
                self._operands(variables.numbers(variables.initial), kinds),
                kinds,
                lambda operands: self.operand(condition(variables.symbols(operands)), "bool"),
                lambda operands: self._operands(
                    variables.numbers(body(variables.symbols(operands))), kinds
                ),
                iterations,
            )
        )
        frame.variables.update(variables.symbols(results))
        frame.variables.pop(_COUNTER, None)
        if target is not None:
            self.bind(target, AFTER_LOOP, frame)

    # Expressions

    def value(self, node: ast.expr, frame: Frame) -> object:
        """Return the value of an expression."""
        with Location(node, frame):
            return self._value(node, frame)

    def _value(self, node: ast.expr, frame: Frame) -> object:
        match node:
            case ast.Constant(value=constant):
                return constant
            case ast.Name(id=name):
                return self._variable(name, frame)
            case ast.Attribute(value=owner, attr=name):
                value = self.value(owner, frame)
                if is_number(value):
                    raise RefusedError(f"the attribute {name} of a number: use arithmetic")
                return getattr(value, name)
            case ast.Tuple(elts=nodes):
                return tuple(self._values(nodes, frame))
            case ast.Subscript(value=owner, slice=index):
                return self._element(self.value(owner, frame), index, frame)
            case ast.BinOp(left=left, op=op, right=right):
                return self.binary(type(op), self.value(left, frame), self.value(right, frame))
            case ast.UnaryOp(op=op, operand=operand):
                return self.unary(type(op), self.value(operand, frame))
            case ast.BoolOp():
                return self._bool_operation(node, frame)
            case ast.Compare():
                return self._comparison(node, frame)
            case ast.IfExp(test=test, body=then, orelse=otherwise):
                condition = self.truth(self.value(test, frame))
                if not isinstance(condition, Scalar):
                    return self.value(then if condition else otherwise, frame)
                refuse_assignments(then, otherwise)
                return self._select(
                    condition,
                    lambda: self.value(then, frame),
                    lambda: self.value(otherwise, frame),
                )
            case ast.NamedExpr(target=target, value=inner):
                result = self.value(inner, frame)
                self.bind(target, result, frame)
                return result
            case ast.Call(func=function, args=nodes, keywords=keywords):
                if any(keyword.arg is None for keyword in keywords):
                    raise RefusedError("keyword arguments from a mapping: write each of them")
                named = {str(word.arg): self.value(word.value, frame) for word in keywords}
                arguments = tuple(self._values(nodes, frame))
                return self.read(self.value(function, frame), arguments, named)
            case _:
                raise RefusedError(REFUSED.get(type(node), type(node).__name__))

    def _variable(self, name: str, frame: Frame) -> object:
        value = frame.variables.get(name, frame.names.get(name, Frame))
        if value is Frame:
            raise RefusedError(f"{name} has no value: assign it before it is used")
        if isinstance(value, AfterLoop):
            raise RefusedError(f"{name} is used after its loop: assign it to another name within")
        return value

    def _values(self, nodes: list[ast.expr], frame: Frame) -> Iterator[object]:
        """Yield the values of expressions; a starred one is a tuple, whose entries are yielded."""
        for node in nodes:
            if isinstance(node, ast.Starred):
                value = self.value(node.value, frame)
                if not isinstance(value, tuple):
                    raise RefusedError(f"* of {describe(value)}: must be of a tuple")
                yield from value
            else:
                yield self.value(node, frame)

    def _element(self, value: object, index_node: ast.expr, frame: Frame) -> object:
        """Return an element of a tuple, or a part of it."""
        if isinstance(index_node, ast.Slice):
            nodes = (index_node.lower, index_node.upper, index_node.step)
            bounds = [None if node is None else self.value(node, frame) for node in nodes]
            index: object = slice(*bounds)
        else:
            index = self.value(index_node, frame)
        if not isinstance(index, Scalar):
            if is_number(value):
                raise RefusedError("an element of a number: an array is not supported")
            return cast(tuple[object, ...], value)[cast(int, index)]
        if not isinstance(value, tuple):
            raise RefusedError(f"an element of {describe(value)}: make it a tuple")
        if index.kind == "float":
            raise RefusedError("a float as an index: convert it with int(...)")
        result: object = value[-1]
        for position in range(len(value) - 2, -1, -1):
            condition = self.operation("le", "bool", "int", index, position)
            result = self._select(
                condition,
                lambda position=position: value[position],  # type: ignore[misc]
                lambda result=result: result,  # type: ignore[misc]
            )
        return result

    def _bool_operation(self, node: ast.BoolOp, frame: Frame) -> object:
        """Return the result of `and` or `or`, which is one of the operands."""
        is_or = isinstance(node.op, ast.Or)
        result = self.value(node.values[0], frame)
        for right in node.values[1:]:
            condition = self.truth(result)
            if not isinstance(condition, Scalar):
                if condition is is_or:
                    return result
                result = self.value(right, frame)
                continue
            refuse_assignments(right)
            left = result

            def value(right: ast.expr = right) -> object:
                return self.value(right, frame)

            right_result = self._dry_run(value)
            # A call may contain a loop that ends only if the left operand allows the call.
            if _is_bool(left) and _is_bool(right_result) and not contains(right, ast.Call):
                name = "or" if is_or else "and"
                result = self.operation(name, "bool", "bool", left, value())
                continue
            unchanged = lambda left=left: left  # noqa: E731
            sides = (unchanged, value) if is_or else (value, unchanged)
            result = self._select(condition, *sides)
        return result

    def _comparison(self, node: ast.Compare, frame: Frame) -> object:
        """Return the result of a comparison, or of a chain such as `low <= value <= high`."""
        values = [self.value(operand, frame) for operand in (node.left, *node.comparators)]
        result: object = True
        for left, op, right in zip(values, node.ops, values[1:], strict=False):
            result = self.both(result, self.compare(type(op), left, right))
        return result


def _is_bool(value: object) -> bool:
    """Return True if a value is a known or an unknown bool."""
    return is_number(value) and kind_of(value) == "bool"
