"""The paper's experiments done again, as a program: their grid, and what it writes."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from codrl_mj.fields import integer
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.program import Program
from codrl_mj.study.trials import Grid
from reproduction.arms import ARMS, TASKS
from reproduction.checks import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, number
from reproduction.findings import gather
from reproduction.page import FOLDER, write
from reproduction.value_iteration import Mesh

_COLOURS = {CONFIRMED: "green", COMPATIBLE: "cyan", NOT_CONFIRMED: "red"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduction(Program):
    """Do the paper's experiments again, judge what it reports, and write a page: docs/reproduction.md.

    What is finished is not computed again: the same command resumes, adds seeds, and writes the page anew. Example:
    python scripts/reproduce.py --dry-run, or with mountain_car --jobs 2
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="{" + ",".join(TASKS) + "}", help="Whose experiments; all if none is named."),
    ] = TASKS
    root: Path = Path("runs/paper")
    """Folder of the run folders."""
    sarsa_seeds: int = integer(30, least=1)
    """Training runs of each kind of SARSA (mountain_car), which take seconds."""
    episodes: int | None = integer(None, least=1)
    """Cut every training off after so many episodes, for trying things out; the default is the paper's budgets."""
    test_episodes: int = integer(100, least=1)
    """Test episodes of each policy."""
    mesh: tyro.conf.Suppress[Mesh] = Mesh()
    """Of value iteration."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_chosen("tasks", self.tasks, TASKS)

    @property
    def grid(self) -> Grid:
        """The trainings and their tests."""
        arms = [arm for arm in ARMS if arm.task in self.tasks]
        if self.episodes is not None:
            arms = [arm.cut_off(self.episodes) for arm in arms]
        return Grid(
            self.root,
            tuple(trial for arm in arms for trial in arm.trials.values()),
            lambda arm: range(self.sarsa_seeds if arm.config.agent.name == "sarsa" else self.seeds),
            self.test_episodes,
        )

    def findings(self) -> Any:
        """What there is, and what it says."""
        plan = {name: getattr(self, name) for name in ("seeds", "sarsa_seeds", "episodes", "test_episodes")}
        return gather(self.grid, plan | {"tasks": list(self.tasks)}, self.out / FOLDER, self.mesh)

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """The page of what there is; the verdicts are printed too."""
        findings = self.findings()
        files = write(findings, self.out)
        for task in self.tasks:
            table = Table("said by", "what is reported", "ours [95 %]", "seeds", "verdict", title=task, box=None)
            for row in findings.rows["claims"]:
                if row["task"] == task:
                    known = [row[name] for name in ("mean", "low", "high")]
                    ours = "–" if None in known else "{} [{}, {}]".format(*map(number, known))
                    verdict = f"[{_COLOURS.get(row['verdict'], 'yellow')}]{row['verdict']}[/]"
                    says = f"{row['statement']} ({row['physics']})"
                    table.add_row(row["source"], says, ours, str(row["seeds"]), verdict)
            Console().print(table)
        return files, findings.found.failures
