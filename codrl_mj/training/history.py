"""What happened in a training: a table of episodes, a table of reports, and the learning curve that they make."""

import csv
import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from codrl_mj.runs.files import atomic_write
from codrl_mj.viz.pages.plots import Curve, Plot, save

WINDOW = 100
"""Training episodes that means are taken over."""
_DOTS = 4000
"""Most training episodes of a learning curve that are drawn one by one."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a training run stands, at the end of a rollout."""

    steps: int
    """Environment steps so far."""
    episodes: int
    """Training episodes that ended so far."""
    mean_return: float
    """Mean return of the last 100 training episodes (NaN before the first ends)."""
    mean_length: float
    """Mean length of the same episodes [steps]."""
    torque_error: float
    """Root mean square of desired minus delivered torque at the motor shaft [N*m] at the ends of
    the environment steps since the last report; an evaluation's is over all integration steps.
    """
    evaluation_return: float
    """Mean return of the evaluation that took place then (NaN where none did)."""
    steps_per_second: float
    """Environment steps per second since training started or was continued."""
    seconds: float
    """Wall-clock time spent on the run so far [s], interruptions excluded."""


REPORT_COLUMNS = tuple(field.name for field in dataclasses.fields(Progress))
EPISODE_COLUMNS = ("episode", "steps", "return", "length")
"""Number of the episode from 1, environment steps of the run when it ended, its return and its length [steps]."""


def read_episodes(path: Path) -> np.ndarray:
    """The table of a run's training episodes, shape (n, 4), columns `EPISODE_COLUMNS`; any other is refused."""
    with path.open(newline="") as file:
        header, *rows = [*csv.reader(file)] or [[]]
    try:
        if tuple(header) != EPISODE_COLUMNS:
            raise ValueError(f"columns {','.join(header)!r}: must be {','.join(EPISODE_COLUMNS)!r}")
        return np.array(rows, dtype=np.float64).reshape(-1, len(EPISODE_COLUMNS))
    except ValueError as error:
        raise ValueError(f"{path}: not a table of episodes: {error}") from None


def learning_curves(
    episodes: np.ndarray, steps: np.ndarray, evaluations: np.ndarray
) -> list[Curve]:
    """Returns over environment steps: of the training episodes, their running mean, and of the evaluations.

    Episodes are rows of `EPISODE_COLUMNS`; evaluations (n,) are those at the steps (n,), NaN where
    there was none.
    """
    curves = []
    if len(episodes):
        ends, returns = episodes[:, 1], episodes[:, 2]
        stride = max(1, len(returns) // _DOTS)
        sums, last = np.cumsum(np.concatenate([[0.0], returns])), np.arange(1, len(returns) + 1)
        first = np.maximum(0, last - WINDOW)
        means = (sums[last] - sums[first]) / (last - first)
        curves.append(
            Curve("training episodes", ends[::stride], returns[::stride], style="dots", colour=5)
        )
        curves.append(Curve(f"mean of {WINDOW} episodes", ends, means, colour=0))
    known = np.isfinite(evaluations)
    return (
        [*curves, Curve("evaluations", steps[known], evaluations[known], colour=1)]
        if known.any()
        else curves
    )


def save_learning_curve(path: Path, title: str, episodes: np.ndarray, reports: np.ndarray) -> None:
    """Write the learning curve of a run as a PNG file, from rows of `EPISODE_COLUMNS` and of `REPORT_COLUMNS`."""
    steps, evaluations = (
        reports[:, REPORT_COLUMNS.index(name)] for name in ("steps", "evaluation_return")
    )
    curves = tuple(learning_curves(episodes, steps, evaluations))
    save(Plot(title, "environment steps", "return", curves), path, (6.0, 3.5))


class GrowingTable:
    """A CSV file of numbers that grows, and its rows in memory."""

    def __init__(self, path: Path, columns: Sequence[str], rows: np.ndarray | None = None) -> None:
        """Write the file anew, with the rows (n, columns) that a checkpoint has."""
        self.rows: list[tuple[float, ...]] = (
            [] if rows is None else [tuple(row) for row in rows.tolist()]
        )
        self._path, self._columns, self._kept = path, columns, 0
        with atomic_write(path) as temporary:
            temporary.write_text(f"{','.join(columns)}\r\n", newline="")
            self.flush(temporary)

    def add(self, row: Iterable[float]) -> None:
        """A row more, in memory."""
        self.rows.append(tuple(float(value) for value in row))

    def flush(self, path: Path | None = None) -> None:
        """Bring what was added to the file; whole numbers as integers, so that a step is not `1000.0`."""
        with (path or self._path).open("a", newline="") as file:
            csv.writer(file).writerows(
                [int(one) if math.isfinite(one) and one == int(one) else one for one in row]
                for row in self.rows[self._kept :]
            )
        self._kept = len(self.rows)

    def array(self) -> np.ndarray:
        """The rows, shape (n, columns)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, len(self._columns))

    def last_mean(self, column: str, count: int = WINDOW) -> float:
        """Mean over the last rows; NaN if there are none."""
        values = [row[self._columns.index(column)] for row in self.rows[-count:]]
        return sum(values) / len(values) if values else math.nan
