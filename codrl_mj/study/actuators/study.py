"""The study of what an actuator costs: its grid, from what a person chooses of it."""

import dataclasses
from pathlib import Path

from codrl_mj.fields import check, integer
from codrl_mj.study.actuators import arms
from codrl_mj.study.actuators.exploration import explored
from codrl_mj.study.actuators.questions import trials
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.trials import Grid


@dataclasses.dataclass(frozen=True)
class ActuatorStudy:
    """What of the study is computed, and where.

    Raises:
        ValueError: an unknown task (the nearest known one is suggested), or a number below 1.
    """

    root: Path = Path("runs/actuators")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = tuple(arms.SECONDS)
    """Tasks."""
    seeds: int = integer(20, least=1)
    """Training runs of every arm, >= 1, with seeds from 0."""
    episodes: int = integer(50, least=1)
    """Test episodes of every policy, >= 1."""
    total_steps: int | None = integer(None, least=1)
    """Environment steps of every training, >= 1, for trying things out; None: the agents' own budgets."""

    def __post_init__(self) -> None:
        """Validate."""
        check_chosen("tasks", self.tasks, arms.SECONDS)
        check(self)

    @property
    def grid(self) -> Grid:
        """Its trainings and tests."""
        every = {trial.name: trial for trial in trials()} | explored()
        chosen = [trial for trial in every.values() if trial.arm.task in self.tasks]
        if self.total_steps is not None:
            chosen = [dataclasses.replace(trial, arm=trial.arm.shortened(self.total_steps)) for trial in chosen]
        return Grid(self.root, tuple(chosen), lambda _: range(self.seeds), self.episodes)
