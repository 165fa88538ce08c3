"""Verdicts: intervals against closed forms, outcomes on both sides of every boundary."""

import math

import numpy as np
import pytest
from scipy import stats

from reproduction.checks import (
    COMPATIBLE,
    CONFIRMED,
    NOT_CONFIRMED,
    NOT_TESTABLE,
    OPEN,
    behavior,
    central_range,
    every_seed,
    higher,
    mean_interval,
    number,
    one_episode,
    one_run,
    prediction_interval,
    same,
    within,
)

NOTHING = np.array([])


def test_the_prediction_interval_of_two_values_is_cauchy_s():
    """With one degree of freedom Student's t is Cauchy's, whose quantiles are tangents."""
    reach = math.tan(math.pi * 0.475) * math.sqrt(2) * math.sqrt(1.5)
    assert prediction_interval(np.array([4.0, 6.0])) == pytest.approx((5 - reach, 5 + reach))


def test_the_prediction_interval_has_its_nominal_coverage():
    values = np.random.default_rng(0).normal(3.0, 2.0, (4000, 6))
    inside = [
        low <= sample[5] <= high
        for sample in values
        for low, high in [prediction_interval(sample[:5])]
    ]
    assert np.mean(inside) == pytest.approx(0.95, abs=3 * math.sqrt(0.95 * 0.05 / 4000))


def test_welchs_interval_is_its_formula():
    values, others = np.array([1.0, 2.0, 3.0, 6.0]), np.array([2.0, 4.0, 9.0])
    shares = values.var(ddof=1) / 4, others.var(ddof=1) / 3
    freedom = sum(shares) ** 2 / (shares[0] ** 2 / 3 + shares[1] ** 2 / 2)
    reach = stats.t.ppf(0.975, freedom) * math.sqrt(sum(shares))
    verdict = higher(0.0)(values, others)
    assert verdict.measured == pytest.approx((-2.0, -2.0 - reach, -2.0 + reach))
    p_value = 2 * stats.t.sf(2.0 / math.sqrt(sum(shares)), freedom)
    assert (verdict.outcome, verdict.p) == (OPEN, pytest.approx(p_value))


def test_the_paired_interval_is_its_formula():
    values, others = np.array([1.0, 5.0, 9.0]), np.array([0.0, 3.0, 9.0])  # differences 1, 2, 0
    reach = stats.t.ppf(0.975, 2) * 1.0 / math.sqrt(3)
    assert same(3.0, paired=True)(values, others).measured == pytest.approx(
        (1.0, 1.0 - reach, 1.0 + reach)
    )


@pytest.mark.parametrize(
    ("others", "measured", "p"), [(499.0, (1.0, 1.0, 1.0), 0.0), (500.0, (0.0, 0.0, 0.0), 1.0)]
)
def test_values_without_spread_have_a_difference_without_spread(others, measured, p):
    verdict = higher(0.5)(np.full(3, 500.0), np.full(3, others))
    assert (verdict.measured, verdict.p) == (measured, p)
    assert same(2.0, paired=True)(np.full(3, 500.0), np.full(3, others)).measured == measured


def test_a_means_interval_is_students():
    """With two values, so one degree of freedom, Student's t is Cauchy's distribution."""
    reach = math.tan(math.pi * 0.475)
    assert mean_interval(np.array([4.0, 6.0])) == pytest.approx((5.0, 5 - reach, 5 + reach))
    assert mean_interval(np.array([4.0])) == (4.0, 4.0, 4.0)


def test_the_central_range_omits_a_fortieth_at_each_end():
    values = np.random.default_rng(0).permutation(np.arange(1.0, 1001.0))
    assert central_range(values) == (25.0, 975.0)
    assert central_range(np.array([7.0])) == (7.0, 7.0)


@pytest.mark.parametrize(
    ("check", "values", "outcome"),
    [
        (within(1.0, 2.0), [1.0, 1.0], CONFIRMED),
        (within(1.0, 2.0), [2.0, 2.0], CONFIRMED),
        (within(1.0, 2.0), [2.0, 2.0 + 1e-9], OPEN),
        (within(1.0, 2.0), [0.0, 4.0], OPEN),
        (within(low=1.0), [1e9, 1e9], CONFIRMED),
        (within(high=1.0), [-1e9, -1e9], CONFIRMED),
        (within(high=1.0), [1.1, 1.1], NOT_CONFIRMED),
        (within(1.0, 2.0), [1.5], NOT_TESTABLE),
        (every_seed(2.0), [1.0, 2.0], CONFIRMED),
        (every_seed(2.0), [1.0, 2.0001], NOT_CONFIRMED),
        (one_run(5.0), [4.9, 5.0], COMPATIBLE),
        (one_run(5.0), [7.0, 7.001, 7.002], NOT_CONFIRMED),
        (one_run(5.0), [5.0], NOT_TESTABLE),
        (one_run(5.0), [5.0, 5.0], COMPATIBLE),
        (one_run(5.0, 1.0), [5.0, 6.0], COMPATIBLE),
        (one_run(5.0, 1.0), [6.0, 6.0], CONFIRMED),
        (one_run(5.0, 1.0), [7.0, 7.001, 7.002], NOT_CONFIRMED),
        (behavior(0.95), [1.0, 1.0], CONFIRMED),
        (behavior(0.95), [0.95, 0.95], CONFIRMED),
        (behavior(0.95), [0.94, 1.0], COMPATIBLE),
        (behavior(0.95), [0.0, 0.1], COMPATIBLE),
        (behavior(0.95), [0.0, 0.09], NOT_CONFIRMED),
        (behavior(0.95), [1.0], NOT_TESTABLE),
    ],
)
def test_outcomes_of_one_value_per_seed(check, values, outcome):
    verdict = check(np.array(values))
    assert verdict.outcome == outcome
    assert verdict.samples == len(values)
    assert verdict.reason


