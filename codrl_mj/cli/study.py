"""`codrl-mj study`, and what it shares with `codrl-mj reproduce`."""

import dataclasses
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


def compute(grid: Any, workers: Any, accept_changes: bool = False) -> None:
    """Compute what of a grid is missing, with a progress bar each for its trainings and its tests."""
    from codrl_mj.cli.terminal import progress_bar

    counts = {"training": len(grid.cells()), "test": len(grid.deployments())}
    with progress_bar("{task.completed}/{task.total}") as bar:
        rows = {kind: bar.add_task(f"{kind}s", total=count) for kind, count in counts.items()}
        grid.compute(workers, accept_changes, lambda kind: bar.advance(rows[kind]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Computed:
    """A verb that trains and tests much, unless that is done already, and writes a page of it.

    It has `grid()`, what is to be computed, and `write()`, which writes the page, and returns its files and failures.
    """

    root: Path
    """Folder of the run folders."""
    out: Path = Path("docs/results")
    """Folder for the page, its figures and its tables."""
    seeds: int = 5
    """Training runs of each kind, with seeds from 0."""
    jobs: int = -1
    """Trainings at once; -1 for one on each CPU."""
    backend: Literal["local", "ray"] = "local"
    """Where: in processes of this machine, or on a Ray cluster whose machines all see the run folders."""
    address: str | None = None
    """Of the Ray cluster, such as auto or ray://head:10001; without one Ray is started on this machine."""
    accept_changes: bool = False
    """Continue begun trainings even if the code or a package is no longer the one that they were started with."""
    dry_run: bool = False
    """Only list the trainings, which of them are finished, and what the rest would take."""
    only_page: bool = False
    """Only write the page, of what there is."""

    def run(self: Any) -> int:
        """Compute what is missing and write the page; 1 if something failed."""
        from codrl_mj.runs.files import check_writable
        from codrl_mj.study.parallel import Workers

        grid, workers = self.grid(), Workers(self.jobs, self.backend, self.address)
        if self.dry_run:
            left = self.print_costs(grid)
            print(f"about {left:.2f} core hours are left: {left / workers.cores:.2f} hours with {workers.cores} jobs")
            return 0
        check_writable(self.root)
        if not self.only_page:
            import matplotlib  # noqa: F401 - what is missing is missed now and not in the end

            compute(grid, workers, self.accept_changes)
        files, failures = self.write()
        for file in files:
            print(f"wrote {file}")
        for name, error in failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if failures else 0

    def print_costs(self, grid: Any) -> float:
        """Print every arm, which of its trainings are finished, and what is left; the core hours left."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.study.trials import numbers_as_text

        every, rows = grid.costs(), []
        columns = "arm", "seeds\nfinished", "seeds\nto do", "s each", "tests\nto do", "core hours\nleft"
        for cost in every:
            each = f"{'' if cost.finished else 'about '}{cost.seconds:.0f}"
            seeds = numbers_as_text(cost.finished), numbers_as_text(cost.missing)
            rows.append((cost.arm.name, *seeds, each, str(cost.tests), f"{cost.left / 3600:.2f}"))
        print_table("", columns, rows, right=columns[3:], padding=(0, 1))
        return sum(cost.left for cost in every) / 3600


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study(Computed):
    """Run the study of what an actuator costs, or go on with it, and write its page: docs/studies.md.

    What is finished is not computed again, so the same command resumes a study, adds seeds to it, and writes its page
    anew. Example: codrl-mj study actuators --dry-run, or codrl-mj study actuators --tasks pendulum --seeds 3 --jobs 2
    """

    study: Annotated[
        tyro.conf.Positional[Literal["actuators"]],
        tyro.conf.arg(help="actuators: when an actuator matters, and what helps: docs/results/plan.md."),
    ]
    root: Path = Path("runs/actuators")
    seeds: int = 20
    """Training runs of each kind, with seeds from 0."""
    tasks: Annotated[
        tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...", help="Tasks; the default is all that it has.")
    ] = None
    episodes: int = 50
    """Test episodes of each policy on each actuator."""
    total_steps: int | None = None
    """Environment steps of every training, for trying things out; the default is each agent's own budget."""

    def grid(self) -> Any:
        """Its trainings and tests."""
        from codrl_mj.study.actuators.study import ActuatorStudy

        names = "root", "tasks", "seeds", "episodes", "total_steps"
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        return ActuatorStudy(**given).grid

    def write(self) -> tuple[Iterable[Path], Mapping[str, Any]]:
        """The page of all results that there are."""
        from codrl_mj.study.actuators.page import write

        collected = self.grid().collect()
        return write(collected, self.out), collected.failures
