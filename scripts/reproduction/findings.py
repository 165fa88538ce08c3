"""What the reproduction found, as rows: of run folders that are at hand, and of trainings that are published."""

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
"""Verdicts; the plan, what is missing, and what value iteration finds."""
Runs = Mapping[str, Sequence[Row]]
"""Published rows by arm."""


@dataclasses.dataclass(frozen=True)
class Findings:
    """What there is, and what it says."""

    plan: Mapping[str, Any]
    """Numbers of episodes of trainings and tests."""
    runs: Runs
    """Published rows by arm."""
    verdicts: Sequence[tuple[Claim, Verdict]]
    """Every claim with what it came to, p not corrected."""
    tables: Mapping[str, Table]
    """What figures are drawn of, by file."""
    optima: Sequence[Optimum]
    """The continuous mountain car's best policies at `DISCOUNTS`; none without that task."""
    values: Mapping[float, float]
    """What its start is worth, by discount factor."""
    missing: Mapping[str, Sequence[int]]
    """Arm -> seeds that are planned, and whose rows lack what is judged by."""
    failures: Mapping[str, str]
    """What went wrong."""


def published_rows(folder: Path, plan: Mapping[str, Any]) -> dict[tuple[str, ...], list[Row]]:
    """Published rows by what they are of, unless they are of other trainings and tests."""
    file = folder / EVERYTHING
    before = read_json(file, "findings")["plan"] if file.is_file() else {}
    alike = file.is_file() and all(before.get(name) == of for name, of in plan.items())
    return read_rows(folder) if alike else {}


def gather(grid: Grid, plan: Mapping[str, Any], published: Path, mesh: Mesh) -> Findings:
    """Read what is finished, and judge every claim by it; runs nothing but value iteration and single episodes.

    Args:
        grid: trainings and tests, of which those at hand have their rows made.
        plan: numbers of episodes of trainings and tests.
        published: folder of the published files: a training that is not at hand has its row there.
        mesh: of value iteration.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    found, before = grid.collect(), published_rows(published, plan)
    chosen = {arm.name for arm in grid.arms}
    arms = [arm for arm in ARMS if arm.name in chosen or any(of[0] == arm.task for of in before)]
    at_hand = {arm.name: read_trained(arm, found) for arm in arms if arm.name in chosen}
    runs, missing = dict[str, list[Row]](), dict[str, list[int]]()
    for arm in arms:
        rows = arm_rows(arm, at_hand.get(arm.name, {}), before)
        runs[arm.name] = [row for seed in sorted(rows) for row in rows[seed]]
        planned = grid.seeds_of(arm) if arm.name in chosen else ()
        absent = [seed for seed in planned if not complete(rows.get(seed, ()), needed(arm.name))]
        missing |= {arm.name: absent} if absent else {}
    driven = any(arm.task == TASK for arm in arms)
    model = Model(mesh) if driven else None
    tasks = {arm.task for arm in arms}
    return Findings(
        plan=plan,
        runs=runs,
        verdicts=[(claim, claim.judge(runs)) for claim in CLAIMS if claim.task in tasks],
        tables=gather_tables(arms, at_hand, published if before else Path("nowhere")),
        optima=[optimum(model, discount) for discount in DISCOUNTS] if model else [],
        values=values_over(model, VALUE_DISCOUNTS) if model else {},
        missing=missing,
        failures=found.failures,
    )


def arm_rows(
    arm: PaperArm, at_hand: Mapping[int, Trained], before: Mapping[tuple[str, ...], Sequence[Row]]
) -> dict[int, list[Row]]:
    """An arm's rows by seed: those that are published, and of runs at hand that are not."""
    rows = {
        int(of[-1]): list(found) for of, found in before.items() if of == identity(arm, int(of[-1]))
    }
    for seed, run in at_hand.items():
        mine = rows.get(seed, [])
        if not complete([row for row in mine if row["run"] == run.folder.name], needed(arm.name)):
            rows[seed] = joined(mine, run_row(arm, seed, run))
    return rows


def claim_rows(verdicts: Sequence[tuple[Claim, Verdict]]) -> list[dict[str, Any]]:
    """Claims and their verdicts; p corrected for all comparisons of the same source (Holm)."""
    corrected: dict[int, float] = {}
    for ours in (False, True):
        compared = [
            n for n, (claim, verdict) in enumerate(verdicts) if _compared(claim, verdict, ours)
        ]
        corrected |= dict(
            zip(compared, holm([verdicts[n][1].p or 0.0 for n in compared]).tolist(), strict=True)
        )
    return [
        _claim_row(claim, verdict, corrected.get(n)) for n, (claim, verdict) in enumerate(verdicts)
    ]


def _compared(claim: Claim, verdict: Verdict, ours: bool) -> bool:
    return verdict.p is not None and (claim.source != PAPER_SAYS) == ours


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
        "seeds": verdict.samples,
        "p": verdict.p,
        "p_corrected": corrected,
        "verdict": verdict.outcome,
        "why": verdict.reason,
    }


def write_files(findings: Findings, folder: Path) -> list[Path]:
    """Write everything as tables, and what is none as JSON, into a folder."""
    tables: dict[str, Iterable[Mapping[str, Any]]] = {
        CLAIM_ROWS: claim_rows(findings.verdicts),
        RUNS: [row for rows in findings.runs.values() for row in rows],
        **findings.tables,
    }
    for name, rows in tables.items():
        write_csv(folder / name, list(rows))
    rest = {name: getattr(findings, name) for name in ("plan", "missing", "failures")} | {
        "value_iteration": [one.as_mapping() for one in findings.optima],
        "values_of_start": [
            {"discount": discount, "value": value} for discount, value in findings.values.items()
        ],
    }
    write_json(folder / EVERYTHING, rest)
    return [folder / name for name in (*tables, EVERYTHING)]
