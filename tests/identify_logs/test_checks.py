"""Every fault is found where it is, and a log without faults is left in peace."""

import dataclasses
import functools
import math
import re

import numpy as np
import pytest

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply
from codrl_mj.identify import identify
from codrl_mj.identify.checks import FACTORS, check, name_of_factor
from codrl_mj.identify.log import Log
from codrl_mj.identify.simulation import Moved, moving
from codrl_mj.identify.synthetic import Excitation, Load, Sampler, Sensor, run, simulate
from tests.identify.draws import scaled
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


def drive_of(motor, sag=0.0):
    return Drive(MOTORS[motor], SampledLoop(), Supply(12.0, sag * MOTORS[motor].resistance))


def excitation_of(motor, kind):
    clock = 4.0 * MOTORS[motor].electrical_time_constant
    return Excitation(
        kind, 6.0, 1.0, frequency=2.0 if kind == "square" else 1.0, highest=150.0, clock=clock
    )


@functools.cache
def logged(motor="small", kind="prbs", sag=0.0, jitter=0.0, dropped=0.0, seed=0, changes=()):
    """A log with noise and quantisation, and a fault: (signal, field, value)."""
    one, drive = MOTORS[motor], drive_of(motor, sag)
    load = Load(3.0 * one.rotor_inertia * one.gear_ratio**2 + 1e-4)
    course = run(drive, excitation_of(motor, kind), load)
    peak, fastest = (
        np.abs(course.signals["current"]).max(),
        np.abs(course.signals["velocity"]).max(),
    )
    sensors = {
        "current": Sensor(0.01 * peak),
        "torque": Sensor(0.01 * peak * one.torque_constant * one.gear_ratio),
        "velocity": Sensor(0.01 * fastest),
        "position": Sensor(resolution=STEP),
    }
    for signal, field, value in changes:
        sensors[signal] = dataclasses.replace(sensors.get(signal, Sensor()), **{field: value})
    sampler = Sampler(RATE, jitter, dropped, mean_voltage=True)
    return simulate(drive, excitation_of(motor, kind), load, sensors, sampler, seed)


def without(log, *names):
    return dataclasses.replace(
        log, signals={name: one for name, one in log.signals.items() if name not in names}
    )


def replaced(log, **signals):
    return dataclasses.replace(log, signals={**log.signals, **signals})


CHECKED = {}  # a log's identity and a motor -> the log, so that it stays, and what is found in it


def found(log, kind, motor=None):
    if (id(log), motor) not in CHECKED:
        CHECKED[id(log), motor] = log, check(log, motor)
    return [one for one in CHECKED[id(log), motor][1] if one.check == kind]


CLEAN = [(motor, kind) for motor in MOTORS for kind in ("slow_sine", "square", "chirp", "prbs")]


@pytest.mark.parametrize(("motor", "kind"), matrix_params([CLEAN[0], CLEAN[3], CLEAN[7]], CLEAN))
def test_a_log_without_faults_is_left_in_peace(motor, kind):
    findings = check(logged(motor, kind), MOTORS[motor])
    assert [one for one in findings if one.severity != "info"] == []
    assert {one.check for one in findings} <= {"excitation"}


SIGNS = {
    "current": lambda log: without(scaled(log, current=-1.0), "torque"),
    "voltage": lambda log: without(scaled(log, voltage=-1.0), "torque"),
    "position": lambda log: scaled(log, position=-1.0),
    "motion": lambda log: scaled(log, position=-1.0, velocity=-1.0),
    "torque": lambda log: scaled(log, torque=-1.0),
    "torque alone": lambda log: without(scaled(log, torque=-1.0), "voltage", "current"),
}
UNITS = {
    "position in degrees": lambda log: scaled(log, position=180.0 / math.pi),
    "position in degrees, alone": lambda log: without(
        scaled(log, position=180.0 / math.pi), "velocity"
    ),
    "motion in degrees": lambda log: scaled(
        log, position=180.0 / math.pi, velocity=180.0 / math.pi
    ),
    "velocity in rpm": lambda log: scaled(log, velocity=30.0 / math.pi),
    "velocity in rpm, alone": lambda log: without(scaled(log, velocity=30.0 / math.pi), "position"),
    "current in mA": lambda log: scaled(log, current=1000.0),
    "torque in mN*m": lambda log: scaled(log, torque=1000.0),
    "duty for voltage": lambda log: replaced(log, voltage=log.signals["duty"]),
    "time in ms": lambda log: dataclasses.replace(
        log, time=1000.0 * log.time + 0.3 * np.arange(len(log.time))
    ),
}


