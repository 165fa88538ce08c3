"""The lag: against its closed form, and the exact response to held commands."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import solve_ivp

from codrl_mj.actuators import Inputs, Lag, parameters_type
from codrl_mj.actuators.lag import HISTORY
from tests.actuators.strategies import between, zero_or

STEP = 0.01


def _responses(lag, commands, step=STEP):
    parameters, state, torques = parameters_type(Lag)(*lag.numbers), lag.State(*[0.0] * len(lag.State._fields)), []
    for index, command in enumerate(commands):
        state, torque, _ = lag.advance(parameters, step, state, Inputs(command, 0.0, 0.0, index * step, 0.0))
        torques.append(torque)
    return np.array(torques)


@pytest.mark.parametrize("time_constant", [0.003, 0.01, 0.2])
def test_a_step_is_answered_by_an_exponential(time_constant):
    times = STEP * np.arange(1, 101)
    expected = 2.0 * (1.0 - np.exp(-times / time_constant))
    np.testing.assert_allclose(_responses(Lag(time_constant=time_constant), [2.0] * 100), expected, rtol=1e-12)


@pytest.mark.parametrize("steps", range(9))
def test_a_delay_of_whole_steps_shifts_the_commands(steps):
    commands = np.random.default_rng(0).uniform(-1, 1, 50)
    delayed = _responses(Lag(time_constant=0.03, delay=steps * STEP), commands)
    shifted = np.concatenate((np.zeros(steps), commands))[:50]
    np.testing.assert_array_equal(delayed, _responses(Lag(time_constant=0.03), shifted))


@pytest.mark.parametrize("delay", [0.003, 0.0175, 0.0799])
def test_a_delay_without_a_lag_mixes_its_neighbours_in_proportion(delay):
    """Between whole delays a held command arrives within a step: its mean over the step."""
    commands = np.random.default_rng(1).uniform(-1, 1, 50)
    fine = 10_000  # samples a step
    arrived = np.repeat(np.concatenate((np.zeros(9), commands)), fine)
    shift = round(delay / STEP * fine)
    shifted = np.concatenate((np.zeros(shift), arrived))[: len(arrived)].reshape(-1, fine).mean(axis=1)[9:]
    np.testing.assert_allclose(_responses(Lag(time_constant=0.0, delay=delay), commands), shifted, atol=1e-12)


def test_without_time_constant_and_delay_it_is_ideal():
    commands = np.random.default_rng(2).uniform(-1, 1, 20)
    np.testing.assert_array_equal(_responses(Lag(time_constant=0.0), commands), commands)


def test_a_gain_scales_what_is_delivered():
    """The equation is linear: a gain is the commands'."""
    commands = np.random.default_rng(5).uniform(-1, 1, 50)
    weak = Lag(time_constant=0.03, delay=0.0125, gain=0.25)
    scaled = _responses(Lag(time_constant=0.03, delay=0.0125), 0.25 * commands)  # a power of two: exact
    np.testing.assert_array_equal(_responses(weak, commands), scaled)
    with pytest.raises(ValueError, match=r"Lag\.gain = 0\.0: must be"):
        Lag(gain=0.0)


def test_it_is_the_solution_of_its_differential_equation():
    commands = np.random.default_rng(3).uniform(-1, 1, 20)
    torque, expected = [0.0], []
    for command in commands:
        slope = lambda _, tau, command=command: (command - tau) / 0.04  # noqa: E731
        torque = solve_ivp(slope, (0.0, STEP), torque, rtol=1e-12, atol=1e-14).y[:, -1]
        expected.append(torque[0])
    np.testing.assert_allclose(_responses(Lag(time_constant=0.04), commands), expected, atol=1e-11)


def test_a_finer_step_does_not_change_a_held_command():
    """The solution is exact: ten steps of a tenth are one."""
    commands = np.random.default_rng(4).uniform(-1, 1, 20)
    fine = _responses(Lag(time_constant=0.04), np.repeat(commands, 10), STEP / 10)
    np.testing.assert_allclose(fine[9::10], _responses(Lag(time_constant=0.04), commands), atol=1e-14)


def test_delays_longer_than_what_is_remembered_are_refused():
    Lag(delay=8 * STEP).check(STEP)
    with pytest.raises(ValueError, match=r"Lag\.delay = 0\.0801: must be <= 0\.08 s, 8 steps of 0\.01 s"):
        Lag(delay=0.0801).check(STEP)
    numbers = np.array([Lag(delay=value).numbers for value in (0.08, 0.0801)])
    assert Lag.instability(numbers, STEP).tolist() == [0.0, math.inf]


@given(
    st.lists(between(-10, 10), min_size=1, max_size=40),
    between(1e-3, 0.1),
    zero_or(1e-3, 5),
    st.integers(0, HISTORY - 1),
    st.just(0.0) | between(0.01, 1.0),
)
def test_it_is_the_exact_answer_to_the_interpolated_commands(commands, step, time_constant, whole, fraction):
    """Any commands, step, time constant and delay, against scipy's zero-order hold of 1/(1 + T*s)."""
    count, delay = len(commands), whole + fraction
    earlier = np.arange(-HISTORY, count)
    arrived = np.interp(np.arange(count) - delay, earlier, np.concatenate([np.zeros(HISTORY), commands]))
    expected = arrived
    if time_constant:
        system = tuple(np.array([[value]]) for value in (-1.0 / time_constant, 1.0 / time_constant, 1.0, 0.0))
        a, b, *_ = signal.cont2discrete(system, step, "zoh")
        expected = signal.lfilter(b[0], [1.0, -a[0, 0]], arrived)
    np.testing.assert_allclose(
        _responses(Lag(time_constant, delay * step), commands, step), expected, atol=1e-7
    )  # 1e-9 of a step is none


@given(st.lists(st.tuples(between(0, 1), between(0, 1)), min_size=1, max_size=20), between(1e-3, 0.1))
def test_what_is_refused_is_what_counts_as_unstable(several, step):
    for one, radius in zip(several, Lag.instability(np.array(several), step), strict=True):
        try:
            Lag(*one).check(step)
        except ValueError:
            assert not radius < 1.0
        else:
            assert radius < 1.0
