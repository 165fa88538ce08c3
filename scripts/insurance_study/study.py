"""Command line of the study of protecting a policy: its grid of runs, and its outputs."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from codrl_mj.fields import integer
from codrl_mj.study.grid import check_selection
from codrl_mj.study.program import Program
from codrl_mj.study.trials import Grid
from insurance_study.page import FOLDER, write
from insurance_study.questions import TASKS, needs_new_policies, trials


@dataclasses.dataclass(frozen=True, kw_only=True)
class InsuranceStudy(Program):
    """Run or resume the study of protecting a policy, and write its page: docs/studies.md.

    Finished results are not computed again. Example: python scripts/study_insurance.py --dry-run
    """

    root: Path = Path("runs/insurance")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = TASKS
    """Tasks."""
    seeds: int = integer(20, minimum=1)
    """Training runs of every arm, with seeds from 0."""
    first_seed: int = integer(0, minimum=0)
    """First of these seeds; the pilot's is 1000."""
    episodes: int = integer(50, minimum=1)
    """Test episodes of every policy."""
    new_only: bool = False
    """Skip tests of policies of the first study's arms, which would have to be trained again."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_selection("tasks", self.tasks, TASKS)

    @property
    def grid(self) -> Grid:
        """Trainings and tests of the study."""
        chosen = [
            trial
            for trial in trials()
            if trial.arm.task in self.tasks and (needs_new_policies(trial) or not self.new_only)
        ]
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return Grid(self.root, tuple(chosen), lambda _: seeds, self.episodes, self.out / FOLDER)

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write the page of all existing results; return its files and the failures."""
        collected = dataclasses.replace(self, new_only=False).grid.collect()
        return write(collected, self.out), collected.failures
