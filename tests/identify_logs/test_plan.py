"""Plans of an excitation: expected errors, limits, and the written voltage."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply
from codrl_mj.identify import plan as plans
from codrl_mj.identify.plan import GOALS, MARGIN, RATES, Sensing, plan, write_excitation
from codrl_mj.identify.synthetic import EXCITATIONS, Load, Sampler, Sensor, simulate

MOTOR = GearMotor(0.94, 3.6e-4, 0.036, 0.036, 1.35e-5, coulomb_friction=5e-3, viscous_friction=1e-6)
DRIVE = Drive(MOTOR, SampledLoop(), Supply(12.0))
LOAD = Load(1e-4)


def plan_at_rates(*rates, kinds=EXCITATIONS, **arguments):
    """Return a plan that compares only some rates [Hz] and excitations."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plans, "RATES", rates)
        patched.setattr(plans, "EXCITATIONS", kinds)
        return plan(arguments.pop("drive", DRIVE), LOAD, **arguments)


@pytest.fixture(scope="module")
def planned():
    return plan_at_rates(*RATES[:4], duration=2.0, max_current=4.0)


def find_option(result, kind, rate):
    """Return the option of a plan with an excitation and a rate [Hz]."""
    return next(
        option for option in result.options if (option.excitation.kind, option.rate) == (kind, rate)
    )


def test_the_best_option_reaches_its_goals_at_the_lowest_rate(planned):
    best = planned.best
    assert planned.missed_goals == planned.unknown == []
    assert set(best.errors) == set(GOALS)
    assert all(best.errors[name] <= goal / MARGIN for name, goal in GOALS.items())
    assert not [
        option
        for option in planned.options
        if option.rate < best.rate and option.worst <= 1.0 / MARGIN
    ]


def test_currents_stay_within_their_limits(planned):
    assert max(option.peak_current for option in planned.options) <= 4.0
    warm = plan_at_rates(1e3, duration=1.0, continuous_current=1.0)
    assert max(option.rms_current for option in warm.options) <= 1.0


def test_a_slow_sine_and_a_held_shaft_do_not_show_all_parameters(planned):
    assert find_option(planned, "slow_sine", 1000.0).errors.get("inductance", math.inf) > 0.5
    assert set(find_option(planned, "locked_prbs", 5000.0).errors) == {"resistance", "inductance"}
    square, prbs = (
        find_option(planned, "square", 1000.0).errors,
        find_option(planned, "prbs", 1000.0).errors,
    )
    assert prbs["inductance"] < 0.3 * square["inductance"]


def test_voltages_that_change_between_rows_make_the_inductance_uncertain():
    errors = {
        voltage: (
            plan_at_rates(
                5e3, kinds=["locked_prbs"], sensing=Sensing(voltage=voltage), duration=1.0
            ).best.errors["inductance"]
        )
        for voltage in ("together", "mean", "instantaneous")
    }
    assert 10.0 * errors["together"] < errors["mean"] < errors["instantaneous"]


@pytest.mark.matrix
def test_expected_errors_agree_with_fits(planned):
    """R, L and kE are fitted by scipy's least squares to logs with different noise."""
    option = find_option(planned, "chirp", 10e3)
    noise = 0.01 * option.peak_current
    solutions = []
    for seed in range(40):
        sensors = {"current": Sensor(noise)}
        log = simulate(DRIVE, option.excitation, LOAD, sensors, Sampler(option.rate), seed)
        # The drive has two samples per row; each has the speed in its middle.
        sample_times = np.arange(2 * len(log.time)) / 20e3
        voltage = np.repeat(option.excitation.voltage(log.time + 1e-9), 2)
        speed = np.interp(sample_times + 25e-6, log.time, log.signals["velocity"])

        def error(scales, voltage=voltage, speed=speed, log=log):
            resistance, inductance, back_emf = scales[:3] * [0.94, 3.6e-4, 0.036]
            decay = math.exp(-resistance / inductance / 20e3)
            current = lfilter(
                [0.0, (1.0 - decay) / resistance], [1.0, -decay], voltage - back_emf * speed
            )
            return (current[::2] - log.signals["current"]) / noise

        solutions.append(least_squares(error, [1.02, 0.9, 0.98]).x)
    expected = [option.errors[name] for name in ("resistance", "inductance", "back_emf_constant")]
    # The standard deviation of 40 draws has a standard error of 11 %.
    np.testing.assert_allclose(np.std(solutions, axis=0), expected, rtol=0.4)


