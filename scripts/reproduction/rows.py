"""Published rows: the results of a training as text, by which claims are judged."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.evaluation.measures import holds_since
from codrl_mj.runs import EPISODES
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.pages import read_csv
from codrl_mj.study.trials import StudyResults, to_scalar, training_seconds
from codrl_mj.tasks import TASKS
from codrl_mj.tasks.pendulum import GOAL_HOLD, MAX_TORQUE, upright_angle
from codrl_mj.training import EVALUATION_SEED
from codrl_mj.training.history import EPISODE_COLUMNS, read_episodes
from reproduction.arms import CENTRE, TEST, PaperArm

Row = Mapping[str, str]
"""Row of a training and its tests; unknown values are empty."""
LAST = 50
"""Number of the last training episodes whose mean return the paper reports."""
# Number of steps of an epoch.
FULL_LENGTH = 4000.0
# Return of an epoch that "approaches 4000" in the paper.
FULL_RETURN = 3800.0
# The limits of upright and still follow from full torque. It just holds the rod at 0.41 rad; the
# angle [rad] is half of that. The speed [rad/s] is the change within a step,
# torque * step / (m l^2 / 3).
UPRIGHT_ANGLE = 0.2
UPRIGHT_SPEED = 3 * MAX_TORQUE * 0.05
RUNS = "runs.csv"
"""File of the rows."""
TESTED = (
    *("returns", "success", "time_to_goal", "tracking_rms", "tracking_percent", "tracking_max"),
    *("saturated_percent", "peak_voltage"),
)
"""Measures of the test, as in docs/evaluation.md: means, and the median time to the goal."""
FURTHER = ("centred", "long_epoch", "paid_epoch", "upright", "times", "tracking_step_percent")
"""Measures of single tasks.

They are the share of steps near the center, first epochs, the share of episodes that end upright,
the times of all test episodes to the goal, or upright [s], with `-` if it was not reached, and with
an inner loop the torque error at the end of the policy's steps [%].
"""
COLUMNS = (
    *("task", "settings", "motor", "gains", "physics", "seed", "run", "seconds", f"last_{LAST}"),
    *(*TESTED, *FURTHER),
)
"""All columns of a row."""


@dataclasses.dataclass(frozen=True)
class Trained:
    """Finished run with its tests."""

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
    """Training by epochs: means over the episodes that ended in each epoch, NaN if none did."""

    returns: np.ndarray
    """Mean return, shape (epochs,)."""
    lengths: np.ndarray
    """Mean length [steps], shape (epochs,)."""
    counts: np.ndarray
    """Number of episodes, shape (epochs,)."""


def identity(arm: PaperArm, seed: int) -> tuple[str, ...]:
    """Return the identity of a training's row, in the order of `identity_of_row`."""
    return arm.task, arm.settings, arm.motor, arm.physics, str(seed)


def identity_of_row(row: Row) -> tuple[str, ...]:
    """Return the identity of a row: task, settings, motor, physics and seed."""
    return row["task"], row["settings"], row["motor"], row["physics"], row["seed"]


def read_rows(folder: Path) -> dict[tuple[str, ...], list[Row]]:
    """Return published rows by identity; a seed with several versions of packages has several."""
    rows_by_identity: dict[tuple[str, ...], list[Row]] = {}
    for row in read_csv(folder / RUNS):
        rows_by_identity.setdefault(identity_of_row(row), []).append(
            {name: row.get(name, "") for name in COLUMNS}
        )
    return rows_by_identity


def complete(rows: Iterable[Row], columns: set[str]) -> bool:
    """Return True if a row of a training has all columns that are needed, so it need not run."""
    return any(all(row[column] for column in columns) for row in rows)


def joined(rows: Sequence[Row], new: Row) -> list[Row]:
    """Add a row to those of its seed, in place of one with the same results.

    Trainings with other versions of packages have other results, and are kept. The name of the new
    run gets the suffix ` again` if such a training has the same configuration, and thus its name.
    """

    def training(row: Row) -> list[str]:
        return [row[name] for name in (f"last_{LAST}", *TESTED)]

    other_rows = [row for row in rows if training(row) != training(new)]
    is_name_taken = any(row["run"] == new["run"] for row in other_rows)
    return [*other_rows, {**new, "run": f"{new['run']} again"} if is_name_taken else new]


