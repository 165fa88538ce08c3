"""Command line of the study of the cost of an actuator: its grid of runs, and its outputs."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from actuator_study.exploration import explored
from actuator_study.page import FOLDER, write
from actuator_study.questions import trials
from codrl_mj.fields import integer
from codrl_mj.study.axes import SECONDS
from codrl_mj.study.grid import check_selection
from codrl_mj.study.program import Program
from codrl_mj.study.trials import Grid


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActuatorStudy(Program):
    """Run or resume the study of the cost of an actuator, and write its page: docs/studies.md.

    Finished results are not computed again, so the same command resumes a study, adds seeds, and
    rewrites its page. Example: python scripts/study_actuators.py --dry-run, or with --tasks
    pendulum --seeds 3 --jobs 2
    """

    root: Path = Path("runs/actuators")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = tuple(SECONDS)
    """Tasks."""
    seeds: int = integer(20, minimum=1)
    """Training runs of every arm, with seeds from 0."""
    episodes: int = integer(50, minimum=1)
    """Test episodes of every policy."""
    total_steps: int | None = integer(None, minimum=1)
    """Environment steps of every training, for quick trials; None: the agents' own budgets."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_selection("tasks", self.tasks, SECONDS)

    @property
    def grid(self) -> Grid:
        """Trainings and tests of the study."""
        every = {trial.name: trial for trial in trials()} | explored()
        chosen = [trial for trial in every.values() if trial.arm.task in self.tasks]
        if self.total_steps is not None:
            for index, trial in enumerate(chosen):
                short = dataclasses.replace(
                    trial.arm.config, total_steps=self.total_steps, total_episodes=None
                )
                chosen[index] = dataclasses.replace(
                    trial, arm=dataclasses.replace(trial.arm, config=short)
                )
        return Grid(
            self.root, tuple(chosen), lambda _: range(self.seeds), self.episodes, self.out / FOLDER
        )

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write the page of all existing results; return its files and the failures."""
        collected = self.grid.collect()
        return write(collected, self.out), collected.failures
