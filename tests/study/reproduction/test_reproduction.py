"""The reproduction: short trainings, gaps, failures, page, figures, command line."""

import contextlib
import csv
import dataclasses
import json
import re
import shutil
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, DCMotorActuator
from codrl_mj.evaluation import evaluate
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.physics import trace_names
from codrl_mj.runs.policies import load_policy
from codrl_mj.study import trials
from codrl_mj.study.parallel import Workers
from codrl_mj.study.program import main
from codrl_mj.study.trials import TEST_SECONDS
from codrl_mj.tasks import find_task
from codrl_mj.training import EVALUATION_SEED
from reproduction import figures
from reproduction.arms import ARMS, TASKS
from reproduction.checks import CONFIRMED, OPEN, Verdict
from reproduction.claims import CLAIMS, PAPER_SAYS
from reproduction.drawn import CURVES, STATES, TORQUES, curve_rows, state_rows, torque_rows
from reproduction.findings import claim_rows
from reproduction.page import FOLDER, PAGE, statements_table, verdicts_line, write
from reproduction.rows import read_rows
from reproduction.study import Reproduction
from reproduction.value_iteration import Mesh
from tests.conftest import REPRESENTATIVES
from tests.matrix import matrix_params
from tests.study.reproduction.worlds import PAPERS, trained, world

RESULTS = Path(__file__).parents[3] / "docs/results"
HILL = [arm for arm in ARMS if arm.task == "mountain_car"]
BLOCKED = HILL[-1]
"""The arm whose run folder cannot be made."""


@pytest.fixture(scope="module")
def reproduction(tmp_path_factory):
    """Return a finished reproduction with one of two seeds of mountain cars and a failed arm."""
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
    hill.every.folders[BLOCKED.name, 0].write_text("a file in the way")
    reported = []
    hill.grid.compute(Workers(jobs=1), on_cell=reported.append)
    findings = plan.findings()
    return plan, findings, plan.out, write(findings, plan.out), reported


@pytest.mark.matrix
def test_every_arm_is_trained_tested_and_read(reproduction):
    plan, findings, _, _, reported = reproduction
    assert (reported.count("training"), reported.count("test")) == (6, 5)
    for arm in HILL[:-1]:
        (row,) = findings.runs[arm.name]
        folder = plan.every.folders[arm.name, 0]
        assert (row["seed"], row["run"]) == ("0", folder.name)
        expected = evaluate(load_policy(folder), arm.config.evaluation_env, 3, EVALUATION_SEED)
        assert float(row["returns"]) == expected.returns.mean
        assert row["time_to_goal"] == ""  # No policy arrives after two training episodes.
        assert row["times"] == "- - -"


@pytest.mark.matrix
def test_failed_and_missing_trainings_are_reported(reproduction):
    _, findings, out, _, _ = reproduction
    assert findings.missing[BLOCKED.name] == [0, 1]
    assert "is not a folder" in findings.failures[f"{BLOCKED.name}, seed 0"]
    page = (out / PAGE).read_text()
    assert f"- {BLOCKED.name}: seeds 0 to 1\n" in page
    assert f"- {BLOCKED.name}, seed 0 failed: " in page
    assert "- mountain_car_continuous, repaired, ideal, mujoco: seeds 0\n" in page
    assert "\nThe 5 trainings took " in page
    assert "A trial: every training was cut off after 2 episodes" in page


@pytest.mark.matrix
def test_the_page_has_every_statement_once_and_the_table_every_claim_with_its_check(reproduction):
    _, findings, out, _, _ = reproduction
    page = (out / PAGE).read_text()
    rows = list(csv.DictReader((out / FOLDER / "claims.csv").open(newline="", encoding="utf-8")))
    judged = [
        claim for claim in CLAIMS if claim.task in ("mountain_car", "mountain_car_continuous")
    ]
    assert len(rows) == len(judged)
    for claim, row in zip(judged, rows, strict=True):
        verdict = claim.judge(findings.runs)
        assert (row["verdict"], row["why"], row["criterion"]) == (
            *verdict[:2],
            claim.check.criterion,
        )
        shown = [
            line for line in page.splitlines() if f"{claim.statement} | {claim.figure} | " in line
        ]
        if claim.source == PAPER_SAYS and claim.counted:
            assert any(verdict.outcome in line for line in shown)
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(lines) == 2 + sum(claim.source == PAPER_SAYS and claim.counted for claim in judged)


