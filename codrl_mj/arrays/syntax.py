"""Source of a function as a syntax tree, in which loops have no `break`, `continue` or `return`.

A back end has loops with a condition only. So a jump becomes a flag: statements after it run only
if the flag is not set, and the loop ends if it is.
"""

import ast
import functools
import inspect
import textwrap
from collections.abc import Iterator
from types import FunctionType
from typing import NamedTuple

from codrl_mj.arrays.scalars import RefusedError

STOPPED = "stopped_by"
"""Attribute of a loop's node: the name of the flag that ends the loop."""


@functools.cache
def definition(function: FunctionType) -> ast.FunctionDef:
    """Return the syntax tree of a function, with the line numbers of its file and without jumps.

    Raises:
        RefusedError: the function has no source, or was not made by `def` without decorators.
    """
    name = function.__name__
    if hasattr(function, "__wrapped__"):
        raise RefusedError(f"{name} has a decorator: call a plain function")
    try:
        lines, first_line = inspect.getsourcelines(function)
        tree = ast.parse(textwrap.dedent("".join(lines)))
    except (OSError, SyntaxError):
        raise RefusedError(f"{name} has no source: define it in a file, with `def`") from None
    ast.increment_lineno(tree, first_line - 1)
    node = tree.body[0]
    # The source of a lambda is the statement that contains it.
    if not isinstance(node, ast.FunctionDef) or node.name != name:
        raise RefusedError(f"{name} is a lambda: define the function with `def`")
    if [decorator for decorator in node.decorator_list if not _is_harmless(decorator)]:
        raise RefusedError(f"{name} has a decorator: call a plain function")
    node.body = [statement for old in node.body for statement in _WithoutJumps().rewrite(old)]
    return ast.fix_missing_locations(node)


def _is_harmless(decorator: ast.expr) -> bool:
    """Return True for decorators that do not change what a function computes."""
    name = ast.unparse(decorator).partition("(")[0].rpartition(".")[2]
    return name in ("staticmethod", "njit", "jit", "register_jitable")


class _Flags(NamedTuple):
    """Names of the variables that replace the jumps of a loop."""

    stop: str
    """Flag: the loop has ended."""
    skip: str
    """Flag: the rest of the iteration is skipped."""
    returned: str
    """Flag: the function has returned."""
    result: str
    """Value that the function has returned."""


class _WithoutJumps(ast.NodeTransformer):
    """Transformer that replaces the jumps of all loops by flags, the innermost loops first."""

    def rewrite(self, statement: ast.stmt) -> list[ast.stmt]:
        """Return the statements that replace a statement."""
        result = self.visit(statement)
        return result if isinstance(result, list) else [result]

    def visit_For(self, node: ast.For) -> ast.stmt | list[ast.stmt]:
        """Return a loop without jumps, and statements around it."""
        return self._rewrite_loop(node)

    def visit_While(self, node: ast.While) -> ast.stmt | list[ast.stmt]:
        """Return a loop without jumps, and statements around it."""
        return self._rewrite_loop(node)

    def _rewrite_loop(self, node: ast.For | ast.While) -> ast.stmt | list[ast.stmt]:
        self.generic_visit(node)
        jumps = {type(jump) for jump in _jumps(node.body)}
        if not jumps:
            return node
        # No name in the source has a space, and no other loop begins in the same line.
        flags = _Flags(*(f"{name} {node.lineno}" for name in _Flags._fields))
        node.body = [_assign(flags.skip, False, node), *_flagged(node.body, flags)]
        setattr(node, STOPPED, flags.stop)
        before: list[ast.stmt] = [_assign(flags.stop, False, node)]
        if ast.Return not in jumps:
            return [*before, node]
        before.append(_assign(flags.returned, False, node))
        after = ast.If(_name(flags.returned), [ast.Return(_name(flags.result))], [])
        return [*before, node, _located(after, node)]


def _flagged(body: list[ast.stmt], flags: _Flags) -> list[ast.stmt]:
    """Return statements in which jumps set flags and the rest runs only without a jump."""
    statements: list[ast.stmt] = []
    for index, statement in enumerate(body):
        if isinstance(statement, ast.Break | ast.Continue | ast.Return):
            return [*statements, *_jump(statement, flags)]
        statements.append(statement)
        if isinstance(statement, ast.If) and any(_jumps([statement])):
            statement.body = _flagged(statement.body, flags)
            statement.orelse = _flagged(statement.orelse, flags)
            if rest := _flagged(body[index + 1 :], flags):
                unless_skipped = ast.If(ast.UnaryOp(ast.Not(), _name(flags.skip)), rest, [])
                statements.append(_located(unless_skipped, statement))
            return statements
    return statements


def _jump(statement: ast.Break | ast.Continue | ast.Return, flags: _Flags) -> list[ast.stmt]:
    """Return the assignments that replace a jump."""
    assignments = [_assign(flags.skip, True, statement)]
    if not isinstance(statement, ast.Continue):
        assignments.append(_assign(flags.stop, True, statement))
    if isinstance(statement, ast.Return):
        value = statement.value or ast.Constant(None)
        result = ast.Assign([ast.Name(flags.result, ast.Store())], value)
        assignments += [_assign(flags.returned, True, statement), _located(result, statement)]
    return assignments


def _jumps(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the jumps of a loop; those of inner loops have already been replaced."""
    for statement in body:
        if isinstance(statement, ast.Break | ast.Continue | ast.Return):
            yield statement
        elif isinstance(statement, ast.If):
            yield from _jumps([*statement.body, *statement.orelse])


def _name(name: str) -> ast.expr:
    return ast.Name(name, ast.Load())


def _assign(name: str, value: bool, near: ast.stmt) -> ast.stmt:
    """Return an assignment of a constant, on the line of another statement."""
    return _located(ast.Assign([ast.Name(name, ast.Store())], ast.Constant(value)), near)


def _located(node: ast.stmt, near: ast.stmt) -> ast.stmt:
    """Return a statement on the line of another one."""
    return ast.fix_missing_locations(ast.copy_location(node, near))


def stop_flag(loop: ast.For | ast.While) -> str | None:
    """Return the name of the flag that ends a loop, or None if the loop has no jumps."""
    flag: str | None = getattr(loop, STOPPED, None)
    return flag


def assigned_names(body: list[ast.stmt]) -> list[str]:
    """Return the names that statements assign, in the order of their first use."""
    nodes = [node for part in body for node in ast.walk(part) if isinstance(node, ast.Name)]
    stored = {node.id for node in nodes if isinstance(node.ctx, ast.Store)}
    return [name for name in dict.fromkeys(node.id for node in nodes) if name in stored]


def contains(node: ast.AST, *kinds: type[ast.AST]) -> bool:
    """Return True if a node of one of these kinds is in a syntax tree."""
    return any(isinstance(inner, kinds) for inner in ast.walk(node))
