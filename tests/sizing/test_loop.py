"""Margins, bandwidth and steps, against closed forms, python-control and frequency sweeps."""

import dataclasses
import math

import control
import numpy as np
import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Drive, SampledLoop
from codrl_mj.sizing import (
    analyze_loop,
    analyze_sample_rates,
    closed_loop,
    find_drive,
    is_closed,
    loop_gains,
    open_loop,
    simulate_loop,
    small_step_response,
    step_responses,
)
from codrl_mj.sizing.loop import ANTI_WINDUPS
from codrl_mj.validation import motor_loops

MOTORS = ("quanser-qube-servo-2", "maxon-dcx22l", "heinzmann-pmg-132", "lego-ev3-large")
every_motor = pytest.mark.parametrize("name", MOTORS)
every_rate = pytest.mark.parametrize("rate", [10e3, 40e3])
with_and_without_delay = pytest.mark.parametrize(
    "delayed", [False, True], ids=["no delay", "delayed"]
)


def measured_gain(drive, frequency, samples=400):
    """Return the simulated complex gain from reference to sampled current at a frequency [Hz]."""
    angle = 2 * math.pi * frequency / drive.controller.sample_rate * np.arange(samples)
    amplitude = 1e-3 * drive.voltage_limit / drive.motor.resistance
    late = slice(samples // 2, None)
    basis = np.stack([np.sin(angle), np.cos(angle)], axis=1)[late]
    current = simulate_loop(drive, amplitude * np.sin(angle)).current[late] / amplitude
    return complex(*np.linalg.lstsq(basis, current, rcond=None)[0])


@every_motor
@every_rate
@with_and_without_delay
def test_the_design_agrees_with_closed_forms(name, rate, delayed):
    """The loop is P/(z - 1), with a delay P/(z*(z - 1)): P = 1 - exp(-2*pi*bandwidth/rate)."""
    figures = analyze_loop(
        find_drive(name, sample_rate=rate, bandwidth=0.05 * rate, delayed=delayed)
    )
    share = -math.expm1(-2 * math.pi * 0.05)
    crossover = 2 * math.asin(share / 2)  # angle of a sample [rad]
    assert figures.gain_margin == pytest.approx((1 if delayed else 2) / share, rel=1e-6)
    assert figures.phase_crossover == pytest.approx(rate / 6 if delayed else rate / 2, rel=1e-6)
    phase = math.pi / 2 - crossover * (1.5 if delayed else 0.5)
    assert figures.phase_margin == pytest.approx(math.degrees(phase), abs=1e-4)
    assert figures.crossover == pytest.approx(crossover / (2 * math.pi) * rate, rel=1e-6)
    if not delayed:
        left = 1 - share
        angle = math.acos((1 + left**2 - 2 * share**2) / (2 * left))
        assert figures.bandwidth == pytest.approx(angle / (2 * math.pi) * rate, rel=1e-6)
        assert figures.settling_time == pytest.approx(
            math.ceil(math.log(0.02) / math.log(left)) / rate, rel=1e-9
        )
        assert figures.overshoot < 1e-9


@every_motor
@with_and_without_delay
def test_the_simulated_loop_has_the_computed_bandwidth_and_margins(name, delayed):
    drive = find_drive(name, delayed=delayed)
    figures = analyze_loop(drive)
    around = figures.bandwidth * np.linspace(0.9, 1.1, 5)
    sweep = [abs(measured_gain(drive, frequency)) for frequency in around]
    bandwidth = np.interp(-math.sqrt(0.5), -np.array(sweep), around)
    assert bandwidth == pytest.approx(figures.bandwidth, rel=0.02)
    closed = measured_gain(drive, figures.crossover)
    opened = closed / (1 - closed)
    assert abs(opened) == pytest.approx(1.0, rel=1e-4)
    assert math.degrees(np.angle(opened)) == pytest.approx(figures.phase_margin - 180.0, abs=0.01)
    if (
        delayed
    ):  # a sixth of the rate is where the phase is -180 degrees: the closed form's angle of 60
        closed = measured_gain(drive, drive.controller.sample_rate / 6)
        assert closed / (1 - closed) == pytest.approx(-1 / figures.gain_margin, rel=1e-3)


@with_and_without_delay
@pytest.mark.parametrize(
    "fields", [{}, {"kp": 2.0, "ki": 9e3}, {"kp": 3.0}], ids=["designed", "given", "kp alone"]
)
def test_the_simulated_step_agrees_with_python_control(delayed, fields):
    drive = Drive(controller=SampledLoop(delayed=delayed, **fields))
    response = simulate_loop(drive, np.full(200, 0.01))
    _, currents = control.step_response(closed_loop(drive), response.time)
    np.testing.assert_allclose(response.current, 0.01 * currents, atol=1e-9)
    figures = analyze_loop(drive)
    if not fields:
        assert figures.overshoot == pytest.approx(max(currents.max() - 1, 0), abs=1e-9)
    assert math.isnan(figures.settling_time) == ("ki" not in fields and bool(fields))
    assert (figures.kp, figures.ki) == loop_gains(drive)


@with_and_without_delay
@pytest.mark.parametrize(
    "loop", [{"kp": 9.0, "ki": 2e4}, {"kp": 2.0, "ki": 6e4}, {"bandwidth": 800.0}]
)
def test_the_margins_agree_with_python_control(loop, delayed):
    drive = Drive(controller=SampledLoop(delayed=delayed, **loop))
    gain_margin, phase_margin, gain_at, phase_at = control.margin(open_loop(drive))
    figures = analyze_loop(drive)
    assert (figures.phase_margin, figures.crossover) == pytest.approx(
        (phase_margin, phase_at / 2 / math.pi), rel=1e-6
    )
    if delayed:  # Without a delay the crossing is where python-control does not look.
        expected = pytest.approx((gain_margin, gain_at / 2 / math.pi), rel=1e-6)
        assert (figures.gain_margin, figures.phase_crossover) == expected


@pytest.mark.parametrize(
    "loop",
    [
        CurrentLoop(kp=1.0, ki=20.0, kd=1e-6),
        CurrentLoop(kp=4.0, ki=300.0, integral_leak=3.0, kff=0.5),
        CurrentLoop(kp=2.0, kd=1e-3, derivative_time_constant=0.004, current_bias=0.1, substeps=2),
    ],
    ids=["paper's", "leak and feed-forward", "filtered derivative"],
)
def test_the_loop_of_an_actuator_agrees_with_python_control_s_series(loop):
    actuator, timestep = DCMotorActuator(controller=loop), 0.02
    dt = timestep / loop.substeps
    joined = motor_loops.closed_loop(actuator, dt)
    z = np.exp(1j * np.linspace(0.01, 3.1, 40))
    np.testing.assert_allclose(closed_loop(actuator, timestep)(z), joined(z), rtol=1e-9)
    response = simulate_loop(actuator, np.full(200, 0.01), timestep=timestep)
    np.testing.assert_allclose(
        response.current, 0.01 * control.step_response(joined, response.time)[1], atol=1e-9
    )
    figures, (_, phase_margin, _, phase_at) = (
        analyze_loop(actuator, timestep),
        control.margin(open_loop(actuator, timestep)),
    )
    assert (figures.phase_margin, figures.crossover) == pytest.approx(
        (phase_margin, phase_at / 2 / math.pi), rel=1e-6
    )
    assert figures.sample_rate == loop.substeps / timestep


def test_raises_if_an_actuator_s_loop_has_no_timestep_or_gain():
    assert not is_closed(DCMotorActuator(controller=CurrentLoop(kp=0.0, kff=1.0)))
    with pytest.raises(ValueError, match="timestep = None: must be the mechanical step"):
        analyze_loop(DCMotorActuator())


def test_designs_at_other_rates_exist_if_the_bandwidth_allows():
    designs_ = analyze_sample_rates(
        find_drive("quanser-qube-servo-2", bandwidth=2000.0, sample_rate=25e3)
    )
    assert [rate for rate, delayed in designs_ if delayed] == [10e3, 20e3, 25e3, 40e3]
    assert "must be <= 1591.55 Hz" in designs_[10e3, False]
    assert designs_[40e3, True].phase_margin > designs_[20e3, True].phase_margin
    assert designs_[40e3, False].phase_margin > designs_[40e3, True].phase_margin


def test_a_slow_loop_has_a_bandwidth_but_no_settling_time():
    figures = analyze_loop(find_drive("quanser-qube-servo-2", bandwidth=0.1))
    assert figures.bandwidth == pytest.approx(0.1, rel=1e-3)
    assert math.isnan(figures.settling_time)
    with pytest.raises(ValueError, match=r"sample_rate = 500: must be >= 1000 Hz"):
        step_responses(find_drive("quanser-qube-servo-2", sample_rate=500.0))


def test_raises_if_the_loop_is_unstable():
    for judge in (analyze_loop, step_responses):
        with pytest.raises(
            ValueError, match=r"unstable: spectral radius .* Lower controller\.kp = 500"
        ):
            judge(Drive(controller=SampledLoop(kp=500.0)))


@pytest.mark.parametrize("name", ["quanser-qube-servo-2", "heinzmann-pmg-132", "cubemars-ak80-6"])
def test_anti_windup_shortens_the_recovery(name):
    """One largest current is within reach at half the no-load speed, so the speed is higher."""
    drive = find_drive(name)
    steps = step_responses(drive)
    within = (
        drive.voltage_limit - drive.motor.back_emf_constant * steps.speed
    ) / drive.motor.resistance
    assert steps.unreachable == pytest.approx(1.8 * within, rel=1e-9)
    assert steps.unreachable <= drive.controller.max_current
    times = {kind: 1e3 * steps.recoveries[kind].settling_time(0.05) for kind in ANTI_WINDUPS}
    assert times["back_calculation"] <= 1.0
    assert times["clamping"] <= 4.0
    assert 15.0 < times["none"] < 60.0
    assert (
        steps.recoveries["back_calculation"].undershoot
        < 1e-3
        < steps.recoveries["clamping"].undershoot
        < 1.0
    )
    reached = steps.recoveries["none"].current[round(0.0199 * drive.controller.sample_rate)]
    assert reached == pytest.approx(within, rel=0.01)


@pytest.mark.parametrize("compensated", [True, False])
@with_and_without_delay
def test_a_response_at_speed_starts_from_zero_current(compensated, delayed):
    drive = Drive(controller=SampledLoop(delayed=delayed, bemf_compensation=compensated))
    np.testing.assert_allclose(simulate_loop(drive, np.zeros(20), 300.0).current, 0.0, atol=1e-12)


@every_motor
def test_the_small_step_does_not_saturate(name):
    for delayed in (False, True):
        small = small_step_response(find_drive(name, delayed=delayed))
        assert np.abs(small.voltage).max() < 0.9 * find_drive(name).voltage_limit
        assert np.isfinite(small.settling_time())


def test_without_back_emf_the_unreachable_current_exceeds_the_stall_current():
    motor = dataclasses.replace(Drive().motor, back_emf_constant=0.0)
    steps = step_responses(Drive(motor))
    assert (steps.speed, steps.unreachable) == (0.0, pytest.approx(1.8 * 24.0 / 8.4))
