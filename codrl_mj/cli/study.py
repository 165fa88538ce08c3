"""`codrl-mj study`."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Study:
    """Run a study of many trainings, or go on with it, and write its page: docs/studies.md.

    What is finished is not computed again, so the same command resumes a study, adds seeds to it, and writes its page
    anew. Example: codrl-mj study mismatch --dry-run, or codrl-mj study mismatch --tasks cartpole --seeds 3 --jobs 2
    """

    study: Annotated[
        tyro.conf.Positional[Literal["mismatch"]],
        tyro.conf.arg(help="mismatch: train on one actuator, test on another."),
    ]
    root: Path = Path("runs/mismatch")
    """Folder of the run folders."""
    out: Path = Path("docs/results")
    """Folder for the page, its figures and its tables."""
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
    seeds: int = 5
    """Training runs of each kind, with seeds from 0."""
    episodes: int = 100
    """Test episodes of each policy on each actuator."""
    total_steps: int | None = None
    """Environment steps of every training; the default is each agent's own budget."""
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

    def run(self) -> int:
        """Compute what is missing and write the page; 1 if something failed."""
        from codrl_mj.study.grid import Workers
        from codrl_mj.study.mismatch import MismatchConfig, collect
        from codrl_mj.study.page import write
        from codrl_mj.validation.page import check_writable

        chosen = {name: getattr(self, name) for name in ("tasks", "experiments") if getattr(self, name) is not None}
        config = MismatchConfig(
            self.root,
            seeds=self.seeds,
            episodes=self.episodes,
            conditions=self.conditions,
            total_steps=self.total_steps,
            **chosen,
        )
        workers = Workers(self.jobs, self.backend, self.address)
        if self.dry_run:
            _print_costs(config, workers.jobs)
            return 0
        check_writable(self.out)
        if not self.only_page:
            _compute(config, workers, self.accept_changes)
        results = collect(config)
        for file in write(results, self.out):
            print(f"wrote {file}")
        for name, error in results.failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if results.failures else 0


def _compute(config: Any, workers: Any, accept_changes: bool) -> None:
    """Train and test, with a bar for each."""
    import matplotlib  # noqa: F401 - what is missing is missed now and not in the end

    from codrl_mj.cli.terminal import progress_bar
    from codrl_mj.study.mismatch import cells, compute, trials

    with progress_bar("{task.completed}/{task.total}") as bar:
        rows = {
            "training": bar.add_task("trainings", total=len(cells(config))),
            "testing": bar.add_task("tests", total=len(trials(config)) * config.seeds),
        }
        compute(config, workers, accept_changes, lambda kind, _: bar.advance(rows[kind]))


def _print_costs(config: Any, jobs: int) -> None:
    """Print every training, and what the unfinished ones would take."""
    from rich.table import Table

    from codrl_mj.cli.terminal import console
    from codrl_mj.study.cost import costs, seeds_finished

    table = Table("training", "seeds finished", "seeds to do")
    for kind, seeds in seeds_finished(config).items():
        table.add_row(
            kind, *(" ".join(str(seed) for seed, done in seeds.items() if done is to) for to in (True, False))
        )
    console().print(table)
    header = ("task", "agent", "steps", "trainings", "finished", "s each", "tests", "finished", "s each", "hours left")
    table = Table(*header, title="Time of one core", title_justify="left")
    every = costs(config)
    for cost in every:
        estimate = "" if cost.trained else "about "
        table.add_row(
            *(cost.task, cost.agent, f"{cost.steps:,}", str(cost.trainings), str(cost.trained)),
            *(f"{estimate}{cost.seconds:.0f}", str(cost.tests), str(cost.tested), f"about {cost.test_seconds:.1f}"),
            f"{cost.left / 3600:.2f}",
        )
    console().print(table)
    total, left = (sum(getattr(cost, part) for cost in every) / 3600 for part in ("total", "left"))
    cores = (os.cpu_count() or 1) if jobs == -1 else jobs
    print(f"about {left:.2f} of {total:.2f} core hours are left: {left / cores:.2f} hours with {cores} jobs")
