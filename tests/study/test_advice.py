"""Advice on an actuator: the bench against closed forms, and verdicts on results from a formula."""

import csv
import dataclasses
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from codrl_mj import cli
from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Lag, Motor, Supply
from codrl_mj.runs.files import write_json
from codrl_mj.sizing import find_drive, torque_limits
from codrl_mj.study.advice import (
    BUY,
    COMMAND,
    IDEAL,
    LOOP,
    MEASURE,
    RANDOMIZE,
    SENSOR,
    THROUGH,
    LossBounds,
    advise,
    decide,
    option_bounds,
    plan_measurement,
)
from codrl_mj.study.axes import (
    AXES,
    FLOORS,
    REAL,
    REFERENCE_SPEEDS,
    drive_on_supply,
    needed_voltage,
    random_training,
    study_env,
    timestep,
)
from codrl_mj.study.bench import fix_sensor, measure_on_task, redesign_loop, severities
from codrl_mj.study.evidence import SUDDEN, WIND_UP, Evidence, Outcome, gains, is_better
from codrl_mj.study.pages import read_csv
from codrl_mj.tasks import find_task, named_actuator
from codrl_mj.training import TrainConfig
from tests.matrix import matrix_params
from tests.study.pretended import pretend

SERVO = """product = "a hobby servo of 20 kg*cm"

[datasheet]
nominal_voltage = "7.4 V"
no_load_speed = "50 rpm"
no_load_current = "0.15 A"
stall_torque = "20 kg*cm"
stall_current = "2.5 A"
gear_ratio = "340:1"
shaft = "output"
inductance = "0.2 mH"

[estimated]
inductance = "as of other small motors"
"""
LOOP_STEPS = {"supply": 1.0 / (2.0 * math.pi * 0.0555 * 20.0), "noise": 1.0}
"""Integration steps that the loops of the axes' own motors take: a bandwidth of 0.0555 of 20
samples a step; and half of what is left in each step, 1/2 + 1/4 + ...
"""


@pytest.mark.parametrize("task", matrix_params(["furuta"], REFERENCE_SPEEDS))
@pytest.mark.parametrize("axis", ["lag", "weakness", "supply", "noise"])
def test_the_bench_measures_every_severity_and_nothing_on_other_axes(task, axis):
    for severity in AXES[axis].severities:
        measured = severities(
            measure_on_task(AXES[axis].make_env(task, severity).actuator, task), task
        )
        finest = timestep(task) / find_task(task).step_duration  # policy steps
        expected = dict.fromkeys(AXES, 0.0) | {axis: severity}
        if axis == "lag":
            missing = (
                math.exp(-20.0 / severity) if severity else 0.0
            )  # Missing after the horizon of 20 steps.
            assert measured.pop("weakness") == pytest.approx(missing, abs=2e-3)
            whole = (severity - 20.0 * missing / (1.0 - missing)) if severity else 0.0
            assert measured.pop("lag") == pytest.approx(
                max(whole - finest / 2, 0.0), abs=0.1 * finest, rel=5e-3
            )
        else:
            assert measured.pop("lag") == pytest.approx(
                LOOP_STEPS.get(axis, 0.0) * finest, abs=0.1 * finest
            )
        for name, value in measured.items():
            assert value == pytest.approx(expected[name], abs=2e-3, rel=2e-3), name


def test_the_bench_separates_delay_and_lag():
    step = find_task("pendulum").step_duration
    measured = severities(measure_on_task(Lag(step, delay=0.6 * step), "pendulum"), "pendulum")
    assert measured["delay"] == pytest.approx(0.6)
    assert measured["lag"] == pytest.approx(
        0.95, abs=0.01
    )  # Half an integration step is subtracted.


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
def test_the_measured_friction_is_that_of_the_gearmotor_at_its_output(task, kinds, expected):
    drive = drive_on_supply(task, 100.0)
    rubbed = dataclasses.replace(drive.motor, arm_radius=0.1, rotor_inertia=0.0, **kinds)
    measured = severities(measure_on_task(dataclasses.replace(drive, motor=rubbed), task), task)[
        "friction"
    ]
    at_the_rotor = expected(REFERENCE_SPEEDS[task] / 0.1)
    assert measured == pytest.approx(at_the_rotor / 0.1 / find_task(task).max_force, rel=1e-3)


def test_a_current_limit_counts_as_weakness():
    drive = drive_on_supply("pendulum", 100.0)
    limited = dataclasses.replace(drive.controller, max_current=0.25 * drive.controller.max_current)
    measured = severities(
        measure_on_task(dataclasses.replace(drive, controller=limited), "pendulum"), "pendulum"
    )
    assert measured["weakness"] == pytest.approx(0.75, abs=1e-3)
    assert measured["supply"] == pytest.approx(0.0, abs=1e-3)