def times_of(text: str) -> np.ndarray:
    """Parse times [s] from a row's text, shape (episodes,); infinite if not at the goal."""
    return np.array([np.inf if time == "-" else float(time) for time in text.split()])


def read_trained(arm: PaperArm, collected: StudyResults) -> dict[int, Trained]:
    """Return the runs of an arm that are finished and tested, by seed.

    Raises:
        ValueError: a file of a run is damaged.
    """
    runs = {}
    for seed in collected.grid.seeds_of(arm):
        folder, by_test = collected.folders.get((arm.name, seed)), arm.trials.items()
        if folder is not None and all(
            seed in collected.evaluations[trial.name] for _, trial in by_test
        ):
            tests = {test: collected.evaluations[trial.name][seed] for test, trial in by_test}
            runs[seed] = Trained(
                folder, read_episodes(folder / EPISODES), tests, training_seconds(folder)
            )
    return runs


def run_row(arm: PaperArm, seed: int, run: Trained) -> Row:
    """Return the row of a finished run."""
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
        row["long_epoch"] = first_epoch(epochs.lengths >= FULL_LENGTH)
        row["paid_epoch"] = first_epoch(epochs.returns >= FULL_RETURN)
    else:
        times = run.tests[TEST]["episode_times_to_goal"]
        if arm.task == "pendulum":
            times = [upright_since(episode) for episode in run_tests(arm, run.folder, len(times))]
            row["upright"] = float(np.mean([time is not None for time in times]))
        elif arm.actuator != IDEAL:
            episodes = run_tests(arm, run.folder, len(times))
            row["tracking_step_percent"] = step_tracking(episodes)
        row["times"] = " ".join("-" if time is None else f"{time:.6g}" for time in times)
    return {name: "" if row[name] is None else str(row[name]) for name in COLUMNS}


def run_tests(arm: PaperArm, folder: Path, episodes: int) -> list[Episode]:
    """Run the first test episodes of a run's policy."""
    return run_episodes(load_policy(folder), arm.trials[TEST].env.build, episodes, EVALUATION_SEED)


def step_tracking(episodes: Sequence[Episode]) -> float | None:
    """Return the rms torque error by the rms desired torque at the end of the policy's steps [%].

    With an inner loop this is its last step, as in the paper's Algorithm 2; `tracking_percent` is
    that of all its steps. It is None if no torque is desired.
    """
    desired, actual = (
        np.concatenate([episode.signals[name] for episode in episodes])
        for name in ("desired_force", "actual_force")
    )
    error, scale = float(np.mean((actual - desired) ** 2)), float(np.mean(desired**2))
    return 100.0 * (error / scale) ** 0.5 if scale > 0 else None


def upright_since(episode: Episode) -> float | None:
    """Return the time from which the pendulum stays upright and still [s].

    It is None if that does not hold over the last second.
    """
    angle, speed = np.abs(upright_angle(episode.state.T)), np.abs(episode.state[:, 1])
    step = float(episode.time[0])
    since = holds_since((angle <= UPRIGHT_ANGLE) & (speed <= UPRIGHT_SPEED)) * step
    # Half a step absorbs rounding.
    return since if since + GOAL_HOLD < episode.time[-1] + 0.5 * step else None


def first_epoch(reached: np.ndarray) -> int:
    """Return the first epoch in which a condition holds, or one more than there are."""
    return 1 + int(np.argmax(np.append(reached, True)))


def epochs_of(arm: PaperArm, run: Trained) -> Epochs:
    """Return a training by its epochs, which are the agent's rollouts."""
    steps = arm.config.agent.rollout_steps * arm.config.num_envs  # type: ignore[attr-defined]
    return by_epoch(run, steps, -(-(arm.config.total_steps or 0) // steps))


def by_epoch(run: Trained, steps: int, count: int) -> Epochs:
    """Sort a run's episodes into epochs.

    Args:
        run: finished run.
        steps: steps of an epoch.
        count: number of epochs.
    """
    epoch = np.ceil(run.column("steps") / steps).astype(int) - 1
    numbers = np.bincount(epoch, minlength=count)[:count]

    def mean(column: str) -> np.ndarray:
        sums = np.bincount(epoch, run.column(column), minlength=count)[:count]
        means: np.ndarray = np.divide(sums, numbers, out=np.full(count, np.nan), where=numbers > 0)
        return means

    return Epochs(mean("return"), mean("length"), numbers)
