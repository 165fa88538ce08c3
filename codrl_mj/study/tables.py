"""The mismatch study's numbers as files: every run as CSV, everything that was computed from them as JSON."""

import csv
import dataclasses
import math
from pathlib import Path
from typing import Any

from codrl_mj.evaluation.measures import Interval
from codrl_mj.runs.files import write_json, writing
from codrl_mj.study.mismatch import Results
from codrl_mj.study.summaries import MEASURES, Summary, measure

RUNS, RESULTS = "runs.csv", "results.json"
"""A row for every policy and test; trials, comparisons and what is missing."""
COLUMNS = (
    "task",
    "agent",
    "trained",
    "tested",
    "seed",
    "episodes",
    "return",
    "return_low",
    "return_high",
    *MEASURES,
)
"""Columns of `RUNS`: `return` is the mean over the episodes, within 95 % bounds. Units as in docs/evaluation.md."""


def write(results: Results, summary: Summary, folder: Path) -> list[Path]:
    """Write both files into a folder."""
    with writing(folder / RUNS) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for result in results.trials.values():
            arm = result.trial.arm
            for seed, evaluation in result.evaluations.items():
                returns = evaluation["returns"]
                rows.writerow(
                    [
                        *(arm.task, arm.agent, arm.name, result.trial.test.name, seed, evaluation["episodes"]),
                        *(returns[key] for key in ("mean", "low", "high")),
                        *(measure(name, evaluation) for name in MEASURES),
                    ]
                )
    write_json(folder / RESULTS, as_mapping(results, summary))
    return [folder / RUNS, folder / RESULTS]


def as_mapping(results: Results, summary: Summary) -> dict[str, Any]:
    """Everything as JSON-serialisable values; intervals are mappings of `mean`, `low` and `high`, null if unknown."""
    trials = {}
    for name, result in results.trials.items():
        arm, of_it = result.trial.arm, summary.trials.get(name)
        trials[name] = {
            "task": arm.task,
            "trained": arm.name,
            "tested": result.trial.test.name,
            "returns": {seed: evaluation["returns"]["mean"] for seed, evaluation in result.evaluations.items()},
            "summary": None if of_it is None else _plain(dataclasses.asdict(of_it)),
        }
    comparisons = [
        {"experiment": experiment, "task": task, "outcome": verdict.outcome, **_plain(dataclasses.asdict(verdict))}
        for experiment, of in results.plans.items()
        for task, plan in of.items()
        for pair in plan.comparisons
        if (verdict := summary.verdicts.get(pair)) is not None
    ]
    return {
        "config": _plain(dataclasses.asdict(results.config)),
        "runs": results.runs,
        "seconds": results.seconds,
        "codes": dict(results.codes),
        "untrained": list(results.untrained),
        "untested": list(results.untested),
        "failures": dict(results.failures),
        "arrivals": {name: dataclasses.asdict(arrivals) for name, arrivals in results.arrivals.items()},
        "trials": trials,
        "comparisons": comparisons,
    }


def _plain(value: Any) -> Any:
    """JSON-serialisable values; NaN, which JSON has not, as None."""
    if isinstance(value, Interval):
        return {name: _plain(number) for name, number in value._asdict().items()}
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and math.isnan(value) else value
