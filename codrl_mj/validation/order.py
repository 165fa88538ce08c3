"""Orders of convergence: slopes fitted on logarithmic axes, with intervals."""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy import stats

from codrl_mj.pages.plots import Curve, Plot
from codrl_mj.validation.outcome import Check


class Slope(NamedTuple):
    """A slope fitted to a cloud of points on logarithmic axes."""

    value: float
    """The exponent p of error = c * step^p."""
    half_width: float
    """Half the width of its 95 % interval."""

    def distance(self, promised: float) -> float:
        """How far the farther end of the interval lies from the promised order; infinite if the fit is no number."""
        distance = abs(self.value - promised) + self.half_width
        return distance if np.isfinite(distance) else np.inf

    def __str__(self) -> str:
        """The slope with its interval."""
        return f"{self.value:.3f} +- {self.half_width:.3f}"


def fit_slope(steps: np.ndarray, errors: np.ndarray) -> Slope:
    """Least squares on the logarithms, with the 95 % interval of Student's t at n - 2 degrees of freedom.

    Args:
        steps: abscissae > 0, at least three.
        errors: what was found at each; a zero or a NaN makes the slope a NaN.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.log(errors)
    if not np.isfinite(logarithms).all():
        return Slope(np.nan, np.nan)
    fit = stats.linregress(np.log(steps), logarithms)
    return Slope(float(fit.slope), float(stats.t.ppf(0.975, len(steps) - 2) * fit.stderr))


class Family(NamedTuple):
    """Errors of one case at several steps."""

    label: str
    """The case, as in a legend."""
    steps: np.ndarray
    """What is made smaller, or larger where the promised order is negative."""
    errors: np.ndarray
    """What was found at each."""
    rounding: float = 0.0
    """Size up to which an error is rounding, and says nothing of an order."""

    def judged(self, promised: float) -> tuple[float, str]:
        """How far it is from the promised order, and the finding in words; rounding is left out.

        With fewer than three errors left there is no slope, and the largest may be what the promised order leaves over
        rounding two steps before it, with as much again for rounding's scatter: `TOLERANCE` times its share in that.
        """
        clear = ~(self.errors <= self.rounding) | (self.rounding == 0.0)  # NaN is clear
        spread = f"errors {self.errors[0]:.2g} to {self.errors[-1]:.2g}"
        if clear.sum() >= 3 or not self.rounding:
            slope = fit_slope(self.steps[clear], self.errors[clear])
            return slope.distance(promised), f"{self.label}: slope {slope}, {spread}"
        share = float(self.errors.max() / (2.0 * self.rounding * (self.steps[0] / self.steps[2]) ** promised))
        return TOLERANCE * share, f"{self.label}: exact to rounding, {self.rounding:.2g}: {spread}"


TOLERANCE = 0.1
"""Farthest that any end of a slope's 95 % interval may lie from the promised order. A method one order worse misses by
1; an error that does not vanish, such as a parameter off by 1 %, bends the line until its slope is near 0."""


def order_check(
    name: str, oracle: str, families: list[Family], promised: float, plot: Plot, group: str, task: str = ""
) -> Check:
    """Whether every family's errors vanish at the promised order: slopes within `TOLERANCE`, intervals included.

    Args:
        name: of the check.
        oracle: what the errors are differences from.
        families: one slope each.
        promised: the order.
        plot: title and axis labels; the curves are made here, a line of the promised slope among them.
        group: of the check.
        task: of the check.
    """
    found = [family.judged(promised) for family in families]
    distances = [np.inf if np.isnan(distance) else distance for distance, _ in found]
    worst = int(np.argmax(distances))
    curves = [Curve(text.partition(", ")[0], f.steps, f.errors) for f, (_, text) in zip(families, found, strict=True)]
    first = families[0]
    guide = 0.5 * first.errors[-1] * (first.steps / first.steps[-1]) ** promised  # beside the errors, not upon them
    curves.append(Curve(f"slope {promised:g}, as promised", first.steps, guide, reference=True))
    return Check(
        name,
        oracle,
        sum(len(f.steps) for f in families),
        distances[worst],
        TOLERANCE,
        found[worst][1],
        group=group,
        task=task,
        unit="slope",
        plots=(dataclasses.replace(plot, curves=tuple(curves), x_log=True, y_log=True),),
    )
