"""Command line of the reproduction: its grid of runs, and its outputs."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from codrl_mj.fields import integer
from codrl_mj.study.grid import check_selection
from codrl_mj.study.pages import write_csv
from codrl_mj.study.program import Program
from codrl_mj.study.trials import Arm, Grid
from reproduction.arms import ARMS, TASKS, PaperArm
from reproduction.checks import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, number
from reproduction.claims import needed
from reproduction.findings import Findings, arm_rows, gather, published_rows
from reproduction.page import FOLDER, write
from reproduction.rows import RUNS, complete, identity, read_trained
from reproduction.value_iteration import Mesh

_COLOURS = {CONFIRMED: "green", COMPATIBLE: "cyan", NOT_CONFIRMED: "red"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduction(Program):
    """Repeat the paper's experiments, judge its statements, and write a page: docs/reproduction.md.

    Published trainings are not computed again: the same command resumes a study and adds seeds,
    whose rows are published as they finish. Example: python scripts/reproduce.py --dry-run, or with
    pendulum --settings repaired --seeds 20 --jobs 2
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="{" + ",".join(TASKS) + "}", help="Tasks of the experiments; default: all."
        ),
    ] = TASKS
    settings: tuple[str, ...] = ("paper", "repaired")
    """Settings of the agents: as printed in the paper, and repaired where these do not learn."""
    root: Path = Path("runs/paper")
    """Folder of the run folders."""
    sarsa_seeds: int = integer(30, minimum=1)
    """Training runs of each kind of SARSA (mountain_car), which take seconds."""
    episodes: int | None = integer(None, minimum=1)
    """Maximum number of training episodes, for quick trials; default: the paper's budgets."""
    test_episodes: int = integer(100, minimum=1)
    """Test episodes of each policy."""
    mesh: tyro.conf.Suppress[Mesh] = Mesh()
    """Mesh of value iteration."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_selection("tasks", self.tasks, TASKS)
        check_selection("settings", self.settings, ("paper", "repaired"))

    @property
    def plan(self) -> dict[str, Any]:
        """Numbers of episodes of trainings and tests."""
        return {"episodes": self.episodes, "test_episodes": self.test_episodes}

    @property
    def every(self) -> Grid:
        """Chosen trainings and their tests, whether they are published or not."""
        arms = [arm for arm in ARMS if arm.task in self.tasks and arm.settings in self.settings]
        if self.episodes is not None:
            arms = [arm.cut_off(self.episodes) for arm in arms]
        trials = tuple(trial for arm in arms for trial in arm.trials.values())
        return Grid(self.root, trials, lambda arm: range(self._seeds(arm)), self.test_episodes)

    @property
    def grid(self) -> Grid:
        """Chosen trainings that are not published, from each arm's first incomplete seed on."""
        every, rows = self.every, published_rows(self.out / FOLDER, self.plan)

        def remaining_seeds(arm: Any) -> range:
            columns, planned = needed(arm.name), self._seeds(arm)
            incomplete = (
                seed
                for seed in range(planned)
                if not complete(rows.get(identity(arm, seed), ()), columns)
            )
            return range(next(incomplete, planned), planned)

        seeds = {arm.name: remaining_seeds(arm) for arm in every.arms}
        return dataclasses.replace(every, seeds_of=lambda arm: seeds[arm.name])

    def _seeds(self, arm: Arm) -> int:
        return self.sarsa_seeds if arm.config.agent.name == "sarsa" else self.seeds

    def publish(self) -> None:
        """Write the rows of finished trainings beside the published ones, and nothing else."""
        folder = self.out / FOLDER
        published_by_identity, collected = published_rows(folder, self.plan), self.every.collect()
        chosen = [arm for arm in collected.grid.arms if isinstance(arm, PaperArm)]
        new = {
            identity(arm, seed): rows
            for arm in chosen
            for seed, rows in arm_rows(
                arm, read_trained(arm, collected), published_by_identity
            ).items()
        }
        if new:
            write_csv(
                folder / RUNS,
                [row for rows in (published_by_identity | new).values() for row in rows],
            )

    def findings(self) -> Findings:
        """Judge all results."""
        return gather(self.every, self.plan, self.out / FOLDER, self.mesh)

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write the page of all results, print the verdicts; return files and failures."""
        findings = self.findings()
        files = write(findings, self.out)
        table = Table(
            "task", "said by", "what is reported", "ours [95 %]", "trainings", "verdict", box=None
        )
        for claim, verdict in findings.verdicts:
            ours = (
                "–"
                if verdict.measured is None
                else "{} [{}, {}]".format(*map(number, verdict.measured))
            )
            reported = f"{claim.statement}: {claim.says} ({claim.settings})"
            outcome = f"[{_COLOURS.get(verdict.outcome, 'yellow')}]{verdict.outcome}[/]"
            table.add_row(claim.task, claim.source, reported, ours, str(verdict.samples), outcome)
        Console().print(table)
        return files, findings.failures
