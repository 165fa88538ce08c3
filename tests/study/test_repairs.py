"""The ablation of the continuous car's repairs: its plan, and its verdicts on made-up rows."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import study_repairs
from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.pages import read_csv, write_csv
from codrl_mj.study.trials import format_ranges
from reproduction.page import FOLDER as REPRODUCTION
from reproduction.rows import RUNS
from study_repairs import (
    FOLDER,
    NEEDED,
    NOT_JUDGED,
    NOT_NEEDED,
    OPEN,
    PAGE,
    REPAIRS,
    Judged,
    RepairsStudy,
    judge_rows,
    reference,
    without,
)
from tests.study.reproduction.worlds import made_up

PLAN = Path(__file__).parents[2] / "docs/results/repairs_plan.md"
# Arm -> return in test; a seed's is at most 0.5 away.
RETURNS = {
    "all": 93.0,
    "none": 0.0,
    "discount": 1.0,
    "learning rates": 93.0,
    "targets": 95.0,
    "velocity scale": 87.5,
    "noise": 91.0,
}


def rows_of(arm, level, seeds=range(5)):
    return [made_up(arm, n, test=level, last=level, success=float(level > 90)) for n in seeds]


@pytest.fixture
def study(tmp_path):
    """Return the study with the reproduction's rows, and with rows of all arms."""
    for folder in (FOLDER, REPRODUCTION):
        (tmp_path / folder).mkdir()
    pairs = (("repaired", "all"), ("paper", "none"))
    before = [row for kind, name in pairs for row in rows_of(reference(kind), RETURNS[name])]
    write_csv(tmp_path / REPRODUCTION / RUNS, before)
    new = [row for name in REPAIRS for row in rows_of(without(name), RETURNS[name])]
    write_csv(tmp_path / FOLDER / RUNS, new)
    return RepairsStudy(root=tmp_path / "runs", out=tmp_path)


def test_an_arm_leaves_out_one_repair_and_all_together_are_the_repaired_settings():
    printed, repaired = reference("paper").config.agent, reference("repaired").config.agent
    fields = [field.name for field in dataclasses.fields(printed)]
    changed = {name for name in fields if getattr(printed, name) != getattr(repaired, name)}
    assert changed == {name for names in REPAIRS.values() for name in names}
    for repair, names in REPAIRS.items():
        arm = without(repair)
        for name in fields:
            source = printed if name in names else repaired
            assert getattr(arm.config.agent, name) == getattr(source, name)
        assert dataclasses.replace(arm.config, agent=repaired) == reference("repaired").config
        assert arm.actuator == reference("paper").actuator


def test_made_up_repairs_get_their_verdicts(study):
    judged = {item.name: item for item in judge_rows(study.rows())}
    outcomes = {name: judged[name].outcome for name in REPAIRS}
    assert outcomes == {
        "discount": NEEDED,
        "learning rates": NOT_NEEDED,
        "targets": NOT_NEEDED,
        "velocity scale": OPEN,  # 5.5 lower, and the interval reaches 5
        "noise": NOT_NEEDED,
    }
    assert judged["discount"].difference.mean == pytest.approx(-92.0)
    assert (judged["all"].learning, judged["discount"].learning) == (5, 0)
    study.write()
    page = (study.out / PAGE).read_text()
    assert re.search(
        r"\| all without discount \| 1\.0 \| 1\.0 \| 0 of 5 \| -92\.0 \[-\S+, -\S+\] \| \*\*needed",
        page,
    )
    assert "5 seeds of every arm are judged" in page
    assert len(read_csv(study.out / FOLDER / RUNS)) == 5 * len(REPAIRS)


@pytest.mark.parametrize(
    ("low", "high", "outcome"),
    [
        (-9.0, -5.1, NEEDED),
        (-9.0, -5.0, OPEN),
        (-5.0, 9.0, NOT_NEEDED),
        (-5.1, 1.0, OPEN),
    ],
)
def test_an_interval_beyond_the_margin_decides(low, high, outcome):
    difference = Interval((low + high) / 2, low, high)
    assert Judged("noise", np.zeros((5, 3)), difference).outcome == outcome


def test_only_seeds_of_all_arms_are_judged_and_two_are_needed(study):
    rows = study.rows()
    rows["noise"] = {seed: row for seed, row in rows["noise"].items() if seed < 2}
    assert {len(item.values) for item in judge_rows(rows)} == {2}
    del rows["noise"][1]
    assert {item.outcome for item in judge_rows(rows)} == {NOT_JUDGED}
    rows["noise"] = {}
    assert {len(item.values) for item in judge_rows(rows)} == {0}


def test_published_rows_are_not_trained_again(study):
    assert not study.grid.cells
    remaining = [row for row in read_csv(study.out / FOLDER / RUNS) if row["seed"] != "3"]
    write_csv(study.out / FOLDER / RUNS, remaining)
    assert {format_ranges(cost.missing) for cost in study.grid.costs()} == {"3 to 4"}
    (study.out / FOLDER / RUNS).unlink()
    assert len(study.grid.cells) == 5 * len(REPAIRS)


def test_the_study_is_that_of_the_plan():
    plan, study = " ".join(PLAN.read_text().split()), RepairsStudy()
    assert f"need {len(study.every.cells)} new trainings" in plan
    assert f"in {study.every.episodes} episodes" in plan
    assert f"at a level of {100 * study_repairs.CONFIDENCE:g} %" in plan
    assert f"The margin is {study_repairs.MARGIN:g}" in plan
    assert f"{reference('paper').config.total_episodes} episodes" in plan