def pretended(outcome=None, rows=None):
    """Return findings in which every claim has the same outcome, or that follow from rows."""
    runs = rows or {arm.name: [] for arm in ARMS}
    verdicts = [(claim, Verdict(outcome, "") if outcome else claim.judge(runs)) for claim in CLAIMS]
    return types.SimpleNamespace(runs=runs, verdicts=verdicts)


def test_22_statements_are_counted_for_any_outcome():
    assert "**Of 22 statements: 22 open.**" in verdicts_line(pretended(OPEN).verdicts)
    table = statements_table(pretended(CONFIRMED)).splitlines()
    assert len(table) == 2 + 22
    assert all(line.endswith("**confirmed** |") for line in table[2:])


def test_results_of_settings_as_printed_are_shown_in_addition():
    table = statements_table(pretended(rows=world(PAPERS)))
    assert "| time to the goal, no motor |  | 160 s |  |  | 160 s [159, 161] |" in table
    line = next(line for line in table.splitlines() if "*Continuous Mountain Car*" in line)
    assert line.count("95 [94") == 2
    upright = next(line for line in table.splitlines() if "upright" in line)
    assert (
        "| 100 %, after 50 s | 100 %, after 50 s | 100 %, after 50 s | **confirmed** |" in upright
    )


def test_p_is_corrected_for_all_comparisons_of_a_source():
    """Holm multiplies the smallest of n p by n."""
    rows = claim_rows(pretended(rows=world(PAPERS)).verdicts)
    compared = [row for row in rows if row["p"] is not None and row["source"] == PAPER_SAYS]
    assert len(compared) == 5
    smallest = min(compared, key=lambda row: row["p"])
    assert smallest["p_corrected"] == pytest.approx(5 * smallest["p"])
    assert all(row["p_corrected"] is None for row in rows if row["p"] is None)


@pytest.mark.matrix
def test_every_file_named_on_the_page_is_complete(reproduction):
    _, _, out, files, _ = reproduction
    page = (out / PAGE).read_text()
    named = {out / name for name in re.findall(rf"\(({FOLDER}/[^)]+)\)", page)}
    assert named | {out / PAGE, out / FOLDER / STATES, out / FOLDER / TORQUES} == set(files)
    drawn = [path for path in files if path.suffix == ".svg"]
    assert {path.stem for path in drawn} == {
        "learning_mountain_car",
        "torque_mountain_car",
        "states_mountain_car",
        "discount",
    }
    for path in drawn:
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
    assert not [path for path in out.rglob("*") if path.is_file() and path not in files]


@pytest.mark.matrix
def test_the_tables_contain_the_findings(reproduction):
    _, findings, out, _, _ = reproduction
    runs = list(csv.DictReader((out / FOLDER / "runs.csv").open()))
    assert runs == [row for rows in findings.runs.values() for row in rows]
    claims = list(csv.DictReader((out / FOLDER / "claims.csv").open()))
    assert [row["verdict"] for row in claims] == [
        verdict.outcome for _, verdict in findings.verdicts
    ]
    content = json.loads((out / FOLDER / "findings.json").read_text())
    assert content["missing"][BLOCKED.name] == [0, 1]
    assert [entry["discount"] for entry in content["value_iteration"]] == [
        0.85,
        0.9,
        0.95,
        0.99,
        0.999,
    ]
    curves = list(csv.DictReader((out / FOLDER / CURVES).open()))
    assert {(row["motor"], row["seeds"]) for row in curves} == {
        ("paper gains", "1"),
        ("fast gains", "1"),
        ("ideal", "1"),
    }


@pytest.mark.matrix
def test_published_rows_replace_deleted_run_folders(reproduction, tmp_path):
    """The page is the same without run folders and without published rows."""
    plan, _, out, _, _ = reproduction
    elsewhere = dataclasses.replace(plan, out=tmp_path)
    elsewhere.publish()
    assert (tmp_path / FOLDER / "runs.csv").read_bytes() == (out / FOLDER / "runs.csv").read_bytes()
    shutil.copytree(out / FOLDER, tmp_path / "gone" / FOLDER)
    gone = dataclasses.replace(plan, root=tmp_path / "none", out=tmp_path / "gone")
    for path in write(gone.findings(), gone.out):
        original = out / path.relative_to(gone.out)
        if path.suffix in (".csv", ".svg"):
            assert path.read_bytes() == original.read_bytes(), path
    missing_seeds = {cost.arm.name: cost.missing for cost in gone.grid.costs()}
    assert missing_seeds[HILL[0].name] == (1,)
    assert missing_seeds[BLOCKED.name] == (0, 1)


