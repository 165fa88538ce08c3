"""Raw memory access in functions that numba compiles: integer addresses become typed pointers."""

# ruff: noqa: ARG001, ARG005 - numba fixes the arguments

import ctypes
import functools
import inspect
import sys
from collections import namedtuple
from collections.abc import Callable, Sequence
from types import CodeType, FunctionType, ModuleType
from typing import Protocol, TypeVar, overload

import numba
import numpy as np
from llvmlite import ir
from llvmlite.ir import IRBuilder, Value
from numba import types
from numba.core import typing
from numba.core.base import BaseContext
from numba.core.typing import Signature
from numba.extending import intrinsic, register_jitable

from codrl_mj.compile_cache import CompiledCallback, F, P, R, register_symbol

Number = TypeVar("Number", int, float)


@overload
def internal(function: F, **options: object) -> F: ...
@overload
def internal(function: None = None, **options: object) -> Callable[[F], F]: ...


def internal(function: F | None = None, **options: object) -> F | Callable[[F], F]:
    """Compile a function that only compiled code calls, with the options of `numba.njit`.

    It has no entry points for Python, which take time to compile. It is inlined because numba
    passes each entry of a tuple as an argument: a call with a drive's parameters would copy 31
    numbers.
    """
    compiled: F | Callable[[F], F] = numba.njit(
        function,
        forceinline=True,
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        **options,
    )
    return compiled


_LIBRARIES = sys.stdlib_module_names | {"numba", "numpy", "scipy"}
"""Packages whose functions numba supports by itself, or not at all."""

_REGISTERED: set[FunctionType] = set()
"""Plain functions that compiled code can call."""


def register_callees(function: FunctionType) -> None:
    """Register the Python functions that a function calls, directly or indirectly, with numba.

    They can still be called from Python.
    """
    # Nested functions and comprehensions have code objects of their own, among the constants.
    codes, names = [function.__code__], set[str]()
    for code in codes:
        names |= {*code.co_names, *code.co_freevars}
        codes += [const for const in code.co_consts if isinstance(const, CodeType)]
    closure = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    scope = function.__globals__ | {name: cell.cell_contents for name, cell in closure}
    values = [scope[name] for name in names & scope.keys()]
    # The loop appends functions that are called through a module (`module.f(x)`) to the list.
    for value in values:
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0] not in _LIBRARIES:
            inner = [getattr(value, name) for name in names if hasattr(value, name)]
            values += [callee for callee in inner if all(callee is not known for known in values)]
        is_user_function = (
            isinstance(value, FunctionType) and value.__module__.partition(".")[0] not in _LIBRARIES
        )
        if is_user_function and value not in _REGISTERED:
            _REGISTERED.add(value)
            register_jitable(forceinline=True)(value)
            register_callees(value)


class Pointer(Protocol[Number]):
    """Pointer to numbers in compiled code, where numba's type is `CPointer`."""

    def __getitem__(self, index: int, /) -> Number:
        """Return a number."""

    def __setitem__(self, index: int, number: Number, /) -> None:
        """Overwrite a number."""


Generator = Callable[[BaseContext, IRBuilder, Signature, Sequence[Value]], Value]
"""Function (context, builder, signature, arguments) that emits LLVM code and returns its result."""


