"""The study of what an actuator costs: what it trains, tests and concludes, on scores that a formula gives."""

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
from codrl_mj.study.axes import AXES, FLOORS, SECONDS, ideal_trial, ideal, needed_voltage, study_env
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.program import main
from codrl_mj.study.questions import Scores, Verdict, judge
from codrl_mj.tasks import find_task
from tests.study.pretended import pretend

RESULTS = Path(__file__).parents[2] / "docs/results"


def returns(score):
    """Mean returns of which the task's share is what a formula says: spans from the floor to a ceiling 100 above."""
    return lambda trial, seed: FLOORS[trial.arm.task] + 100.0 * score(trial, seed)


def noisy(level):
    """About a level, otherwise for every seed, and with ideal-trained policies at exactly 1 on the mean at home."""

    def score(trial, seed):
        return level(trial) + 0.02 * (-1.0) ** seed  # sums to 0 over an even number of seeds

    return score


def alone(root, **options):
    """The study in a folder, with nothing published."""
    return ActuatorStudy(root=root, out=root, **options)


def judged(grid):
    """The verdicts of the primary questions."""
    return judge(
        Scores(grid.collect(), FLOORS, [ideal_trial(ideal(task)) for task in SECONDS]),
        primary(),
        primary=True,
    )


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Matched training is worth 0.3 everywhere; every motor costs ideal-trained policies half of the span."""

    def level(trial):
        ideal_trial = trial.test in ("ideal", "designed", "good motor", "supply 0", "noise 0")
        if trial.arm.name.endswith(": ideal"):
            return 1.0 if ideal_trial else 0.5
        return 0.8

    grid = alone(tmp_path_factory.mktemp("runs"), seeds=6).grid
    pretend(grid, returns(noisy(level)))
    return grid


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=[] if task == "furuta" else pytest.mark.matrix) for task in SECONDS],
)
@pytest.mark.parametrize("axis", AXES)
def test_every_dose_is_an_environment_that_can_be_stepped(task, axis):
    for dose in AXES[axis].severities:
        env = AXES[axis].make_env(task, dose).make()
        env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
        env.close()


def test_doses_are_in_steps_of_the_policy_and_shares_of_the_force():
    for task in SECONDS:
        definition = find_task(task)
        assert AXES["lag"].make_env(task, 2.0).actuator == Lag(2.0 * definition.step_duration)
        assert (
            AXES["delay"].make_env(task, 3.0).disturbances.command_delay == 3.0 * definition.step_duration
        )
        assert AXES["friction"].make_env(task, 0.1).joint.friction == pytest.approx(
            0.1 * definition.max_force
        )
        supply = AXES["supply"].make_env(task, 0.35).actuator
        assert supply.supply.voltage == pytest.approx(0.65 * needed_voltage(task))
        stall = supply.motor.torque_constant * supply.controller.max_current
        assert stall == pytest.approx(definition.max_force)


def test_where_half_the_voltage_is_missing_the_stall_torque_is_just_the_largest():
    """U = 2*sqrt(F*w) of which half is R*F/k: what the motor of 1 ohm takes to hold the largest force."""
    for task in SECONDS:
        drive = AXES["supply"].make_env(task, 0.5).actuator
        stall = drive.motor.torque_constant * drive.supply.voltage / drive.motor.resistance
        assert stall == pytest.approx(find_task(task).max_force)


@pytest.mark.matrix
def test_no_dose_of_a_lag_is_ideal():
    env, same = study_env("pendulum").make(), AXES["lag"].make_env("pendulum", 0.0).make()
    for one in (env, same):
        one.reset(seed=3)
    for _ in range(20):
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], same.step(action)[0])


def test_the_plan_is_what_is_computed():
    """docs/results/plan.md counts arms, trainings and tests, and names the hypotheses and doses.

    What is explored beyond it tests more, and trains nothing else.
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
        doses = ", ".join(f"{dose:g}" for dose in axis.severities)
        trained = ", ".join(f"{axis.training_severity[task]:g}" for task in arms.TRAINED)
        assert f"| {doses} | {trained} |" in next(
            line for line in plan.splitlines() if line.startswith(f"| {name} |")
        )


