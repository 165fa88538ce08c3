"""What a study's script is: flags, progress, costs, and a page of what there is: docs/studies.md."""

import abc
import dataclasses
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

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
from codrl_mj.study.trials import Grid, numbers_as_text
from codrl_mj.training import TrainingStoppedError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program(Checked, abc.ABC):
    """A script that trains and tests much, unless that is done already, and writes a page of it.

    Raises:
        ValueError: a number that is out of its bounds.
    """

    root: Path
    """Folder of the run folders."""
    out: Path = Path("docs/results")
    """Folder for the page, its figures and its tables."""
    seeds: int = integer(5, minimum=1)
    """Training runs of each kind, with seeds from 0."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = Workers()
    accept_changes: bool = False
    """Continue begun trainings even if the code or a package is no longer the one that they were started with."""
    dry_run: bool = False
    """Only list the trainings, which of them are finished, and what the rest would take."""
    only_page: bool = False
    """Only write the page, of what there is."""

    @property
    @abc.abstractmethod
    def grid(self) -> Grid:
        """Its trainings and tests."""

    @abc.abstractmethod
    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write the page of all results that there are: the files, and what failed."""

    def publish(self) -> None:
        """Write what there is, each time that all of a seed is computed: run folders do not outlive a machine.

        What cannot be written now is written in the end, or refused there.
        """
        try:
            self.write()
        except (OSError, ValueError) as error:
            print(f"not published yet: {error}", file=sys.stderr)

    def run(self) -> int:
        """Compute what is missing and write the page; 1 if something failed."""
        grid, workers = self.grid, self.workers
        if self.dry_run:
            left = _print_costs(grid)
            print(
                f"about {left:.2f} core hours are left: {left / workers.cores:.2f} hours with"
                f" {workers.cores} jobs"
            )
            return 0
        check_writable(self.root)
        check_writable(self.out)
        if not self.only_page:
            import matplotlib  # noqa: F401 - what is missing is missed now and not in the end

            compute(grid, workers, self.accept_changes, self.publish)
        files, failures = self.write()
        for file in files:
            print(f"wrote {file}")
        for name, error in failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if failures else 0


def main(kind: type[Program], arguments: Sequence[str] | None = None) -> int:
    """Run a study's script; its flags are the fields of its program.

    Args:
        kind: the program.
        arguments: the command line without the script's name; None takes the process's.

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
    """Compute what of a grid is missing, with a progress bar each for its trainings and its tests."""
    counts = {"training": len(grid.cells), "test": len(grid.deployments)}
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
    """Print every arm, which of its trainings are finished, and what is left; the core hours left."""
    table, every = Table("arm", "seeds\nfinished", "seeds\nto do", box=None), grid.costs()
    for column in ("s each", "tests\nto do", "core hours\nleft"):
        table.add_column(column, justify="right")
    for cost in every:
        each = f"{'' if cost.finished else 'about '}{cost.seconds:.0f}"
        seeds = numbers_as_text(cost.finished), numbers_as_text(cost.missing)
        table.add_row(cost.arm.name, *seeds, each, str(cost.tests), f"{cost.left / 3600:.2f}")
    _console().print(table)
    return sum(cost.left for cost in every) / 3600


def _console() -> Console:
    """110 columns wide where it goes to a file."""
    return Console() if sys.stdout.isatty() else Console(width=110)
