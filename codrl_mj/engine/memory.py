"""Raw memory access in functions that numba compiles: integer addresses become typed pointers."""

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
"""`numba.njit` for functions that only compiled code calls.

They have no entry points for Python, which take time to compile. They are inlined because numba
passes each entry of a tuple as an argument: a call with a drive's parameters would copy 31 numbers.
"""


def llvm_intrinsic(signature: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return a decorator for code generators (context, builder, signature, arguments).

    Args:
        signature: a function of the argument types that returns numba's signature.
    """

    def decorate(generate: Any) -> Any:
        def typed(typing_context: Any, *argument_types: Any) -> Any:
            return signature(*argument_types), generate

        # numba binds an intrinsic's arguments by the names in its signature, the typing context
        # first.
        kind, rest = (
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            inspect.signature(signature).parameters.values(),
        )
        typed.__signature__ = inspect.Signature([inspect.Parameter("context", kind), *rest])  # type: ignore[attr-defined]
        typed.__name__, typed.__doc__ = generate.__name__, generate.__doc__
        return intrinsic(typed)

    return decorate


def to_pointer(builder: Any, address: Any, kind: Any) -> Any:
    """Convert an integer to a pointer to an LLVM type."""
    return builder.inttoptr(address, ir.PointerType(kind))


def _pointer(element: Any) -> Any:
    """Return an intrinsic that turns an integer address into a typed pointer."""

    @llvm_intrinsic(lambda address: types.CPointer(element)(types.uintp))
    def pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return to_pointer(builder, arguments[0], context.get_data_type(element))

    return pointer


f64, f32, i32, i64, u8, u64 = map(
    _pointer, (types.float64, types.float32, types.int32, types.int64, types.uint8, types.uint64)
)


def named_address(name: str, address: int) -> Any:
    """Return an intrinsic that returns an address, which the linker finds by a symbol's name.

    Compiled code that is cached on disk thus stays valid in processes with other addresses.
    """
    name = register_symbol(name, address)

    @llvm_intrinsic(lambda: types.uintp())
    def address_of_symbol(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        declared = builder.module.globals.get(name)
        variable = declared or ir.GlobalVariable(builder.module, ir.IntType(8), name)
        variable.linkage = "external"
        return builder.ptrtoint(variable, context.get_value_type(types.uintp))

    return address_of_symbol


@llvm_intrinsic(lambda function, *arguments: types.float64(types.uintp, types.Tuple(arguments)))
def call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Call the C function at an address, which returns a float64; argument types must be exact."""
    argument_types = [context.get_value_type(kind) for kind in signature.args[1]]
    function = to_pointer(
        builder,
        arguments[0],
        ir.FunctionType(context.get_value_type(types.float64), argument_types),
    )
    return builder.call(
        function,
        [builder.extract_value(arguments[1], index) for index in range(len(argument_types))],
    )


@llvm_intrinsic(lambda pointer, entry: types.uintp(pointer, types.int64))
def entry_address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return the address of an entry of the array behind a typed pointer."""
    return builder.ptrtoint(
        builder.gep(arguments[0], [arguments[1]]), context.get_value_type(types.uintp)
    )


@llvm_intrinsic(lambda count: types.CPointer(types.float64)(types.int64))
def stack_floats(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return a pointer to uninitialized float64 on the stack, valid until the caller returns."""
    return builder.alloca(context.get_value_type(types.float64), size=arguments[0])


@llvm_intrinsic(lambda target, source, count: types.void(types.uintp, types.uintp, types.int64))
def copy_bytes(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Copy `count` bytes from address `source` to address `target`."""
    kind = ir.IntType(8).as_pointer()
    function = builder.module.declare_intrinsic("llvm.memcpy", [kind, kind, ir.IntType(64)])
    target_pointer, source_pointer = (builder.inttoptr(address, kind) for address in arguments[:2])
    builder.call(function, [target_pointer, source_pointer, arguments[2], ir.IntType(1)(0)])
    return context.get_dummy_value()


@llvm_intrinsic(lambda address, number: types.int64(types.uintp, types.int64))
def atomic_add(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Add a number to the int64 at an address atomically; return its previous value."""
    return builder.atomic_rmw(
        "add", to_pointer(builder, arguments[0], ir.IntType(64)), arguments[1], "seq_cst"
    )


@llvm_intrinsic(lambda address: types.int64(types.uintp))
def atomic_load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Load the int64 at an address atomically, so that other threads' changes are seen."""
    return builder.load_atomic(to_pointer(builder, arguments[0], ir.IntType(64)), "seq_cst", 8)


@llvm_intrinsic(lambda address, kind: named_tuple_type(kind.instance_class)(types.uintp, kind))
def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Read a named tuple of class `kind` from consecutive float64 numbers at an address."""
    tuple_type = signature.return_type
    pointer = to_pointer(builder, arguments[0], context.get_value_type(types.float64))
    entries = (
        builder.gep(pointer, [context.get_constant(types.intp, index)])
        for index in range(len(tuple_type))
    )
    return context.make_tuple(builder, tuple_type, [builder.load(entry) for entry in entries])


@internal
def read_row(vector: Any, kind: Any) -> Any:
    """Read a named tuple of class `kind` from the first entries of a float64 array."""
    return read(vector.ctypes.data, kind)


def named_tuple_type(kind: type) -> Any:
    """Return numba's type of a named tuple of float64."""
    return types.BaseTuple.from_types((types.float64,) * len(kind._fields), kind)  # type: ignore[attr-defined]


@functools.cache
def entries_type(size: int) -> Any:
    """Return a named tuple class of `size` entries, to `read` a row of an array."""
    return namedtuple("Entries", [f"entry{index}" for index in range(size)])


@llvm_intrinsic(lambda values: types.UniTuple(types.float64, len(values))(values))
def to_floats(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Convert a tuple of numbers of any types to float64."""
    return context.make_tuple(
        builder, signature.return_type, _as_floats(context, builder, signature, arguments)
    )


@llvm_intrinsic(lambda values, address: types.void(values, types.uintp))
def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Write a tuple of numbers as consecutive float64 at an address."""
    pointer = to_pointer(builder, arguments[1], context.get_value_type(types.float64))
    for index, value in enumerate(_as_floats(context, builder, signature, arguments)):
        builder.store(value, builder.gep(pointer, [context.get_constant(types.intp, index)]))
    return context.get_dummy_value()


def _as_floats(context: Any, builder: Any, signature: Any, arguments: Any) -> list[Any]:
    """Convert the entries of the first argument, a tuple of numbers, to float64."""
    return [
        context.cast(builder, builder.extract_value(arguments[0], index), kind, types.float64)
        for index, kind in enumerate(signature.args[0])
    ]


def callback(function: Any, return_type: Any = None, *argument_types: Any) -> Any:
    """Wrap a compiled function (mjModel, mjData, ...) as a pointer for MuJoCo's setters."""
    # The wrapper refers to the function, because the machine code is freed with the function.
    wrapper: Any = ctypes.CFUNCTYPE(return_type, ctypes.c_void_p, ctypes.c_void_p, *argument_types)(
        function.address
    )
    wrapper.owner = function
    return wrapper
