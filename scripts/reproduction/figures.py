"""The paper's figures redrawn from published tables, and results of value iteration."""

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
"""Motor of an arm -> color and dashes."""
SETTINGS = {"paper": "as printed", "repaired": "repaired"}
"""Settings -> name in figures."""
LEARNED = {
    "returns": "mean return",
    "lengths": "mean length\n[steps]",
    "counts": "number of\nepisodes",
}
"""Learning curve -> label of its axis."""
_ERROR = COLORS[3]
# Width of all figures [in].
_WIDTH = 8.0


@dataclasses.dataclass(frozen=True)
class StateCurve:
    """Quantity that is drawn over the time of an episode."""

    label: str
    """Name and unit."""
    values: Callable[[np.ndarray], np.ndarray]
    """Function of the state's entries, shape (k, T+1)."""
    marks: tuple[float, ...] = ()
    """Values to mark: goals and limits."""


def _entry(label: str, index: int, *marks: float) -> StateCurve:
    return StateCurve(label, lambda state: state[index], marks)


def _entries(task: str, marks: Mapping[int, tuple[float, ...]]) -> list[StateCurve]:
    """Return the curves of all entries of a task's state."""
    return [
        _entry(name, index, *marks.get(index, ()))
        for index, name in enumerate(find_task(task).state_names)
    ]


CURVES: dict[str, list[StateCurve]] = {
    "pendulum": [
        StateCurve("height x = cos θ [m]", lambda state: np.cos(state[0]), (1.0,)),
        StateCurve("y = sin θ [m]", lambda state: np.sin(state[0]), (0.0,)),
        StateCurve(
            "θ [rad], wrapped",
            lambda state: _unbroken(np.asarray(pendulum.upright_angle(state))),
            (0.0,),
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
"""Task -> curves of its states: the paper's, and every entry of the state."""


def _unbroken(angle: np.ndarray) -> np.ndarray:
    """Return a wrapped angle with NaN at its jumps, where no line is drawn."""
    jumps = np.abs(np.diff(angle, prepend=angle[:1])) > np.pi
    return np.where(jumps, np.nan, angle)


def draw_learning(path: Path, task: str, curves: Table) -> bool:
    """Draw the learning curves of a task: means and 95 % bands over seeds.

    Settings as printed are faint if there are repaired ones.


    Args:
        path: SVG file.
        task: task name.
        curves: rows of `drawn.CURVES`.

    Returns:
            True if there is anything to draw.
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
            x, mean, low, high = (column(shown, part) for part in ("at", "mean", "low", "high"))
            color, dashes = STYLES[motor]
            label = (
                f"{motor}{f', {SETTINGS[settings]}' if repaired else ''} ({shown[0]['seeds']}"
                " seeds)"
            )
            faint = repaired and settings == "paper"
            axes.plot(
                x,
                mean,
                color=color,
                linestyle=dashes,
                linewidth=0.8 if faint else 1.6,
                label=label,
            )
            axes.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
        axes.set(ylabel=LEARNED[name], yscale="log" if name == "counts" else "linear")
        axes.yaxis.label.set_fontsize("small" if len(names) > 1 else "medium")
    all_axes[-1, 0].set_xlabel("training episode" if len(names) == 1 else "epoch of 4000 steps")
    if len(names) == 1:
        all_axes[0, 0].set_ylabel(f"return, mean of last {LAST}")
    add_legend(figure, 2 if repaired else 3)
    save_figure(figure, path)
    return True


def draw_torque(path: Path, task: str, torques: Table) -> bool:
    """Draw desired and actual shaft torque at an episode's beginning, and their difference.

    Args:
        path: SVG file.
        task: task name.
        torques: rows of `drawn.TORQUES`.

    Returns:
            True if there is anything to draw.
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
    """Draw the states over an episode, a row for each curve, a line for each motor.

    Args:
        path: SVG file.
        task: task name.
        states: rows of `drawn.STATES`.

    Returns:
            True if there is anything to draw.
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
            color, dashes = STYLES[motor]
            state = np.array([column(rows, entry) for entry in entries])
            axes.plot(
                column(rows, "time"),
                curve.values(state),
                color=color,
                linestyle=dashes,
                label=motor,
            )
        axes.set_ylabel(curve.label.replace("_dot", "'"), fontsize="small")
    all_axes[-1, 0].set_xlabel("time [s]")
    add_legend(figure, 3)
    save_figure(figure, path)
    return True


def _learned(arms: Mapping[tuple[str, str], Table]) -> dict[str, Table]:
    """Return an episode's rows by motor, with repaired settings if there are any.

    Where settings were repaired, policies with settings as printed learned nothing.
    """
    shown = "repaired" if any(settings == "repaired" for settings, _ in arms) else "paper"
    return {motor: rows for (settings, motor), rows in arms.items() if settings == shown}


def draw_discounts(path: Path, values: Mapping[float, float], optima: Sequence[Optimum]) -> None:
    """Draw the continuous mountain car's value by discount factor, and the best policies' paths.

    Args:
        path: SVG file.
        values: discount factor -> value.
        optima: best policies at some discount factors.
    """
    figure, ((value_axes, path_axes),) = _panels(1, 2)
    discounts = np.array(list(values))
    value_axes.plot(1 - discounts, list(values.values()), color=COLORS[0], marker=".")
    value_axes.set_xscale("log")
    value_axes.invert_xaxis()
    marked_discounts = [best.discount for best in optima]
    value_axes.set_xticks(
        [1 - discount for discount in marked_discounts],
        [f"{discount:g}" for discount in marked_discounts],
        rotation=45,
    )
    value_axes.set_xticks([], minor=True)
    value_axes.axvline(1 - marked_discounts[0], color=COLORS[2], linestyle="--", linewidth=1)
    value_axes.annotate(
        "the paper's",
        (1 - marked_discounts[0], 0.5 * max(values.values())),
        rotation=90,
        ha="right",
        va="center",
    )
    value_axes.set(xlabel="discount factor", ylabel="value of the start")
    dashes = ("-", ":", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
    for index, best in enumerate(optima):
        times = np.concatenate([[0.0], best.episode.time])
        style = dashes[index % len(dashes)]
        path_axes.plot(
            times,
            best.episode.state[:, 0],
            color=COLORS[index],
            linestyle=style,
            label=f"{best.discount:g}",
        )
    path_axes.axhline(mountain_car_continuous.GOAL, color="0.6", linewidth=0.8)
    path_axes.set(
        xlabel="time [s]", ylabel="x [m]", xlim=(0, 120), title="best policy at discount factor"
    )
    add_legend(figure, 5)
    save_figure(figure, path)


def _panels(rows: int, columns: int, row_height: float = 2.6, sharey: bool = False) -> Any:
    """Return a figure and its axes, shape (rows, columns); axes of a column share the x axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, 0.6 + rows * row_height), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False, sharex="col", sharey=sharey)
    for panel in axes.flat:
        panel.grid(color="0.9")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels()
    return figure, axes
