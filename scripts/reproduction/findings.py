"""Results of the reproduction as rows: from run folders, and from published rows."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import read_json, write_json
from codrl_mj.study.inference import holm
from codrl_mj.study.pages import write_csv
from codrl_mj.study.trials import Grid
from reproduction.arms import ARMS, PaperArm
from reproduction.checks import Verdict
from reproduction.claims import CLAIMS, PAPER_SAYS, Claim, needed
from reproduction.drawn import Table, gather_tables
from reproduction.rows import (
    RUNS,
    Row,
    Trained,
    complete,
    identity,
    joined,
    read_rows,
    read_trained,
    run_row,
)
from reproduction.value_iteration import DISCOUNTS, TASK, Mesh, Model, Optimum, optimum, values_over

VALUE_DISCOUNTS = tuple(1 - 0.2 * 0.8**step for step in range(24))
"""Discount factors of the curve of values, from 0.8 to 0.999."""
CLAIM_ROWS, EVERYTHING = "claims.csv", "findings.json"
"""Files of the verdicts, and of the plan, missing runs and results of value iteration."""
Runs = Mapping[str, Sequence[Row]]
"""Arm -> published rows."""


@dataclasses.dataclass(frozen=True)
class Findings:
    """All results and verdicts."""

    plan: Mapping[str, Any]
    """Numbers of episodes of trainings and tests."""
    runs: Runs
    """Arm -> published rows."""
    verdicts: Sequence[tuple[Claim, Verdict]]
    """Claims with their verdicts, p not corrected."""
    tables: Mapping[str, Table]
    """File -> data of the figures."""
    optima: Sequence[Optimum]
    """Best policies of the continuous mountain car at `DISCOUNTS`; empty without that task."""
    values: Mapping[float, float]
    """Discount factor -> value of that task's start."""
    missing: Mapping[str, Sequence[int]]
    """Arm -> planned seeds whose rows lack a needed column."""
    failures: Mapping[str, str]
    """Name of a training -> its error."""


def published_rows(folder: Path, plan: Mapping[str, Any]) -> dict[tuple[str, ...], list[Row]]:
    """Return the published rows by identity, unless they are of other trainings and tests."""
    file = folder / EVERYTHING
    published_plan = read_json(file, "findings")["plan"] if file.is_file() else {}
    is_same_plan = file.is_file() and all(
        published_plan.get(name) == count for name, count in plan.items()
    )
    return read_rows(folder) if is_same_plan else {}


def gather(grid: Grid, plan: Mapping[str, Any], published: Path, mesh: Mesh) -> Findings:
    """Judge every claim by all finished runs; only value iteration and single episodes are run.

    Args:
        grid: trainings and tests; those with a run folder get new rows.
        plan: numbers of episodes of trainings and tests.
        published: folder of the published files, with rows of trainings without a run folder.
        mesh: mesh of value iteration.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    collected, published_by_identity = grid.collect(), published_rows(published, plan)
    chosen = {arm.name for arm in grid.arms}
    arms = [
        arm
        for arm in ARMS
        if arm.name in chosen or any(key[0] == arm.task for key in published_by_identity)
    ]
    at_hand = {arm.name: read_trained(arm, collected) for arm in arms if arm.name in chosen}
    runs, missing = dict[str, list[Row]](), dict[str, list[int]]()
    for arm in arms:
        rows = arm_rows(arm, at_hand.get(arm.name, {}), published_by_identity)
        runs[arm.name] = [row for seed in sorted(rows) for row in rows[seed]]
        planned = grid.seeds_of(arm) if arm.name in chosen else ()
        absent = [seed for seed in planned if not complete(rows.get(seed, ()), needed(arm.name))]
        missing |= {arm.name: absent} if absent else {}
    has_mountain_car = any(arm.task == TASK for arm in arms)
    model = Model(mesh) if has_mountain_car else None
    tasks = {arm.task for arm in arms}
    return Findings(
        plan=plan,
        runs=runs,
        verdicts=[(claim, claim.judge(runs)) for claim in CLAIMS if claim.task in tasks],
        tables=gather_tables(
            arms, at_hand, published if published_by_identity else Path("nowhere")
        ),
        optima=[optimum(model, discount) for discount in DISCOUNTS] if model else [],
        values=values_over(model, VALUE_DISCOUNTS) if model else {},
        missing=missing,
        failures=collected.failures,
    )


def arm_rows(
    arm: PaperArm, at_hand: Mapping[int, Trained], before: Mapping[tuple[str, ...], Sequence[Row]]
) -> dict[int, list[Row]]:
    """Return an arm's rows by seed: published ones, and new ones of runs that are not published."""
    rows = {
        int(key[-1]): list(key_rows)
        for key, key_rows in before.items()
        if key == identity(arm, int(key[-1]))
    }
    for seed, run in at_hand.items():
        seed_rows = rows.get(seed, [])
        if not complete(
            [row for row in seed_rows if row["run"] == run.folder.name], needed(arm.name)
        ):
            rows[seed] = joined(seed_rows, run_row(arm, seed, run))
    return rows


def claim_rows(verdicts: Sequence[tuple[Claim, Verdict]]) -> list[dict[str, Any]]:
    """Return claims with verdicts; p is corrected over all comparisons of a source (Holm)."""
    corrected: dict[int, float] = {}
    for is_port in (False, True):
        compared = [
            index
            for index, (claim, verdict) in enumerate(verdicts)
            if _compared(claim, verdict, is_port)
        ]
        corrected |= dict(
            zip(
                compared,
                holm([verdicts[index][1].p or 0.0 for index in compared]).tolist(),
                strict=True,
            )
        )
    return [
        _claim_row(claim, verdict, corrected.get(index))
        for index, (claim, verdict) in enumerate(verdicts)
    ]


def _compared(claim: Claim, verdict: Verdict, is_port: bool) -> bool:
    return verdict.p is not None and (claim.source != PAPER_SAYS) == is_port


def _claim_row(claim: Claim, verdict: Verdict, corrected: float | None) -> dict[str, Any]:
    mean, low, high = verdict.measured or (None, None, None)
    names = ("task", "source", "figure", "statement", "says", "settings")
    return {name: getattr(claim, name) for name in names} | {
        "counted": "yes" if claim.counted else "no",
        "arm": claim.arms[0],
        "against": claim.arms[1] if len(claim.arms) > 1 else "",
        "measure": claim.measure.text,
        "column": claim.measure.column,
        "rule": claim.check.rule,
        "least": claim.check.low,
        "most": claim.check.high,
        "criterion": claim.check.criterion,
        "mean": mean,
        "low": low,
        "high": high,
        "trainings": verdict.samples,
        "p": verdict.p,
        "p_corrected": corrected,
        "verdict": verdict.outcome,
        "why": verdict.reason,
    }


def write_files(findings: Findings, folder: Path) -> list[Path]:
    """Write the tables, and the other results as JSON, into a folder."""
    tables: dict[str, Iterable[Mapping[str, Any]]] = {
        CLAIM_ROWS: claim_rows(findings.verdicts),
        RUNS: [row for rows in findings.runs.values() for row in rows],
        **findings.tables,
    }
    for name, rows in tables.items():
        write_csv(folder / name, list(rows))
    other_results = {name: getattr(findings, name) for name in ("plan", "missing", "failures")} | {
        "value_iteration": [optimum.as_mapping() for optimum in findings.optima],
        "values_of_start": [
            {"discount": discount, "value": value} for discount, value in findings.values.items()
        ],
    }
    write_json(folder / EVERYTHING, other_results)
    return [folder / name for name in (*tables, EVERYTHING)]
