"""The runs of an arm over seeds, and what they are reduced to: one value for each seed."""

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.study.trials import Collected, plain, training_seconds
from codrl_mj.training.folder import EPISODES
from codrl_mj.training.history import EPISODE_COLUMNS, read_episodes
from reproduction.arms import TEST, PaperArm

LAST = 50
"""Training episodes that the paper takes its means over."""


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished run and its tests."""

    folder: Path
    """Run folder."""
    episodes: np.ndarray
    """Training episodes, shape (n, 4); columns `EPISODE_COLUMNS`."""
    tests: Mapping[str, Mapping[str, Any]]
    """`Evaluation.as_mapping()` of every test."""
    seconds: float
    """Wall-clock time of the training [s]."""

    def column(self, name: str) -> np.ndarray:
        """A column of the training episodes, shape (n,)."""
        return self.episodes[:, EPISODE_COLUMNS.index(name)]


@dataclasses.dataclass(frozen=True)
class Epochs:
    """A training by epochs: entry e is about the episodes that ended in epoch e + 1, and NaN if none did."""

    returns: np.ndarray
    """Mean return, shape (epochs,)."""
    lengths: np.ndarray
    """Mean length [steps], shape (epochs,)."""
    counts: np.ndarray
    """Number of episodes, shape (epochs,)."""


@dataclasses.dataclass(frozen=True)
class Series:
    """The runs of an arm, as far as they are finished and tested."""

    arm: PaperArm
    """The arm."""
    runs: Mapping[int, Trained]
    """Seed -> run, seeds ascending."""

    def only(self, seeds: Collection[int]) -> "Series":
        """The runs of some seeds."""
        return dataclasses.replace(self, runs={seed: run for seed, run in self.runs.items() if seed in seeds})

    def last_returns(self, count: int = LAST) -> np.ndarray:
        """Mean return of the last training episodes, a value for each seed; seeds without an episode are left out."""
        returns = [run.column("return") for run in self.runs.values()]
        return np.array([of_run[-count:].mean() for of_run in returns if len(of_run)])

    def tested(self, measure: str, test: str = TEST) -> np.ndarray:
        """A measure of a test, a value for each seed that has one; of an interval the mean, of quartiles the median."""
        values = [plain(run.tests[test][measure]) for run in self.runs.values()]
        return np.array([value for value in values if value is not None], dtype=float)

    def times_to_goal(self) -> list[np.ndarray]:
        """Times to the goal of the test episodes [s], an array for each seed; infinite where it was not reached."""
        times = [run.tests[TEST]["episode_times_to_goal"] for run in self.runs.values()]
        return [np.array([np.inf if time is None else time for time in of_run]) for of_run in times]

    def returns_by_episode(self) -> np.ndarray:
        """Returns of the training, shape (seeds, episodes), as far as all seeds have them; there must be one."""
        returns = [run.column("return") for run in self.runs.values()]
        shortest = min(map(len, returns))
        return np.array([of_run[:shortest] for of_run in returns])

    def epochs(self) -> list[Epochs]:
        """The training by its epochs, which are the agent's rollouts; for each seed."""
        config = self.arm.config
        steps = config.agent.rollout_steps * config.num_envs  # type: ignore[attr-defined]
        return [by_epoch(run, steps, -(-(config.total_steps or 0) // steps)) for run in self.runs.values()]


def read_series(arm: PaperArm, found: Collected) -> Series:
    """Read the runs of an arm that are finished and tested.

    Raises:
        ValueError: a file of a run is damaged.
    """
    runs = {}
    for seed in found.grid.seeds_of(arm):
        folder, by_test = found.folders.get((arm.name, seed)), arm.trials.items()
        if folder is not None and all(seed in found.evaluations[trial.name] for _, trial in by_test):
            tests = {test: found.evaluations[trial.name][seed] for test, trial in by_test}
            runs[seed] = Trained(folder, read_episodes(folder / EPISODES), tests, training_seconds(folder))
    return Series(arm, runs)


def by_epoch(run: Trained, steps: int, count: int) -> Epochs:
    """Sort a run's episodes into epochs.

    Args:
        run: the run.
        steps: of an epoch.
        count: of epochs.
    """
    epoch = np.ceil(run.column("steps") / steps).astype(int) - 1
    numbers = np.bincount(epoch, minlength=count)[:count]

    def mean(column: str) -> np.ndarray:
        sums = np.bincount(epoch, run.column(column), minlength=count)[:count]
        return np.divide(sums, numbers, out=np.full(count, np.nan), where=numbers > 0)

    return Epochs(mean("return"), mean("length"), numbers)
