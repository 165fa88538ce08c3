"""The table of checks, and the one runner: the worst of what a check's cases found, where it was, and its picture.

A check is a function of cases: it yields what it compared, case by case, and says nothing of verdicts. `check` enters
it in `TABLE` with its rows (name, oracle, tolerance, unit) and makes it one that returns outcomes.
"""

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, ParamSpec

import numpy as np

from codrl_mj.pages.plots import Curve, Plot

Arguments = ParamSpec("Arguments")


ORDER_TOLERANCE = 0.1
"""Farthest that any end of a slope's 95 % interval may lie from the promised order. A method one order worse misses by
1; an error that does not vanish, such as a parameter off by 1 %, bends the line until its slope is near 0."""


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


class Oracle(NamedTuple):
    """A row of the table: name and oracle may hold words in braces, such as `{task.oracle}`, an argument's."""

    name: str
    oracle: str
    tolerance: float
    unit: str = "relative"


def order(name: str, oracle: str) -> Oracle:
    """A row of slopes, which `of_order` finds: how far from the promised order errors vanish."""
    return Oracle(name, oracle, ORDER_TOLERANCE, "slope")


class Case(NamedTuple):
    """What was compared at once."""

    gaps: Any
    """Differences found, a number or an array, each >= 0 or NaN."""
    where: str | Callable[[int], str] = ""
    """Where that was, or the words for the flat index of the largest of the gaps."""
    samples: int | None = None
    """How many comparisons it was; None for the number of gaps."""
    plots: tuple[Plot, ...] = ()
    """What to look at."""


EVERYWHERE = "everywhere: there is no difference"
Cases = Iterable[Case | tuple[Case, ...]]


class Compared(Generic[Arguments]):
    """A check as it stands in the table; called, it makes its cases and returns an outcome for each row."""

    def __init__(self, group: str, rows: tuple[Oracle, ...], cases: Callable[Arguments, Cases]) -> None:
        """Of a group, with what is compared."""
        self.group, self.rows, self.cases = group, rows, cases
        self.__doc__ = cases.__doc__

    def __call__(self, *arguments: Arguments.args, **named: Arguments.kwargs) -> list[Check]:
        """The outcomes; without a case there is none."""
        return self.of()(*arguments, **named)

    def of(self, task: str = "", **words: str) -> Callable[Arguments, list[Check]]:
        """The check with words for the braces of its rows that are none of its arguments; and the task or model."""

        def run(*arguments: Arguments.args, **named: Arguments.kwargs) -> list[Check]:
            bound = inspect.signature(self.cases).bind(*arguments, **named)
            found = [(case,) if isinstance(case, Case) else case for case in self.cases(*arguments, **named)]
            of_rows = zip(*found, strict=True)
            said = {"task": task} | bound.arguments | words
            return [outcome(row, self.group, said, cases) for row, cases in zip(self.rows, of_rows, strict=bool(found))]

        return run


TABLE: list[Compared[Any]] = []
"""Every check of the modules that were imported."""


def check(group: str, *rows: Oracle) -> Callable[[Callable[Arguments, Cases]], Compared[Arguments]]:
    """Enter a function of cases in the table, in a group of the certificate.

    The function yields a `Case` each time, or of several rows a tuple of them, one for each.
    """

    def enter(cases: Callable[Arguments, Cases]) -> Compared[Arguments]:
        TABLE.append(Compared(group, rows, cases))
        return TABLE[-1]

    return enter


def outcome(row: Oracle, group: str, said: dict[str, Any], cases: Iterable[Case]) -> Check:
    """The worst of a row's cases: the largest gap, the first of equals; a NaN is larger than anything."""
    worst, where, samples = -math.inf, "", 0
    plots: list[Plot] = []
    for case in cases:
        gaps = np.ravel(case.gaps)
        samples += gaps.size if case.samples is None else case.samples
        plots += case.plots
        at = int(np.argmax(gaps)) if gaps.size else -1  # a NaN, if there is one
        if at >= 0 and not (gaps[at] <= worst or math.isnan(worst)):
            worst, words = float(gaps[at]), case.where
            where = words if isinstance(words, str) else words(at) if worst else EVERYWHERE
    if worst < 0.0:  # nothing was compared
        worst, where = 0.0, EVERYWHERE
    task = said["task"]
    name, oracle = (text.format_map(said) for text in (row.name, row.oracle))
    return Check(
        name, oracle, samples, worst, row.tolerance, where, group, getattr(task, "name", task), row.unit, tuple(plots)
    )


# -- orders of convergence ----------------------------------------------------------------------------------


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

    Of at least three steps > 0; an error that is zero or NaN makes the slope a NaN.
    """
    from scipy import stats  # the certificate's reader does without

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
        rounding two steps before it, with as much again for rounding's scatter: `ORDER_TOLERANCE` times its share in
        that.
        """
        clear = ~(self.errors <= self.rounding) | (self.rounding == 0.0)  # NaN is clear
        spread = f"errors {self.errors[0]:.2g} to {self.errors[-1]:.2g}"
        if clear.sum() >= 3 or not self.rounding:
            slope = fit_slope(self.steps[clear], self.errors[clear])
            return slope.distance(promised), f"{self.label}: slope {slope}, {spread}"
        share = float(self.errors.max() / (2.0 * self.rounding * (self.steps[0] / self.steps[2]) ** promised))
        share = math.inf if math.isnan(share) else share
        return ORDER_TOLERANCE * share, f"{self.label}: exact to rounding, {self.rounding:.2g}: {spread}"


def of_order(promised: float, families: list[Family], title: str, x_label: str, y_label: str) -> Case:
    """How far from the promised order every family's errors vanish, intervals included; drawn with that slope."""
    found = [one.judged(promised) for one in families]
    curves = [Curve(text.partition(", ")[0], f.steps, f.errors) for f, (_, text) in zip(families, found, strict=True)]
    first = families[0]
    guide = 0.5 * first.errors[-1] * (first.steps / first.steps[-1]) ** promised  # beside the errors, not upon them
    curves.append(Curve(f"slope {promised:g}, as promised", first.steps, guide, reference=True))
    plot = Plot(title, x_label, y_label, tuple(curves), x_log=True, y_log=True)
    distance, where = max(found, key=lambda one: one[0])
    return Case(distance, where, sum(len(one.steps) for one in families), (plot,))
