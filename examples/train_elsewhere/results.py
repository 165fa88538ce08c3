"""Rows, tables and pictures of the other scripts; it needs neither MJX nor mjlab."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib import pyplot

Row = dict[str, str | int | float]
"""Row of a table: column -> value."""
COLORS = {"ideal": "#0b62b8", "motor": "#bd5a0e"}


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write a CSV file."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


def read_rows(path: Path) -> list[Row]:
    """Read a CSV file; all values are texts."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def draw_learning_curves(rows: Iterable[Row], path: Path) -> None:
    """Draw the return of each training over its steps."""
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in rows:
        key = str(row["trained on"]), str(row["seed"])
        curves.setdefault(key, []).append((float(row["steps"]), float(row["return"])))
    figure, axes = pyplot.subplots(figsize=(6.4, 3.0), layout="constrained")
    labeled: set[str] = set()
    for (name, _), points in curves.items():
        label = None if name in labeled else {"ideal": "on ideal torques"}.get(name, "on the motor")
        labeled.add(name)
        axes.plot(*np.array(points).T, color=COLORS[name], linewidth=1.2, label=label)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("mean return of 64 worlds")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def table(rows: Iterable[Row]) -> str:
    """Return Markdown with the mean return [lowest, highest] of the seeds in both simulators."""
    lines = [
        "| trained on | tested on | in MJX | in our engine | largest gap of an episode | upright |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((str(row["trained on"]), str(row["tested on"])), []).append(row)
    for (trained, tested), group in groups.items():
        cells = []
        for column in ("MJX", "ours"):
            returns = [float(row[column]) for row in group]
            cells.append(f"{np.mean(returns):.1f} [{min(returns):.1f}, {max(returns):.1f}]")
        gap = max(float(row["largest gap of an episode"]) for row in group)
        success = np.mean([float(row["success"]) for row in group])
        lines.append(
            f"| {trained} | {tested} | {' | '.join(cells)} | {gap:.3f} | {100 * success:.0f} % |"
        )
    return "\n".join(lines)
