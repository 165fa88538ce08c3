"""Back end that computes with arrays of numpy, torch or JAX: one entry of an array is an actuator.

Both sides of a branch are computed, and each entry takes its own. A loop runs until all entries
have finished; finished entries keep their values.
"""

import functools
import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeGuard, cast

import numpy as np

from codrl_mj.actuators import Family, Inputs, noise, parameters_type
from codrl_mj.arrays import narrow_noise
from codrl_mj.arrays.family import read_advance
from codrl_mj.arrays.scalars import Kind, RefusedError, Replacement, Scalar, ScalarLoop

# numpy, torch and JAX have no common type of arrays, and none of modules.
Array = Any
"""Array of the array module."""
ArrayModule = Any
"""numpy, torch or jax.numpy."""

_OPERATORS: dict[str, Callable[..., Array]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "floordiv": lambda a, b: a // b,
    "mod": lambda a, b: a % b,
    "pow": lambda a, b: a**b,
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
    "xor": lambda a, b: a ^ b,
    "shl": lambda a, b: a << b,
    "shr": lambda a, b: a >> b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "neg": lambda a: -a,
    "not": lambda a: ~a,
}
_NAMES = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"}
"""Names of functions in array modules, where they differ from those in C."""
_ENABLE_X64 = 'jax.config.update("jax_enable_x64", True) before the first array of JAX'
_WITH_INFINITE_DERIVATIVES = {
    *("mul", "div", "pow", "log", "log1p", "log2", "log10", "sqrt", "exp", "expm1"),
    *("asin", "acos", "tan", "hypot", "fmod", "sinh", "cosh"),
}
"""Operations whose derivative, or its product with a zero, may be infinite or NaN."""


