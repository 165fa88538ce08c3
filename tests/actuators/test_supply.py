"""What feeds the drive: a voltage behind a resistance, against the paper's algorithm under the voltage that is left."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.actuators import Actuator, CurrentLoop, Inputs, Motor, Supply, parameters_type
from tests.actuators.strategies import actuators, between, supplies
from tests.reference import of_actuator

states = st.tuples(between(-20, 20), between(-20, 20), between(-20, 20))


def _advance(actuator, dt, state, torque, speed):
    parameters = parameters_type(type(actuator))(*actuator.numbers)
    return actuator.advance(parameters, dt, actuator.State(*state), Inputs(torque, 0.0, speed, 0.0, 0.0))


def _available(actuator, current):
    """The voltage [V] that is left at a current [A]."""
    supply, most = actuator.supply or Supply(), actuator.controller.max_voltage
    open_circuit = most if math.isinf(supply.voltage) else supply.voltage
    return min(most, max(open_circuit - supply.resistance * abs(current), 0.0))


def _with_substeps(actuator, substeps):
    return dataclasses.replace(actuator, controller=dataclasses.replace(actuator.controller, substeps=substeps))


@given(actuators, supplies, between(1e-4, 0.1), states, between(-20, 20), between(-20, 20))
def test_a_step_is_the_papers_under_the_voltage_that_is_left(actuator, supply, dt, state, force, velocity):
    actuator = dataclasses.replace(_with_substeps(actuator, 1), supply=supply)
    arm, limit = actuator.arm_radius, _available(actuator, state[0])
    after, torque, signals = _advance(actuator, dt, state, force * arm, velocity / arm)
    current, integral, error, voltage, delivered = of_actuator(actuator, limit)(dt, *state, force, velocity)
    # relative to the largest terms, before the limit: a rounding error is no smaller where terms cancel
    motor, loop = actuator.motor, actuator.controller
    i_ref, emf = abs(force * arm / motor.torque_constant), motor.back_emf_constant * abs(velocity / arm)
    e_size = i_ref + abs(state[0])
    d_size = (e_size + abs(state[2])) / (dt + loop.derivative_time_constant)
    u_size = loop.kp * e_size + loop.ki * (abs(state[1]) + e_size * dt) + loop.kd * d_size + loop.kff * i_ref + emf
    i_size = abs(state[0]) + dt / motor.inductance * (u_size + emf + motor.resistance * abs(state[0]))
    assert abs(signals.voltage - voltage) <= 1e-12 * u_size
    assert abs(after.current - current) <= 1e-12 * i_size
    assert abs(torque / arm - delivered) <= 1e-12 * motor.torque_constant * i_size / arm
    assert after.integral == pytest.approx(integral, rel=1e-12, abs=1e-12 * (abs(state[1]) + e_size * dt))
    assert after.error == pytest.approx(error, rel=1e-12, abs=1e-12 * (e_size + abs(state[2])))
    assert signals.saturated == (abs(signals.voltage) >= limit)


@given(actuators, supplies, between(1e-4, 0.1), states, between(-20, 20), between(-20, 20))
def test_substeps_are_that_many_steps_each_with_its_own_sag(actuator, supply, dt, state, torque, speed):
    actuator = dataclasses.replace(actuator, supply=supply)
    count, state = actuator.controller.substeps, actuator.State(*state)
    whole = _advance(actuator, dt, state, torque, speed)
    for _ in range(count):
        state, delivered, signals = _advance(_with_substeps(actuator, 1), dt / count, state, torque, speed)
    assert whole == (state, delivered, signals)


@pytest.mark.parametrize(
    ("open_circuit", "most", "resistance", "stalled"),
    [
        (12.0, 24.0, 0.0, 6.0),  # the supply is the limit: V/R
        (24.0, 12.0, 0.0, 6.0),  # the controller is
        (12.0, 24.0, 1.0, 4.0),  # V/(R + Rs)
        (12.0, 6.0, 1.0, 3.0),  # it sags to 9 V, and 6 V is all that the controller uses
        (12.0, 9.0, 2.0, 3.0),  # it sags below 9 V
        (math.inf, 12.0, 1.0, 4.0),  # the supply has the controller's voltage
    ],
)
def test_the_stall_current_is_that_of_the_limit_that_binds(open_circuit, most, resistance, stalled):
    motor, loop = Motor(resistance=2.0, torque_constant=0.5), CurrentLoop(kp=1e6, max_voltage=most)
    actuator = Actuator(motor, loop, Supply(open_circuit, resistance))
    for sign in (1.0, -1.0):
        state = actuator.State(0.0, 0.0, 0.0)
        for _ in range(200):
            state, torque, signals = _advance(actuator, 0.01, state, sign * 1e5, 0.0)
        assert state.current == pytest.approx(sign * stalled, rel=1e-12)
        assert torque == 0.5 * state.current
        assert signals.voltage == pytest.approx(2.0 * state.current, rel=1e-12)
        assert signals.saturated == 1.0


def test_the_sag_is_that_of_the_current_at_the_electrical_steps_start():
    # R = 1, L = 0.5, dt = 0.1: i = 2 leaves 10 - 2*2 = 6 V, i' = 2 + (6 - 2)/0.5*0.1 = 2.8; then 4.4 V, i'' = 3.12
    actuator = Actuator(
        Motor(inductance=0.5), CurrentLoop(kp=1e6, max_voltage=10.0, substeps=2), Supply(resistance=2.0)
    )
    state, _, signals = _advance(actuator, 0.2, (2.0, 0.0, 0.0), 1e5, 0.0)
    assert signals.voltage == pytest.approx(4.4, rel=1e-14)
    assert state.current == pytest.approx(3.12, rel=1e-14)


def test_a_spent_supply_gives_nothing_and_no_other_sign():
    actuator = Actuator(controller=CurrentLoop(max_voltage=10.0), supply=Supply(resistance=2.0))
    for current in (5.0, -5.0, 50.0):
        signals = _advance(actuator, 0.01, (current, 0.0, 0.0), -current, 0.0)[2]
        assert signals.voltage == 0.0
        assert signals.saturated == 1.0


def test_a_supply_that_never_binds_changes_no_bit():
    plain = Actuator(controller=CurrentLoop(kp=2.0, ki=3.0, max_voltage=24.0))
    for supply in (Supply(), Supply(voltage=24.0), Supply(voltage=1e6, resistance=1e-3)):
        fed = dataclasses.replace(plain, supply=supply)
        assert _advance(fed, 0.01, (0.3, 0.2, 0.1), 1.0, 2.0) == _advance(plain, 0.01, (0.3, 0.2, 0.1), 1.0, 2.0)


@pytest.mark.parametrize(("supply", "limit"), [(None, 24.0), (Supply(12.0), 12.0), (Supply(48.0, 1.0), 24.0)])
def test_the_voltage_limit_is_the_lesser(supply, limit):
    assert Actuator(supply=supply).voltage_limit == limit


@given(actuators, supplies, between(1e-3, 0.1))
def test_what_is_refused_is_what_counts_as_unstable(actuator, supply, timestep):
    actuator = dataclasses.replace(actuator, supply=supply)
    (radius,) = type(actuator).instability(np.array([actuator.numbers]), timestep)
    try:
        actuator.check(timestep)
    except ValueError as error:
        refused = True
        assert "supply.resistance" in str(error) or "unstable" in str(error)  # noqa: PT017 - if and only if
    else:
        refused = False
    assert refused == (not radius < 1.0)


def test_a_resistance_under_which_the_saturated_current_oscillates_is_refused_with_its_bound():
    # i' = i + (V - Rs*i - R*i)*dt/L: the pole 1 - (R + Rs)*dt/L is -1 at Rs = 2*L/dt - R = 3
    for resistance, stable in ((2.99, True), (3.0, False)):
        actuator = Actuator(supply=Supply(resistance=resistance))
        if stable:
            actuator.check(0.05)
            continue
        with pytest.raises(ValueError, match=r"supply\.resistance = 3: must be < 2\*L/dt - R = 3 ohm .* of 0\.05 s"):
            actuator.check(0.05)
        dataclasses.replace(actuator, controller=CurrentLoop(substeps=2)).check(0.05)  # the remedy
