"""`codrl-mj reproduce`."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.study import Computed
from codrl_mj.tasks import TASKS


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce(Computed):
    """Do the paper's experiments again, judge what it reports, and write a page: docs/reproduction.md.

    What is finished is not computed again: the same command resumes, adds seeds, and writes the page anew. Example:
    codrl-mj reproduce --dry-run, or codrl-mj reproduce mountain_car --jobs 2
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="{" + ",".join(TASKS) + "}", help="Whose experiments; all if none is named."),
    ] = ()
    root: Path = Path("runs/paper")
    sarsa_seeds: int = 30
    """Training runs of each kind of SARSA (mountain_car), which take seconds."""
    episodes: int | None = None
    """Cut every training off after so many episodes, for trying things out; the default is the paper's budgets."""
    test_episodes: int = 100
    """Test episodes of each policy."""

    def plan(self) -> Any:
        """The experiments of the chosen tasks."""
        from codrl_mj.study.reproduction.reproduce import Reproduction

        names = "root", "seeds", "sarsa_seeds", "episodes", "test_episodes", *(["tasks"] if self.tasks else [])
        return Reproduction(**{name: getattr(self, name) for name in names})

    def grid(self) -> Any:
        """Their trainings and tests."""
        return self.plan().grid

    def write(self) -> tuple[Iterable[Path], Mapping[str, Any]]:
        """The page of what there is; the verdicts are printed too."""
        from codrl_mj.study.reproduction.page import write
        from codrl_mj.study.reproduction.reproduce import gather

        findings = gather(self.plan())
        files = write(findings, self.out)
        _print_verdicts(findings)
        return files, findings.found.failures


def _print_verdicts(findings: Any) -> None:
    """Print a row for each claim."""
    from rich.text import Text

    from codrl_mj.cli.terminal import print_table
    from codrl_mj.study.reproduction.verdicts import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, number

    colours = {CONFIRMED: "green", COMPATIBLE: "cyan", NOT_CONFIRMED: "red"}
    columns = "said by", "what is reported", "ours [95 %]", "seeds", "verdict"
    for task in findings.plan.tasks:
        rows: list[Any] = []
        for claim, verdict in findings.claims:
            if claim.task == task:
                found = "–" if verdict.measured is None else "{} [{}, {}]".format(*map(number, verdict.measured))
                outcome = Text(str(verdict.outcome), colours.get(verdict.outcome, "yellow"))
                statement = f"{claim.statement} ({claim.physics})"
                rows.append((claim.source, statement, found, str(verdict.samples), outcome))
        print_table(task, columns, rows, right=("seeds",), padding=(0, 1))
