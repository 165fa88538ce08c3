"""Responses of servos against linear models and closed forms, and their pictures and tables."""

import dataclasses
import json
import math

import numpy as np
import pytest

from codrl_mj.actuators import (
    GearMotor,
    PwmLoop,
    PwmServo,
    SampledLoop,
    Servo,
    ServoFriction,
    ServoLoop,
    Supply,
)
from codrl_mj.cli import main
from codrl_mj.sizing import analyze_servo, find_drive, find_servo
from codrl_mj.sizing.servo_response import FREQUENCIES, STEP, max_lifted_load
from codrl_mj.viz.pages.servo_diagrams import servo_plots, steady_errors

MOTOR = GearMotor(
    resistance=2.0,
    inductance=2e-5,
    torque_constant=4e-3,
    back_emf_constant=4e-3,
    rotor_inertia=2e-7,
    gear_ratio=200.0,
)
PWM = PwmServo(MOTOR, PwmLoop(position_gain=0.1, servo_rate=5000.0), Supply(100.0))
"""A servo that is never at its limits here."""
INERTIA = 0.01


def test_gain_phase_and_bandwidth_are_those_of_a_mass_on_a_damped_spring():
    response = analyze_servo(PWM, INERTIA)
    total = INERTIA + MOTOR.rotor_inertia * MOTOR.gear_ratio**2
    frequencies = 2.0 * math.pi * FREQUENCIES
    answers = PWM.stiffness / (
        PWM.stiffness - total * frequencies**2 + 1j * frequencies * PWM.back_emf_damping
    )
    np.testing.assert_allclose(response.gains, np.abs(answers), rtol=0.02)
    np.testing.assert_allclose(response.phases, np.unwrap(np.angle(answers)), atol=0.05)
    grid = np.geomspace(1.0, 32.0, 10_000)
    waves = 2j * math.pi * grid
    gains = abs(PWM.stiffness / (PWM.stiffness + total * waves**2 + waves * PWM.back_emf_damping))
    exact = grid[np.argmax(gains < math.sqrt(0.5))]
    assert response.bandwidth == pytest.approx(exact, rel=0.03)


def test_the_step_overshoots_and_settles_as_that_mass():
    response = analyze_servo(PWM, INERTIA)
    total = INERTIA + MOTOR.rotor_inertia * MOTOR.gear_ratio**2
    natural = math.sqrt(PWM.stiffness / total)
    damping = PWM.back_emf_damping / (2.0 * natural * total)
    overshoot = math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert response.overshoot == pytest.approx(overshoot, abs=0.01)
    assert abs(response.final_error) < 1e-3
    outside = np.abs(response.step.position - (STEP - response.final_error)) > 0.02 * STEP
    assert not outside[response.step.time >= response.settling_time].any()
    assert response.step.position.max() == pytest.approx(STEP * (1.0 + overshoot), abs=0.01)


@pytest.mark.parametrize("resistance", [0.0, 0.7])
def test_the_sag_is_the_error_whose_duty_cycle_carries_the_load(resistance):
    servo = dataclasses.replace(PWM, supply=Supply(12.0, resistance))
    response = analyze_servo(servo, INERTIA)
    errors = np.array([0.5, 2.0, 9.0])
    duty = servo.loop.position_gain * errors
    currents = duty * 12.0 / (MOTOR.resistance + duty**2 * resistance)
    torques = MOTOR.gear_ratio * MOTOR.torque_constant * currents
    np.testing.assert_allclose(steady_errors(servo, response, torques), errors, rtol=1e-9)
    largest = 12.0 / (MOTOR.resistance + resistance) * MOTOR.torque_constant * MOTOR.gear_ratio
    assert response.max_torque == pytest.approx(largest, rel=1e-12)