def test_wrong_motors_differ_from_the_nominal_by_what_they_are_called():
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
def test_drawn_doses_end_at_the_dose_that_they_are_said_to(task, axis):
    """The distribution's ends are the fields of the environments of these doses."""
    (name, distribution), *rest = arms.drawn(task, axis).config.env.distributions.items()
    assert not rest
    of = operator.attrgetter(name)
    ends = [
        of(AXES[axis].make_env(task, dose).actuator)
        for dose in (0.0, arms.drawn_up_to(axis, AXES[axis].training_severity[task]))
    ]
    assert [distribution.low, distribution.high] == pytest.approx(sorted(ends), rel=1e-5)
    assert (
        AXES[axis].training_severity[task]
        < arms.drawn_up_to(axis, AXES[axis].training_severity[task])
        <= AXES[axis].severities[-1]
    )


def test_what_is_explored_is_one_thing_otherwise():
    """Nothing but anti-windup, or one number of the paper's actuator, or the integration step."""
    for task, pairs in windup().items():
        for planned, wound in pairs:
            drive = wound.env.actuator
            tracking = dataclasses.replace(drive.controller, anti_windup="back_calculation")
            assert dataclasses.replace(drive, controller=tracking) == planned.env.actuator
            assert (wound.arm.name, planned.env.timestep) == (f"{task}: ideal", wound.env.timestep)
    for task in arms.LOOPED:
        nominal = study_env(task, "paper")
        flat = {name: flattened(env.as_mapping()) for name, env in paper_loops(task).items()}
        changed = {
            name: {
                key for key, value in flattened(nominal.as_mapping()).items() if found[key] != value
            }
            for name, found in flat.items()
        }
        assert {len(keys) for name, keys in changed.items() if name != "feed-forward 0"} == {1}
        assert changed["feed-forward 0"] == (
            {"actuator.controller.kff"} if task == "cartpole" else set()
        )


