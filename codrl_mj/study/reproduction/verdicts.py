"""Whether what was reported is what is found: checks as pure functions of values over seeds.

What was reported is one number, as a rule from one run or one episode. What is found is a sample over seeds. Each check
says in words when it is passed (`criterion`), and gives a `Verdict`.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from codrl_mj.evaluation.measures import Interval, bootstrap_mean

CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE = "confirmed", "not confirmed", "not testable"
LEVEL = 0.95
"""Of every interval."""
_MORE = "more seeds would tell"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a check came to."""

    outcome: str
    """`confirmed`, `not confirmed` or `not testable`."""
    reason: str
    """Why."""
    measured: Interval | None = None
    """What was found, and its 95 % interval over seeds; None if nothing."""
    samples: int = 0
    """Number of seeds, of the arm that has the fewest."""


@dataclasses.dataclass(frozen=True)
class Within:
    """The mean over seeds lies in a band."""

    low: float = -math.inf
    """Lower bound, included."""
    high: float = math.inf
    """Upper bound, included."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        if math.isinf(self.low):
            return f"mean over seeds at most {number(self.high)}"
        if math.isinf(self.high):
            return f"mean over seeds at least {number(self.low)}"
        return f"mean over seeds from {number(self.low)} to {number(self.high)}"

    def __call__(self, values: np.ndarray) -> Verdict:
        """Judge one value for each seed, shape (n,)."""
        if len(values) == 0:
            return _nothing()
        measured = bootstrap_mean(values)
        inside = self.low <= measured.mean <= self.high
        if measured.low == measured.high:
            reason = f"every seed has {number(measured.mean)}" if len(values) > 1 else "one seed: no interval"
        elif inside:
            whole = self.low <= measured.low and measured.high <= self.high
            reason = (
                "the whole interval is" if whole else "the mean is; the interval reaches beyond: more seeds would tell"
            )
        else:
            beyond = measured.high < self.low or measured.low > self.high
            reason = (
                "the whole interval is beyond"
                if beyond
                else "the mean is not; the interval reaches in: more seeds would tell"
            )
        return Verdict(CONFIRMED if inside else NOT_CONFIRMED, reason, measured, len(values))


@dataclasses.dataclass(frozen=True)
class OneRun:
    """A number that was read off one run could be one of our runs'."""

    figure: float
    """The number."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        return f"{number(self.figure)} is within the range of 95 % of single runs"

    def __call__(self, values: np.ndarray) -> Verdict:
        """Judge one value for each seed, shape (n,), by the prediction interval of one more run."""
        if len(values) == 0:
            return _nothing()
        measured = bootstrap_mean(values)
        if len(values) == 1:
            return Verdict(NOT_TESTABLE, "one seed: it takes two to say how runs differ", measured, 1)
        low, high = prediction_interval(values)
        inside = low <= self.figure <= high
        reason = f"95 % of single runs lie from {number(low)} to {number(high)} (Student's prediction interval)"
        return Verdict(CONFIRMED if inside else NOT_CONFIRMED, reason, measured, len(values))


@dataclasses.dataclass(frozen=True)
class OneEpisode:
    """A time that was read off one episode could be one of our episodes'."""

    figure: float
    """The time [s]."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        return f"{number(self.figure)} s is within the range of 95 % of the test episodes that arrive"

    def __call__(self, times: Sequence[np.ndarray]) -> Verdict:
        """Judge times of test episodes [s], infinite where the goal was not reached: an array for each seed.

        What is reported as measured is the mean over seeds of the median over episodes that arrive.
        """
        if len(times) == 0:
            return _nothing()
        arriving = [of_seed[np.isfinite(of_seed)] for of_seed in times]
        arrived = np.concatenate(arriving)
        count = sum(map(len, times))
        if not len(arrived):
            return Verdict(NOT_CONFIRMED, f"none of {count} episodes arrives", None, len(times))
        low, high = central_range(arrived)
        reason = f"95 % of those that arrive take {number(low)} to {number(high)} s"
        if len(arrived) < count:
            reason += f"; {100 * (1 - len(arrived) / count):.0f} % never arrive"
        measured = bootstrap_mean(np.array([np.median(of_seed) for of_seed in arriving if len(of_seed)]))
        inside = low <= self.figure <= high
        return Verdict(CONFIRMED if inside else NOT_CONFIRMED, reason, measured, len(times))


@dataclasses.dataclass(frozen=True)
class EverySeed:
    """The value of every seed is at most a limit."""

    limit: float
    """The limit, included."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        return f"at most {number(self.limit)} in every seed"

    def __call__(self, values: np.ndarray) -> Verdict:
        """Judge one value for each seed, shape (n,)."""
        if len(values) == 0:
            return _nothing()
        beyond = int(np.sum(values > self.limit))
        reason = f"{beyond} of {len(values)} seeds are beyond; the largest has {number(float(np.max(values)))}"
        return Verdict(NOT_CONFIRMED if beyond else CONFIRMED, reason, _mean(values), len(values))


