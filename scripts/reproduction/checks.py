"""Checks of reported numbers against measured ones: pure functions of values over seeds.

A reported number is usually from one run or one episode. The measured values are a sample over
seeds. One rule judges bounds and comparisons: the 95 % interval lies inside (*confirmed*), outside
(*not confirmed*), or across (*open*). If a statement is about a single run or episode that could be
one of ours, it is only *compatible*.
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
    """Number of seeds of the arm that has the fewest."""
    p: float | None = None
    """p-value of no difference between two arms: two-sided t test, not corrected."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Rule that judges one value for each seed of every arm; an array if times are judged."""

    rule: str
    """`mean`, `difference`, `paired`, `one run`, `one episode` or `every seed`."""
    low: float
    """Lower bound, or the number that is reported for one run or episode."""
    high: float
    """Upper bound, or the same number."""
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


def one_run(figure: float) -> Check:
    """Return the check that a number from one run is within the prediction interval of ours."""

    def judge(values: np.ndarray) -> Verdict:
        low, high = prediction_interval(values)
        reason = (
            f"95 % of single runs lie from {number(low)} to {number(high)} (Student's prediction"
            " interval)"
        )
        return Verdict(
            COMPATIBLE if low <= figure <= high else NOT_CONFIRMED, reason, mean_interval(values)
        )

    criterion = f"{number(figure)} is within the range of 95 % of single runs"
    return Check("one run", figure, figure, criterion, judge)


def one_episode(figure: float) -> Check:
    """Return the check that a time [s] from one episode is within the range of our episodes'.

    It judges an array for each seed: times of test episodes [s], infinite if the goal was not
    reached. The measured value is the mean over seeds of the median over episodes that arrive.
    """

    def judge(times: list[np.ndarray]) -> Verdict:
        all_times = np.concatenate(times)
        arrived = all_times[np.isfinite(all_times)]
        if not len(arrived):
            return Verdict(NOT_CONFIRMED, f"none of {len(all_times)} episodes arrives")
        low, high = central_range(arrived)
        reason = f"95 % of those that arrive take {number(low)} to {number(high)} s"
        if len(arrived) < len(all_times):
            reason += f"; {len(all_times) - len(arrived)} of {len(all_times)} never arrive"
        outcome = COMPATIBLE if low <= figure <= high else NOT_CONFIRMED
        return Verdict(outcome, reason, mean_interval(medians(times)))

    criterion = f"{number(figure)} s is within the range of 95 % of the test episodes that arrive"
    return Check("one episode", figure, figure, criterion, judge, min_seeds=1)


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
