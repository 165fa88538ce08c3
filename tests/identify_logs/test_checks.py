"""Checks of logs: each fault is found at its row, and a log without faults has no findings."""

import dataclasses
import functools
import math
import re

import numpy as np
import pytest

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply
from codrl_mj.identify import identify
from codrl_mj.identify.checks import FACTORS, check, explain_factor
from codrl_mj.identify.log import Log
from codrl_mj.identify.simulation import ShaftParameters, simulate_shaft
from codrl_mj.identify.synthetic import Excitation, Load, Sampler, Sensor, simulate, simulate_drive
from tests.identify.draws import scale_signals
from tests.matrix import matrix_params

MOTORS = {
    "small": GearMotor(
        0.94, 3.6e-4, 0.036, 0.036, 1.35e-5, coulomb_friction=5e-3, viscous_friction=1e-6
    ),
    "geared": GearMotor(2.2, 1.3e-3, 0.014, 0.014, 2e-6, gear_ratio=30.0, coulomb_friction=1e-3),
    "fast": GearMotor(
        8.4, 1.16e-3, 0.042, 0.042, 4e-6, coulomb_friction=1e-3, viscous_friction=3e-6
    ),
}
RATE = 5000.0
STEP = 2.0 * math.pi / 4096


def make_drive(motor, sag=0.0):
    return Drive(MOTORS[motor], SampledLoop(), Supply(12.0, sag * MOTORS[motor].resistance))


def make_excitation(motor, kind):
    clock = 4.0 * MOTORS[motor].electrical_time_constant
    return Excitation(
        kind, 6.0, 1.0, frequency=2.0 if kind == "square" else 1.0, highest=150.0, clock=clock
    )


@functools.cache
def make_log(motor="small", kind="prbs", sag=0.0, jitter=0.0, dropped=0.0, seed=0, changes=()):
    """Return a log with noise, quantization and changes of sensors (signal, field, value)."""
    parameters, drive = MOTORS[motor], make_drive(motor, sag)
    load = Load(3.0 * parameters.rotor_inertia * parameters.gear_ratio**2 + 1e-4)
    course = simulate_drive(drive, make_excitation(motor, kind), load)
    peak, fastest = (
        np.abs(course.signals["current"]).max(),
        np.abs(course.signals["velocity"]).max(),
    )
    sensors = {
        "current": Sensor(0.01 * peak),
        "torque": Sensor(0.01 * peak * parameters.torque_constant * parameters.gear_ratio),
        "velocity": Sensor(0.01 * fastest),
        "position": Sensor(resolution=STEP),
    }
    for signal, field, value in changes:
        sensors[signal] = dataclasses.replace(sensors.get(signal, Sensor()), **{field: value})
    sampler = Sampler(RATE, jitter, dropped, mean_voltage=True)
    return simulate(drive, make_excitation(motor, kind), load, sensors, sampler, seed)


def remove_signals(log, *names):
    """Return a log without some signals."""
    return dataclasses.replace(
        log, signals={name: values for name, values in log.signals.items() if name not in names}
    )


def replace_signals(log, **signals):
    """Return a log with other values of some signals."""
    return dataclasses.replace(log, signals={**log.signals, **signals})


# The cache holds the log itself, too: otherwise another log may get its identity.
CHECKED = {}
"""Identity of a log and a motor -> the log and its findings."""


def findings_of(log, kind, motor=None):
    """Return the findings of a kind of check."""
    if (id(log), motor) not in CHECKED:
        CHECKED[id(log), motor] = log, check(log, motor)
    return [finding for finding in CHECKED[id(log), motor][1] if finding.check == kind]


CLEAN = [(motor, kind) for motor in MOTORS for kind in ("slow_sine", "square", "chirp", "prbs")]


@pytest.mark.parametrize(("motor", "kind"), matrix_params([CLEAN[0], CLEAN[3], CLEAN[7]], CLEAN))
def test_a_log_without_faults_has_no_findings(motor, kind):
    findings = check(make_log(motor, kind), MOTORS[motor])
    assert [finding for finding in findings if finding.severity != "info"] == []
    assert {finding.check for finding in findings} <= {"excitation"}


