"""What is advised about an actuator: the bench against closed forms, and verdicts on results that a formula gives."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from actuator_study.questions import secondary
from codrl_mj import cli
from codrl_mj.actuators import Actuator, CurrentLoop, Lag, Motor, Supply
from codrl_mj.motor_design import find_drive, torque_limits
from codrl_mj.study.advice import (
    BUY,
    IDEAL,
    LOOP,
    MEASURE,
    THROUGH,
    advise,
    decide,
    delivered,
    doses,
    redesign,
)
from codrl_mj.study.doses import AXES, FLOORS, REFERENCE_SPEEDS, supplied, timestep
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.measured import measured, measured_grid
from codrl_mj.tasks import find_task, named_actuator
from tests.matrix import but
from tests.study.pretended import pretend

OWN_STEPS = {"supply": 1.0 / (2.0 * math.pi * 0.0555 * 20.0), "noise": 1.0}
"""Integration steps that the loops of the axes' own motors take: a bandwidth of 0.0555 of 20 samples a step; and half
of what is left in each step, 1/2 + 1/4 + ..."""


@pytest.mark.parametrize("task", but(["furuta"], REFERENCE_SPEEDS))
@pytest.mark.parametrize("axis", ["lag", "weakness", "supply", "noise"])
def test_the_bench_finds_every_dose_of_the_study_and_nothing_else(task, axis):
    for dose in AXES[axis].doses:
        found = doses(delivered(AXES[axis].at(task, dose).actuator, task), task)
        finest = timestep(task) / find_task(task).step_duration  # policy steps
        expected = dict.fromkeys(AXES, 0.0) | {axis: dose}
        if axis == "lag":
            missing = math.exp(-20.0 / dose) if dose else 0.0  # after the horizon of 20 steps
            assert found.pop("weakness") == pytest.approx(missing, abs=2e-3)
            whole = (dose - 20.0 * missing / (1.0 - missing)) if dose else 0.0
            assert found.pop("lag") == pytest.approx(max(whole - finest / 2, 0.0), abs=0.1 * finest, rel=5e-3)
        else:
            assert found.pop("lag") == pytest.approx(OWN_STEPS.get(axis, 0.0) * finest, abs=0.1 * finest)
        for name, value in found.items():
            assert value == pytest.approx(expected[name], abs=2e-3, rel=2e-3), name


def test_a_delay_is_found_beside_a_lag():
    step = find_task("pendulum").step_duration
    found = doses(delivered(Lag(step, delay=0.6 * step), "pendulum"), "pendulum")
    assert found["delay"] == pytest.approx(0.6)
    assert found["lag"] == pytest.approx(0.95, abs=0.01)  # half an integration step less


@pytest.mark.parametrize("task", ["pendulum", "mountain_car"])
@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ({"coulomb_friction": 0.02}, lambda _: 0.02),
        ({"viscous_friction": 1e-3}, lambda speed: 1e-3 * speed),
        ({"stribeck_friction": 0.02, "stribeck_speed": 1e6}, lambda _: 0.02),
        ({"coulomb_friction": 0.02, "viscous_friction": 1e-3}, lambda speed: 0.02 + 1e-3 * speed),
    ],
)
def test_friction_is_the_gearmotor_s_at_the_output(task, kinds, expected):
    drive = supplied(task, 100.0)
    rubbed = dataclasses.replace(drive.motor, arm_radius=0.1, rotor_inertia=0.0, **kinds)
    found = doses(delivered(dataclasses.replace(drive, motor=rubbed), task), task)["friction"]
    at_the_rotor = expected(REFERENCE_SPEEDS[task] / 0.1)
    assert found == pytest.approx(at_the_rotor / 0.1 / find_task(task).max_force, rel=1e-3)


def test_a_current_limit_is_weakness():
    drive = supplied("pendulum", 100.0)
    limited = dataclasses.replace(drive.controller, max_current=0.25 * drive.controller.max_current)
    found = doses(delivered(dataclasses.replace(drive, controller=limited), "pendulum"), "pendulum")
    assert found["weakness"] == pytest.approx(0.75, abs=1e-3)
    assert found["supply"] == pytest.approx(0.0, abs=1e-3)


def test_what_creeps_to_its_end_counts_as_missing():
    """A PI loop that is at kp/(kp + R) with (L/R)/(1 + kp/R), and at the rest with (1 + kp)/ki."""
    step, dt = find_task("pendulum").step_duration, timestep("pendulum")
    loop = CurrentLoop(kp=1.0, ki=2.0 / (1000 * step), max_voltage=1e3)
    found = delivered(Actuator(Motor(1.0, 10 * dt, 1.0, 1.0), loop), "pendulum")
    assert found.at_rest == pytest.approx(1.0 - 0.5 * math.exp(-0.02), abs=2e-3)
    # of what is there in the 20th step: the quick half, by a fifth in each of ten integration steps, and what creeps
    quick, creeps = np.sum(0.8 ** np.arange(1, 100)) / 10.0, 1000.0 * (1.0 - math.exp(-0.02)) - 20.0 * math.exp(-0.0195)
    assert found.lag == pytest.approx(0.5 * (quick + creeps) / found.at_rest, abs=0.005)


# evidence


def results(loss, matched=0.2):
    """Rows of hypotheses.csv: ideal-trained policies lose `loss(axis, dose)` on every task, within 0.01."""

    def effect(contrast):
        ideal = contrast.one.arm.name.endswith(": ideal")
        axis, _, dose = contrast.one.test.rpartition(" ")
        return -loss(axis, float(dose)) if ideal else loss(axis, float(dose)) - matched

    for hypothesis in secondary():
        (pair,) = hypothesis.contrasts
        if pair.one.test.rpartition(" ")[0] in AXES:
            mean = effect(pair)
            yield {
                "name": hypothesis.name,
                "compared": f"{pair.one.name} over {pair.other.name}",
                **{name: str(mean + by) for name, by in (("effect", 0.0), ("low", -0.01), ("high", 0.01))},
            }


def proportional(axis, dose):
    """Half of the span at the largest dose."""
    return 0.5 * dose / AXES[axis].doses[-1]


@pytest.fixture(scope="module")
def rows():
    return list(results(proportional))


@pytest.fixture(scope="module")
def evidence(rows):
    return Evidence(rows)


@pytest.mark.parametrize("axis", AXES)
def test_a_loss_is_interpolated_and_has_the_rows_that_it_is_between(evidence, axis):
    tested, named = AXES[axis].doses, {one.statement: one.name for one in secondary()}
    middle = (tested[1] + tested[2]) / 2
    loss = evidence.loss("acrobot", axis, middle)
    assert loss.loss == pytest.approx([proportional(axis, middle) + by for by in (0.0, -0.01, 0.01)])
    assert loss.rows == tuple(named[f"acrobot, ideal-trained: {axis} {at:g} over none"] for at in tested[1:3])
    assert evidence.loss("acrobot", axis, 0.0)[2:5] == ((0.0, 0.0, 0.0), False, ())
    assert evidence.loss("acrobot", axis, tested[1]).rows == (
        named[f"acrobot, ideal-trained: {axis} {tested[1]:g} over none"],
    )
    beyond = evidence.loss("acrobot", axis, 2 * tested[-1])
    assert beyond.beyond
    assert beyond.loss.mean == pytest.approx(0.5)


def test_what_training_keeps_is_known_where_it_was_tried(evidence):
    assert evidence.loss("furuta", "lag", 0.5).kept == pytest.approx(0.2)
    assert evidence.loss("acrobot", "lag", 0.5).kept is None


def test_verdicts(evidence):
    step = find_task("pendulum").step_duration
    assert advise(Lag(0.0), "pendulum", evidence).verdict == IDEAL
    assert advise(Lag(step), "pendulum", evidence).verdict == THROUGH
    assert advise(Lag(10 * step), "pendulum", evidence).verdict == BUY
    weak = advise(Lag(0.0, gain=0.6), "pendulum", evidence)
    assert (weak.verdict, weak.lost.mean) == (BUY, pytest.approx(0.5 * 0.4 / 0.7))
    late = advise(named_actuator("weaker", "pendulum"), "pendulum", evidence)
    assert late.verdict == LOOP
    assert late.redesigned.found.lag < 0.1
    assert "designed loop" in late.reason


def test_more_than_was_tested_is_no_reason_to_buy_where_it_cost_nothing():
    harmless = Evidence(list(results(lambda axis, dose: 0.0 if axis == "weakness" else proportional(axis, dose))))
    found = advise(Lag(0.0, gain=0.1), "acrobot", harmless)
    assert (found.verdict, found.lost.mean) == (MEASURE, 0.0)
    assert "no dose as large" in found.reason


def test_more_than_is_asked_for_is_not_called_harmless(evidence):
    assert advise(Lag(0.0, gain=3.0), "pendulum", evidence).verdict == MEASURE


def test_more_than_was_tested_which_cost_nothing_is_measured_beside_a_loss():
    """Four times the largest noise, whose tested doses are harmless, beside a lag that would be trained through."""
    harmless = Evidence(list(results(lambda axis, dose: 0.0 if axis == "noise" else proportional(axis, dose))))
    lag, noise = (harmless.loss("pendulum", axis, dose) for axis, dose in (("lag", 1.0), ("noise", 6.4)))
    assert [decide([lag], None), decide([lag, noise], None)] == [THROUGH, MEASURE]


def test_a_force_that_nobody_asked_for_is_not_called_harmless(evidence):
    """A sensor that reads 0.1 A too much: a loop with an integrator takes -0.1 A for none."""
    paper = named_actuator("paper", "pendulum")
    wrong = dataclasses.replace(paper, controller=dataclasses.replace(paper.controller, current_bias=0.1))
    found = advise(wrong, "pendulum", evidence)
    assert (found.verdict, "nothing is asked for" in found.reason) == (MEASURE, True)
    share = 0.1 * paper.motor.torque_constant / paper.motor.arm_radius / find_task("pendulum").max_force
    assert found.found.unasked == pytest.approx(share, rel=0.05)


def test_the_largest_dose_is_not_beyond_it(evidence):
    found = advise(AXES["supply"].at("acrobot", AXES["supply"].doses[-1]).actuator, "acrobot", evidence)
    assert not any(loss.beyond for loss in found.losses)


def test_a_ringing_loop_is_late(evidence):
    """Poles of 0.9 rad a step with a damping ratio of 0.1: an overshoot of exp(-pi*0.1/sqrt(0.99)) = 73 %."""
    speed = 0.9 / find_task("pendulum").step_duration
    loop = CurrentLoop(kp=0.0, ki=speed**2, max_voltage=1e6, substeps=100)
    found = advise(Actuator(Motor(0.2 * speed, 1.0, 1.0, 1.0), loop), "pendulum", evidence)
    assert found.found.lag > 1.0
    assert found.verdict != IDEAL


def test_a_detuned_drive_is_told_to_design_its_loop(evidence):
    drive = supplied("pendulum", 100.0)
    slow = dataclasses.replace(drive.controller, bandwidth=0.3)
    assert advise(dataclasses.replace(drive, controller=slow), "pendulum", evidence).verdict == LOOP
    assert advise(drive, "pendulum", evidence)[3:5] == (None, IDEAL)


def test_a_designed_loop_keeps_the_supply_and_does_not_cure_a_sensor(evidence):
    paper = named_actuator("paper", "pendulum")
    sagging = dataclasses.replace(paper, supply=Supply(5.0, 0.3))
    assert redesign(sagging, "pendulum").supply == Supply(5.0, 0.3)
    noisy = dataclasses.replace(paper, controller=dataclasses.replace(paper.controller, current_noise=0.1))
    assert redesign(noisy, "pendulum") is None
    assert advise(noisy, "pendulum", evidence).redesigned is None


def test_without_results_there_is_no_verdict():
    found = advise(Lag(1.0), "cartpole", Evidence([]))
    assert found.verdict is None
    assert "measure" in found.reason


# measured


@pytest.mark.parametrize(
    ("ideal", "designed", "through", "verdict"),
    [
        (0.97, 1.0, 1.0, IDEAL),
        (0.5, 0.96, 1.0, LOOP),
        (0.5, 0.6, 0.96, THROUGH),
        (0.5, 0.6, 0.7, THROUGH),
        (0.5, 0.6, 0.52, LOOP),
        (0.5, 0.54, 0.52, BUY),
    ],
)
def test_the_verdict_of_a_measurement(tmp_path, ideal, designed, through, verdict):
    actuator = named_actuator("weaker", "cartpole")
    grid = measured_grid(actuator, "cartpole", 4, tmp_path)

    def score(trial, seed):
        level = through if trial.arm.name.endswith("through it") else {"ideal": 1.0, "designed": designed}
        level = level if isinstance(level, float) else level.get(trial.test, ideal)
        return FLOORS["cartpole"] + 200.0 * (level + 0.001 * (-1) ** seed)

    pretend(grid, score)
    found = measured(actuator, "cartpole", grid.collect())
    assert found.verdict == verdict
    assert [found.scores[name].mean for name in (IDEAL, LOOP, THROUGH)] == pytest.approx([ideal, designed, through])
    # of four policies +-0.001 around the mean: Student's t of three degrees of freedom
    assert found.scores[LOOP].high - designed == pytest.approx(3.18245 * 0.001 * math.sqrt(4 / 3) / 2, rel=1e-4)


def test_a_measurement_that_is_not_finished_says_so(tmp_path):
    actuator = named_actuator("weaker", "cartpole")
    grid = measured_grid(actuator, "cartpole", 2, tmp_path)
    pretend(grid, lambda *_: 100.0, leaving_out=[("cartpole: through it", 1)])
    with pytest.raises(ValueError, match=r"1 of its trainings and tests are missing"):
        measured(actuator, "cartpole", grid.collect())


# the command line


@pytest.fixture
def file(tmp_path, rows):
    path = tmp_path / "hypotheses.csv"
    with path.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


def test_on_the_command_line_with_results_and_runs(tmp_path, file, capsys):
    actuator = named_actuator("weaker", "cartpole")
    pretend(measured_grid(actuator, "cartpole", 2, tmp_path / "runs"), lambda _, seed: 100.0 + seed)
    words = [
        "advise",
        "weaker",
        "cartpole",
        "--evidence",
        str(file),
        "--measure",
        "2",
        "--root",
        str(tmp_path / "runs"),
    ]
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert f"{LOOP}: the same motor under a designed loop loses 0.0" in shown
    assert f"measured: {IDEAL}" in shown
    assert cli.main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["advice"]["verdict"] == LOOP
    assert found["advice"]["losses"][0]["axis"] == "lag"
    assert found["measured"]["scores"][IDEAL]["mean"] == pytest.approx(1.0)


@pytest.mark.parametrize("value", ["nan", "inf", "much", ""])
def test_evidence_that_is_no_number_is_refused(tmp_path, file, value):
    lines = file.read_text().splitlines()
    cells = lines[2].split(",")
    cells[lines[0].split(",").index("low")] = value
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("\n".join([lines[0], lines[1], ",".join(cells), *lines[3:]]) + "\n")
    with pytest.raises(ValueError, match=rf"wrong.csv, line 3: low = '{value}': must be a finite number"):
        Evidence.read(wrong)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["papr", "cartpole"], "did you mean 'paper'"),
        (["paper", "cartpol"], "did you mean 'cartpole'"),
        (["paper", "cartpole", "--measure", "1"], "must be >= 2"),
        (["paper", "cartpole", "--evidence", "nowhere.csv"], "nowhere.csv"),
        (["paper", "cartpole", "--evidence", "docs/upright_tolerances.csv"], "has no column 'name'"),
        (["ideal", "cartpole", "--measure", "2"], "actuator = 'ideal'"),
        (["maxon-dcx22l", "pendulum", "--gear-ratio", "0"], "gear_ratio = 0.0"),
        (["lag", "pendulum", "--voltage", "3"], "--voltage: "),
    ],
)
def test_bad_input_is_told(words, said, capsys):
    assert cli.main(["advise", *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("gear", "volts"), [(59.0, 9.0), (59.0, 3.0), (2.0, 9.0)])
def test_a_motor_s_gear_and_supply_are_the_command_line_s(gear, volts, file, capsys):
    words = ["advise", "maxon-dcx22l", "pendulum", "--evidence", str(file), "--json"]
    assert cli.main([*words, "--gear-ratio", str(gear), "--voltage", str(volts)]) == 0
    found = json.loads(capsys.readouterr().out)["advice"]["found"]
    drive, force = find_drive("maxon-dcx22l", gear_ratio=gear, voltage=volts), find_task("pendulum").max_force
    frictionless = dataclasses.replace(drive, motor=dataclasses.replace(drive.motor, coulomb_friction=0.0))
    for name, speed in (("at_rest", 0.0), ("at_speed", REFERENCE_SPEEDS["pendulum"])):
        expected = min(float(torque_limits(frictionless, speed, drive.controller.max_current)[1]) / force, 1.0)
        assert found[name] == pytest.approx(expected, rel=2e-3), name
    assert found["friction"] == pytest.approx(gear * drive.motor.coulomb_friction / force, rel=1e-3)


def test_what_is_assumed_of_a_motor_is_said(file, capsys):
    assert cli.main(["advise", "maxon-dcx22l", "pendulum", "--gear-ratio", "59", "--evidence", str(file)]) == 0
    assert "assumed, for none is given: controller.max_current = inf" in capsys.readouterr().out
