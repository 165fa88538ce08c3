"""Reads and writes raw memory in functions that numba compiles: integer addresses become typed pointers."""

# ruff: noqa: ARG001, ARG005 - numba fixes the arguments

import ctypes
import functools
import inspect
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from codrl_mj.compile_cache import register_symbol

internal = functools.partial(
    numba.njit,
    forceinline=True,
    error_model="numpy",
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
)
"""`numba.njit` for what only compiled code calls: the ways in from Python, left out, take their time to compile.

Inlined, because numba hands over each number of a tuple by itself: to call with a drive's
parameters costs 31 copies.
"""


def emitted(signature: Callable[..., Any]) -> Callable[[Any], Any]:
    """Make a numba intrinsic of what it emits: (context, builder, signature, arguments) -> LLVM value.

    `signature` is a function of the types of its arguments.
    """

    def made(emit: Any) -> Any:
        def typed(typing_context: Any, *given: Any) -> Any:
            return signature(*given), emit

        named, own = (
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            inspect.signature(signature).parameters.values(),
        )
        typed.__signature__ = inspect.Signature([inspect.Parameter("context", named), *own])  # type: ignore[attr-defined]
        typed.__name__, typed.__doc__ = emit.__name__, emit.__doc__
        return intrinsic(typed)

    return made


def pointed(builder: Any, address: Any, kind: Any) -> Any:
    """An integer as a pointer to an LLVM type."""
    return builder.inttoptr(address, ir.PointerType(kind))


def _pointer(element: Any) -> Any:
    """An intrinsic that turns an integer address into a typed pointer."""

    @emitted(lambda address: types.CPointer(element)(types.uintp))
    def pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return pointed(builder, arguments[0], context.get_data_type(element))

    return pointer


f64, f32, i32, i64, u8, u64 = map(
    _pointer, (types.float64, types.float32, types.int32, types.int64, types.uint8, types.uint64)
)


def symbol(name: str, address: int) -> Any:
    """An intrinsic for an address of this process, which compiled code knows by a name."""
    name = register_symbol(name, address)

    @emitted(lambda: types.uintp())
    def at_symbol(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = builder.module.globals.get(name)
        place = known or ir.GlobalVariable(builder.module, ir.IntType(8), name)
        place.linkage = "external"
        return builder.ptrtoint(place, context.get_value_type(types.uintp))

    return at_symbol


@emitted(lambda function, *given: types.float64(types.uintp, types.Tuple(given)))
def call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Call a compiled C function by its address, with arguments of just its types; it returns a float64."""
    kinds = [context.get_value_type(kind) for kind in signature.args[1]]
    function = pointed(
        builder, arguments[0], ir.FunctionType(context.get_value_type(types.float64), kinds)
    )
    return builder.call(
        function, [builder.extract_value(arguments[1], at) for at in range(len(kinds))]
    )


@emitted(lambda pointer, entry: types.uintp(pointer, types.int64))
def at(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Address of an entry of what a typed pointer points to."""
    return builder.ptrtoint(
        builder.gep(arguments[0], [arguments[1]]), context.get_value_type(types.uintp)
    )


@emitted(lambda count: types.CPointer(types.float64)(types.int64))
def on_stack(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Typed pointer to so many float64 of no value, which end with the function that calls this."""
    return builder.alloca(context.get_value_type(types.float64), size=arguments[0])


@emitted(lambda target, source, count: types.void(types.uintp, types.uintp, types.int64))
def copy_bytes(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Copy so many bytes from address `source` to address `target`."""
    kind = ir.IntType(8).as_pointer()
    function = builder.module.declare_intrinsic("llvm.memcpy", [kind, kind, ir.IntType(64)])
    to, start = (builder.inttoptr(address, kind) for address in arguments[:2])
    builder.call(function, [to, start, arguments[2], ir.IntType(1)(0)])
    return context.get_dummy_value()


@emitted(lambda address, number: types.int64(types.uintp, types.int64))
def count_on(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Add a number to the int64 at an address, in one piece among threads; returns what was there before."""
    return builder.atomic_rmw(
        "add", pointed(builder, arguments[0], ir.IntType(64)), arguments[1], "seq_cst"
    )


@emitted(lambda address: types.int64(types.uintp))
def look(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """The int64 at an address, as other threads have left it."""
    return builder.load_atomic(pointed(builder, arguments[0], ir.IntType(64)), "seq_cst", 8)


@emitted(lambda address, kind: tuple_of(kind.instance_class)(types.uintp, kind))
def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """The named tuple of class `kind` whose entries are the float64 numbers from an address on."""
    made = signature.return_type
    pointer = pointed(builder, arguments[0], context.get_value_type(types.float64))
    places = (
        builder.gep(pointer, [context.get_constant(types.intp, at)]) for at in range(len(made))
    )
    return context.make_tuple(builder, made, [builder.load(place) for place in places])


@internal
def row_as(vector: Any, kind: Any) -> Any:
    """An array of float64 as the named tuple of a class that it begins with."""
    return read(vector.ctypes.data, kind)


def tuple_of(kind: type) -> Any:
    """Numba's type of a named tuple of float64."""
    return types.BaseTuple.from_types((types.float64,) * len(kind._fields), kind)  # type: ignore[attr-defined]


@functools.cache
def entries_type(size: int) -> Any:
    """A named tuple of so many entries, to `read` a row of an array with."""
    return namedtuple("Entries", [f"entry{at}" for at in range(size)])


@emitted(lambda values: types.UniTuple(types.float64, len(values))(values))
def floats(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """A tuple of numbers, of whatever types, as float64."""
    return context.make_tuple(
        builder, signature.return_type, _as_floats(context, builder, signature, arguments)
    )


@emitted(lambda values, address: types.void(values, types.uintp))
def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Write a tuple of numbers as float64 from an address on."""
    pointer = pointed(builder, arguments[1], context.get_value_type(types.float64))
    for at, value in enumerate(_as_floats(context, builder, signature, arguments)):
        builder.store(value, builder.gep(pointer, [context.get_constant(types.intp, at)]))
    return context.get_dummy_value()


def _as_floats(context: Any, builder: Any, signature: Any, arguments: Any) -> list[Any]:
    """The entries of the first argument, a tuple of numbers."""
    return [
        context.cast(builder, builder.extract_value(arguments[0], at), kind, types.float64)
        for at, kind in enumerate(signature.args[0])
    ]


def callback(function: Any, returned: Any = None, *more: Any) -> Any:
    """What MuJoCo's setters take for a compiled function of (mjModel, mjData) and `more`; it keeps that alive."""
    made: Any = ctypes.CFUNCTYPE(returned, ctypes.c_void_p, ctypes.c_void_p, *more)(
        function.address
    )
    made.owner = function
    return made