def test_a_servo_with_a_current_loop_sags_by_load_over_both_gains():
    motor = dataclasses.replace(MOTOR, rotor_inertia=0.0)
    loop = ServoLoop(position_gain=10.0, velocity_gain=0.5)
    servo = Servo(motor, SampledLoop(20e3, max_current=1.0), Supply(24.0), loop)
    response = analyze_servo(servo, INERTIA)
    assert response.stiffness == pytest.approx(5.0, rel=1e-12)
    assert response.max_torque == pytest.approx(0.8, rel=1e-12)
    # The inertia turns the two loops into s^2 + 50*s + 500, with half the power at this frequency.
    half_power = math.sqrt(0.5 * (math.sqrt(1500.0**2 + 4.0 * 500.0**2) - 1500.0))
    assert response.bandwidth == pytest.approx(half_power / (2.0 * math.pi), rel=0.02)
    assert analyze_servo(servo).inertia == pytest.approx(0.05 * servo.back_emf_damping)
    with pytest.raises(ValueError, match="must be 'position'"):
        analyze_servo(dataclasses.replace(servo, loop=ServoLoop("velocity")))


def test_friction_and_losses_of_the_gear_shift_the_sag():
    motor = dataclasses.replace(MOTOR, coulomb_friction=1e-4, gear_efficiency=0.8)
    servo = dataclasses.replace(PWM, motor=motor)
    sag = servo_plots(servo, analyze_servo(servo, INERTIA))[3]
    free, lifting, lowering = sag.curves
    load, friction = free.x[10], 1e-4 * MOTOR.gear_ratio
    assert lifting.y[10] == pytest.approx((load + friction) / 0.8 / servo.stiffness, rel=1e-9)
    assert lowering.y[10] == pytest.approx((load - friction) * 0.8 / servo.stiffness, rel=1e-9)


def test_the_largest_load_that_an_sts3215_lifts_is_its_printed_stall_torque_at_full_duty():
    """Its gear passes on 64 % of the motor's torque, which without friction looks much larger."""
    servo = find_servo(
        {"name": "feetech-sts3215-7v4", "family": "pwm_servo"}, find_drive("feetech-sts3215-7v4")
    )
    response = analyze_servo(servo)
    # 19.5 kg*cm at 7.4 V; the largest duty cycle is 0.97, and friction takes its share in full.
    assert max_lifted_load(servo, response) == pytest.approx(0.97 * 1.912, rel=3e-3)
    assert response.max_torque > 3.0
    rubbing = dataclasses.replace(PWM, friction=ServoFriction(base=0.1))
    assert math.isnan(max_lifted_load(rubbing, response))


STS = "motor show feetech-sts3215-7v4 --family pwm_servo --position-p 16 --inertia 0.01"


def test_motor_show_prints_and_draws_a_bus_servo(tmp_path, capsys):
    words = f"{STS} --out {tmp_path} --html {tmp_path}/page.html".split()
    assert main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "2.656 of the voltage per rad, 8.468 N*m/rad, P = 16 of feetech-sts" in text
    assert "bandwidth" in text
    assert "controller." not in text
    for name in ("servo.png", "torque_speed.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "page.html").read_text()
    assert "Sag: error that carries a load" in page
    assert "Current loop" not in page


def test_motor_show_reports_a_servo_as_json(capsys):
    assert main([*STS.split(), "--json"]) == 0
    servo = json.loads(capsys.readouterr().out)["servo"]
    setting = {"name": "feetech-sts3215-7v4", "family": "pwm_servo", "loop": {"position_p": 16}}
    expected = analyze_servo(find_servo(setting, find_drive("feetech-sts3215-7v4")), 0.01)
    assert servo["stiffness"] == pytest.approx(expected.stiffness)
    assert servo["units"]["stiffness"] == "N*m/rad"
    assert servo["inertia"] == 0.01


def test_a_register_of_another_motor_is_shown_with_its_firmware(capsys):
    words = "motor show maxon-re65 --family pwm_servo --position-p 32 --firmware feetech-sts"
    assert main(words.split()) == 0
    assert "P = 32 of feetech-sts" in " ".join(capsys.readouterr().out.split())


def test_a_register_of_an_unknown_firmware_is_refused(capsys):
    assert (
        main([*["motor", "show", "maxon-re65", "--family", "pwm_servo", "--position-p"], "32"]) != 0
    )
    assert "set firmware to one of feetech-sts" in capsys.readouterr().err
