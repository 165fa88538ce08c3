"""Checks of reported numbers against measured ones: pure functions of values over seeds.

A reported number is usually from one run or one episode. The measured values are a sample over
seeds. One rule judges bounds and comparisons: the 95 % interval lies inside (*confirmed*), outside
(*not confirmed*), or across (*open*). If a statement is about a single run or episode that could be
one of ours, it is only *compatible*, unless the interval of our mean lies in a range that the
statement leaves.

Ranges include their ends: a value that equals an end lies inside. "Under 85 s" excludes 85 s.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.inference import Stratum, effect

OUTCOMES = ("confirmed", "compatible", "open", "not confirmed", "not testable")
"""Possible outcomes of a check."""
CONFIRMED, COMPATIBLE, OPEN, NOT_CONFIRMED, NOT_TESTABLE = OUTCOMES


class Verdict(NamedTuple):
    """Result of a check."""

    outcome: str
    """One of `OUTCOMES`."""
    reason: str
    """Reason for the outcome."""
    measured: Interval | None = None
    """Measured value, with its 95 % interval over seeds; None if there is none."""
    samples: int = 0
    """Number of trainings of the arm that has the fewest; a seed may have two."""
    p: float | None = None
    """p-value of no difference between two arms: two-sided t test, not corrected."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Rule that judges one value for each seed of every arm; an array if times are judged."""

    rule: str
    """Name of the rule, such as `mean`; examples/recompute_reproduction.py has all of them."""
    low: float
    """Lower bound of what is stated; equal to `high` if that is a number."""
    high: float
    """Upper bound; only *under* excludes the bound itself."""
    criterion: str
    """Condition in words."""
    judge: Callable[..., Verdict]
    """Function that judges the values of each arm."""
    min_seeds: int = 2
    """Number of seeds that are needed."""

    def __call__(self, *values: Any) -> Verdict:
        """Judge one value for each seed of every arm, shape (n,)."""
        samples = min(map(len, values))
        if samples < self.min_seeds:
            reason = (
                "one seed: it takes two to say how runs differ" if samples else "no published value"
            )
            return Verdict(NOT_TESTABLE, reason, samples=samples)
        return self.judge(*values)._replace(samples=samples)


def mean_interval(values: np.ndarray) -> Interval:
    """Return the mean over seeds and its 95 % interval by Student's t; a point if all are equal.

    Args:
        values: shape (n,), n >= 1.
    """
    mean = float(np.mean(values))
    if np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    from scipy.special import stdtrit

    half = float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) / math.sqrt(len(values)))
    return Interval(mean, mean - half, mean + half)


def judge_interval(measured: Interval, low: float, high: float) -> tuple[str, str]:
    """Judge a 95 % interval against inclusive bounds; return the outcome and the reason."""
    if low <= measured.low and measured.high <= high:
        return CONFIRMED, "the whole interval is"
    if measured.high < low or measured.low > high:
        return NOT_CONFIRMED, "the whole interval is beyond"
    return OPEN, "the interval lies across: more seeds would tell"


def within(low: float = -math.inf, high: float = math.inf) -> Check:
    """Return the check that the mean over seeds lies between bounds."""

    def judge(values: np.ndarray) -> Verdict:
        measured = mean_interval(values)
        return Verdict(*judge_interval(measured, low, high), measured)

    bounds = f"from {number(low)} to {number(high)}"
    if math.isinf(low) or math.isinf(high):
        bounds = f"at most {number(high)}" if math.isinf(low) else f"at least {number(low)}"
    return Check("mean", low, high, f"the 95 % interval of the mean is {bounds}", judge)


def same(margin: float, paired: bool = False) -> Check:
    """Return the check that both arms have the same mean, up to a margin.

    Args:
        margin: largest difference that does not matter.
        paired: True if the n-th values of both belong together, such as those of one seed with both
            kinds of physics.
    """
    kind = "paired t" if paired else "Welch"
    criterion = f"the 95 % interval of the difference ({kind}) is within ±{number(margin)}"
    return _difference(-margin, margin, criterion, paired)


def higher(margin: float) -> Check:
    """Return the check that the first arm's mean is higher than the second's by over a margin."""
    criterion = f"the 95 % interval of the difference (Welch) is above {number(margin)}"
    return _difference(margin, math.inf, criterion, paired=False)


def _difference(low: float, high: float, criterion: str, paired: bool) -> Check:
    def judge(values: np.ndarray, others: np.ndarray) -> Verdict:
        from scipy.stats import ttest_ind, ttest_rel

        measured = effect([Stratum(values, others, paired)])
        outcome, reason = judge_interval(measured, low, high)
        # Without any spread there is no test statistic.
        if measured.low == measured.high:
            reason = "no two values differ" if measured.mean == 0 else reason
            return Verdict(outcome, reason, measured, p=float(measured.mean == 0))
        test = ttest_rel(values, others) if paired else ttest_ind(values, others, equal_var=False)
        return Verdict(outcome, reason, measured, p=float(test.pvalue))

    return Check("paired" if paired else "difference", low, high, criterion, judge)


def judge_single(measured: Interval, single: tuple[float, float], low: float, high: float) -> str:
    """Judge a range that is stated for one run or episode; if low is high, it is a number.

    The interval of our mean can only confirm a range. `single` is the range of 95 % of our single
    runs or episodes.
    """
    if low < high and judge_interval(measured, low, high)[0] == CONFIRMED:
        return CONFIRMED
    return COMPATIBLE if single[0] <= high and low <= single[1] else NOT_CONFIRMED


