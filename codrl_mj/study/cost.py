"""What the mismatch study takes: counted, and estimated from the runs that are finished."""

import dataclasses
from typing import NamedTuple

import numpy as np

from codrl_mj.files import read_json
from codrl_mj.study.grid import cell_folder
from codrl_mj.study.mismatch import MismatchConfig, cells, deployments
from codrl_mj.training import finished


class Speed(NamedTuple):
    """How fast an agent is on a task [1/s of one core]."""

    training: float
    """Training steps."""
    testing: float
    """Test episodes."""


SPEEDS: dict[tuple[str, str], Speed] = {
    ("cartpole", "ppo"): Speed(5000, 40),
    ("cartpole", "dqn"): Speed(1050, 40),
    ("pendulum", "ppo"): Speed(4700, 100),
    ("pendulum", "sac"): Speed(470, 100),
    ("acrobot", "ppo"): Speed(2600, 40),
    ("acrobot", "dqn"): Speed(660, 40),
}
"""(task, agent) -> where nothing is finished yet: measured on one core of a 2-core virtual machine that was busy."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What the runs of an agent on a task take."""

    task: str
    """Task name."""
    agent: str
    """The agent's name."""
    steps: int
    """Environment steps of a training."""
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
        steps = next(iter(mine.values())).total_steps or 0
        speed = SPEEDS[task, agent]
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


def seeds_finished(config: MismatchConfig) -> dict[str, dict[int, bool]]:
    """Kind of training -> seed -> whether it is finished."""
    found: dict[str, dict[int, bool]] = {}
    for name, cell in cells(config).items():
        kind, _, seed = name.rpartition(", seed ")
        found.setdefault(kind, {})[int(seed)] = finished(cell_folder(config.root, cell))
    return found
