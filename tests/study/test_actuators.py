"""The study of actuators: its trainings, tests and conclusions, on scores from a formula."""

import csv
import dataclasses
import operator
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from actuator_study import arms
from actuator_study.exploration import paper_loops, windup
from actuator_study.page import FOLDER, PAGE, write
from actuator_study.questions import primary, secondary, trials, wrong_motors
from actuator_study.study import ActuatorStudy
from codrl_mj.actuators import Lag
from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.axes import (
    AXES,
    FLOORS,
    SECONDS,
    ideal_arm,
    ideal_trial,
    needed_voltage,
    study_env,
)
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.program import main
from codrl_mj.study.questions import Scores, Verdict, judge
from codrl_mj.tasks import find_task
from tests.study.pretended import pretend

RESULTS = Path(__file__).parents[2] / "docs/results"


def returns(score):
    """Return a score function with mean returns from a formula; every span is 100."""
    return lambda trial, seed: FLOORS[trial.arm.task] + 100.0 * score(trial, seed)


def noisy(level):
    """Add noise by seed to a level; ideal-trained policies have a mean of exactly 1."""

    def score(trial, seed):
        return level(trial) + 0.02 * (-1.0) ** seed  # The sum over an even number of seeds is 0.

    return score


def unpublished_study(root, **options):
    """Return the study in a folder without published rows."""
    return ActuatorStudy(root=root, out=root, **options)