def test_slowly_creeping_force_counts_as_missing():
    """A PI loop reaches kp/(kp + R) with (L/R)/(1 + kp/R), and the rest with (1 + kp)/ki."""
    step, dt = find_task("pendulum").step_duration, timestep("pendulum")
    loop = CurrentLoop(kp=1.0, ki=2.0 / (1000 * step), max_voltage=1e3)
    response = measure_on_task(DCMotorActuator(Motor(1.0, 10 * dt, 1.0, 1.0), loop), "pendulum")
    assert response.at_rest == pytest.approx(1.0 - 0.5 * math.exp(-0.02), abs=2e-3)
    # Lag of the force that is present in the 20th step: the fast half decays by a fifth in each of
    # ten integration steps, and the other half creeps.
    quick, slow = (
        np.sum(0.8 ** np.arange(1, 100)) / 10.0,
        1000.0 * (1.0 - math.exp(-0.02)) - 20.0 * math.exp(-0.0195),
    )
    assert response.lag == pytest.approx(0.5 * (quick + slow) / response.at_rest, abs=0.005)


# evidence

SEEDS = range(4)


def results(lost, matched=0.02, generic=None):
    """Yield rows of runs.csv in which ideal-trained policies lose `lost(axis, severity)`."""

    def row(task, trained, tested, loss):
        for seed in SEEDS:
            score = 1.0 - loss + 0.001 * (-1) ** seed
            yield {
                "task": task,
                "trained": trained,
                "tested": tested,
                "seed": str(seed),
                "score": str(score),
                "success": "1.0",
            }

    for task in REFERENCE_SPEEDS:
        yield from row(task, "ideal", "ideal", 0.0)
        for axis, bounds_at in AXES.items():
            for severity in bounds_at.severities:
                yield from row(task, "ideal", f"{axis} {severity:g}", lost(axis, severity))
            if task in bounds_at.training_severity:
                yield from row(task, axis, f"{axis} {bounds_at.training_severity[task]:g}", matched)
                if generic is not None:
                    yield from row(
                        task, "random", f"{axis} {bounds_at.training_severity[task]:g}", generic
                    )


def proportional(axis, severity):
    """Return half of the span at the largest severity, and proportionally less below it."""
    return 0.5 * severity / AXES[axis].severities[-1]


@pytest.fixture(scope="module")
def rows():
    return list(results(proportional))


@pytest.fixture(scope="module")
def evidence(rows):
    return Evidence(rows)


@pytest.mark.parametrize("axis", AXES)
def test_losses_are_interpolated_policy_by_policy_between_named_tests(axis):
    """Policy 0 loses twice as much as policy 1 at every severity."""
    tested = AXES[axis].severities
    rows = [
        {
            **row,
            "score": str(
                1.0 - (2 - int(row["seed"])) * proportional(axis, float(row["tested"].split()[-1]))
            ),
        }
        for row in results(proportional)
        if row["tested"].startswith(f"{axis} ")
        and row["seed"] in "01"
        and row["trained"] == "ideal"
    ]
    baseline = [row for row in results(proportional) if row["tested"] == "ideal"]
    middle = (tested[1] + tested[2]) / 2
    evidence = Evidence([*baseline, *rows])
    loss = evidence.loss("acrobot", axis, middle)
    if axis in SUDDEN:  # Only bounded, by the two tests.
        for outcome, severity in ((loss.lower, tested[1]), (loss.outcome, tested[2])):
            expected = evidence.loss("acrobot", axis, severity).outcome.lost
            assert outcome.lost == pytest.approx(expected, abs=1e-12)
        return
    assert loss.lower is loss.outcome
    extra = 0.0 if AXES[axis].motor_at_zero else 0.001  # of the test without it
    expected = [2 * proportional(axis, middle), proportional(axis, middle)]
    assert loss.outcome.lost == pytest.approx(
        np.array(expected) + np.array([extra, -extra]), abs=1e-12
    )
    assert loss.between == tuple(sorted(f"{axis} {severity:g}" for severity in tested[1:3]))
    assert not loss.beyond


@pytest.mark.parametrize("axis", AXES)
def test_beyond_the_tested_severities_the_largest_loss_is_a_lower_bound(evidence, axis):
    tested = AXES[axis].severities
    beyond = evidence.loss("acrobot", axis, 2 * tested[-1])
    assert beyond.beyond
    assert beyond.outcome.loss.mean == pytest.approx(0.5)
    assert not evidence.loss("acrobot", axis, tested[-1]).beyond
    assert evidence.loss("acrobot", axis, 0.0).outcome.loss == (0.0, 0.0, 0.0)


