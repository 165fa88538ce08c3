"""The runs of an arm over seeds, and what they are reduced to: one value for each seed."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import read_json
from codrl_mj.study.reproduction.arms import TEST, Arm
from codrl_mj.training.folder import EPISODES, RESULT
from codrl_mj.training.history import EPISODE_COLUMNS, read_episodes

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


def read_trained(folder: Path, tests: Mapping[str, Mapping[str, Any]]) -> Trained:
    """Read a finished run folder.

    Raises:
        FileNotFoundError: it is not finished.
        ValueError: a file is damaged.
    """
    result = read_json(folder / RESULT, "result of a run")
    return Trained(folder, read_episodes(folder / EPISODES), tests, float(result["seconds"]))


@dataclasses.dataclass(frozen=True)
class Series:
    """The runs of an arm, as far as they are finished."""

    arm: Arm
    """The arm."""
    runs: Mapping[int, Trained]
    """Seed -> run, seeds ascending."""
    missing: tuple[int, ...] = ()
    """Seeds that are wanted and not finished."""
    failures: Mapping[int, str] = dataclasses.field(default_factory=dict)
    """Missing seeds that failed, and why."""

    def only(self, seeds: Collection[int]) -> "Series":
        """The runs of some seeds."""
        return dataclasses.replace(self, runs={seed: run for seed, run in self.runs.items() if seed in seeds})

    def last_returns(self, count: int = LAST) -> np.ndarray:
        """Mean return of the last training episodes, a value for each seed; seeds without an episode are left out."""
        returns = [run.column("return") for run in self.runs.values()]
        return np.array([of_run[-count:].mean() for of_run in returns if len(of_run)])

    def tested(self, measure: str, test: str = TEST) -> np.ndarray:
        """A measure of a test, a value for each seed that has one; of an interval the mean, of quartiles the median."""
        values = [run.tests[test][measure] for run in self.runs.values()]
        plain = [value.get("mean", value.get("median")) if isinstance(value, Mapping) else value for value in values]
        return np.array([value for value in plain if value is not None], dtype=float)

    def times_to_goal(self) -> list[np.ndarray]:
        """Times to the goal of the test episodes [s], an array for each seed; infinite where it was not reached."""
        times = [run.tests[TEST]["episode_times_to_goal"] for run in self.runs.values()]
        return [np.array([np.inf if time is None else time for time in of_run]) for of_run in times]

    def returns_by_episode(self) -> np.ndarray:
        """Returns of the training, shape (seeds, episodes), as far as all seeds have them."""
        returns = [run.column("return") for run in self.runs.values()]
        shortest = min(map(len, returns), default=0)
        return np.array([of_run[:shortest] for of_run in returns]).reshape(len(returns), shortest)

    def epochs(self) -> list["Epochs"]:
        """The training by its epochs, which are the agent's rollouts; for each seed."""
        config = self.arm.config(0)
        steps = config.agent.rollout_steps * config.num_envs  # type: ignore[attr-defined]
        count = -(-(config.total_steps or 0) // steps)
        return [by_epoch(run, steps, count) for run in self.runs.values()]


@dataclasses.dataclass(frozen=True)
class Epochs:
    """A training by epochs: entry e is about the episodes that ended in epoch e + 1, and NaN if none did."""

    returns: np.ndarray
    """Mean return, shape (epochs,)."""
    lengths: np.ndarray
    """Mean length [steps], shape (epochs,)."""
    counts: np.ndarray
    """Number of episodes, shape (epochs,)."""

    def first(self, reached: np.ndarray) -> float:
        """The first epoch (from 1) in which a condition holds, or infinity.

        Args:
            reached: bool, shape (epochs,).
        """
        return float(np.argmax(reached)) + 1 if reached.any() else np.inf


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


def running_mean(values: np.ndarray, count: int = LAST) -> np.ndarray:
    """Mean of each value and those before it, at most `count` in all.

    Args:
        values: shape (..., n).
        count: >= 1.

    Returns:
        Shape (..., n).
    """
    sums = np.cumsum(np.concatenate([np.zeros((*values.shape[:-1], 1)), values], axis=-1), axis=-1)
    ends = np.arange(1, values.shape[-1] + 1)
    begins = np.maximum(0, ends - count)
    return (sums[..., ends] - sums[..., begins]) / (ends - begins)


def band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over seeds with its 95 % percentile-bootstrap interval, at every place (scipy, 999 resamples, fixed seed).

    Args:
        values: shape (seeds, n), seeds >= 1.

    Returns:
        Mean, lower and upper bound, shape (n,) each; with one seed the bounds are the mean.
    """
    mean = values.mean(axis=0)
    if len(values) < 2 or not values.size:
        return mean, mean, mean
    from scipy.stats import bootstrap

    interval = bootstrap(
        (values,), np.mean, axis=0, n_resamples=999, batch=50, method="percentile", rng=0
    ).confidence_interval
    return mean, interval.low, interval.high


def interval_text(seeds: Sequence[int]) -> str:
    """Seeds as text: runs of consecutive ones by their ends."""
    parts: list[list[int]] = []
    for seed in sorted(seeds):
        if parts and seed == parts[-1][1] + 1:
            parts[-1][1] = seed
        else:
            parts.append([seed, seed])
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in parts)
