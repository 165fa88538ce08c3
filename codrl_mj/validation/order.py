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
    slopes = [fit_slope(family.steps, family.errors) for family in families]
    distances = [slope.distance(promised) for slope in slopes]
    worst = int(np.argmax(distances))
    family = families[worst]
    where = f"{family.label}: slope {slopes[worst]}, errors {family.errors[0]:.2g} to {family.errors[-1]:.2g}"
    curves = [Curve(f"{f.label}: {slope}", f.steps, f.errors) for f, slope in zip(families, slopes, strict=True)]
    first = families[0]
    guide = 0.5 * first.errors[-1] * (first.steps / first.steps[-1]) ** promised  # beside the errors, not upon them
    curves.append(Curve(f"slope {promised:g}, as promised", first.steps, guide, reference=True))
    return Check(
        name,
        oracle,
        sum(len(f.steps) for f in families),
        distances[worst],
        TOLERANCE,
        where,
        group=group,
        task=task,
        unit="slope",
        plots=(dataclasses.replace(plot, curves=tuple(curves), x_log=True, y_log=True),),
    )
