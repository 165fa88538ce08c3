"""The states and the run in which the certificate compares a task with its oracles."""

import math
from typing import NamedTuple


class Trials(NamedTuple):
    """What the certificate tries a task in; in the units of the task's state."""

    bounds: tuple[float, ...]
    """States are drawn uniformly within plus and minus these."""
    edges: tuple[tuple[float, ...], ...]
    """States on the walls, on the speed limits, on the cut of wrapped angles, and beside them: values of each entry."""
    start: tuple[float, ...]
    """Start of a run that stays away from bounds, walls and wrapped angles, where the task's equations are smooth."""
    steps: int
    """Environment steps of that run."""
    balanced_steps: int
    """Of these, the first ones over which energies are balanced, with integration steps many times finer."""
    horizon: int | None = None
    """Environment steps over which two implementations must agree to 1e-9; None for a whole episode. A chaotic task's
    rounding errors, 1e-16 * exp(lambda t), pass that within one."""


def around(value: float) -> tuple[float, ...]:
    """A bound, the numbers next to it on both sides, and one just inside; and all of them negated."""
    numbers = (value, math.nextafter(value, math.inf), math.nextafter(value, 0.0), 0.999 * value)
    return (*numbers, *(-number for number in numbers))
