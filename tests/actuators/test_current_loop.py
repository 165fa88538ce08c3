"""One step of the current loop: against the paper's algorithm written out by hand, and against closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from codrl_mj.actuators import Actuator, CurrentLoop, Inputs, Motor, parameters_type
from tests.actuators.strategies import actuators, between
from tests.reference import of_actuator

INFINITE = math.inf


def _one_substep(actuator, **loop):
    return dataclasses.replace(actuator, controller=dataclasses.replace(actuator.controller, substeps=1, **loop))


def advance(actuator, dt, current, integral, error, torque, speed):
    """Current, integral, error and voltage after a step."""
    parameters = parameters_type(type(actuator))(*actuator.numbers)
    inputs = Inputs(torque, 0.0, speed, 0.0, 0.0)
    after, delivered, signals = actuator.advance(parameters, dt, actuator.State(current, integral, error), inputs)
    assert signals.current == after.current
    assert signals.reference_current == torque / actuator.motor.torque_constant
    assert delivered == actuator.motor.torque_constant * after.current
    assert signals.saturated == (abs(signals.voltage) >= actuator.voltage_limit)
    return *after, signals.voltage


def _run(actuator, dt, steps, torque, speed, state=(0.0, 0.0, 0.0)):
    """The state and voltage after `steps` steps at constant desired torque and speed."""
    voltage = 0.0
    for _ in range(steps):
        *state, voltage = advance(actuator, dt, *state, torque, speed)
    return *state, voltage


states = st.tuples(between(-20, 20), between(-20, 20), between(-20, 20))
timesteps = between(1e-4, 0.1)


# -- the paper's algorithm ----------------------------------------------------------------------------------


@given(actuators, timesteps, states, between(-20, 20), between(-20, 20))
def test_one_step_is_the_papers_algorithm(actuator, dt, state, force, velocity):
    actuator = _one_substep(actuator)
    motor, loop = actuator.motor, actuator.controller
    arm = motor.arm_radius
    i, integral, e, u = advance(actuator, dt, *state, force * arm, velocity / arm)
    *expected_state, expected_u, expected_force = of_actuator(actuator)(dt, *state, force, velocity)

    # relative to the largest term of each sum: a rounding error is no smaller where terms cancel
    i_ref, omega = abs(force * arm / motor.torque_constant), abs(velocity / arm)
    e_size = i_ref + abs(state[0])
    integral_size = abs(state[1]) + e_size * dt
    d_size = (e_size + abs(state[2])) / (dt + loop.derivative_time_constant)
    u_size = loop.kp * e_size + loop.ki * integral_size + loop.kd * d_size
    u_size += motor.back_emf_constant * omega + loop.kff * i_ref
    i_size = abs(state[0]) + dt / motor.inductance * (u_size + motor.resistance * abs(state[0]))
    assert abs(i - expected_state[0]) <= 1e-12 * i_size
    assert abs(integral - expected_state[1]) <= 1e-12 * integral_size
    assert abs(e - expected_state[2]) <= 1e-12 * (e_size + abs(state[2]))
    assert abs(u - expected_u) <= 1e-12 * u_size
    assert abs(motor.torque_constant * i / arm - expected_force) <= 1e-12 * motor.torque_constant * i_size / arm


@given(actuators, timesteps, states, between(-20, 20), between(-20, 20))
def test_substeps_are_that_many_steps_at_a_fraction_of_the_timestep(actuator, dt, state, torque, speed):
    count = actuator.controller.substeps
    whole = advance(actuator, dt, *state, torque, speed)
    assert whole == _run(_one_substep(actuator), dt / count, count, torque, speed, state)


@given(actuators, timesteps, states, between(-20, 20), between(-20, 20))
def test_the_voltage_never_leaves_the_supply(actuator, dt, state, torque, speed):
    limit = actuator.controller.max_voltage
    assert -limit <= advance(actuator, dt, *state, torque, speed)[3] <= limit


@given(actuators, timesteps, states, between(-20, 20), between(-20, 20))
def test_reversing_everything_reverses_the_result(actuator, dt, state, torque, speed):
    forward = advance(actuator, dt, *state, torque, speed)
    backward = advance(actuator, dt, *(-s for s in state), -torque, -speed)
    assert forward == tuple(-value for value in backward)


# -- closed forms -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("u_max", [3.0, 12.0])
@pytest.mark.parametrize("resistance", [0.5, 2.0])
def test_stall_current_is_supply_over_resistance(u_max, resistance):
    actuator = Actuator(Motor(resistance=resistance, torque_constant=0.3), CurrentLoop(kp=1e6, max_voltage=u_max))
    current, *_, voltage = _run(actuator, 0.01, 600, torque=1e5, speed=0.0)
    assert voltage == u_max
    assert current == pytest.approx(u_max / resistance, rel=1e-12)


def test_the_winding_charges_as_a_discrete_first_order_lag():
    motor = Motor(resistance=2.0, inductance=0.4)
    actuator = Actuator(motor, CurrentLoop(kp=1e6, max_voltage=6.0))
    pole = 1.0 - motor.resistance * 0.01 / motor.inductance
    for steps in (1, 2, 10, 100):
        current, *_ = _run(actuator, 0.01, steps, torque=1e5, speed=0.0)
        assert current == pytest.approx(3.0 * (1.0 - pole**steps), rel=1e-12)


def test_no_current_flows_at_the_no_load_speed():
    actuator = Actuator(Motor(back_emf_constant=0.05), CurrentLoop(kp=1e6, max_voltage=12.0, bemf_compensation=False))
    assert _run(actuator, 0.01, 500, torque=1e5, speed=12.0 / 0.05)[0] == pytest.approx(0.0, abs=1e-12)
    assert _run(actuator, 0.01, 500, torque=1e5, speed=13.0 / 0.05)[0] < 0.0  # driven beyond it, it generates


@pytest.mark.parametrize("speed", [-200.0, -50.0, 0.0, 50.0, 200.0])
def test_the_saturated_torque_speed_curve_is_the_straight_line_of_the_datasheet(speed):
    motor = Motor(resistance=1.5, torque_constant=0.06, back_emf_constant=0.06)
    actuator = Actuator(motor, CurrentLoop(kp=1e9, max_voltage=24.0))
    torque = motor.torque_constant * _run(actuator, 0.01, 200, torque=1e5, speed=speed)[0]
    stall, no_load = 0.06 * 24.0 / 1.5, 24.0 / 0.06
    assert torque == pytest.approx(stall * (1.0 - speed / no_load), rel=1e-9)


@pytest.mark.parametrize("speed", [-3.0, 0.0, 3.0])
def test_a_proportional_loop_reaches_its_share_of_the_reference(speed):
    motor = Motor(resistance=2.0, torque_constant=0.5, back_emf_constant=0.7)
    compensated = Actuator(motor, CurrentLoop(kp=6.0, max_voltage=INFINITE))
    reference = 1.2 / 0.5
    assert _run(compensated, 0.01, 100, 1.2, speed)[0] == pytest.approx(reference * 6.0 / 8.0, rel=1e-12)
    plain = _one_substep(compensated, bemf_compensation=False)
    expected = (6.0 * reference - 0.7 * speed) / 8.0
    assert _run(plain, 0.01, 100, 1.2, speed)[0] == pytest.approx(expected, rel=1e-12)


def test_an_integral_removes_the_steady_state_error():
    current, *_ = _run(Actuator(controller=CurrentLoop(kp=1.0, ki=5.0)), 0.01, 1300, torque=1.7, speed=2.0)
    assert current == pytest.approx(1.7, rel=1e-12)


def test_a_leaking_integral_leaves_the_error_of_its_finite_gain():
    # a leak makes the integral's gain ki/leak at rest: i = ref*(kp + ki/leak)/(R + kp + ki/leak)
    loop = CurrentLoop(kp=1.0, ki=5.0, integral_leak=2.0)
    current, *_ = _run(Actuator(controller=loop), 0.01, 1300, torque=1.7, speed=0.0)
    assert current == pytest.approx(1.7 * 3.5 / 4.5, rel=1e-12)


def test_feed_forward_of_the_resistance_holds_the_reference_without_feedback():
    motor = Motor(resistance=3.0)
    actuator = Actuator(motor, CurrentLoop(kp=0.0, kff=3.0))
    assert _run(actuator, 0.01, 2000, torque=1.1, speed=0.0)[0] == pytest.approx(1.1, rel=1e-12)


def test_deadbeat_gain_reaches_the_reference_in_one_step():
    # kp + R = L/dt puts the loop's pole at 0; with kff = R there is no error left
    actuator = Actuator(Motor(resistance=1.0, inductance=0.1), CurrentLoop(kp=4.0, kff=1.0))
    assert _run(actuator, 0.02, 1, torque=1.3, speed=0.0)[0] == pytest.approx(1.3, rel=1e-14)


@given(actuators, between(-20, 20), between(-20, 20), between(-5, 5))
def test_compensation_makes_the_unsaturated_current_independent_of_speed(actuator, torque, speed, current):
    actuator = _one_substep(actuator, bemf_compensation=True, max_voltage=INFINITE)
    still = advance(actuator, 0.01, current, 0.0, 0.0, torque, 0.0)
    moving = advance(actuator, 0.01, current, 0.0, 0.0, torque, speed)
    scale = 0.01 / actuator.motor.inductance * (abs(moving[3]) + abs(actuator.motor.back_emf_constant * speed))
    assert moving[0] == pytest.approx(still[0], abs=1e-13 * (scale + abs(still[0]) + 1.0))
    assert moving[3] - still[3] == pytest.approx(
        actuator.motor.back_emf_constant * speed, abs=1e-12 * (abs(moving[3]) + abs(still[3]) + 1.0)
    )


# -- each feature's wiring ----------------------------------------------------------------------------------
# A state, and the one-step voltage or current with the feature on and off, worked out by hand from
# R = 2, L = 0.5, kT = 0.5, kE = 0.25, kP = 3, dt = 0.1; i = 1, I = 0.5, e_old = 0.25, torque 1 (i_ref = 2, e = 1),
# w = 4. Plain P loop with compensation: u = 3 + 1 = 4; i' = 1 + (4 - 1 - 2)/0.5*0.1 = 1.2.

FEATURES = {
    # name: (field changes, expected u, expected i')
    "proportional loop alone": ({}, 4.0, 1.2),
    "no compensation": ({"bemf_compensation": False}, 3.0, 1.0),
    "integral": ({"ki": 2.0}, 4.0 + 2.0 * 0.6, 1.2 + 0.2 * 1.2),
    "derivative": ({"kd": 0.1}, 4.0 + 0.1 * 7.5, 1.2 + 0.2 * 0.75),
    "feed-forward": ({"kff": 0.75}, 4.0 + 0.75 * 2.0, 1.2 + 0.2 * 1.5),
    "saturation": ({"max_voltage": 3.5}, 3.5, 1.1),
    "leak": ({"ki": 2.0, "integral_leak": 2.0}, 4.0 + 2.0 * 0.5, 1.2 + 0.2 * 1.0),
    "filtered derivative": ({"kd": 0.1, "derivative_time_constant": 0.15}, 4.0 + 0.1 * 3.0, 1.2 + 0.2 * 0.3),
    # second half-step from i = 1.1: e = 0.9, u = 3.7, i' = 1.1 + (3.7 - 1 - 2.2)/0.5*0.05
    "substeps": ({"substeps": 2}, 3.7, 1.15),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_each_feature_changes_the_step_as_worked_out_by_hand(feature):
    changes, voltage, current = FEATURES[feature]
    motor = Motor(resistance=2.0, inductance=0.5, torque_constant=0.5, back_emf_constant=0.25)
    actuator = Actuator(motor, CurrentLoop(**{"kp": 3.0, **changes}))
    result = advance(actuator, 0.1, 1.0, 0.5, 0.25, 1.0, 4.0)
    assert result[3] == pytest.approx(voltage, rel=1e-14)
    assert result[0] == pytest.approx(current, rel=1e-14)


def test_back_emf_opposes_the_current_of_a_moving_motor():
    # as above with no compensation and kE = 0: the winding sees the whole of u = 3, i' = 1 + (3 - 2)/0.5*0.1
    motor = Motor(resistance=2.0, inductance=0.5, torque_constant=0.5, back_emf_constant=0.0)
    loop = CurrentLoop(kp=3.0, bemf_compensation=False)
    assert advance(Actuator(motor, loop), 0.1, 1.0, 0.5, 0.25, 1.0, 4.0)[0] == pytest.approx(1.2, rel=1e-14)


# -- filters ------------------------------------------------------------------------------------------------

ERRORS = np.random.default_rng(3).normal(size=200)


def _integrals(leak, dt):
    """The integral of ERRORS: with no gain and no current the error is the reference itself."""
    actuator, integral, found = Actuator(controller=CurrentLoop(kp=0.0, integral_leak=leak)), 0.0, []
    for error in ERRORS:
        _, integral, _, _ = advance(actuator, dt, 0.0, integral, 0.0, error, 0.0)
        found.append(integral)
    return np.array(found)


def _derivatives(time_constant, dt):
    """The derivative of ERRORS: at kd = 1 it is the voltage, while the current is held at zero."""
    loop = CurrentLoop(kp=0.0, kd=1.0, max_voltage=INFINITE, derivative_time_constant=time_constant)
    actuator, previous, found = Actuator(controller=loop), 0.0, []
    for error in ERRORS:
        _, _, previous, voltage = advance(actuator, dt, 0.0, 0.0, previous, error, 0.0)
        found.append(voltage)
    return np.array(found)


def _discretised(numerator, denominator, dt):
    """ERRORS through a transfer function, by scipy's backward Euler rule."""
    b, a, _ = signal.cont2discrete((numerator, denominator), dt, method="backward_diff")
    return signal.lfilter(b.ravel(), a, ERRORS)


