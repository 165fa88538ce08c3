"""What is published of a training: a row of numbers as text, which alone is judged; and how run folders make one."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.evaluation.measures import holds_since
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.pages import read_csv
from codrl_mj.study.trials import Collected, to_scalar, training_seconds
from codrl_mj.tasks import TASKS
from codrl_mj.tasks.pendulum import GOAL_HOLD, MAX_TORQUE, upright_angle
from codrl_mj.training import EVALUATION_SEED
from codrl_mj.training.folder import EPISODES
from codrl_mj.training.history import EPISODE_COLUMNS, read_episodes
from reproduction.arms import CENTRE, TEST, PaperArm

Row = Mapping[str, str]
"""A training and its test; empty where nothing is known."""
LAST = 50
"""Training episodes that the paper takes its means over."""
FULL_LENGTH = 4000.0  # steps of an epoch
FULL_RETURN = 3800.0  # of an epoch, that "approaches 4000"
# upright and still, by what full torque can do: it just holds the rod at 0.41 rad, of which this is
# half, and changes its speed by so much within a step
UPRIGHT_ANGLE = 0.2  # rad
UPRIGHT_SPEED = 3 * MAX_TORQUE * 0.05  # rad/s: torque * step / (m l^2 / 3)
RUNS = "runs.csv"
"""The file of the rows."""
TESTED = (
    *("returns", "success", "time_to_goal", "tracking_rms", "tracking_percent", "tracking_max"),
    *("saturated_percent", "peak_voltage"),
)
"""Measures of the test in a row, as docs/evaluation.md has them: means, and the median time to the goal."""
FURTHER = ("centred", "long_epoch", "paid_epoch", "upright", "times")
"""Those of single tasks: share of steps near the centre, first epochs, share of episodes that end
upright; and the times of all test episodes to the goal, or upright [s], `-` where it was not
reached.
"""
COLUMNS = (
    *("task", "settings", "motor", "gains", "physics", "seed", "run", "seconds", f"last_{LAST}"),
    *(*TESTED, *FURTHER),
)
"""All of a row."""


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


def identity(arm: PaperArm, seed: int) -> tuple[str, ...]:
    """What a row is of, as `of_row` has it."""
    return arm.task, arm.settings, arm.motor, arm.physics, str(seed)


def of_row(row: Row) -> tuple[str, ...]:
    """What a row is of."""
    return row["task"], row["settings"], row["motor"], row["physics"], row["seed"]


def read_rows(folder: Path) -> dict[tuple[str, ...], list[Row]]:
    """Published rows by what they are of: several where a seed was trained with different packages."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in read_csv(folder / RUNS):
        found.setdefault(of_row(row), []).append({name: row.get(name, "") for name in COLUMNS})
    return found


def complete(rows: Iterable[Row], columns: set[str]) -> bool:
    """Whether a training needs not be done again, since a row of it has what is judged by."""
    return any(all(row[column] for column in columns) for row in rows)


def joined(rows: Sequence[Row], new: Row) -> list[Row]:
    """Rows of a seed with a new one, in place of one of the same training; with other packages it is another."""

    def training(row: Row) -> list[str]:
        return [row[name] for name in (f"last_{LAST}", *TESTED)]

    others = [row for row in rows if row["run"] != new["run"] and training(row) != training(new)]
    return [*others, new]


def times_of(text: str) -> np.ndarray:
    """Times [s] from a row's text, shape (episodes,); infinite where the goal was not reached."""
    return np.array([np.inf if time == "-" else float(time) for time in text.split()])


def read_trained(arm: PaperArm, found: Collected) -> dict[int, Trained]:
    """The runs of an arm that are at hand, finished and tested, by seed.

    Raises:
        ValueError: a file of a run is damaged.
    """
    runs = {}
    for seed in found.grid.seeds_of(arm):
        folder, by_test = found.folders.get((arm.name, seed)), arm.trials.items()
        if folder is not None and all(
            seed in found.evaluations[trial.name] for _, trial in by_test
        ):
            tests = {test: found.evaluations[trial.name][seed] for test, trial in by_test}
            runs[seed] = Trained(
                folder, read_episodes(folder / EPISODES), tests, training_seconds(folder)
            )
    return runs


def run_row(arm: PaperArm, seed: int, run: Trained) -> Row:
    """The row of a finished run."""
    row: dict[str, Any] = {
        name: getattr(arm, name) for name in ("task", "settings", "motor", "gains", "physics")
    }
    row |= {"seed": seed, "run": run.folder.name, "seconds": run.seconds}
    row |= {
        f"last_{LAST}": float(run.column("return")[-LAST:].mean()) if len(run.episodes) else None
    }
    row |= {name: to_scalar(run.tests[TEST][name]) for name in TESTED} | dict.fromkeys(FURTHER)
    if CENTRE in run.tests:
        row["centred"] = to_scalar(run.tests[CENTRE]["returns"]) / TASKS[arm.task].max_episode_steps
        epochs = epochs_of(arm, run)
        row["long_epoch"] = first(epochs.lengths >= FULL_LENGTH)
        row["paid_epoch"] = first(epochs.returns >= FULL_RETURN)
    else:
        times = run.tests[TEST]["episode_times_to_goal"]
        if arm.task == "pendulum":
            times = [upright_since(episode) for episode in run_tests(arm, run.folder, len(times))]
            row["upright"] = float(np.mean([time is not None for time in times]))
        row["times"] = " ".join("-" if time is None else f"{time:.6g}" for time in times)
    return {name: "" if row[name] is None else str(row[name]) for name in COLUMNS}


def run_tests(arm: PaperArm, folder: Path, episodes: int) -> list[Episode]:
    """The first test episodes of a run's policy."""
    return run_episodes(load_policy(folder), arm.trials[TEST].env.make, episodes, EVALUATION_SEED)


def upright_since(episode: Episode) -> float | None:
    """Time from which the pendulum is upright and still to the end [s]; None if not over the last second."""
    angle, speed = np.abs(upright_angle(episode.state.T)), np.abs(episode.state[:, 1])
    step = float(episode.time[0])
    since = holds_since((angle <= UPRIGHT_ANGLE) & (speed <= UPRIGHT_SPEED)) * step
    return (
        since if since + GOAL_HOLD < episode.time[-1] + 0.5 * step else None
    )  # half a step: rounding


def first(reached: np.ndarray) -> int:
    """The first epoch in which something holds; one more than there are if it never does."""
    return 1 + int(np.argmax(np.append(reached, True)))


def epochs_of(arm: PaperArm, run: Trained) -> Epochs:
    """A training by its epochs, which are the agent's rollouts."""
    steps = arm.config.agent.rollout_steps * arm.config.num_envs  # type: ignore[attr-defined]
    return by_epoch(run, steps, -(-(arm.config.total_steps or 0) // steps))


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
