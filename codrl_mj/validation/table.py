"""Table of all checks, and the decorator that evaluates them.

A check is a generator function that yields the compared cases without judging them. The decorator
`check` enters its rows in `TABLE` and turns it into a function that returns these rows with the
worst case, its description and the plots.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from codrl_mj.plots import Curve, Plot

ORDER_TOLERANCE = 0.1
"""Largest distance of either end of a slope's 95 % interval from the promised order.

A method one order worse misses by 1; an error that does not vanish, such as a parameter off by 1 %,
bends the line until its slope is near 0.
"""


REPORT = "this is a fault of codrl_mj, or of this version of MuJoCo or Gymnasium; please report it"
"""Likely cause of a failure that a user cannot fix."""


@dataclasses.dataclass(frozen=True)
class Check:
    """A row of the table, and after the check its result.

    In the table, name and oracle may have fields in braces, which the check's arguments fill in.
    """

    name: str
    """Compared quantity, such as `one step, euler`; unique within its group and task."""
    oracle: str
    """Reference of the comparison."""
    tolerance: float
    """Largest difference allowed."""
    unit: str = "relative"
    """Unit of `worst` and `tolerance`; `relative` divides each state entry by max(1, its size)."""
    samples: int = 0
    """Number of comparisons."""
    worst: float = math.nan
    """Largest difference."""
    where: str = ""
    """Description of the case with the largest difference."""
    group: str = ""
    """Part of the certificate: dynamics, trajectories, convergence, motor, energy or execution."""
    task: str = ""
    """Task or model that was checked; empty if the check needs none."""
    plots: tuple[Plot, ...] = ()
    """Plots of the comparison."""
    fault: str = ""
    """Likely cause of a failure, and its remedy."""

    @property
    def passed(self) -> bool:
        """True if the largest difference is within the tolerance; a NaN is a failure."""
        return bool(self.worst <= self.tolerance)

    @property
    def tolerance_ratio(self) -> float:
        """Ratio of the largest difference to the tolerance; a failure is > 1, a NaN infinite."""
        if self.tolerance == 0.0 or math.isnan(self.worst):
            return 0.0 if self.worst == 0.0 else math.inf
        return self.worst / self.tolerance

    @property
    def margin(self) -> str:
        """Ratio of the tolerance to the largest difference, as text."""
        if self.tolerance_ratio == 0.0:
            return "exact"
        # Near 1, two digits would round a failure to 1 and make it look like a pass.
        ratio = 1.0 / self.tolerance_ratio
        return f"{ratio:.2g}" if ratio >= 1.005 or ratio < 1.0 else f"{ratio:.4g}"


@dataclasses.dataclass(frozen=True)
class Skipped:
    """A check that was not run."""

    name: str
    """Quantity that was not compared."""
    reason: str
    """Reason why the check does not apply, or a missing requirement."""
    group: str = ""
    """Group of checks; the certificate fills it in."""
    task: str = ""
    """Task or model; the certificate fills it in."""


def order_check(name: str, oracle: str) -> Check:
    """Return a table row for an order of convergence, which `order_case` evaluates."""
    return Check(name, oracle, ORDER_TOLERANCE, "slope")


class Case(NamedTuple):
    """Differences of one comparison."""

    gaps: ArrayLike
    """Differences, a number or an array, each >= 0 or NaN."""
    where: str | Callable[[int], str] = ""
    """Description of the case, or a function of the flat index of the largest difference."""
    samples: int | None = None
    """Number of comparisons; None for the number of differences."""
    plots: tuple[Plot, ...] = ()
    """Plots of the comparison."""


NO_DIFFERENCE = "everywhere: there is no difference"
Cases = Iterable[Case | tuple[Case, ...]]
TABLE: list[Check] = []
"""Rows of all checks of the imported modules."""


def check(group: str, *rows: Check) -> Callable[[Callable[..., Cases]], Callable[..., list[Check]]]:
    """Register a generator function of cases as a check in a group of the certificate.

    The function yields a `Case` for a single row, or a tuple with a `Case` for each row. If it
    yields nothing, there are no results. Fields in braces in the rows are filled in by its
    arguments and by further keyword arguments of the call.
    """
    group_rows = [dataclasses.replace(row, group=group) for row in rows]
    TABLE.extend(group_rows)

    def register(cases: Callable[..., Cases]) -> Callable[..., list[Check]]:
        signature = inspect.signature(cases)

        @functools.wraps(cases)
        def run_check(*arguments: object, **keywords: object) -> list[Check]:
            # Keyword arguments that the check itself does not take only fill in its rows.
            extra = {
                name: keywords.pop(name)
                for name in list(keywords)
                if name not in signature.parameters
            }
            fields = extra | signature.bind(*arguments, **keywords).arguments
            case_tuples = [
                (case,) if isinstance(case, Case) else case
                for case in cases(*arguments, **keywords)
            ]
            cases_by_row = zip(*case_tuples, strict=True)
            return [
                evaluate_cases(row, fields, row_cases)
                for row, row_cases in zip(group_rows, cases_by_row, strict=bool(case_tuples))
            ]

        return run_check

    return register


def evaluate_cases(row: Check, fields: Mapping[str, object], cases: Iterable[Case]) -> Check:
    """Return a row with the result of its cases.

    The worst case has the largest difference; of equal ones it is the first. A NaN is larger than
    any number.
    """
    worst, description, samples = -math.inf, "", 0
    plots: list[Plot] = []
    for case in cases:
        gaps = np.ravel(case.gaps)
        samples += gaps.size if case.samples is None else case.samples
        plots += case.plots
        # argmax returns the index of a NaN if there is one.
        index = int(np.argmax(gaps)) if gaps.size else -1
        if index >= 0 and not (gaps[index] <= worst or math.isnan(worst)):
            worst, case_description = float(gaps[index]), case.where
            description = (
                case_description
                if isinstance(case_description, str)
                else case_description(index)
                if worst
                else NO_DIFFERENCE
            )
    # No case had any differences.
    if worst < 0.0:
        worst, description = 0.0, NO_DIFFERENCE
    name, oracle = (text.format_map(fields) for text in (row.name, row.oracle))
    return dataclasses.replace(
        row,
        name=name,
        oracle=oracle,
        samples=samples,
        worst=worst,
        where=description,
        plots=tuple(plots),
    )


# -- orders of convergence -------------------------------------------------------------------------


def fit_slope(steps: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Return the slope of errors over steps on logarithmic axes, and half its 95 % interval.

    The fit is least squares on the logarithms, the interval Student's t at n - 2 degrees of
    freedom. At least three steps > 0 are needed; an error that is zero or NaN makes both results
    NaN.
    """
    # The import is local because reading a certificate does not need scipy.
    from scipy import stats

    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.log(errors)
    if not np.isfinite(logarithms).all():
        return math.nan, math.nan
    fit = stats.linregress(np.log(steps), logarithms)
    return float(fit.slope), float(stats.t.ppf(0.975, len(steps) - 2) * fit.stderr)