SIGNS = {
    "current": lambda log: remove_signals(scale_signals(log, current=-1.0), "torque"),
    "voltage": lambda log: remove_signals(scale_signals(log, voltage=-1.0), "torque"),
    "position": lambda log: scale_signals(log, position=-1.0),
    "motion": lambda log: scale_signals(log, position=-1.0, velocity=-1.0),
    "torque": lambda log: scale_signals(log, torque=-1.0),
    "torque alone": lambda log: remove_signals(
        scale_signals(log, torque=-1.0), "voltage", "current"
    ),
}
UNITS = {
    "position in degrees": lambda log: scale_signals(log, position=180.0 / math.pi),
    "position in degrees, alone": lambda log: remove_signals(
        scale_signals(log, position=180.0 / math.pi), "velocity"
    ),
    "motion in degrees": lambda log: scale_signals(
        log, position=180.0 / math.pi, velocity=180.0 / math.pi
    ),
    "velocity in rpm": lambda log: scale_signals(log, velocity=30.0 / math.pi),
    "velocity in rpm, alone": lambda log: remove_signals(
        scale_signals(log, velocity=30.0 / math.pi), "position"
    ),
    "current in mA": lambda log: scale_signals(log, current=1000.0),
    "torque in mN*m": lambda log: scale_signals(log, torque=1000.0),
    "duty for voltage": lambda log: replace_signals(log, voltage=log.signals["duty"]),
    "time in ms": lambda log: dataclasses.replace(
        log, time=1000.0 * log.time + 0.3 * np.arange(len(log.time))
    ),
}


@pytest.mark.parametrize(("motor", "kind"), matrix_params([CLEAN[3]], CLEAN))
def test_wrong_signs_and_units_are_found_with_every_excitation(motor, kind):
    log = make_log(motor, kind)
    for name, make in SIGNS.items():
        signs = findings_of(make(log), "sign")
        assert {finding.severity for finding in signs} == {"error"}, name
        assert "minus" in signs[0].remedy
    assert [name for name, make in UNITS.items() if not findings_of(make(log), "unit")] == []


def pendulum_log(amplitude=6.0, **sensors):
    """Return a log of a slow pendulum."""
    excitation = Excitation("slow_sine", amplitude, 4.0)
    return simulate(
        make_drive("geared"), excitation, Load(2e-2, gravity=0.8), sensors, Sampler(500.0)
    )


@pytest.mark.parametrize("amplitude", [6.0, 2.0])
@pytest.mark.parametrize("signal", ["torque", "current"])
def test_gravity_shows_degrees_instead_of_radians(amplitude, signal):
    clean = remove_signals(
        pendulum_log(amplitude), "velocity", *{"torque", "current", "voltage"} - {signal}
    )
    (finding,) = findings_of(scale_signals(clean, position=180.0 / math.pi), "unit")
    assert (finding.severity, "gravity" in finding.message, finding.remedy) == (
        "error",
        True,
        "write position=column:deg",
    )
    assert findings_of(clean, "unit") == []


def test_the_encoder_step_shows_degrees_instead_of_radians():
    encoder = remove_signals(make_log(), "torque", "velocity")
    (finding,) = findings_of(scale_signals(encoder, position=180.0 / math.pi), "unit")
    assert (finding.severity, "1/4096 of 360" in finding.message) == ("error", True)
    rounded = replace_signals(encoder, position=np.round(encoder.signals["position"], 2))
    rounded = dataclasses.replace(rounded, resolution={**rounded.resolution, "position": 0.01})
    # A file may round radians to decimals, too.
    assert [finding.severity for finding in findings_of(rounded, "unit")] == ["warning"]


@pytest.mark.parametrize(
    ("make", "message", "severity"),
    [
        (
            lambda log: scale_signals(log, current=1000.0, voltage=3.0),
            "the resistance would be 0.00",
            "error",
        ),
        (lambda log: scale_signals(log, current=1000.0), "the current is up to ", "error"),
        (lambda log: scale_signals(log, voltage=1000.0), "the voltage is up to ", "error"),
        (lambda log: scale_signals(log, current=1e-5), "outside 0.005 to 1e4 ohm", "error"),
        (lambda log: scale_signals(log, voltage=1 / 12.0), "is it a duty?", "warning"),
    ],
)
def test_implausible_values_are_found_without_a_datasheet(make, message, severity):
    clean = remove_signals(make_log(), "torque", "bus")
    matching = [
        finding for finding in findings_of(make(clean), "unit") if message in finding.message
    ]
    assert [finding.severity for finding in matching] == [severity]
    assert findings_of(clean, "unit") == []


def test_a_wrong_unit_of_the_current_is_found_with_a_datasheet():
    log = remove_signals(scale_signals(make_log(), current=100.0), "torque")
    assert findings_of(log, "unit") == []
    assert "hundredths" in findings_of(log, "unit", MOTORS["small"])[0].message


