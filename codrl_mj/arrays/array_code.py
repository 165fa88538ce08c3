"""Back end that computes with arrays of numpy, torch or JAX: one entry of an array is an actuator.

Both sides of a branch are computed, and each entry takes its own. A loop runs until all entries
have finished; finished entries keep their values.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeGuard, cast

import numpy as np

from codrl_mj.actuators import Family, Inputs, parameters_type
from codrl_mj.arrays.family import read_advance
from codrl_mj.arrays.scalars import Kind, RefusedError, Scalar, ScalarLoop

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
_MAX_INT = 2.0**62


class ArrayCode:
    """Back end whose operands are arrays.

    Args:
        array_module: numpy, torch or jax.numpy.
        like: array whose device is used.
        shape: common shape of all arrays.
    """

    def __init__(self, array_module: ArrayModule, like: Array, shape: tuple[int, ...]) -> None:
        """Store the module and find out its types."""
        self._module, self._shape = array_module, shape
        self._name: str = array_module.__name__
        self._alive: Array = None
        self._device = like.device if self._name == "torch" else None
        self._types = {
            "bool": array_module.bool if self._name == "torch" else np.bool_,
            "int": array_module.int64,
            "float": array_module.float64,
        }

    def constant(self, value: float, kind: Kind) -> Array:
        """Return a number as an array without dimensions."""
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
            operand = self._module.clip(number, -_MAX_INT, _MAX_INT)
        if self._name == "torch":
            return operand.to(self._types[new])
        return operand.astype(self._types[new])

    def operation(self, name: str, kind: Kind, *operands: Array) -> Array:
        """Return the result of an operation on arrays.

        Raises:
            RefusedError: the array module does not have the function.
        """
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
) -> Advanced:
    """Advance many actuators of a family by a mechanical step.

    Every entry of parameters, state and inputs is either a float, which holds for all actuators, or
    an array. All arrays have a common shape after broadcasting, and so do the results.

    With jax.numpy the function can be compiled by `jax.jit`, and used in `jax.vmap`, `lax.scan` and
    `jax.jvp`. Floats are constants of the compiled code.

    Args:
        family: the family.
        array_module: numpy, torch or jax.numpy.
        parameters: named tuple of the family's `parameters_type`, or values by name.
        timestep: mechanical step [s].
        state: the family's `State`; all entries are 0 at the start.
        inputs: `Inputs` at the shaft.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take.
        ValueError: no entry is an array, or an array is not of 64-bit floats.
    """
    if not isinstance(parameters, Mapping):
        names = parameters_type(family)._fields
        parameters = dict(zip(names, parameters, strict=True))
    parts: tuple[Mapping[str, object], ...] = (
        parameters,
        dict(zip(family.State._fields, state, strict=True)),
        inputs._asdict(),
    )
    arrays = [value for part in parts for value in part.values() if _is_array(value)]
    if not arrays:
        raise ValueError("no entry is an array: expected at least one, such as inputs.speed")
    shape = np.broadcast_shapes(*(tuple(array.shape) for array in arrays))
    backend = ArrayCode(array_module, arrays[0], shape)
    symbols = [{name: _symbol(name, value) for name, value in part.items()} for part in parts]
    # Infinity and NaN are results here, as in compiled code: the other side of a branch is computed
    # with numbers that it was not written for.
    with np.errstate(all="ignore"):
        result = read_advance(family, backend, symbols[0], timestep, *symbols[1:])
    return Advanced(
        family.State(*map(backend.full, result.state)),
        backend.full(result.torque),
        family.Signals(*map(backend.full, result.signals)),
    )


def _is_array(value: object) -> TypeGuard[Array]:
    """Return True for arrays, also for those that JAX traces, but not for numpy's scalars."""
    return hasattr(value, "dtype") and not isinstance(value, np.generic)


def _symbol(name: str, value: object) -> object:
    """Return the symbol of an array; a float remains a constant.

    Raises:
        ValueError: the array has another type than 64-bit floats.
    """
    if not _is_array(value):
        return value
    if not str(value.dtype).endswith("float64"):
        raise ValueError(
            f"{name} has the dtype {value.dtype}: expected float64; convert it. JAX needs"
            ' jax.config.update("jax_enable_x64", True) before its first array'
        )
    return Scalar("float", value)
