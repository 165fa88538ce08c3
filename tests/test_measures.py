"""The pure functions that episodes are reduced by, against closed forms, identities and counting."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codrl_mj.evaluation.measures import (
    bootstrap_mean,
    delay,
    electrical_energy,
    holds_since,
    integral_of_square,
    interquartile_mean,
    mechanical_work,
    quartiles,
    sign_changes,
    wilson_rate,
)

# -- means and rates ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.1, 1.0, 30.0])
def test_the_interval_of_many_values_is_the_normal_one(spread):
    values = np.random.default_rng(1).gamma(4.0, spread, 1000)
    mean, low, high = bootstrap_mean(values)
    half = 1.959964 * values.std(ddof=1) / math.sqrt(len(values))
    assert mean == pytest.approx(math.fsum(values) / 1000, rel=1e-12)
    assert (high - low) / 2 == pytest.approx(half, rel=0.05)
    assert (high + low) / 2 == pytest.approx(mean, abs=0.1 * half)


def test_the_interval_of_few_values_is_that_of_all_their_resamples():
    values = np.array([0.0, 1.0, 2.5, 7.0, 20.0])
    choices = np.stack(np.meshgrid(*[np.arange(5)] * 5), axis=-1).reshape(-1, 5)
    every_mean = values[choices].mean(axis=1)  # all 5^5 resamples, each equally likely
    _, low, high = bootstrap_mean(values)
    # 9999 of them are drawn: the shares below the ends are 2.5 % and 97.5 % within sampling error and ties
    assert np.mean(every_mean < low) <= 0.030
    assert np.mean(every_mean <= low) >= 0.020
    assert np.mean(every_mean < high) <= 0.980
    assert np.mean(every_mean <= high) >= 0.970


@pytest.mark.parametrize("values", [[500.0] * 100, [-3.25], [0.1] * 3], ids=["many", "one", "three"])
def test_values_without_spread_have_an_interval_without_width(values):
    mean, low, high = bootstrap_mean(np.array(values))
    assert low == mean == high == pytest.approx(values[0], rel=1e-15)


def test_the_interval_is_the_same_every_time():
    values = np.random.default_rng(2).normal(size=20)
    assert bootstrap_mean(values) == bootstrap_mean(values)


@pytest.mark.parametrize("count", [2, 3, 10, 57])
def test_intervals_and_means_are_scipys_to_the_bit(count):
    for values in (np.random.default_rng(count).normal(size=count), np.arange(float(count)) ** 2):
        theirs = scipy.stats.bootstrap((values,), np.mean, method="percentile", rng=0).confidence_interval
        assert bootstrap_mean(values)[1:] == (theirs.low, theirs.high)
        assert interquartile_mean(values) == scipy.stats.trim_mean(values, 0.25)
    for successes in range(count + 1):
        theirs = scipy.stats.binomtest(successes, count).proportion_ci(0.95, "wilson")
        assert wilson_rate(successes, count)[1:] == (theirs.low, theirs.high)


@given(st.integers(1, 500).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials))))
def test_the_interval_of_a_rate_is_wilsons(counts):
    successes, trials = counts
    rate = wilson_rate(successes, trials)
    share, z = successes / trials, 1.959963984540054
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)  # Wilson (1927)
    half = z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    assert rate.mean == share
    assert rate.low == pytest.approx(centre - half, abs=1e-12)
    assert rate.high == pytest.approx(centre + half, abs=1e-12)


def test_the_interquartile_mean_is_that_of_the_middle_half():
    values = np.array([-1000.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e6])
    assert interquartile_mean(values) == (2 + 3 + 4 + 5) / 4
    assert interquartile_mean(values[::-1]) == interquartile_mean(values)
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0  # a quarter of three values is none of them


def test_quartiles_cut_a_sample_into_quarters():
    assert quartiles(np.random.default_rng(0).permutation(101) / 1.0) == (50.0, 25.0, 75.0)
    assert quartiles(np.array([7.0])) == (7.0, 7.0, 7.0)


@given(st.lists(st.booleans()))
def test_a_condition_holds_from_its_last_breach_on(held):
    since = holds_since(np.array(held, dtype=bool))
    assert all(held[since:])
    assert since == 0 or not held[since - 1]


# -- delay --------------------------------------------------------------------------------------------------


def swing(times):
    """Three sinusoids of incommensurate periods (from 12 samples), each of which a delay shifts."""
    return sum(weight * np.sin(rate * times + rate) for rate, weight in ((0.13, 1.0), (0.31, 0.7), (0.52, 0.4)))


@pytest.mark.parametrize("shift", [0.0, 0.2, 0.5, 0.8, 2.25, 7.0, 13.4])
def test_the_delay_of_a_shifted_signal_is_found_to_a_hundredth_of_a_sample(shift):
    times = np.arange(20_000)
    found = delay([swing(times)], [0.3 * swing(times - shift) + 5.0], 0.02)
    assert found == pytest.approx(0.02 * shift, abs=0.01 * 0.02)


@pytest.mark.parametrize("shift", [0.3, 4.0, 9.7])
def test_the_delay_of_a_sinusoid_is_within_its_period(shift):
    times = np.arange(20_000)
    found = delay([np.sin(0.5 * times)], [np.sin(0.5 * (times - shift))], 1.0)
    assert found == pytest.approx(shift, abs=0.01)


@pytest.mark.parametrize("rate", [0.2, 0.5])
def test_the_delay_through_a_first_order_lag_is_that_of_its_phase(rate):
    times, time_constant = np.arange(20_000), 3.0
    phase = math.atan(rate * time_constant)  # of 1/(1 + j*rate*T)
    found = delay([np.sin(rate * times)], [np.cos(phase) * np.sin(rate * times - phase)], 1.0)
    assert found == pytest.approx(phase / rate, abs=0.01)


def test_the_delay_is_that_of_all_episodes_together():
    random = np.random.default_rng(3)
    desired = [random.normal(size=size) for size in (400, 3, 150, 1000)]
    actual = [np.concatenate([random.normal(size=6), signal])[: len(signal)] for signal in desired]
    assert delay(desired, actual, 0.5) == pytest.approx(3.0, abs=0.05)  # noise beside the peak: 1/sqrt(1500) samples


@given(st.floats(0.01, 100.0), st.floats(-100.0, 100.0))
def test_neither_scale_nor_offset_changes_a_delay(scale, offset):
    times = np.arange(500)
    expected = delay([swing(times)], [swing(times - 2.3)], 1.0)
    assert delay([swing(times)], [scale * swing(times - 2.3) + offset], 1.0) == pytest.approx(expected, abs=1e-6)


def test_a_signal_that_does_not_follow_has_no_delay():
    random = np.random.default_rng(4)
    noise, other = random.normal(size=(2, 1000))
    assert delay([noise], [other], 1.0) is None
    assert delay([noise], [-noise], 1.0) is None
    assert delay([np.full(9, 2.0)], [noise[:9]], 1.0) is None
    assert delay([noise[:9]], [np.full(9, 2.0)], 1.0) is None
    assert delay([noise[:1]], [other[:1]], 1.0) is None


def test_a_signal_that_leads_has_no_negative_delay():
    times = np.arange(2000)
    assert delay([swing(times)], [swing(times + 0.4)], 1.0) == 0.0


# -- energies -----------------------------------------------------------------------------------------------

SAMPLES = arrays(float, 12, elements=st.floats(-50, 50))


@pytest.mark.parametrize("duration", [0.05, 0.3, 2.0])
def test_the_energies_of_a_stalled_motor_are_those_of_its_exponential(duration):
    voltage, resistance, time_constant = 6.0, 1.5, 0.1
    final = voltage / resistance
    count = round(duration / time_constant * 1000)
    timestep = duration / count
    current = final * (1 - np.exp(-np.linspace(0, duration, count + 1) / time_constant))
    decay = math.exp(-duration / time_constant)
    drawn, returned = electrical_energy(np.full(count, voltage), current, timestep)
    # linear interpolation of an exponential errs by (dt/T)^2/12 = 1e-7
    assert drawn == pytest.approx(voltage * final * (duration - time_constant * (1 - decay)), rel=1e-5)
    assert returned == 0.0
    heat = resistance * integral_of_square(current, timestep)
    squares = duration - 2 * time_constant * (1 - decay) + time_constant / 2 * (1 - decay**2)
    assert heat == pytest.approx(resistance * final**2 * squares, rel=1e-5)
    magnetic = time_constant * resistance * current[-1] ** 2 / 2
    assert drawn == pytest.approx(heat + magnetic, rel=1e-5)


@given(SAMPLES, SAMPLES, st.floats(-50, 50))
def test_energy_returned_is_what_is_drawn_with_the_voltage_reversed(voltage, current, first):
    current = np.append(first, current)
    drawn, returned = electrical_energy(voltage, current, 0.1)
    assert drawn >= 0
    assert returned >= 0
    assert electrical_energy(-voltage, current, 0.1) == (returned, drawn)


@given(st.floats(-50, 50), st.floats(-50, 50), st.integers(1, 40))
def test_the_integral_of_the_square_of_a_ramp_is_exact(begin, end, count):
    samples = np.linspace(begin, end, count + 1)
    assert integral_of_square(samples, 2.0 / count) == pytest.approx(
        2.0 * (begin**2 + begin * end + end**2) / 3, rel=1e-9, abs=1e-9
    )


@given(SAMPLES, st.floats(-50, 50))
def test_the_work_on_a_free_mass_is_its_kinetic_energy(force, first):
    mass, timestep = 2.5, 0.05
    speed = np.append(first, first + np.cumsum(force) * timestep / mass)
    kinetic = mass / 2 * (speed[-1] ** 2 - speed[0] ** 2)
    assert mechanical_work(force, speed, timestep) == pytest.approx(kinetic, rel=1e-9, abs=1e-9)


def test_motors_whose_torques_have_means_of_their_own_lag_as_each_of_them():
    """A mean that one motor holds says nothing of lateness, and must not hide that of the others."""
    rng = np.random.default_rng(0)
    desired = [offset + rng.normal(size=400) for _ in range(3) for offset in (20.0, -20.0)]  # two motors in turn
    actual = [np.concatenate([np.full(4, signal.mean()), signal[:-4]]) for signal in desired]
    alone = [delay(desired[motor::2], actual[motor::2], 0.01) for motor in (0, 1)]
    assert alone == pytest.approx([0.04, 0.04], abs=1e-3)
    assert delay(desired, actual, 0.01, motors=2) == pytest.approx(0.04, abs=1e-3)


@pytest.mark.parametrize(
    ("samples", "changes"),
    [([], 0), ([0.0, 0.0], 0), ([1, 2, 3], 0), ([1, -1, 1], 2), ([1, 0, 0, -2], 1), ([1, 0, 2], 0)],
)
def test_a_sign_changes_where_the_next_one_is_another(samples, changes):
    assert sign_changes(np.array(samples, dtype=float)) == changes
