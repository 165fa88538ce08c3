"""Inference on scores, against scipy's tests, textbook examples and complete enumeration."""

import itertools

import numpy as np
import pytest
from scipy import stats

from codrl_mj.study.inference import (
    Stratum,
    benjamini_hochberg,
    detectable_difference,
    effect,
    equivalence_p,
    holm,
    permutation_p,
    power,
    runs_needed,
)

RANDOM = np.random.default_rng(0)
ONE, OTHER = RANDOM.normal(0.5, 1.0, 20), RANDOM.normal(0.0, 2.0, 16)
TWICE = ONE + RANDOM.normal(0.2, 0.3, 20)


def test_the_effect_of_a_stratum_has_welch_s_interval():
    expected = stats.ttest_ind(ONE, OTHER, equal_var=False).confidence_interval()
    mean, low, high = effect([Stratum(ONE, OTHER)])
    assert (low, high) == pytest.approx((expected.low, expected.high), rel=1e-12)
    assert mean == pytest.approx(ONE.mean() - OTHER.mean(), rel=1e-12)


def test_the_effect_of_pairs_has_student_s_interval():
    expected = stats.ttest_rel(TWICE, ONE).confidence_interval(0.9)
    assert effect([Stratum(TWICE, ONE, True)], 0.9)[1:] == pytest.approx(
        (expected.low, expected.high), rel=1e-12
    )


def test_two_equal_strata_equal_one_with_twice_the_runs():
    """Two copies have the mean of one, half its variance, and twice the degrees of freedom."""
    treatment, two = (
        effect([Stratum(ONE, ONE[::-1] + 1.0)]),
        effect([Stratum(ONE, ONE[::-1] + 1.0)] * 2),
    )
    assert two.mean == pytest.approx(treatment.mean)
    ratio = stats.t.ppf(0.975, 76) / stats.t.ppf(0.975, 38) / np.sqrt(2)
    assert two.high - two.low == pytest.approx(ratio * (treatment.high - treatment.low), rel=1e-12)


def test_scores_without_spread_have_an_interval_of_zero_width():
    assert effect([Stratum(np.ones(3), np.zeros(3))]) == (1.0, 1.0, 1.0)


def test_the_permutation_test_agrees_with_complete_enumeration():
    treatment, control = np.array([3.0, 5.0, 8.0, 9.0]), np.array([1.0, 2.0, 4.0, 6.0])
    pooled, observed = np.concatenate([treatment, control]), treatment.mean() - control.mean()
    differences = [
        pooled[list(chosen)].mean() - np.delete(pooled, list(chosen)).mean()
        for chosen in itertools.combinations(range(8), 4)
    ]
    exact = np.mean(np.abs(differences) >= observed - 1e-12)
    assert permutation_p([Stratum(treatment, control)]) == pytest.approx(
        exact, abs=5e-3
    )  # Three standard deviations of 50,000 samples.
    upper = np.mean(np.array(differences) >= observed - 1e-12)
    assert permutation_p([Stratum(treatment, control)], two_sided=False) == pytest.approx(
        upper, abs=5e-3
    )


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
    treatment, control = RANDOM.normal(0.3, 1.0, 100), RANDOM.normal(0.0, 1.0, 100)
    assert permutation_p([Stratum(treatment, control)]) == pytest.approx(
        stats.ttest_ind(treatment, control).pvalue, abs=0.01
    )


def test_p_is_uniform_without_a_difference():
    """The level is exact, also for strata with different distributions."""
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
    treatment, control = RANDOM.normal(0.05, 0.3, 60), RANDOM.normal(0.0, 0.3, 60)
    expected = max(
        stats.ttest_ind(treatment + 0.15, control, alternative="greater").pvalue,
        stats.ttest_ind(treatment - 0.15, control, alternative="less").pvalue,
    )
    assert equivalence_p([Stratum(treatment, control)], 0.15) == pytest.approx(expected, abs=0.01)


def test_holm_reproduces_the_published_example():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])


def test_benjamini_hochberg_agrees_with_scipy():
    assert benjamini_hochberg([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.04, 0.04])
    assert len(benjamini_hochberg([])) == 0


def test_power_is_the_share_of_significant_simulated_tests():
    random = np.random.default_rng(2)
    treatment, control = (
        random.normal(0.9, 1.0, (20_000, 20)),
        random.normal(0.0, 1.0, (20_000, 20)),
    )
    rejections = np.mean(stats.ttest_ind(treatment, control, axis=1).pvalue < 0.05)
    assert power(20, 0.9) == pytest.approx(rejections, abs=0.01)


def test_runs_needed_inverts_detectable_difference():
    assert runs_needed(1.0) == 17  # A textbook's value for a power of 80 % at 5 %.
    assert power(20, detectable_difference(20)) == pytest.approx(0.8, abs=1e-6)
    assert runs_needed(detectable_difference(20, 0.05 / 12), 0.05 / 12) == 20
    assert runs_needed(0.0) is None
    assert runs_needed(1e-3) is None
