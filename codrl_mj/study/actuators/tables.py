"""The study's numbers as CSV files, so that every number of the page is a row."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import mapping_of
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.study.actuators.verdicts import Scores, Verdict, seeds_to_close
from codrl_mj.study.tables import write_csv
from codrl_mj.study.trials import Collected

RUNS, TRIALS, HYPOTHESES = "runs.csv", "trials.csv", "hypotheses.csv"
"""Rows are: a policy in a test; all policies of an arm in a test; a hypothesis."""
MEASURES = (
    "success",
    "tracking_percent",
    "saturated_percent",
    "rms_current",
    "peak_current",
    "energy_drawn",
    "copper_loss",
    "mechanical_work",
    "torque_rms",
    "reversals",
)
"""What is tabulated besides score and return: fields of `codrl_mj.evaluation.Evaluation`."""


def runs(collected: Collected, scores: Scores) -> Iterable[dict[str, Any]]:
    """A row for every policy and test; units are those of docs/evaluation.md."""
    for trial in collected.grid.trials:
        mine = scores.of(trial)
        measured = {name: collected.scores(trial, name) for name in ("returns", *MEASURES)}
        for seed in collected.evaluations[trial.name]:
            yield {
                "task": trial.arm.task,
                "trained": trial.arm.name.partition(": ")[2],
                "tested": trial.test,
                "seed": seed,
                "score": mine.get(seed),
                **{name: found.get(seed) for name, found in measured.items()},
                "run": collected.folders[trial.arm.name, seed].name,
            }


def trials(collected: Collected, scores: Scores) -> Iterable[dict[str, Any]]:
    """A row for every trial: mean score with its 95 % bootstrap interval over policies, and means of the measures."""
    for trial in collected.grid.trials:
        mine = np.array(list(scores.of(trial).values()))
        if not mine.size:
            continue
        mean = bootstrap_mean(mine)
        measured = {name: list(collected.scores(trial, name).values()) for name in ("returns", *MEASURES)}
        env = trial.env
        yield {
            "task": trial.arm.task,
            "trained": trial.arm.name.partition(": ")[2],
            "tested": trial.test,
            "policies": len(mine),
            "score": mean.mean,
            "low": mean.low,
            "high": mean.high,
            "worst": mine.min(),
            "best": mine.max(),
            **{name: np.mean(found) if found else None for name, found in measured.items()},
            "actuator": mapping_of(env.actuators[0]) or "ideal",
            "joint": env.joint.friction,
            "command_delay": env.disturbances.command_delay,
        }


def hypotheses(verdicts: Sequence[Verdict]) -> Iterable[dict[str, Any]]:
    """A row for every hypothesis."""
    for verdict in verdicts:
        hypothesis = verdict.hypothesis
        yield {
            "name": hypothesis.name,
            "question": hypothesis.question,
            "statement": hypothesis.statement,
            "kind": hypothesis.kind,
            "contrasts": verdict.strata[1],
            "tested": verdict.strata[0],
            "policies": min(verdict.runs),
            "effect": verdict.effect.mean,
            "low": verdict.effect.low,
            "high": verdict.effect.high,
            "p": verdict.p,
            "corrected_p": verdict.corrected,
            "outcome": verdict.outcome,
            "seeds_to_close": seeds_to_close(verdict) if verdict.outcome == "open" else None,
            "compared": "; ".join(f"{pair.one.name} over {pair.other.name}" for pair in hypothesis.contrasts),
        }


def write(collected: Collected, scores: Scores, verdicts: Sequence[Verdict], folder: Path) -> list[Path]:
    """Write the files into a folder."""
    rows = {RUNS: runs(collected, scores), TRIALS: trials(collected, scores), HYPOTHESES: hypotheses(verdicts)}
    for name, table in rows.items():
        write_csv(folder / name, list(table))
    return [folder / name for name in rows]