@pytest.mark.parametrize(
    ("ratio", "name"),
    [
        *((1.02 * factor, name) for name, factor in FACTORS.items()),
        *((-0.98 / factor, name) for name, factor in FACTORS.items()),
        # The first ratio is near two factors, the second near none.
        (9.8, "rpm for rad/s (9.549) or kgf*cm for N*m (10.2) or a wrong scale"),
        (4.3, "gear"),
    ],
)
def test_factors_are_explained(ratio, name):
    assert name in explain_factor(ratio)
    # A resistance does not depend on the unit of an angle.
    assert "rpm" not in explain_factor(9.43, angle=False)


@pytest.mark.parametrize(
    ("kind", "signal", "delay", "expected", "tolerance"),
    [
        *(
            (kind, "current", rows / RATE, rows, 0.3)
            for kind in ("chirp", "prbs")
            for rows in (1.0, 2.0, 3.5)
        ),
        *(("slow_sine", "velocity", seconds, 1e3 * seconds, 0.2) for seconds in (0.003, 0.02)),
    ],
)
def test_a_delayed_signal_is_found(kind, signal, delay, expected, tolerance):
    """The message has the lag of a current in rows, and that of a velocity in milliseconds."""
    (finding,) = findings_of(make_log(kind=kind, changes=((signal, "delay", delay),)), "lag")
    assert finding.severity == "warning"
    assert float(finding.message.split()[3]) == pytest.approx(expected, abs=tolerance)
    assert (" after " in finding.message) or signal == "velocity"


def test_an_instantaneous_voltage_declared_as_mean_is_found():
    log, excitation = make_log(), make_excitation("small", "prbs")
    assert findings_of(log, "voltage") == []
    at_rows = replace_signals(log, voltage=excitation.voltage(log.time))
    (finding,) = findings_of(at_rows, "voltage")
    assert (finding.severity, "half a row" in finding.message) == ("warning", True)
    (finding,) = findings_of(dataclasses.replace(at_rows, mean_voltage=False), "voltage")
    assert finding.severity == "info"


def test_a_duty_in_percent_is_found():
    log = remove_signals(make_log(), "torque", "bus")
    assert findings_of(log, "unit") == []
    (finding,) = findings_of(scale_signals(log, duty=100.0), "unit")
    assert (finding.severity, finding.remedy) == (
        "error",
        "correct its unit, such as duty=column:percent",
    )
    (finding,) = findings_of(
        remove_signals(scale_signals(log, voltage=100.0), "duty", "current"), "unit"
    )
    assert (finding.severity, "a duty in percent" in finding.message) == ("warning", True)


@pytest.mark.parametrize("signals", [("current",), ("velocity",), ("position",)])
def test_a_supply_mapped_as_the_motor_voltage_is_found(signals):
    log = remove_signals(make_log(kind="slow_sine"), *{*make_log().signals} - {*signals, "voltage"})
    assert "error" not in {finding.severity for finding in findings_of(log, "voltage")}
    supply = 24.0 + 0.05 * np.sin(log.time)
    (finding,) = [
        each
        for each in findings_of(replace_signals(log, voltage=supply), "voltage")
        if each.severity == "error"
    ]
    assert finding.remedy.startswith("write bus=column:V")
    held = replace_signals(
        log, voltage=supply, **{name: np.cumsum(np.abs(log.signals[name])) for name in signals}
    )
    # A constant voltage may drive a motor that turns one way.
    assert "error" not in {finding.severity for finding in findings_of(held, "voltage")}


def test_rows_that_repeat_old_values_are_found():
    """A position sampled at 500 Hz in rows of 5 kHz is found; a coarse encoder is no fault."""
    log = make_log(kind="slow_sine")
    (finding,) = findings_of(
        replace_signals(log, position=np.repeat(log.signals["position"][::10], 10)[:-9]), "repeated"
    )
    assert (finding.severity, "every 10th row" in finding.message) == ("warning", True)
    coarse = make_log(kind="slow_sine", changes=(("position", "resolution", 0.05),))
    assert findings_of(coarse, "repeated") == findings_of(log, "repeated") == []


@pytest.mark.parametrize(
    "signals", [("velocity",), ("position", "velocity"), ("voltage",), ("position", "voltage")]
)
@pytest.mark.parametrize("stride", [1, 300])
def test_the_check_reports_the_reason_why_a_fit_is_refused(signals, stride):
    """`check` and `identify` refuse rows over 50 ms apart and too few signals in the same words."""
    log = make_log(kind="slow_sine")
    part = Log(
        "part", 10.0 * log.time[::stride], {name: log.signals[name][::stride] for name in signals}
    )
    findings = [finding for finding in check(part) if finding.check in ("signals", "rows")]
    assert bool(findings) == (signals != ("position", "voltage") or stride == 300)
    if findings:
        with pytest.raises(
            ValueError, match=re.escape(f"{findings[0].message}; {findings[0].remedy}")
        ):
            identify([part], "free", {"load_inertia": 0.0})


