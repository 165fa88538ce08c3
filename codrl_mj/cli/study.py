"""`codrl-mj study`, and what it shares with `codrl-mj reproduce`."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


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
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.runs.files import check_writable
        from codrl_mj.study.parallel import Workers

        grid, workers = self.grid(), Workers(self.jobs, self.backend, self.address)
        if self.dry_run:
            left = self.print_costs(grid)
            print(f"about {left:.2f} core hours are left: {left / workers.cores:.2f} hours with {workers.cores} jobs")
            return 0
        check_writable(self.out)
        if not self.only_page:
            import matplotlib  # noqa: F401 - what is missing is missed now and not in the end

            counts, compute = self.work(grid)
            with progress_bar("{task.completed}/{task.total}") as bar:
                rows = {kind: bar.add_task(f"{kind}s", total=count) for kind, count in counts.items()}
                compute(workers, self.accept_changes, lambda kind, *_: bar.advance(rows[kind]))
        files, failures = self.write()
        for file in files:
            print(f"wrote {file}")
        for name, error in failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if failures else 0

    def print_costs(self, grid: Any) -> float:
        """Print every arm, which of its trainings are finished, and what is left; the core hours left."""
        from rich import box
        from rich.table import Table

        from codrl_mj.cli.terminal import console
        from codrl_mj.study.trials import numbers_as_text

        table, every = (
            Table("arm", "seeds\nfinished", "seeds\nto do", box=box.SIMPLE_HEAD, pad_edge=False),
            grid.costs(),
        )
        for header in ("s each", "tests\nto do", "core hours\nleft"):
            table.add_column(header, justify="right")
        for cost in every:
            each = f"{'' if cost.finished else 'about '}{cost.seconds:.0f}"
            seeds = numbers_as_text(cost.finished), numbers_as_text(cost.missing)
            table.add_row(cost.arm.name, *seeds, each, str(cost.tests), f"{cost.left / 3600:.2f}")
        console().print(table)
        return sum(cost.left for cost in every) / 3600

    def work(self, grid: Any) -> tuple[Mapping[str, int], Callable[..., None]]:
        """The numbers of trainings and tests, by the names that a function reports them under, and that function."""
        return {"training": len(grid.cells()), "test": len(grid.deployments())}, grid.compute


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study(Computed):
    """Run a study of many trainings, or go on with it, and write its page: docs/studies.md.

    What is finished is not computed again, so the same command resumes a study, adds seeds to it, and writes its page
    anew. Example: codrl-mj study mismatch --dry-run, or codrl-mj study mismatch --tasks cartpole --seeds 3 --jobs 2
    """

    study: Annotated[
        tyro.conf.Positional[Literal["mismatch"]],
        tyro.conf.arg(help="mismatch: train on one actuator, test on another."),
    ]
    root: Path = Path("runs/mismatch")
    tasks: Annotated[
        tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...", help="Tasks; the default is all that it has.")
    ] = None
    experiments: Annotated[
        tuple[str, ...] | None,
        tyro.conf.arg(
            metavar="NAME ...",
            help="Of matrix, ladder, action, observation, randomised, reward, agents; the default is all.",
        ),
    ] = None
    conditions: Annotated[
        tuple[str, ...] | None,
        tyro.conf.arg(metavar="NAME ...", help="Actuators to train and test on, such as ideal weaker; default all."),
    ] = None
    episodes: int = 100
    """Test episodes of each policy on each actuator."""
    total_steps: int | None = None
    """Environment steps of every training; the default is each agent's own budget."""

    def grid(self) -> Any:
        """The study's configuration."""
        from codrl_mj.study.mismatch import MismatchConfig

        names = "root", "tasks", "experiments", "conditions", "seeds", "episodes", "total_steps"
        return MismatchConfig(**{name: value for name in names if (value := getattr(self, name)) is not None})

    def print_costs(self, grid: Any) -> float:
        """Print the seeds of every training, and a row for each agent on each task."""
        from rich.table import Table

        from codrl_mj.cli.terminal import console
        from codrl_mj.study.cost import costs, seeds_finished

        table = Table("training", "seeds finished", "seeds to do")
        for kind, seeds in seeds_finished(grid).items():
            table.add_row(
                kind, *(" ".join(str(seed) for seed, done in seeds.items() if done is to) for to in (True, False))
            )
        console().print(table)
        every = costs(grid)
        title = f"Time of one core: about {sum(cost.total for cost in every) / 3600:.2f} hours in all"
        header = (
            "task",
            "agent",
            "steps",
            "trainings",
            "finished",
            "s each",
            "tests",
            "finished",
            "s each",
            "hours left",
        )
        table = Table(*header, title=title, title_justify="left")
        for cost in every:
            estimate = "" if cost.trained else "about "
            table.add_row(
                *(cost.task, cost.agent, f"{cost.steps:,}", str(cost.trainings), str(cost.trained)),
                *(f"{estimate}{cost.seconds:.0f}", str(cost.tests), str(cost.tested), f"about {cost.test_seconds:.1f}"),
                f"{cost.left / 3600:.2f}",
            )
        console().print(table)
        return sum(cost.left for cost in every) / 3600

    def work(self, grid: Any) -> tuple[Mapping[str, int], Callable[..., None]]:
        """Every cell and its tests."""
        from codrl_mj.study.mismatch import cells, compute, trials

        return {"training": len(cells(grid)), "test": len(trials(grid)) * grid.seeds}, functools.partial(compute, grid)

    def write(self) -> tuple[Iterable[Path], Mapping[str, Any]]:
        """The page of all results that there are."""
        from codrl_mj.study.mismatch import collect
        from codrl_mj.study.page import write

        results = collect(self.grid())
        return write(results, self.out), results.failures