@pytest.mark.parametrize(
    "check",
    [within(0.0, 1.0), every_seed(1.0), one_run(1.0), one_episode(1.0), behavior(0.95)],
)
def test_without_runs_nothing_can_be_tested(check):
    verdict = check(NOTHING)
    assert (verdict.outcome, verdict.measured, verdict.samples) == (NOT_TESTABLE, None, 0)


@pytest.mark.parametrize("check", [higher(1.0), same(1.0), same(1.0, paired=True)])
def test_a_comparison_needs_two_seeds_of_each(check):
    assert check(NOTHING, np.array([1.0, 2.0])).outcome == NOT_TESTABLE
    assert check(np.array([1.0]), np.array([1.0, 2.0])).outcome == NOT_TESTABLE


def test_one_runs_boundary_is_the_prediction_interval():
    values = np.array([4.0, 6.0])
    edge = 5 + math.tan(math.pi * 0.475) * math.sqrt(2) * math.sqrt(1.5)
    assert one_run(edge - 1e-6)(values).outcome == COMPATIBLE
    assert one_run(edge + 1e-6)(values).outcome == NOT_CONFIRMED


def test_an_episode_is_compatible_within_the_central_range():
    times = [np.arange(1.0, 21.0), np.arange(21.0, 41.0)]  # 1 to 40: the central 95 % are 1 to 39
    assert one_episode(39.0)(times).outcome == COMPATIBLE
    assert one_episode(39.5)(times).outcome == NOT_CONFIRMED
    assert one_episode(39.0)(times).measured.mean == (10.5 + 30.5) / 2


def test_about_a_time_allows_its_tolerance_and_can_be_confirmed():
    times = [np.arange(1.0, 21.0), np.arange(21.0, 41.0)]  # the central 95 % are 1 to 39
    assert one_episode(44.0, 5.0)(times).outcome == COMPATIBLE
    assert one_episode(44.5, 5.0)(times).outcome == NOT_CONFIRMED
    assert one_episode(10.0, 5.0)([np.array([12.0]), np.array([13.0])]).outcome == COMPATIBLE
    assert one_episode(10.0, 5.0)([np.array([12.0]), np.array([12.1])]).outcome == CONFIRMED


def test_a_quantile_that_equals_a_bound_is_not_under_it():
    times = [np.arange(1.0, 21.0), np.arange(21.0, 41.0)]  # the central 95 % begin at 1
    assert one_episode(1.0)(times).outcome == COMPATIBLE
    tie = one_episode(1.0, under=True)(times)
    assert (tie.outcome, one_episode(1.5, under=True)(times).outcome) == (NOT_CONFIRMED, COMPATIBLE)
    assert "0 % take less than 1 s" in tie.reason
    assert one_episode(99.0, under=True)(times[:1] * 2).outcome == CONFIRMED


def test_episodes_that_do_not_arrive_are_reported_without_a_time():
    some = [
        np.array([1.0, math.inf, math.inf]),
        np.array([2.0, 3.0, 4.0]),
        np.array([math.inf, math.inf]),
    ]
    assert one_episode(5.0)(some).outcome == NOT_CONFIRMED
    verdict = one_episode(4.0)(some)
    assert verdict.outcome == COMPATIBLE
    assert (verdict.measured.mean, verdict.samples) == (2.0, 3)
    assert "4 of 8 never arrive" in verdict.reason
    nobody = one_episode(5.0)(some[2:])
    assert (nobody.outcome, nobody.measured) == (NOT_CONFIRMED, None)


def test_higher_is_a_test_of_the_difference_and_not_of_the_means():
    values = np.array([1.0, 2.0, 3.0])
    assert higher(0.0)(values, values - 0.1).outcome == OPEN
    assert higher(2.0)(values, values - 10.0).outcome == CONFIRMED
    assert higher(9.0)(values, values - 10.0).outcome == OPEN
    assert higher(0.0)(values - 10.0, values).outcome == NOT_CONFIRMED
    assert higher(3.0)(values, values).outcome == NOT_CONFIRMED  # by more than what does not matter


def test_equality_has_to_be_shown_not_only_not_refuted():
    values = np.array([1.0, 2.0, 3.0])
    assert same(1.0)(values, values).outcome == OPEN  # the interval is wider than that
    assert "more seeds would tell" in same(1.0)(values, values).reason
    assert same(3.0)(values, values).outcome == CONFIRMED
    assert same(1.0, paired=True)(values, values - 0.5).outcome == CONFIRMED
    apart = same(1.0, paired=True)(values, values - 1.5)
    assert (apart.outcome, apart.reason) == (NOT_CONFIRMED, "the whole interval is beyond")
    assert same(0.0, paired=True)(values, values).reason == "no two values differ"


def test_bounds_and_comparisons_have_one_rule():
    narrow, wide = np.array([1.4, 1.5, 1.6]), np.array([-5.0, 1.0, 8.5])  # means 1.5
    for check in (within(1.0, 2.0), same(2.0), higher(1.0)):
        others = () if check.rule == "mean" else (np.zeros(3),)
        assert check(narrow, *others).outcome == CONFIRMED
        assert check(wide, *others).outcome == OPEN
        assert check(narrow - 9.0, *others).outcome == NOT_CONFIRMED


def test_numbers_as_text():
    assert [number(value) for value in (-122.54, 4000.4, 0.11859, 100.0)] == [
        "-122.5",
        "4000",
        "0.119",
        "100",
    ]