def test_gaps_dropped_rows_and_jitter_are_found():
    log = make_log(dropped=0.05, jitter=0.1)
    rows = np.flatnonzero(np.diff(log.row_numbers) > 1) + 1
    (dropped,) = findings_of(log, "dropped rows")
    assert dropped.row == log.row_numbers[rows[0]]
    missing = int(log.row_numbers[-1] - len(log.time))
    assert dropped.message.startswith(f"{missing} rows missing")
    assert findings_of(log, "jitter")
    whole, keep = make_log(), np.r_[0:1000, 3000:5001]
    remaining = {name: values[keep] for name, values in whole.signals.items()}
    gap = dataclasses.replace(whole, time=whole.time[keep], signals=remaining, rows=keep + 1)
    assert [finding.row for finding in findings_of(gap, "gap")] == [3001]
    assert (
        findings_of(whole, "jitter")
        == findings_of(whole, "gap")
        == findings_of(whole, "dropped rows")
        == []
    )


@pytest.mark.parametrize("kind", ["slow_sine", "prbs"])
def test_outliers_are_found_at_their_rows(kind):
    clean = make_log(kind=kind)
    spoiled = clean.signals["current"].copy()
    rows = np.arange(333, 5_000, 250)
    spoiled[rows] += 5.0 * np.std(spoiled) * np.where(rows % 2, 1.0, -1.0)
    (finding,) = findings_of(replace_signals(clean, current=spoiled), "outliers")
    listed = [int(word) for word in finding.message.partition("(")[2].rstrip(")").split(",")]
    assert finding.row == listed[0]
    # The row before an outlier may differ from both of its neighbors, too.
    assert set(listed) <= {*rows, *(rows + 1)}
    assert finding.severity == "info"
    assert findings_of(clean, "outliers") == []


def test_a_clipped_current_is_found():
    current = make_log().signals["current"]
    limit = 0.6 * np.abs(current).max()
    clipped = findings_of(
        replace_signals(make_log(), current=np.clip(current, -limit, limit)), "saturation"
    )
    assert {finding.row for finding in clipped} == {
        1 + int(np.argmax(side >= limit)) for side in (current, -current)
    }


def test_coarse_sensors_are_found():
    coarse = make_log(changes=(("position", "resolution", 1.0), ("current", "resolution", 2.0)))
    assert {finding.message.split()[0] for finding in findings_of(coarse, "resolution")} == {
        "current",
        "position",
    }
    assert findings_of(make_log(), "resolution") == []


@pytest.mark.parametrize("motor", MOTORS)
def test_a_sagging_supply_is_found_if_the_duty_varies(motor):
    (finding,) = findings_of(make_log(motor, "chirp", sag=0.25), "sag")
    # At half of the duty, d^2 = 0.25 of the supply's 0.25 R acts at the motor.
    assert float(finding.message.split()[8]) == pytest.approx(
        0.0625 * MOTORS[motor].resistance, rel=0.3
    )
    assert findings_of(make_log(motor, "chirp"), "sag") == []


def test_a_wrapped_position_and_too_much_voltage_are_found():
    log = make_log(kind="slow_sine")
    wrapped = findings_of(
        replace_signals(log, position=log.signals["position"] % (2.0 * math.pi)), "wrapped"
    )
    turns = np.flatnonzero(np.diff(np.floor(log.signals["position"] / (2.0 * math.pi))) != 0.0)
    assert [finding.row for finding in wrapped] == [turns[0] + 2]
    assert (
        "times that of the supply"
        in findings_of(replace_signals(log, bus=0.4 * log.signals["bus"]), "unit")[0].message
    )


def test_gravity_shows_an_offset_of_the_position():
    log = remove_signals(pendulum_log(position=Sensor(resolution=STEP)), "voltage", "current")
    assert findings_of(log, "sign") == findings_of(log, "zero") == []
    turned = replace_signals(log, position=log.signals["position"] + math.pi)
    assert "at the top" in findings_of(turned, "zero")[0].message
    (tilted,) = findings_of(replace_signals(log, position=log.signals["position"] + 0.1), "zero")
    assert float(
        tilted.remedy.removeprefix("write position=column").partition(":")[0]
    ) == pytest.approx(-0.1, abs=0.02)


