"""The reproduction's numbers as files: every claim and every run as CSV, and all of it as JSON."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import write_json, writing
from codrl_mj.study.reproduction.claims import Claim
from codrl_mj.study.reproduction.reproduce import Findings
from codrl_mj.study.reproduction.series import LAST, Series
from codrl_mj.study.reproduction.verdicts import Verdict

CLAIMS, RUNS, EVERYTHING = "claims.csv", "runs.csv", "findings.json"
CLAIM_COLUMNS = (
    "task",
    "physics",
    "source",
    "section",
    "statement",
    "measure",
    "confirmed_if",
    "mean",
    "low",
    "high",
    "seeds",
    "seconds",
    "verdict",
    "why",
)
"""`mean`, `low` and `high` of ours over seeds; `seconds`: mean wall-clock time of a training that it is about."""
TESTED = (
    "returns",
    "success",
    "time_to_goal",
    "tracking_rms",
    "tracking_percent",
    "tracking_max",
    "saturated_percent",
    "peak_voltage",
)
"""Measures of the test in `RUNS`, as docs/evaluation.md has them: means, and the median time to the goal."""
RUN_COLUMNS = ("task", "settings", "motor", "gains", "physics", "seed", "run", "seconds", f"last_{LAST}", *TESTED)


def write(findings: Findings, folder: Path) -> list[Path]:
    """Write the three files into a folder."""
    _write_csv(folder / CLAIMS, CLAIM_COLUMNS, (claim_row(findings, *one) for one in findings.claims))
    _write_csv(folder / RUNS, RUN_COLUMNS, run_rows(findings.evidence.series.values()))
    write_json(folder / EVERYTHING, as_mapping(findings))
    return [folder / name for name in (CLAIMS, RUNS, EVERYTHING)]


def _write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    with writing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def seconds_of(findings: Findings, claim: Claim) -> float | None:
    """Mean wall-clock time of the trainings that a claim is about [s]; None if there are none."""
    series = [findings.evidence.series[name] for name in claim.arms]
    took = [run.seconds for one in series for run in one.runs.values()]
    return float(np.mean(took)) if took else None


def claim_row(findings: Findings, claim: Claim, verdict: Verdict) -> dict[str, Any]:
    """A claim and its verdict, by `CLAIM_COLUMNS`."""
    mean, low, high = (None, None, None) if verdict.measured is None else verdict.measured
    values = (
        *(claim.task, claim.physics, claim.source, claim.section, claim.statement, claim.measure),
        *(claim.check.criterion, mean, low, high, verdict.samples, seconds_of(findings, claim)),
        *(verdict.outcome, verdict.reason),
    )
    return dict(zip(CLAIM_COLUMNS, values, strict=True))


def run_rows(every: Iterable[Series]) -> list[dict[str, Any]]:
    """Every finished run, by `RUN_COLUMNS`."""
    rows = []
    for series in every:
        arm = series.arm
        for seed, run in series.runs.items():
            alone = series.only({seed})
            last = alone.last_returns()
            tested = {name: next(iter(alone.tested(name)), None) for name in TESTED}
            values = (
                *(arm.task, arm.settings, arm.motor, arm.gains, arm.physics, seed, run.folder.name, run.seconds),
                float(last[0]) if len(last) else None,
                *(None if value is None else float(value) for value in tested.values()),
            )
            rows.append(dict(zip(RUN_COLUMNS, values, strict=True)))
    return rows


def as_mapping(findings: Findings) -> dict[str, Any]:
    """Everything as JSON-serialisable values."""
    plan, evidence = findings.plan, findings.evidence
    return {
        "plan": {name: getattr(plan, name) for name in ("seeds", "sarsa_seeds", "episodes", "test_episodes")}
        | {"tasks": list(plan.tasks)},
        "claims": [claim_row(findings, *one) for one in findings.claims],
        "missing": {name: list(one.missing) for name, one in evidence.series.items() if one.missing},
        "failures": {name: dict(one.failures) for name, one in evidence.series.items() if one.failures},
        "runs": run_rows(evidence.series.values()),
        "value_iteration": [optimum.as_mapping() for optimum in evidence.optima],
        "values_of_start": [{"discount": discount, "value": value} for discount, value in findings.values.items()],
    }
