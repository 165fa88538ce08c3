"""Whether what was reported is what is found: checks as pure functions of values over seeds.

What was reported is one number, as a rule from one run or one episode. What is found is a sample
over seeds. One rule judges bounds and comparisons: the 95 % interval lies inside (*confirmed*),
outside (*not confirmed*), or across (*open*). What was said of one run or one episode, and could be
one of ours, is only *compatible*.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.inference import Stratum, effect

OUTCOMES = ("confirmed", "compatible", "open", "not confirmed", "not testable")
"""What a check may come to."""
CONFIRMED, COMPATIBLE, OPEN, NOT_CONFIRMED, NOT_TESTABLE = OUTCOMES


class Verdict(NamedTuple):
    """What a check came to."""

    outcome: str
    """One of `OUTCOMES`."""
    reason: str
    """Why."""
    measured: Interval | None = None
    """What was found, and its 95 % interval over seeds; None if nothing."""
    samples: int = 0
    """Number of seeds, of the arm that has the fewest."""
    p: float | None = None
    """Of no difference, where two arms are compared: Welch's t test, two-sided, of this comparison alone."""


@dataclasses.dataclass(frozen=True)
class Check:
    """How values over seeds are judged: one value for each seed of every arm; of a time in an episode, an array."""

    rule: str
    """`mean`, `difference`, `paired`, `one run`, `one episode` or `every seed`."""
    low: float
    """Lower bound, or the number that was reported of one run or episode."""
    high: float
    """Upper bound, or the same number."""
    criterion: str
    """When it is passed, in words."""
    judge: Callable[..., Verdict]
    """Of each arm's values."""
    least: int = 2
    """Seeds that it takes."""

    def __call__(self, *values: Any) -> Verdict:
        """Judge one value for each seed of every arm, shape (n,)."""
        samples = min(map(len, values))
        if samples < self.least:
            reason = (
                "one seed: it takes two to say how runs differ" if samples else "no published value"
            )
            return Verdict(NOT_TESTABLE, reason, samples=samples)
        return self.judge(*values)._replace(samples=samples)


def mean_interval(values: np.ndarray) -> Interval:
    """Mean over seeds and its 95 % interval by Student's t; of one value, or of equal ones, a point.

    Args:
        values: shape (n,), n >= 1.
    """
    mean = float(np.mean(values))
    if np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    from scipy.special import stdtrit

    half = float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) / math.sqrt(len(values)))
    return Interval(mean, mean - half, mean + half)


def place(measured: Interval, low: float, high: float) -> tuple[str, str]:
    """The one rule: what a 95 % interval comes to, against bounds that are included, and why."""
    if low <= measured.low and measured.high <= high:
        return CONFIRMED, "the whole interval is"
    if measured.high < low or measured.low > high:
        return NOT_CONFIRMED, "the whole interval is beyond"
    return OPEN, "the interval lies across: more seeds would tell"


def within(low: float = -math.inf, high: float = math.inf) -> Check:
    """The mean over seeds lies between bounds."""

    def judge(values: np.ndarray) -> Verdict:
        measured = mean_interval(values)
        return Verdict(*place(measured, low, high), measured)

    bounds = f"from {number(low)} to {number(high)}"
    if math.isinf(low) or math.isinf(high):
        bounds = f"at most {number(high)}" if math.isinf(low) else f"at least {number(low)}"
    return Check("mean", low, high, f"the 95 % interval of the mean is {bounds}", judge)


def same(margin: float, paired: bool = False) -> Check:
    """Both arms have the same mean, up to a margin.

    Args:
        margin: difference that does not matter.
        paired: whether the n-th values of both belong together, as those of one seed on two kinds
            of physics do.
    """
    kind = "paired t" if paired else "Welch"
    criterion = f"the 95 % interval of the difference ({kind}) is within ±{number(margin)}"
    return _difference(-margin, margin, criterion, paired)


def higher(margin: float) -> Check:
    """The mean of the one arm is higher than the other's by more than what does not matter."""
    criterion = f"the 95 % interval of the difference (Welch) is above {number(margin)}"
    return _difference(margin, math.inf, criterion, paired=False)


