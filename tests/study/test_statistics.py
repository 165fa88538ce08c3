"""Statistics over runs: against scipy, closed forms, and every resample that there is."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import bootstrap, mannwhitneyu, trim_mean

from codrl_mj.study.statistics import RESAMPLES, Scores, interquartile_mean_interval, probability_of_improvement

RANDOM = np.random.default_rng(7)
ONE, OTHER, THIRD = RANDOM.normal(0.6, 1, 9), RANDOM.normal(0, 1, 7).round(1), RANDOM.normal(0.3, 1, 6)
NOISE = 4 / math.sqrt(RESAMPLES)  # of a percentile, in standard deviations of the statistic: generous


def column(scores):
    return np.asarray(scores, dtype=float)[:, np.newaxis]


def quantiles(values):
    return np.percentile(list(values), [2.5, 97.5])


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([5.0], 5.0),
        ([1.0, 3.0], 2.0),
        ([0.0, 1.0, 2.0, 100.0], 1.5),  # a quarter of four is one at each end
        ([0.0, 10.0, 20.0, 30.0, 1000.0], 20.0),
    ],
)
def test_the_interquartile_mean_leaves_the_outer_quarters_out(scores, expected):
    assert interquartile_mean_interval([column(scores)]).mean == expected


def test_the_interval_of_one_stratum_is_that_of_every_resample():
    """With four runs there are 4**4 resamples: the bootstrap's limit is known exactly."""
    scores = np.array([0.0, 10.0, 25.0, 45.0])
    exact = quantiles(trim_mean(np.array(draw), 0.25) for draw in itertools.product(scores, repeat=4))
    got = interquartile_mean_interval([column(scores)])
    np.testing.assert_allclose(got[1:], exact, atol=NOISE * scores.std())


def test_strata_are_resampled_apart_as_scipy_does():
    def pooled(*samples, axis):
        return trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)

    far = THIRD + 100.0  # mixed with the others, the strata would be lost in the spread between them
    oracle = bootstrap((ONE, far), pooled, method="percentile", n_resamples=20_000, rng=1).confidence_interval
    got = interquartile_mean_interval([column(ONE), column(far)])
    assert got.mean == pytest.approx(trim_mean(np.append(ONE, far), 0.25), rel=1e-12)
    np.testing.assert_allclose(got[1:], [oracle.low, oracle.high], atol=NOISE * (oracle.high - oracle.low))


def test_a_runs_scores_in_several_tests_stay_together():
    """Scores that cancel within a run have no spread between runs: resampled one by one they would have."""
    opposite = np.stack([ONE, -ONE], axis=1)
    together, apart = interquartile_mean_interval([opposite]), interquartile_mean_interval([opposite.reshape(-1, 1)])
    assert together.high - together.low < 0.5 * (apart.high - apart.low)


def test_a_single_run_has_no_interval():
    assert all(map(math.isnan, interquartile_mean_interval([column([3.0])])[1:]))
    assert all(map(math.isnan, probability_of_improvement([(Scores("a", ONE[:1]), Scores("b", OTHER[:1]))])[1:]))


def test_equal_runs_have_an_interval_of_no_width():
    assert interquartile_mean_interval([np.full((5, 1), 500.0)]) == (500.0, 500.0, 500.0)


def test_the_probability_of_improvement_is_mann_whitneys_statistic():
    expected = mannwhitneyu(ONE, OTHER).statistic / (len(ONE) * len(OTHER))
    assert probability_of_improvement([(Scores("a", ONE), Scores("b", OTHER))]).mean == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [([2.0, 3.0], [0.0, 1.0], 1.0), ([0.0], [1.0], 0.0), ([1.0, 1.0], [1.0], 0.5), ([0.0, 2.0], [1.0], 0.5)],
)
def test_the_probability_of_improvement_of_few_runs(one, other, expected):
    assert probability_of_improvement([(Scores("a", np.array(one)), Scores("b", np.array(other)))]).mean == expected


def test_its_interval_is_that_of_every_resample():
    one, other = np.array([1.0, 4.0, 6.0]), np.array([0.0, 3.0, 5.0])
    exact = quantiles(
        np.mean([(x > y) + 0.5 * (x == y) for x in xs for y in ys])
        for xs in itertools.product(one, repeat=3)
        for ys in itertools.product(other, repeat=3)
    )
    got = probability_of_improvement([(Scores("a", one), Scores("b", other))])
    np.testing.assert_allclose(got[1:], exact, atol=1 / 9)  # the statistic is a multiple of that


def test_pairs_are_averaged_and_resampled_apart_as_scipy_does():
    def mean(a, b, c, d, axis):
        assert axis == -1
        pairs = [(a, b), (c, d)]
        return np.mean([(x[..., :, None] > y[..., None, :]).mean((-2, -1)) for x, y in pairs], axis=0)

    fourth = OTHER + 1e-9 + 0.2
    samples = ONE, OTHER + 1e-9, THIRD, fourth
    oracle = bootstrap(samples, mean, method="percentile", n_resamples=20_000, rng=1).confidence_interval
    first, second = ((Scores(f"{k} one", samples[k]), Scores(f"{k} other", samples[k + 1])) for k in (0, 2))
    got = probability_of_improvement([first, second])
    expected = (probability_of_improvement([first]).mean + probability_of_improvement([second]).mean) / 2
    assert got.mean == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(got[1:], [oracle.low, oracle.high], atol=NOISE * (oracle.high - oracle.low))


def test_the_same_runs_in_two_tests_are_resampled_together():
    """One pair twice says no more than once; runs of other kinds would."""
    pair = Scores("a", ONE), Scores("b", OTHER)
    once = probability_of_improvement([pair])
    assert probability_of_improvement([pair, pair]) == pytest.approx(once, rel=1e-12)
    others = probability_of_improvement([pair, (Scores("c", ONE), Scores("d", OTHER))])
    assert others.high - others.low < 0.9 * (once.high - once.low)


def test_scores_of_one_kind_are_the_same_runs():
    with pytest.raises(ValueError, match="'a': 8 and 9 runs"):
        probability_of_improvement([(Scores("a", ONE), Scores("b", OTHER)), (Scores("a", ONE[:8]), Scores("c", OTHER))])
