"""What figures are drawn of: tables of curves and episodes, published, so that a figure needs no run folder."""

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
"""The tables: learning curves; the states of a test episode; desired and actual torque at its beginning."""
POINTS = 125  # of a learning curve, at most
SHORT, FEW = (
    1.0,
    20,
)  # s; policy steps: of an episode's torque as much is shown as the longer of both

ENTRIES = ("state_1", "state_2", "state_3", "state_4")
"""Columns of a state's entries, in the order of the task's `state_names`."""
Table = list[Mapping[str, str]]
"""Rows by the columns' names, as text."""


def about(arm: PaperArm) -> dict[str, str]:
    """What a row of a table is of; all of them are of MuJoCo."""
    return {"task": arm.task, "settings": arm.settings, "motor": arm.motor}


def curve_rows(arm: PaperArm, runs: Mapping[int, Trained]) -> Table:
    """Learning curves of an arm's runs, at least one: means over seeds and their 95 % bands.

    Of returns the running mean over episodes; of PPO, whose rollouts are the paper's epochs, mean
    return, mean length and number of episodes over epochs.
    """
    if arm.config.agent.name == "ppo":
        every = [epochs_of(arm, run) for run in runs.values()]
        curves = {
            name: np.array([_filled(getattr(one, name).astype(float)) for one in every])
            for name in ("lengths", "returns", "counts")
        }
    else:
        returns = [run.column("return") for run in runs.values()]
        shortest = min(map(len, returns))
        curves = {"returns": running_mean(np.array([of_run[:shortest] for of_run in returns]))}
    rows: Table = []
    for name, values in curves.items():
        step = max(1, math.ceil(values.shape[1] / POINTS))
        kept = np.arange(step - 1, values.shape[1], step)
        for place, *point in zip(kept + 1, *band(values[:, kept]), strict=True):
            numbers = dict(zip(("mean", "low", "high"), map(_short, point), strict=True))
            rows.append(
                about(arm) | {"curve": name, "seeds": str(len(runs)), "at": str(place)} | numbers
            )
    return rows


def state_rows(arm: PaperArm, episode: Episode) -> Table:
    """The states of an episode, from before its first step on."""
    times = np.concatenate([[0.0], episode.time])
    return [
        about(arm)
        | {"time": _short(time)}
        | dict.fromkeys(ENTRIES, "")
        | dict(zip(ENTRIES, map(_short, state), strict=False))
        for time, state in zip(times, episode.state, strict=True)
    ]


def torque_rows(arm: PaperArm, episode: Episode) -> Table:
    """Desired and actual torque at the shaft in the integration steps at the beginning of an episode [N·m]."""
    radius, inner = arm.actuator.motor.arm_radius, episode.inner_steps
    desired = radius * np.repeat(episode.signals["desired_force"], inner)
    actual = radius * episode.trace["actual_force"]
    shown = max(FEW * inner, round(SHORT / episode.timestep))
    pairs = zip(desired[:shown], actual[:shown], strict=True)
    return [
        about(arm)
        | {
            "time": _short(n * episode.timestep),
            "desired": _short(one),
            "actual": _short(other),
        }
        for n, (one, other) in enumerate(pairs)
    ]


def gather_tables(
    arms: Iterable[PaperArm], runs: Mapping[str, Mapping[int, Trained]], published: Path
) -> dict[str, Table]:
    """The tables, of arms' runs by name: of what is at hand anew, but as published if that is of more seeds."""
    before = {name: read_csv(published / name) for name in (CURVES, STATES, TORQUES)}
    tables: dict[str, Table] = {CURVES: [], STATES: [], TORQUES: []}
    for arm in arms:
        if arm.physics != "mujoco":
            continue
        mine = runs.get(arm.name, {})
        old = {
            name: [row for row in rows if _of(row) == about(arm)] for name, rows in before.items()
        }
        seeds = max((int(row["seeds"]) for row in old[CURVES]), default=0)
        tables[CURVES] += curve_rows(arm, mine) if mine and len(mine) >= seeds else old[CURVES]
        if mine and (0 in mine or not old[STATES]):
            (episode,) = run_tests(arm, next(iter(mine.values())).folder, 1)
            tables[STATES] += state_rows(arm, episode)
            tables[TORQUES] += [] if arm.actuator == IDEAL else torque_rows(arm, episode)
        else:
            tables[STATES] += old[STATES]
            tables[TORQUES] += old[TORQUES]
    return tables


def _of(row: Mapping[str, str]) -> dict[str, str]:
    return {name: row[name] for name in ("task", "settings", "motor")}


def column(rows: Iterable[Mapping[str, str]], name: str) -> np.ndarray:
    """A column of a table as numbers, shape (n,)."""
    return np.array([float(row[name]) for row in rows])


def running_mean(values: np.ndarray, count: int = LAST) -> np.ndarray:
    """Mean of each value and those before it, at most `count` in all.

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

    options: dict[str, Any] = {"n_resamples": 999, "batch": 50, "method": "percentile", "rng": 0}
    interval = bootstrap((values,), np.mean, axis=0, **options).confidence_interval
    return mean, interval.low, interval.high


def _filled(values: np.ndarray) -> np.ndarray:
    """NaN replaced by the value before it; 0 where there is none."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last >= 0, values[last], 0.0)


def _short(value: float) -> str:
    return f"{float(value):.5g}"


def arms_of(table: Sequence[Mapping[str, str]], task: str) -> dict[tuple[str, str], Table]:
    """A task's rows by settings and motor."""
    found: dict[tuple[str, str], Table] = {}
    for row in table:
        if row["task"] == task:
            found.setdefault((row["settings"], row["motor"]), []).append(row)
    return found