@pytest.mark.matrix
def test_writing_again_from_the_run_folders_gives_the_same_files(reproduction, tmp_path):
    plan, _, out, files, _ = reproduction
    again = write(dataclasses.replace(plan, out=tmp_path).findings(), tmp_path)
    assert [path.relative_to(tmp_path) for path in again] == [
        path.relative_to(out) for path in files
    ]
    for path, original in zip(files, again, strict=True):
        assert path.read_bytes() == original.read_bytes(), path


@pytest.mark.matrix
def test_the_page_includes_written_conclusions(reproduction, tmp_path):
    plan, _, _, _, _ = reproduction
    written = tmp_path / "reproduction_conclusions.md"
    written.write_text("What a person wrote.\n")
    write(dataclasses.replace(plan, tasks=("acrobot",), out=tmp_path).findings(), tmp_path)
    assert "## Conclusions\n\nWhat a person wrote.\n" in (tmp_path / PAGE).read_text()
    assert written.read_text() == "What a person wrote.\n"


@pytest.mark.matrix
def test_the_published_page_follows_from_the_published_rows(tmp_path):
    """Compare page, tables and figures byte for byte, from rows, curves and episodes."""
    shutil.copytree(RESULTS / FOLDER, tmp_path / FOLDER)
    shutil.copy(RESULTS / "reproduction_conclusions.md", tmp_path)
    (tmp_path / FOLDER / "claims.csv").unlink()
    files, failures = Reproduction(root=tmp_path / "none", out=tmp_path).write()
    assert not failures
    assert {file.name for file in files} == {
        PAGE,
        *(file.name for file in (RESULTS / FOLDER).iterdir()),
    }
    for file in files:
        if file.suffix in (".md", ".csv"):
            assert file.read_bytes() == (RESULTS / file.relative_to(tmp_path)).read_bytes(), (
                file.name
            )


def test_the_example_recomputes_every_verdict_without_the_package():
    """Run in an interpreter without the package."""
    example = RESULTS.parents[1] / "examples" / "recompute_reproduction.py"
    run = [sys.executable, "-I", "-S", str(example), str(RESULTS / FOLDER)]
    lines = subprocess.run(run, capture_output=True, text=True, check=True).stdout.splitlines()
    claims = list(
        csv.DictReader((RESULTS / FOLDER / "claims.csv").open(newline="", encoding="utf-8"))
    )
    assert [line.rsplit(": ", 1)[1] for line in lines] == [row["verdict"] for row in claims]
    assert len(claims) == len(CLAIMS)


def test_published_verdicts_follow_from_the_current_claims():
    rows = read_rows(RESULTS / FOLDER)
    runs = {arm.name: [] for arm in ARMS}
    for key, arm_rows in rows.items():
        runs[", ".join(key[:-1])] += arm_rows
    claims = list(
        csv.DictReader((RESULTS / FOLDER / "claims.csv").open(newline="", encoding="utf-8"))
    )
    for claim, row in zip(CLAIMS, claims, strict=True):
        assert (row["statement"], row["verdict"]) == (claim.statement, claim.judge(runs).outcome)


def test_repeated_trainings_of_a_seed_change_no_verdict():
    """docs/reproduction.md says so: 9 or 10 trainings are of 5 seeds."""
    every, last = {arm.name: [] for arm in ARMS}, {arm.name: [] for arm in ARMS}
    for key, arm_rows in read_rows(RESULTS / FOLDER).items():
        every[", ".join(key[:-1])] += arm_rows
        last[", ".join(key[:-1])].append(arm_rows[-1])
    pairs = [(claim.judge(every), claim.judge(last)) for claim in CLAIMS]
    assert any(both.samples > single.samples == 5 for both, single in pairs)
    assert all(both.outcome == single.outcome for both, single in pairs)


@pytest.mark.matrix
def test_finished_runs_are_not_trained_again(reproduction):
    plan, _, _, _, _ = reproduction
    hill = dataclasses.replace(plan, tasks=("mountain_car",), sarsa_seeds=1)
    results = [
        folder / "result.json"
        for folder in hill.every.folders.values()
        if (folder / "result.json").is_file()
    ]
    assert len(results) == 5
    before = [path.stat().st_mtime_ns for path in results]
    hill.grid.compute(Workers(jobs=1))
    assert [path.stat().st_mtime_ns for path in results] == before


