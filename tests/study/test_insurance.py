"""The study of robust training: its actuator against the package's, its arms and its page."""

import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from actuator_study.arms import DRAWN
from actuator_study.by_task import judge_by_task
from actuator_study.study import ActuatorStudy
from codrl_mj.actuators import Lag
from codrl_mj.disturbances import Disturbances
from codrl_mj.study.axes import (
    AXES,
    FLOORS,
    RANDOM_RANGES,
    ideal_arm,
    ideal_trial,
    random_arm,
    study_env,
    timestep,
)
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.pages import read_csv, write_csv
from codrl_mj.study.questions import Scores, judge
from codrl_mj.study.trials import Grid
from codrl_mj.tasks import find_task
from insurance_study.learning import still_rising
from insurance_study.page import PLANNED
from insurance_study.questions import (
    HARMLESS,
    REMEMBERED,
    SEVERITIES,
    TASKS,
    double,
    generic,
    half,
    late,
    needs_new_policies,
    primary,
    reach,
    secondary,
    trials,
)
from insurance_study.study import InsuranceStudy
from tests.study.pretended import pretend

RESULTS = Path(__file__).parents[2] / "docs/results"


def play(config, actions):
    """Return observations without the actuator's entries, and all of them, for given actions."""
    env = config.build()
    observations = [env.reset(seed=3)[0]]
    observations += [env.step(action)[0] for action in actions]
    env.close()
    return np.array(observations)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("steps", [0.0, 0.25, 0.8])
