"""What a check reports: its oracle, its tolerance, the worst case found and where; and plots to look at."""

import dataclasses
import math

from codrl_mj.pages.plots import Plot


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

    @property
    def margin(self) -> str:
        """Tolerance over worst case, as text."""
        if self.worst == 0.0:
            return "exact"
        if not math.isfinite(self.worst) or self.tolerance == 0.0:
            return "0"
        ratio = self.tolerance / self.worst
        return f"{ratio:.2g}" if ratio >= 1.005 or ratio < 1.0 else f"{ratio:.4g}"


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
