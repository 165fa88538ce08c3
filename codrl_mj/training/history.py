"""History of a training: a table of episodes, a table of reports, and the learning curve."""

import csv
import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from codrl_mj.plots import Curve, Plot, save_png
from codrl_mj.runs.files import atomic_write

WINDOW = 100
"""Number of training episodes in running means."""
_DOTS = 4000
"""Approximate number of training episodes that a learning curve shows as dots."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of a training at the end of a rollout."""

    steps: int
    """Environment steps so far."""
    episodes: int
    """Training episodes that ended so far."""
    mean_return: float
    """Mean return of the last 100 training episodes (NaN before the first ends)."""
    mean_length: float
    """Mean length of the same episodes [steps]."""
    torque_error: float
    """Root mean square of desired minus delivered torque at the motor shaft [N*m], over the ends of
    the environment steps since the last report. An evaluation takes it over all integration steps.
    """
    evaluation_return: float
    """Mean return of the evaluation at this step (NaN if there was none)."""
    steps_per_second: float
    """Environment steps per second since training started or was continued."""
    seconds: float
    """Wall-clock time spent on the run so far [s], interruptions excluded."""


REPORT_COLUMNS = tuple(field.name for field in dataclasses.fields(Progress))
EPISODE_COLUMNS = ("episode", "steps", "return", "length")
"""Number of the episode from 1, steps of the run at its end, its return and its length [steps]."""


def read_episodes(path: Path) -> np.ndarray:
    """Return the table of a run's training episodes, shape (n, 4), with columns `EPISODE_COLUMNS`.

    Raises:
        ValueError: the file has another form.
    """
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
    """Return curves of returns over environment steps.

    The curves show the training episodes, their running mean, and the evaluations.

    Args:
        episodes: rows of `EPISODE_COLUMNS`.
        steps: environment steps of the reports, shape (n,).
        evaluations: mean returns at these steps, shape (n,); NaN if there was no evaluation.
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
    """Write the learning curve of a run as a PNG file.

    Args:
        path: the file.
        title: the figure's title.
        episodes: rows of `EPISODE_COLUMNS`.
        reports: rows of `REPORT_COLUMNS`.
    """
    steps, evaluations = (
        reports[:, REPORT_COLUMNS.index(name)] for name in ("steps", "evaluation_return")
    )
    curves = tuple(learning_curves(episodes, steps, evaluations))
    save_png(Plot(title, "environment steps", "return", curves), path, (6.0, 3.5))


class GrowingTable:
    """Growing CSV file of numbers, with its rows in memory."""

    def __init__(self, path: Path, columns: Sequence[str], rows: np.ndarray | None = None) -> None:
        """Create the file, or replace it by one with the rows (n, columns) of a checkpoint."""
        self.rows: list[tuple[float, ...]] = (
            [] if rows is None else [tuple(row) for row in rows.tolist()]
        )
        self._path, self._columns, self._num_written = path, columns, 0
        with atomic_write(path) as temporary:
            temporary.write_text(f"{','.join(columns)}\r\n", newline="")
            self.flush(temporary)

    def add(self, row: Iterable[float]) -> None:
        """Add a row in memory."""
        self.rows.append(tuple(float(value) for value in row))

    def flush(self, path: Path | None = None) -> None:
        """Append the new rows to the file; whole numbers as integers, such as `1000` for a step."""
        with (path or self._path).open("a", newline="") as file:
            csv.writer(file).writerows(
                [
                    int(value) if math.isfinite(value) and value == int(value) else value
                    for value in row
                ]
                for row in self.rows[self._num_written :]
            )
        self._num_written = len(self.rows)

    def array(self) -> np.ndarray:
        """Return the rows, shape (n, columns)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, len(self._columns))

    def last_mean(self, column: str, count: int = WINDOW) -> float:
        """Return the mean of a column over the last rows; NaN if there are none."""
        values = [row[self._columns.index(column)] for row in self.rows[-count:]]
        return sum(values) / len(values) if values else math.nan
