"""Fits of motors that are known, and what cannot be told of them."""

import dataclasses

import numpy as np
import pytest

from codrl_mj.identify import Log, identify
from tests.identify import bench


def errors(found, **truth):
    return {name: found[name].value / value - 1.0 for name, value in truth.items()}


def within(found, **truth):
    return {name: found[name].low <= value <= found[name].high for name, value in truth.items()}


MOTOR = {
    "resistance": bench.RESISTANCE,
    "inductance": bench.INDUCTANCE,
    "back_emf_constant": bench.CONSTANT,
    "inertia": bench.INERTIA,
}


@pytest.fixture(scope="module")
def motor():
    return identify([bench.motor_log(step=2.0 * np.pi / 4096)], "free", {"load_inertia": 0.0})


def test_a_motor_is_identified_from_voltage_current_and_position(motor):
    assert {motor[name].status for name in (*MOTOR, "rotor_inertia", "torque_constant")} == {"identified"}
    assert all(within(motor, **MOTOR).values()), motor.estimates
    off = errors(motor, **MOTOR)
    assert max(abs(off["resistance"]), abs(off["back_emf_constant"])) < 0.02
    assert abs(off["inductance"]) < 0.1
    assert abs(off["inertia"]) < 0.05
    assert motor["rotor_inertia"].value == pytest.approx(motor["inertia"].value)


def test_a_locked_rotor_tells_resistance_and_inductance_and_nothing_else():
    found = identify([bench.motor_log("locked", duration=2.5)])
    assert [one.name for one in found.estimates] == ["resistance", "inductance"]
    truth = {"resistance": bench.RESISTANCE, "inductance": bench.INDUCTANCE}
    assert all(within(found, **truth).values())
    assert max(map(abs, errors(found, **truth).values())) < 0.02
    assert "back_emf_constant" in found.problem() or "torque_constant" in found.problem()


def test_a_slow_sine_tells_no_inductance():
    found = identify([bench.motor_log("sine", rate=1000)], "free")
    assert found["inductance"].status in ("unidentifiable", "refused")
    assert found["resistance"].status == found["back_emf_constant"].status == "identified"
    assert abs(found["resistance"].value / bench.RESISTANCE - 1.0) < 0.02
    assert "--known inductance" in found.problem()


def test_a_late_voltage_is_found_late():
    log = bench.motor_log("locked", duration=1.5)
    late = np.append(log.signals["voltage"][2:], [0.0, 0.0])  # the log's voltage comes two rows early
    found = identify([dataclasses.replace(log, signals={**log.signals, "voltage": late})])
    assert found.delays["winding"] == 2
    assert abs(found["inductance"].value / bench.INDUCTANCE - 1.0) < 0.02


def test_outliers_and_dropped_rows_do_no_harm():
    log, random = bench.motor_log("locked", duration=1.5), np.random.default_rng(1)
    current = log.signals["current"].copy()
    current[random.choice(len(current), 35, replace=False)] += 40.0
    spoilt = dataclasses.replace(log, signals={**log.signals, "current": current}, mean_voltage=False)
    kept = np.sort(random.choice(len(current), round(0.95 * len(current)), replace=False))
    spoilt = Log("spoilt", log.time[kept], {name: one[kept] for name, one in spoilt.signals.items()})
    found = identify([spoilt])
    assert abs(found["resistance"].value / bench.RESISTANCE - 1.0) < 0.02
    assert abs(found["inductance"].value / bench.INDUCTANCE - 1.0) < 0.1


SWUNG = {"inertia": 0.19, "mgl": 3.6, "coulomb_friction": 0.15}


@pytest.fixture(scope="module")
def swings():
    return [bench.mujoco_pendulum(0, 6.0), bench.mujoco_pendulum(1, 3.0)]


def test_mujocos_pendulum_is_identified(swings):
    found = identify(swings[:1], "pendulum", held_out=swings[1:])
    assert all(within(found, **SWUNG).values()), found.estimates
    assert max(map(abs, errors(found, **SWUNG).values())) < 0.05
    assert found["viscous_friction"].low <= 0.01 <= found["viscous_friction"].high
    assert {one.status for one in found.estimates} == {"identified"}
    assert found.held_out[0].open_loop < 0.01
    assert found.warnings == ()


def test_without_a_known_mass_a_torques_gain_is_not_told_apart(swings):
    found = identify(swings[:1], "pendulum", estimated=["torque_gain"])
    assert found["torque_gain"].status == found["inertia"].status == found["mgl"].status == "ratio"
    assert "inertia by" in found["torque_gain"].why


@pytest.mark.matrix
def test_with_a_known_mass_a_torques_gain_is_found(swings):
    gain, log = 1.25, swings[0]
    wrong = dataclasses.replace(log, signals={**log.signals, "torque": log.signals["torque"] / gain})
    told = identify([wrong], "pendulum", {"mgl": 3.6}, estimated=["torque_gain"])
    assert told["torque_gain"].status == "identified"
    assert told["torque_gain"].value == pytest.approx(gain, rel=0.02)


@pytest.mark.matrix
def test_a_voltage_alone_tells_the_constants_only_together(swings):
    """With V = torque and no back-EMF the voltage of a motor with kT = kE = k has k/R = 1 and nothing of k itself."""
    log = swings[0]
    driven = Log(
        log.name, log.time, {"position": log.signals["position"], "voltage": log.signals["torque"]}, log.resolution
    )
    found = identify([driven], "pendulum", {"mgl": 3.6})
    assert found["torque_constant"].status in ("ratio", "refused")
    assert found["resistance"].status in ("ratio", "refused")
    assert found["torque_constant"].value / found["resistance"].value == pytest.approx(1.0, rel=0.05)


def test_bad_input_says_what_to_do(swings):
    log = swings[0]
    with pytest.raises(ValueError, match="pendulum, free or load"):
        identify([log])
    with pytest.raises(ValueError, match=r"mgl = -1.0: must be from 0"):
        identify([log], known={"mgl": -1.0})
    with pytest.raises(ValueError, match=r"did you mean known\.inertia"):
        identify([log], "pendulum", {"inertja": 1.0})
    with pytest.raises(ValueError, match="tell nothing"):
        identify([Log("empty", log.time, {"position": log.signals["position"]})], "free")
    with pytest.raises(ValueError, match="none was given"):
        identify([], "free")
    with pytest.raises(ValueError, match=r"segment = 0.0: must be >= 0.05"):
        identify([log], "pendulum", segment=0.0)


@pytest.mark.matrix
def test_intervals_hold_what_is_true_in_nineteen_of_twenty_draws():
    truth = {"resistance": bench.RESISTANCE, "inductance": bench.INDUCTANCE}
    held = dict.fromkeys(truth, 0)
    for seed in range(20):
        found = identify([bench.motor_log("locked", 2000, 2.5, seed=seed)], seed=seed)
        assert {found[name].status for name in truth} == {"identified"}
        for name, inside in within(found, **truth).items():
            held[name] += inside
    assert min(held.values()) >= 19


@pytest.mark.matrix
def test_friction_is_found_within_five_percent_whatever_it_is():
    random = np.random.default_rng(2)
    for seed in range(3):
        coulomb, viscous = random.uniform(0.05, 0.3), random.uniform(0.01, 0.05)
        logs = [bench.mujoco_pendulum(2 * seed + place, 6.0, coulomb, viscous) for place in (0, 1)]
        found = identify(logs, "pendulum")
        truth = {"coulomb_friction": coulomb, "viscous_friction": viscous}
        assert all(within(found, **truth).values())
        assert max(map(abs, errors(found, **truth).values())) < 0.05
