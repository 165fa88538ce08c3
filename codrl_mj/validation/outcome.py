"""What a check reports: its oracle, its tolerance, the worst case found and where; and curves to look at."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    label: str
    """Its name in the legend."""
    x: np.ndarray
    """Shape (n,)."""
    y: np.ndarray
    """Shape (n,)."""
    reference: bool = False
    """Whether it is drawn as a reference (the oracle, a promised slope, a bound) rather than as a result."""


@dataclasses.dataclass(frozen=True)
class Plot:
    """A plot that shows what a check compared."""

    title: str
    """What is shown."""
    x_label: str
    """With its unit."""
    y_label: str
    """With its unit."""
    curves: tuple[Curve, ...]
    """The lines."""
    x_log: bool = False
    """Whether the horizontal axis is logarithmic."""
    y_log: bool = False
    """Whether the vertical axis is logarithmic."""


@dataclasses.dataclass(frozen=True)
class Check:
    """The outcome of one check."""

    name: str
    """What was compared; stable, such as `one step, euler`, and unique within its group and task."""
    oracle: str
    """What it was compared with."""
    samples: int
    """How many comparisons were made."""
    worst: float
    """Largest difference found."""
    tolerance: float
    """Largest difference allowed."""
    where: str
    """Where the largest difference was found."""
    group: str = "dynamics"
    """Which part of the certificate: dynamics, trajectories, convergence, motor, energy or execution."""
    task: str = ""
    """The task or model it was run on; empty where it needs none."""
    unit: str = "relative"
    """Unit of `worst` and `tolerance`; `relative` measures each state entry against max(1, its size)."""
    plots: tuple[Plot, ...] = ()
    """What to look at."""

    @property
    def passed(self) -> bool:
        """Whether the port is right as far as this check sees; a NaN is a failure."""
        return bool(self.worst <= self.tolerance)


@dataclasses.dataclass(frozen=True)
class Skipped:
    """A check that was not made."""

    name: str
    """What was not compared."""
    reason: str
    """Why it does not apply, or what it needs."""
    group: str = ""
    """Which part of the certificate."""
    task: str = ""
    """The task or model."""
