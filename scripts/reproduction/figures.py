"""The paper's figures, redrawn from published tables: learning, torque, states; and what value iteration finds."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.study.axes import CENTER_RADIUS
from codrl_mj.study.pages import COLORS, add_legend, save_figure
from codrl_mj.tasks import (
    acrobot,
    cartpole,
    find_task,
    mountain_car,
    mountain_car_continuous,
    pendulum,
)
from codrl_mj.viz.films.strip import ACTUAL, DESIRED
from reproduction.drawn import ENTRIES, Table, arms_of, column
from reproduction.rows import LAST
from reproduction.value_iteration import Optimum

STYLES = {
    "ideal": (COLORS[0], "--"),
    "paper gains": (COLORS[2], "-"),
    "fast gains": (COLORS[1], "-."),
}
"""Of an arm, by its motor: colour and dashes."""
SETTINGS = {"paper": "as printed", "repaired": "repaired"}
"""What settings are called."""
LEARNED = {
    "returns": "mean return",
    "lengths": "mean length\n[steps]",
    "counts": "number of\nepisodes",
}
"""What learning curves are called."""
_ERROR = COLORS[3]
_WIDTH = 8.0  # in


@dataclasses.dataclass(frozen=True)
class StateCurve:
    """Something that is drawn over the time of an episode."""

    label: str
    """Name and unit."""
    values: Callable[[np.ndarray], np.ndarray]
    """Of the state's entries, shape (k, T+1)."""
    marks: tuple[float, ...] = ()
    """Values to mark: goals and limits."""


def _entry(label: str, index: int, *marks: float) -> StateCurve:
    return StateCurve(label, lambda state: state[index], marks)


def _entries(task: str, marks: Mapping[int, tuple[float, ...]]) -> list[StateCurve]:
    """Every entry of a task's state."""
    return [
        _entry(name, index, *marks.get(index, ()))
        for index, name in enumerate(find_task(task).state_names)
    ]


CURVES: dict[str, list[StateCurve]] = {
    "pendulum": [
        StateCurve("height x = cos θ [m]", lambda state: np.cos(state[0]), (1.0,)),
        StateCurve("y = sin θ [m]", lambda state: np.sin(state[0]), (0.0,)),
        StateCurve(
            "θ [rad], wrapped", lambda state: _unbroken(pendulum.upright_angle(state)), (0.0,)
        ),
        _entry("θ_dot [rad/s]", 1, 0.0),
    ],
    "mountain_car": _entries("mountain_car", {0: (mountain_car.GOAL,)}),
    "mountain_car_continuous": _entries(
        "mountain_car_continuous", {0: (mountain_car_continuous.GOAL,)}
    ),
    "acrobot": [
        StateCurve(
            "-cos θ1\n- cos(θ1 + θ2) [m]",
            lambda state: -np.cos(state[0]) - np.cos(state[0] + state[1]),
            (acrobot.GOAL_HEIGHT,),
        ),
        StateCurve("θ1 [rad], wrapped", lambda state: _unbroken(state[0])),
        StateCurve("θ2 [rad], wrapped", lambda state: _unbroken(state[1])),
        _entry("θ1_dot [rad/s]", 2),
        _entry("θ2_dot [rad/s]", 3),
    ],
    "cartpole": _entries(
        "cartpole",
        {0: (-CENTER_RADIUS, CENTER_RADIUS), 2: (-cartpole.ANGLE_LIMIT, cartpole.ANGLE_LIMIT)},
    ),
}
"""What is drawn of each task's states: the paper's curves, and every entry of the state."""


def _unbroken(angle: np.ndarray) -> np.ndarray:
    """A wrapped angle without the lines from one end to the other."""
    jumps = np.abs(np.diff(angle, prepend=angle[:1])) > np.pi
    return np.where(jumps, np.nan, angle)


def draw_learning(path: Path, task: str, curves: Table) -> bool:
    """Draw how a task is learned, all on one scale: means and 95 % bands over seeds, faint with settings as printed.

    Args:
        path: SVG file.
        task: task name.
        curves: rows of `drawn.CURVES`.

    Returns:
        Whether there is anything to draw.
    """
    arms = arms_of(curves, task)
    names = list(dict.fromkeys(row["curve"] for rows in arms.values() for row in rows))
    if not names:
        return False
    figure, all_axes = _panels(len(names), 1, row_height=1.3 if len(names) > 1 else 2.6)
    repaired = any(settings == "repaired" for settings, _ in arms)
    for axes, name in zip(all_axes[:, 0], names, strict=True):
        for (settings, motor), rows in arms.items():
            shown = [row for row in rows if row["curve"] == name]
            places, mean, low, high = (
                column(shown, part) for part in ("at", "mean", "low", "high")
            )
            colour, dashes = STYLES[motor]
            label = (
                f"{motor}{f', {SETTINGS[settings]}' if repaired else ''} ({shown[0]['seeds']}"
                " seeds)"
            )
            faint = repaired and settings == "paper"
            axes.plot(
                places,
                mean,
                color=colour,
                linestyle=dashes,
                linewidth=0.8 if faint else 1.6,
                label=label,
            )
            axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.set(ylabel=LEARNED[name], yscale="log" if name == "counts" else "linear")
        axes.yaxis.label.set_fontsize("small" if len(names) > 1 else "medium")
    all_axes[-1, 0].set_xlabel("training episode" if len(names) == 1 else "epoch of 4000 steps")
    if len(names) == 1:
        all_axes[0, 0].set_ylabel(f"return, mean of last {LAST}")
    add_legend(figure, 2 if repaired else 3)
    save_figure(figure, path)
    return True


