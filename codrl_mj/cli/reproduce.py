"""`codrl-mj reproduce`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.tasks import TASKS


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Do the paper's experiments again, judge what it reports, and write a page: docs/reproduction.md.

    What is finished is not computed again: the same command resumes, adds seeds, and writes the page anew. Example:
    codrl-mj reproduce --dry-run, or codrl-mj reproduce mountain_car --jobs 2
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="{" + ",".join(TASKS) + "}", help="Whose experiments; all if none is named."),
    ] = ()
    root: Path = Path("runs/paper")
    """Folder of the run folders."""
    out: Path = Path("docs/results")
    """Folder for the page, its figures and its tables."""
    seeds: int = 5
    """Training runs of each kind, with seeds from 0."""
    sarsa_seeds: int = 30
    """Training runs of each kind of SARSA (mountain_car), which take seconds."""
    episodes: int | None = None
    """Cut every training off after so many episodes, for trying things out; the default is the paper's budgets."""
    test_episodes: int = 100
    """Test episodes of each policy."""
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
        """Compute what is missing, write the page and print the verdicts; 1 if something failed."""
        from codrl_mj.study.grid import Workers
        from codrl_mj.study.reproduction.page import write
        from codrl_mj.study.reproduction.reproduce import Reproduction, gather
        from codrl_mj.validation.page import check_writable

        chosen: dict[str, Any] = {"tasks": self.tasks} if self.tasks else {}
        plan = Reproduction(
            self.root,
            seeds=self.seeds,
            sarsa_seeds=self.sarsa_seeds,
            episodes=self.episodes,
            test_episodes=self.test_episodes,
            **chosen,
        )
        workers = Workers(self.jobs, self.backend, self.address)
        if self.dry_run:
            _print_costs(plan, workers.jobs)
            return 0
        check_writable(self.out)
        if not self.only_page:
            _compute(plan, workers, self.accept_changes)
        findings = gather(plan)
        files = write(findings, self.out)
        _print_verdicts(findings)
        for file in files:
            print(f"wrote {file}")
        failures = {
            f"{name}, seed {seed}": error
            for name, series in findings.evidence.series.items()
            for seed, error in series.failures.items()
        }
        for name, error in failures.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
        return 1 if failures else 0


def _compute(plan: Any, workers: Any, accept_changes: bool) -> None:
    """Train and test, with a bar for each."""
    import matplotlib  # noqa: F401 - what is missing is missed now and not in the end

    from codrl_mj.cli.terminal import progress_bar
    from codrl_mj.study.reproduction.reproduce import compute

    with progress_bar("{task.completed}/{task.total}") as bar:
        rows = {
            "training": bar.add_task("trainings", total=len(plan.cells())),
            "test": bar.add_task("tests", total=len(plan.deployments(unfinished=True))),
        }
        compute(plan, workers, accept_changes, lambda kind: bar.advance(rows[kind]))


def _print_verdicts(findings: Any) -> None:
    """Print a row for each claim."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from codrl_mj.cli.terminal import console
    from codrl_mj.study.reproduction.verdicts import CONFIRMED, NOT_CONFIRMED, number

    colours = {CONFIRMED: "green", NOT_CONFIRMED: "red"}
    for task in findings.plan.tasks:
        table = Table(title=task, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        for header in ("said by", "what is reported", "ours [95 %]", "seeds", "verdict"):
            table.add_column(header, justify="right" if header == "seeds" else "left", overflow="fold")
        for claim, verdict in findings.claims:
            if claim.task == task:
                found = "–" if verdict.measured is None else "{} [{}, {}]".format(*map(number, verdict.measured))
                words = claim.source, f"{claim.statement} ({claim.physics or 'value iteration'})", found
                colour = colours.get(verdict.outcome, "yellow")
                table.add_row(*map(escape, words), str(verdict.samples), f"[{colour}]{verdict.outcome}")
        console().print(table)


def _print_costs(plan: Any, jobs: int) -> None:
    """Print every arm, which of its trainings are finished, and what the others would take."""
    from rich.table import Table

    from codrl_mj.cli.terminal import console
    from codrl_mj.study.reproduction.reproduce import cores, costs
    from codrl_mj.study.reproduction.series import interval_text

    table = Table("training", "seeds finished", "seeds to do", "s each", "core hours left")
    every = costs(plan)
    for cost in every:
        each = f"{'' if cost.finished else 'about '}{cost.seconds:.0f}"
        seeds = interval_text(cost.finished), interval_text(cost.missing)
        table.add_row(cost.arm.name, *seeds, each, f"{cost.left / 3600:.2f}")
    console().print(table)
    left = sum(cost.left for cost in every) / 3600
    at_once = cores(jobs)
    print(f"about {left:.1f} core hours are left: {left / at_once:.1f} hours with {at_once} jobs")
