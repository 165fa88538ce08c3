"""What the mismatch study takes: counted, and estimated from the runs that are finished."""

import dataclasses
from typing import NamedTuple

import numpy as np

from codrl_mj.runs.files import read_json
from codrl_mj.study.grid import cell_folder
from codrl_mj.study.mismatch import MismatchConfig, cells, deployments
from codrl_mj.training import TrainConfig, finished


class Speed(NamedTuple):
    """How fast an agent is on a task [1/s of one core]."""

    training: float
    """Training steps."""
    testing: float
    """Test episodes."""
    episode: float | None = None
    """Steps of a training episode, where the agent's budget is in episodes [1]."""


SPEEDS: dict[tuple[str, str], Speed] = {
    ("cartpole", "ppo"): Speed(7700, 130),
    ("cartpole", "dqn"): Speed(1450, 130),
    ("pendulum", "ppo"): Speed(6400, 190),
    ("pendulum", "sac"): Speed(490, 190),
    ("acrobot", "ppo"): Speed(4300, 50),
    ("acrobot", "dqn"): Speed(960, 50, episode=135),
}
"""(task, agent) -> where nothing is finished yet: measured with two trainings at once on a 2-core virtual machine."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What the runs of an agent on a task take."""

    task: str
    """Task name."""
    agent: str
    """The agent's name."""
    steps: int
    """Environment steps of a training; an estimate if its budget is in episodes."""
    trainings: int
    """Trainings in all."""
    trained: int
    """How many of them are finished."""
    seconds: float
    """A training's duration [s of one core]: the mean of the finished ones, or an estimate if there is none."""
    tests: int
    """Tests of policies in all."""
    tested: int
    """How many of them are finished."""
    test_seconds: float
    """A test's duration [s of one core], estimated."""

    @property
    def left(self) -> float:
        """What is left to do [s of one core]."""
        return (self.trainings - self.trained) * self.seconds + (self.tests - self.tested) * self.test_seconds

    @property
    def total(self) -> float:
        """All of it [s of one core]."""
        return self.trainings * self.seconds + self.tests * self.test_seconds


def costs(config: MismatchConfig) -> list[Cost]:
    """What every agent takes on every task.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    every, tests = cells(config), deployments(config)
    folders = {name: cell_folder(config.root, cell) for name, cell in every.items()}
    by_folder = [deployment for by_seed in tests.values() for deployment in by_seed.values()]
    found = []
    for task, agent in dict.fromkeys((cell.task, cell.agent.name) for cell in every.values()):
        mine = {name: cell for name, cell in every.items() if (cell.task, cell.agent.name) == (task, agent)}
        runs = {folders[name] for name in mine}
        took = [read_json(run / "result.json", "result of a run")["seconds"] for run in runs if finished(run)]
        speed = SPEEDS[task, agent]
        steps = _steps(next(iter(mine.values())), speed)
        mine_tested = [deployment for deployment in by_folder if deployment.run in runs]
        found.append(
            Cost(
                task=task,
                agent=agent,
                steps=steps,
                trainings=len(mine),
                trained=len(took),
                seconds=float(np.mean(took)) if took else steps / speed.training,
                tests=len(mine_tested),
                tested=sum(deployment.record.is_file() for deployment in mine_tested),
                test_seconds=config.episodes / speed.testing,
            )
        )
    return found


def _steps(cell: TrainConfig, speed: Speed) -> int:
    """Environment steps of a training; an estimate if its budget is in episodes."""
    if cell.total_steps is not None:
        return cell.total_steps
    assert cell.total_episodes is not None
    assert speed.episode is not None
    return round(cell.total_episodes * speed.episode)


def seeds_finished(config: MismatchConfig) -> dict[str, dict[int, bool]]:
    """Kind of training -> seed -> whether it is finished."""
    found: dict[str, dict[int, bool]] = {}
    for name, cell in cells(config).items():
        kind, _, seed = name.rpartition(", seed ")
        found.setdefault(kind, {})[int(seed)] = finished(cell_folder(config.root, cell))
    return found