class ArrayCode:
    """Back end whose operands are arrays.

    Args:
        array_module: numpy, torch or jax.numpy.
        like: array whose device and type are used.
        shape: common shape of all arrays.
        max_iterations: largest number of iterations of a loop whose number is unknown, with JAX
            only; None if there is no limit. Reverse-mode derivatives need a limit.
    """

    def __init__(
        self,
        array_module: ArrayModule,
        like: Array,
        shape: tuple[int, ...],
        max_iterations: int | None = None,
    ) -> None:
        """Store the module and find out its types."""
        self._module, self._shape = array_module, shape
        self._name: str = array_module.__name__
        self._max_iterations = max_iterations
        self._alive: Array = None
        self._device = like.device if self._name == "torch" else None
        self._is_narrow = has_32_bits(array_module)
        # Floats of both types hold these numbers exactly.
        self._max_int = 2.0**30 if self._is_narrow else 2.0**62
        self._types = {
            "bool": array_module.bool if self._name == "torch" else np.bool_,
            "int": array_module.int32 if self._is_narrow else array_module.int64,
            "float": like.dtype,
        }
        normal = functools.partial(narrow_noise.standard_normal, array_module)
        self.replacements: Mapping[Callable[..., object], Replacement] = (
            {noise.standard_normal: Replacement(("float", "int", "int"), "float", normal)}
            if self._is_narrow
            else {}
        )

    def constant(self, value: float, kind: Kind) -> Array:
        """Return a number as an array without dimensions.

        Raises:
            RefusedError: an int is too large for JAX without 64 bits.
        """
        if kind == "int" and self._is_narrow and abs(value) >= 2**31:
            raise RefusedError(f"the int {value} needs 64 bits, which JAX lacks: {_ENABLE_X64}")
        if self._name == "torch":
            return self._module.tensor(value, dtype=self._types[kind], device=self._device)
        return self._module.asarray(value, self._types[kind])

    def full(self, array: Array) -> Array:
        """Return an array broadcast to the common shape."""
        return self._module.broadcast_to(array, self._shape)

    def convert(self, operand: Array, old: Kind, new: Kind) -> Array:
        """Return an array of another kind."""
        if (old, new) == ("float", "int"):
            # The result is undefined if a float is NaN or too large for an int.
            number = self._module.where(operand == operand, operand, 0.0)
            operand = self._module.clip(number, -self._max_int, self._max_int)
        if self._name == "torch":
            return operand.to(self._types[new])
        return operand.astype(self._types[new])

    def operation(self, name: str, kind: Kind, *operands: Array) -> Array:
        """Return the result of an operation on arrays.

        Raises:
            RefusedError: the array module does not have the function.
        """
        if name in _WITH_INFINITE_DERIVATIVES and kind == "float":
            operands = tuple(map(self._shielded, operands))
        first, last = operands[0], operands[-1]
        if name in ("min", "max"):
            # The functions of array modules treat NaN differently from Python's.
            is_last = last < first if name == "min" else last > first
            return self._module.where(is_last, last, first)
        if name in ("floordiv", "mod") and kind == "int":
            divisor = self._module.where(last == 0, self.constant(1, "int"), last)
            is_zero, result = last == 0, _OPERATORS[name](first, divisor)
            return self._module.where(is_zero, self.constant(0, "int"), result)
        if name in _OPERATORS:
            return _OPERATORS[name](*operands)
        if name == "rint" and self._name == "torch":
            name = "round"
        function = getattr(self._module, _NAMES.get(name, name), None)
        if function is None:
            raise RefusedError(f"{name}: {self._name} has no such function")
        return function(*operands)

    def branch(
        self,
        condition: Array,
        then: Callable[[], list[Array]],
        otherwise: Callable[[], list[Array]],
        kinds: list[Kind],  # noqa: ARG002
    ) -> list[Array]:
        """Return the entries of two sides, each chosen by the condition."""
        left_side = self._restricted(condition, then)
        pairs = zip(left_side, self._restricted(~condition, otherwise), strict=True)
        return [self._module.where(condition, left, right) for left, right in pairs]

    def loop(self, loop: ScalarLoop) -> list[Array]:
        """Return the variables of a loop when all entries have finished."""

        def running(values: list[Array]) -> Array:
            condition = loop.condition(values)
            # An entry that is not on this side of a branch might never finish.
            return condition if self._alive is None else condition & self._alive

        def iteration(values: list[Array]) -> list[Array]:
            if loop.iterations is not None:
                return [self.full(new) for new in loop.body(values)]
            mask = running(values)
            after = self._restricted(mask, lambda: loop.body(values))
            return [
                self.full(self._module.where(mask, new, old))
                for new, old in zip(after, values, strict=True)
            ]

        def is_running(values: list[Array]) -> Array:
            return running(values).any()

        values = [self.full(value) for value in loop.initial]
        if self._name == "jax.numpy" and self._max_iterations and loop.iterations is None:
            values = self._bounded_loop(self._max_iterations, is_running, iteration, values)
            unfinished = running(values)
            # An entry that needs more iterations has no result.
            return [
                self._module.where(unfinished, np.nan, value) if kind == "float" else value
                for kind, value in zip(loop.kinds, values, strict=True)
            ]
        if self._name == "jax.numpy":
            return self._traced_loop(loop.iterations, is_running, iteration, values)
        if loop.iterations is not None:
            for _ in range(loop.iterations):
                values = iteration(values)
            return values
        while bool(is_running(values)):
            values = iteration(values)
        return values

    def _restricted(self, mask: Array, side: Callable[[], list[Array]]) -> list[Array]:
        """Return the result of a function that only some entries need."""
        before, self._alive = self._alive, mask if self._alive is None else self._alive & mask
        try:
            return side()
        finally:
            self._alive = before

    def _shielded(self, operand: Array) -> Array:
        """Return an operand with a harmless number in entries that are on the other side.

        In reverse mode, an infinite derivative of such an entry times 0 would be NaN.
        """
        if self._max_iterations is None or self._alive is None:
            return operand
        return self._module.where(self._alive, operand, 0.5)

    def _bounded_loop(
        self,
        max_iterations: int,
        is_running: Callable[[list[Array]], Array],
        iteration: Callable[[list[Array]], list[Array]],
        values: list[Array],
    ) -> list[Array]:
        """Return the variables of a loop of fixed length, as reverse-mode derivatives need it."""
        lax = importlib.import_module("jax.lax")

        def step(_: Array, before: list[Array]) -> list[Array]:
            unchanged = before
            return cast(
                list[Array],
                lax.cond(is_running(before), iteration, lambda _: unchanged, before),
            )

        return cast(list[Array], lax.fori_loop(0, max_iterations, step, values))

    def _traced_loop(
        self,
        iterations: int | None,
        is_running: Callable[[list[Array]], Array],
        iteration: Callable[[list[Array]], list[Array]],
        values: list[Array],
    ) -> list[Array]:
        """Return the variables of a loop that JAX compiles, instead of unrolling it."""
        lax = importlib.import_module("jax.lax")
        if iterations is None:
            result = lax.while_loop(is_running, iteration, values)
        else:
            result = lax.fori_loop(0, iterations, lambda _, before: iteration(before), values)
        return cast(list[Array], result)


class Advanced(NamedTuple):
    """Actuators after a step."""

    # The named tuples are the family's own, with arrays in place of floats.
    state: Any
    """The family's `State`, with an array for each entry."""
    torque: Array
    """Torque at the shaft [N*m] or force [N]."""
    signals: Any
    """The family's `Signals`, with an array for each entry."""