@pytest.mark.matrix
def test_costs_come_from_finished_runs_or_estimates(reproduction):
    plan, findings, _, _, _ = reproduction
    by_arm = {cost.arm.name: cost for cost in plan.grid.costs()}
    half = by_arm[HILL[0].name]  # The first seed's row is published.
    assert (half.finished, half.missing) == ((), (1,))
    assert (half.tests, half.remaining_seconds) == (1, HILL[0].seconds + TEST_SECONDS)
    none = by_arm[BLOCKED.name]
    assert (none.finished, none.missing, none.remaining_seconds) == (
        (),
        (0, 1),
        2 * (BLOCKED.seconds + TEST_SECONDS),
    )
    took = {cost.arm.name: cost.seconds for cost in plan.every.costs()}
    assert took[HILL[0].name] == float(findings.runs[HILL[0].name][0]["seconds"])


def test_the_estimate_is_less_than_four_hours_on_two_cores(tmp_path):
    grid = Reproduction(root=tmp_path, out=tmp_path).grid
    assert sum(cost.remaining_seconds for cost in grid.costs()) < 2 * 4 * 3600
    assert len(grid.cells) == sum(30 if arm.task == "mountain_car" else 5 for arm in ARMS)


def test_first_seeds_are_trained_first_and_long_trainings_before_short_ones(tmp_path):
    order = list(Reproduction(root=tmp_path, out=tmp_path).grid.cells)
    seeds = [seed for _, seed in order]
    assert seeds == sorted(seeds)
    seconds = {arm.name: arm.seconds for arm in ARMS}
    first = [seconds[name] for name, seed in order if seed == 0]
    assert first == sorted(first, reverse=True)


def test_seeds_are_trained_together_until_every_core_is_occupied(tmp_path, monkeypatch):
    at_once = []
    monkeypatch.setattr(
        trials,
        "train_runs",
        lambda runs, *_, **__: at_once.append(sorted(c.seed for c in runs.values())),
    )
    plan = Reproduction(
        root=tmp_path, out=tmp_path, tasks=("pendulum",), settings=("paper",), seeds=5
    )
    for jobs in (1, 2, 3):
        plan.every.compute(Workers(jobs=jobs))
    one_each, three = [[seed, seed] for seed in range(5)], [[0, 0, 1, 1], [2, 2, 3, 3], [4, 4]]
    assert at_once == [*one_each, *one_each, *three]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ("cartpol",)}, "unknown 'cartpol': did you mean 'cartpole'"),
        ({"tasks": ()}, "empty"),
        ({"settings": ("repared",)}, "did you mean 'repaired'"),
        ({"seeds": 0}, "seeds = 0: must be an integer >= 1"),
        ({"sarsa_seeds": 1.5}, "sarsa_seeds = 1.5"),
        ({"episodes": 0}, "episodes = 0"),
        ({"test_episodes": None}, "test_episodes = None"),
    ],
)
def test_raises_if_the_plan_is_invalid(changes, message):
    with pytest.raises(ValueError, match=message):
        Reproduction(**changes)


# -- figures ---------------------------------------------------------------------------------------


def random_episode(arm, steps=30, inner_steps=3):
    """Return an episode of random numbers."""
    random = np.random.default_rng(0)
    task = find_task(arm.task)
    return Episode(
        time=task.step_duration * np.arange(1, steps + 1),
        state=random.uniform(-3, 3, (steps + 1, len(task.state_names))),
        observation=np.zeros((steps + 1, 1)),
        action=np.zeros(steps),
        reward=np.zeros(steps),
        first_speeds=np.zeros(1),
        trace={
            name: random.uniform(-1, 1, steps * inner_steps)
            for name in trace_names(DCMotorActuator)
        },
        signals={"desired_force": random.uniform(-1, 1, steps)},
        terminated=True,
        actuator=arm.actuator,
    )


@pytest.mark.parametrize("task", matrix_params(REPRESENTATIVES, TASKS))
def test_states_and_torques_of_every_task_are_drawn(task, tmp_path):
    arms = [arm for arm in ARMS if arm.task == task and arm.physics == "mujoco"]
    states = [row for arm in arms for row in state_rows(arm, random_episode(arm))]
    torques = [
        row
        for arm in arms
        if arm.actuator != IDEAL
        for row in torque_rows(arm, random_episode(arm))
    ]
    assert figures.draw_states(tmp_path / "states.svg", task, states)
    assert figures.draw_torque(tmp_path / "torque.svg", task, torques)
    for name in ("states", "torque"):
        assert ElementTree.parse(tmp_path / f"{name}.svg").getroot().tag.endswith("svg")
    assert not figures.draw_states(tmp_path / "none.svg", task, [])
    assert not (tmp_path / "none.svg").exists()


