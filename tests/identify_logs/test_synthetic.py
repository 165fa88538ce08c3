"""Synthetic logs, compared with closed forms and scipy."""

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


def change_motor(**fields):
    """Return the drive with other fields of its motor."""
    return dataclasses.replace(DRIVE, motor=dataclasses.replace(MOTOR, **fields))


@pytest.mark.parametrize("load", [LOAD, Load(1e-3, gravity=0.4), Load(1e-3, against=0.05)])
def test_the_motion_agrees_with_scipy(load):
    drive = change_motor(coulomb_friction=0.0)
    samples = simulate_drive(
        drive, Excitation("chirp", 12.0, 0.5, highest=50.0), load, position=0.3
    )
    motor, ratio = drive.motor, drive.motor.gear_ratio
    inertia = motor.rotor_inertia + load.inertia / ratio**2

    def slope(_, state, voltage):
        current, speed, angle = state
        torque = motor.torque_constant * current - motor.viscous_friction * speed
        outside = (load.gravity * np.sin(angle / ratio) + load.against) / ratio
        voltage_left = voltage - motor.resistance * current - motor.back_emf_constant * speed
        return voltage_left / motor.inductance, (torque - outside) / inertia, speed

    state, states = np.array([0.0, 0.0, 0.3 * ratio]), []
    for row in range(3000):
        states.append(state)
        span, volts = samples.time[row : row + 2], samples.signals["voltage"][row]
        state = solve_ivp(slope, span, state, args=(volts,), rtol=1e-8).y[:, -1]
    expected = np.array(states) / [1.0, ratio, ratio]
    actual = np.column_stack(
        [samples.signals[name][:3000] for name in ("current", "velocity", "position")]
    )
    largest = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(actual / largest, expected / largest, atol=2e-4)


def test_a_locked_winding_is_exact():
    samples = simulate_drive(
        DRIVE, Excitation("square", 6.0, 0.4, frequency=2.0), Load(locked=True)
    )
    half = samples.time < 0.25
    expected = 6.0 / 0.9 * -np.expm1(-samples.time[half] * 0.9 / 4e-4)
    np.testing.assert_allclose(samples.signals["current"][half], expected, rtol=1e-12)
    assert not samples.signals["position"].any()
    # A locked shaft needs no inertia.
    bare = simulate_drive(change_motor(rotor_inertia=0.0), Excitation("locked_prbs", 6.0, 0.1))
    assert not bare.signals["position"].any()


def test_friction_holds_the_shaft_and_slows_it():
    # The torque 0.07/0.9*0.036 is below the Coulomb friction of 3e-3.
    held = simulate_drive(DRIVE, Excitation("square", 0.07, 0.4, frequency=1.0), LOAD)
    assert not held.signals["position"].any()
    samples = simulate_drive(DRIVE, Excitation("square", 6.0, 4.0, frequency=0.1), LOAD)
    # At constant speed kT*i = c + b*omega and u = R*i + kE*omega.
    speed = (6.0 - 0.9 * 3e-3 / 0.036) / (0.036 + 0.9 * 2e-5 / 0.036)
    assert samples.signals["velocity"][-1] * 5.0 == pytest.approx(speed, rel=1e-6)
    assert samples.signals["current"][-1] == pytest.approx((3e-3 + 2e-5 * speed) / 0.036, rel=1e-6)


def test_a_gear_loses_torque_by_its_efficiency():
    drive = change_motor(gear_efficiency=0.8, coulomb_friction=0.0, viscous_friction=0.0)
    samples = simulate_drive(
        drive, Excitation("square", 6.0, 4.0, frequency=0.1), Load(1e-3, against=0.3)
    )
    assert samples.signals["current"][-1] * 0.036 * 5.0 * 0.8 == pytest.approx(0.3, rel=1e-6)


def test_a_supply_sags_by_its_current():
    drive = dataclasses.replace(DRIVE, supply=Supply(24.0, 0.3))
    samples = simulate_drive(
        drive, Excitation("square", 12.0, 0.2, frequency=1.0), Load(locked=True)
    )
    current = samples.signals["current"][-2]
    assert samples.signals["bus"][-2] == pytest.approx(24.0 - 0.3 * 0.5 * current)
    assert current == pytest.approx(0.5 * samples.signals["bus"][-2] / 0.9)


def test_sensors_have_their_noise_gain_bias_delay_and_outliers():
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


def test_samplers_have_jitter_dropped_rows_and_mean_voltages():
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
    samples = simulate_drive(DRIVE, excitation, LOAD)
    # The expected mean is a sum over a fine grid.
    for row in np.flatnonzero(np.diff(log.row_numbers) == 1)[::97]:
        grid = np.linspace(log.time[row], log.time[row + 1], 2001)[:-1]
        expected = samples.signals["command"][np.floor(grid * 20e3 + 1e-6).astype(int)].mean()
        assert log.signals["voltage"][row] == pytest.approx(expected, abs=0.02)


def test_a_seed_makes_logs_reproducible():
    logs = [
        simulate(DRIVE, Excitation(duration=1.0), LOAD, {"current": Sensor(0.1)}, seed=seed)
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(logs[0].signals["current"], logs[1].signals["current"])
    assert np.any(logs[0].signals["current"] != logs[2].signals["current"])


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_excitations_have_their_amplitude_and_duration(kind):
    excitation = Excitation(kind, 3.0, 2.0)
    voltage = excitation.voltage(np.linspace(0.0, 3.0, 3001))
    assert np.abs(voltage).max() == pytest.approx(3.0, rel=0.01)
    assert np.all(voltage[2000:] == 0.0)
    assert abs(np.mean(voltage[:2000])) < 0.3


def test_a_prbs_is_white_up_to_its_clock_rate():
    bits = Excitation("locked_prbs", 1.0, 100.0, clock=0.01).voltage(0.01 * np.arange(8191) + 0.005)
    correlation = np.fft.ifft(np.abs(np.fft.fft(bits)) ** 2).real / 8191
    # A maximum length sequence has this autocorrelation at all other lags.
    np.testing.assert_allclose(correlation[1:], -1.0 / 8191, atol=1e-9)
    assert set(bits) == {-1.0, 1.0}


def test_a_chirp_reaches_its_frequency():
    time = np.linspace(0.0, 2.0, 200_001)
    crossings = time[:-1][
        np.diff(np.sign(Excitation("chirp", 1.0, 2.0, highest=80.0).voltage(time))) != 0.0
    ]
    assert 0.5 / np.diff(crossings)[-2] == pytest.approx(80.0, rel=0.02)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: Excitation("prbz"), "did you mean prbs"),
        (lambda: Excitation("prbs", 0.0), "amplitude"),
        (
            lambda: simulate_drive(change_motor(rotor_inertia=0.0), Excitation()),
            "one must be > 0.*load its inertia",
        ),
        (
            lambda: simulate(DRIVE, Excitation(), LOAD, {"currant": Sensor()}),
            "did you mean current",
        ),
    ],
)
def test_invalid_excitations_shafts_and_sensors_raise_an_error(act, message):
    with pytest.raises(ValueError, match=message):
        act()


def test_a_warm_motor_has_a_higher_resistance():
    """At 35 K above the datasheet's 25 degC copper has 13.8 % more resistance."""
    warm = DRIVE.replaced({"motor.ambient_temperature": 60.0})
    current = simulate_drive(warm, np.full(20001, 2.0), Load(locked=True)).signals["current"][-1]
    assert current == pytest.approx(
        2.0 / (DRIVE.motor.resistance * (1.0 + 0.00393 * 35.0)), rel=1e-6
    )