@pytest.mark.parametrize(("motor", "kind"), matrix_params([CLEAN[3]], CLEAN))
def test_wrong_signs_and_units_are_found_by_every_excitation(motor, kind):
    log = logged(motor, kind)
    for name, make in SIGNS.items():
        told = found(make(log), "sign")
        assert {one.severity for one in told} == {"error"}, name
        assert "minus" in told[0].remedy
    assert [name for name, make in UNITS.items() if not found(make(log), "unit")] == []


def hanging(amplitude=6.0, **sensors):
    """A pendulum, swung slowly."""
    excitation = Excitation("slow_sine", amplitude, 4.0)
    return simulate(
        drive_of("geared"), excitation, Load(2e-2, gravity=0.8), sensors, Sampler(500.0)
    )


@pytest.mark.parametrize("amplitude", [6.0, 2.0])
@pytest.mark.parametrize("signal", ["torque", "current"])
def test_degrees_for_radians_are_an_error_by_gravity(amplitude, signal):
    clean = without(hanging(amplitude), "velocity", *{"torque", "current", "voltage"} - {signal})
    (one,) = found(scaled(clean, position=180.0 / math.pi), "unit")
    assert (one.severity, "gravity" in one.message, one.remedy) == (
        "error",
        True,
        "write position=column:deg",
    )
    assert found(clean, "unit") == []


def test_degrees_for_radians_are_an_error_by_the_encoder():
    encoder = without(logged(), "torque", "velocity")
    (one,) = found(scaled(encoder, position=180.0 / math.pi), "unit")
    assert (one.severity, "1/4096 of 360" in one.message) == ("error", True)
    rounded = replaced(encoder, position=np.round(encoder.signals["position"], 2))
    rounded = dataclasses.replace(rounded, resolution={**rounded.resolution, "position": 0.01})
    assert [one.severity for one in found(rounded, "unit")] == [
        "warning"
    ]  # decimals of a file may be of radians too


@pytest.mark.parametrize(
    ("make", "says", "severity"),
    [
        (
            lambda log: scaled(log, current=1000.0, voltage=3.0),
            "the resistance would be 0.00",
            "error",
        ),
        (lambda log: scaled(log, current=1000.0), "the current is up to ", "error"),
        (lambda log: scaled(log, voltage=1000.0), "the voltage is up to ", "error"),
        (lambda log: scaled(log, current=1e-5), "outside 0.005 to 1e4 ohm", "error"),
        (lambda log: scaled(log, voltage=1 / 12.0), "is it a duty?", "warning"),
    ],
)
def test_what_no_bench_has_is_found_without_a_datasheet(make, says, severity):
    clean = without(logged(), "torque", "bus")
    told = [one for one in found(make(clean), "unit") if says in one.message]
    assert [one.severity for one in told] == [severity]
    assert found(clean, "unit") == []


def test_the_current_alone_needs_a_datasheet_for_its_unit():
    log = without(scaled(logged(), current=100.0), "torque")
    assert found(log, "unit") == []
    assert "hundredths" in found(log, "unit", MOTORS["small"])[0].message


@pytest.mark.parametrize(
    ("ratio", "name"),
    [
        *((1.02 * factor, name) for name, factor in FACTORS.items()),
        *((-0.98 / factor, name) for name, factor in FACTORS.items()),
        (9.8, "rpm for rad/s (9.549) or kgf*cm for N*m (10.2) or a wrong scale"),  # of any of them
        (4.3, "gear"),  # of none
    ],
)
def test_factors_have_names(ratio, name):
    assert name in name_of_factor(ratio)
    assert "rpm" not in name_of_factor(9.43, angle=False)  # resistances have no angle


@pytest.mark.parametrize(
    ("kind", "signal", "delay", "told", "near"),
    [
        *(
            (kind, "current", rows / RATE, rows, 0.3)
            for kind in ("chirp", "prbs")
            for rows in (1.0, 2.0, 3.5)
        ),
        *(("slow_sine", "velocity", seconds, 1e3 * seconds, 0.2) for seconds in (0.003, 0.02)),
    ],
)
def test_a_late_signal_is_found(kind, signal, delay, told, near):
    """A current in rows, a velocity in ms."""
    (one,) = found(logged(kind=kind, changes=((signal, "delay", delay),)), "lag")
    assert one.severity == "warning"
    assert float(one.message.split()[3]) == pytest.approx(told, abs=near)
    assert (" after " in one.message) or signal == "velocity"


def test_a_voltage_that_is_no_mean_is_found_where_it_changes_between_rows():
    log, excitation = logged(), excitation_of("small", "prbs")
    assert found(log, "voltage") == []
    at_rows = replaced(log, voltage=excitation.voltage(log.time))
    (one,) = found(at_rows, "voltage")
    assert (one.severity, "half a row" in one.message) == ("warning", True)
    (one,) = found(dataclasses.replace(at_rows, mean_voltage=False), "voltage")
    assert one.severity == "info"


