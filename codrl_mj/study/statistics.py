"""Statistics over training runs, as Agarwal et al. (2021) recommend them for the few runs that there always are.

A score is a run's mean return over its test episodes: runs, not episodes, are what training repeats, so runs are what
is resampled. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", arXiv 2108.13264.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval, interquartile_mean

RESAMPLES = 2000
"""Bootstrap resamples, as many as Agarwal et al. take for probabilities of improvement."""


class Scores(NamedTuple):
    """Scores of the runs of one kind in one test."""

    kind: str
    """What kind of runs: scores of the same kind are the same runs', in the same order, and are resampled together."""
    values: np.ndarray
    """Score of each run, shape (runs,), at least one."""


def interquartile_mean_interval(strata: Sequence[np.ndarray]) -> Interval:
    """Interquartile mean over all scores, with its 95 % stratified-bootstrap interval.

    Args:
        strata: scores by kind of run, whose runs are resampled apart: shape (runs, tests), at least one run. A run's
            scores in several tests stay together.

    Returns:
        The interval is NaN where there is a single run of every kind: then nothing is known of the spread.
    """
    mean = interquartile_mean(np.concatenate([scores.ravel() for scores in strata]))
    return Interval(mean, *_percentiles({str(k): scores for k, scores in enumerate(strata)}, _interquartile_means))


def probability_of_improvement(pairs: Sequence[tuple[Scores, Scores]]) -> Interval:
    """Probability that a run of one kind scores higher than one of another, and its 95 % stratified-bootstrap interval.

    The mean over the pairs of P(X > Y) + P(X = Y)/2, which is the Mann-Whitney statistic over the number of pairs of
    runs. 0.5: no improvement.

    Args:
        pairs: the one's and the other's scores in a test; at least one pair.

    Returns:
        The interval is NaN where there is a single run of every kind.

    Raises:
        ValueError: scores of one kind differ in number.
    """
    runs: dict[str, np.ndarray] = {}
    for kind, values in (scores for pair in pairs for scores in pair):
        if len(runs.setdefault(kind, np.arange(len(values)))) != len(values):
            raise ValueError(f"scores of {kind!r}: {len(values)} and {len(runs[kind])} runs: must be the same runs'")

    def mean(drawn: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.mean(
            [_superiority(one.values[drawn[one.kind]], other.values[drawn[other.kind]]) for one, other in pairs], axis=0
        )

    return Interval(float(mean(runs)), *_percentiles(runs, mean))


def _superiority(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Share of pairs in which the one is higher, ties counting half; shapes (..., n) and (..., m) -> (...)."""
    difference = one[..., :, np.newaxis] - other[..., np.newaxis, :]
    return (0.5 * (np.sign(difference) + 1)).mean(axis=(-2, -1))


def _interquartile_means(drawn: Mapping[str, np.ndarray]) -> np.ndarray:
    """Interquartile mean over all strata, each of shape (resamples, runs, tests); shape (resamples,)."""
    from scipy.stats import trim_mean

    return trim_mean(np.concatenate([scores.reshape(RESAMPLES, -1) for scores in drawn.values()], axis=1), 0.25, axis=1)


def _percentiles(
    strata: Mapping[str, np.ndarray], statistic: Callable[[Mapping[str, np.ndarray]], np.ndarray]
) -> tuple[float, float]:
    """The 2.5 % and 97.5 % percentiles of a statistic when the runs of each stratum are drawn anew with replacement.

    Args:
        strata: by kind of run, shape (runs, ...).
        statistic: of as many resamples at once: (resamples, runs, ...) of each stratum -> (resamples,).
    """
    if all(len(runs) < 2 for runs in strata.values()):
        return np.nan, np.nan
    random = np.random.default_rng(0)  # scipy's bootstrap takes neither single runs nor rows that stay together
    shapes = {kind: (RESAMPLES, len(runs)) for kind, runs in strata.items()}
    drawn = {kind: runs[random.integers(len(runs), size=shapes[kind])] for kind, runs in strata.items()}
    low, high = np.percentile(statistic(drawn), [2.5, 97.5])
    return float(low), float(high)
