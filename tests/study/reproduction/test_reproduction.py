"""The reproduction from configuration to page: tiny trainings, what is missing, what failed, figures, command line."""

import contextlib
import csv
import dataclasses
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, Actuator
from codrl_mj.evaluation import evaluate
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.physics import trace_names
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.parallel import Workers
from codrl_mj.study.program import main
from codrl_mj.study.trials import TEST_SECONDS
from codrl_mj.tasks import find_task
from codrl_mj.training import EVALUATION_SEED
from reproduction import figures
from reproduction.arms import ARMS, TASKS
from reproduction.checks import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE
from reproduction.claims import CLAIMS
from reproduction.findings import claim_row
from reproduction.page import FOLDER, PAGE, shorter, verdicts_section, write
from reproduction.series import Series
from reproduction.study import Reproduction
from reproduction.value_iteration import Mesh
from tests.study.reproduction.worlds import trained

RESULTS = Path(__file__).parents[3] / "docs/results"
HILL = [arm for arm in ARMS if arm.task == "mountain_car"]
BLOCKED = HILL[-1]
"""The arm whose run folder cannot be made."""


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """One of two seeds of mountain cars that were trained for two episodes; one arm could not be."""
    root = tmp_path_factory.mktemp("paper")
    plan = Reproduction(
        root=root,
        out=tmp_path_factory.mktemp("results"),
        tasks=("mountain_car", "mountain_car_continuous"),
        seeds=1,
        sarsa_seeds=2,
        episodes=2,
        test_episodes=3,
        mesh=Mesh(31, 31, 5),
    )
    hill = dataclasses.replace(plan, tasks=("mountain_car",), sarsa_seeds=1)
    hill.grid.folders()[BLOCKED.name, 0].write_text("a file in the way")
    reported = []
    hill.grid.compute(Workers(jobs=1), on_cell=reported.append)
    findings = plan.findings()
    return plan, findings, plan.out, write(findings, plan.out), reported


@pytest.mark.matrix
def test_every_arm_is_trained_tested_and_read(done):
    plan, findings, _, _, reported = done
    assert (reported.count("training"), reported.count("test")) == (6, 5)
    for arm in HILL[:-1]:
        series = findings.series[arm.name]
        assert (*series.runs, *findings.rows["missing"][arm.name]) == (0, 1)
        run = series.runs[0]
        assert run.folder == plan.grid.folders()[arm.name, 0]
        assert len(run.episodes) == 2
        env = arm.config.evaluation_env
        expected = evaluate(load_policy(run.folder), env, 3, EVALUATION_SEED)
        assert run.tests["test"]["episode_returns"] == list(expected.episode_returns)
        assert series.tested("returns") == [expected.returns.mean]


@pytest.mark.matrix
def test_what_failed_or_was_not_tried_is_said(done):
    _, findings, out, _, _ = done
    assert findings.rows["missing"][BLOCKED.name] == [0, 1]
    assert "is not a folder" in findings.found.failures[f"{BLOCKED.name}, seed 0"]
    page = (out / PAGE).read_text()
    assert f"- {BLOCKED.name}: seeds 0 to 1\n" in page
    assert f"- {BLOCKED.name}, seed 0 failed: " in page
    assert "- mountain_car_continuous, repaired, ideal, mujoco: seeds 0\n" in page
    assert "5 of 16 trainings are finished" in page
    assert "A trial: every training was cut off after 2 episodes" in page


@pytest.mark.matrix
def test_the_page_has_what_the_paper_reports_and_the_table_every_claim_with_its_check(done):
    plan, findings, out, _, _ = done
    page = (out / PAGE).read_text()
    with (out / FOLDER / "claims.csv").open(newline="", encoding="utf-8") as file:
        rows = {(row["source"], row["physics"], row["statement"], row["measure"]): row for row in csv.DictReader(file)}
    assert len(rows) == len(findings.rows["claims"])
    for claim in CLAIMS:
        if claim.task not in plan.tasks:
            continue
        verdict = claim.judge(findings.series)
        row = rows[claim.source, claim.physics, claim.statement, claim.measure.text]
        assert (row["verdict"], row["why"], row["criterion"]) == (
            verdict.outcome,
            verdict.reason,
            claim.check.criterion,
        )
        of_the_paper = claim.source == "paper" and claim.physics != "analytic"
        found = [
            line
            for line in page.splitlines()
            if f"| {shorter(claim.statement)} | {shorter(claim.measure.text)}: " in line
        ]
        assert len(found) == of_the_paper or claim.source == "paper"
        if of_the_paper:
            assert verdict.outcome in found[0]
    untested = [row for row in findings.rows["claims"] if row["verdict"] == NOT_TESTABLE]
    assert {row["task"] for row in untested} == {"mountain_car_continuous", "mountain_car"}  # one seed: no comparison
    assert page.count("| the paper reports | ours [95 %] |") == 2