def test_the_written_voltage_is_the_planned_one(planned, tmp_path):
    write_excitation(tmp_path / "excitation.csv", planned.best)
    time, voltage = np.loadtxt(tmp_path / "excitation.csv", delimiter=",", skiprows=1).T
    assert (tmp_path / "excitation.csv").read_text().startswith("time,voltage\n")
    np.testing.assert_allclose(np.diff(time), 1.0 / planned.best.rate, rtol=1e-3)
    inside = time + (0.4 / planned.best.rate if "prbs" in planned.best.excitation.kind else 0.0)
    assert np.corrcoef(voltage, planned.best.excitation.voltage(inside))[0, 1] > 0.999
    assert voltage[-1] == 0.0


def test_a_long_plan_has_distinct_times(planned, tmp_path):
    """In a plan of two hours no two rows have the same time."""
    excitation = dataclasses.replace(planned.best.excitation, kind="square", duration=7200.0)
    write_excitation(
        tmp_path / "long.csv", planned.best._replace(excitation=excitation, rate=100.0)
    )
    time = np.loadtxt(tmp_path / "long.csv", delimiter=",", skiprows=1, usecols=0)
    np.testing.assert_allclose(np.diff(time), 0.01, rtol=1e-6)


def test_a_slow_drive_is_planned_at_its_sample_rate():
    slow = dataclasses.replace(DRIVE, controller=SampledLoop(sample_rate=0.9 * min(RATES)))
    assert {option.rate for option in plan(slow, duration=4.0).options} == {0.9 * min(RATES)}


def test_a_gear_is_planned_as_an_equivalent_motor_without_gear():
    """The errors are the same for a motor without gear and with the values at the output.

    It has n times the constants and the Coulomb friction, and n^2 times the inertia and the viscous
    friction.
    """
    ratio, geared = 20.0, MOTOR
    direct = GearMotor(
        geared.resistance,
        geared.inductance,
        ratio * geared.torque_constant,
        ratio * geared.back_emf_constant,
        ratio**2 * geared.rotor_inertia,
        coulomb_friction=ratio * geared.coulomb_friction,
        viscous_friction=ratio**2 * geared.viscous_friction,
    )
    errors = [
        plan_at_rates(
            1e3, kinds=["prbs"], drive=dataclasses.replace(DRIVE, motor=motor), duration=1.0
        ).best.errors
        for motor in (dataclasses.replace(geared, gear_ratio=ratio), direct)
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.01)
    assert {"inertia", "coulomb_friction"} <= errors[0].keys()


def test_parameters_that_are_zero_on_the_datasheet_are_unknown():
    bare = dataclasses.replace(
        DRIVE, motor=dataclasses.replace(MOTOR, viscous_friction=0.0, coulomb_friction=0.0)
    )
    result = plan_at_rates(2e3, kinds=["prbs"], drive=bare, duration=1.0)
    assert result.unknown == ["coulomb_friction", "viscous_friction"]
    assert not {*result.unknown} & {*result.best.errors}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"duration": 0.5}, "log for longer"),
        ({"max_current": 0.0}, "max_current"),
        ({"continuous_current": -1.0}, "continuous_current"),
    ],
)
def test_invalid_arguments_raise_an_error(arguments, message):
    with pytest.raises(ValueError, match=message):
        plan(DRIVE, LOAD, **arguments)
    with pytest.raises(ValueError, match="together"):
        Sensing(voltage="togethr")
