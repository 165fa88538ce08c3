"""The table of checks, and the one runner: the worst of what a check's cases found, where it was, and its picture.

A check is a function of cases: it yields what it compared, case by case, and says nothing of
verdicts. `check` enters its rows in `TABLE` and makes it one that returns them with what was found.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.viz.pages.plots import Curve, Plot

ORDER_TOLERANCE = 0.1
"""Farthest that any end of a slope's 95 % interval may lie from the promised order. A method one
order worse misses by 1; an error that does not vanish, such as a parameter off by 1 %, bends the
line until its slope is near 0.
"""


REPORT = "this is a fault of codrl_mj, or of this version of MuJoCo or Gymnasium; please report it"


@dataclasses.dataclass(frozen=True)
class Check:
    """A row of the table, whose name and oracle may hold words in braces; once it was made, what was found."""

    name: str
    """What was compared; stable, such as `one step, euler`, and unique within its group and task."""
    oracle: str
    """What it was compared with."""
    tolerance: float
    """Largest difference allowed."""
    unit: str = "relative"
    """Unit of `worst` and `tolerance`; `relative` measures each state entry against max(1, its size)."""
    samples: int = 0
    """How many comparisons were made."""
    worst: float = math.nan
    """Largest difference found."""
    where: str = ""
    """Where the largest difference was found."""
    group: str = ""
    """Which part of the certificate: dynamics, trajectories, convergence, motor, energy or execution."""
    task: str = ""
    """The task or model it was run on; empty where it needs none."""
    plots: tuple[Plot, ...] = ()
    """What to look at."""
    fault: str = ""
    """Of a check that failed: whose fault that is, and what to do."""

    @property
    def passed(self) -> bool:
        """Whether the port is right as far as this check sees; a NaN is a failure."""
        return bool(self.worst <= self.tolerance)

    @property
    def beyond(self) -> float:
        """How many times its tolerance the worst case is: above 1 it fails; a NaN is infinitely far."""
        if self.tolerance == 0.0 or math.isnan(self.worst):
            return 0.0 if self.worst == 0.0 else math.inf
        return self.worst / self.tolerance

    @property
    def margin(self) -> str:
        """Tolerance over worst case, as text."""
        if self.beyond == 0.0:
            return "exact"
        ratio = 1.0 / self.beyond
        return f"{ratio:.2g}" if ratio >= 1.005 or ratio < 1.0 else f"{ratio:.4g}"


@dataclasses.dataclass(frozen=True)
class Skipped:
    """A check that was not made."""

    name: str
    """What was not compared."""
    reason: str
    """Why it does not apply, or what it needs."""
    group: str = ""
    """Which part of the certificate; the certificate fills it in."""
    task: str = ""
    """The task or model; the certificate fills it in."""


def order(name: str, oracle: str) -> Check:
    """A row of slopes, which `of_order` finds: how far from the promised order errors vanish."""
    return Check(name, oracle, ORDER_TOLERANCE, "slope")


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
TABLE: list[Check] = []
"""The rows of every check of the modules that were imported."""


def check(group: str, *rows: Check) -> Callable[[Callable[..., Cases]], Callable[..., list[Check]]]:
    """Enter a function of cases in the table, in a group of the certificate.

    The function yields a `Case` each time, or of several rows a tuple of them, one for each;
    without a case there is no outcome. Words in the braces of rows are its arguments, or what it is
    called with besides, by name.
    """
    of_group = [dataclasses.replace(row, group=group) for row in rows]
    TABLE.extend(of_group)

    def enter(cases: Callable[..., Cases]) -> Callable[..., list[Check]]:
        signature = inspect.signature(cases)

        @functools.wraps(cases)
        def made(*arguments: Any, **named: Any) -> list[Check]:
            words = {
                name: named.pop(name) for name in list(named) if name not in signature.parameters
            }
            said = words | signature.bind(*arguments, **named).arguments
            found = [
                (case,) if isinstance(case, Case) else case for case in cases(*arguments, **named)
            ]
            of_rows = zip(*found, strict=True)
            return [
                outcome(row, said, several)
                for row, several in zip(of_group, of_rows, strict=bool(found))
            ]

        return made

    return enter


def outcome(row: Check, said: dict[str, Any], cases: Iterable[Case]) -> Check:
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
    name, oracle = (text.format_map(said) for text in (row.name, row.oracle))
    found: dict[str, Any] = {
        "samples": samples,
        "worst": worst,
        "where": where,
        "plots": tuple(plots),
    }
    return dataclasses.replace(row, name=name, oracle=oracle, **found)


# -- orders of convergence ----------------------------------------------------------------------------------


def fit_slope(steps: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """The exponent of a cloud of points on logarithmic axes, and half the width of its 95 % interval.

    Least squares on the logarithms, and Student's t at n - 2 degrees of freedom, of at least three
    steps > 0; an error that is zero or NaN makes both a NaN.
    """
    from scipy import stats  # the certificate's reader does without

    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.log(errors)
    if not np.isfinite(logarithms).all():
        return math.nan, math.nan
    fit = stats.linregress(np.log(steps), logarithms)
    return float(fit.slope), float(stats.t.ppf(0.975, len(steps) - 2) * fit.stderr)


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

        With fewer than three errors left there is no slope, and the largest may be what the
        promised order leaves over rounding two steps before it, with as much again for rounding's
        scatter: `ORDER_TOLERANCE` times its share in that.
        """
        clear = ~(self.errors <= self.rounding) | (self.rounding == 0.0)  # NaN is clear
        spread = f"errors {self.errors[0]:.2g} to {self.errors[-1]:.2g}"
        if clear.sum() >= 3 or not self.rounding:
            slope, half = fit_slope(self.steps[clear], self.errors[clear])
            distance = abs(slope - promised) + half  # of the farther end of the interval
            said = f"{self.label}: slope {slope:.3f} +- {half:.3f}, {spread}"
            return distance if math.isfinite(distance) else math.inf, said
        share = float(
            self.errors.max() / (2.0 * self.rounding * (self.steps[0] / self.steps[2]) ** promised)
        )
        share = math.inf if math.isnan(share) else share
        return (
            ORDER_TOLERANCE * share,
            f"{self.label}: exact to rounding, {self.rounding:.2g}: {spread}",
        )


def of_order(
    promised: float, families: list[Family], title: str, x_label: str, y_label: str
) -> Case:
    """How far from the promised order every family's errors vanish, intervals included; drawn with that slope."""
    found = [one.judged(promised) for one in families]
    curves = [
        Curve(text.partition(", ")[0], f.steps, f.errors)
        for f, (_, text) in zip(families, found, strict=True)
    ]
    first = families[0]
    guide = (
        0.5 * first.errors[-1] * (first.steps / first.steps[-1]) ** promised
    )  # beside the errors, not upon them
    curves.append(Curve(f"slope {promised:g}, as promised", first.steps, guide, reference=True))
    plot = Plot(title, x_label, y_label, tuple(curves), x_log=True, y_log=True)
    distance, where = max(found, key=lambda one: one[0])
    return Case(distance, where, sum(len(one.steps) for one in families), (plot,))