def primary_verdicts(grid):
    """Return the verdicts of the primary questions."""
    return judge(
        Scores(grid.collect(), FLOORS, [ideal_trial(ideal_arm(task)) for task in SECONDS]),
        primary(),
        primary=True,
    )


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Return a study in which matched training gains 0.3 and every motor costs half of the span."""

    def level(trial):
        ideal_trial = trial.test in ("ideal", "designed", "good motor", "supply 0", "noise 0")
        if trial.arm.name.endswith(": ideal"):
            return 1.0 if ideal_trial else 0.5
        return 0.8

    grid = unpublished_study(tmp_path_factory.mktemp("runs"), seeds=6).grid
    pretend(grid, returns(noisy(level)))
    return grid


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=[] if task == "furuta" else pytest.mark.matrix) for task in SECONDS],
)
@pytest.mark.parametrize("axis", AXES)
def test_the_environment_of_every_severity_can_be_stepped(task, axis):
    for severity in AXES[axis].severities:
        env = AXES[axis].make_env(task, severity).build()
        env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
        env.close()


def test_severities_are_in_policy_steps_and_shares_of_the_largest_force():
    for task in SECONDS:
        definition = find_task(task)
        assert AXES["lag"].make_env(task, 2.0).actuator == Lag(2.0 * definition.step_duration)
        assert (
            AXES["delay"].make_env(task, 3.0).disturbances.command_delay
            == 3.0 * definition.step_duration
        )
        assert AXES["friction"].make_env(task, 0.1).joint.friction == pytest.approx(
            0.1 * definition.max_force
        )
        supply = AXES["supply"].make_env(task, 0.35).actuator
        assert supply.supply.voltage == pytest.approx(0.65 * needed_voltage(task))
        stall = supply.motor.torque_constant * supply.controller.max_current
        assert stall == pytest.approx(definition.max_force)


def test_half_of_the_voltage_gives_a_stall_torque_equal_to_the_largest_torque():
    """Half of U = 2*sqrt(F*w) is R*F/k, at which the 1 ohm motor holds the largest force."""
    for task in SECONDS:
        drive = AXES["supply"].make_env(task, 0.5).actuator
        stall = drive.motor.torque_constant * drive.supply.voltage / drive.motor.resistance
        assert stall == pytest.approx(find_task(task).max_force)


@pytest.mark.matrix
def test_a_lag_of_severity_zero_equals_the_ideal_actuator():
    env, lag_env = study_env("pendulum").build(), AXES["lag"].make_env("pendulum", 0.0).build()
    for env_to_reset in (env, lag_env):
        env_to_reset.reset(seed=3)
    for _ in range(20):
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], lag_env.step(action)[0])


def test_the_study_computes_what_the_plan_states():
    """docs/results/plan.md has the numbers of arms, trainings and tests, and all hypotheses.

    The exploration adds tests, but no trainings.
    """
    plan, planned = (RESULTS / "plan.md").read_text(), trials()
    grid = ActuatorStudy().grid
    assert set(planned) <= set(grid.trials)
    counts = len(grid.arms), len(grid.cells), len(planned) * 20
    assert (
        "{} arms, 20 seeds each: {} trainings, {} tests of {} episodes".format(
            *counts, grid.episodes
        )
        in plan
    )
    assert [hypothesis.name for hypothesis in primary()] == [
        f"P{number}" for number in range(1, 13)
    ]
    for name, axis in AXES.items():
        severities = ", ".join(f"{severity:g}" for severity in axis.severities)
        trained = ", ".join(f"{axis.training_severity[task]:g}" for task in arms.TRAINED)
        assert f"| {severities} | {trained} |" in next(
            line for line in plan.splitlines() if line.startswith(f"| {name} |")
        )


def test_detuned_motors_differ_from_the_nominal_one_as_their_names_state():
    nominal = study_env("pendulum", "weaker")
    motors = wrong_motors("pendulum")
    assert (
        motors["resistance -25 %"].actuator.motor.resistance
        == 0.75 * nominal.actuator.motor.resistance
    )
    assert motors["resistance -25 %"].actuator.controller == nominal.actuator.controller
    assert motors["friction 20 %"].joint.friction == pytest.approx(0.4)
    assert motors["friction 20 %"].actuator == nominal.actuator


@pytest.mark.parametrize("task", arms.TRAINED)
@pytest.mark.parametrize("axis", arms.DRAWN)
def test_random_severities_end_at_the_stated_severity(task, axis):
    """The ends of the distribution are the fields of the environments at these severities."""
    (name, distribution), *rest = arms.drawn(task, axis).config.env.distributions.items()
    assert not rest
    of = operator.attrgetter(name)
    ends = [
        of(AXES[axis].make_env(task, severity).actuator)
        for severity in (0.0, arms.drawn_up_to(axis, AXES[axis].training_severity[task]))
    ]
    assert [distribution.low, distribution.high] == pytest.approx(sorted(ends), rel=1e-5)
    assert (
        AXES[axis].training_severity[task]
        < arms.drawn_up_to(axis, AXES[axis].training_severity[task])
        <= AXES[axis].severities[-1]
    )


def test_each_exploration_changes_a_single_setting():
    """Only anti-windup, one number of the paper's actuator, or the integration step differs."""
    for task, pairs in windup().items():
        for planned, varied in pairs:
            drive = varied.env.actuator
            tracking = dataclasses.replace(drive.controller, anti_windup="back_calculation")
            assert dataclasses.replace(drive, controller=tracking) == planned.env.actuator
            assert (varied.arm.name, planned.env.timestep) == (
                f"{task}: ideal",
                varied.env.timestep,
            )
    for task in arms.LOOPED:
        nominal = study_env(task, "paper")
        flat = {name: flatten(env.as_mapping()) for name, env in paper_loops(task).items()}
        changed = {
            name: {
                key for key, value in flatten(nominal.as_mapping()).items() if fields[key] != value
            }
            for name, fields in flat.items()
        }
        assert {len(keys) for name, keys in changed.items() if name != "feed-forward 0"} == {1}
        assert changed["feed-forward 0"] == (
            {"actuator.controller.kff"} if task == "cartpole" else set()
        )


