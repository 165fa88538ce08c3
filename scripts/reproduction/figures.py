"""The paper's figures, redrawn from run folders: learning, torque, states; and what value iteration finds."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.films.strip import ACTUAL, DESIRED
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.doses import CENTRE_RADIUS
from codrl_mj.study.pages import COLOURS, legend, save
from codrl_mj.tasks import acrobot, cartpole, find_task, mountain_car, mountain_car_continuous, pendulum
from codrl_mj.training import EVALUATION_SEED
from reproduction.arms import TEST, PaperArm
from reproduction.series import LAST, Series
from reproduction.value_iteration import Optimum

STYLES = {"ideal": (COLOURS[0], "--"), "paper gains": (COLOURS[2], "-"), "fast gains": (COLOURS[1], "-.")}
"""Of an arm, by its motor: colour and dashes."""
PHYSICS = {"mujoco": "MuJoCo", "analytic": "Gymnasium's equations"}
_ERROR = COLOURS[3]
_MANY = 4000  # points of a line; more are drawn as an image within the SVG
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
    return [_entry(name, index, *marks.get(index, ())) for index, name in enumerate(find_task(task).state_names)]


CURVES: dict[str, list[StateCurve]] = {
    "pendulum": [
        StateCurve("height x = cos θ [m]", lambda state: np.cos(state[0]), (1.0,)),
        StateCurve("y = sin θ [m]", lambda state: np.sin(state[0]), (0.0,)),
        StateCurve("θ [rad], wrapped", lambda state: _unbroken(pendulum.upright_angle(state)), (0.0,)),
        _entry("θ_dot [rad/s]", 1, 0.0),
    ],
    "mountain_car": _entries("mountain_car", {0: (mountain_car.GOAL,)}),
    "mountain_car_continuous": _entries("mountain_car_continuous", {0: (mountain_car_continuous.GOAL,)}),
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
        "cartpole", {0: (-CENTRE_RADIUS, CENTRE_RADIUS), 2: (-cartpole.ANGLE_LIMIT, cartpole.ANGLE_LIMIT)}
    ),
}
"""What is drawn of each task's states: the paper's curves, and every entry of the state."""


def _unbroken(angle: np.ndarray) -> np.ndarray:
    """A wrapped angle without the lines from one end to the other."""
    jumps = np.abs(np.diff(angle, prepend=angle[:1])) > np.pi
    return np.where(jumps, np.nan, angle)


def example(series: Series) -> Episode:
    """The first test episode of the first seed that is finished, of which there must be one."""
    run = next(iter(series.runs.values()))
    (episode,) = run_episodes(load_policy(run.folder), series.arm.trials[TEST].env.make, 1, EVALUATION_SEED)
    return episode


def draw_learning(path: Path, arms: Sequence[Series]) -> None:
    """Draw trainings, a column for each settings and physics: means and 95 % bands over seeds.

    It is the running mean of returns over episodes; of PPO, whose rollouts are the paper's epochs, mean return, mean
    length and number of episodes over epochs.

    Args:
        path: SVG file.
        arms: of one task, at least one, each with a run.
    """

    def over_epochs(what: str) -> Callable[[Series], np.ndarray]:
        return lambda series: np.array([_filled(getattr(one, what).astype(float)) for one in series.epochs()])

    rows = {f"return, mean of last {LAST}": lambda series: running_mean(series.returns_by_episode())}
    along, title, size = "training episode", "{} settings, {}", "medium"
    if arms[0].arm.config.agent.name == "ppo":
        labels = {"mean return": "returns", "mean length [steps]": "lengths", "number of episodes": "counts"}
        rows = {label: over_epochs(what) for label, what in labels.items()}
        along, title, size = "epoch of 4000 steps", "{1}", "large"
    columns: dict[tuple[str, str], list[Series]] = {}
    for series in arms:
        columns.setdefault((series.arm.settings, PHYSICS[series.arm.physics]), []).append(series)
    figure, all_axes = _panels(len(rows), len(columns))
    for (about, members), column in zip(columns.items(), all_axes.T, strict=True):
        for axes, (label, values_of) in zip(column, rows.items(), strict=True):
            for series in members:
                values = values_of(series)
                colour, dashes = STYLES[series.arm.motor]
                places, (mean, low, high) = np.arange(1, values.shape[1] + 1), band(values)
                name = f"{_name(series.arm)} ({len(values)} seeds)"
                axes.plot(places, mean, color=colour, linestyle=dashes, linewidth=1.4, label=name)
                axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.set(ylabel=label, yscale="log" if label == "number of episodes" else "linear")
        column[0].set_title(title.format(*about), fontsize=size)
        column[-1].set_xlabel(along)
    legend(figure, 2)
    save(figure, path)


def draw_torque(path: Path, episodes: Sequence[tuple[PaperArm, Episode]]) -> None:
    """Draw desired and actual torque at the shaft, and their difference, over an episode: a column for each arm.

    Args:
        path: SVG file.
        episodes: arms with a motor, and an episode of each.
    """
    figure, all_axes = _panels(2, len(episodes), heights=(2, 1))
    for (above, below), (arm, episode) in zip(all_axes.T, episodes, strict=True):
        radius = arm.actuator.motor.arm_radius
        edges = np.arange(len(episode.trace["speed"]) + 1) * episode.timestep
        desired = radius * np.repeat(episode.signals["desired_force"], episode.inner_steps)
        actual = radius * episode.trace["actual_force"]
        options: dict[str, Any] = {"baseline": None, "rasterized": len(edges) > _MANY}
        above.stairs(actual, edges, color=ACTUAL, linewidth=1.8, label="actual", **options)
        above.stairs(desired, edges, color=DESIRED, linewidth=0.9, linestyle="--", label="desired", **options)
        below.stairs(desired - actual, edges, color=_ERROR, label="error: desired - actual", **options)
        above.set(ylabel="torque [N·m]", title=arm.gains)
        below.set(ylabel="error [N·m]", xlabel="time [s]")
    legend(figure, 2)
    save(figure, path)


def draw_states(path: Path, task: str, episodes: Sequence[tuple[PaperArm, Episode]]) -> None:
    """Draw what there is to see of the states over an episode, a row for each curve, a line for each arm.

    Args:
        path: SVG file.
        task: the task's name.
        episodes: arms, and an episode of each.
    """
    curves = CURVES[task]
    figure, all_axes = _panels(len(curves), 1, row_height=1.35)
    for axes, curve in zip(all_axes[:, 0], curves, strict=True):
        for mark in curve.marks:
            axes.axhline(mark, color="0.6", linewidth=0.8)
        for arm, episode in episodes:
            times = np.concatenate([[0.0], episode.time])
            colour, dashes = STYLES[arm.motor]
            axes.plot(times, curve.values(episode.state.T), color=colour, linestyle=dashes, label=_name(arm))
        axes.set_ylabel(curve.label.replace("_dot", "'"), fontsize="small")
    all_axes[-1, 0].set_xlabel("time [s]")
    legend(figure, 2)
    save(figure, path)


def draw_discounts(path: Path, values: Mapping[float, float], optima: Sequence[Optimum]) -> None:
    """Draw what the continuous mountain car's start is worth over discount factors, and how the best policies drive.

    Args:
        path: SVG file.
        values: discount factor -> value.
        optima: the best policies at some discount factors.
    """
    figure, ((worth, drive),) = _panels(1, 2)
    discounts = np.array(list(values))
    worth.plot(1 - discounts, list(values.values()), color=COLOURS[0], marker=".")
    worth.set_xscale("log")
    worth.invert_xaxis()
    marked = [one.discount for one in optima]
    worth.set_xticks([1 - discount for discount in marked], [f"{discount:g}" for discount in marked], rotation=45)
    worth.set_xticks([], minor=True)
    worth.axvline(1 - marked[0], color=COLOURS[2], linestyle="--", linewidth=1)
    worth.annotate("the paper's", (1 - marked[0], 0.5 * max(values.values())), rotation=90, ha="right", va="center")
    worth.set(xlabel="discount factor", ylabel="value of the start")
    dashes = ("-", ":", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
    for index, one in enumerate(optima):
        times = np.concatenate([[0.0], one.episode.time])
        style = dashes[index % len(dashes)]
        drive.plot(times, one.episode.state[:, 0], color=COLOURS[index], linestyle=style, label=f"{one.discount:g}")
    drive.axhline(mountain_car_continuous.GOAL, color="0.6", linewidth=0.8)
    drive.set(xlabel="time [s]", ylabel="x [m]", xlim=(0, 120), title="best policy at discount factor")
    drive.legend(fontsize="small", ncols=3)
    save(figure, path)


def _panels(rows: int, columns: int, row_height: float = 0.0, heights: Sequence[float] | None = None) -> Any:
    """A figure and its axes, shape (rows, columns); rows share their time or episode axis."""
    from matplotlib.figure import Figure

    height = rows * row_height if row_height else 1.6 + 1.6 * rows
    figure = Figure(figsize=(_WIDTH if columns < 3 else 2.7 * columns, 0.6 + height), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False, sharex="col", height_ratios=heights)
    for each in axes.flat:
        each.grid(color="0.9")
        each.set_axisbelow(True)
        each.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels()
    return figure, axes


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


def _name(arm: PaperArm) -> str:
    return "ideal" if arm.actuator == IDEAL else arm.gains