def _difference(low: float, high: float, criterion: str, paired: bool) -> Check:
    def judge(values: np.ndarray, others: np.ndarray) -> Verdict:
        from scipy.stats import ttest_ind, ttest_rel

        measured = effect([Stratum(values, others, paired)])
        outcome, reason = place(measured, low, high)
        if measured.low == measured.high:  # without any spread there is no statistic
            reason = "no two values differ" if measured.mean == 0 else reason
            return Verdict(outcome, reason, measured, p=float(measured.mean == 0))
        test = ttest_rel(values, others) if paired else ttest_ind(values, others, equal_var=False)
        return Verdict(outcome, reason, measured, p=float(test.pvalue))

    return Check("paired" if paired else "difference", low, high, criterion, judge)


def one_run(figure: float) -> Check:
    """A number that was read off one run could be one of our runs': by the prediction interval of one more."""

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
    """A time [s] that was read off one episode could be one of our episodes'.

    It is judged by an array for each seed: times of test episodes [s], infinite where the goal was
    not reached. What is measured is the mean over seeds of the median over episodes that arrive.
    """

    def judge(times: list[np.ndarray]) -> Verdict:
        every = np.concatenate(times)
        arrived = every[np.isfinite(every)]
        if not len(arrived):
            return Verdict(NOT_CONFIRMED, f"none of {len(every)} episodes arrives")
        low, high = central_range(arrived)
        reason = f"95 % of those that arrive take {number(low)} to {number(high)} s"
        if len(arrived) < len(every):
            reason += f"; {len(every) - len(arrived)} of {len(every)} never arrive"
        outcome = COMPATIBLE if low <= figure <= high else NOT_CONFIRMED
        return Verdict(outcome, reason, mean_interval(medians(times)))

    criterion = f"{number(figure)} s is within the range of 95 % of the test episodes that arrive"
    return Check("one episode", figure, figure, criterion, judge, least=1)


def every_seed(limit: float) -> Check:
    """The value of every seed is at most a limit."""

    def judge(values: np.ndarray) -> Verdict:
        beyond = int(np.sum(values > limit))
        reason = (
            f"{beyond} of {len(values)} seeds are beyond; the largest has"
            f" {number(float(np.max(values)))}"
        )
        return Verdict(NOT_CONFIRMED if beyond else CONFIRMED, reason, mean_interval(values))

    return Check(
        "every seed", -math.inf, limit, f"at most {number(limit)} in every seed", judge, least=1
    )


def medians(times: list[np.ndarray]) -> np.ndarray:
    """The median time of each seed's episodes that arrive; seeds of which none does are left out."""
    arriving = [of_seed[np.isfinite(of_seed)] for of_seed in times]
    return np.array([np.median(of_seed) for of_seed in arriving if len(of_seed)])


def prediction_interval(values: np.ndarray) -> tuple[float, float]:
    """Where one more value of the same normal distribution lies with a probability of 95 %.

    mean -+ t * s * sqrt(1 + 1/n), with Student's t of n - 1 degrees of freedom and the sample's
    standard deviation s.

    Args:
        values: shape (n,), n >= 2.
    """
    from scipy.special import stdtrit

    count = len(values)
    reach = stdtrit(count - 1, 0.975) * np.std(values, ddof=1) * math.sqrt(1 + 1 / count)
    return float(np.mean(values) - reach), float(np.mean(values) + reach)


def central_range(values: np.ndarray) -> tuple[float, float]:
    """The values between which the central 95 % lie: the smallest that 2.5 % and 97.5 % do not exceed.

    Args:
        values: shape (n,), n >= 1.
    """
    low, high = np.quantile(values, (0.025, 0.975), method="inverted_cdf")
    return float(low), float(high)


def number(value: float) -> str:
    """A number as text: three digits, four from 100 on, or all before the point."""
    return (
        f"{value:.3g}"
        if abs(value) < 100
        else f"{value:.4g}"
        if abs(value) < 1000
        else f"{value:.0f}"
    )