def draw_torque(path: Path, task: str, torques: Table) -> bool:
    """Draw the beginning of an episode: desired and actual torque at the shaft, and their difference, on one scale.

    Args:
        path: SVG file.
        task: task name.
        torques: rows of `drawn.TORQUES`.

    Returns:
        Whether there is anything to draw.
    """
    arms = _learned(arms_of(torques, task))
    if not arms:
        return False
    figure, all_axes = _panels(len(arms), 1, row_height=2.0, sharey=True)
    for axes, (motor, rows) in zip(all_axes[:, 0], arms.items(), strict=True):
        times, desired, actual = (column(rows, name) for name in ("time", "desired", "actual"))
        edges = np.append(times, times[-1] + times[1])
        axes.stairs(actual, edges, color=ACTUAL, linewidth=1.8, label="actual", baseline=None)
        axes.stairs(
            desired,
            edges,
            color=DESIRED,
            linewidth=0.9,
            linestyle="--",
            label="desired",
            baseline=None,
        )
        axes.stairs(
            desired - actual, edges, color=_ERROR, label="error: desired - actual", baseline=None
        )
        axes.set(ylabel=f"torque [N·m],\n{motor}")
    all_axes[-1, 0].set_xlabel("time [s]")
    add_legend(figure, 3)
    save_figure(figure, path)
    return True


def draw_states(path: Path, task: str, states: Table) -> bool:
    """Draw what there is to see of the states over an episode, a row for each curve, a line for each motor.

    Args:
        path: SVG file.
        task: task name.
        states: rows of `drawn.STATES`.

    Returns:
        Whether there is anything to draw.
    """
    arms, curves = _learned(arms_of(states, task)), CURVES[task]
    if not arms:
        return False
    figure, all_axes = _panels(len(curves), 1, row_height=1.35)
    entries = ENTRIES[: len(find_task(task).state_names)]
    for axes, curve in zip(all_axes[:, 0], curves, strict=True):
        for mark in curve.marks:
            axes.axhline(mark, color="0.6", linewidth=0.8)
        for motor, rows in arms.items():
            colour, dashes = STYLES[motor]
            state = np.array([column(rows, entry) for entry in entries])
            axes.plot(
                column(rows, "time"),
                curve.values(state),
                color=colour,
                linestyle=dashes,
                label=motor,
            )
        axes.set_ylabel(curve.label.replace("_dot", "'"), fontsize="small")
    all_axes[-1, 0].set_xlabel("time [s]")
    add_legend(figure, 3)
    save_figure(figure, path)
    return True


def _learned(arms: Mapping[tuple[str, str], Table]) -> dict[str, Table]:
    """An episode's rows by motor: with repaired settings where there are any, for others learn nothing there."""
    shown = "repaired" if any(settings == "repaired" for settings, _ in arms) else "paper"
    return {motor: rows for (settings, motor), rows in arms.items() if settings == shown}


def draw_discounts(path: Path, values: Mapping[float, float], optima: Sequence[Optimum]) -> None:
    """Draw what the continuous mountain car's start is worth over discount factors, and how the best policies drive.

    Args:
        path: SVG file.
        values: discount factor -> value.
        optima: the best policies at some discount factors.
    """
    figure, ((worth, drive),) = _panels(1, 2)
    discounts = np.array(list(values))
    worth.plot(1 - discounts, list(values.values()), color=COLORS[0], marker=".")
    worth.set_xscale("log")
    worth.invert_xaxis()
    marked = [one.discount for one in optima]
    worth.set_xticks(
        [1 - discount for discount in marked], [f"{discount:g}" for discount in marked], rotation=45
    )
    worth.set_xticks([], minor=True)
    worth.axvline(1 - marked[0], color=COLORS[2], linestyle="--", linewidth=1)
    worth.annotate(
        "the paper's",
        (1 - marked[0], 0.5 * max(values.values())),
        rotation=90,
        ha="right",
        va="center",
    )
    worth.set(xlabel="discount factor", ylabel="value of the start")
    dashes = ("-", ":", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
    for index, one in enumerate(optima):
        times = np.concatenate([[0.0], one.episode.time])
        style = dashes[index % len(dashes)]
        drive.plot(
            times,
            one.episode.state[:, 0],
            color=COLORS[index],
            linestyle=style,
            label=f"{one.discount:g}",
        )
    drive.axhline(mountain_car_continuous.GOAL, color="0.6", linewidth=0.8)
    drive.set(
        xlabel="time [s]", ylabel="x [m]", xlim=(0, 120), title="best policy at discount factor"
    )
    add_legend(figure, 5)
    save_figure(figure, path)


def _panels(rows: int, columns: int, row_height: float = 2.6, sharey: bool = False) -> Any:
    """A figure and its axes, shape (rows, columns); rows share their time or episode axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, 0.6 + rows * row_height), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False, sharex="col", sharey=sharey)
    for each in axes.flat:
        each.grid(color="0.9")
        each.set_axisbelow(True)
        each.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels()
    return figure, axes
