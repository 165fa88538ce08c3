"""What is concluded from scores, beside scipy's tests, textbook examples and the counting of relabellings."""

import itertools

import numpy as np
import pytest
from scipy import stats

from codrl_mj.study.inference import (
    Stratum,
    detectable_difference,
    effect,
    equivalence_p,
    benjamini_hochberg,
    holm,
    permutation_p,
    power,
    runs_needed,
)

RANDOM = np.random.default_rng(0)
ONE, OTHER = RANDOM.normal(0.5, 1.0, 20), RANDOM.normal(0.0, 2.0, 16)
TWICE = ONE + RANDOM.normal(0.2, 0.3, 20)


def test_the_effect_of_one_stratum_is_welch_s():
    expected = stats.ttest_ind(ONE, OTHER, equal_var=False).confidence_interval()
    mean, low, high = effect([Stratum(ONE, OTHER)])
    assert (low, high) == pytest.approx((expected.low, expected.high), rel=1e-12)
    assert mean == pytest.approx(ONE.mean() - OTHER.mean(), rel=1e-12)


def test_the_effect_of_pairs_is_student_s():
    expected = stats.ttest_rel(TWICE, ONE).confidence_interval(0.9)
    assert effect([Stratum(TWICE, ONE, True)], 0.9)[1:] == pytest.approx(
        (expected.low, expected.high), rel=1e-12
    )


def test_pooled_strata_of_equal_spread_are_as_one_of_twice_the_runs():
    """Two copies have the mean of one, and half its variance; degrees of freedom double."""
    one, two = effect([Stratum(ONE, ONE[::-1] + 1.0)]), effect([Stratum(ONE, ONE[::-1] + 1.0)] * 2)
    assert two.mean == pytest.approx(one.mean)
    ratio = stats.t.ppf(0.975, 76) / stats.t.ppf(0.975, 38) / np.sqrt(2)
    assert two.high - two.low == pytest.approx(ratio * (one.high - one.low), rel=1e-12)


def test_scores_without_spread_have_no_width():
    assert effect([Stratum(np.ones(3), np.zeros(3))]) == (1.0, 1.0, 1.0)


def test_a_permutation_test_counts_what_all_relabellings_give():
    one, other = np.array([3.0, 5.0, 8.0, 9.0]), np.array([1.0, 2.0, 4.0, 6.0])
    pooled, seen = np.concatenate([one, other]), one.mean() - other.mean()
    differences = [
        pooled[list(chosen)].mean() - np.delete(pooled, list(chosen)).mean()
        for chosen in itertools.combinations(range(8), 4)
    ]
    exact = np.mean(np.abs(differences) >= seen - 1e-12)
    assert permutation_p([Stratum(one, other)]) == pytest.approx(
        exact, abs=5e-3
    )  # 3 deviations of 50,000 draws
    upper = np.mean(np.array(differences) >= seen - 1e-12)
    assert permutation_p([Stratum(one, other)], two_sided=False) == pytest.approx(upper, abs=5e-3)


def test_a_paired_permutation_test_exchanges_within_pairs():
    gains = np.array([0.5, 0.7, -0.1, 0.9, 0.4])
    signs = np.array(list(itertools.product((-1, 1), repeat=5)))
    exact = np.mean(np.abs(signs @ gains) >= gains.sum() - 1e-12)
    p = permutation_p([Stratum(gains, np.zeros(5), True)])
    assert p == pytest.approx(exact, abs=5e-3)
    assert p != pytest.approx(permutation_p([Stratum(gains, np.zeros(5))]), abs=5e-3)


def test_large_samples_agree_with_student_s_tests():
    assert permutation_p([Stratum(TWICE, ONE, True)]) == pytest.approx(
        stats.ttest_rel(TWICE, ONE).pvalue, abs=0.01
    )
    one, other = RANDOM.normal(0.3, 1.0, 100), RANDOM.normal(0.0, 1.0, 100)
    assert permutation_p([Stratum(one, other)]) == pytest.approx(
        stats.ttest_ind(one, other).pvalue, abs=0.01
    )


def test_under_no_difference_p_is_uniform():
    """The level is kept, also by strata of unlike distributions."""
    random = np.random.default_rng(1)
    p = [
        permutation_p(
            [
                Stratum(random.exponential(1.0, 6), random.exponential(1.0, 6)),
                Stratum(*random.random((2, 5))),
            ]
        )
        for _ in range(60)
    ]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_equivalence_needs_a_difference_within_the_margin_and_enough_runs():
    close = Stratum(RANDOM.normal(0.0, 0.1, 20), RANDOM.normal(0.0, 0.1, 20))
    assert equivalence_p([close], 0.2) < 0.001
    assert equivalence_p([Stratum(close.treatment[:3], close.control[:3])], 0.1) > 0.05
    assert equivalence_p([Stratum(close.treatment + 0.2, close.control)], 0.2) > 0.2
    assert equivalence_p([close], 0.2) == pytest.approx(
        equivalence_p([Stratum(close.control, close.treatment)], 0.2), abs=0.001
    )


def test_equivalence_agrees_with_two_t_tests():
    one, other = RANDOM.normal(0.05, 0.3, 60), RANDOM.normal(0.0, 0.3, 60)
    expected = max(
        stats.ttest_ind(one + 0.15, other, alternative="greater").pvalue,
        stats.ttest_ind(one - 0.15, other, alternative="less").pvalue,
    )
    assert equivalence_p([Stratum(one, other)], 0.15) == pytest.approx(expected, abs=0.01)


def test_holm_as_in_his_example():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])


def test_false_discoveries_are_scipy_s():
    assert benjamini_hochberg([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.04, 0.04])
    assert len(benjamini_hochberg([])) == 0


def test_power_is_the_share_of_simulated_tests_that_find_it():
    random = np.random.default_rng(2)
    one, other = random.normal(0.9, 1.0, (20_000, 20)), random.normal(0.0, 1.0, (20_000, 20))
    found = np.mean(stats.ttest_ind(one, other, axis=1).pvalue < 0.05)
    assert power(20, 0.9) == pytest.approx(found, abs=0.01)


def test_runs_and_differences_belong_together():
    assert runs_needed(1.0) == 17  # the textbook's, for 80 % at 5 %
    assert power(20, detectable_difference(20)) == pytest.approx(0.8, abs=1e-6)
    assert runs_needed(detectable_difference(20, 0.05 / 12), 0.05 / 12) == 20
    assert runs_needed(0.0) is None
    assert runs_needed(1e-3) is None