@pytest.mark.parametrize("lag", [0.0, 0.7])
def test_late_equals_lag_if_the_delay_fits_into_lag(task, steps, lag):
    step, gain = find_task(task).step_duration, 0.8
    actions = [study_env(task).build().action_space.sample() for _ in range(40)]
    ours = study_env(task, late(task, time_constant=lag * step, delay=steps * step, gain=gain))
    theirs = study_env(task, Lag(lag * step, steps * step, gain))
    np.testing.assert_allclose(play(ours, actions), play(theirs, actions), rtol=0, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("steps", [0.5, 1.0, 1.25, 2.0, 3.3, 4.0])
def test_a_longer_delay_equals_the_environment_s_command_delay(task, steps):
    step = find_task(task).step_duration
    actions = [study_env(task).build().action_space.sample() for _ in range(40)]
    ours = study_env(task, late(task, delay=steps * step))
    theirs = study_env(task, disturbances=Disturbances(command_delay=steps * step))
    np.testing.assert_allclose(play(ours, actions), play(theirs, actions), rtol=0, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_the_observation_has_the_last_four_commands(task):
    config = study_env(
        task, late(task, delay=1.3 * find_task(task).step_duration), observe_actuator=True
    )
    space = study_env(task).build().action_space
    actions = [space.sample() for _ in range(12)]
    shown = play(config, actions)[:, -4:]
    commands = [0.0, 0.0, 0.0, 0.0, *(float(np.ravel(action)[0]) for action in actions)]
    if task == "acrobot":  # 0, 1, 2 are -1, 0 and 1 times the largest torque
        commands[4:] = [value - 1.0 for value in commands[4:]]
    largest = find_task(task).max_force if task != "acrobot" else 1.0
    expected = [
        [commands[step_index + 3 - back] / largest for back in range(4)] for step_index in range(13)
    ]
    np.testing.assert_allclose(shown, expected, rtol=0, atol=1e-6)


def test_raises_if_the_delay_exceeds_the_memory():
    step = find_task("pendulum").step_duration
    with pytest.raises(ValueError, match=r"Late\.delay"):
        study_env("pendulum", late("pendulum", delay=4.1 * step)).build()
    assert timestep("pendulum") == pytest.approx(step / 10)


def test_severities_and_ranges_follow_from_the_first_study_by_the_plan():
    evidence = Evidence.read()
    for task in TASKS:
        for axis, harmless in HARMLESS[task].items():
            known = [
                (severity, evidence.loss(task, axis, severity).outcome)
                for severity in AXES[axis].severities[1:]
            ]
            is_negligible = [
                severity
                for severity, _ in itertools.takewhile(lambda pair: pair[1].is_negligible, known)
            ]
            assert harmless == (is_negligible[-1] if is_negligible else 0.0)
            assert reach(task, axis) == (2 * harmless or AXES[axis].severities[1])
    for axis, severity in SEVERITIES["acrobot"].items():
        harmful = [
            d
            for d in AXES[axis].severities[1:]
            if evidence.loss("acrobot", axis, d).outcome.is_harmful
        ]
        assert severity == (harmful[0] if harmful else AXES[axis].severities[-1])


def test_the_study_computes_what_the_plan_states():
    plan = (RESULTS / "insurance_plan.md").read_text()
    arms = {trial.arm.name for trial in trials() if needs_new_policies(trial)}
    assert f"{len(arms)} new arms" in plan
    assert f"no p before {PLANNED} policies of every kind" in plan
    assert f"All others ({len(secondary())}, each of one task)" in " ".join(plan.split())
    for number, question in enumerate(primary(), start=1):
        line = next(line for line in plan.splitlines() if line.startswith(f"| I{number} |"))
        assert question.name == f"I{number}"
        assert ("equivalence" in line) == (question.kind == "equivalent")
        for words, axes in (
            ("six axes", AXES),
            ("four axes", DRAWN),
            ("six arms", AXES),
            ("lag and delay", REMEMBERED),
        ):
            if words in line:
                assert len(question.contrasts) == len(axes) * len(TASKS)
    for task, title in (("pendulum", "Pendulum"), ("furuta", "Furuta"), ("acrobot", "Acrobot")):
        stated = " | ".join(f"{reach(task, axis):g}" for axis in ("lag", "weakness", "delay"))
        assert f"| {title} | {stated} |" in plan


def test_random_actuators_have_the_stated_ranges():
    for task in TASKS:
        step = find_task(task).step_duration
        for share, arm in ((1.0, generic(task)), (0.5, half(task)), (2.0, double(task))):
            env = arm.config.env
            ends = {
                name: (distribution.low, distribution.high)
                for name, distribution in env.distributions.items()
            }
            assert ends["time_constant"] == (0.0, pytest.approx(share * reach(task, "lag") * step))
            assert ends["delay"] == (0.0, pytest.approx(share * reach(task, "delay") * step))
            short = share * reach(task, "weakness")
            assert ends["gain"] == pytest.approx((1 - short, 1 + short))
            assert env.disturbances.pulse_force == pytest.approx(
                0.25 * share * find_task(task).max_force
            )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a written study: matched training keeps 0.9, random actuators 0.7, all others half.

    On ideal forces nothing is lost, and observed commands change nothing. Four policies of each
    kind are planned.
    """
    out = tmp_path_factory.mktemp("insurance")

    def level(trial):
        kind = trial.arm.name.partition(": ")[2].removesuffix(", remembering")
        if trial.test.startswith("ideal"):
            return 1.0
        return 0.9 if kind in AXES else 0.7 if kind == "random" else 0.5

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("insurance_study.page.PLANNED", 4)
        study = InsuranceStudy(root=out / "runs", out=out, seeds=4)
        spread = [-0.02, 0.02, 0.01, -0.01]  # The sum is 0.
        pretend(
            study.grid,
            lambda trial, seed: FLOORS[trial.arm.task] + 100.0 * (level(trial) + spread[seed]),
        )
        yield out, list(study.write()[0])


def test_the_page_states_the_true_results(written):
    out, files = written
    assert all(file.is_file() for file in files)
    rows = {row["name"]: row for row in read_csv(out / "insurance" / "hypotheses.csv")}
    effects = {
        name: float(rows[name]["effect"])
        for name in ("I1", "I2", "I3", "I4", "I6", "I8", "I9", "I10")
    }
    expected = {
        "I1": 0.2,
        "I2": 0.2,
        "I3": 0.0,
        "I4": 0.0,
        "I6": 0.2,
        "I8": 0.0,
        "I9": 0.2,
        "I10": -0.2,
    }
    assert effects == pytest.approx(expected, abs=1e-9)
    assert rows["I10"]["outcome"] == "the other way"
    assert rows["I3"]["outcome"] == "yes"
    page = (out / "insurance.md").read_text()
    assert (
        "| random actuators | 1.00 | 0.70, 0.70; 24 of 24;" in page
    )  # Four policies on six severities.
    assert "| the same severity | 1.00 | 0.90, 0.90;" in page
    assert "| Acrobot, a step of 200 ms | ideal forces |" in page
    assert "| delay 600 ms (400 ms) | 0.50; 4; " in page.replace("\u00a0", " ")
    (row,) = (line for line in page.splitlines() if line.startswith("| friction 0.2 N·m | "))
    assert [cell[:5] for cell in row.split(" | ")[1:]] == ["0.50;", "**0.9", "–", "0.70;", "0.50;"]
    by_task, pooled = (line for line in page.splitlines() if line.startswith("| I10 |"))
    assert by_task.count(" | the other way, -0.20 [-0.23, -0.17]") == len(TASKS)
    assert pooled.split(" | ")[4] == "–"  # It rests on no single task.
    assert "not judged" not in page


@pytest.mark.parametrize(
    ("protected", "expected"),
    [(("pendulum",), {"pendulum"}), (("pendulum", "acrobot"), set()), (TASKS, set())],
)
def test_a_verdict_rests_on_a_task_without_which_it_fails(tmp_path, protected, expected):
    """Random actuators gain 0.3 on the named tasks, and nothing on the others."""
    (question,) = (question for question in primary() if question.name == "I2")
    homes = [ideal_trial(ideal_arm(task)) for task in TASKS]
    tested = [trial for pair in question.contrasts for trial in pair]
    planned = tuple({trial.name: trial for trial in (*homes, *tested)}.values())
    grid = Grid(tmp_path, planned, lambda _: range(4))

    def score(trial, seed):
        gain = 0.3 * (trial.arm.name.endswith(": random") and trial.arm.task in protected)
        level = 1.0 if trial.test == "ideal" else 0.5 + gain
        return FLOORS[trial.arm.task] + 100.0 * level + [-2.0, 2.0, 1.0, -1.0][seed]

    pretend(grid, score)
    scores = Scores(grid.collect(), FLOORS, homes)
    pooled = judge(scores, [question], primary=True)
    assert [verdict.outcome for verdict in pooled] == ["yes"]
    by_task = judge_by_task(scores, pooled)
    assert {verdict.task for verdict in by_task if verdict.is_needed} == expected
    effects = {verdict.task: verdict.verdict.effect.mean for verdict in by_task}
    assert effects == pytest.approx({task: 0.3 * (task in protected) for task in TASKS}, abs=1e-9)
    others = {verdict.task: verdict.others.mean for verdict in by_task}
    assert others == pytest.approx(
        {task: 0.15 * len(set(protected) - {task}) for task in TASKS}, abs=1e-9
    )


def test_published_rows_tell_policies_that_were_trained_again_from_the_first_study_s():
    first = {
        (row["task"], row["trained"], row["tested"], row["seed"]): (row["run"], row["returns"])
        for row in read_csv(RESULTS / "actuators" / "runs.csv")
    }
    again, shared = [], 0
    for row in read_csv(RESULTS / "insurance" / "runs.csv"):
        key = row["task"], row["trained"], row["tested"], row["seed"]
        if row["trained_again"] == "True":
            assert key not in first
            again.append(row)
        elif key in first:
            assert first[key] == (row["run"], row["returns"])
            shared += 1
    assert {row["run"] for row in again} <= {run for run, _ in first.values()}
    counts = len(again), len({row["run"] for row in again}), shared
    assert counts == (1180, 400, 1480)
    page = " ".join((RESULTS / "insurance.md").read_text().split())
    assert "marks the 1180 rows of the 400 retrained policies in the column `trained_again`" in page


def test_the_overview_counts_trainings_and_hours_as_the_tables_do():
    overview = " ".join((RESULTS / "README.md").read_text().split())
    totals = {
        study: json.loads((RESULTS / study / "totals.json").read_text())
        for study in ("actuators", "insurance")
    }
    hours = {study: f"{total['seconds'] / 3600:.1f} hours" for study, total in totals.items()}
    first = {row["run"] for row in read_csv(RESULTS / "actuators" / "runs.csv")}
    rows = read_csv(RESULTS / "insurance" / "runs.csv")
    again = {row["run"] for row in rows if row["trained_again"] == "True"}
    new = {row["run"] for row in rows} - first
    trained, planned = totals["actuators"]["trainings"], len(ActuatorStudy().grid.cells)
    assert (
        f"The first study took {hours['actuators']} for {trained} of its {planned} planned"
        f" trainings, of which {len(first)} were tested." in overview
    )
    assert (
        f"The second study has {len(new) + len(again)} trainings: {len(new)} for its own kinds of"
        f" training, and {len(again)} to repeat policies of the first study. The time of"
        f" {sum(totals['insurance']['codes'].values())} of them is known, {hours['insurance']}."
        in overview
    )


def test_the_published_page_follows_from_the_published_rows(tmp_path, monkeypatch):
    """Compare the page and its tables byte for byte, without run folders."""
    # The fixture `written` plans fewer policies for the whole module.
    monkeypatch.setattr("insurance_study.page.PLANNED", PLANNED)
    (tmp_path / "insurance").mkdir()
    for name in ("runs.csv", "learning.csv", "totals.json"):
        shutil.copy(RESULTS / "insurance" / name, tmp_path / "insurance")
    shutil.copy(RESULTS / "insurance_conclusions.md", tmp_path)
    files, failures = InsuranceStudy(root=tmp_path / "none", out=tmp_path).write()
    assert not failures
    for file in files:
        assert file.read_bytes() == (RESULTS / file.relative_to(tmp_path)).read_bytes(), file.name


def test_questions_with_fewer_policies_than_planned_are_not_judged(written, tmp_path):
    out, _ = written
    (tmp_path / "insurance").mkdir()
    rows = [row for row in read_csv(out / "insurance" / "runs.csv") if int(row["seed"]) < 3]
    write_csv(tmp_path / "insurance" / "runs.csv", rows)
    InsuranceStudy(root=tmp_path / "runs", out=tmp_path, seeds=4).write()
    page = (tmp_path / "insurance.md").read_text()
    assert page.count("| not judged |") == 10
    assert "The 266 secondary comparisons, each of one task, are not judged yet." in page
    judged = read_csv(tmp_path / "insurance" / "hypotheses.csv")
    assert {(row["outcome"], row["p"], row["corrected_p"]) for row in judged} == {
        ("not judged", "", "")
    }


def test_returns_in_each_tenth_of_the_training_are_published(written):
    rows = read_csv(written[0] / "insurance" / "learning.csv")
    assert len(rows) == 4 * len({trial.arm.name for trial in trials()})
    assert [float(rows[0][f"tenth_{number}"]) for number in range(1, 11)] == [
        2 * step_count + 1.5 for step_count in range(10)
    ]
    assert len({row["run"] for row in rows}) == len(rows)


def test_rows_replace_deleted_run_folders(written, tmp_path):
    out, _ = written
    shutil.copytree(out / "insurance", tmp_path / "insurance")
    InsuranceStudy(root=tmp_path / "runs", out=tmp_path, seeds=4).write()
    for name in ("runs.csv", "hypotheses.csv", "learning.csv"):
        assert (tmp_path / "insurance" / name).read_text() == (out / "insurance" / name).read_text()


def test_the_page_counts_trainings_whose_returns_still_rise():
    def runs(task, trained, *rises):
        return [
            {"task": task, "trained": trained, "tenth_8": 10.0, "tenth_10": 10.0 + rise}
            for rise in rises
        ]

    rows = [*runs("a", "up", 4.0, 8.0), *runs("a", "level", 4.0, 4.0), *runs("a", "down", -9.0)]
    rows += [*runs("b", "wide span", 8.0), *runs("c", "no span", 99.0)]
    rows.append({"task": "a", "trained": "no episode", "tenth_8": "", "tenth_10": "5"})
    assert still_rising(rows, {"a": 100.0, "b": 1000.0}, 0.05) == (["a: up"], 4)


def test_training_time_is_counted_once_if_the_page_is_written_again(tmp_path):
    study = InsuranceStudy(root=tmp_path / "runs", out=tmp_path, seeds=1, tasks=("furuta",))
    grid = study.grid
    pretend(grid, lambda trial, _: FLOORS[trial.arm.task] + 100.0)
    untested = grid.folders["furuta: random", 0]
    shutil.move(untested / "deployments", tmp_path / "later")
    for _ in range(2):
        study.write()
        assert study.grid.collect().totals.seconds == 10.0 * (len(grid.arms) - 1)
    shutil.move(tmp_path / "later", untested / "deployments")
    for _ in range(2):
        study.write()
        assert study.grid.collect().totals.seconds == 10.0 * len(grid.arms)


def test_the_recommended_random_actuators_are_those_of_the_study():
    """A lag stands for the study's own actuator; distributions, pushes and budget are the same."""
    for task in TASKS:
        recommended = random_arm(ideal_arm(task), RANDOM_RANGES[task]).config
        trained = generic(task).config
        assert sorted(recommended.env.randomize) == sorted(trained.env.randomize), task
        assert recommended.env.disturbances == trained.env.disturbances
        assert recommended.total_steps == trained.total_steps
