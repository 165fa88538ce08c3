"""Plots below a film's scene: desired and actual torque and one more signal, over time."""

import dataclasses

import numpy as np

from codrl_mj.actuators import ActuatorModel, Ideal
from codrl_mj.boundary import Artist, Axes, Figure
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.tasks import TASKS

_DPI = 100
# Heights [px], from top to bottom.
HEADER_HEIGHT = 24
TORQUE_HEIGHT = 120
GAP = 8
VOLTAGE_HEIGHT = 60
TIME_HEIGHT = 26
PLOT_HEIGHT = TORQUE_HEIGHT + GAP + VOLTAGE_HEIGHT
# Widths [px] left and right of the plots. The margin has room for half of the last tick label.
AXIS_WIDTH = 62
MARGIN = 16
# Colors that color-blind people can distinguish (Okabe and Ito).
DESIRED, ACTUAL, VOLTAGE, SATURATED = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)
_LIMIT_COLORS = {
    "voltage_saturated": SATURATED,
    "current_saturated": "#E69F00",
    "temperature_saturated": "#56B4E9",
}
"""Signals of families with several limits -> their colors."""


def draw_text(text: str, width: int, height: int, color: str = "#22313F") -> np.ndarray:
    """Return an image of one line of bold, centered text: (height, width, 3), uint8."""
    figure = _figure(width, height)
    figure.text(
        0.5,
        0.5,
        text.replace("$", r"\$"),
        ha="center",
        va="center",
        fontsize=12,
        color=color,
        weight="bold",
    )
    return _pixels(figure)


