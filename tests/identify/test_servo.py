"""Position servos identified from their commands and encoders, in simulations that are not ours."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import servo_simulators
import study_servo_fit
from codrl_mj.actuators import resolve
from codrl_mj.cli import main
from codrl_mj.identify import Log, check
from codrl_mj.identify.servo import identify_servo
from codrl_mj.identify.servo_model import ServoModel
from tests.published import published_folder

FITTED = ("position_gain", "damping", "armature", "coulomb_friction", "command_delay", "zero")
"""Parameters of every simulated servo."""


def fit(kind, seed, **arguments):
    """Return a simulated servo, and the result of a fit to its log."""
    servo = servo_simulators.draw(seed, kind)
    log = servo_simulators.servo_log(servo, kind, seed)
    return servo, identify_servo([log], **{"known": servo.known, **arguments})


@pytest.fixture(scope="module")
def bam():
    return fit("bam", 1)


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("mujoco_position", {}),
        ("mujoco_dcmotor", {"stall_torque", "duty_gain"}),
        ("pwm", {"stall_torque", "duty_gain"}),
    ],
)
def test_the_truth_lies_in_the_intervals(kind, limit):
    servo, result = fit(kind, 0)
    for name in (*FITTED, *limit):
        estimate = result[name]
        assert estimate.status == "identified", estimate
        assert estimate.low <= servo.truth[name] <= estimate.high, estimate


def test_a_servo_of_bams_equations_is_identified_with_its_firmwares_law(bam):
    servo, result = bam
    for name in (*FITTED, "stall_torque", "duty_gain"):
        assert result[name].status == "identified"
        assert result[name].low <= servo.truth[name] <= result[name].high, name
    assert result.problem() is None
    assert result.fitted[0].closed_loop < 1e-3


def test_the_result_is_a_pwm_servo_that_moves_alike(bam, tmp_path):
    servo, result = bam
    result.write(tmp_path)
    actuator = resolve(str(tmp_path / "actuator.yaml"), None, "a test")
    assert actuator.family == "pwm_servo"
    truth = servo.truth
    assert actuator.stall_torque == pytest.approx(truth["stall_torque"], rel=0.01)
    assert actuator.stiffness == pytest.approx(truth["position_gain"], rel=0.01)
    motor = actuator.motor
    damping = motor.torque_constant * motor.back_emf_constant / motor.resistance
    assert damping + motor.viscous_friction == pytest.approx(truth["damping"], rel=0.02)
    assert motor.rotor_inertia == pytest.approx(truth["armature"], rel=0.03)
    low, high = result.intervals()["loop.command_delay"]
    assert low <= actuator.loop.command_delay <= high


def test_the_command_writes_an_actuator_a_result_and_a_page(tmp_path, capsys):
    servo = servo_simulators.draw(1)
    log = servo_simulators.servo_log(servo, "bam", 1)
    table = np.stack([log.time, log.signals["command"], log.signals["position"]], axis=1)
    path, out = tmp_path / "swing.csv", tmp_path / "motor"
    np.savetxt(path, table, delimiter=",", header="t,goal,present", comments="")
    columns = "time=t:s,command=goal:rad,position=present:rad"
    known = [f"{name}={value}" for name, value in servo.known.items()]
    arguments = ["--columns", columns, "--load", "pendulum", "--known", *known]
    assert main(["identify", "servo", str(path), *arguments, "--out", str(out)]) == 0
    assert {file.name for file in out.iterdir()} == {"actuator.yaml", "result.json", "report.html"}
    assert "position_gain" in capsys.readouterr().out
    assert resolve(str(out / "actuator.yaml"), None, "a test").family == "pwm_servo"


def test_without_a_load_only_ratios_to_the_inertia_are_identified():
    servo = dataclasses.replace(servo_simulators.draw(1), mass=1e-9, length=1e-3)
    log = servo_simulators.servo_log(servo, "bam", 1)
    result = identify_servo([log], "free")
    ratio = result["position_gain_per_inertia"]
    assert ratio.status == "identified"
    assert ratio.low <= servo.truth["position_gain"] / servo.armature <= ratio.high
    assert result["duty_gain"].low <= servo.duty_gain <= result["duty_gain"].high
    assert "position_gain" not in {estimate.name for estimate in result.estimates}
    assert "only ratios" in result.problem()
    # A single known torque or inertia gives all of them.
    known = {"armature": servo.armature, "load_inertia": 0.0}
    scaled = identify_servo([log], "free", known)
    gain = scaled["position_gain"]
    assert gain.low <= servo.truth["position_gain"] <= gain.high


def test_a_logged_duty_gives_the_law_though_the_torque_reaches_no_limit():
    servo = servo_simulators.draw(4)
    times = np.arange(2400) / 200.0
    log = servo_simulators.servo_log(servo, "bam", 4, with_duty=True)
    slow = 0.4 * np.sin(0.9 * times) + 0.2 * np.sin(3.1 * times)
    rows = np.floor((servo_simulators.STEP * np.arange(120_000) - servo.delay) * 200.0 + 1e-9)
    held = slow[np.clip(rows.astype(int), 0, None)]
    positions, duties = servo_simulators.simulate_bam(servo, held)
    signals = {"command": slow, "position": positions[::50], "duty": duties[::50]}
    log = Log("slow", times, signals)
    without = dataclasses.replace(log, signals={**signals, "duty": 0.0 * times})
    result = identify_servo([log], known=servo.known)
    for name in ("duty_gain", "stall_torque"):
        assert result[name].status == "identified", result[name]
        assert result[name].low <= servo.truth[name] <= result[name].high, result[name]
    # A register that does not follow the error is reported, and the stall torque stays unknown.
    refused = identify_servo([without], known=servo.known)
    assert any("not proportional" in text for text in refused.warnings)
    assert refused["stall_torque"].status == "unidentifiable"
    assert "stall_torque" in refused.problem()


def test_a_known_resistance_splits_stall_torque_and_damping(bam):
    servo, _ = bam
    log = servo_simulators.servo_log(servo, "bam", 1)
    known = {**servo.known, "resistance": servo.resistance, "supply_voltage": servo.volts}
    result = identify_servo([log], known=known)
    constant, viscous = result["torque_constant"], result["viscous_friction"]
    assert constant.low <= servo.torque_constant <= constant.high
    assert viscous.low <= servo.viscous <= viscous.high
    assert result.actuator().motor.resistance == servo.resistance


def test_logs_that_contradict_each_other_widen_the_intervals():
    """The second log is of a servo with twice the friction: no value holds for both."""
    servo = servo_simulators.draw(1)
    rough = dataclasses.replace(servo, coulomb=2.0 * servo.coulomb)
    logs = [
        servo_simulators.servo_log(simulated, "bam", seed)
        for seed, simulated in enumerate((servo, rough))
    ]
    friction = identify_servo(logs, known=servo.known)["coulomb_friction"]
    assert friction.causes["logs"] > 0.0
    assert friction.low < servo.coulomb * 1.2
    assert friction.high > servo.coulomb * 1.8


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda log: {"command": log.signals["command"]}, "no position"),
        (lambda log: {**log.signals, "command": -log.signals["command"]}, "against the command"),
        (lambda log: {**log.signals, "command": 0.0 * log.time}, "does not change"),
        (lambda log: {**log.signals, "position": 0.0 * log.time}, "does not move"),
    ],
)
def test_logs_that_show_no_servo_are_refused(change, text):
    log = servo_simulators.servo_log(servo_simulators.draw(1), "bam", 1, duration=3.0)
    with pytest.raises(ValueError, match=text):
        identify_servo([dataclasses.replace(log, signals=change(log))], known={"mgl": 1.0})


def test_mass_without_length_and_unknown_names_are_refused():
    log = servo_simulators.servo_log(servo_simulators.draw(1), "bam", 1, duration=3.0)
    with pytest.raises(ValueError, match="both are needed"):
        identify_servo([log], known={"mass": 1.0})
    with pytest.raises(ValueError, match="did you mean"):
        identify_servo([log], known={"stall_torqe": 1.0})


def test_the_check_of_a_servo_log_names_the_verb_and_finds_no_error():
    log = servo_simulators.servo_log(servo_simulators.draw(1), "bam", 1, duration=3.0)
    (finding,) = [finding for finding in check(log) if finding.check == "signals"]
    assert finding.severity == "info"
    assert "identify servo" in finding.remedy


def test_commands_between_rows_arrive_after_the_delay_and_not_before():
    """A servo without friction and with a delay of 12.3 ms is at rest until then."""
    times = np.arange(0.0, 0.2, 0.005)
    target = np.where(times >= 0.05, 1.0, 0.0)
    known = {"position_gain": 5.0, "damping": 0.5, "inertia": 0.01, "coulomb_friction": 0.0}
    model = ServoModel(
        rig="free", friction="coulomb", known={**known, "command_delay": 0.0123}, segment=10.0
    )
    log = Log("step", times, {"command": target, "position": 1e-9 * times})
    (segment,) = model.segments([log])
    positions = model.simulator(np.zeros(0))(segment, np.zeros(2))
    still = times <= 0.05 + 0.0123
    assert np.all(positions[still] == 0.0)
    # The exact response of inertia, damping and gain to a step.
    after = times[~still] - 0.05 - 0.0123
    decay, wave = 25.0, np.sqrt(500.0 - 25.0**2 + 0j)
    exact = 1.0 - np.exp(-decay * after) * (
        np.cos(wave * after) + decay / wave * np.sin(wave * after)
    )
    assert positions[~still] == pytest.approx(exact.real, abs=2e-4)


def test_the_page_of_accuracy_quotes_the_study():
    rows = list(csv.DictReader(study_servo_fit.SUMMARY.open()))
    page = (Path(study_servo_fit.__file__).parent.parent / "docs/identify_servo.md").read_text()
    identified = sum(int(row["identified"]) for row in rows)
    inside = sum(int(row["inside_interval"]) for row in rows)
    assert f"{inside:,} of {identified:,}" in page
    assert all(int(row["inside_interval"]) >= 0.9 * int(row["identified"]) for row in rows)


@pytest.mark.matrix
def test_the_xl330_at_a_gain_of_200_is_predicted_better_than_by_bams_parameters():
    """Over all gains, BAM's M4 and M6 are better; its parameters are read if they are there."""
    folder = published_folder("bam_xl330")
    logs = [
        study_servo_fit.read_log(path, study_servo_fit.COLUMNS)
        for path in sorted(folder.glob("*.json"))
    ]
    held_out = [log for log in logs if log.constants["kp"] == 200.0]
    fitted = [log for log in logs if log.constants["kp"] != 200.0]
    known = {"mass": 0.49, "length": 0.1}
    result = identify_servo(fitted, "pendulum", known, "load", held_out)
    errors = [prediction.closed_loop for prediction in result.held_out]
    assert np.mean(errors) < 0.036
    parameters = folder.parent.parent / "real_logs" / "bam_params" / "xl330"
    for model in ("m1", "m4", "m6") if parameters.is_dir() else ():
        values = json.loads((parameters / f"{model}.json").read_text())
        paths = [path for path in sorted(folder.glob("*.json")) if is_held_out(path)]
        theirs = [study_servo_fit.bam_error(path, values) for path in paths]
        assert np.mean(errors) < np.mean(theirs)


def is_held_out(path):
    """Return True for the logs with a gain of 200."""
    return json.loads(path.read_text())["kp"] == 200
