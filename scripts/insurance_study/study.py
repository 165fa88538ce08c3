"""The study of what insures a policy, as a program: its grid, and what it writes."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from codrl_mj.fields import integer
from codrl_mj.study.grid import check_selection
from codrl_mj.study.program import Program
from codrl_mj.study.trials import Grid
from insurance_study.page import FOLDER, write
from insurance_study.questions import TASKS, new, trials


@dataclasses.dataclass(frozen=True, kw_only=True)
class InsuranceStudy(Program):
    """Run the study of what insures a policy, or go on with it, and write its page: docs/studies.md.

    What is finished is not computed again. Example: python scripts/study_insurance.py --dry-run
    """

    root: Path = Path("runs/insurance")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = TASKS
    """Tasks."""
    seeds: int = integer(20, least=1)
    """Training runs of every arm, with seeds from 0."""
    first_seed: int = integer(0, least=0)
    """The first of them; the pilot's is 1000."""
    episodes: int = integer(50, least=1)
    """Test episodes of every policy."""
    new_only: bool = False
    """Leave out what needs policies of the first study's arms to be trained again."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_selection("tasks", self.tasks, TASKS)

    @property
    def grid(self) -> Grid:
        """Its trainings and tests."""
        chosen = [
            one
            for one in trials()
            if one.arm.task in self.tasks and (new(one) or not self.new_only)
        ]
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return Grid(self.root, tuple(chosen), lambda _: seeds, self.episodes, self.out / FOLDER)

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """The page of all results that there are, and what failed."""
        collected = dataclasses.replace(self, new_only=False).grid.collect()
        return write(collected, self.out), collected.failures
