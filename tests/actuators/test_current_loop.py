"""Current loop, supply and voltage-driven motor, against the paper's algorithm and closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from codrl_mj.actuators import (
    CurrentLoop,
    DCMotorActuator,
    Inputs,
    Motor,
    Supply,
    find_family,
    parameters_type,
)
from codrl_mj.actuators.model import family_name
from tests.actuators.strategies import actuators, between, supplies
from tests.reference import of_actuator

states = st.tuples(between(-20, 20), between(-20, 20), between(-20, 20))
timesteps = between(1e-4, 0.1)


def advance(actuator, dt, state, torque, speed):
    """Return state, torque and signals after a step."""
    parameters = parameters_type(type(actuator))(*actuator.parameter_values)
    return actuator.advance(
        parameters, dt, actuator.State(*state), Inputs(torque, 0.0, speed, 0.0, 0.0)
    )


def with_substeps(actuator, substeps):
    return dataclasses.replace(
        actuator, controller=dataclasses.replace(actuator.controller, substeps=substeps)
    )


def available(actuator, current):
    """Return the available voltage [V] at a current [A]."""
    supply, max_voltage = actuator.supply or Supply(), actuator.controller.max_voltage
    open_circuit = max_voltage if math.isinf(supply.voltage) else supply.voltage
    return min(max_voltage, max(open_circuit - supply.resistance * abs(current), 0.0))


# -- the paper's algorithm -------------------------------------------------------------------------


@given(actuators, supplies, timesteps, states, between(-20, 20), between(-20, 20))
def test_a_step_follows_the_paper_within_the_available_voltage(
    actuator, supply, dt, state, force, velocity
):
    actuator = dataclasses.replace(with_substeps(actuator, 1), supply=supply)
    arm, limit = actuator.arm_radius, available(actuator, state[0])
    after, torque, signals = advance(actuator, dt, state, force * arm, velocity / arm)
    current, integral, error, voltage, delivered = of_actuator(actuator, limit)(
        dt, *state, force, velocity
    )
    # The tolerance is relative to the largest terms before the limit: a rounding error does not
    # shrink when terms cancel.
    motor, loop = actuator.motor, actuator.controller
    i_ref, emf = (
        abs(force * arm / motor.torque_constant),
        motor.back_emf_constant * abs(velocity / arm),
    )
    e_size = i_ref + abs(state[0])
    d_size = (e_size + abs(state[2])) / (dt + loop.derivative_time_constant)
    u_size = (
        loop.kp * e_size
        + loop.ki * (abs(state[1]) + e_size * dt)
        + loop.kd * d_size
        + loop.kff * i_ref
        + emf
    )
    i_size = abs(state[0]) + dt / motor.inductance * (
        u_size + emf + motor.resistance * abs(state[0])
    )
    assert abs(signals.voltage - voltage) <= 1e-12 * u_size
    assert abs(after.current - current) <= 1e-12 * i_size
    assert abs(torque / arm - delivered) <= 1e-12 * motor.torque_constant * i_size / arm
    assert after.integral == pytest.approx(
        integral, rel=1e-12, abs=1e-12 * (abs(state[1]) + e_size * dt)
    )
    assert after.error == pytest.approx(error, rel=1e-12, abs=1e-12 * (e_size + abs(state[2])))
    assert signals.current == after.current
    assert signals.reference_current == force * arm / motor.torque_constant
    assert signals.saturated == (abs(signals.voltage) >= limit)
    assert abs(signals.voltage) <= limit


@given(actuators, supplies, timesteps, states, between(-20, 20), between(-20, 20))
def test_substeps_equal_separate_steps_with_a_supply_voltage_each(
    actuator, supply, dt, state, torque, speed
):
    actuator = dataclasses.replace(actuator, supply=supply)
    count, after = actuator.controller.substeps, state
    for _ in range(count):
        after, *others = advance(with_substeps(actuator, 1), dt / count, after, torque, speed)
    assert advance(actuator, dt, state, torque, speed) == (after, *others)


ERRORS = np.random.default_rng(3).normal(size=200)


@pytest.mark.parametrize("dt", [1e-3, 0.05, 1.0])
@pytest.mark.parametrize("constant", [1e-3, 0.05, 2.0, 100.0])
def test_integral_and_derivative_match_scipys_backward_euler_filters(constant, dt):
    """Compare with 1/(s + leak) and s/(1 + Td*s); the error is the reference without gains."""
    leaking = CurrentLoop(kp=0.0, integral_leak=constant)
    filtering = CurrentLoop(kp=0.0, kd=1.0, max_voltage=math.inf, derivative_time_constant=constant)
    integral, previous, values = 0.0, 0.0, []
    for error in ERRORS:
        (_, integral, _), *_ = advance(
            DCMotorActuator(controller=leaking), dt, (0.0, integral, 0.0), error, 0.0
        )
        (*_, previous), _, signals = advance(
            DCMotorActuator(controller=filtering), dt, (0.0, 0.0, previous), error, 0.0
        )
        values.append((integral, signals.voltage))
    for ours, system in zip(
        np.transpose(values), (([1.0], [1.0, constant]), ([1.0, 0.0], [constant, 1.0])), strict=True
    ):
        numerator, denominator, _ = signal.cont2discrete(system, dt, method="backward_diff")
        theirs = signal.lfilter(numerator.ravel(), denominator, ERRORS)
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12 * np.abs(theirs).max())


# -- closed forms of the steady state --------------------------------------------------------------

STALLED, LINE = Motor(resistance=2.0, torque_constant=0.5), Motor(1.5, 0.1, 0.06, 0.06)
SHARE, STIFF = Motor(2.0, 0.1, 0.5, 0.7), CurrentLoop(kp=1e6, max_voltage=12.0)
FREE = CurrentLoop(kp=6.0, max_voltage=math.inf, bemf_compensation=False)
STEADY_STATES = {  # name: actuator, torque, speed, steps of 10 ms, current
    "stall": (DCMotorActuator(STALLED, STIFF), 1e5, 0.0, 600, 12.0 / 2.0),
    "the supply is the limit": (
        DCMotorActuator(STALLED, STIFF, Supply(6.0)),
        1e5,
        0.0,
        600,
        6.0 / 2.0,
    ),
    "V/(R + Rs)": (DCMotorActuator(STALLED, STIFF, Supply(12.0, 1.0)), 1e5, 0.0, 600, 12.0 / 3.0),
    "the supply has the controller's voltage": (
        DCMotorActuator(STALLED, STIFF, Supply(math.inf, 1.0)),
        1e5,
        0.0,
        600,
        4.0,
    ),
    "it sags to more than the controller uses": (
        DCMotorActuator(STALLED, CurrentLoop(kp=1e6, max_voltage=6.0), Supply(12.0, 1.0)),
        *(1e5, 0.0, 600, 6.0 / 2.0),
    ),
    "a first-order lag after 10 steps": (
        DCMotorActuator(Motor(2.0, 0.4), STIFF),
        1e5,
        0.0,
        10,
        6.0 * (1.0 - 0.95**10),
    ),
    "no load": (DCMotorActuator(LINE, STIFF), 1e5, 12.0 / 0.06, 500, 0.0),
    "driven beyond it": (DCMotorActuator(LINE, STIFF), 1e5, 13.0 / 0.06, 500, -1.0 / 1.5),
    "the datasheet's line": (
        DCMotorActuator(LINE, STIFF),
        1e5,
        -50.0,
        500,
        (12.0 + 0.06 * 50.0) / 1.5,
    ),
    "a proportional share": (
        DCMotorActuator(SHARE, CurrentLoop(kp=6.0)),
        1.2,
        3.0,
        100,
        2.4 * 6.0 / 8.0,
    ),
    "the same with back-EMF": (
        DCMotorActuator(SHARE, FREE),
        1.2,
        3.0,
        100,
        (6.0 * 2.4 - 0.7 * 3.0) / 8.0,
    ),
    "an integral": (DCMotorActuator(controller=CurrentLoop(kp=1.0, ki=5.0)), 1.7, 2.0, 1300, 1.7),
    "one that leaks: (kp + ki/leak)/(R + kp + ki/leak)": (
        DCMotorActuator(controller=CurrentLoop(kp=1.0, ki=5.0, integral_leak=2.0)),
        *(1.7, 0.0, 1300, 1.7 * 3.5 / 4.5),
    ),
    "feed-forward of R": (
        DCMotorActuator(Motor(3.0), CurrentLoop(kp=0.0, kff=3.0)),
        1.1,
        0.0,
        2000,
        1.1,
    ),
    "deadbeat: kp + R = L/dt, kff = R": (
        DCMotorActuator(Motor(1.0, 0.05), CurrentLoop(kp=4.0, kff=1.0)),
        1.3,
        0.0,
        1,
        1.3,
    ),
}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", STEADY_STATES)
def test_the_current_settles_at_the_closed_form(name, sign):
    actuator, torque, speed, steps, current = STEADY_STATES[name]
    state = (0.0, 0.0, 0.0)
    for _ in range(steps):
        state, *_ = advance(actuator, 0.01, state, sign * torque, sign * speed)
    assert state.current == pytest.approx(sign * current, rel=1e-12, abs=1e-12)


# -- errors, and descriptive properties ----------------------------------------------------------


def test_raises_if_the_supply_makes_the_saturated_current_oscillate():
    # i' = i + (V - Rs*i - R*i)*dt/L: the pole 1 - (R + Rs)*dt/L is -1 at Rs = 2*L/dt - R = 3
    allowed, refused = (
        DCMotorActuator(supply=Supply(resistance=resistance)) for resistance in (2.99, 3.0)
    )
    assert allowed.check(0.05) is None
    radii = DCMotorActuator.instability(
        np.array([allowed.parameter_values, refused.parameter_values]), 0.05
    )
    np.testing.assert_array_equal(radii < 1.0, [True, False])
    with pytest.raises(
        ValueError, match=r"supply\.resistance = 3: must be < 2\*L/dt - R = 3 ohm .* of 0\.05 s"
    ):
        refused.check(0.05)
    # The remedy of the message.
    assert with_substeps(refused, 2).check(0.05) is None


def test_properties_and_commands_follow_from_the_fields():
    actuator = DCMotorActuator(
        Motor(2.0, 0.3, 0.5, arm_radius=0.15), CurrentLoop(max_voltage=math.inf)
    )
    assert (actuator.winding, actuator.arm_radius, actuator.voltage_limit) == (
        (2.0, 0.3),
        0.15,
        math.inf,
    )
    assert actuator.motor.electrical_time_constant == 0.15
    limits = [
        DCMotorActuator(supply=supply).voltage_limit
        for supply in (None, Supply(12.0), Supply(48.0, 1.0))
    ]
    assert limits == [24.0, 12.0, 24.0]
    command = actuator.commands()["current"]
    assert command.actuator is actuator
    # The torque is kT*i.
    assert (command.torque_per_unit, command.limit) == (0.5, None)
    noisy = DCMotorActuator(controller=CurrentLoop(current_noise=0.1))
    assert noisy.random
    assert noisy.commands()["voltage"].actuator.random
    assert not DCMotorActuator(controller=CurrentLoop(current_bias=0.1)).random


# -- under a commanded voltage ---------------------------------------------------------------------


@given(
    actuators, supplies, between(1e-4, 0.05), between(-20, 20), between(-150, 150), between(-20, 20)
)
def test_the_terminal_voltage_is_the_command_within_the_available_voltage(
    actuator, supply, dt, current, volts, speed
):
    actuator = dataclasses.replace(actuator, supply=supply)
    command, motor, substeps = (
        actuator.commands()["voltage"],
        actuator.motor,
        actuator.controller.substeps,
    )
    state, delivered, signals = advance(
        command.actuator, dt, (current, 0.0, 0.0), volts * command.torque_per_unit, speed
    )
    expected, size = current, abs(current)
    for _ in range(substeps):
        limit = available(actuator, expected)
        voltage = np.clip(volts, -limit, limit)
        drop = motor.back_emf_constant * speed + motor.resistance * expected
        expected += (voltage - drop) / motor.inductance * (dt / substeps)
        sag = 0.0 if supply is None else supply.resistance
        size += dt / motor.inductance * (abs(volts) + abs(motor.back_emf_constant * speed)) + abs(
            expected
        )
        size *= 1 + (motor.resistance + sag) * dt / motor.inductance
    assert signals.voltage == pytest.approx(voltage, rel=1e-12, abs=1e-12 * size * (sag > 0.0))
    assert state.current == pytest.approx(expected, rel=1e-12, abs=1e-12 * size)
    assert delivered == motor.torque_constant * state.current
    # Without a desired torque, the delivered one counts as desired.
    assert signals.reference_current == signals.current == state.current


def test_a_commanded_voltage_bypasses_the_loop_and_the_sensor():
    actuator = DCMotorActuator(
        controller=CurrentLoop(5.0, 3.0, 1e-3, substeps=2, integral_leak=1.0, current_bias=0.5)
    )
    command = actuator.commands()["voltage"]
    driven, loop = command.actuator, command.actuator.controller
    assert (actuator.is_torque_controlled, driven.is_torque_controlled) == (True, False)
    assert (loop.kp, loop.ki, loop.kd, loop.integral_leak, loop.bemf_compensation) == (
        0,
        0,
        0,
        0,
        False,
    )
    assert (loop.substeps, command.limit) == (2, 24.0)
    applied_fields = {
        "motor.resistance",
        "motor.inductance",
        "motor.back_emf_constant",
        "controller.substeps",
    }
    fields = {f"motor.{field.name}" for field in dataclasses.fields(Motor)}
    fields |= {f"controller.{field.name}" for field in dataclasses.fields(CurrentLoop)}
    assert {*command.fixed} == fields - applied_fields
    assert advance(driven, 0.01, (1.0, 0.0, 0.0), 7.0, 2.0)[2].voltage == 7.0
    parameters, rest = (
        parameters_type(type(driven))(*driven.parameter_values),
        Inputs(0.0, 0.0, 0.0, 0.0, 0.0),
    )
    assert driven.observe(parameters, 0.01, driven.Signals(1.5, 1.5, 7.0, 0.0), rest) == (2.0, 2.0)
    assert find_family(family_name(type(driven))) is type(driven)
