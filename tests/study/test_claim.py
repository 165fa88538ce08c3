"""The study of the paper's claim: its plan, and its verdicts on rows with known differences."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import study_claim
from codrl_mj.study.axes import FLOORS
from codrl_mj.study.pages import read_csv, write_csv
from codrl_mj.study.parallel import Workers
from codrl_mj.study.questions import MARGIN
from codrl_mj.study.trials import MEASURES, RUNS, Grid, format_ranges
from reproduction.arms import ARMS
from study_claim import (
    FOLDER,
    HYPOTHESES,
    LOW_VOLTAGE_TASKS,
    PAGE,
    SETTINGS,
    VOLTAGES,
    ClaimStudy,
    cells,
    conclude,
    evaluation_envs,
)

PLAN = Path(__file__).parents[2] / "docs/results/claim_plan.md"
SEEDS = 8
# A run's standard deviation is 0.01 of the span, or 0.4 where nothing can be decided.
SPREAD, WIDE = 0.01, 0.4
# Task -> difference of the scores, spread, verdict. The difference of the continuous car is
# significant, and below the margin.
EXPECTED = {
    "pendulum": (0.2, SPREAD, "better"),
    "cartpole": (0.0, SPREAD, "equivalent"),
    "acrobot": (-0.2, SPREAD, "worse"),
    "mountain_car": (0.06, WIDE, "undecided"),
    "mountain_car_continuous": (0.02, 0.1 * SPREAD, "equivalent"),
}


def offsets(count):
    """Return offsets with mean 0 and standard deviation 1."""
    values = np.linspace(-1.0, 1.0, count)
    return values / values.std()


def write_rows(study, expected=EXPECTED):
    """Write a row for every policy and test; ideal-trained policies score 1 without a motor."""
    grid, rows = study.grid, []
    for trial in grid.trials:
        task, _, kind = trial.arm.name.partition(": ")
        difference, spread, _ = expected[task]
        level = 1.0 + (difference if kind == "through" and trial.test.endswith(" V") else 0.0)
        seeds = grid.seeds_of(trial.arm)
        for seed, offset in zip(seeds, offsets(len(seeds)), strict=True):
            floor = FLOORS[task]
            rows.append(
                {
                    "task": task,
                    "trained": kind,
                    "tested": trial.test,
                    "seed": seed,
                    "returns": floor + 100.0 * (level + spread * offset),
                    **dict.fromkeys(MEASURES, 0.5),
                    "run": grid.folders[trial.arm.name, seed].name,
                }
            )
    write_csv(study.out / FOLDER / RUNS, rows)
    return rows


@pytest.fixture
def study(tmp_path):
    return make_study(tmp_path)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Return the study with all rows and its page."""
    study = make_study(tmp_path_factory.mktemp("claim"))
    write_rows(study)
    study.write()
    return study


def make_study(out):
    (out / FOLDER).mkdir()
    return ClaimStudy(root=out / "runs", out=out, seeds=SEEDS)


def page_rows(study):
    """Return the cells of the page's table by task and test."""
    lines = (study.out / PAGE).read_text().splitlines()
    table = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    return {tuple(row[:2]): row[2:] for row in table}


def test_rows_with_known_differences_get_the_true_verdicts(judged):
    rows = page_rows(judged)
    for cell in cells():
        difference, spread, verdict = EXPECTED[cell.task]
        row = rows[study_claim.TITLES[cell.task], f"{cell.volts:g} V"]
        assert row[-1] == verdict
        mean, low, high = map(float, re.findall(r"[+-][\d.]+", row[-4]))
        assert mean == pytest.approx(difference, abs=6e-4)
        assert low < mean < high
        assert (high - low < MARGIN) == (spread < WIDE)
        assert row[2:4] == ["50", "50"]  # success
    assert rows["Pendulum", "12 V"][:2] == ["1.000; 0 of 8", "1.200; 0 of 8"]
    assert rows["Acrobot", "5 V"][1] == "0.800; 8 of 8"
    assert rows["Mountain Car", "24 V"][0].endswith(" of 40")
    assert rows["Acrobot", "ideal, small steps"][-4:] == ["–"] * 4
    page = (judged.out / PAGE).read_text()
    assert "at 24 V: **not confirmed** (1 better, 2 equivalent, 1 worse, 1 undecided)." in page
    assert "all supplies: **not confirmed** (3 better, 4 equivalent, 3 worse, 1 undecided)." in page


def test_all_hypotheses_are_corrected_together(judged):
    rows = read_csv(judged.out / FOLDER / HYPOTHESES)
    assert len(rows) == 2 * len(cells()) == 22
    p = np.array([float(row["p"]) for row in rows])
    corrected = np.array([float(row["corrected_p"]) for row in rows])
    np.testing.assert_allclose(corrected[np.argmin(p)], 22 * p.min(), rtol=1e-12)
    assert np.all(corrected >= p)


