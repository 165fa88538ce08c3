"""What may be concluded from scores of training runs: tests, corrections for their number, equivalence, power.

A score is one trained policy's mean over its test episodes. Runs, not episodes, are what training
repeats. A contrast pools strata (the same question on several tasks or doses): its effect is the
mean of their differences of means.
"""

import bisect
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval

RELABELLINGS = 50_000
"""Random relabellings of a permutation test: a p of 2e-5 is the smallest that it can give."""


class Stratum(NamedTuple):
    """Scores of two kinds of runs in the same test."""

    one: np.ndarray
    """Shape (n,), n >= 2."""
    other: np.ndarray
    """Shape (m,), m >= 2; of a paired stratum the same runs' in another test, in the same order."""
    paired: bool = False
    """Whether both are the same runs'."""

    @property
    def difference(self) -> float:
        """Mean of the one less mean of the other."""
        return float(np.mean(self.one) - np.mean(self.other))


def effect(strata: Sequence[Stratum], confidence: float = 0.95) -> Interval:
    """Mean difference over the strata, with its interval by Student's t, variances unequal (Welch, Satterthwaite).

    Args:
        strata: at least one, of which none shares runs with another.
        confidence: of the interval, in (0, 1).
    """
    from scipy.special import stdtrit  # Student's t without the distributions' half a second

    samples: list[np.ndarray] = []
    for one, other, paired in strata:
        samples += [one - other] if paired else [one, other]
    parts = [(float(np.var(sample, ddof=1)) / len(sample), len(sample) - 1) for sample in samples]
    variance = sum(part for part, _ in parts)
    mean = float(np.mean([stratum.difference for stratum in strata]))
    if variance == 0:
        return Interval(mean, mean, mean)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    half = stdtrit(freedom, 0.5 + confidence / 2) * np.sqrt(variance) / len(strata)
    return Interval(mean, mean - float(half), mean + float(half))


def permutation_p(strata: Sequence[Stratum], least: float = 0.0, two_sided: bool = True) -> float:
    """How often labels given at random make a mean difference as large as the one seen: the p of no difference.

    Labels are exchanged within each stratum: among its runs, or, where it is paired, within every
    pair. The labels seen count as one of the relabellings. Where both kinds have the same
    distribution (of pairs: where differences are as likely with either sign) the level is exact;
    where their means alone are equal it is so approximately, for about equal numbers of runs.

    Args:
        strata: at least one, of which none shares runs with another.
        least: the difference that is to be exceeded: it is taken from the one's scores first.
        two_sided: whether a difference of the other sign counts as well.
    """
    totals = np.zeros(RELABELLINGS)
    seen = 0.0
    for number, stratum in enumerate(strata):
        one, other = stratum.one - least, stratum.other
        seen += float(np.mean(one) - np.mean(other))
        if stratum.paired:
            totals += _signs(len(one), number) @ (one - other) / len(one)
            continue
        pooled, n = np.concatenate([one, other]), len(one)
        sums = _chosen(n, len(other), number) @ pooled
        totals += sums / n - (pooled.sum() - sums) / len(other)
    slack = 1e-9 * max(1.0, abs(seen))  # sums in another order differ by rounding
    extreme = np.abs(totals) >= abs(seen) - slack if two_sided else totals >= seen - slack
    return (1 + int(extreme.sum())) / (1 + RELABELLINGS)


@functools.lru_cache(32)
def _signs(n: int, stratum: int) -> np.ndarray:
    """Random signs of n pairs, shape (relabellings, n)."""
    random = np.random.default_rng([n, stratum])
    return (random.integers(0, 2, (RELABELLINGS, n)) * 2 - 1).astype(np.float64)


@functools.lru_cache(32)
def _chosen(n: int, m: int, stratum: int) -> np.ndarray:
    """Which n of n + m runs are labelled as the one, at random, shape (relabellings, n + m)."""
    keys = np.random.default_rng([n, m, stratum]).random((RELABELLINGS, n + m), dtype=np.float32)
    return (np.argsort(np.argsort(keys, axis=1), axis=1) < n).astype(np.float64)


def equivalence_p(strata: Sequence[Stratum], margin: float) -> float:
    """Two one-sided tests: the p of a difference of at least the margin, of either sign.

    Args:
        strata: at least one.
        margin: largest difference that does not matter, > 0.
    """
    swapped = [Stratum(stratum.other, stratum.one, stratum.paired) for stratum in strata]
    return max(permutation_p(of, -margin, two_sided=False) for of in (strata, swapped))


def holm(p: Sequence[float]) -> np.ndarray:
    """Holm's corrected p: the chance of any false positive among all of them stays below the level.

    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
    Statistics 6 (1979).
    """
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)
    stepped = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def false_discovery(p: Sequence[float]) -> np.ndarray:
    """Benjamini and Hochberg's corrected p (scipy): of what is called found, that share is false at most."""
    from scipy.stats import false_discovery_control

    return np.asarray(false_discovery_control(p)) if len(p) else np.array([])


def power(runs: int, difference: float, level: float = 0.05) -> float:
    """Chance that a two-sided t-test of two kinds of at least 2 `runs` each finds a difference of their means.

    It is in standard deviations of a run. By the noncentral t distribution.
    """
    from scipy.stats import nct, t

    freedom, shift = 2 * runs - 2, difference * np.sqrt(runs / 2)
    bound = t.ppf(1 - level / 2, freedom)
    above, below = nct.sf(bound, freedom, shift), nct.cdf(-bound, freedom, shift)
    return float(
        np.nan_to_num(above, nan=1.0) + np.nan_to_num(below)
    )  # scipy has NaN where nothing is left to find


def detectable(runs: int, level: float = 0.05, chance: float = 0.8) -> float:
    """Smallest difference, in standard deviations of a run, that is found with that chance."""
    from scipy.optimize import brentq

    return float(brentq(lambda difference: power(runs, difference, level) - chance, 1e-6, 50.0))


def runs_needed(
    difference: float, level: float = 0.05, chance: float = 0.8, most: int = 10_000
) -> int | None:
    """Runs of each kind that find a difference, in standard deviations of a run, with that chance; None: > `most`."""
    if difference == 0 or power(most, difference, level) < chance:
        return None
    return bisect.bisect_left(
        range(most), chance, 2, key=lambda runs: power(runs, difference, level)
    )
