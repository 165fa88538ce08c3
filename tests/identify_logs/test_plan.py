"""What a plan expects is what comes out, and what it writes is what it planned."""

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


def at_rates(*rates, kinds=EXCITATIONS, **arguments):
    """A plan of which only some rates [Hz] and excitations are tried."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plans, "RATES", rates)
        patched.setattr(plans, "EXCITATIONS", kinds)
        return plan(arguments.pop("drive", DRIVE), LOAD, **arguments)


@pytest.fixture(scope="module")
def planned():
    return at_rates(*RATES[:4], duration=2.0, max_current=4.0)


def of(found, kind, rate):
    return next(one for one in found.options if (one.excitation.kind, one.rate) == (kind, rate))


def test_the_best_reaches_its_goals_with_the_margin_at_the_lowest_rate(planned):
    best = planned.best
    assert planned.missed == planned.unknown == []
    assert set(best.errors) == set(GOALS)
    assert all(best.errors[name] <= goal / MARGIN for name, goal in GOALS.items())
    assert not [
        one for one in planned.options if one.rate < best.rate and one.worst <= 1.0 / MARGIN
    ]


def test_currents_stay_within_their_limits(planned):
    assert max(one.peak_current for one in planned.options) <= 4.0
    warm = at_rates(1e3, duration=1.0, continuous_current=1.0)
    assert max(one.rms_current for one in warm.options) <= 1.0


def test_what_a_slow_sine_and_a_held_shaft_do_not_show(planned):
    assert of(planned, "slow_sine", 1000.0).errors.get("inductance", math.inf) > 0.5
    assert set(of(planned, "locked_prbs", 5000.0).errors) == {"resistance", "inductance"}
    square, prbs = of(planned, "square", 1000.0).errors, of(planned, "prbs", 1000.0).errors
    assert prbs["inductance"] < 0.3 * square["inductance"]


def test_voltages_that_change_between_rows_cost_most_of_the_inductance():
    errors = {
        how: (
            at_rates(
                5e3, kinds=["locked_prbs"], sensing=Sensing(voltage=how), duration=1.0
            ).best.errors["inductance"]
        )
        for how in ("together", "mean", "instantaneous")
    }
    assert 10.0 * errors["together"] < errors["mean"] < errors["instantaneous"]


@pytest.mark.matrix
def test_errors_expected_are_those_of_fits(planned):
    """Least squares by scipy on logs that differ in their noise: R, L and kE."""
    option = of(planned, "chirp", 10e3)
    noise = 0.01 * option.peak_current
    found = []
    for seed in range(40):
        sensors = {"current": Sensor(noise)}
        log = simulate(DRIVE, option.excitation, LOAD, sensors, Sampler(option.rate), seed)
        # two of the drive's samples from row to row, the speed in the middle of each
        fine = np.arange(2 * len(log.time)) / 20e3
        voltage = np.repeat(option.excitation.voltage(log.time + 1e-9), 2)
        speed = np.interp(fine + 25e-6, log.time, log.signals["velocity"])

        def error(scales, voltage=voltage, speed=speed, log=log):
            resistance, inductance, back_emf = scales[:3] * [0.94, 3.6e-4, 0.036]
            decay = math.exp(-resistance / inductance / 20e3)
            current = lfilter(
                [0.0, (1.0 - decay) / resistance], [1.0, -decay], voltage - back_emf * speed
            )
            return (current[::2] - log.signals["current"]) / noise

        found.append(least_squares(error, [1.02, 0.9, 0.98]).x)
    expected = [option.errors[name] for name in ("resistance", "inductance", "back_emf_constant")]
    np.testing.assert_allclose(np.std(found, axis=0), expected, rtol=0.4)  # of 40 draws: 11 % each


def test_what_is_written_is_what_was_planned(planned, tmp_path):
    write_excitation(tmp_path / "excitation.csv", planned.best)
    time, voltage = np.loadtxt(tmp_path / "excitation.csv", delimiter=",", skiprows=1).T
    assert (tmp_path / "excitation.csv").read_text().startswith("time,voltage\n")
    np.testing.assert_allclose(np.diff(time), 1.0 / planned.best.rate, rtol=1e-3)
    inside = time + (0.4 / planned.best.rate if "prbs" in planned.best.excitation.kind else 0.0)
    assert np.corrcoef(voltage, planned.best.excitation.voltage(inside))[0, 1] > 0.999
    assert voltage[-1] == 0.0


def test_a_long_plan_is_written_row_by_row(planned, tmp_path):
    """Hours of it: no two rows have the same time."""
    excitation = dataclasses.replace(planned.best.excitation, kind="square", duration=7200.0)
    write_excitation(
        tmp_path / "long.csv", planned.best._replace(excitation=excitation, rate=100.0)
    )
    time = np.loadtxt(tmp_path / "long.csv", delimiter=",", skiprows=1, usecols=0)
    np.testing.assert_allclose(np.diff(time), 0.01, rtol=1e-6)


def test_a_drive_of_few_samples_is_planned_at_its_rate():
    slow = dataclasses.replace(DRIVE, controller=SampledLoop(sample_rate=0.9 * min(RATES)))
    assert {one.rate for one in plan(slow, duration=4.0).options} == {0.9 * min(RATES)}


def test_a_gear_is_planned_as_the_motor_that_it_is_at_its_output():
    """A motor of n times the constants, n^2 the inertia and viscous, and n the Coulomb friction tells as much."""
    ratio, one = 20.0, MOTOR
    direct = GearMotor(
        one.resistance, one.inductance, ratio * one.torque_constant, ratio * one.back_emf_constant,
        ratio**2 * one.rotor_inertia, coulomb_friction=ratio * one.coulomb_friction,
        viscous_friction=ratio**2 * one.viscous_friction,
    )  # fmt: skip
    errors = [
        at_rates(
            1e3, kinds=["prbs"], drive=dataclasses.replace(DRIVE, motor=motor), duration=1.0
        ).best.errors
        for motor in (dataclasses.replace(one, gear_ratio=ratio), direct)
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.01)
    assert {"inertia", "coulomb_friction"} <= errors[0].keys()


def test_what_the_datasheet_leaves_at_zero_is_named():
    bare = dataclasses.replace(
        DRIVE, motor=dataclasses.replace(MOTOR, viscous_friction=0.0, coulomb_friction=0.0)
    )
    found = at_rates(2e3, kinds=["prbs"], drive=bare, duration=1.0)
    assert found.unknown == ["coulomb_friction", "viscous_friction"]
    assert not {*found.unknown} & {*found.best.errors}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"duration": 0.5}, "log for longer"),
        ({"max_current": 0.0}, "max_current"),
        ({"continuous_current": -1.0}, "continuous_current"),
    ],
)
def test_bad_plans_are_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        plan(DRIVE, LOAD, **arguments)
    with pytest.raises(ValueError, match="together"):
        Sensing(voltage="togethr")
