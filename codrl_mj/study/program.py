"""Base class of a study's script, with its flags, progress bars, costs and result page."""

import abc
import dataclasses
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from codrl_mj.fields import Checked, integer
from codrl_mj.runs.files import check_writable
from codrl_mj.study.parallel import Workers
from codrl_mj.study.trials import Grid, format_ranges
from codrl_mj.training import TrainingStoppedError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program(Checked, abc.ABC):
    """Script that computes the missing trainings and tests of a study and writes its page.

    Raises:
        ValueError: a number is out of bounds.
    """

    PUBLISH_EACH_TRAINING: ClassVar[bool] = False
    """True if one job publishes the rows of each training, instead of those of a seed."""

    root: Path
    """Folder of the run folders."""
    out: Path = Path("docs/results")
    """Folder for the page, its figures and its tables."""
    seeds: int = integer(5, minimum=1)
    """Training runs of each kind, with seeds from 0."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = Workers()
    accept_changes: bool = False
    """Continue started trainings even if the code or a package has changed since."""
    dry_run: bool = False
    """Only list the finished and the missing trainings, with the estimated time of the latter."""
    only_page: bool = False
    """Only write the page from the available results."""

    @property
    @abc.abstractmethod
    def grid(self) -> Grid:
        """Trainings and tests of the study."""

    @abc.abstractmethod
    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write the page of all available results; return the files and the errors by name."""

    def publish(self) -> None:
        """Write the available results after each completed seed; run folders may be temporary.

        An error is only printed here; at the end of the study, where the page is written again, it
        is raised.
        """
        try:
            self.write()
        except (OSError, ValueError) as error:
            print(f"not published yet: {error}", file=sys.stderr)

    def run(self) -> int:
        """Compute missing results and write the page; return 1 if anything failed."""
        grid, workers = self.grid, self.workers
        if self.dry_run:
            core_hours = _print_costs(grid)
            print(
                f"about {core_hours:.2f} core hours are left:"
                f" {core_hours / workers.cores:.2f} hours with {workers.cores} jobs"
            )
            return 0
        check_writable(self.root)
        check_writable(self.out)
        if not self.only_page:
            # The pages need matplotlib: report that it is missing before hours of work, not after.
            import matplotlib  # noqa: F401

            if self.PUBLISH_EACH_TRAINING and workers.cores == 1:
                for name, seed in grid.cells:
                    part = grid.restricted_to({name: range(seed, seed + 1)})
                    part.compute(workers, self.accept_changes, on_seed=self.publish)
            compute(grid, workers, self.accept_changes, self.publish)
        files, failures = self.write()
        for file in files:
            print(f"wrote {file}")
        for name, error in failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if failures else 0


def main(kind: type[Program], arguments: Sequence[str] | None = None) -> int:
    """Run a study's script, with the fields of its program as flags.

    Args:
        kind: class of the program.
        arguments: command line without the script's name; None takes `sys.argv`.

    Returns:
        Exit status: 0, 1 if something failed, 2 for bad input, 130 after Ctrl-C, 143 after SIGTERM.
    """
    try:
        return tyro.cli(kind, description=kind.__doc__, args=arguments).run()
    except TrainingStoppedError as stopped:
        print(stopped, file=sys.stderr)
        return 128 + stopped.signal_number
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def compute(
    grid: Grid,
    workers: Workers,
    accept_changes: bool = False,
    on_seed: Callable[[], None] = lambda: None,
) -> None:
    """Compute the missing cells of a grid, with progress bars for trainings and tests."""
    counts = {"training": len(grid.cells), "test": len(grid.policy_tests)}
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=_console()) as bar:
        rows = {kind: bar.add_task(f"{kind}s", total=count) for kind, count in counts.items()}
        grid.compute(workers, accept_changes, lambda kind: bar.advance(rows[kind]), on_seed)


def _print_costs(grid: Grid) -> float:
    """Print finished and missing trainings of every arm; return the remaining core hours."""
    table, costs = Table("arm", "seeds\nfinished", "seeds\nto do", box=None), grid.costs()
    for column in ("s each", "tests\nto do", "core hours\nleft"):
        table.add_column(column, justify="right")
    for cost in costs:
        seconds_each = f"{'' if cost.finished else 'about '}{cost.seconds:.0f}"
        seeds = format_ranges(cost.finished), format_ranges(cost.missing)
        table.add_row(
            cost.arm.name,
            *seeds,
            seconds_each,
            str(cost.tests),
            f"{cost.remaining_seconds / 3600:.2f}",
        )
    _console().print(table)
    return sum(cost.remaining_seconds for cost in costs) / 3600


def _console() -> Console:
    """Return a console that is 110 columns wide if the output is not a terminal."""
    return Console() if sys.stdout.isatty() else Console(width=110)
