"""How policies learned: what each run returned in every tenth of its budget; published, for run folders do not stay."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs import EPISODES, RESULT
from codrl_mj.runs.files import read_json
from codrl_mj.study.pages import read_csv
from codrl_mj.study.trials import Collected

LEARNING = "learning.csv"
"""A row for every run: the mean return of its training episodes that ended in each tenth of its steps."""
TENTHS = tuple(f"tenth_{number}" for number in range(1, 11))


def learning_rows(collected: Collected, published: Path) -> list[dict[str, Any]]:
    """The published row of every run, whose name stands for its configuration, or else one of what is at hand."""
    known = {row["run"]: row for row in read_csv(published)}
    found: list[dict[str, Any]] = []
    for (name, seed), folder in collected.folders.items():
        if folder.name in known:
            found.append(dict(known[folder.name]))
        elif (folder / RESULT).is_file():
            task, _, trained = name.partition(": ")
            found.append(
                {"task": task, "trained": trained, "seed": seed}
                | _tenths(folder)
                | {"run": folder.name}
            )
    return found


def _tenths(folder: Path) -> dict[str, Any]:
    """A run's steps, and its mean return in every tenth of them; None where no episode ended."""
    steps = int(read_json(folder / RESULT, "result of a run")["steps"])
    episodes = read_csv(folder / EPISODES)
    ends = np.array([float(row["steps"]) for row in episodes])
    returns = np.array([float(row["return"]) for row in episodes])
    tenth = np.minimum(np.ceil(10.0 * ends / steps), 10.0)
    means = [
        float(returns[tenth == one].mean()) if (tenth == one).any() else None
        for one in range(1, 11)
    ]
    return {"steps": steps} | dict(zip(TENTHS, means, strict=True))


def still_rising(
    rows: Sequence[Mapping[str, Any]], spans: Mapping[str, float], margin: float
) -> tuple[list[str], int]:
    """The arms whose mean return of the last tenth is above that of the eighth by a margin, in shares of spans.

    Returns:
        Their names, and of how many arms; of a task without a span none is counted.
    """
    arms: dict[str, list[float]] = {}
    for row in rows:
        last, before = (
            float(row[TENTHS[at]]) if row[TENTHS[at]] not in (None, "") else math.nan
            for at in (9, 7)
        )
        if row["task"] in spans and not math.isnan(last - before):
            arms.setdefault(f"{row['task']}: {row['trained']}", []).append(
                (last - before) / spans[row["task"]]
            )
    return [name for name, rises in arms.items() if float(np.mean(rises)) > margin], len(arms)
