"""Statistical inference on scores of training runs: tests, corrections, equivalence and power.

A score is the mean of one trained policy over its test episodes. The independent samples are runs,
not episodes. A contrast pools strata, which ask the same question on several tasks or at several
severities. Its effect is the mean, over strata, of the difference of the two groups' means.
"""

import bisect
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval

RELABELINGS = 50_000
"""Random relabelings of a permutation test; the smallest possible p-value is 2e-5."""


class Stratum(NamedTuple):
    """Scores of two groups of runs in the same test."""

    treatment: np.ndarray
    """Scores that may be higher, shape (n,), n >= 2."""
    control: np.ndarray
    """Reference scores, shape (m,), m >= 2; if paired, those of the same runs in the same order."""
    paired: bool = False
    """True if both groups are the same runs in two tests."""

    @property
    def difference(self) -> float:
        """Mean of the treatment minus mean of the control."""
        return float(np.mean(self.treatment) - np.mean(self.control))


def effect(strata: Sequence[Stratum], confidence: float = 0.95) -> Interval:
    """Return the mean difference over strata with its interval by Welch's t (Satterthwaite).

    Args:
        strata: at least one; no two of them share runs.
        confidence: confidence level of the interval, in (0, 1).
    """
    # scipy.stats takes half a second to import; stdtrit is Student's quantile without it.
    from scipy.special import stdtrit

    samples: list[np.ndarray] = []
    for treatment, control, paired in strata:
        samples += [treatment - control] if paired else [treatment, control]
    parts = [(float(np.var(sample, ddof=1)) / len(sample), len(sample) - 1) for sample in samples]
    variance = sum(part for part, _ in parts)
    mean = float(np.mean([stratum.difference for stratum in strata]))
    if variance == 0:
        return Interval(mean, mean, mean)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    half = stdtrit(freedom, 0.5 + confidence / 2) * np.sqrt(variance) / len(strata)
    return Interval(mean, mean - float(half), mean + float(half))


def permutation_p(
    strata: Sequence[Stratum], min_difference: float = 0.0, two_sided: bool = True
) -> float:
    """Return the p-value of no difference, from a permutation test of the mean difference.

    Labels are exchanged within each stratum: among its runs, or within each pair of a paired
    stratum. The observed labels count as one of the relabelings. The level is exact if both groups
    have the same distribution (for pairs: if differences are symmetric about 0). If only the means
    are equal, it is approximate and needs about equal numbers of runs.

    Args:
        strata: at least one; no two of them share runs.
        min_difference: difference to be exceeded; it is subtracted from the treatment's scores.
        two_sided: True to count differences of either sign.
    """
    totals = np.zeros(RELABELINGS)
    observed = 0.0
    for number, stratum in enumerate(strata):
        treatment, control = stratum.treatment - min_difference, stratum.control
        observed += float(np.mean(treatment) - np.mean(control))
        if stratum.paired:
            totals += _random_signs(len(treatment), number) @ (treatment - control) / len(treatment)
            continue
        pooled, n = np.concatenate([treatment, control]), len(treatment)
        sums = _random_labels(n, len(control), number) @ pooled
        totals += sums / n - (pooled.sum() - sums) / len(control)
    # Summation in another order changes the last bits, so that ties need a tolerance.
    tolerance = 1e-9 * max(1.0, abs(observed))
    extreme = (
        np.abs(totals) >= abs(observed) - tolerance if two_sided else totals >= observed - tolerance
    )
    return (1 + int(extreme.sum())) / (1 + RELABELINGS)


@functools.lru_cache(32)
def _random_signs(n: int, stratum: int) -> np.ndarray:
    """Return random signs of n pairs, shape (relabelings, n)."""
    random = np.random.default_rng([n, stratum])
    return (random.integers(0, 2, (RELABELINGS, n)) * 2 - 1).astype(np.float64)


@functools.lru_cache(32)
def _random_labels(n: int, m: int, stratum: int) -> np.ndarray:
    """Return random masks of n treatment runs among n + m runs, shape (relabelings, n + m)."""
    # The ranks of random keys are a random permutation; ranks below n select n runs of each row.
    keys = np.random.default_rng([n, m, stratum]).random((RELABELINGS, n + m), dtype=np.float32)
    return (np.argsort(np.argsort(keys, axis=1), axis=1) < n).astype(np.float64)


def equivalence_p(strata: Sequence[Stratum], margin: float) -> float:
    """Return the p-value for the hypothesis that the difference reaches the margin (TOST).

    It is the larger p-value of two one-sided permutation tests; a small one shows equivalence.

    Args:
        strata: at least one.
        margin: largest difference that counts as equivalent, > 0.
    """
    swapped = [Stratum(stratum.control, stratum.treatment, stratum.paired) for stratum in strata]
    return max(permutation_p(pair, -margin, two_sided=False) for pair in (strata, swapped))


def holm(p: Sequence[float]) -> np.ndarray:
    """Return p-values corrected by Holm, which bounds the probability of any false positive.

    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
    Statistics 6 (1979).
    """
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)
    stepped = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def benjamini_hochberg(p: Sequence[float]) -> np.ndarray:
    """Return p-values corrected by Benjamini and Hochberg, which bounds false discoveries."""
    from scipy.stats import false_discovery_control

    return np.asarray(false_discovery_control(p)) if len(p) else np.array([])


def power(runs: int, difference: float, level: float = 0.05) -> float:
    """Return the power of a two-sided t-test of two groups, from the noncentral t distribution.

    Args:
        runs: runs in each group, >= 2.
        difference: difference of the means [standard deviations of a run].
        level: level of the test.
    """
    from scipy.stats import nct, t

    freedom, shift = 2 * runs - 2, difference * np.sqrt(runs / 2)
    bound = t.ppf(1 - level / 2, freedom)
    above, below = nct.sf(bound, freedom, shift), nct.cdf(-bound, freedom, shift)
    # For large shifts scipy returns NaN instead of the limits 1 (above) and 0 (below).
    return float(np.nan_to_num(above, nan=1.0) + np.nan_to_num(below))


def detectable_difference(runs: int, level: float = 0.05, probability: float = 0.8) -> float:
    """Return the smallest detectable difference [standard deviations of a run] at a given power."""
    from scipy.optimize import brentq

    return float(
        brentq(lambda difference: power(runs, difference, level) - probability, 1e-6, 50.0)
    )


def runs_needed(
    difference: float, level: float = 0.05, probability: float = 0.8, max_runs: int = 10_000
) -> int | None:
    """Return the number of runs per group that detect a difference; None above `max_runs`.

    The difference is in standard deviations of a run.
    """
    if difference == 0 or power(max_runs, difference, level) < probability:
        return None
    return bisect.bisect_left(
        range(max_runs), probability, 2, key=lambda runs: power(runs, difference, level)
    )