def test_an_outcome_has_student_s_interval_and_counts_failures():
    lost = np.array([0.0, 0.0, 0.02, 0.4])
    outcome = Outcome(lost, np.zeros(4))
    low, high = stats.t.interval(0.95, 3, np.mean(lost), stats.sem(lost))
    assert outcome.loss == pytest.approx([np.mean(lost), low, high], rel=1e-12)
    assert outcome.failed == 0.25
    assert outcome.summary()["median"] == pytest.approx(0.01)
    assert outcome.summary()["worst"] == 0.4
    assert not outcome.is_negligible
    assert not outcome.is_harmful


@pytest.mark.parametrize(
    ("lost", "missed", "is_negligible", "is_harmful"),
    [
        ([0.04] * 20, 0.0, True, False),
        ([0.06] * 20, 0.0, False, False),
        ([0.11] * 20, 0.0, False, True),
        ([0.0] * 18 + [0.3] * 2, 0.0, True, False),
        ([0.0] * 17 + [0.2] * 3, 0.0, False, False),  # The mean is 0.03, but three fail.
        ([0.0] * 20, 0.2, False, True),  # Only success is lost.
    ],
)
def test_mean_interval_failures_and_success_classify_an_outcome(
    lost, missed, is_negligible, is_harmful
):
    outcome = Outcome(np.array(lost), np.full(20, missed))
    assert (outcome.is_negligible, outcome.is_harmful) == (is_negligible, is_harmful)


# verdicts


def bounds_at(loss, policies=20):
    outcome = Outcome(loss + 0.001 * (-1.0) ** np.arange(policies), np.zeros(policies))
    return LossBounds(outcome, outcome)


