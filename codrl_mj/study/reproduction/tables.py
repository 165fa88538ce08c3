"""The reproduction's numbers as files: every claim and every run as CSV, and all of it as JSON."""

from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import write_json
from codrl_mj.study.reproduction.claims import Claim
from codrl_mj.study.reproduction.reproduce import Findings
from codrl_mj.study.reproduction.series import LAST, Series
from codrl_mj.study.reproduction.verdicts import Verdict
from codrl_mj.study.tables import write_csv

CLAIMS, RUNS, EVERYTHING = "claims.csv", "runs.csv", "findings.json"
TESTED = (
    *("returns", "success", "time_to_goal", "tracking_rms", "tracking_percent", "tracking_max"),
    *("saturated_percent", "peak_voltage"),
)
"""Measures of the test in `RUNS`, as docs/evaluation.md has them: means, and the median time to the goal."""


def write(findings: Findings, folder: Path) -> list[Path]:
    """Write the three files into a folder."""
    everything = as_mapping(findings)
    write_csv(folder / CLAIMS, everything["claims"])
    write_csv(folder / RUNS, everything["runs"])
    write_json(folder / EVERYTHING, everything)
    return [folder / name for name in (CLAIMS, RUNS, EVERYTHING)]


def claim_row(findings: Findings, claim: Claim, verdict: Verdict) -> dict[str, Any]:
    """A claim and its verdict: ours over seeds, and the mean wall-clock time of a training that it is about [s]."""
    mean, low, high = verdict.measured or (None, None, None)
    took = [run.seconds for name in claim.arms for run in findings.series[name].runs.values()]
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


def run_rows(series: Series) -> list[dict[str, Any]]:
    """The finished runs of an arm."""
    rows = []
    for seed, run in series.runs.items():
        alone = series.only({seed})
        measured = {f"last_{LAST}": alone.last_returns()} | {name: alone.tested(name) for name in TESTED}
        row = {name: getattr(series.arm, name) for name in ("task", "settings", "motor", "gains", "physics")}
        row |= {"seed": seed, "run": run.folder.name, "seconds": run.seconds}
        rows.append(row | {name: float(one[0]) if len(one) else None for name, one in measured.items()})
    return rows


def as_mapping(findings: Findings) -> dict[str, Any]:
    """Everything as JSON-serialisable values."""
    plan = findings.plan
    return {
        "plan": {name: getattr(plan, name) for name in ("seeds", "sarsa_seeds", "episodes", "test_episodes")}
        | {"tasks": list(plan.tasks)},
        "claims": [claim_row(findings, *one) for one in findings.claims],
        "missing": findings.missing,
        "failures": dict(findings.found.failures),
        "runs": [row for series in findings.series.values() for row in run_rows(series)],
        "value_iteration": [optimum.as_mapping() for optimum in findings.optima],
        "values_of_start": [{"discount": discount, "value": value} for discount, value in findings.values.items()],
    }