def draw_strip(
    task: str, episode: Episode, motor: int, width: int, window: float, end: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Draw the signals of a motor once, so that the plots of each frame can be cut from the image.

    Args:
        task: task name.
        episode: the episode.
        motor: index of the motor.
        width: width of a frame [px].
        window: time that a frame shows [s].
        end: end of the time axis [s].

    Returns:
        The scale of the time axis [px/s]; the frame of the plots (legend and vertical axes); and
            the whole content below the legend, `MARGIN` px wider than the time that it shows.
    """
    body, scale = PLOT_HEIGHT + TIME_HEIGHT, (width - AXIS_WIDTH - MARGIN) / window
    frame = _figure(width, HEADER_HEIGHT + body)
    length = round(scale * end)
    content = _figure(length + MARGIN, body)
    actuator = episode.actuator
    if isinstance(actuator, tuple):
        actuator = actuator[motor]
        motor_signals = {name: values[:, motor] for name, values in episode.signals.items()}
        episode = dataclasses.replace(episode, signals=motor_signals, actuator=actuator)
    lines = []
    for bottom, height, plot, label in (
        (
            TIME_HEIGHT + VOLTAGE_HEIGHT + GAP,
            TORQUE_HEIGHT,
            _plot_torque,
            torque_label(task, actuator, motor),
        ),
        (TIME_HEIGHT, VOLTAGE_HEIGHT, _plot_signal, _second_signal(actuator)[1]),
    ):
        total = HEADER_HEIGHT + body
        # The visible axis is a strip without width in the frame; the curves are drawn on an axis
        # without labels in the wide image.
        axis = frame.add_axes((AXIS_WIDTH / width, bottom / total, 1e-6, height / total))
        axes = content.add_axes((0, bottom / body, length / (length + MARGIN), height / body))
        lines += plot(episode, actuator, axes)
        _share_axis(axis, axes, label, end, window)
    content.axes[0].set_xticks([])
    narrow_legend = (
        {"columnspacing": 1.0, "handlelength": 1.4, "handletextpad": 0.4} if len(lines) > 4 else {}
    )
    frame.legend(
        handles=lines,
        loc="upper right",
        ncols=len(lines),
        fontsize=8,
        frameon=False,
        borderaxespad=0.2,
        **narrow_legend,
    )
    return scale, _pixels(frame), _pixels(content)


def _figure(width: int, height: int) -> Figure:
    from matplotlib import figure as figures
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = figures.Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def _share_axis(axis: Axes, axes: Axes, label: str, end: float, window: float) -> None:
    """Move the vertical axis of `axes` to `axis`, and set about six time ticks per window."""
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    for target in (axis, axes):
        target.set_ylim(axes.get_ylim())
        target.tick_params(labelsize=8)
        target.spines[["top", "right"]].set_visible(False)
    axis.set_ylabel(label, fontsize=9)
    axis.set_xticks([])
    axes.set(yticks=[], xlim=(0, end))
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(
        MultipleLocator(float(np.diff(MaxNLocator(6).tick_values(0, window))[0]))
    )
    # The edge of the image would cut a label at 0, so it is left out.
    axes.xaxis.set_major_formatter(lambda time, _: f"{time:g} s" if time else "")


def _plot_torque(episode: Episode, actuator: ActuatorModel, axes: Axes) -> list[Artist]:
    """Plot desired and actual torque (force, if there is no motor), and shade reached limits."""
    arm, edges = actuator.arm_radius, np.append(0.0, episode.time)
    desired, actual = episode.signals["desired_force"] * arm, episode.signals["actual_force"] * arm
    limit = 1.15 * max(np.abs(desired).max(), np.abs(actual).max(), 1e-9)
    axes.set_ylim(-limit, limit)
    axes.axhline(0, color="0.85", linewidth=0.8)
    lines = [
        axes.stairs(values, edges, baseline=None, color=color, linewidth=line_width, label=label)
        for values, color, label, line_width in (
            (desired, DESIRED, "desired", 1.0),
            (actual, ACTUAL, "actual", 2.0),
        )
        if label == "actual" or all(episode.is_torque_controlled)
    ]
    limits = [name for name in _LIMIT_COLORS if name in actuator.Signals._fields] or ["saturated"]
    for name in limits:
        is_limited = episode.signals[name] != 0.0
        if is_limited.any():
            options = {
                "baseline": -limit,
                "fill": True,
                "color": _LIMIT_COLORS.get(name, SATURATED),
                "alpha": 0.3,
            }
            band, label = np.where(is_limited, limit, -limit), name.replace("_saturated", " limit")
            lines.append(axes.stairs(band, edges, label=label, **options))
    return lines


def torque_label(task: str, actuator: ActuatorModel, motor: int) -> str:
    """Return the label of the first plot: torque at the shaft, or joint force without a motor."""
    if not isinstance(actuator, Ideal):
        return "shaft torque [N·m]"
    if task not in TASKS:
        return "joint force [N, N·m]"
    is_slide = "[m/s]" in TASKS[task].state_names[TASKS[task].speed_indices[motor]]
    return "joint force [N]" if is_slide else "joint torque [N·m]"


def _second_signal(actuator: ActuatorModel) -> tuple[str | None, str]:
    """Return the second plot's signal and label.

    The signal is the voltage, or the family's first signal with a unit, or None.
    """
    fields: tuple[str, ...] = actuator.Signals._fields
    if "voltage" in fields or isinstance(actuator, Ideal):
        return None if isinstance(actuator, Ideal) else "voltage", "u [V]"
    name = next((name for name in actuator.SIGNAL_UNITS if name in fields), None)
    return name, f"{name} [{actuator.SIGNAL_UNITS[name]}]" if name else ""


def _plot_signal(episode: Episode, actuator: ActuatorModel, axes: Axes) -> list[Artist]:
    """Plot the voltage with its limit if that is near, or the first signal of other families."""
    name, _ = _second_signal(actuator)
    if name is None:
        axes.set_ylim(-1, 1)
        subject = (
            "an ideal actuator has"
            if isinstance(actuator, Ideal)
            else f"{type(actuator).__name__} shows"
        )
        axes.text(0.02, 0, f"{subject} no voltage", va="center", fontsize=8, color="0.5")
        return []
    values, limit = episode.signals[name], actuator.voltage_limit if name == "voltage" else None
    span = 1.2 * max(np.abs(values).max(), 1e-9)
    axes.set_ylim(-span, span)
    axes.axhline(0, color="0.85", linewidth=0.8)
    if limit is not None and limit < span:
        for side in (-limit, limit):
            axes.axhline(side, color=SATURATED, linewidth=1.0, linestyle="--")
    label = name.replace("_", " ")
    return [
        axes.stairs(
            values,
            np.append(0.0, episode.time),
            baseline=None,
            color=VOLTAGE,
            linewidth=1.6,
            label=label,
        )
    ]