def advance(
    family: Family,
    array_module: ArrayModule,
    parameters: Mapping[str, object] | tuple[object, ...],
    timestep: float,
    state: tuple[object, ...],
    inputs: Inputs,
    max_iterations: int | None = None,
) -> Advanced:
    """Advance many actuators of a family by a mechanical step.

    Every entry of parameters, state and inputs is either a float, which holds for all actuators, or
    an array. All arrays have a common shape after broadcasting, and so do the results. Arrays are
    of 64-bit floats, or all of 32-bit floats.

    With jax.numpy the function can be compiled by `jax.jit`, and used in `jax.vmap`, `lax.scan` and
    `jax.jvp`; with `max_iterations` also in `jax.grad`. Floats are constants of the compiled code.

    Args:
        family: the family.
        array_module: numpy, torch or jax.numpy.
        parameters: named tuple of the family's `parameters_type`, or values by name.
        timestep: mechanical step [s].
        state: the family's `State`; all entries are 0 at the start.
        inputs: `Inputs` at the shaft.
        max_iterations: largest number of iterations of each loop whose number is unknown while the
            source is read; an actuator that needs more gets NaN. With JAX only, for reverse-mode
            derivatives. None: no limit.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take.
        ValueError: no entry is an array; or an array is not of floats, or of others than the rest;
            or `max_iterations` is not positive, or given without JAX.
    """
    _check_max_iterations(array_module, max_iterations)
    if not isinstance(parameters, Mapping):
        names = parameters_type(family)._fields
        parameters = dict(zip(names, parameters, strict=True))
    parts: tuple[Mapping[str, object], ...] = (
        parameters,
        dict(zip(family.State._fields, state, strict=True)),
        inputs._asdict(),
    )
    named = [(name, value) for part in parts for name, value in part.items() if _is_array(value)]
    _check_arrays(array_module, named)
    arrays = [array for _, array in named]
    shape = np.broadcast_shapes(*(tuple(array.shape) for array in arrays))
    # JAX on a CPU takes up to twice as long for rows that are no multiple of its vectors.
    backend = ArrayCode(array_module, arrays[0], (math.prod(shape),), max_iterations)

    def symbol(value: object) -> object:
        return Scalar("float", _flat(array_module, value, shape)) if _is_array(value) else value

    symbols = [{name: symbol(value) for name, value in part.items()} for part in parts]
    # Infinity and NaN are results here, as in compiled code: the other side of a branch is computed
    # with numbers that it was not written for.
    with np.errstate(all="ignore"):
        result = read_advance(family, backend, symbols[0], timestep, *symbols[1:])

    def shaped(array: Array) -> Array:
        return backend.full(array).reshape(shape)

    return Advanced(
        family.State(*map(shaped, result.state)),
        shaped(result.torque),
        family.Signals(*map(shaped, result.signals)),
    )


def _is_array(value: object) -> TypeGuard[Array]:
    """Return True for arrays, also for those that JAX traces, but not for numpy's scalars."""
    return hasattr(value, "dtype") and not isinstance(value, np.generic)


def has_32_bits(array_module: ArrayModule) -> bool:
    """Return True for JAX without 64-bit floats and integers."""
    is_jax = array_module.__name__ == "jax.numpy"
    return is_jax and bool(array_module.zeros(0, float).dtype == np.float32)


def _check_max_iterations(array_module: ArrayModule, max_iterations: int | None) -> None:
    """Raise if `max_iterations` is invalid.

    Raises:
        ValueError: it is not positive, or given without JAX.
    """
    if max_iterations is None:
        return
    if max_iterations < 1:
        raise ValueError(f"max_iterations = {max_iterations}: must be >= 1, or None for no limit")
    if array_module.__name__ != "jax.numpy":
        raise ValueError(
            f"max_iterations = {max_iterations}: is for jax.numpy only; leave it None for"
            f" {array_module.__name__}"
        )


def _check_arrays(array_module: ArrayModule, named: list[tuple[str, Array]]) -> None:
    """Raise unless all arrays are of 64-bit floats, or all of 32-bit floats.

    Args:
        array_module: numpy, torch or jax.numpy.
        named: names and arrays.

    Raises:
        ValueError: with the name of an array and a remedy.
    """
    if not named:
        raise ValueError("no entry is an array: expected at least one, such as inputs.speed")
    first, like = named[0]
    for name, array in named:
        dtype = str(array.dtype).removeprefix("torch.")
        if dtype not in ("float32", "float64"):
            raise ValueError(
                f"{name} has the dtype {dtype}: expected float64 or float32; convert it"
            )
        if array.dtype != like.dtype:
            raise ValueError(
                f"{name} has the dtype {dtype}, and {first} has"
                f" {str(like.dtype).removeprefix('torch.')}: expected the same for all; convert one"
            )
        if dtype == "float64" and has_32_bits(array_module):
            raise ValueError(
                f"{name} has the dtype float64, which JAX lacks: convert it to float32, or call"
                f" {_ENABLE_X64}"
            )


def _flat(array_module: ArrayModule, array: Array, shape: tuple[int, ...]) -> Array:
    """Return an array of a common shape as one row; a single number remains one."""
    if math.prod(array.shape) == 1:
        return array.reshape(())
    return array_module.broadcast_to(array, shape).reshape(-1)
