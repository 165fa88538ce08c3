"""Page of a motor: the numbers of its datasheet with their sources, and its loop."""

import itertools
import math
import re

import numpy as np
import pytest

from codrl_mj.actuators import (
    CurrentLoop,
    DCMotorActuator,
    GearMotor,
    Inputs,
    Motor,
    PwmLoop,
    PwmServo,
    Supply,
    parameters_type,
)
from codrl_mj.cli import main
from codrl_mj.sizing import describe_motor, drive_limits, find_drive
from codrl_mj.viz.pages.diagrams import no_load_speed, torque_range, torque_speed_diagram
from codrl_mj.viz.pages.motor import _abilities
from tests.viz.pages.parsed import check_self_contained


def test_the_command_writes_a_page_with_every_number(tmp_path, capsys):
    out = tmp_path / "motor.html"
    assert main(["motor", "show", "quanser-qube-servo-2", "--html", str(out)]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    parsed = check_self_contained(out.read_text())
    for word in ("8.4", "resistance", "gain margin", "Quanser", "Bode: gain"):
        assert word in parsed.text
    assert {"abilities", "loop", "numbers", "drive"} <= set(parsed.ids)


def test_assumed_values_are_listed_below_the_abilities():
    drive = find_drive("kraken-x60")
    text = str(_abilities(describe_motor(drive), drive, None))
    assert "at 12 V" in text
    assert (
        "assumed, because not specified: controller.max_current = inf, motor.rotor_inertia = 0."
        in text
    )


def test_the_diagram_goes_through_stall_and_no_load():
    drive = find_drive("maxon-ec45-flat-50w", gear_ratio=12.0)
    can, plot = drive_limits(drive), torque_speed_diagram(drive)
    highest = next(curve for curve in plot.curves if re.match("voltage.*highest", curve.label))
    assert abs(np.interp(can.no_load_speed, highest.x, highest.y)) < 1e-3 * can.stall_torque
    assert highest.y.max() > can.stall_torque  # braking
    assert highest.y[highest.x > 0.0].max() < can.stall_torque


def test_torque_range_before_friction_ends_at_the_no_load_speed():
    """Compare with the formula: kT*(V - kE*w)/R is 0 at V/kE."""
    drive = find_drive("quanser-qube-servo-2", max_current=float("inf"))
    low, high = torque_range(drive, np.array([0.0, no_load_speed(drive)]))
    motor = drive.motor
    assert high[0] == np.float64(motor.torque_constant * drive.voltage_limit / motor.resistance)
    assert abs(high[1]) < 1e-12
    assert low[0] == -high[0]


def test_torque_range_of_a_pwm_servo_is_that_of_its_largest_duty_cycle():
    servo = PwmServo(GearMotor(), PwmLoop(max_duty=0.5), Supply(12.0, 1.0))
    motor = servo.motor
    expected = 0.5 * 12.0 * motor.torque_constant / (motor.resistance + 0.5**2 * 1.0)
    low, high = torque_range(servo, np.array([0.0]))
    assert (low[0], high[0]) == pytest.approx((-expected, expected))


def test_torque_range_with_a_supply_is_where_the_motor_settles():
    """Command far more than the motor can deliver, at a constant speed."""
    motor = Motor(resistance=1.0, inductance=1e-3, torque_constant=0.1, back_emf_constant=0.1)
    speeds = np.array([-100.0, 0.0, 50.0, 100.0, 200.0])
    sagging, unlimited = Supply(24.0, 1.0), Supply(math.inf, 0.5)
    for supply, max_voltage in (
        (sagging, math.inf),
        (sagging, 9.0),
        (unlimited, 12.0),
        (None, 12.0),
    ):
        actuator = DCMotorActuator(
            motor, CurrentLoop(kp=10.0, max_voltage=max_voltage, substeps=20), supply
        )
        settled = []
        for command, speed in itertools.product((-1e3, 1e3), speeds):
            parameters, state, torque = (
                parameters_type(DCMotorActuator)(*actuator.parameter_values),
                actuator.State(0.0, 0.0, 0.0),
                0.0,
            )
            for _ in range(200):
                state, torque, _ = actuator.advance(
                    parameters, 1e-3, state, Inputs(command, 0.0, speed, 0.0, 0.0)
                )
            settled.append(torque)
        np.testing.assert_allclose(np.ravel(torque_range(actuator, speeds)), settled, rtol=1e-6)
