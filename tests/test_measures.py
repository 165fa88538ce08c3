"""Pure functions of measures, against closed forms, identities and counting."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.evaluation.measures import (
    bootstrap_mean,
    delay,
    holds_since,
    interquartile_mean,
    quartiles,
    sign_changes,
    wilson_rate,
)

# -- means and rates -------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 10, 57, 1000])
def test_bootstrap_means_equal_scipy_s_bit_by_bit(count):
    for values in (
        np.random.default_rng(count).gamma(4.0, 30.0, size=count),
        np.arange(float(count)) ** 2,
    ):
        theirs = scipy.stats.bootstrap(
            (values,), np.mean, method="percentile", rng=0
        ).confidence_interval
        assert bootstrap_mean(values) == (np.mean(values), theirs.low, theirs.high)
        assert interquartile_mean(values) == scipy.stats.trim_mean(values, 0.25)


@pytest.mark.parametrize("trials", [1, 2, 3, 10, 57, 500])
def test_wilson_intervals_equal_scipy_s_bit_by_bit(trials):
    for successes in range(trials + 1):
        theirs = scipy.stats.binomtest(successes, trials).proportion_ci(0.95, "wilson")
        assert wilson_rate(successes, trials) == (successes / trials, theirs.low, theirs.high)


@pytest.mark.parametrize(
    "values", [[500.0] * 100, [-3.25], [0.1] * 3], ids=["many", "one", "three"]
)
def test_values_without_spread_have_an_interval_of_zero_width(values):
    mean, low, high = bootstrap_mean(np.array(values))
    assert low == mean == high == pytest.approx(values[0], rel=1e-15)


def test_quartiles_cut_a_sample_into_quarters():
    assert quartiles(np.random.default_rng(0).permutation(101) / 1.0) == (50.0, 25.0, 75.0)
    assert quartiles(np.array([7.0])) == (7.0, 7.0, 7.0)


@given(st.lists(st.booleans()))
def test_a_condition_holds_after_its_last_violation(held):
    since = holds_since(np.array(held, dtype=bool))
    assert all(held[since:])
    assert since == 0 or not held[since - 1]


# -- delay -----------------------------------------------------------------------------------------


def swing(times):
    """Return three sinusoids of incommensurate periods (from 12 samples), shifted by a delay."""
    return sum(
        weight * np.sin(rate * times + rate)
        for rate, weight in ((0.13, 1.0), (0.31, 0.7), (0.52, 0.4))
    )


@pytest.mark.parametrize("shift", [0.0, 0.2, 0.5, 0.8, 2.25, 7.0, 13.4])
def test_the_delay_of_a_shifted_signal_has_an_error_below_a_hundredth_of_a_sample(shift):
    times = np.arange(20_000)
    measured = delay([swing(times)], [0.3 * swing(times - shift) + 5.0], 0.02)
    assert measured == pytest.approx(0.02 * shift, abs=0.01 * 0.02)


@pytest.mark.parametrize("rate", [0.2, 0.5])
def test_the_delay_of_a_first_order_lag_follows_from_its_phase(rate):
    times, time_constant = np.arange(20_000), 3.0
    phase = math.atan(rate * time_constant)  # Phase of 1/(1 + j*rate*T).
    measured = delay([np.sin(rate * times)], [np.cos(phase) * np.sin(rate * times - phase)], 1.0)
    assert measured == pytest.approx(phase / rate, abs=0.01)


@pytest.mark.parametrize("shift", [4.0, 9.7])
def test_the_delay_of_a_sinusoid_is_within_its_period(shift):
    times = np.arange(20_000)
    assert delay([np.sin(0.5 * times)], [np.sin(0.5 * (times - shift))], 1.0) == pytest.approx(
        shift, abs=0.01
    )


def test_the_delay_uses_all_episodes_together():
    random = np.random.default_rng(3)
    desired = [random.normal(size=size) for size in (400, 3, 150, 1000)]
    actual = [np.concatenate([random.normal(size=6), signal])[: len(signal)] for signal in desired]
    assert delay(desired, actual, 0.5) == pytest.approx(
        3.0, abs=0.05
    )  # The noise beside the peak is 1/sqrt(1500) samples.


def test_motors_with_different_mean_torques_have_their_common_delay():
    """A constant mean of one motor has no delay, and must not hide the delay of the others."""
    rng = np.random.default_rng(0)
    desired = [
        offset + rng.normal(size=400) for _ in range(3) for offset in (20.0, -20.0)
    ]  # Two motors in turn.
    actual = [np.concatenate([np.full(4, signal.mean()), signal[:-4]]) for signal in desired]
    single_motor = [delay(desired[motor::2], actual[motor::2], 0.01) for motor in (0, 1)]
    assert single_motor == pytest.approx([0.04, 0.04], abs=1e-3)
    assert delay(desired, actual, 0.01, motors=2) == pytest.approx(0.04, abs=1e-3)


NOISE, OTHER = np.random.default_rng(4).normal(size=(2, 1000))
STILL = np.full(9, 2.0)


@pytest.mark.parametrize(
    ("desired", "actual", "expected"),
    [
        (NOISE, OTHER, None),  # The signal does not follow.
        (NOISE, -NOISE, None),
        (STILL, NOISE[:9], None),
        (NOISE[:9], STILL, None),
        (NOISE[:1], OTHER[:1], None),
        (swing(np.arange(2000)), swing(np.arange(2000) + 0.4), 0.0),  # The signal leads.
    ],
)
def test_uncorrelated_signals_have_no_delay_and_leading_ones_zero(desired, actual, expected):
    assert delay([desired], [actual], 1.0) == expected


# -- reversals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("samples", "changes"),
    [([], 0), ([0.0, 0.0], 0), ([1, 2, 3], 0), ([1, -1, 1], 2), ([1, 0, 0, -2], 1), ([1, 0, 2], 0)],
)
def test_sign_changes_skip_zeros(samples, changes):
    assert sign_changes(np.array(samples, dtype=float)) == changes