@pytest.mark.parametrize("dt", [1e-3, 0.05, 1.0])
@pytest.mark.parametrize("leak", [0.0, 0.1, 3.0, 100.0])
def test_the_integral_is_the_backward_euler_form_of_one_over_s_plus_leak(leak, dt):
    expected = _discretised([1.0], [1.0, leak], dt)
    np.testing.assert_allclose(_integrals(leak, dt), expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("dt", [1e-3, 0.05, 1.0])
@pytest.mark.parametrize("time_constant", [1e-3, 0.05, 2.0])
def test_the_derivative_is_the_backward_euler_form_of_s_over_one_plus_td_s(time_constant, dt):
    expected = _discretised([1.0, 0.0], [time_constant, 1.0], dt)
    np.testing.assert_allclose(
        _derivatives(time_constant, dt), expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max()
    )


@pytest.mark.parametrize("leak", [0.5, 20.0])
def test_the_integral_of_a_constant_error_settles_at_error_over_leak(leak):
    actuator = Actuator(controller=CurrentLoop(kp=0.0, integral_leak=leak))
    factor = 1.0 / (1.0 + leak * 0.05)
    for steps in (1, 3, 50):
        integral = _run(actuator, 0.05, steps, torque=0.0, speed=0.0, state=(0.0, 1.0, 0.0))[1]
        assert integral == pytest.approx(factor**steps, rel=1e-12)
    integral = 0.0
    for _ in range(1200):
        integral = advance(actuator, 0.05, 0.0, integral, 0.0, 2.0, 0.0)[1]
    assert integral == pytest.approx(2.0 / leak, rel=1e-12)


def test_without_filters_integral_and_derivative_are_the_papers_sum_and_difference():
    np.testing.assert_allclose(_integrals(0.0, 0.05), np.cumsum(ERRORS) * 0.05, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(_derivatives(0.0, 0.05), np.diff(ERRORS, prepend=0.0) / 0.05, rtol=1e-12)


@pytest.mark.parametrize(("filtered", "small"), [(_integrals, 1e-4), (_derivatives, 1e-6)])
def test_filters_vanish_linearly_with_their_parameter(filtered, small):
    plain = filtered(0.0, 0.05)
    distance = [np.abs(filtered(small * scale, 0.05) - plain).max() for scale in (1.0, 0.5, 0.25)]
    assert distance[0] > 0.0
    np.testing.assert_allclose(np.array(distance[:2]) / distance[1:], 2.0, rtol=2e-3)
