"""Reads and writes raw memory in functions that numba compiles: integer addresses become typed pointers."""

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _pointer(element: Any) -> Any:
    """A numba intrinsic that turns an integer address into a typed pointer."""

    @intrinsic
    def pointer(typing_context: Any, address: Any) -> Any:  # noqa: ARG001 - numba fixes the arguments
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
            return builder.inttoptr(arguments[0], ir.PointerType(context.get_data_type(element)))

        return types.CPointer(element)(types.uintp), codegen

    return pointer


f64, i32, i64, u8 = (_pointer(kind) for kind in (types.float64, types.int32, types.int64, types.uint8))


@numba.njit(inline="always")
def array(struct: int, at: int) -> int:
    """Address of the array whose pointer the structure at address `struct` holds at offset `at`."""
    return types.uintp(i64(struct + at)[0])
