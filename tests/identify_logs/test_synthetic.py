"""Computed logs, against closed forms and scipy."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply
from codrl_mj.identify.synthetic import (
    EXCITATIONS,
    Excitation,
    Load,
    Sampler,
    Sensor,
    simulate,
    simulate_drive,
)

MOTOR = GearMotor(
    0.9, 4e-4, 0.036, 0.036, 1.35e-5, gear_ratio=5.0, coulomb_friction=3e-3, viscous_friction=2e-5
)
DRIVE = Drive(MOTOR, SampledLoop(), Supply(24.0))
LOAD = Load(inertia=1e-3)


def changed(**fields):
    return dataclasses.replace(DRIVE, motor=dataclasses.replace(MOTOR, **fields))


@pytest.mark.parametrize("load", [LOAD, Load(1e-3, gravity=0.4), Load(1e-3, against=0.05)])
def test_motion_is_what_scipy_integrates(load):
    drive = changed(coulomb_friction=0.0)
    course = simulate_drive(drive, Excitation("chirp", 12.0, 0.5, highest=50.0), load, position=0.3)
    motor, ratio = drive.motor, drive.motor.gear_ratio
    inertia = motor.rotor_inertia + load.inertia / ratio**2

    def slope(_, state, voltage):
        current, speed, angle = state
        torque = motor.torque_constant * current - motor.viscous_friction * speed
        outside = (load.gravity * np.sin(angle / ratio) + load.against) / ratio
        voltage_left = voltage - motor.resistance * current - motor.back_emf_constant * speed
        return voltage_left / motor.inductance, (torque - outside) / inertia, speed

    state, found = np.array([0.0, 0.0, 0.3 * ratio]), []
    for row in range(3000):
        found.append(state)
        span, volts = course.time[row : row + 2], course.signals["voltage"][row]
        state = solve_ivp(slope, span, state, args=(volts,), rtol=1e-8).y[:, -1]
    expected = np.array(found) / [1.0, ratio, ratio]
    actual = np.column_stack(
        [course.signals[name][:3000] for name in ("current", "velocity", "position")]
    )
    largest = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(actual / largest, expected / largest, atol=2e-4)


def test_a_locked_winding_is_exact():
    course = simulate_drive(DRIVE, Excitation("square", 6.0, 0.4, frequency=2.0), Load(locked=True))
    half = course.time < 0.25
    expected = 6.0 / 0.9 * -np.expm1(-course.time[half] * 0.9 / 4e-4)
    np.testing.assert_allclose(course.signals["current"][half], expected, rtol=1e-12)
    assert not course.signals["position"].any()
    bare = simulate_drive(
        changed(rotor_inertia=0.0), Excitation("locked_prbs", 6.0, 0.1)
    )  # which needs no inertia
    assert not bare.signals["position"].any()


def test_friction_holds_slows_and_heats_what_it_has_to():
    held = simulate_drive(DRIVE, Excitation("square", 0.07, 0.4, frequency=1.0), LOAD)  # 0.07/0.9*0.036 < 3e-3
    assert not held.signals["position"].any()
    course = simulate_drive(DRIVE, Excitation("square", 6.0, 4.0, frequency=0.1), LOAD)
    # steady: kT*i = c + b*omega and u = R*i + kE*omega
    speed = (6.0 - 0.9 * 3e-3 / 0.036) / (0.036 + 0.9 * 2e-5 / 0.036)
    assert course.signals["velocity"][-1] * 5.0 == pytest.approx(speed, rel=1e-6)
    assert course.signals["current"][-1] == pytest.approx((3e-3 + 2e-5 * speed) / 0.036, rel=1e-6)


def test_a_gear_loses_its_share():
    drive = changed(gear_efficiency=0.8, coulomb_friction=0.0, viscous_friction=0.0)
    course = simulate_drive(drive, Excitation("square", 6.0, 4.0, frequency=0.1), Load(1e-3, against=0.3))
    assert course.signals["current"][-1] * 0.036 * 5.0 * 0.8 == pytest.approx(0.3, rel=1e-6)


def test_a_supply_sags_by_what_it_gives():
    drive = dataclasses.replace(DRIVE, supply=Supply(24.0, 0.3))
    course = simulate_drive(drive, Excitation("square", 12.0, 0.2, frequency=1.0), Load(locked=True))
    current = course.signals["current"][-2]
    assert course.signals["bus"][-2] == pytest.approx(24.0 - 0.3 * 0.5 * current)
    assert current == pytest.approx(0.5 * course.signals["bus"][-2] / 0.9)


def test_sensors_show_what_they_are_told():
    excitation = Excitation("slow_sine", 12.0, 2.0)
    plain = simulate(DRIVE, excitation, LOAD)
    sensors = {
        "current": Sensor(noise=0.05, gain=-1.05, bias=0.2),
        "position": Sensor(resolution=0.01),
        "velocity": Sensor(delay=0.02),
        "torque": Sensor(outliers=0.02),
    }
    log = simulate(DRIVE, excitation, LOAD, sensors, seed=3)
    error = log.signals["current"] - (0.2 - 1.05 * plain.signals["current"])
    assert np.std(error) == pytest.approx(0.05, rel=0.03)
    assert abs(np.mean(error)) < 0.002
    assert log.resolution["position"] == pytest.approx(0.01)
    assert np.abs(log.signals["position"] - plain.signals["position"]).max() <= 0.005 + 1e-12
    np.testing.assert_allclose(
        log.signals["velocity"][100:], plain.signals["velocity"][:-100], atol=1e-7
    )
    off = np.abs(log.signals["torque"] - plain.signals["torque"])
    assert np.mean(off > 0.0) == pytest.approx(0.02, abs=0.006)
    assert off[off > 0.0].min() > 2.9 * np.std(plain.signals["torque"])


def test_samplers_jitter_drop_and_average():
    excitation = Excitation("prbs", 12.0, 2.0, clock=1.7e-3)
    log = simulate(
        DRIVE,
        excitation,
        LOAD,
        None,
        Sampler(1000.0, jitter=0.1, dropped=0.05, mean_voltage=True),
        seed=1,
    )
    assert 2001 - len(log.time) == pytest.approx(100, abs=40)
    whole = np.diff(log.time)[np.diff(log.row_numbers) == 1]
    assert np.std(whole) == pytest.approx(0.1e-3 * np.sqrt(2.0), rel=0.1)
    course = simulate_drive(DRIVE, excitation, LOAD)
    for row in np.flatnonzero(np.diff(log.row_numbers) == 1)[
        ::97
    ]:  # the mean, by sums over a fine grid
        fine = np.linspace(log.time[row], log.time[row + 1], 2001)[:-1]
        expected = course.signals["command"][np.floor(fine * 20e3 + 1e-6).astype(int)].mean()
        assert log.signals["voltage"][row] == pytest.approx(expected, abs=0.02)


def test_a_seed_repeats_and_another_differs():
    made = [
        simulate(DRIVE, Excitation(duration=1.0), LOAD, {"current": Sensor(0.1)}, seed=seed)
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(made[0].signals["current"], made[1].signals["current"])
    assert np.any(made[0].signals["current"] != made[2].signals["current"])


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_excitations_keep_to_their_amplitude_and_end(kind):
    excitation = Excitation(kind, 3.0, 2.0)
    voltage = excitation.voltage(np.linspace(0.0, 3.0, 3001))
    assert np.abs(voltage).max() == pytest.approx(3.0, rel=0.01)
    assert np.all(voltage[2000:] == 0.0)
    assert abs(np.mean(voltage[:2000])) < 0.3


def test_a_prbs_is_white_up_to_its_clock():
    bits = Excitation("locked_prbs", 1.0, 100.0, clock=0.01).voltage(0.01 * np.arange(8191) + 0.005)
    correlation = np.fft.ifft(np.abs(np.fft.fft(bits)) ** 2).real / 8191
    np.testing.assert_allclose(
        correlation[1:], -1.0 / 8191, atol=1e-9
    )  # of a maximum length sequence
    assert set(bits) == {-1.0, 1.0}


def test_a_chirp_reaches_its_frequency():
    time = np.linspace(0.0, 2.0, 200_001)
    crossings = time[:-1][
        np.diff(np.sign(Excitation("chirp", 1.0, 2.0, highest=80.0).voltage(time))) != 0.0
    ]
    assert 0.5 / np.diff(crossings)[-2] == pytest.approx(80.0, rel=0.02)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda: Excitation("prbz"), "did you mean prbs"),
        (lambda: Excitation("prbs", 0.0), "amplitude"),
        (
            lambda: simulate_drive(changed(rotor_inertia=0.0), Excitation()),
            "one must be > 0.*load its inertia",
        ),
        (
            lambda: simulate(DRIVE, Excitation(), LOAD, {"currant": Sensor()}),
            "did you mean current",
        ),
    ],
)
def test_bad_excitations_shafts_and_sensors_are_refused(act, says):
    with pytest.raises(ValueError, match=says):
        act()


def test_a_motor_that_is_warm_from_the_start_has_the_resistance_of_that():
    """35 K above the 25 degC of datasheets copper has 13.8 % more: a held shaft takes V/R as long as it is held."""
    warm = DRIVE.replaced({"motor.ambient_temperature": 60.0})
    current = simulate_drive(warm, np.full(20001, 2.0), Load(locked=True)).signals["current"][-1]
    assert current == pytest.approx(
        2.0 / (DRIVE.motor.resistance * (1.0 + 0.00393 * 35.0)), rel=1e-6
    )
