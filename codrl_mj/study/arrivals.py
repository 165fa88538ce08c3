"""Whether and when an agent met the goal in training, on tasks whose episodes end there."""

import dataclasses
from pathlib import Path

from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig
from codrl_mj.training.folder import EPISODES
from codrl_mj.training.history import EPISODE_COLUMNS, read_episodes


@dataclasses.dataclass(frozen=True)
class Arrivals:
    """The training episodes of a run that reached the goal."""

    episodes: int
    """Training episodes, >= 0."""
    arrived: int
    """Those that ended at the goal."""
    first: int | None
    """Number of the first of these, from 1; None if there is none."""


def ends_at_goal(task: str) -> bool:
    """Whether a task's episodes end at a goal, and nowhere else before the time limit."""
    definition = find_task(task)
    return definition.goal is not None and definition.goal is definition.terminated


def read_arrivals(config: TrainConfig, run: Path) -> Arrivals:
    """Count the arrivals of a run.

    Args:
        config: of the run, on a task that `ends_at_goal`. An episode that arrives with the last step that it has is
            not told from one that does not.
        run: its folder.

    Raises:
        ValueError: its table of episodes is damaged.
    """
    lengths = read_episodes(run / EPISODES)[:, EPISODE_COLUMNS.index("length")]
    arrived = lengths < config.env.time_limit
    return Arrivals(len(arrived), int(arrived.sum()), int(arrived.argmax()) + 1 if arrived.any() else None)
