"""Reads and writes raw memory in functions that numba compiles: integer addresses become typed pointers."""

import functools
from collections import namedtuple
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from codrl_mj.kept import linked

internal = functools.partial(numba.njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""`numba.njit` for what only compiled code calls: the ways in from Python, left out, take their time to compile."""


def _pointer(element: Any) -> Any:
    """A numba intrinsic that turns an integer address into a typed pointer."""

    @intrinsic
    def pointer(typing_context: Any, address: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
            return builder.inttoptr(arguments[0], ir.PointerType(context.get_data_type(element)))

        return types.CPointer(element)(types.uintp), codegen

    return pointer


def symbol(name: str, address: int) -> Any:
    """A numba intrinsic for an address of this process, which compiled code knows by a name."""
    name = linked(name, address)

    @intrinsic
    def at_symbol(typing_context: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
            known = builder.module.globals.get(name)
            place = known or ir.GlobalVariable(builder.module, ir.IntType(8), name)
            place.linkage = "external"
            return builder.ptrtoint(place, context.get_value_type(types.uintp))

        return types.uintp(), codegen

    return at_symbol


f64, i32, i64, u8, u64 = (
    _pointer(kind) for kind in (types.float64, types.int32, types.int64, types.uint8, types.uint64)
)


@intrinsic
def call_family(
    typing_context: Any,  # noqa: ARG001 - numba fixes the arguments
    function: Any,  # noqa: ARG001
    parameters: Any,  # noqa: ARG001
    timestep: Any,  # noqa: ARG001
    before: Any,  # noqa: ARG001
    after: Any,  # noqa: ARG001
    seen: Any,  # noqa: ARG001
    desired: Any,  # noqa: ARG001
    position: Any,  # noqa: ARG001
    speed: Any,  # noqa: ARG001
    time: Any,  # noqa: ARG001
    key: Any,  # noqa: ARG001
    inertia: Any,  # noqa: ARG001
) -> Any:
    """Call a family's compiled function (see `codrl_mj.engine.families`) by its address; returns the torque [N*m]."""
    address, number = types.uintp, types.float64
    return _call(address, number, address, address, address, *(number,) * 6)


@intrinsic
def call_inertia(
    typing_context: Any,  # noqa: ARG001 - numba fixes the arguments
    function: Any,  # noqa: ARG001
    model: Any,  # noqa: ARG001
    data: Any,  # noqa: ARG001
    output: Any,  # noqa: ARG001
    gear: Any,  # noqa: ARG001
) -> Any:
    """Call the compiled function of `codrl_mj.engine.inertia` by its address; returns the inertia [kg*m^2]."""
    return _call(types.uintp, types.uintp, types.int32, types.float64)


def _call(*kinds: Any) -> tuple[Any, Any]:
    """What an intrinsic returns that calls a C function of such arguments, which returns a float64, by its address."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        llvm = [context.get_value_type(kind) for kind in kinds]
        function_type = ir.FunctionType(context.get_value_type(types.float64), llvm)
        return builder.call(builder.inttoptr(arguments[0], function_type.as_pointer()), arguments[1:])

    return types.float64(types.uintp, *kinds), codegen


@intrinsic
def at(typing_context: Any, pointer: Any, entry: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """Address of an entry of what a typed pointer points to."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        return builder.ptrtoint(builder.gep(arguments[0], [arguments[1]]), context.get_value_type(types.uintp))

    return types.uintp(pointer, types.int64), codegen


@intrinsic
def on_stack(typing_context: Any, count: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """Typed pointer to so many float64 of no value, which end with the function that calls this."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        return builder.alloca(context.get_value_type(types.float64), size=arguments[0])

    return types.CPointer(types.float64)(types.int64), codegen


@intrinsic
def copy_bytes(typing_context: Any, target: Any, source: Any, count: Any) -> Any:  # noqa: ARG001 - numba fixes them
    """Copy so many bytes from address `source` to address `target`."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        kind = ir.IntType(8).as_pointer()
        function = builder.module.declare_intrinsic("llvm.memcpy", [kind, kind, ir.IntType(64)])
        to, start = (builder.inttoptr(address, kind) for address in arguments[:2])
        builder.call(function, [to, start, arguments[2], ir.IntType(1)(0)])
        return context.get_dummy_value()

    return types.void(types.uintp, types.uintp, types.int64), codegen


@intrinsic
def count_on(typing_context: Any, address: Any, number: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """Add a number to the int64 at an address, in one piece among threads; returns what was there before."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        pointer = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", pointer, arguments[1], "seq_cst")

    return types.int64(types.uintp, types.int64), codegen


@intrinsic
def read(typing_context: Any, address: Any, kind: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """The named tuple of class `kind` whose entries are the float64 numbers from an address on."""
    made = tuple_of(kind.instance_class)

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        pointer = builder.inttoptr(arguments[0], ir.PointerType(context.get_value_type(types.float64)))
        places = (builder.gep(pointer, [context.get_constant(types.intp, at)]) for at in range(len(made)))
        return context.make_tuple(builder, made, [builder.load(place) for place in places])

    return made(types.uintp, kind), codegen


def tuple_of(kind: type) -> Any:
    """Numba's type of a named tuple of float64."""
    return types.BaseTuple.from_types((types.float64,) * len(kind._fields), kind)  # type: ignore[attr-defined]


@functools.cache
def entries_type(size: int) -> Any:
    """A named tuple of so many entries, to `read` a row of an array with."""
    return namedtuple("Entries", [f"entry{at}" for at in range(size)])


@intrinsic
def floats(typing_context: Any, values: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """A tuple of numbers, of whatever types, as float64."""
    made = types.UniTuple(types.float64, len(values))

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        parts = [
            context.cast(builder, builder.extract_value(arguments[0], at), kind, types.float64)
            for at, kind in enumerate(values)
        ]
        return context.make_tuple(builder, made, parts)

    return made(values), codegen


@intrinsic
def write(typing_context: Any, values: Any, address: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
    """Write a tuple of numbers as float64 from an address on."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        pointer = builder.inttoptr(arguments[1], ir.PointerType(context.get_value_type(types.float64)))
        for at, kind in enumerate(values):
            value = context.cast(builder, builder.extract_value(arguments[0], at), kind, types.float64)
            builder.store(value, builder.gep(pointer, [context.get_constant(types.intp, at)]))
        return context.get_dummy_value()

    return types.void(values, types.uintp), codegen
