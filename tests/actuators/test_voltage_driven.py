"""A motor under commanded voltage: what the command `voltage` leaves of an actuator."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given

from codrl_mj.actuators import Actuator, CurrentLoop, Inputs, Motor, Supply, family_name, find_family, parameters_type
from tests.actuators.strategies import actuators, between


def _driven(actuator):
    return actuator.commands()["voltage"].actuator


def _advance(actuator, dt, current, torque, speed):
    parameters = parameters_type(type(actuator))(*actuator.numbers)
    inputs = Inputs(torque, 0.0, speed, 0.0, 0.0)
    return actuator.advance(parameters, dt, actuator.State(current, 0.0, 0.0), inputs)


@given(actuators, between(1e-4, 0.05), between(-20, 20), between(-150, 150), between(-20, 20))
def test_the_terminal_voltage_is_the_command_within_the_limit(actuator, dt, current, volts, speed):
    command = actuator.commands()["voltage"]
    motor, loop = actuator.motor, actuator.controller
    torque = volts * command.torque_per_unit
    state, delivered, signals = _advance(command.actuator, dt, current, torque, speed)
    expected_voltage = np.clip(volts, -loop.max_voltage, loop.max_voltage)
    expected, size = current, abs(current)
    for _ in range(loop.substeps):
        drop = motor.back_emf_constant * speed + motor.resistance * expected
        expected += (expected_voltage - drop) / motor.inductance * (dt / loop.substeps)
        size += dt / motor.inductance * (abs(volts) + abs(motor.back_emf_constant * speed)) + abs(expected)
        size *= 1 + motor.resistance * dt / motor.inductance
    assert signals.voltage == pytest.approx(expected_voltage, rel=1e-12)
    assert state.current == pytest.approx(expected, rel=1e-12, abs=1e-12 * size)
    assert delivered == motor.torque_constant * state.current


@given(actuators, between(-20, 20))
def test_what_follows_counts_as_asked_for(actuator, volts):
    driven = _driven(actuator)
    state, _, signals = _advance(driven, 0.01, 0.3, volts * actuator.motor.torque_constant, 1.0)
    assert signals.reference_current == signals.current == state.current
    assert not driven.tracks
    assert actuator.tracks


def test_the_supply_limits_and_sags():
    driven = _driven(Actuator(controller=CurrentLoop(max_voltage=24.0), supply=Supply(voltage=12.0, resistance=2.0)))
    assert _advance(driven, 0.01, 0.0, 20.0, 0.0)[2].voltage == 12.0
    signals = _advance(driven, 0.01, 3.0, 20.0, 0.0)[2]
    assert (signals.voltage, signals.saturated) == (6.0, 1.0)
    assert _advance(driven, 0.01, 3.0, 5.0, 0.0)[2].saturated == 0.0


def test_the_sensor_is_read_but_drives_nothing():
    loop = CurrentLoop(kp=5.0, ki=3.0, kd=1e-3, current_bias=0.5)
    driven, parameters = _driven(Actuator(controller=loop)), parameters_type(Actuator)
    assert _advance(driven, 0.01, 1.0, 7.0, 2.0)[2].voltage == 7.0
    signals = driven.Signals(1.5, 1.5, 7.0, 0.0)
    seen = driven.observe(parameters(*driven.numbers), 0.01, signals, Inputs(0.0, 0.0, 0.0, 0.0, 0.0))
    assert seen == (2.0, 2.0)


@given(actuators)
def test_no_gain_is_left_to_be_unstable_or_drawn(actuator):
    command = actuator.commands()["voltage"]
    loop = command.actuator.controller
    assert (loop.kp, loop.ki, loop.kd, loop.integral_leak, loop.bemf_compensation) == (0, 0, 0, 0, False)
    assert command.limit == loop.max_voltage == actuator.controller.max_voltage
    assert loop.substeps == actuator.controller.substeps
    kept = {"motor.resistance", "motor.inductance", "motor.back_emf_constant", "controller.substeps"}
    fields = {f"motor.{field.name}" for field in dataclasses.fields(Motor)}
    fields |= {f"controller.{field.name}" for field in dataclasses.fields(CurrentLoop)}
    assert {*command.fixed} == fields - kept


def test_it_is_found_by_its_place_and_is_not_the_loop_itself():
    driven = _driven(Actuator())
    assert find_family(family_name(type(driven))) is type(driven)
    assert type(driven) is not Actuator
    assert type(driven).from_numbers(driven.numbers, driven.arm_radius) == driven


def test_the_current_command_is_the_actuator_itself():
    actuator = Actuator(Motor(torque_constant=0.5, arm_radius=0.2))
    command = actuator.commands()["current"]
    assert command.actuator is actuator
    assert command.torque_per_unit == 0.5  # tau = kT*i
    assert command.limit is None