@pytest.mark.parametrize(
    ("mujoco", "analytic", "counted"),
    [
        (CONFIRMED, CONFIRMED, "1 | 0 | 0 | 0"),
        (COMPATIBLE, COMPATIBLE, "0 | 1 | 0 | 0"),
        (COMPATIBLE, NOT_CONFIRMED, "0 | 0 | 1 | 0"),
        (CONFIRMED, NOT_TESTABLE, "1 | 0 | 0 | 0"),
        (NOT_TESTABLE, NOT_TESTABLE, "0 | 0 | 0 | 1"),
    ],
)
def test_a_statement_about_both_kinds_of_physics_has_two_verdicts_and_counts_once(mujoco, analytic, counted):
    both = [claim for claim in CLAIMS if claim.statement == "ideal: goal in 160 s"]
    assert [claim.physics for claim in both] == ["mujoco", "analytic"]
    nothing = {arm.name: Series(arm, {}) for arm in ARMS}
    judged = [
        claim_row(claim, nothing) | {"verdict": verdict}
        for claim, verdict in zip(both, (mujoco, analytic), strict=True)
    ]
    assert f"| the paper | 2 | 1 | {counted} |" in verdicts_section(judged)


@pytest.mark.matrix
def test_every_file_that_the_page_names_is_there_and_whole(done):
    _, _, out, files, _ = done
    page = (out / PAGE).read_text()
    named = {out / name for name in re.findall(rf"\(({FOLDER}/[^)]+)\)", page)}
    assert named | {out / PAGE} == set(files)
    drawn = [path for path in files if path.suffix == ".svg"]
    assert {path.stem for path in drawn} == {
        "learning_mountain_car",
        "torque_mountain_car_paper",
        "states_mountain_car_paper",
        "discount",
    }
    for path in drawn:
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
    assert not [path for path in out.rglob("*") if path.is_file() and path not in files]