def flattened(mapping, prefix=""):
    """Leaves of nested mappings by their path."""
    found = {}
    for name, value in mapping.items():
        path = f"{prefix}{name}"
        found |= flattened(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return found


def test_what_is_so_is_found(study):
    verdicts = {one.question.name: one for one in judged(study)}
    for name in ("P1", "P2", "P3", "P4", "P5", "P6", "P12"):
        assert verdicts[name].outcome == "yes"
        assert verdicts[name].effect.mean == pytest.approx(0.3)
        assert verdicts[name].runs == (6, 6)
    assert verdicts["P7"].outcome == "open"  # generic training scores as high
    assert verdicts["P8"].outcome == verdicts["P10"].outcome == verdicts["P11"].outcome == "yes"
    assert verdicts["P9"].effect.mean == pytest.approx(0.2)


def test_what_is_otherwise_is_said(tmp_path):
    def level(trial):
        matched = trial.arm.name in {f"{task}: lag" for task in arms.TRAINED}
        return 0.2 if matched else 1.0 if trial.test != "good motor" else 0.5

    grid = alone(tmp_path, seeds=6).grid
    pretend(grid, returns(noisy(level)))
    verdicts = {one.question.name: one for one in judged(grid)}
    assert verdicts["P1"].outcome == "the other way"
    assert verdicts["P11"].outcome == "no"
    assert verdicts["P11"].seeds_to_close(12) is None


@pytest.mark.parametrize(("kind", "mean", "seeds"), [("better", 0.05, 30), ("equivalent", 0.0, 27)])
def test_seeds_that_would_tell_find_it_as_often_as_power_says(kind, mean, seeds):
    """A run's standard deviation of 0.05, tested at the strictest of Holm's levels."""
    half = 0.05 * np.sqrt(2 / 20) * stats.t.ppf(0.975, 38)
    hypothesis = next(one for one in primary() if one.kind == kind)
    interval = Interval(mean, mean - half, mean + half)
    verdict = Verdict(hypothesis, (20, 20), (1, 1), interval, 0.2, 1.0)
    assert verdict.seeds_to_close(12) == seeds
    random = np.random.default_rng(0)
    one, other = (
        random.normal(mean, 0.05, (20_000, seeds)),
        random.normal(0.0, 0.05, (20_000, seeds)),
    )
    if kind == "better":
        found = stats.ttest_ind(one, other, axis=1).pvalue < 0.05 / 12
    else:
        found = stats.ttest_ind(one + 0.05, other, axis=1, alternative="greater").pvalue < 0.05 / 12
    assert found.mean() == pytest.approx(0.8, abs=0.02)


def test_policies_that_are_tested_in_several_contrasts_count_once(tmp_path):
    """P7 holds the same generic policies against six arms: its runs are policies' means over the six axes.

    And P10 the same policies on six motors: its pairs are means of their differences.
    """
    random = np.random.default_rng(0)
    own = random.normal(0.0, 0.1, 6)  # what a seed is better by, wherever it is tested

    def score(trial, seed):
        if trial.arm.name.endswith(("generic", "weaker")) and trial.test != "weaker":
            return 0.5 + own[seed]
        return 1.0 + 0.01 * (-1) ** seed

    grid = alone(tmp_path, tasks=("pendulum",), seeds=6).grid
    pretend(grid, returns(score))
    verdicts = {one.question.name: one for one in judged(grid)}
    matched = 1.0 + 0.01 * (-1.0) ** np.arange(6)
    for name, strata, test in (
        ("P7", (6, 12), stats.ttest_ind(matched, 0.5 + own, equal_var=False)),
        ("P10", (4, 8), stats.ttest_rel(0.5 + own, matched)),
    ):
        assert verdicts[name].strata == strata
        assert verdicts[name].runs == (6, 6)
        assert verdicts[name].effect[1:] == pytest.approx(test.confidence_interval(), rel=1e-9)


def test_nothing_is_concluded_from_nothing(tmp_path):
    grid = ActuatorStudy(root=tmp_path / "none", out=tmp_path / "out", tasks=("furuta",)).grid
    assert {one.outcome for one in judged(grid)} == {"not judged"}
    files = write(grid.collect(), tmp_path / "out")
    text = files[0].read_text()
    assert f"0 of {len(grid.cells)} trainings" in text
    assert "What is missing" in text


@pytest.mark.matrix
def test_the_page_says_which_doses_are_borne(tmp_path):
    """Up to half a step of lag costs 0.02, more of it 0.2, and nothing else anything."""

    def level(trial):
        axis, _, dose = trial.test.rpartition(" ")
        return 1.0 if axis != "lag" else 0.98 if float(dose) <= 0.5 else 0.8

    grid = alone(tmp_path / "runs", tasks=("pendulum",), seeds=4).grid
    pretend(grid, returns(noisy(level)))
    page = write(grid.collect(), tmp_path)[0].read_text()
    lag = "≤25, ≥50 ms (4)"  # of steps of 50 ms
    assert f"| {lag} | ≤70 % | ≤70 % | ≤200 ms | ≤0.6 N·m | ≤3.2 N·m |" in page
    assert "| CartPole: 20 ms, 10 N | – | – | – | – | – | – |" in page  # of which nothing is known


@pytest.mark.matrix
def test_the_page_has_every_number_in_a_file(study, tmp_path):
    files = {file.name: file for file in write(study.collect(), tmp_path)}
    rows = list(csv.DictReader(files["hypotheses.csv"].open()))
    assert len(rows) == len(primary()) + len(secondary())
    first = rows[0]
    page = files["actuators.md"].read_text()
    assert (
        f"{float(first['effect']):+.3f} [{float(first['low']):+.3f}, {float(first['high']):+.3f}]"
        in page
    )
    assert len(page.splitlines()) <= 190
    assert len(list(csv.DictReader(files["runs.csv"].open()))) == len(study.deployments)
    assert (
        sum(file.stat().st_size for name, file in files.items() if name.endswith(".svg")) < 500_000
    )
    assert f"({FOLDER}/chart.svg)" in page
    evidence = Evidence.read(files["runs.csv"])
    for task in SECONDS:
        for axis, described in AXES.items():
            assert evidence.loss(task, axis, described.severities[3]).outcome.loss.mean == pytest.approx(
                0.5
            )
    written = {name: file.read_bytes() for name, file in files.items()}
    again = {file.name: file.read_bytes() for file in write(study.collect(), tmp_path)}
    assert written == again


@pytest.mark.matrix
def test_from_the_command_line_a_small_study_is_computed_and_goes_on(tmp_path, monkeypatch, capsys):
    """One training and its tests, for a few steps; the second call trains nothing."""
    from actuator_study import study as module

    few = [one for one in module.trials() if one.arm.name == "mountain_car: ideal"][:2]
    monkeypatch.setattr(module, "trials", lambda: few)
    call = ["--root", str(tmp_path / "runs"), "--out", str(tmp_path / "out"), "--jobs", "1"]
    call += ["--tasks", "mountain_car", "--seeds", "1", "--episodes", "2", "--total-steps", "400"]
    assert main(ActuatorStudy, [*call, "--dry-run"]) == 0
    assert "mountain_car: ideal" in capsys.readouterr().out
    published = []
    monkeypatch.setattr(ActuatorStudy, "publish", lambda study: published.append(study.write()))
    assert main(ActuatorStudy, call) == 0
    assert len(published) == 1  # when all of the seed was computed
    run = next((tmp_path / "runs").glob("mountain_car-*/result.json"))
    before = run.stat().st_mtime_ns
    assert main(ActuatorStudy, call) == 0
    assert run.stat().st_mtime_ns == before
    assert len(published) == 1
    page = tmp_path / "out" / "actuators.md"
    assert "1 of 1 trainings" in page.read_text()
    shutil.rmtree(tmp_path / "runs")  # its rows stand for it
    written = page.read_bytes()
    assert main(ActuatorStudy, call) == 0
    assert page.read_bytes() == written
    assert not [*(tmp_path / "runs").glob("mountain_car-*")]
    assert (
        main(ActuatorStudy, [*call, "--total-steps", "500"]) == 0
    )  # of another configuration they do not
    assert [*(tmp_path / "runs").glob("mountain_car-*/result.json")]


@pytest.mark.matrix
def test_the_published_page_is_what_the_published_rows_say(tmp_path):
    """Byte for byte, with its tables and figures; no run folder is at hand."""
    for name in ("runs.csv", "totals.json"):
        (tmp_path / FOLDER).mkdir(exist_ok=True)
        shutil.copy(RESULTS / FOLDER / name, tmp_path / FOLDER)
    (tmp_path / "insurance").mkdir()  # what advice knows, too
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
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ActuatorStudy(**wrong)


@pytest.mark.parametrize("flag", ["--root", "--out"])
def test_what_cannot_be_written_is_refused_before_anything_is_computed(flag, tmp_path, capsys):
    (tmp_path / "file").touch()
    options = {"--root": tmp_path / "runs", "--out": tmp_path / "out"} | {
        flag: tmp_path / "file" / "inside"
    }
    assert main(ActuatorStudy, [*(str(word) for pair in options.items() for word in pair)]) == 2
    assert "file" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_stranger_recomputes_the_numbers_without_the_package():
    """In an interpreter that has nothing of ours: means and failures of the published trials."""
    example = RESULTS.parents[1] / "examples" / "recompute.py"
    run = [sys.executable, "-I", "-S", str(example), str(RESULTS / FOLDER / "runs.csv")]
    lines = subprocess.run(run, capture_output=True, text=True, check=True).stdout.splitlines()
    rows = list(csv.DictReader((RESULTS / FOLDER / "trials.csv").open()))
    trials = {(row["task"], row["trained"], row["tested"]): row for row in rows}
    assert len(lines) == 13
    for line in lines[1:]:
        task, axis, dose, *cells = line.replace(";", "").split()
        for trained, mean, failed in zip(
            ("ideal", "generic", axis), cells[::2], cells[1::2], strict=True
        ):
            found = trials[task, trained, f"{axis} {dose}"]
            assert float(mean) == pytest.approx(float(found["score"]), abs=6e-4)
            assert int(failed) == round(20 * float(found["failed"]))


def test_what_cannot_be_published_yet_stops_no_study(tmp_path, monkeypatch, capsys):
    study = ActuatorStudy(root=tmp_path, out=tmp_path)
    monkeypatch.setattr(
        ActuatorStudy, "write", lambda _: (_ for _ in ()).throw(ValueError("a damaged file"))
    )
    study.publish()
    assert capsys.readouterr().err == "not published yet: a damaged file\n"
