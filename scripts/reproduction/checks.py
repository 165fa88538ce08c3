"""Whether what was reported is what is found: checks as pure functions of values over seeds.

What was reported is one number, as a rule from one run or one episode. What is found is a sample over seeds. What holds
over them is *confirmed*; what was said of one run or one episode, and could be one of ours, is only *compatible*.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval, bootstrap_mean
from codrl_mj.study.inference import Stratum, effect

OUTCOMES = ("confirmed", "compatible", "not confirmed", "not testable")
"""What a check may come to."""
CONFIRMED, COMPATIBLE, NOT_CONFIRMED, NOT_TESTABLE = OUTCOMES


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


@dataclasses.dataclass(frozen=True)
class Check:
    """How values over seeds are judged."""

    criterion: str
    """When it is passed, in words."""
    judge: Callable[..., tuple[bool, str, Interval | None]]
    """Of each arm's values, one for each seed: whether it is passed, why, and what was found."""
    passed: str = CONFIRMED
    """What it then comes to."""
    least: int = 1
    """Seeds that it takes."""
    paired: bool = False
    """Whether the n-th values of all arms are to be of one seed."""

    def __call__(self, *values: Any) -> Verdict:
        """Judge one value for each seed of every arm, shape (n,)."""
        samples = min(map(len, values))
        if samples == 0:
            return Verdict(NOT_TESTABLE, "no finished run")
        if samples < self.least:
            measured = bootstrap_mean(values[0]) if len(values) == 1 else None
            return Verdict(NOT_TESTABLE, "one seed: it takes two to say how runs differ", measured, samples)
        holds, reason, measured = self.judge(*values)
        return Verdict(self.passed if holds else NOT_CONFIRMED, reason, measured, samples)


def within(low: float = -math.inf, high: float = math.inf) -> Check:
    """The mean over seeds lies in a band, bounds included."""

    def judge(values: np.ndarray) -> tuple[bool, str, Interval]:
        measured = bootstrap_mean(values)
        inside = low <= measured.mean <= high
        if measured.low == measured.high:
            reason = f"every seed has {number(measured.mean)}" if len(values) > 1 else "one seed: no interval"
        elif inside:
            whole = low <= measured.low and measured.high <= high
            reason = "the whole interval is" if whole else f"the mean is; the interval reaches beyond: {_MORE}"
        else:
            beyond = measured.high < low or measured.low > high
            reason = "the whole interval is beyond" if beyond else f"the mean is not; the interval reaches in: {_MORE}"
        return inside, reason, measured

    bounds = f"from {number(low)} to {number(high)}"
    if math.isinf(low) or math.isinf(high):
        bounds = f"at most {number(high)}" if math.isinf(low) else f"at least {number(low)}"
    return Check(f"mean over seeds {bounds}", judge)


def one_run(figure: float) -> Check:
    """A number that was read off one run could be one of our runs': by the prediction interval of one more."""

    def judge(values: np.ndarray) -> tuple[bool, str, Interval]:
        low, high = prediction_interval(values)
        reason = f"95 % of single runs lie from {number(low)} to {number(high)} (Student's prediction interval)"
        return low <= figure <= high, reason, bootstrap_mean(values)

    return Check(f"{number(figure)} is within the range of 95 % of single runs", judge, COMPATIBLE, least=2)


def one_episode(figure: float) -> Check:
    """A time [s] that was read off one episode could be one of our episodes'.

    It is judged by an array for each seed: times of test episodes [s], infinite where the goal was not reached. What is
    measured is the mean over seeds of the median over episodes that arrive.
    """

    def judge(times: list[np.ndarray]) -> tuple[bool, str, Interval | None]:
        arriving = [of_seed[np.isfinite(of_seed)] for of_seed in times]
        arrived, count = np.concatenate(arriving), sum(map(len, times))
        if not len(arrived):
            return False, f"none of {count} episodes arrives", None
        low, high = central_range(arrived)
        reason = f"95 % of those that arrive take {number(low)} to {number(high)} s"
        if len(arrived) < count:
            reason += f"; {100 * (1 - len(arrived) / count):.0f} % never arrive"
        medians = np.array([np.median(of_seed) for of_seed in arriving if len(of_seed)])
        return low <= figure <= high, reason, bootstrap_mean(medians)

    criterion = f"{number(figure)} s is within the range of 95 % of the test episodes that arrive"
    return Check(criterion, judge, COMPATIBLE)


def every_seed(limit: float) -> Check:
    """The value of every seed is at most a limit."""

    def judge(values: np.ndarray) -> tuple[bool, str, Interval]:
        beyond = int(np.sum(values > limit))
        reason = f"{beyond} of {len(values)} seeds are beyond; the largest has {number(float(np.max(values)))}"
        return not beyond, reason, bootstrap_mean(values)

    return Check(f"at most {number(limit)} in every seed", judge)


def higher() -> Check:
    """The mean of the one arm is higher than the other's: Welch's t test over seeds."""

    def judge(values: np.ndarray, others: np.ndarray) -> tuple[bool, str, Interval]:
        from scipy.stats import ttest_ind

        measured = effect([Stratum(values, others)])
        alike = measured.low == measured.high  # without any spread there is no statistic
        p = float(measured.mean == 0) if alike else ttest_ind(values, others, equal_var=False).pvalue
        found = "higher" if measured.low > 0 else "lower" if measured.high < 0 else "no difference can be told"
        means = number(float(np.mean(values))), number(float(np.mean(others)))
        return measured.low > 0, f"means {means[0]} and {means[1]}, p = {p:.2g}: {found}", measured

    return Check("the 95 % interval of the difference (Welch) is above 0", judge, least=2)


def same(margin: float, paired: bool = False) -> Check:
    """Both arms have the same mean, up to a margin, included.

    Args:
        margin: difference that does not matter.
        paired: whether the n-th values of both belong together, as those of one seed on two kinds of physics do.
    """

    def judge(values: np.ndarray, others: np.ndarray) -> tuple[bool, str, Interval]:
        measured = effect([Stratum(values, others, paired)])
        inside = -margin <= measured.low and measured.high <= margin
        if inside:
            reason = "no two values differ" if measured == (0.0, 0.0, 0.0) else "the whole interval is"
        else:
            beyond = measured.low > margin or measured.high < -margin
            reason = "they differ by more" if beyond else f"the interval is too wide: {_MORE}"
        return inside, reason, measured

    kind = "paired t" if paired else "Welch"
    criterion = f"the 95 % interval of the difference ({kind}) is within ±{number(margin)}"
    return Check(criterion, judge, least=2, paired=paired)


_MORE = "more seeds would tell"


def prediction_interval(values: np.ndarray) -> tuple[float, float]:
    """Where one more value of the same normal distribution lies with a probability of 95 %.

    mean -+ t * s * sqrt(1 + 1/n), with Student's t of n - 1 degrees of freedom and the sample's standard deviation s.

    Args:
        values: shape (n,), n >= 2.
    """
    from scipy.stats import t

    count = len(values)
    reach = t.ppf(0.975, count - 1) * np.std(values, ddof=1) * math.sqrt(1 + 1 / count)
    return float(np.mean(values) - reach), float(np.mean(values) + reach)


def central_range(values: np.ndarray) -> tuple[float, float]:
    """The values between which the central 95 % lie: the smallest that 2.5 % and 97.5 % do not exceed.

    Args:
        values: shape (n,), n >= 1.
    """
    low, high = np.quantile(values, (0.025, 0.975), method="inverted_cdf")
    return float(low), float(high)


def number(value: float) -> str:
    """A number as text: four digits, or all before the point."""
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