def _stated(low: float, high: float) -> str:
    return number(low) if low == high else f"a value from {number(low)} to {number(high)}"


def one_run(figure: float, tolerance: float = 0.0) -> Check:
    """Return the check that a number from one run is within the prediction interval of ours.

    The tolerance is the reach of "about" on both sides.
    """
    low, high = figure - tolerance, figure + tolerance

    def judge(values: np.ndarray) -> Verdict:
        single, measured = prediction_interval(values), mean_interval(values)
        reason = "95 % of single runs lie from {} to {} (Student's prediction interval)"
        outcome = judge_single(measured, single, low, high)
        return Verdict(outcome, reason.format(*map(number, single)), measured)

    criterion = f"{_stated(low, high)} is within the range of 95 % of single runs"
    return Check("one run", low, high, criterion, judge)


def one_episode(figure: float, tolerance: float = 0.0, under: bool = False) -> Check:
    """Return the check that a time [s] from one episode is within the range of our episodes'.

    It judges an array for each seed: times of test episodes [s], infinite if the goal was not
    reached. The measured value is the mean over seeds of the median over episodes that arrive. The
    tolerance is the reach of "about" on both sides; `under` excludes the figure and later times.
    """
    low, high = -math.inf if under else figure - tolerance, figure + tolerance

    def judge(times: list[np.ndarray]) -> Verdict:
        all_times = np.concatenate(times)
        arrived = all_times[np.isfinite(all_times)]
        if not len(arrived):
            return Verdict(NOT_CONFIRMED, f"none of {len(all_times)} episodes arrives")
        single, measured = central_range(arrived), mean_interval(medians(times))
        reason = "95 % of those that arrive take {} to {} s".format(*map(number, single))
        if under:
            share = 100 * float(np.mean(arrived < figure))
            reason += f"; {number(share)} % take less than {number(figure)} s"
        if len(arrived) < len(all_times):
            reason += f"; {len(all_times) - len(arrived)} of {len(all_times)} never arrive"
        # A time that equals the figure is not under it.
        highest = math.nextafter(high, low) if under else high
        return Verdict(judge_single(measured, single, low, highest), reason, measured)

    time = f"a time under {number(figure)}" if under else _stated(low, high)
    criterion = f"{time} s is within the range of 95 % of the test episodes that arrive"
    return Check("under" if under else "one episode", low, high, criterion, judge, min_seeds=1)


def behavior(usual: float) -> Check:
    """Return the check of a behavior that one episode shows, by the share of our episodes.

    It is confirmed if the whole interval of the share is at least `usual`, and compatible if the
    share is at least 1 - `usual`, so that the paper's episode is no accident.
    """

    def judge(shares: np.ndarray) -> Verdict:
        measured = mean_interval(shares)
        compatible = COMPATIBLE if measured.mean + usual >= 1.0 else NOT_CONFIRMED
        outcome = CONFIRMED if measured.low >= usual else compatible
        return Verdict(outcome, f"{number(100 * measured.mean)} % of ours show it", measured)

    criterion = (
        f"the 95 % interval of the share is at least {number(usual)} (*compatible*: its mean"
    )
    criterion += f" is at least {number(1.0 - usual)})"
    return Check("behavior", usual, math.inf, criterion, judge)


def every_seed(limit: float) -> Check:
    """Return the check that the value of every seed is at most a limit."""

    def judge(values: np.ndarray) -> Verdict:
        beyond = int(np.sum(values > limit))
        reason = (
            f"{beyond} of {len(values)} seeds are beyond; the largest has"
            f" {number(float(np.max(values)))}"
        )
        return Verdict(NOT_CONFIRMED if beyond else CONFIRMED, reason, mean_interval(values))

    return Check(
        "every seed", -math.inf, limit, f"at most {number(limit)} in every seed", judge, min_seeds=1
    )


def medians(times: list[np.ndarray]) -> np.ndarray:
    """Return the median time of each seed's arriving episodes, without seeds where none arrive."""
    arriving = [seed_times[np.isfinite(seed_times)] for seed_times in times]
    return np.array([np.median(seed_times) for seed_times in arriving if len(seed_times)])


def prediction_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the interval that contains another value of the distribution with 95 % probability.

    The interval is mean -+ t * s * sqrt(1 + 1/n), with Student's t of n - 1 degrees of freedom and
    the sample's standard deviation s; the distribution is assumed to be normal.

    Args:
        values: shape (n,), n >= 2.
    """
    from scipy.special import stdtrit

    count = len(values)
    half_width = stdtrit(count - 1, 0.975) * np.std(values, ddof=1) * math.sqrt(1 + 1 / count)
    return float(np.mean(values) - half_width), float(np.mean(values) + half_width)


def central_range(values: np.ndarray) -> tuple[float, float]:
    """Return the range of the central 95 %: 2.5 % and 97.5 % quantiles, which are sample values.

    Args:
        values: shape (n,), n >= 1.
    """
    low, high = np.quantile(values, (0.025, 0.975), method="inverted_cdf")
    return float(low), float(high)


def number(value: float) -> str:
    """Format a number with three digits, four from 100 on, or all digits before the point."""
    return (
        f"{value:.3g}"
        if abs(value) < 100
        else f"{value:.4g}"
        if abs(value) < 1000
        else f"{value:.0f}"
    )
