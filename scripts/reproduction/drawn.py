"""Data of the figures: published tables of curves and episodes, so that no run folder is needed."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.study.pages import read_csv
from reproduction.arms import PaperArm
from reproduction.rows import LAST, Trained, epochs_of, run_tests

CURVES, STATES, TORQUES = "curves.csv", "states.csv", "torques.csv"
"""Files of learning curves, states of a test episode, and torques at its beginning."""
# Maximum number of points of a learning curve.
POINTS = 125
# Beginning of an episode whose torques are shown: the longer of seconds and policy steps.
SHORT, FEW = 1.0, 20

ENTRIES = ("state_1", "state_2", "state_3", "state_4")
"""Columns of a state's entries, in the order of the task's `state_names`."""
Table = list[Mapping[str, str]]
"""Rows by column name, as text."""


def about(arm: PaperArm) -> dict[str, str]:
    """Return the columns that identify a row's arm; all rows are of MuJoCo."""
    return {"task": arm.task, "settings": arm.settings, "motor": arm.motor}


def curve_rows(arm: PaperArm, runs: Mapping[int, Trained]) -> Table:
    """Return the learning curves of an arm's runs: means over seeds with 95 % bands.

    At least one run is needed. Returns are running means over episodes. PPO's rollouts are the
    paper's epochs: its curves are mean return, mean length and number of episodes by epoch.
    """
    if arm.config.agent.name == "ppo":
        epochs = [epochs_of(arm, run) for run in runs.values()]
        curves = {
            name: np.array(
                [_filled(getattr(run_epochs, name).astype(float)) for run_epochs in epochs]
            )
            for name in ("lengths", "returns", "counts")
        }
    else:
        returns = [run.column("return") for run in runs.values()]
        shortest = min(map(len, returns))
        curves = {
            "returns": running_mean(np.array([run_returns[:shortest] for run_returns in returns]))
        }
    rows: Table = []
    for name, values in curves.items():
        step = max(1, math.ceil(values.shape[1] / POINTS))
        indices = np.arange(step - 1, values.shape[1], step)
        for index, *point in zip(indices + 1, *band(values[:, indices]), strict=True):
            numbers = dict(zip(("mean", "low", "high"), map(_short, point), strict=True))
            rows.append(
                about(arm) | {"curve": name, "seeds": str(len(runs)), "at": str(index)} | numbers
            )
    return rows


def state_rows(arm: PaperArm, episode: Episode) -> Table:
    """Return the states of an episode, including the initial one."""
    times = np.concatenate([[0.0], episode.time])
    return [
        about(arm)
        | {"time": _short(time)}
        | dict.fromkeys(ENTRIES, "")
        | dict(zip(ENTRIES, map(_short, state), strict=False))
        for time, state in zip(times, episode.state, strict=True)
    ]


def torque_rows(arm: PaperArm, episode: Episode) -> Table:
    """Return an episode's first desired and actual shaft torques [N*m], by integration step."""
    radius, inner = arm.actuator.motor.arm_radius, episode.inner_steps
    desired = radius * np.repeat(episode.signals["desired_force"], inner)
    actual = radius * episode.trace["actual_force"]
    shown = max(FEW * inner, round(SHORT / episode.timestep))
    pairs = zip(desired[:shown], actual[:shown], strict=True)
    return [
        about(arm)
        | {
            "time": _short(step * episode.timestep),
            "desired": _short(desired_torque),
            "actual": _short(actual_torque),
        }
        for step, (desired_torque, actual_torque) in enumerate(pairs)
    ]


def gather_tables(
    arms: Iterable[PaperArm], runs: Mapping[str, Mapping[int, Trained]], published: Path
) -> dict[str, Table]:
    """Make the tables from runs, or take the published ones if they are of more seeds.

    Args:
        arms: arms of the tables.
        runs: arm's name -> seed -> run.
        published: folder of the published tables.
    """
    published_tables = {name: read_csv(published / name) for name in (CURVES, STATES, TORQUES)}
    tables: dict[str, Table] = {CURVES: [], STATES: [], TORQUES: []}
    for arm in arms:
        if arm.physics != "mujoco":
            continue
        arm_runs = runs.get(arm.name, {})
        published_rows = {
            name: [row for row in rows if _of(row) == about(arm)]
            for name, rows in published_tables.items()
        }
        seeds = max((int(row["seeds"]) for row in published_rows[CURVES]), default=0)
        tables[CURVES] += (
            curve_rows(arm, arm_runs)
            if arm_runs and len(arm_runs) >= seeds
            else published_rows[CURVES]
        )
        if arm_runs and (0 in arm_runs or not published_rows[STATES]):
            (episode,) = run_tests(arm, next(iter(arm_runs.values())).folder, 1)
            tables[STATES] += state_rows(arm, episode)
            tables[TORQUES] += [] if arm.actuator == IDEAL else torque_rows(arm, episode)
        else:
            tables[STATES] += published_rows[STATES]
            tables[TORQUES] += published_rows[TORQUES]
    return tables


def _of(row: Mapping[str, str]) -> dict[str, str]:
    return {name: row[name] for name in ("task", "settings", "motor")}


def column(rows: Iterable[Mapping[str, str]], name: str) -> np.ndarray:
    """Return a column of a table as numbers, shape (n,)."""
    return np.array([float(row[name]) for row in rows])


def running_mean(values: np.ndarray, count: int = LAST) -> np.ndarray:
    """Return the mean of each value and those before it, at most `count` in all.

    Args:
        values: shape (..., n).
        count: >= 1.

    Returns:
        Shape (..., n).
    """
    sums = np.cumsum(values, axis=-1)
    sums[..., count:] = sums[..., count:] - sums[..., :-count]
    return sums / np.minimum(np.arange(1, values.shape[-1] + 1), count)


def band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean over seeds and its 95 % interval at every index, by percentile bootstrap.

    It uses scipy with 999 resamples and a fixed seed.

    Args:
        values: shape (seeds, n), seeds >= 1.

    Returns:
        Mean, lower and upper bound, shape (n,) each; with one seed the bounds are the mean.
    """
    mean = values.mean(axis=0)
    if len(values) < 2 or not values.size:
        return mean, mean, mean
    from scipy.stats import bootstrap

    options: dict[str, Any] = {"n_resamples": 999, "batch": 50, "method": "percentile", "rng": 0}
    interval = bootstrap((values,), np.mean, axis=0, **options).confidence_interval
    return mean, interval.low, interval.high


def _filled(values: np.ndarray) -> np.ndarray:
    """Replace every NaN by the value before it, or by 0 if there is none."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last >= 0, values[last], 0.0)


def _short(value: float) -> str:
    return f"{float(value):.5g}"


def arms_of(table: Sequence[Mapping[str, str]], task: str) -> dict[tuple[str, str], Table]:
    """Return a task's rows by settings and motor."""
    rows_by_arm: dict[tuple[str, str], Table] = {}
    for row in table:
        if row["task"] == task:
            rows_by_arm.setdefault((row["settings"], row["motor"]), []).append(row)
    return rows_by_arm
