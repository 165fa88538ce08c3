"""What the reproduction found, as rows: from run folders, and from what is published of those that are not at hand."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import read_json, write_json
from codrl_mj.study.pages import write_csv
from codrl_mj.study.trials import Collected, Grid
from reproduction.arms import ARMS
from reproduction.claims import CLAIMS, Claim
from reproduction.series import LAST, Series, read_series
from reproduction.value_iteration import DISCOUNTS, TASK, Mesh, Model, Optimum, optimum, values_over

VALUE_DISCOUNTS = tuple(1 - 0.2 * 0.8**step for step in range(24))
"""Discount factors of the curve of values, from 0.8 to 0.999."""
FILES = {"claims": "claims.csv", "runs": "runs.csv"}
"""Parts of the findings that are tables -> their files."""
EVERYTHING = "findings.json"
"""All of them."""
TESTED = (
    *("returns", "success", "time_to_goal", "tracking_rms", "tracking_percent", "tracking_max"),
    *("saturated_percent", "peak_voltage"),
)
"""Measures of the test in a run's row, as docs/evaluation.md has them: means, and the median time to the goal."""


@dataclasses.dataclass(frozen=True)
class Findings:
    """What there is, and what it says."""

    found: Collected
    """What is at hand."""
    series: Mapping[str, Series]
    """The runs of every arm that are at hand, by its name."""
    optima: Sequence[Optimum]
    """The continuous mountain car's best policies at `DISCOUNTS`; none without that task."""
    rows: Mapping[str, Any]
    """Everything as JSON-serialisable values: the plan, claims, runs, and what is missing."""


def gather(grid: Grid, plan: Mapping[str, Any], published: Path, mesh: Mesh) -> Findings:
    """Read what is finished, and judge every claim by it; runs nothing but value iteration.

    Args:
        grid: trainings and tests.
        plan: numbers of seeds and episodes, and the tasks.
        published: folder of the published files. A run that is not at hand has its row there; what such runs were
            judged by was not published, so that a claim about them keeps its verdict.
        mesh: of value iteration.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    found, arms = grid.collect(), [arm for arm in ARMS if arm.task in plan["tasks"]]
    series = {arm.name: read_series(arm, found) for arm in arms}
    before = read_json(published / EVERYTHING, "findings") if (published / EVERYTHING).is_file() else {}
    if any(before.get("plan", {}).get(name) != plan[name] for name in ("episodes", "test_episodes")):
        before = {}  # of other trainings and tests
    identity = ("task", "settings", "motor", "physics", "seed")
    runs_before = {tuple(row[name] for name in identity): row for row in before.get("runs", ())}
    claims_before = {_identity(row): row for row in before.get("claims", ())}
    runs, missing, gone = [], dict[str, list[int]](), set()
    for arm in arms:
        absent = []
        for seed in grid.seeds_of(arm):
            row = runs_before.get((arm.task, arm.settings, arm.motor, arm.physics, seed))
            if seed in series[arm.name].runs:
                runs.append(run_row(series[arm.name], seed))
            elif row is not None:
                runs.append(row)
                gone.add(arm.name)
            else:
                absent.append(seed)
        missing |= {arm.name: absent} if absent else {}
    claims = []
    for claim in CLAIMS:
        if claim.task in plan["tasks"]:
            row = claim_row(claim, series)
            claims.append(claims_before.get(_identity(row), row) if gone & set(claim.arms) else row)
    driven = TASK in plan["tasks"]
    model = Model(mesh) if driven else None
    optima = [optimum(model, discount) for discount in DISCOUNTS] if model else []
    values = values_over(model, VALUE_DISCOUNTS) if model else {}
    return Findings(
        found,
        series,
        optima,
        {
            "plan": dict(plan),
            "claims": claims,
            "missing": missing,
            "failures": dict(found.failures),
            "runs": runs,
            "value_iteration": [one.as_mapping() for one in optima],
            "values_of_start": [{"discount": discount, "value": value} for discount, value in values.items()],
        },
    )


def _identity(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a claim's row is about."""
    return tuple(row[name] for name in ("task", "physics", "source", "statement", "measure", "criterion"))


def claim_row(claim: Claim, series: Mapping[str, Series]) -> dict[str, Any]:
    """A claim and its verdict: ours over seeds, and the mean wall-clock time of a training that it is about [s]."""
    verdict = claim.judge(series)
    mean, low, high = verdict.measured or (None, None, None)
    took = [run.seconds for name in claim.arms for run in series[name].runs.values()]
    names = ("task", "physics", "source", "section", "statement")
    return {name: getattr(claim, name) for name in names} | {
        "measure": claim.measure.text,
        "criterion": claim.check.criterion,
        "mean": mean,
        "low": low,
        "high": high,
        "seeds": verdict.samples,
        "seconds": float(np.mean(took)) if took else None,
        "verdict": verdict.outcome,
        "why": verdict.reason,
    }


def run_row(series: Series, seed: int) -> dict[str, Any]:
    """A finished run of an arm."""
    run, alone = series.runs[seed], series.only({seed})
    measured = {f"last_{LAST}": alone.last_returns()} | {name: alone.tested(name) for name in TESTED}
    row = {name: getattr(series.arm, name) for name in ("task", "settings", "motor", "gains", "physics")}
    row |= {"seed": seed, "run": run.folder.name, "seconds": run.seconds}
    return row | {name: float(one[0]) if len(one) else None for name, one in measured.items()}


def write_files(rows: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write the rows as CSV and JSON into a folder."""
    for part, name in FILES.items():
        write_csv(folder / name, rows[part])
    write_json(folder / EVERYTHING, rows)
    return [folder / name for name in (*FILES.values(), EVERYTHING)]