def test_a_duty_in_percent_is_found():
    log = without(logged(), "torque", "bus")
    assert found(log, "unit") == []
    (one,) = found(scaled(log, duty=100.0), "unit")
    assert (one.severity, one.remedy) == ("error", "correct its unit, such as duty=column:percent")
    (one,) = found(without(scaled(log, voltage=100.0), "duty", "current"), "unit")
    assert (one.severity, "a duty in percent" in one.message) == ("warning", True)


@pytest.mark.parametrize("signals", [("current",), ("velocity",), ("position",)])
def test_a_supply_taken_for_the_motors_voltage_is_found(signals):
    log = without(logged(kind="slow_sine"), *{*logged().signals} - {*signals, "voltage"})
    assert "error" not in {one.severity for one in found(log, "voltage")}
    supply = 24.0 + 0.05 * np.sin(log.time)
    (one,) = [
        one for one in found(replaced(log, voltage=supply), "voltage") if one.severity == "error"
    ]
    assert one.remedy.startswith("write bus=column:V")
    held = replaced(
        log, voltage=supply, **{name: np.cumsum(np.abs(log.signals[name])) for name in signals}
    )
    assert "error" not in {
        one.severity for one in found(held, "voltage")
    }  # it may be a step that is held


def test_rows_that_repeat_old_values_are_found():
    """A position that is read 500 times a second into rows of 5 kHz; one of a coarse encoder is left in peace."""
    log = logged(kind="slow_sine")
    (one,) = found(
        replaced(log, position=np.repeat(log.signals["position"][::10], 10)[:-9]), "repeated"
    )
    assert (one.severity, "every 10th row" in one.message) == ("warning", True)
    coarse = logged(kind="slow_sine", changes=(("position", "resolution", 0.05),))
    assert found(coarse, "repeated") == found(log, "repeated") == []


@pytest.mark.parametrize(
    "signals", [("velocity",), ("position", "velocity"), ("voltage",), ("position", "voltage")]
)
@pytest.mark.parametrize("every", [1, 300])
def test_what_a_fit_refuses_is_an_error_of_the_check(signals, every):
    """Rows over 50 ms apart, and too few signals, are refused by both, in the same words."""
    log = logged(kind="slow_sine")
    part = Log(
        "part", 10.0 * log.time[::every], {name: log.signals[name][::every] for name in signals}
    )
    told = [one for one in check(part) if one.check in ("signals", "rows")]
    assert bool(told) == (signals != ("position", "voltage") or every == 300)
    if told:
        with pytest.raises(ValueError, match=re.escape(f"{told[0].message}; {told[0].remedy}")):
            identify([part], "free", {"load_inertia": 0.0})


def test_gaps_dropped_rows_and_jitter():
    log = logged(dropped=0.05, jitter=0.1)
    rows = np.flatnonzero(np.diff(log.row_numbers) > 1) + 1
    (dropped,) = found(log, "dropped rows")
    assert dropped.row == log.row_numbers[rows[0]]
    missing = int(log.row_numbers[-1] - len(log.time))
    assert dropped.message.startswith(f"{missing} rows missing")
    assert found(log, "jitter")
    whole, keep = logged(), np.r_[0:1000, 3000:5001]
    kept = {name: values[keep] for name, values in whole.signals.items()}
    gap = dataclasses.replace(whole, time=whole.time[keep], signals=kept, rows=keep + 1)
    assert [one.row for one in found(gap, "gap")] == [3001]
    assert found(whole, "jitter") == found(whole, "gap") == found(whole, "dropped rows") == []


@pytest.mark.parametrize("kind", ["slow_sine", "prbs"])
def test_outliers_are_found_where_they_are(kind):
    clean = logged(kind=kind)
    spoiled = clean.signals["current"].copy()
    rows = np.arange(333, 5_000, 250)
    spoiled[rows] += 5.0 * np.std(spoiled) * np.where(rows % 2, 1.0, -1.0)
    (one,) = found(replaced(clean, current=spoiled), "outliers")
    listed = [int(word) for word in one.message.partition("(")[2].rstrip(")").split(",")]
    assert one.row == listed[0]
    assert set(listed) <= {
        *rows,
        *(rows + 1),
    }  # or the row before, where that leaves its neighbours too
    assert one.severity == "info"
    assert found(clean, "outliers") == []


def test_a_clipped_current_is_found():
    current = logged().signals["current"]
    limit = 0.6 * np.abs(current).max()
    clipped = found(replaced(logged(), current=np.clip(current, -limit, limit)), "saturation")
    assert {one.row for one in clipped} == {
        1 + int(np.argmax(side >= limit)) for side in (current, -current)
    }


