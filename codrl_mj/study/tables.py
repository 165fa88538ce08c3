"""The mismatch study's numbers as CSV files: of every run, trial, comparison, training and actuator."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import writing
from codrl_mj.study.conditions import every_condition
from codrl_mj.study.mismatch import Results, cell_name
from codrl_mj.study.plan import Comparison, Plan, Trial
from codrl_mj.study.summaries import MEASURES, Summary, Verdict, by_question, judge, measure

RUNS, TRIALS, COMPARISONS = "runs.csv", "trials.csv", "comparisons.csv"
"""Rows are: a policy and a test; all policies of an arm on a test; a question, on one test or over several."""
ARRIVALS, ACTUATORS = "arrivals.csv", "actuators.csv"
"""Rows are: a training, with when it met the goal; an actuator, with what its name stands for."""


def write(results: Results, summary: Summary, folder: Path) -> list[Path]:
    """Write the files into a folder; units are those of docs/evaluation.md."""
    tables = {
        RUNS: _runs(results),
        TRIALS: _trials(results, summary),
        COMPARISONS: _comparisons(results, summary),
        ARRIVALS: _arrivals(results),
        ACTUATORS: _actuators(results),
    }
    for name, rows in tables.items():
        _write(folder / name, list(rows))
    return [folder / name for name in tables]


def _write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table whose header is the first row's keys; NaN and None are empty cells."""
    with writing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, rows[0] if rows else [], lineterminator="\n")
        out.writeheader()
        out.writerows({key: "" if _unknown(value) else value for key, value in row.items()} for row in rows)


def _unknown(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _runs(results: Results) -> Iterable[dict[str, Any]]:
    for result in results.trials.values():
        arm = result.trial.arm
        for seed, evaluation in result.evaluations.items():
            returns = evaluation["returns"]
            yield {
                "task": arm.task,
                "agent": arm.agent,
                "trained": arm.name,
                "tested": result.trial.test.name,
                "seed": seed,
                "episodes": evaluation["episodes"],
                "return": returns["mean"],
                "return_low": returns["low"],
                "return_high": returns["high"],
                **{name: measure(name, evaluation) for name in MEASURES},
            }


def _trials(results: Results, summary: Summary) -> Iterable[dict[str, Any]]:
    for name, of in summary.trials.items():
        trial, (middle, low, high) = results.trials[name].trial, of.interquartile_mean
        yield {
            "task": trial.arm.task,
            "trained": trial.arm.name,
            "tested": trial.test.name,
            "runs": of.runs,
            "mean": of.mean,
            "lowest": of.lowest,
            "highest": of.highest,
            "interquartile_mean": middle,
            "interquartile_low": low,
            "interquartile_high": high,
            **of.measures,
        }


def _comparisons(results: Results, summary: Summary) -> Iterable[dict[str, Any]]:
    for experiment, of in results.plans.items():
        for task, plan in of.items():
            for pair in plan.comparisons:
                if pair in summary.verdicts:
                    yield _row(experiment, task, summary.verdicts[pair])
        yield from (_row(experiment, over, verdict) for over, verdict in pooled(results, of))


def _row(experiment: str, task: str, verdict: Verdict) -> dict[str, Any]:
    probability, low, high = verdict.probability
    return {
        "experiment": experiment,
        "task": task,
        "question": verdict.question,
        "tests": "; ".join(verdict.tests),
        "runs_one": verdict.runs[0],
        "runs_other": verdict.runs[1],
        "one": verdict.one,
        "other": verdict.other,
        "probability_of_improvement": probability,
        "low": low,
        "high": high,
        "outcome": verdict.outcome,
    }


def pooled(results: Results, of: Mapping[str, Plan]) -> list[tuple[str, Verdict]]:
    """The questions of an experiment over all tests of each task, and over all tasks, where there are several."""
    comparisons: list[Comparison] = [pair for plan in of.values() for pair in plan.comparisons]
    verdicts = []
    for pairs in by_question(comparisons).values():
        by_task = {task: [pair for pair in pairs if pair.one.arm.task == task] for task in of}
        groups = {task: mine for task, mine in by_task.items() if len(mine) > 1}
        groups |= {"all tasks": pairs} if sum(map(bool, by_task.values())) > 1 else {}
        verdicts += [(label, verdict) for label, group in groups.items() if (verdict := judge(results, group))]
    return verdicts


def _arrivals(results: Results) -> Iterable[dict[str, Any]]:
    arms = {(result.trial.arm.task, result.trial.arm.name): result.trial.arm for result in results.trials.values()}
    for (task, name), arm in arms.items():
        own = results.trials.get(Trial(arm, arm.condition).name)
        for seed in range(results.config.seeds):
            met = results.arrivals.get(cell_name(task, name, seed))
            if met is not None:
                tested = own.evaluations.get(seed) if own else None
                yield {
                    "task": task,
                    "trained": name,
                    "seed": seed,
                    "episodes": met.episodes,
                    "arrived": met.arrived,
                    "first": met.first,
                    "return_in_test_there": tested["returns"]["mean"] if tested else None,
                }


def _actuators(results: Results) -> Iterable[dict[str, Any]]:
    used = {name for of in results.plans.values() for plan in of.values() for name in _names(plan.trials)}
    for task in results.config.tasks:
        for name, condition in every_condition(task).items():
            if name in used:
                yield {"task": task, "name": name, "is": condition.description}


def _names(trials: Iterable[Trial]) -> set[str]:
    return {name for trial in trials for name in (trial.test.name, trial.arm.condition.name)}
