"""Compare the speed of our motors in other simulators with our own engine's, on one core.

Two groups are measured in one run and one process, which keeps itself and all libraries on one
core:

- a step of 4,096 worlds with 12 drives each: our compiled loop, the kernel of Warp, and JAX;
- a step of HalfCheetah in mujoco_warp, with six motors and without.

The members of a group take turns, in the opposite order in every second turn. The table shows the
median over the turns of the ratio to the group's first member, and an interval of 95 % for it. The
clock counts processor time, which other processes do not use. `make simulators` installs what is
needed. `--publish` writes docs/results/simulator_speed.csv and the tables of docs/arrays.md.
"""

import argparse
import importlib
import math
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from rich.table import Table

from codrl_mj.cli.terminal import console
from codrl_mj.study import markdown_table, read_csv, write_csv, write_page

if TYPE_CHECKING:
    from simulator_subjects import Subject

ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "JAX_PLATFORMS": "cpu",
}
"""Settings of the libraries for one thread."""
ROWS = Path(__file__).parents[1] / "docs" / "results" / "simulator_speed.csv"
PAGE = ROWS.parents[1] / "arrays.md"
WRITTEN = "<!-- written by scripts/simulator_speed.py -->\n"
MIN_TURNS = 15
"""Number of turns below which nothing is published."""


class Spread(NamedTuple):
    """Median of some ratios, and an interval that contains their true median."""

    median: float
    low: float
    high: float


class Row(NamedTuple):
    """Time of a member of a group."""

    group: str
    member: str
    milliseconds: float
    """Median processor time of a step [ms]."""
    ratio: Spread
    """Time divided by that of the group's first member."""


def median_interval(values: np.ndarray) -> Spread:
    """Return the median, and its interval of 95 % between two of the values, in order."""
    ordered, num = np.sort(values), len(values)
    # The number of values below the true median is binomial.
    rank = max(math.floor(num / 2 - 1.96 * math.sqrt(num) / 2), 0)
    return Spread(float(np.median(values)), float(ordered[rank]), float(ordered[num - 1 - rank]))


def measure(group: str, members: "list[Subject]", turns: int, duration: float) -> list[Row]:
    """Time the members in turn.

    Args:
        group: title of the group.
        members: its members.
        turns: number of turns.
        duration: approximate duration of a turn of a member [s].
    """
    counts = []
    for member in members:
        # The first call compiles.
        _seconds(member, 1)
        elapsed = min(_seconds(member, member.period) for _ in range(3))
        counts.append(member.period * max(1, round(duration / elapsed)))
    times = np.empty((turns, len(members)))
    for turn in range(turns):
        columns = range(len(members))
        for column in reversed(columns) if turn % 2 else columns:
            times[turn, column] = _seconds(members[column], counts[column]) / counts[column]
    return [
        Row(
            group,
            member.name,
            1e3 * float(np.median(times[:, column])),
            median_interval(times[:, column] / times[:, 0]),
        )
        for column, member in enumerate(members)
    ]


def _seconds(member: "Subject", steps: int) -> float:
    """Return the processor time of some steps [s]."""
    member.prepare()
    start = time.process_time()
    member.run(steps)
    return time.process_time() - start


def use_one_core() -> None:
    """Keep this process on one core, and libraries that are imported later to one thread."""
    os.environ.update(ONE_THREAD)
    # Not all systems can do this.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def groups() -> "dict[str, Callable[[], list[Subject]]]":
    """Return the groups by title."""
    # Libraries read their settings when they are imported.
    subjects = importlib.import_module("simulator_subjects")
    drives = f"{subjects.NUM_WORLDS:,} worlds with {subjects.NUM_DRIVES} drives"
    return {
        f"{drives}, the same in all worlds": lambda: subjects.drives(()),
        f"{drives}, three numbers drawn per drive": lambda: subjects.drives(subjects.DRAWN),
        f"HalfCheetah in mujoco_warp, {subjects.NUM_CHEETAHS} worlds": subjects.cheetahs,
    }


def report(rows: list[Row]) -> None:
    """Print the table of a group."""
    table = Table(title=rows[0].group, title_justify="left")
    for column in ("", "ms a step", "times the first"):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        table.add_row(row.member, f"{row.milliseconds:.2f}", _text(row.ratio))
    console().print(table)


def _text(spread: Spread) -> str:
    return f"{spread.median:.2f} ({spread.low:.2f} to {spread.high:.2f})"


def publish(rows: list[Row], file: Path = ROWS, page: Path = PAGE) -> None:
    """Write the rows of all groups, and the tables of the page."""
    write_csv(
        file,
        [
            {
                "group": row.group,
                "member": row.member,
                "milliseconds": f"{row.milliseconds:.3f}",
                **{name: f"{value:.3f}" for name, value in row.ratio._asdict().items()},
            }
            for row in rows
        ],
    )
    write_tables(file, page)


def write_tables(file: Path = ROWS, page: Path = PAGE) -> None:
    """Write the tables of the page from the published rows."""
    rows = read_csv(file)
    tables = []
    for group in dict.fromkeys(row["group"] for row in rows):
        cells = [
            (
                row["member"],
                f"{float(row['milliseconds']):.1f}",
                _text(Spread(*(float(row[name]) for name in Spread._fields))),
            )
            for row in rows
            if row["group"] == group
        ]
        tables.append(markdown_table((group, "ms a step", "times the first"), cells, 2))
    head = page.read_text(encoding="utf-8").partition(WRITTEN)[0]
    write_page(page, [head + WRITTEN, *tables])


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="only groups whose title contains this")
    parser.add_argument("--turns", type=int, default=25, help="turns of each member of a group")
    parser.add_argument("--duration", type=float, default=0.15, help="duration of a turn [s]")
    parser.add_argument("--publish", action="store_true", help="write rows and tables in docs/")
    parser.add_argument("--only-page", action="store_true", help="only write the tables again")
    options = parser.parse_args()
    if options.turns < 1:
        parser.error(f"--turns {options.turns}: must be >= 1")
    if options.publish and (options.only or options.turns < MIN_TURNS):
        parser.error(f"--publish: needs all groups, and at least {MIN_TURNS} turns")
    if options.only_page:
        write_tables()
        return 0
    use_one_core()
    # The cheetah has armatures and dampings of its own beside those of the motors.
    warnings.simplefilter("ignore")
    rows: list[Row] = []
    for title, make in groups().items():
        if options.only in title:
            results = measure(title, make(), options.turns, options.duration)
            report(results)
            rows += results
    if options.publish:
        publish(rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