@pytest.mark.matrix
def test_the_tables_are_the_findings(done):
    _, findings, out, _, _ = done
    with (out / FOLDER / "runs.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 5
    for row in runs:
        name = f"{row['task']}, {row['settings']}, {row['motor']}, {row['physics']}"
        run = findings.series[name].runs[int(row["seed"])]
        assert float(row["returns"]) == run.tests["test"]["returns"]["mean"]
        assert float(row["last_50"]) == run.column("return").mean()
        assert row["time_to_goal"] == ""  # nobody arrives after two episodes
    with (out / FOLDER / "claims.csv").open() as file:
        claims = list(csv.DictReader(file))
    content = json.loads((out / FOLDER / "findings.json").read_text())
    assert [row["verdict"] for row in claims] == [row["verdict"] for row in findings.rows["claims"]]
    assert [row["verdict"] for row in content["claims"]] == [row["verdict"] for row in claims]
    assert content["missing"][BLOCKED.name] == [0, 1]
    assert [one["discount"] for one in content["value_iteration"]] == [0.85, 0.9, 0.95, 0.99, 0.999]


@pytest.mark.matrix
def test_written_again_from_the_run_folders_it_is_the_same(done, tmp_path):
    plan, _, out, files, _ = done
    again = write(dataclasses.replace(plan, out=tmp_path).findings(), tmp_path)
    assert [path.relative_to(tmp_path) for path in again] == [path.relative_to(out) for path in files]
    for path, other in zip(files, again, strict=True):
        assert path.read_bytes() == other.read_bytes(), path


@pytest.mark.matrix
def test_the_page_includes_what_a_person_wrote(done, tmp_path):
    plan, _, _, _, _ = done
    written = tmp_path / "reproduction_conclusions.md"
    written.write_text("What a person wrote.\n")
    write(dataclasses.replace(plan, tasks=("acrobot",), out=tmp_path).findings(), tmp_path)
    assert "## Conclusions\n\nWhat a person wrote.\n" in (tmp_path / PAGE).read_text()
    assert written.read_text() == "What a person wrote.\n"


@pytest.mark.matrix
def test_the_published_page_is_what_the_published_rows_say(tmp_path):
    """Byte for byte, with its tables; curves and times of episodes were not published: their figures stay."""
    shutil.copytree(RESULTS / FOLDER, tmp_path / FOLDER)
    shutil.copy(RESULTS / "reproduction_conclusions.md", tmp_path)
    for name in ("claims.csv", "runs.csv"):
        (tmp_path / FOLDER / name).unlink()
    files, failures = Reproduction(root=tmp_path / "none", out=tmp_path).write()
    assert not failures
    assert {file.name for file in files} == {PAGE, *(file.name for file in (RESULTS / FOLDER).iterdir())}
    for file in files:
        if file.suffix in (".md", ".csv"):
            assert file.read_bytes() == (RESULTS / file.relative_to(tmp_path)).read_bytes(), file.name


@pytest.mark.matrix
def test_finished_runs_are_not_trained_again(done):
    plan, _, _, _, _ = done
    hill = dataclasses.replace(plan, tasks=("mountain_car",), sarsa_seeds=1)
    results = [folder / "result.json" for folder in hill.grid.folders().values() if (folder / "result.json").is_file()]
    assert len(results) == 5
    before = [path.stat().st_mtime_ns for path in results]
    hill.grid.compute(Workers(jobs=1))
    assert [path.stat().st_mtime_ns for path in results] == before


@pytest.mark.matrix
def test_costs_are_those_of_finished_runs_or_estimates(done):
    plan, findings, _, _, _ = done
    by_arm = {cost.arm.name: cost for cost in plan.grid.costs()}
    half = by_arm[HILL[0].name]
    assert (half.finished, half.missing) == ((0,), (1,))
    assert half.seconds == findings.series[HILL[0].name].runs[0].seconds
    assert (half.tests, half.left) == (1, half.seconds + TEST_SECONDS)
    none = by_arm[BLOCKED.name]
    assert (none.finished, none.missing, none.left) == ((), (0, 1), 2 * (BLOCKED.seconds + TEST_SECONDS))


def test_the_whole_is_estimated_at_less_than_four_hours_of_two_cores(tmp_path):
    grid = Reproduction(root=tmp_path).grid
    assert sum(cost.left for cost in grid.costs()) < 2 * 4 * 3600
    assert len(grid.cells()) == sum(30 if arm.task == "mountain_car" else 5 for arm in ARMS)


def test_all_arms_first_seeds_are_trained_first_and_the_longest_before_the_others(tmp_path):
    order = list(Reproduction(root=tmp_path).grid.cells())
    seeds = [seed for _, seed in order]
    assert seeds == sorted(seeds)
    seconds = {arm.name: arm.seconds for arm in ARMS}
    first = [seconds[name] for name, seed in order if seed == 0]
    assert first == sorted(first, reverse=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ("cartpol",)}, "unknown 'cartpol': did you mean 'cartpole'"),
        ({"tasks": ()}, "none is named"),
        ({"seeds": 0}, "seeds = 0: must be an integer >= 1"),
        ({"sarsa_seeds": 1.5}, "sarsa_seeds = 1.5"),
        ({"episodes": 0}, "episodes = 0"),
        ({"test_episodes": None}, "test_episodes = None"),
    ],
)
def test_impossible_plans_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Reproduction(**changes)


# -- figures ------------------------------------------------------------------------------------------------


def made_up(arm, steps=30, inner_steps=3):
    """An episode of random numbers."""
    random = np.random.default_rng(0)
    task = find_task(arm.task)
    return Episode(
        time=task.step_duration * np.arange(1, steps + 1),
        state=random.uniform(-3, 3, (steps + 1, len(task.state_names))),
        observation=np.zeros((steps + 1, 1)),
        action=np.zeros(steps),
        reward=np.zeros(steps),
        first_speeds=np.zeros(1),
        trace={name: random.uniform(-1, 1, steps * inner_steps) for name in trace_names(Actuator)},
        signals={"desired_force": random.uniform(-1, 1, steps)},
        terminated=True,
        actuator=arm.actuator,
    )


