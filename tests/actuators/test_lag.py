"""Lag: exact response to held commands, against scipy."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import signal

from codrl_mj.actuators import Inputs, Lag, parameters_type
from codrl_mj.actuators.lag import HISTORY
from tests.actuators.strategies import between, zero_or


@example([1.0, -2.0, 0.5, 3.0] * 5, 0.01, 0.03, HISTORY - 1, 0.75, 1.0)
@given(
    st.lists(between(-10, 10), min_size=1, max_size=40),
    between(1e-3, 0.1),
    zero_or(1e-3, 5),
    st.integers(0, HISTORY - 1),
    st.just(0.0) | between(0.01, 1.0),
    between(0.1, 2.0),
)
def test_the_response_to_interpolated_commands_is_exact(
    commands, step, time_constant, whole, fraction, gain
):
    """Compare any commands and parameters with scipy's zero-order hold of 1/(1 + T*s).

    A delay between whole steps weights the adjacent commands: a held command that arrives within a
    step counts by its mean over the step.
    """
    lag, count, delay = (
        Lag(time_constant, (whole + fraction) * step, gain),
        len(commands),
        whole + fraction,
    )
    parameters, state, torques = (
        parameters_type(Lag)(*lag.parameter_values),
        lag.State(*[0.0] * len(lag.State._fields)),
        [],
    )
    for index, command in enumerate(commands):
        state, torque, _ = lag.advance(
            parameters, step, state, Inputs(command, 0.0, 0.0, index * step, 0.0)
        )
        torques.append(torque)
    earlier = np.arange(-HISTORY, count)
    arrived = gain * np.interp(
        np.arange(count) - delay, earlier, np.concatenate([np.zeros(HISTORY), commands])
    )
    expected = arrived
    if time_constant:
        system = tuple(
            np.array([[value]]) for value in (-1.0 / time_constant, 1.0 / time_constant, 1.0, 0.0)
        )
        a, b, *_ = signal.cont2discrete(system, step, "zoh")
        expected = signal.lfilter(b[0], [1.0, -a[0, 0]], arrived)
    # A fraction of 1e-9 of a step counts as 0.
    np.testing.assert_allclose(torques, expected, atol=1e-7 if fraction else 1e-12)


def test_raises_if_the_delay_exceeds_the_history():
    Lag(delay=HISTORY * 0.01).check(0.01)
    with pytest.raises(
        ValueError, match=r"Lag\.delay = 0\.0801: must be <= 0\.08 s, 8 steps of 0\.01 s"
    ):
        Lag(delay=0.0801).check(0.01)


def test_warns_if_the_time_constant_seems_to_be_in_milliseconds():
    with pytest.warns(UserWarning, match=r"Lag\.time_constant = 50: .*for 50 ms write 0\.05"):
        Lag(50.0).check(0.01)