class ConvergenceSeries(NamedTuple):
    """Errors of one case at several steps."""

    label: str
    """Name of the case in a legend."""
    steps: np.ndarray
    """Step sizes, decreasing; for a negative order increasing quantities, such as bandwidths."""
    errors: np.ndarray
    """Error at each step."""
    rounding: float = 0.0
    """Size up to which an error is only rounding and shows no order."""

    def distance_from(self, promised: float) -> tuple[float, str]:
        """Return the distance from the promised order, and its description.

        Errors that are only rounding are left out. If fewer than three errors remain, there is no
        slope, and the largest error is compared with an allowance instead: twice the rounding,
        times the factor by which an error of the promised order grows from the third step size to
        the first. The distance is then `ORDER_TOLERANCE` times the largest error over this
        allowance.
        """
        # A NaN compares false and therefore stays in, so that it fails the check.
        clear = ~(self.errors <= self.rounding) | (self.rounding == 0.0)
        spread = f"errors {self.errors[0]:.2g} to {self.errors[-1]:.2g}"
        if clear.sum() >= 3 or not self.rounding:
            slope, half_width = fit_slope(self.steps[clear], self.errors[clear])
            # The distance of the farther end of the interval.
            distance = abs(slope - promised) + half_width
            description = f"{self.label}: slope {slope:.3f} +- {half_width:.3f}, {spread}"
            return distance if math.isfinite(distance) else math.inf, description
        share = float(
            self.errors.max() / (2.0 * self.rounding * (self.steps[0] / self.steps[2]) ** promised)
        )
        share = math.inf if math.isnan(share) else share
        return (
            ORDER_TOLERANCE * share,
            f"{self.label}: exact to rounding, {self.rounding:.2g}: {spread}",
        )


def order_case(
    promised: float, series: list[ConvergenceSeries], title: str, x_label: str, y_label: str
) -> Case:
    """Return the case with the largest distance from the promised order, and a plot of all errors.

    The distances include the intervals; the plot has a line with the promised slope.
    """
    distances = [errors.distance_from(promised) for errors in series]
    curves = [
        Curve(text.partition(", ")[0], errors.steps, errors.errors)
        for errors, (_, text) in zip(series, distances, strict=True)
    ]
    first = series[0]
    # The factor 0.5 moves the line beside the errors, so that it does not cover them.
    guide = 0.5 * first.errors[-1] * (first.steps / first.steps[-1]) ** promised
    curves.append(Curve(f"slope {promised:g}, as promised", first.steps, guide, reference=True))
    plot = Plot(title, x_label, y_label, tuple(curves), x_log=True, y_log=True)
    distance, description = max(distances, key=lambda pair: pair[0])
    return Case(distance, description, sum(len(errors.steps) for errors in series), (plot,))