@pytest.mark.parametrize("task", TASKS)
def test_states_and_torques_are_drawn_of_every_task(task, tmp_path):
    episodes = [(arm, made_up(arm)) for arm in ARMS if arm.task == task and arm.physics == "mujoco"]
    figures.draw_states(tmp_path / "states.svg", task, episodes)
    figures.draw_torque(tmp_path / "torque.svg", [one for one in episodes if one[0].actuator != IDEAL])
    for name in ("states", "torque"):
        assert ElementTree.parse(tmp_path / f"{name}.svg").getroot().tag.endswith("svg")


def test_the_curves_are_what_the_paper_plots():
    """Acrobot hanging: -2; upright: 2. Pendulum upright: x = 1, y = 0."""
    (height, *_) = figures.CURVES["acrobot"]
    states = np.array([[0, 0, 0, 0], [np.pi, 0, 0, 0], [np.pi / 2, np.pi / 2, 0, 0]])
    assert height.values(states.T) == pytest.approx([-2.0, 2.0, 1.0])
    x, y, angle, speed = (
        curve.values(np.array([[2 * np.pi, 3.0], [np.pi / 2, 0.0]]).T) for curve in figures.CURVES["pendulum"]
    )
    assert (*x, *y) == pytest.approx((1.0, 0.0, 0.0, 1.0), abs=1e-12)
    assert angle == pytest.approx([0.0, np.pi / 2], abs=1e-12)
    assert speed.tolist() == [3.0, 0.0]


def test_epochs_are_drawn(tmp_path):
    arms = [arm for arm in ARMS if arm.task == "cartpole"]
    series = [Series(arm, {seed: trained(seed, epoch=35) for seed in range(3)}) for arm in arms]
    figures.draw_learning(tmp_path / "epochs.svg", series)
    assert ElementTree.parse(tmp_path / "epochs.svg").getroot().tag.endswith("svg")


# -- command line -------------------------------------------------------------------------------------------


def test_a_dry_run_lists_and_makes_nothing(tmp_path, capsys):
    given = ["acrobot", "--dry-run", "--seeds", "3", "--jobs", "2", "--root", str(tmp_path / "no")]
    assert main(Reproduction, given) == 0
    shown = capsys.readouterr().out
    assert "acrobot, paper, paper gains, mujoco" in shown
    assert "0 to 2" in shown
    assert "hours with 2 jobs" in shown
    assert not (tmp_path / "no").exists()


def test_a_page_can_be_written_of_nothing(tmp_path, capsys):
    given = ["acrobot", "--only-page", "--root", str(tmp_path / "no"), "--out", str(tmp_path / "out")]
    assert main(Reproduction, given) == 0
    assert "0 of 10 trainings are finished" in (tmp_path / "out" / PAGE).read_text()
    assert "not testable" in capsys.readouterr().out
    assert not (tmp_path / "no").exists()


@pytest.mark.matrix
def test_failures_show_in_the_exit_status(done, tmp_path, capsys):
    plan, _, _, _, _ = done
    given = ["mountain_car", "--only-page", "--root", str(plan.root), "--out", str(tmp_path)]
    assert main(Reproduction, [*given, "--sarsa-seeds", "2", "--episodes", "2", "--test-episodes", "3"]) == 1
    assert f"failed: {BLOCKED.name}, seed 0: " in capsys.readouterr().err


@pytest.mark.matrix
def test_a_test_that_failed_is_said(done, tmp_path):
    plan, _, _, _, _ = done
    folder = plan.grid.folders()[HILL[0].name, 0]
    broken, content = folder / "policy.json", (folder / "policy.json").read_text()
    shorter = dataclasses.replace(plan, tasks=("mountain_car",), test_episodes=2)
    broken.write_text("{")
    try:
        shorter.grid.compute(Workers(jobs=1))
    finally:
        broken.write_text(content)
    findings = shorter.findings()
    assert "policy.json" in findings.found.failures[f"{HILL[0].name} on test, seed 0"]
    assert findings.rows["missing"][HILL[0].name] == [0]
    assert 0 in findings.series[HILL[1].name].runs


def test_an_unknown_task_is_named(capsys):
    with contextlib.suppress(SystemExit):
        assert main(Reproduction, ["pendulm", "--dry-run"]) == 2
    assert "did you mean 'pendulum'" in " ".join(capsys.readouterr().err.split())