def test_a_torque_that_does_not_explain_the_motion_is_found():
    log = remove_signals(make_log("geared", "square"), "voltage", "current")
    assert findings_of(log, "torque") == []
    disturbance = np.random.default_rng(0).standard_normal(20)[np.arange(len(log.time)) // 251]
    assert findings_of(
        replace_signals(log, torque=log.signals["torque"] + 0.3 * disturbance), "torque"
    )


BALANCED = {
    "below resonance": ((0.08, 2.3, 0.0, 0.39), lambda t: np.sin(np.pi * t), ["velocity"]),
    "with friction": ((0.02, 1.3, 0.05, 0.2), lambda t: 0.5 * np.sin(np.pi * t), ["velocity"]),
    "jerked": ((1e-3, 0.9, 0.2, 0.18), lambda t: np.where(t % 1.0 < 0.5, 1.0, -1.0), ["velocity"]),
    "held nearly still": ((4e-4, 13.0, 0.03, 2e-3), lambda t: 0.25 * t, ["position", "velocity"]),
    "held by a step": (
        (6e-4, 14.0, 0.3, 0.09),
        lambda t: np.ones(len(t)),
        ["position", "velocity"],
    ),
}
"""Name -> (J, m*g*l, Coulomb and viscous friction), torque as a function of time, other signals."""


def balanced_log(name, seed=0):
    """Return a log of a pendulum whose torque balances mostly friction and gravity."""
    (inertia, mgl, coulomb, viscous), torque, signals = BALANCED[name]
    time, random = np.arange(0.0, 4.0, 1e-3), np.random.default_rng(seed)
    shaft = ShaftParameters(inertia, mgl, 0.0, coulomb, viscous, 1.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0)
    position, velocity = simulate_shaft(time, torque(time), 0.0 * time, 0.0, 0.0, shaft)
    noisy = {
        "position": STEP * np.round(position / STEP),
        "velocity": velocity + 0.02 * random.standard_normal(4000),
    }
    measured = torque(time) + 0.005 * random.standard_normal(4000)
    return Log(
        name,
        time,
        {"torque": measured, **{signal: noisy[signal] for signal in signals}},
        {"position": STEP},
    )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", BALANCED)
def test_a_pendulum_that_hardly_accelerates_has_no_error_of_sign_or_unit(name, seed):
    assert [
        finding for finding in check(balanced_log(name, seed)) if finding.severity == "error"
    ] == []


def test_a_free_rig_shows_a_wrong_sign_that_gravity_could_explain():
    """A free rotor under a sine with the wrong sign moves like a pendulum."""
    log = remove_signals(make_log(kind="slow_sine"), "voltage", "current", "velocity")
    (finding,) = [
        each for each in check(scale_signals(log, torque=-1.0), rig="free") if each.check == "sign"
    ]
    assert "with a minus" in finding.message
    assert "zero" not in {
        each.check
        for each in check(replace_signals(log, position=log.signals["position"] + 1.0), rig="free")
    }


def test_a_motor_that_holds_a_pendulum_has_no_error_of_unit():
    motor = GearMotor(
        0.17, 1e-4, 0.09, 0.09, 6e-5, gear_ratio=6.0, coulomb_friction=0.02, viscous_friction=1e-4
    )
    drive = Drive(motor, SampledLoop(), Supply(24.0))
    volts = np.where(np.arange(1, 20 * 4000 + 2) > 10_000, 0.6, 0.0)
    log = simulate(
        drive,
        volts,
        Load(0.146, gravity=9.53),
        {"position": Sensor(resolution=STEP)},
        Sampler(RATE),
    )
    assert findings_of(remove_signals(log, "velocity"), "unit") == []


def test_parameters_that_an_excitation_does_not_show_are_reported():
    assert "inductance" in findings_of(make_log(kind="slow_sine"), "excitation")[0].message
    assert findings_of(make_log(kind="prbs"), "excitation") == []
    held = simulate(
        make_drive("small"), Excitation("locked_prbs", 6.0, 1.0), Load(), {"current": Sensor(0.05)}
    )
    assert "stands still" in findings_of(held, "excitation")[0].message
    assert all(finding.severity == "info" for finding in check(held))
    one_way = simulate(
        make_drive("small"), Excitation("square", 6.0, 0.4, frequency=1.0), Load(1e-4)
    )
    assert "in one direction only" in findings_of(one_way, "excitation")[-1].message
    silent = replace_signals(one_way, voltage=np.zeros(len(one_way.time)))
    assert "error" in [finding.severity for finding in findings_of(silent, "excitation")]