def half_failing(loss, policies=20):
    """Return exact bounds with a mean loss, where ten policies lose nearly all and ten nothing."""
    lost = np.where(np.arange(policies) < policies // 2, 2.0 * loss - 0.02, 0.02)
    outcome = Outcome(lost + 0.001 * (-1.0) ** np.arange(policies), np.zeros(policies))
    return LossBounds(outcome, outcome)


def noisy(loss, missed, policies=20):
    outcome = Outcome(np.full(policies, loss), np.full(policies, missed))
    return LossBounds(outcome, outcome)


UNKNOWN = LossBounds(None, None)


@pytest.mark.parametrize(
    ("options", "verdict"),
    [
        ({IDEAL: bounds_at(0.03)}, IDEAL),
        ({IDEAL: bounds_at(0.5), LOOP: bounds_at(0.04), THROUGH: bounds_at(0.0)}, LOOP),
        ({IDEAL: bounds_at(0.5), RANDOMIZE: bounds_at(0.04), THROUGH: bounds_at(0.0)}, RANDOMIZE),
        ({IDEAL: bounds_at(0.5), RANDOMIZE: bounds_at(0.2), THROUGH: bounds_at(0.04)}, THROUGH),
        (
            {IDEAL: bounds_at(0.5), RANDOMIZE: half_failing(0.24), THROUGH: half_failing(0.2)},
            RANDOMIZE,
        ),  # As good, with less effort.
        (
            {IDEAL: bounds_at(0.5), RANDOMIZE: half_failing(0.45), THROUGH: half_failing(0.2)},
            THROUGH,
        ),  # A partial remedy.
        (
            {IDEAL: bounds_at(0.98), COMMAND: bounds_at(0.88), THROUGH: bounds_at(0.5)},
            BUY,
        ),  # All win much, and every policy still fails.
        (
            {IDEAL: half_failing(0.15), THROUGH: bounds_at(0.06)},
            THROUGH,
        ),  # The two intervals are closer than the margin; that of the difference is decisive.
        (
            {IDEAL: noisy(0.02, 0.8), SENSOR: bounds_at(0.0), RANDOMIZE: noisy(0.0, 0.8)},
            SENSOR,
        ),  # Success decides.
        (
            {IDEAL: LossBounds(bounds_at(0.3).upper, bounds_at(0.0).lower), LOOP: bounds_at(0.0)},
            MEASURE,
        ),  # It is not known whether anything must be done.
        ({IDEAL: bounds_at(0.5), RANDOMIZE: bounds_at(0.48), THROUGH: bounds_at(0.47)}, BUY),
        ({IDEAL: bounds_at(0.5), RANDOMIZE: UNKNOWN, THROUGH: bounds_at(0.47)}, MEASURE),
        ({IDEAL: bounds_at(0.5), THROUGH: UNKNOWN}, MEASURE),
        (
            {IDEAL: bounds_at(0.5), THROUGH: LossBounds(None, bounds_at(0.2).lower)},
            BUY,
        ),  # Both surely lose too much.
        (
            {IDEAL: bounds_at(0.5), THROUGH: LossBounds(None, bounds_at(0.07).lower)},
            MEASURE,
        ),
        (
            {IDEAL: LossBounds(None, bounds_at(0.0).lower), THROUGH: UNKNOWN},
            MEASURE,
        ),  # Beyond the tests, which cost nothing.
    ],
)
def test_decide_follows_its_rule(options, verdict):
    assert decide(options) == verdict


def test_verdicts_of_lags_and_loops(evidence):
    step = find_task("pendulum").step_duration
    assert advise(Lag(0.0), "pendulum", evidence).verdict == IDEAL
    assert advise(Lag(2 * step), "pendulum", evidence).verdict == THROUGH  # This loses only 0.02.
    assert (
        advise(Lag(3 * step), "pendulum", evidence).verdict == MEASURE
    )  # More lag than in training.
    untested = advise(Lag(3 * find_task("cartpole").step_duration), "cartpole", evidence)
    assert (untested.verdict, untested.options[THROUGH]) == (MEASURE, UNKNOWN)
    random = [
        {**row, "trained": "random", "score": "0.99"}
        for row in evidence.rows
        if row["tested"] == "lag 4"
    ]
    randomized = advise(
        Lag(3 * find_task("cartpole").step_duration),
        "cartpole",
        Evidence([*evidence.rows, *random]),
    )
    assert randomized.verdict == RANDOMIZE  # A test with more lag cost 0.01.
    assert randomized.options[RANDOMIZE].upper.loss.mean == pytest.approx(0.01, abs=2e-3)
    late = advise(named_actuator("weaker", "pendulum"), "pendulum", evidence)
    assert late.verdict == LOOP
    assert late.options[LOOP].upper.loss.mean < 0.05
    assert "with this option 0.0" in late.reason


def test_randomization_is_preferred_if_it_is_as_good():
    evidence_ = Evidence(list(results(proportional, generic=0.03)))
    lag = Lag(2 * find_task("pendulum").step_duration)
    assert advise(lag, "pendulum", evidence_).verdict == RANDOMIZE


def test_buying_requires_that_every_option_failed_at_most_as_severe_conditions():
    hopeless = Evidence(list(results(proportional, matched=0.4, generic=0.42)))

    def at_most(share):
        drive = drive_on_supply("pendulum", 100.0)
        limited = dataclasses.replace(
            drive.controller, max_current=share * drive.controller.max_current
        )
        return advise(dataclasses.replace(drive, controller=limited), "pendulum", hopeless)

    assert at_most(0.45).verdict == BUY
    assert at_most(0.45).options[THROUGH].lower.loss.mean == pytest.approx(0.4)
    assert at_most(0.8).verdict == MEASURE  # Less is missing than in training.


def test_losses_of_several_axes_are_added(evidence):
    step = find_task("pendulum").step_duration
    lag, weak, both = (
        advise(actuator, "pendulum", evidence).options[IDEAL].upper.loss.mean
        for actuator in (Lag(step), Lag(0.0, gain=0.9), Lag(step, gain=0.9))
    )
    assert both == pytest.approx(lag + weak, abs=2e-3)


def test_the_tests_of_a_drive_itself_are_used():
    """Weakness costs ideal-trained policies 0.5, and those trained on the marginal motor 0.02."""
    rows = list(results(lambda axis, severity: 0.5 * (axis == "weakness" and severity > 0)))
    motor = [
        {
            "task": "pendulum",
            "trained": trained,
            "tested": "marginal motor",
            "seed": seed,
            "score": score,
            "success": "1",
        }
        for trained, score in (("ideal", "0.5"), ("marginal motor", "0.98"))
        for seed in SEEDS
    ]
    actuator = study_env("pendulum", REAL["pendulum"]["marginal motor"]).actuator
    tested = Evidence([*rows, *motor])
    assert advise(actuator, "pendulum", tested).options[THROUGH].upper.loss.mean == pytest.approx(
        0.02
    )
    assert advise(actuator, "pendulum", tested).verdict == THROUGH
    assert advise(actuator, "pendulum", tested.without("marginal motor")).verdict == MEASURE


def test_a_larger_command_compensates_the_losses_of_a_gear(evidence):
    """The gear has an efficiency of 80 %, and its motor spare current for 1.25 times the force."""
    drive = drive_on_supply("pendulum", 100.0)
    limit = dataclasses.replace(drive.controller, max_current=2.0 * drive.controller.max_current)
    lossy = dataclasses.replace(
        drive, motor=dataclasses.replace(drive.motor, gear_efficiency=0.8), controller=limit
    )
    advice = advise(lossy, "pendulum", evidence)
    assert advice.response.at_rest == pytest.approx(0.8, abs=1e-3)
    assert (advice.verdict, "by 1.25" in advice.reason) == (COMMAND, True)
    short = dataclasses.replace(lossy, controller=drive.controller)  # No spare current.
    advice = advise(short, "pendulum", evidence)
    assert advice.options[COMMAND].lower.loss.mean == pytest.approx(
        advice.options[IDEAL].lower.loss.mean, abs=0.01
    )


def test_an_untested_severity_without_tested_loss_is_to_be_measured():
    harmless = Evidence(
        list(
            results(
                lambda axis, severity: 0.0 if axis == "weakness" else proportional(axis, severity)
            )
        )
    )
    drive = drive_on_supply("acrobot", 100.0)
    limited = dataclasses.replace(drive.controller, max_current=0.1 * drive.controller.max_current)
    advice = advise(dataclasses.replace(drive, controller=limited), "acrobot", harmless)
    assert (advice.verdict, advice.options[IDEAL].upper) == (MEASURE, None)
    assert "at least 0.00" in advice.reason


def test_excess_force_is_not_called_negligible(evidence):
    assert advise(Lag(0.0, gain=3.0), "pendulum", evidence).verdict == MEASURE


def test_a_force_without_command_is_not_called_negligible(evidence):
    """With a sensor offset of 0.1 A, a loop with an integrator settles at -0.1 A."""
    paper = named_actuator("paper", "pendulum")
    biased = dataclasses.replace(
        paper, controller=dataclasses.replace(paper.controller, current_bias=0.1)
    )
    advice = advise(biased, "pendulum", evidence)
    assert (advice.verdict, "at a command of zero" in advice.reason) == (MEASURE, True)
    share = (
        0.1 * paper.motor.torque_constant / paper.motor.arm_radius / find_task("pendulum").max_force
    )
    assert advice.response.unasked == pytest.approx(share, rel=0.05)


def test_the_largest_tested_severity_is_not_beyond_the_tests(evidence):
    advice = advise(
        AXES["supply"].make_env("acrobot", AXES["supply"].severities[-1]).actuator,
        "acrobot",
        evidence,
    )
    assert not any(loss.beyond for loss in advice.losses)


def test_ringing_counts_as_lag(evidence):
    """Poles of 0.9 rad a step with damping 0.1 overshoot by exp(-pi*0.1/sqrt(0.99)) = 73 %."""
    speed = 0.9 / find_task("pendulum").step_duration
    loop = CurrentLoop(kp=0.0, ki=speed**2, max_voltage=1e6, substeps=100)
    advice = advise(DCMotorActuator(Motor(0.2 * speed, 1.0, 1.0, 1.0), loop), "pendulum", evidence)
    assert advice.response.lag > 1.0
    assert advice.verdict != IDEAL


def test_a_detuned_drive_is_advised_to_design_its_loop(evidence):
    drive = drive_on_supply("pendulum", 100.0)
    slow = dataclasses.replace(drive.controller, bandwidth=0.3)
    assert advise(dataclasses.replace(drive, controller=slow), "pendulum", evidence).verdict == LOOP
    well = advise(drive, "pendulum", evidence)
    assert (LOOP in well.options, well.verdict) == (False, IDEAL)


def test_a_designed_loop_keeps_the_supply_and_is_not_offered_for_sensor_errors(evidence):
    paper = named_actuator("paper", "pendulum")
    sagging = dataclasses.replace(paper, supply=Supply(5.0, 0.3))
    assert redesign_loop(sagging, "pendulum").supply == Supply(5.0, 0.3)
    noisy = dataclasses.replace(
        paper, controller=dataclasses.replace(paper.controller, current_noise=0.1)
    )
    assert redesign_loop(noisy, "pendulum") is None
    assert LOOP not in advise(noisy, "pendulum", evidence).options


def test_without_results_there_is_no_verdict():
    advice = advise(Lag(1.0), "cartpole", Evidence([]))
    assert advice.verdict is None
    assert "measure" in advice.reason


# published evidence


@pytest.fixture(scope="module")
def published():
    return Evidence.read()


def without_anti_windup(task, severity):
    drive = drive_on_supply(task, (1.0 - severity) * needed_voltage(task))
    loop = dataclasses.replace(drive.controller, anti_windup="none")
    return dataclasses.replace(drive, controller=loop)


def test_gains_are_the_intervals_of_welch_and_of_pairs():
    random = np.random.default_rng(0)
    low, high = (Outcome(random.normal(m, 0.1, 20), np.zeros(20)) for m in (0.1, 0.3))
    for paired, test in ((False, stats.ttest_ind), (True, stats.ttest_rel)):
        options = {} if paired else {"equal_var": False}
        interval = test(high.lost, low.lost, **options).confidence_interval(0.95)
        gain = gains(low, high, paired)["loss"]
        assert gain == pytest.approx([np.mean(high.lost - low.lost), *interval], rel=1e-9)
    assert (is_better(low, high), is_better(high, low)) == (True, False)
    assert not is_better(Outcome(np.full(20, 0.2), np.zeros(20)), high)  # Every policy fails.


@pytest.mark.parametrize(
    ("severity", "verdict"), [(0.35, LOOP), (0.6, LOOP), (0.7, LOOP), (0.25, MEASURE), (0.2, IDEAL)]
)
def test_a_saturating_drive_without_anti_windup_is_trained_on_ideal_only_where_it_was_harmless(
    severity, verdict, published
):
    """Measured on Furuta: 0.00 is lost at 20 %, and 0.19 at 35 %, where 4 of 20 policies fail."""
    drive = without_anti_windup("furuta", severity)
    assert advise(drive, "furuta", published).verdict == verdict
    unknown = Evidence(row for row in published.rows if "winding up" not in row["tested"])
    advice = advise(drive, "furuta", unknown)
    assert advice.options[IDEAL].upper is None
    assert advice.verdict != IDEAL
    with_anti_windup = AXES["supply"].make_env("furuta", severity).actuator
    assert WIND_UP not in {loss.axis for loss in advise(with_anti_windup, "furuta", unknown).losses}


def test_noise_of_the_current_sensor_is_named_with_the_success_that_decides(published):
    """On Pendulum, policies lose 0.03 of the score, and 83 % of their success."""
    drive = AXES["noise"].make_env("pendulum", 0.8).actuator
    advice = advise(drive, "pendulum", published)
    outcome = advice.options[IDEAL].upper
    assert (advice.verdict, outcome.loss.mean < 0.05) == (SENSOR, True)
    assert f"{100 * outcome.success_lost.mean:.0f} % less success" in advice.reason
    assert "current sensor" in advice.reason
    exact = dataclasses.replace(
        drive, controller=dataclasses.replace(drive.controller, current_noise=0.0)
    )
    assert fix_sensor(drive) == exact
    assert fix_sensor(exact) is None


def test_a_difference_is_decisive_where_the_two_intervals_are_closer_than_the_margin(published):
    """On Furuta with 60 % of the voltage missing, training through it saves 5 of 20 policies."""
    drive = AXES["supply"].make_env("furuta", 0.6).actuator
    advice = advise(drive, "furuta", published)
    ideal_trained, through = advice.options[IDEAL].lower, advice.options[THROUGH].upper
    assert through.loss.high > ideal_trained.loss.low - 0.05
    assert (advice.verdict, "not tested" in advice.reason) == (THROUGH, False)
    assert "25 % fewer failures" in advice.reason


@pytest.mark.parametrize("severity", [0.25, 0.35])
def test_randomizing_is_judged_by_the_ranges_that_are_printed(severity, published):
    """The first study's arm has other ranges: it is not evidence for those that are printed."""
    axis = {0.25: "weakness", 0.35: "supply"}[severity]
    requested = dict.fromkeys(AXES, 0.0) | {axis: severity}
    bounds = option_bounds(published, "pendulum", requested)
    printed = published.outcome("pendulum", "random", f"{axis} {severity:g}")
    assert bounds[RANDOMIZE].upper.loss.mean == pytest.approx(printed.loss.mean, abs=1e-12)
    advice = advise(Lag(0.05), "pendulum", published)
    assert advice.verdict == RANDOMIZE
    for text in ("time_constant=uniform(0", "delay=uniform(0", "gain=uniform(0.9, 1.1)"):
        assert text in advice.command


@pytest.mark.matrix
def test_the_printed_training_runs(tmp_path, published, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = re.sub(r"--total-steps \d+", "--total-steps 64", random_training("furuta"))
    assert cli.main(shlex.split(command)[1:]) == 0
    assert (tmp_path / "runs" / "random" / "config.json").is_file()


def test_a_remedy_with_which_every_policy_fails_is_not_the_answer(tmp_path, capsys):
    """A larger command wins 0.10 of the span, and 20 of 20 policies still fail."""
    motor = tmp_path / "servo.toml"
    motor.write_text(SERVO)
    assert cli.main(["advise", str(motor), "pendulum"]) == 0
    answer = " ".join(capsys.readouterr().out.partition(f"{BUY}: ")[2].split())
    assert "20 of 20 fail" in answer
    assert f"{COMMAND} wins 0.10, but every policy still fails" in answer


def test_the_published_answers_on_every_drive_with_rows_are_those_on_the_page():
    """There are 16 motors and loops, 8 variants of a loop and 30 drives without anti-windup."""
    root = Path(__file__).parents[2] / "docs"
    rows = read_csv(root / "results" / "actuators" / "advised.csv")
    page = (root / "advise.md").read_text()
    results = (root / "results" / "actuators.md").read_text()
    further = [row["judged"] for row in rows if row["kind"] != "motors and loops"]
    counts = [further.count(name) for name in ("right", "says nothing", "not tested", "wrong")]
    assert (len(rows), len(further), counts[-1]) == (54, 38, 0)
    judged = [row["judged"] for row in rows]
    right, silent, untested = (
        judged.count(name) for name in ("right", "says nothing", "not tested")
    )
    assert f"right for {right}" in page
    assert f"*measure it* for {silent}" in page
    assert f"not tested there for {untested}" in page
    for kind in {row["kind"] for row in rows}:
        answers = [row["judged"] for row in rows if row["kind"] == kind]
        cells = (answers.count(name) for name in ("right", "wrong", "not tested", "says nothing"))
        assert f"| {len(answers)} {kind} | {' | '.join(map(str, cells))} |" in results
    right, wrong, untested, silent = re.search(
        r"\| 180 severities of one effect \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|", results
    ).groups()
    assert f"{right} right, {wrong} wrong, {untested} not tested and {silent}" in page


# measured


@pytest.mark.parametrize(
    ("ideal", "designed", "randomized", "through", "verdict"),
    [
        (0.97, 1.0, 1.0, 1.0, IDEAL),
        (0.5, 0.96, 1.0, 1.0, LOOP),
        (0.5, 0.6, 0.96, 0.97, RANDOMIZE),
        (0.5, 0.6, 0.6, 0.96, THROUGH),
        (0.5, 0.6, 0.6, 0.7, BUY),  # Every policy still fails.
        (0.5, 0.92, 0.6, 0.91, LOOP),
        (0.5, 0.6, 0.6, 0.92, THROUGH),
        (0.5, 0.54, 0.52, 0.52, BUY),
    ],
)
def test_the_verdict_of_a_measurement(tmp_path, ideal, designed, randomized, through, verdict):
    measurement = plan_measurement(named_actuator("weaker", "cartpole"), "cartpole", 4, tmp_path)

    def score(trial, seed):
        level = {"cartpole: through it": through, "cartpole: generic": randomized}.get(
            trial.arm.name
        )
        level = (
            {"ideal": 1.0, "designed": designed}.get(trial.test, ideal) if level is None else level
        )
        return FLOORS["cartpole"] + 200.0 * (level + 0.001 * (-1) ** seed)

    pretend(measurement.grid, score)
    options = measurement.loss_bounds(measurement.grid.collect())
    assert decide(options) == verdict
    scores = [1.0 - options[name].upper.loss.mean for name in (IDEAL, LOOP, RANDOMIZE, THROUGH)]
    assert scores == pytest.approx([ideal, designed, randomized, through])
    # Four policies at +-0.001 around the mean: Student's t with three degrees of freedom.
    mean, low, _ = options[LOOP].upper.loss
    assert mean - low == pytest.approx(3.18245 * 0.001 * math.sqrt(4 / 3) / 2, rel=1e-4)


@pytest.mark.parametrize("task", ["cartpole", "pendulum"])
def test_measurements_use_the_study_s_environments(task, tmp_path):
    """The rewards are those of the study's floors: on CartPole the paper's."""
    measurement = plan_measurement("weaker", task, 2, tmp_path)
    assert measurement.baseline.env == study_env(task)
    assert {trial.env for trial in measurement.options.values()} == {
        study_env(task, "weaker"),
        study_env(task, redesign_loop(named_actuator("weaker", task), task)),
    }


def test_raises_if_a_measurement_is_not_finished(tmp_path):
    measurement = plan_measurement(named_actuator("weaker", "cartpole"), "cartpole", 2, tmp_path)
    pretend(measurement.grid, lambda *_: 100.0, leaving_out=[("cartpole: through it", 1)])
    with pytest.raises(ValueError, match=r"1 of the measurement's trainings and tests are missing"):
        measurement.loss_bounds(measurement.grid.collect())


def test_a_run_is_measured_with_its_environment_agent_and_budget(tmp_path):
    config = TrainConfig.preset(
        "cartpole", "ppo", total_steps=3000, env={"inner_steps": 20, "actuator": "weak"}
    )
    write_json(tmp_path / "run" / "config.json", {"train": config.as_mapping()})
    measurement = plan_measurement("weaker", str(tmp_path / "run"), 2, tmp_path)
    for arm in measurement.grid.arms:
        assert (arm.config.total_steps, arm.config.env.inner_steps) == (3000, 20)
    assert measurement.baseline.env.actuator == IDEAL_ACTUATOR
    assert measurement.options[THROUGH].env.actuator == named_actuator("weaker", "cartpole")


@pytest.mark.matrix
def test_a_third_party_environment_is_measured_relative_to_its_random_actions(tmp_path, capsys):
    config = TrainConfig.preset("InvertedPendulum-v5", "ppo", total_steps=4096, num_envs=2)
    write_json(tmp_path / "run" / "config.json", {"train": config.as_mapping()})
    words = [
        "advise",
        "lag",
        str(tmp_path / "run"),
        "--measure",
        "2",
        "--root",
        str(tmp_path / "runs"),
        "--json",
    ]
    assert cli.main(words) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["advice"] is None
    assert set(content["measured"]["options"]) == {IDEAL, THROUGH}
    assert content["measured"]["options"][IDEAL]["most"]["policies"] == 2


# the command line


def test_a_measurement_without_a_number_has_ten_policies_and_says_what_they_bound(
    tmp_path, file, capsys
):
    """1 - 0.05^(1/10) = 26 %."""
    measurement = plan_measurement("weaker", "cartpole", 10, tmp_path / "runs")
    pretend(measurement.grid, lambda _, seed: 100.0 + seed)
    words = ["advise", "weaker", "cartpole", "--evidence", str(file), "--measure"]
    assert cli.main([*words, "--root", str(tmp_path / "runs")]) == 0
    shown = capsys.readouterr().out
    assert "10 policies of each kind" in shown
    assert "If none of 10 policies fails, up to 26% may fail" in shown


@pytest.fixture
def file(tmp_path, rows):
    path = tmp_path / "runs.csv"
    with path.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


def test_the_command_line_reports_evidence_and_measurement(tmp_path, file, capsys):
    measurement = plan_measurement("weaker", "cartpole", 2, tmp_path / "runs")
    pretend(measurement.grid, lambda _, seed: 100.0 + seed)
    words = ["advise", "weaker", "cartpole", "--evidence", str(file), "--measure", "2"]
    words += ["--root", str(tmp_path / "runs")]
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert f"{LOOP}: policies trained on ideal forces lose " in shown
    assert f"measured: {IDEAL}" in shown
    assert cli.main([*words, "--json"]) == 0
    content = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert content["advice"]["verdict"] == LOOP
    assert content["advice"]["losses"][0]["axis"] == "lag"
    assert content["measured"]["options"][IDEAL]["most"]["loss"]["mean"] == pytest.approx(0.0)


@pytest.mark.parametrize("value", ["nan", "inf", "much"])
def test_raises_if_the_evidence_has_no_number(tmp_path, file, value):
    lines = file.read_text().splitlines()
    cells = lines[2].split(",")
    cells[lines[0].split(",").index("score")] = value
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("\n".join([lines[0], lines[1], ",".join(cells), *lines[3:]]) + "\n")
    with pytest.raises(
        ValueError, match=rf"wrong.csv, line 3: score = '{value}': must be a finite number"
    ):
        Evidence.read(wrong)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["papr", "cartpole"], "did you mean 'paper'"),
        (["paper", "cartpol"], "did you mean 'cartpole'"),
        (["paper", "cartpole", "--measure", "1"], "must be >= 2"),
        (["paper", "cartpole", "--evidence", "nowhere.csv"], "nowhere.csv"),
        (
            ["paper", "cartpole", "--evidence", "docs/upright_tolerances.csv"],
            "has no column 'task'",
        ),
        (["ideal", "cartpole", "--measure", "2"], "actuator = 'ideal'"),
        (["maxon-dcx22l", "pendulum", "--gear-ratio", "0"], "gear_ratio = 0.0"),
        (["lag", "pendulum", "--voltage", "3"], "--voltage: "),
    ],
)
def test_bad_input_is_reported(words, message, capsys):
    assert cli.main(["advise", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("gear", "volts"), [(59.0, 9.0), (59.0, 3.0), (2.0, 9.0)])
def test_flags_set_the_gear_and_supply_of_a_motor(gear, volts, file, capsys):
    words = ["advise", "maxon-dcx22l", "pendulum", "--evidence", str(file), "--json"]
    assert cli.main([*words, "--gear-ratio", str(gear), "--voltage", str(volts)]) == 0
    content = json.loads(capsys.readouterr().out)["advice"]["found"]
    drive, force = (
        find_drive("maxon-dcx22l", gear_ratio=gear, voltage=volts),
        find_task("pendulum").max_force,
    )
    frictionless = dataclasses.replace(
        drive, motor=dataclasses.replace(drive.motor, coulomb_friction=0.0)
    )
    for name, speed in (("at_rest", 0.0), ("at_speed", REFERENCE_SPEEDS["pendulum"])):
        expected = min(
            float(torque_limits(frictionless, speed, drive.controller.max_current)[1]) / force, 1.0
        )
        assert content[name] == pytest.approx(expected, rel=2e-3), name
    assert content["friction"] == pytest.approx(
        gear * drive.motor.coulomb_friction / force, rel=1e-3
    )


def test_assumptions_about_a_motor_are_reported(file, capsys):
    assert (
        cli.main(
            ["advise", "maxon-dcx22l", "pendulum", "--gear-ratio", "59", "--evidence", str(file)]
        )
        == 0
    )
    assert "assumed, because not specified: controller.max_current = inf" in capsys.readouterr().out