@dataclasses.dataclass(frozen=True)
class SomeSeed:
    """The value of some seed is at least a limit."""

    limit: float
    """The limit, included."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        return f"at least {number(self.limit)} in some seed"

    def __call__(self, values: np.ndarray) -> Verdict:
        """Judge one value for each seed, shape (n,)."""
        if len(values) == 0:
            return _nothing()
        there = int(np.sum(values >= self.limit))
        reason = f"so in {there} of {len(values)} seeds; the largest has {number(float(np.max(values)))}"
        return Verdict(CONFIRMED if there else NOT_CONFIRMED, reason, _mean(values), len(values))


@dataclasses.dataclass(frozen=True)
class Higher:
    """The mean of one arm is higher than another's: Welch's t test over seeds."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        return "the 95 % interval of the difference (Welch) is above 0"

    def __call__(self, values: np.ndarray, others: np.ndarray) -> Verdict:
        """Judge one value for each seed of both arms, shapes (n,) and (m,)."""
        samples = min(len(values), len(others))
        if samples == 0:
            return _nothing()
        if samples == 1:
            return Verdict(NOT_TESTABLE, "one seed: it takes two to say how runs differ", None, 1)
        measured, p_value = difference(values, others)
        reason = f"means {number(float(np.mean(values)))} and {number(float(np.mean(others)))}, p = {p_value:.2g}: " + (
            "higher" if measured.low > 0 else "lower" if measured.high < 0 else "no difference can be told"
        )
        return Verdict(CONFIRMED if measured.low > 0 else NOT_CONFIRMED, reason, measured, samples)


@dataclasses.dataclass(frozen=True)
class Same:
    """Two arms have the same mean, up to a margin."""

    margin: float
    """Difference that does not matter, included."""
    paired: bool = False
    """Whether the n-th values of both belong together, as those of one seed on two kinds of physics do."""

    @property
    def criterion(self) -> str:
        """When it is confirmed."""
        kind = "paired t" if self.paired else "Welch"
        return f"the 95 % interval of the difference ({kind}) is within ±{number(self.margin)}"

    def __call__(self, values: np.ndarray, others: np.ndarray) -> Verdict:
        """Judge one value for each seed of both arms, shapes (n,) and (m,); n = m where they are paired."""
        samples = min(len(values), len(others))
        if samples == 0:
            return _nothing()
        if samples == 1:
            return Verdict(NOT_TESTABLE, "one seed: it takes two to say how runs differ", None, 1)
        measured, _ = paired_difference(values, others) if self.paired else difference(values, others)
        inside = -self.margin <= measured.low and measured.high <= self.margin
        if inside:
            reason = "no two values differ" if measured == (0.0, 0.0, 0.0) else "the whole interval is"
        else:
            beyond = measured.low > self.margin or measured.high < -self.margin
            reason = "they differ by more" if beyond else f"the interval is too wide: {_MORE}"
        return Verdict(CONFIRMED if inside else NOT_CONFIRMED, reason, measured, samples)


@dataclasses.dataclass(frozen=True)
class Holds:
    """A statement about what was computed without chance holds."""

    criterion: str
    """The statement."""

    def __call__(self, holds: bool | None, found: str = "") -> Verdict:
        """Judge whether it holds (None: it was not computed), and say what was found."""
        if holds is None:
            return Verdict(NOT_TESTABLE, "not computed")
        return Verdict(CONFIRMED if holds else NOT_CONFIRMED, found)


Check = Within | OneRun | OneEpisode | EverySeed | SomeSeed | Higher | Same | Holds


def _nothing() -> Verdict:
    return Verdict(NOT_TESTABLE, "no finished run")


def _mean(values: np.ndarray) -> Interval | None:
    """Mean over seeds with its interval; None if one of them is infinite."""
    return bootstrap_mean(values) if np.isfinite(values).all() else None


def prediction_interval(values: np.ndarray) -> tuple[float, float]:
    """Where one more value of the same normal distribution lies with a probability of 95 %.

    mean -+ t * s * sqrt(1 + 1/n), with Student's t of n - 1 degrees of freedom and the sample's standard deviation s.

    Args:
        values: shape (n,), n >= 2.
    """
    from scipy.stats import t

    count = len(values)
    reach = t.ppf((1 + LEVEL) / 2, count - 1) * np.std(values, ddof=1) * math.sqrt(1 + 1 / count)
    return float(np.mean(values) - reach), float(np.mean(values) + reach)


def central_range(values: np.ndarray) -> tuple[float, float]:
    """The values between which the central 95 % lie: the smallest that 2.5 % and 97.5 % do not exceed.

    Args:
        values: shape (n,), n >= 1.
    """
    ordered = np.sort(values)
    ranks = [math.ceil(round(share * len(ordered), 9)) - 1 for share in ((1 - LEVEL) / 2, (1 + LEVEL) / 2)]
    low, high = (float(ordered[max(rank, 0)]) for rank in ranks)
    return low, high


def difference(values: np.ndarray, others: np.ndarray) -> tuple[Interval, float]:
    """Difference of two means, its 95 % interval, and the p value that it is not 0: Welch's t test (scipy).

    Args:
        values: shape (n,), n >= 2.
        others: what is subtracted, shape (m,), m >= 2.
    """
    apart = float(np.mean(values) - np.mean(others))
    if np.ptp(values) == 0 and np.ptp(others) == 0:
        return Interval(apart, apart, apart), float(apart == 0)
    from scipy.stats import ttest_ind

    test = ttest_ind(values, others, equal_var=False)
    interval = test.confidence_interval(LEVEL)
    return Interval(apart, float(interval.low), float(interval.high)), float(test.pvalue)


def paired_difference(values: np.ndarray, others: np.ndarray) -> tuple[Interval, float]:
    """Mean of differences, its 95 % interval, and the p value that it is not 0: the paired t test (scipy).

    Args:
        values: shape (n,), n >= 2.
        others: what is subtracted, shape (n,).
    """
    apart = values - others
    mean = float(np.mean(apart))
    if np.ptp(apart) == 0:
        return Interval(mean, mean, mean), float(mean == 0)
    from scipy.stats import ttest_rel

    test = ttest_rel(values, others)
    interval = test.confidence_interval(LEVEL)
    return Interval(mean, float(interval.low), float(interval.high)), float(test.pvalue)


def number(value: float) -> str:
    """A number as text: four digits, or all before the point."""
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
