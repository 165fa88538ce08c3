"""Learning curves of the study: each run's return in every tenth of its budget.

They are published because run folders are not kept.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs import EPISODES, RESULT
from codrl_mj.runs.files import read_json
from codrl_mj.study.pages import read_csv
from codrl_mj.study.trials import StudyResults

LEARNING = "learning.csv"
"""File with a row for every run: mean return of the episodes that ended in each tenth."""
TENTHS = tuple(f"tenth_{number}" for number in range(1, 11))


def learning_rows(collected: StudyResults, published: Path) -> list[dict[str, Any]]:
    """Return a row for every run: the published one, or else one from its run folder."""
    known = {row["run"]: row for row in read_csv(published)}
    rows: list[dict[str, Any]] = []
    for (name, seed), folder in collected.folders.items():
        # A run folder's name is the hash of its configuration, so a published row with it is
        # still valid.
        if folder.name in known:
            rows.append(dict(known[folder.name]))
        elif (folder / RESULT).is_file():
            task, _, trained = name.partition(": ")
            rows.append(
                {"task": task, "trained": trained, "seed": seed}
                | _tenths(folder)
                | {"run": folder.name}
            )
    return rows


def _tenths(folder: Path) -> dict[str, Any]:
    """Return a run's steps and its mean return in every tenth of them; None if no episode ended."""
    steps = int(read_json(folder / RESULT, "result of a run")["steps"])
    episodes = read_csv(folder / EPISODES)
    ends = np.array([float(row["steps"]) for row in episodes])
    returns = np.array([float(row["return"]) for row in episodes])
    tenth = np.minimum(np.ceil(10.0 * ends / steps), 10.0)
    means = [
        float(returns[tenth == index].mean()) if (tenth == index).any() else None
        for index in range(1, 11)
    ]
    return {"steps": steps} | dict(zip(TENTHS, means, strict=True))


def still_rising(
    rows: Sequence[Mapping[str, Any]], spans: Mapping[str, float], margin: float
) -> tuple[list[str], int]:
    """Return the arms whose return still rises: the last tenth above the eighth by a margin.

    Args:
        rows: rows of `learning_rows`.
        spans: task -> span of the score, by which a rise is divided.
        margin: smallest rise that counts.

    Returns:
            Names of these arms, and the number of all arms; tasks without a span are not counted.
    """
    arms: dict[str, list[float]] = {}
    for row in rows:
        last, before = (
            float(row[TENTHS[index]]) if row[TENTHS[index]] not in (None, "") else math.nan
            for index in (9, 7)
        )
        if row["task"] in spans and not math.isnan(last - before):
            arms.setdefault(f"{row['task']}: {row['trained']}", []).append(
                (last - before) / spans[row["task"]]
            )
    return [name for name, rises in arms.items() if float(np.mean(rises)) > margin], len(arms)