def test_nothing_is_judged_before_all_rows_exist(study):
    rows = write_rows(study)
    write_csv(study.out / FOLDER / RUNS, rows[:-1])
    study.write()
    assert "at 24 V: **not judged** (5 not judged)" in (study.out / PAGE).read_text()
    hypotheses = read_csv(study.out / FOLDER / HYPOTHESES)
    assert {row["corrected_p"] for row in hypotheses} == {""}
    assert len(read_csv(study.out / FOLDER / RUNS)) == len(rows) - 1


@pytest.mark.parametrize(
    ("outcomes", "claim"),
    [
        (["better", "better"], "confirmed"),
        (["better", "undecided"], "open"),
        (["undecided", "equivalent"], "not confirmed"),
        (["better", "worse"], "not confirmed"),
        (["better", "not judged"], "not judged"),
    ],
)
def test_the_claim_needs_every_comparison(outcomes, claim):
    assert conclude(outcomes) == claim


def test_published_rows_are_not_computed_again(study):
    rows = write_rows(study)
    assert not any(cost.missing or cost.tests for cost in study.grid.costs())
    write_csv(
        study.out / FOLDER / RUNS,
        [row for row in rows if (row["task"], row["seed"]) != ("acrobot", 3)],
    )
    missing = {cost.arm.name: format_ranges(cost.missing) for cost in study.grid.costs()}
    assert {name: seeds for name, seeds in missing.items() if seeds} == {
        "acrobot: ideal": "3",
        "acrobot: through": "3",
    }


def test_one_job_publishes_each_training_and_goes_by_seed(study, monkeypatch):
    parts = []
    monkeypatch.setattr(Grid, "compute", lambda grid, *_, **__: parts.append(tuple(grid.cells)))
    dataclasses.replace(study, workers=Workers(jobs=1)).run()
    *single, whole = parts
    assert single == [(cell,) for cell in whole]
    assert whole == tuple(study.grid.cells)
    seeds = [seed for _, seed in whole]
    assert seeds == sorted(seeds)
    assert {name.partition(":")[0] for name, seed in whole if seed == SEEDS - 1} == set(SETTINGS)


def test_the_study_is_that_of_the_plan():
    plan, grid = " ".join(PLAN.read_text().split()), ClaimStudy().grid
    assert f"There are {len(grid.cells)} trainings and {len(grid.policy_tests)} tests" in plan
    assert f"Each of the {len(cells())} comparisons has two hypotheses" in plan
    assert f"in {grid.episodes} episodes" in plan
    assert f"less than {MARGIN} of the span" in plan
    for arm in grid.arms:
        title = study_claim.TITLES[arm.task]
        row = re.search(rf"\| {title} \| (\w+) \| (\w+) \| (.*?) \| (\d+) \|", plan)
        assert row[1].lower() == arm.config.agent.name
        assert row[2] == SETTINGS[arm.task]
        budget = arm.config.total_episodes or arm.config.total_steps // 4000
        assert row[3].split()[0] == str(budget)
        assert int(row[4]) == len(grid.seeds_of(arm))


def test_policies_are_trained_and_tested_on_the_paper_s_motor():
    paper_arms = {(arm.task, arm.settings, arm.motor, arm.physics): arm for arm in ARMS}
    for task, settings in SETTINGS.items():
        through = study_claim.arm(task, "through").config
        assert through == paper_arms[task, settings, "paper gains", "mujoco"].config
        ideal = study_claim.arm(task, "ideal").config
        assert ideal == paper_arms[task, settings, "ideal", "mujoco"].config
        envs = evaluation_envs(task)
        assert envs["24 V"].actuator == through.actuator
        assert envs["ideal"].actuator == ideal.actuator
        limits = [envs[f"{volts:g} V"].actuator.controller.max_voltage for volts in VOLTAGES]
        assert limits == [24.0, 12.0, 5.0]
        for env in envs.values():
            assert env.options == through.env.options
            assert env.max_episode_steps is None


@pytest.mark.parametrize("task", LOW_VOLTAGE_TASKS)
def test_a_car_s_motor_stays_below_the_lowest_supply(task):
    """Full force against and with the motion, as a policy may command it, does not saturate."""
    env = evaluation_envs(task)["24 V"].build()
    force = (0, 2) if task == "mountain_car" else (np.array([-1.0]), np.array([1.0]))
    env.reset(seed=0)
    voltages = []
    for step in range(190):
        velocity = env.unwrapped.state[1]
        info = env.step(force[int(velocity > 0) if step < 60 else step % 2])[-1]
        voltages.append(abs(info["voltage"]))
    env.close()
    assert 0.5 < max(voltages) < min(VOLTAGES)