def test_coarse_sensors_are_found():
    coarse = logged(changes=(("position", "resolution", 1.0), ("current", "resolution", 2.0)))
    assert {one.message.split()[0] for one in found(coarse, "resolution")} == {
        "current",
        "position",
    }
    assert found(logged(), "resolution") == []


@pytest.mark.parametrize("motor", MOTORS)
def test_a_supply_that_sags_unseen_is_found_where_the_duty_varies(motor):
    (one,) = found(logged(motor, "chirp", sag=0.25), "sag")
    # at half of the duty: d^2*R/4
    assert float(one.message.split()[5]) == pytest.approx(
        0.0625 * MOTORS[motor].resistance, rel=0.3
    )
    assert found(logged(motor, "chirp"), "sag") == []


def test_a_wrapped_position_and_too_much_voltage_are_found():
    log = logged(kind="slow_sine")
    wrapped = found(replaced(log, position=log.signals["position"] % (2.0 * math.pi)), "wrapped")
    turns = np.flatnonzero(np.diff(np.floor(log.signals["position"] / (2.0 * math.pi))) != 0.0)
    assert [one.row for one in wrapped] == [turns[0] + 2]
    assert (
        "times that of the supply"
        in found(replaced(log, bus=0.4 * log.signals["bus"]), "unit")[0].message
    )


def test_gravity_tells_a_zero_that_is_not_where_it_hangs():
    log = without(hanging(position=Sensor(resolution=STEP)), "voltage", "current")
    assert found(log, "sign") == found(log, "zero") == []
    turned = replaced(log, position=log.signals["position"] + math.pi)
    assert "at the top" in found(turned, "zero")[0].message
    (tilted,) = found(replaced(log, position=log.signals["position"] + 0.1), "zero")
    assert float(
        tilted.remedy.removeprefix("write position=column").partition(":")[0]
    ) == pytest.approx(-0.1, abs=0.02)


def test_a_torque_that_does_not_move_it_is_found():
    log = without(logged("geared", "square"), "voltage", "current")
    assert found(log, "torque") == []
    other = np.random.default_rng(0).standard_normal(20)[np.arange(len(log.time)) // 251]
    assert found(replaced(log, torque=log.signals["torque"] + 0.3 * other), "torque")


PUSHED = {  # J, m*g*l, Coulomb and viscous friction; torque of time; logged besides the torque
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


def pushed(name, seed=0):
    """A pendulum that a torque holds, or moves slowly: friction and gravity take nearly all of it."""
    (inertia, mgl, coulomb, viscous), torque, signals = PUSHED[name]
    time, random = np.arange(0.0, 4.0, 1e-3), np.random.default_rng(seed)
    moved = Moved(inertia, mgl, 0.0, coulomb, viscous, 1.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0)
    position, velocity = moving(time, torque(time), 0.0 * time, 0.0, 0.0, moved)
    noisy = {
        "position": STEP * np.round(position / STEP),
        "velocity": velocity + 0.02 * random.standard_normal(4000),
    }
    given = torque(time) + 0.005 * random.standard_normal(4000)
    return Log(
        name, time, {"torque": given, **{one: noisy[one] for one in signals}}, {"position": STEP}
    )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", PUSHED)
def test_a_pendulum_that_hardly_accelerates_is_not_said_to_have_a_wrong_sign_or_unit(name, seed):
    assert [one for one in check(pushed(name, seed)) if one.severity == "error"] == []


def test_the_rig_tells_a_sign_that_gravity_would_explain_too():
    """A free rotor under a sine: with a minus it would be a pendulum."""
    log = without(logged(kind="slow_sine"), "voltage", "current", "velocity")
    (one,) = [one for one in check(scaled(log, torque=-1.0), rig="free") if one.check == "sign"]
    assert "with a minus" in one.message
    assert "zero" not in {
        one.check
        for one in check(replaced(log, position=log.signals["position"] + 1.0), rig="free")
    }


def test_a_motor_that_holds_a_pendulum_is_not_said_to_have_two_constants():
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
    assert found(without(log, "velocity"), "unit") == []


def test_what_an_excitation_does_not_show_is_told():
    assert "inductance" in found(logged(kind="slow_sine"), "excitation")[0].message
    assert found(logged(kind="prbs"), "excitation") == []
    held = simulate(
        drive_of("small"), Excitation("locked_prbs", 6.0, 1.0), Load(), {"current": Sensor(0.05)}
    )
    assert "stands still" in found(held, "excitation")[0].message
    assert all(one.severity == "info" for one in check(held))
    one_way = simulate(drive_of("small"), Excitation("square", 6.0, 0.4, frequency=1.0), Load(1e-4))
    assert "one way only" in found(one_way, "excitation")[-1].message
    nothing = replaced(one_way, voltage=np.zeros(len(one_way.time)))
    assert "error" in [one.severity for one in found(nothing, "excitation")]
