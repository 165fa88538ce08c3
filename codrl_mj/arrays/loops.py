"""Variables of a loop: their structures and kinds, which must hold in every iteration."""

from collections.abc import Callable, Iterable, Mapping

from codrl_mj.arrays.frames import AFTER_LOOP, AfterLoop
from codrl_mj.arrays.scalars import (
    Kind,
    Number,
    Operand,
    RefusedError,
    describe,
    kinds_of,
    leaves,
    same_structure,
    symbols,
    widest,
    zeros_like,
)

Values = Mapping[str, object]
"""Values of variables by name."""


class LoopVariables:
    """Variables that change in a loop.

    Args:
        names: names that the loop assigns.
        before: values of all variables before the loop.
    """

    def __init__(self, names: Iterable[str], before: Values) -> None:
        """Collect the values before the loop; some names may have none yet."""
        self._names = list(names)
        self.initial = {name: before[name] for name in self._names if name in before}
        """Values before the loop by name, in the order of all lists of numbers."""
        self._kinds: dict[str, list[Kind]] = {}

    @property
    def all_kinds(self) -> list[Kind]:
        """Kinds of all numbers, after `settle`."""
        return [kind for name in self.initial for kind in self._kinds[name]]

    def settle(
        self, condition: Callable[[Values], object], body: Callable[[Values], Values]
    ) -> None:
        """Find structures and kinds that hold in all iterations.

        A name that the body assigns first has no value before the loop, so any number will do. The
        kinds grow until an iteration changes none: an int that becomes a float is a float from the
        beginning.

        Args:
            condition: function from the variables to a bool.
            body: function from the variables to those after an iteration.

        Raises:
            RefusedError: a variable changes its structure in an iteration.
        """
        self._kinds = {name: kinds_of(value) for name, value in self.initial.items()}
        while True:
            before = dict(self._kinds)
            variables = self.symbols([None] * len(self.all_kinds))
            condition(variables)
            after = body(variables)
            for name in dict.fromkeys([*self._names, *self.initial]):
                if name in after:
                    self._widen(name, after[name])
            if self._kinds == before:
                return

    def _widen(self, name: str, value: object) -> None:
        """Include the value of a variable after an iteration."""
        if isinstance(value, AfterLoop) or isinstance(self.initial.get(name), AfterLoop):
            self.initial[name], self._kinds[name] = AFTER_LOOP, []
        elif name not in self.initial:
            self.initial[name], self._kinds[name] = zeros_like(value), kinds_of(value)
        elif not same_structure(self.initial[name], value):
            raise RefusedError(
                f"{name.split()[0]} is {describe(self.initial[name])} before the loop and"
                f" {describe(value)} after an iteration: make them alike"
            )
        else:
            self._kinds[name] = list(map(widest, self._kinds[name], kinds_of(value)))

    def symbols(self, operands: Iterable[Operand]) -> dict[str, object]:
        """Return the variables with symbols in place of their numbers."""
        remaining = iter(operands)
        return {
            name: symbols(value, kinds, [next(remaining) for _ in kinds])
            for name, value in self.initial.items()
            for kinds in (self._kinds[name],)
        }

    def numbers(self, values: Values) -> list[Number]:
        """Return the numbers of all variables in order."""
        return [
            number
            for name, value in self.initial.items()
            if not isinstance(value, AfterLoop)
            for number in leaves(values[name])
        ]