def test_the_torque_figure_shows_a_second_or_twenty_steps():
    ends = {}
    for arm in ARMS:
        if arm.actuator != IDEAL:
            rows = torque_rows(arm, random_episode(arm, steps=80, inner_steps=2))
            ends[arm.task] = float(rows[-1]["time"]) + find_task(arm.task).step_duration / 2
    expected = {
        "pendulum": 1.0,
        "mountain_car": 20.0,
        "mountain_car_continuous": 20.0,
        "acrobot": 4.0,
        "cartpole": 1.0,
    }
    assert ends == pytest.approx(expected)


def test_the_curves_are_the_quantities_in_the_paper_s_figures():
    """Acrobot hanging: -2; upright: 2. Pendulum upright: x = 1, y = 0."""
    height, *_ = figures.CURVES["acrobot"]
    states = np.array([[0, 0, 0, 0], [np.pi, 0, 0, 0], [np.pi / 2, np.pi / 2, 0, 0]])
    assert height.values(states.T) == pytest.approx([-2.0, 2.0, 1.0])
    x, y, angle, speed = (
        curve.values(np.array([[2 * np.pi, 3.0], [np.pi / 2, 0.0]]).T)
        for curve in figures.CURVES["pendulum"]
    )
    assert (*x, *y) == pytest.approx((1.0, 0.0, 0.0, 1.0), abs=1e-12)
    assert angle == pytest.approx([0.0, np.pi / 2], abs=1e-12)
    assert speed.tolist() == [3.0, 0.0]


def test_epochs_are_drawn_one_below_the_other(tmp_path):
    arms = [arm for arm in ARMS if arm.task == "cartpole" and arm.physics == "mujoco"]
    rows = [
        row for arm in arms for row in curve_rows(arm, {seed: trained(seed) for seed in range(3)})
    ]
    assert {(row["curve"], row["seeds"]) for row in rows} == {
        (name, "3") for name in ("lengths", "returns", "counts")
    }
    assert figures.draw_learning(tmp_path / "epochs.svg", "cartpole", rows)
    assert ElementTree.parse(tmp_path / "epochs.svg").getroot().tag.endswith("svg")


# -- command line ----------------------------------------------------------------------------------


def test_a_dry_run_only_lists(tmp_path, capsys):
    arguments = [
        "acrobot",
        "--dry-run",
        "--seeds",
        "3",
        "--jobs",
        "2",
        "--root",
        str(tmp_path / "no"),
    ]
    arguments += ["--out", str(tmp_path / "out")]
    assert main(Reproduction, arguments) == 0
    shown = capsys.readouterr().out
    assert "acrobot, paper, paper gains, mujoco" in shown
    assert "0 to 2" in shown
    assert "hours with 2 jobs" in shown
    assert not (tmp_path / "no").exists()


def test_a_page_can_be_written_without_results(tmp_path, capsys):
    arguments = [
        "acrobot",
        "--only-page",
        "--root",
        str(tmp_path / "no"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(Reproduction, arguments) == 0
    assert "\nThe 0 trainings took 0.0 hours" in (tmp_path / "out" / PAGE).read_text()
    assert "not testable" in capsys.readouterr().out
    assert not (tmp_path / "no").exists()


@pytest.mark.matrix
def test_failures_set_the_exit_status(reproduction, tmp_path, capsys):
    plan, _, _, _, _ = reproduction
    arguments = ["mountain_car", "--only-page", "--root", str(plan.root), "--out", str(tmp_path)]
    assert (
        main(
            Reproduction,
            [*arguments, "--sarsa-seeds", "2", "--episodes", "2", "--test-episodes", "3"],
        )
        == 1
    )
    assert f"failed: {BLOCKED.name}, seed 0: " in capsys.readouterr().err


@pytest.mark.matrix
def test_a_failed_test_is_reported(reproduction, tmp_path):
    plan, _, _, _, _ = reproduction
    folder = plan.every.folders[HILL[0].name, 0]
    broken, content = folder / "policy.json", (folder / "policy.json").read_text()
    shorter = dataclasses.replace(plan, tasks=("mountain_car",), test_episodes=2)
    broken.write_text("{")
    try:
        shorter.grid.compute(Workers(jobs=1))
    finally:
        broken.write_text(content)
    findings = shorter.findings()
    assert "policy.json" in findings.failures[f"{HILL[0].name} on test, seed 0"]
    assert 0 in findings.missing[HILL[0].name]
    assert "0" in {row["seed"] for row in findings.runs[HILL[1].name]}


def test_raises_if_a_task_is_unknown(capsys):
    with contextlib.suppress(SystemExit):
        assert main(Reproduction, ["pendulm", "--dry-run"]) == 2
    assert "did you mean 'pendulum'" in " ".join(capsys.readouterr().err.split())