def flatten(mapping, prefix=""):
    """Return the leaves of nested mappings by path."""
    leaves = {}
    for name, value in mapping.items():
        path = f"{prefix}{name}"
        leaves |= flatten(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return leaves


def test_true_hypotheses_are_confirmed(study):
    verdicts = {verdict.question.name: verdict for verdict in primary_verdicts(study)}
    for name in ("P1", "P2", "P3", "P4", "P5", "P6", "P12"):
        assert verdicts[name].outcome == "yes"
        assert verdicts[name].effect.mean == pytest.approx(0.3)
        assert verdicts[name].runs == (6, 6)
    assert verdicts["P7"].outcome == "open"  # Generic training scores as high.
    assert verdicts["P8"].outcome == verdicts["P10"].outcome == verdicts["P11"].outcome == "yes"
    assert verdicts["P9"].effect.mean == pytest.approx(0.2)


def test_false_hypotheses_are_reported(tmp_path):
    def level(trial):
        matched = trial.arm.name in {f"{task}: lag" for task in arms.TRAINED}
        return 0.2 if matched else 1.0 if trial.test != "good motor" else 0.5

    grid = unpublished_study(tmp_path, seeds=6).grid
    pretend(grid, returns(noisy(level)))
    verdicts = {verdict.question.name: verdict for verdict in primary_verdicts(grid)}
    assert verdicts["P1"].outcome == "the other way"
    assert verdicts["P11"].outcome == "no"
    assert verdicts["P11"].seeds_to_close(12) is None


@pytest.mark.parametrize(("kind", "mean", "seeds"), [("better", 0.05, 30), ("equivalent", 0.0, 27)])
def test_the_recommended_number_of_seeds_has_the_stated_power(kind, mean, seeds):
    """Runs have a standard deviation of 0.05 and are tested at the strictest of Holm's levels."""
    half = 0.05 * np.sqrt(2 / 20) * stats.t.ppf(0.975, 38)
    hypothesis = next(question for question in primary() if question.kind == kind)
    interval = Interval(mean, mean - half, mean + half)
    verdict = Verdict(hypothesis, (20, 20), (1, 1), interval, 0.2, 1.0)
    assert verdict.seeds_to_close(12) == seeds
    random = np.random.default_rng(0)
    treatment, control = (
        random.normal(mean, 0.05, (20_000, seeds)),
        random.normal(0.0, 0.05, (20_000, seeds)),
    )
    if kind == "better":
        is_significant = stats.ttest_ind(treatment, control, axis=1).pvalue < 0.05 / 12
    else:
        is_significant = (
            stats.ttest_ind(treatment + 0.05, control, axis=1, alternative="greater").pvalue
            < 0.05 / 12
        )
    assert is_significant.mean() == pytest.approx(0.8, abs=0.02)


def test_policies_in_several_contrasts_count_once(tmp_path):
    """P7 compares the same generic policies with six arms, P10 on six motors.

    A sample of P7 is a policy's mean over six axes, one of P10 the mean of its differences.
    """
    random = np.random.default_rng(0)
    seed_offsets = random.normal(0.0, 0.1, 6)  # Advantage of a seed, the same in every test.

    def score(trial, seed):
        if trial.arm.name.endswith(("generic", "weaker")) and trial.test != "weaker":
            return 0.5 + seed_offsets[seed]
        return 1.0 + 0.01 * (-1) ** seed

    grid = unpublished_study(tmp_path, tasks=("pendulum",), seeds=6).grid
    pretend(grid, returns(score))
    verdicts = {verdict.question.name: verdict for verdict in primary_verdicts(grid)}
    matched = 1.0 + 0.01 * (-1.0) ** np.arange(6)
    for name, strata, test in (
        ("P7", (6, 12), stats.ttest_ind(matched, 0.5 + seed_offsets, equal_var=False)),
        ("P10", (4, 8), stats.ttest_rel(0.5 + seed_offsets, matched)),
    ):
        assert verdicts[name].strata == strata
        assert verdicts[name].runs == (6, 6)
        assert verdicts[name].effect[1:] == pytest.approx(test.confidence_interval(), rel=1e-9)


def test_without_results_no_question_is_judged(tmp_path):
    grid = ActuatorStudy(root=tmp_path / "none", out=tmp_path / "out", tasks=("furuta",)).grid
    assert {verdict.outcome for verdict in primary_verdicts(grid)} == {"not judged"}
    files = write(grid.collect(), tmp_path / "out")
    text = files[0].read_text()
    assert f"0 of {len(grid.cells)} trainings" in text
    assert "Missing results" in text


@pytest.mark.matrix
def test_the_page_states_which_severities_are_tolerated(tmp_path):
    """A lag of up to half a step costs 0.02, a longer one 0.2, and everything else nothing."""

    def level(trial):
        axis, _, severity = trial.test.rpartition(" ")
        return 1.0 if axis != "lag" else 0.98 if float(severity) <= 0.5 else 0.8

    grid = unpublished_study(tmp_path / "runs", tasks=("pendulum",), seeds=4).grid
    pretend(grid, returns(noisy(level)))
    page = write(grid.collect(), tmp_path)[0].read_text()
    lag = "≤25, ≥50 ms (4)"  # The policy step is 50 ms.
    assert f"| {lag} | ≤70 % | ≤70 % | ≤200 ms | ≤0.6 N·m | ≤3.2 N·m |" in page
    assert (
        "| CartPole: 20 ms, 10 N | – | – | – | – | – | – |" in page
    )  # The study has no results of this task.


@pytest.mark.matrix
def test_every_number_on_the_page_is_in_a_file(study, tmp_path):
    files = {file.name: file for file in write(study.collect(), tmp_path)}
    rows = list(csv.DictReader(files["hypotheses.csv"].open()))
    assert len(rows) == len(primary()) + len(secondary())
    first = rows[0]
    page = files["actuators.md"].read_text()
    assert (
        f"{float(first['effect']):+.3f} [{float(first['low']):+.3f}, {float(first['high']):+.3f}]"
        in page
    )
    # 54 of the lines are the actuators about which `advise` was asked.
    assert len(page.splitlines()) <= 230
    assert len(list(csv.DictReader(files["runs.csv"].open()))) == len(study.policy_tests)
    assert (
        sum(file.stat().st_size for name, file in files.items() if name.endswith(".svg")) < 500_000
    )
    assert f"({FOLDER}/chart.svg)" in page
    evidence = Evidence.read(files["runs.csv"])
    for task in SECONDS:
        for axis, described in AXES.items():
            assert evidence.loss(
                task, axis, described.severities[3]
            ).outcome.loss.mean == pytest.approx(0.5)
    written = {name: file.read_bytes() for name, file in files.items()}
    again = {file.name: file.read_bytes() for file in write(study.collect(), tmp_path)}
    assert written == again


@pytest.mark.matrix
def test_the_command_line_computes_and_continues_a_small_study(tmp_path, monkeypatch, capsys):
    """Compute one short training and its tests; the second call trains nothing."""
    from actuator_study import study as module

    few = [trial for trial in module.trials() if trial.arm.name == "mountain_car: ideal"][:2]
    monkeypatch.setattr(module, "trials", lambda: few)
    call = ["--root", str(tmp_path / "runs"), "--out", str(tmp_path / "out"), "--jobs", "1"]
    call += ["--tasks", "mountain_car", "--seeds", "1", "--episodes", "2", "--total-steps", "400"]
    assert main(ActuatorStudy, [*call, "--dry-run"]) == 0
    assert "mountain_car: ideal" in capsys.readouterr().out
    published = []
    monkeypatch.setattr(ActuatorStudy, "publish", lambda study: published.append(study.write()))
    assert main(ActuatorStudy, call) == 0
    assert len(published) == 1  # After the seed is complete.
    run = next((tmp_path / "runs").glob("mountain_car-*/result.json"))
    before = run.stat().st_mtime_ns
    assert main(ActuatorStudy, call) == 0
    assert run.stat().st_mtime_ns == before
    assert len(published) == 1
    page = tmp_path / "out" / "actuators.md"
    assert "1 of 1 trainings" in page.read_text()
    shutil.rmtree(tmp_path / "runs")  # The published rows replace the folder.
    written = page.read_bytes()
    assert main(ActuatorStudy, call) == 0
    assert page.read_bytes() == written
    assert not [*(tmp_path / "runs").glob("mountain_car-*")]
    assert (
        main(ActuatorStudy, [*call, "--total-steps", "500"]) == 0
    )  # Rows of another configuration do not replace it.
    assert [*(tmp_path / "runs").glob("mountain_car-*/result.json")]


@pytest.mark.matrix
def test_the_published_page_follows_from_the_published_rows(tmp_path):
    """Compare page, tables and figures byte for byte, without run folders."""
    for name in ("runs.csv", "totals.json"):
        (tmp_path / FOLDER).mkdir(exist_ok=True)
        shutil.copy(RESULTS / FOLDER / name, tmp_path / FOLDER)
    (tmp_path / "insurance").mkdir()  # Evidence that `advise` reads, too.
    shutil.copy(RESULTS / "insurance" / "runs.csv", tmp_path / "insurance")
    shutil.copy(RESULTS / "actuators_conclusions.md", tmp_path)
    files, failures = ActuatorStudy(root=tmp_path / "none", out=tmp_path).write()
    assert not failures
    assert {file.name for file in files} == {
        PAGE,
        *(file.name for file in (RESULTS / FOLDER).iterdir()),
    }
    for file in files:
        assert file.read_bytes() == (RESULTS / file.relative_to(tmp_path)).read_bytes(), file.name


@pytest.mark.parametrize(
    "wrong", [{"tasks": ("pendulm",)}, {"seeds": 0}, {"episodes": 1.5}, {"total_steps": True}]
)
def test_raises_if_an_argument_is_invalid(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ActuatorStudy(**wrong)


@pytest.mark.parametrize("flag", ["--root", "--out"])
def test_raises_before_computing_if_the_output_cannot_be_written(flag, tmp_path, capsys):
    (tmp_path / "file").touch()
    options = {"--root": tmp_path / "runs", "--out": tmp_path / "out"} | {
        flag: tmp_path / "file" / "inside"
    }
    assert main(ActuatorStudy, [*(str(word) for pair in options.items() for word in pair)]) == 2
    assert "file" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_the_example_recomputes_the_numbers_without_the_package():
    """Recompute means and failures of the published trials without the package."""
    example = RESULTS.parents[1] / "examples" / "recompute.py"
    run = [sys.executable, "-I", "-S", str(example), str(RESULTS / FOLDER / "runs.csv")]
    lines = subprocess.run(run, capture_output=True, text=True, check=True).stdout.splitlines()
    rows = list(csv.DictReader((RESULTS / FOLDER / "trials.csv").open()))
    trials = {(row["task"], row["trained"], row["tested"]): row for row in rows}
    assert len(lines) == 13
    for line in lines[1:]:
        task, axis, severity, *cells = line.replace(";", "").split()
        for trained, mean, failed in zip(
            ("ideal", "generic", axis), cells[::2], cells[1::2], strict=True
        ):
            row = trials[task, trained, f"{axis} {severity}"]
            assert float(mean) == pytest.approx(float(row["score"]), abs=6e-4)
            assert int(failed) == round(20 * float(row["failed"]))


def test_a_failing_publication_does_not_stop_the_study(tmp_path, monkeypatch, capsys):
    study = ActuatorStudy(root=tmp_path, out=tmp_path)
    monkeypatch.setattr(
        ActuatorStudy, "write", lambda _: (_ for _ in ()).throw(ValueError("a damaged file"))
    )
    study.publish()
    assert capsys.readouterr().err == "not published yet: a damaged file\n"