def llvm_intrinsic(
    signature: Callable[..., Signature], generate: Generator
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that replaces a declaration by a function whose LLVM code is generated.

    The declaration has the name, the arguments and the documentation; its body is never run.

    Args:
        signature: a function of the numba types of the arguments that returns numba's signature.
        generate: the generator of the code.
    """

    def decorate(declaration: Callable[P, R]) -> Callable[P, R]:
        def typed(
            typing_context: typing.Context, *argument_types: types.Type
        ) -> tuple[Signature, Generator]:
            return signature(*argument_types), generate

        # numba binds an intrinsic's arguments by the names in its signature, the typing context
        # first.
        kind, rest = (
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            inspect.signature(declaration).parameters.values(),
        )
        typed.__signature__ = inspect.Signature([inspect.Parameter("context", kind), *rest])  # type: ignore[attr-defined]
        typed.__name__, typed.__doc__ = declaration.__name__, declaration.__doc__
        compiled: Callable[P, R] = intrinsic(typed)
        return compiled

    return decorate


def to_pointer(builder: IRBuilder, address: Value, kind: ir.Type) -> Value:
    """Convert an integer to a pointer to an LLVM type."""
    return builder.inttoptr(address, ir.PointerType(kind))


def _pointer(element: types.Type, python_type: type[Number]) -> Callable[[int], Pointer[Number]]:
    """Return an intrinsic that turns an integer address into a typed pointer."""
    del python_type

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        return to_pointer(builder, arguments[0], context.get_data_type(element))

    @llvm_intrinsic(lambda address: types.CPointer(element)(types.uintp), generate)
    def pointer(address: int) -> Pointer[Number]:
        raise NotImplementedError

    return pointer


f64, f32 = _pointer(types.float64, float), _pointer(types.float32, float)
i32, i64 = _pointer(types.int32, int), _pointer(types.int64, int)
u8, u64 = _pointer(types.uint8, int), _pointer(types.uint64, int)


def named_address(name: str, address: int) -> Callable[[], int]:
    """Return an intrinsic that returns an address, which the linker finds by a symbol's name.

    Compiled code that is cached on disk thus stays valid in processes with other addresses.
    """
    name = register_symbol(name, address)

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        declared = builder.module.globals.get(name)
        variable = declared or ir.GlobalVariable(builder.module, ir.IntType(8), name)
        variable.linkage = "external"
        return builder.ptrtoint(variable, context.get_value_type(types.uintp))

    @llvm_intrinsic(lambda: types.uintp(), generate)
    def address_of_symbol() -> int:
        raise NotImplementedError

    return address_of_symbol


def _generate_call(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
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


@llvm_intrinsic(
    lambda function, *arguments: types.float64(types.uintp, types.Tuple(arguments)),
    _generate_call,
)
def call(function: int, *arguments: float) -> float:
    """Call the C function at an address, which returns a float64; argument types must be exact."""
    raise NotImplementedError


def _generate_entry_address(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    return builder.ptrtoint(
        builder.gep(arguments[0], [arguments[1]]), context.get_value_type(types.uintp)
    )


@llvm_intrinsic(lambda pointer, entry: types.uintp(pointer, types.int64), _generate_entry_address)
def entry_address(pointer: Pointer[Number], entry: int) -> int:
    """Return the address of an entry of the array behind a typed pointer."""
    raise NotImplementedError


def _generate_stack_floats(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    return builder.alloca(context.get_value_type(types.float64), size=arguments[0])


@llvm_intrinsic(lambda count: types.CPointer(types.float64)(types.int64), _generate_stack_floats)
def stack_floats(count: int) -> Pointer[float]:
    """Return a pointer to uninitialized float64 on the stack, valid until the caller returns."""
    raise NotImplementedError


def _generate_copy(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    kind = ir.IntType(8).as_pointer()
    function = builder.module.declare_intrinsic("llvm.memcpy", [kind, kind, ir.IntType(64)])
    target_pointer, source_pointer = (builder.inttoptr(address, kind) for address in arguments[:2])
    builder.call(function, [target_pointer, source_pointer, arguments[2], ir.IntType(1)(0)])
    return context.get_dummy_value()


@llvm_intrinsic(
    lambda target, source, count: types.void(types.uintp, types.uintp, types.int64),
    _generate_copy,
)
def copy_bytes(target: int, source: int, count: int) -> None:
    """Copy `count` bytes from address `source` to address `target`."""
    raise NotImplementedError


def _generate_atomic_add(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    return builder.atomic_rmw(
        "add", to_pointer(builder, arguments[0], ir.IntType(64)), arguments[1], "seq_cst"
    )


@llvm_intrinsic(lambda address, number: types.int64(types.uintp, types.int64), _generate_atomic_add)
def atomic_add(address: int, number: int) -> int:
    """Add a number to the int64 at an address atomically; return its previous value."""
    raise NotImplementedError


def _generate_atomic_load(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    return builder.load_atomic(to_pointer(builder, arguments[0], ir.IntType(64)), "seq_cst", 8)


@llvm_intrinsic(lambda address: types.int64(types.uintp), _generate_atomic_load)
def atomic_load(address: int) -> int:
    """Load the int64 at an address atomically, so that other threads' changes are seen."""
    raise NotImplementedError


def _generate_read(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    tuple_type = signature.return_type
    pointer = to_pointer(builder, arguments[0], context.get_value_type(types.float64))
    entries = (
        builder.gep(pointer, [context.get_constant(types.intp, index)])
        for index in range(len(tuple_type))
    )
    return context.make_tuple(builder, tuple_type, [builder.load(entry) for entry in entries])


@llvm_intrinsic(
    lambda address, kind: named_tuple_type(kind.instance_class)(types.uintp, kind), _generate_read
)
def read(address: int, kind: type[R]) -> R:
    """Read a named tuple of class `kind` from consecutive float64 numbers at an address."""
    raise NotImplementedError


@internal
def read_row(vector: np.ndarray, kind: type[R]) -> R:
    """Read a named tuple of class `kind` from the first entries of a float64 array."""
    return read(vector.ctypes.data, kind)


def named_tuple_type(kind: type) -> types.BaseTuple:
    """Return numba's type of a named tuple of float64."""
    return types.BaseTuple.from_types((types.float64,) * len(kind._fields), kind)  # type: ignore[attr-defined]


@functools.cache
def entries_type(size: int) -> type[tuple[float, ...]]:
    """Return a named tuple class of `size` entries, to `read` a row of an array."""
    return namedtuple("Entries", [f"entry{index}" for index in range(size)])


def _generate_floats(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    return context.make_tuple(
        builder, signature.return_type, _as_floats(context, builder, signature, arguments)
    )


@llvm_intrinsic(lambda values: types.UniTuple(types.float64, len(values))(values), _generate_floats)
def to_floats(values: tuple[float, ...]) -> tuple[float, ...]:
    """Convert a tuple of numbers of any types to float64."""
    raise NotImplementedError


def _generate_write(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> Value:
    pointer = to_pointer(builder, arguments[1], context.get_value_type(types.float64))
    for index, value in enumerate(_as_floats(context, builder, signature, arguments)):
        builder.store(value, builder.gep(pointer, [context.get_constant(types.intp, index)]))
    return context.get_dummy_value()


@llvm_intrinsic(lambda values, address: types.void(values, types.uintp), _generate_write)
def write(values: tuple[float, ...], address: int) -> None:
    """Write a tuple of numbers as consecutive float64 at an address."""
    raise NotImplementedError


def _as_floats(
    context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
) -> list[Value]:
    """Convert the entries of the first argument, a tuple of numbers, to float64."""
    return [
        context.cast(builder, builder.extract_value(arguments[0], index), kind, types.float64)
        for index, kind in enumerate(signature.args[0])
    ]


CFunction = Callable[..., float | None]
"""A C function of ctypes, as MuJoCo's setters accept it."""


def callback(
    function: CompiledCallback[P, R],
    return_type: type[ctypes.c_double] | None = None,
    *argument_types: type[ctypes.c_int],
) -> CFunction:
    """Wrap a compiled function (mjModel, mjData, ...) as a pointer for MuJoCo's setters."""
    # The wrapper refers to the function, because the machine code is freed with the function.
    kind = ctypes.CFUNCTYPE(return_type, ctypes.c_void_p, ctypes.c_void_p, *argument_types)
    wrapper = kind(function.address)
    wrapper.owner = function  # type: ignore[attr-defined]
    return wrapper
