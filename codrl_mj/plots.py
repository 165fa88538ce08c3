"""Plots as data: curves over a common axis; and their drawing with matplotlib, as PNG files.

`viz.pages` draws the same plots on its pages.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np

from codrl_mj.boundary import Axes
from codrl_mj.runs.files import atomic_write

MAX_POINTS = 6000
"""Maximum number of points of a line: even a zoomed screen has fewer pixels."""
_MAX_MARKED_POINTS = 25
"""Maximum number of points of a curve that are marked individually."""
_PALETTE = ("#2b7de0", "#d2691e", "#2e9e62", "#a24fc0", "#d1456b", "#6d78d8")
"""Colors of the curves, legible on white and on black; page.css has the colors of the page."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    label: str
    """Name in the legend."""
    x: np.ndarray
    """Shape (n,), increasing unless the style is `trail`."""
    y: np.ndarray
    """Shape (n,); values that are not finite are gaps."""
    reference: bool = False
    """True if the curve is a reference (an oracle, an expected slope, a bound), False if it is a
    result.
    """
    style: Literal["line", "step", "dots", "trail"] = "line"
    """A `step` holds each value until the next point; a `trail` consists of dots in any order."""
    colour: int | None = None
    """Index of one of six colors; None: the next one."""
    shared: int | None = None
    """Index of the color that is used while curves with other tags are shown too."""
    dashed: bool = False
    """True for a dashed line."""
    filled: bool = False
    """True to fill the area to the previous curve, which has the same x."""
    tags: tuple[str, ...] = ()
    """Owners of the curve, such as a run and a motor. The curve is hidden if one of them is."""
    times: np.ndarray | None = None
    """Times of a trail's points on the page's clock [s], shape (n,). The point at the
    current time is marked.
    """


class CurveOwner(TypedDict, total=False):
    """Fields of a `Curve` that all curves of a run or a motor have in common."""

    shared: int | None
    tags: tuple[str, ...]


class CurveStyle(CurveOwner, total=False):
    """Fields of a `Curve` that several curves have in common."""

    colour: int | None
    dashed: bool


@dataclasses.dataclass(frozen=True)
class Shade:
    """Shaded intervals of the horizontal axis."""

    label: str
    spans: np.ndarray
    """Starts and ends, shape (n, 2)."""
    tags: tuple[str, ...] = ()
    """Owners, as for a curve."""


@dataclasses.dataclass(frozen=True)
class Plot:
    """Curves over a common axis."""

    title: str
    """Title."""
    x_label: str
    """Label of the horizontal axis, with its unit."""
    y_label: str
    """Label of the vertical axis, with its unit."""
    curves: tuple[Curve, ...]
    """Lines of the plot."""
    x_log: bool = False
    """True if the horizontal axis is logarithmic."""
    y_log: bool = False
    """True if the vertical axis is logarithmic."""
    y_limit: float | None = None
    """Largest absolute value that the vertical axis shows."""
    clock: bool = False
    """True if the horizontal axis is the page's clock, which films share."""
    shades: tuple[Shade, ...] = ()
    """Shaded intervals behind the curves."""
    corners: tuple[str, ...] = ()
    """Labels of the corners: top left, bottom left, top right, bottom right."""
    second_axis: tuple[str, float] | None = None
    """Second vertical axis, at the right: its label with unit, and the factor from values of the
    first axis.
    """


def flagged_intervals(times: np.ndarray, flags: np.ndarray) -> np.ndarray:
    """Return the intervals in which a flag is set, as starts and ends, shape (m, 2).

    Args:
        times: edges of all n intervals, shape (n+1,).
        flags: one flag for each interval, shape (n,).
    """
    edges = np.diff(np.concatenate([[0], np.asarray(flags, dtype=int) != 0, [0]]).astype(int))
    return np.column_stack([times[np.flatnonzero(edges == 1)], times[np.flatnonzero(edges == -1)]])


def decimate(
    x: np.ndarray, y: np.ndarray, points: int = MAX_POINTS
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve to about `points` points, with the extremes of each segment.

    All peaks are kept.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(x) <= points:
        return x, y
    indices: set[int] = {0, len(x) - 1}
    for segment in np.array_split(np.arange(len(x)), points // 2):
        # `argmin` and `argmax` would select NaN; zeros take their place.
        finite_values = np.where(np.isfinite(y[segment]), y[segment], 0.0)
        indices |= {int(segment[np.argmin(finite_values)]), int(segment[np.argmax(finite_values)])}
    chosen = np.array(sorted(indices))
    return x[chosen], y[chosen]


def finite_or_nan(values: np.ndarray, log: bool) -> np.ndarray:
    """Return the values, with NaN, which is drawn as a gap, in place of undrawable ones."""
    values = np.asarray(values, dtype=float)
    is_drawable = np.isfinite(values) & (np.abs(values) < 3e38) & (values > 1e-37 if log else True)
    return np.where(is_drawable, values, np.nan)


def ceiling(plot: Plot) -> float | None:
    """Return the top of a logarithmic axis with references: 1e6 times the largest result.

    Reference curves may leave the picture, results may not.
    """
    results = [finite_or_nan(curve.y, True) for curve in plot.curves if not curve.reference]
    if (
        not plot.y_log
        or len(results) == len(plot.curves)
        or not any(np.isfinite(values).any() for values in results)
    ):
        return None
    return 1e6 * max(float(np.nanmax(values)) for values in results if np.isfinite(values).any())


def save_png(
    plots: Plot | Sequence[Plot], path: Path, size: tuple[float, float] | None = None
) -> None:
    """Write a plot, or several in two rows, column by column, as a PNG file on white.

    The file is replaced only when it is complete.

    Args:
        plots: plots to draw, the first twelve curves of each.
        path: the file.
        size: width and height of the picture [in]; None: as needed.
    """
    from matplotlib.figure import Figure

    plot_list = [plots] if isinstance(plots, Plot) else plots
    rows = min(2, len(plot_list))
    columns = math.ceil(len(plot_list) / rows)
    figure = Figure(
        figsize=size or (8.0 if columns == 1 else 4.8 * columns, 2.0 + 3.2 * rows),
        layout="constrained",
    )
    panels = figure.subplots(rows, columns, squeeze=False)
    for plot, axes in zip(plot_list, panels.T.flat, strict=True):
        draw(plot, axes, "#22313f", MAX_POINTS)
        axes.set_title(plot.title.replace("$", r"\$"), fontsize="medium", color="#22313f")
        legend_columns = min(len(plot.curves), 3 if columns == 1 else 2)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.15),
            ncols=legend_columns,
            fontsize="small",
            frameon=False,
        )
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)


def draw(plot: Plot, axes: Axes, ink: str, points: int) -> None:
    """Draw the first twelve curves of a plot on matplotlib's axes.

    Args:
        plot: the plot.
        axes: matplotlib's axes.
        ink: color of text and references.
        points: maximum number of points of a curve.
    """
    for index, curve in enumerate(plot.curves[:12]):
        # matplotlib would typeset text between two dollar signs as a formula.
        label = curve.label.replace("$", r"\$")
        color = (
            ink
            if curve.reference
            else _PALETTE[(index if curve.colour is None else curve.colour) % 6]
        )
        x, y = decimate(curve.x, finite_or_nan(curve.y, plot.y_log), points)
        dots = curve.style in ("dots", "trail")
        has_few_points = len(curve.x) <= _MAX_MARKED_POINTS and not curve.reference
        axes.plot(
            x,
            y,
            linestyle="none" if dots else "--" if curve.dashed or curve.reference else "-",
            linewidth=1.3,
            color=color,
            marker="." if dots or has_few_points else "",
            markersize=9.0 if dots and has_few_points else 5.0 if has_few_points else 3.0,
            drawstyle="steps-post" if curve.style == "step" else "default",
            label=label if label not in axes.get_legend_handles_labels()[1] else None,
        )
        if curve.filled:
            # The previous curve has the same x, but decimation may select other points of it; then
            # the area is left out.
            lower_edge = decimate(
                curve.x, finite_or_nan(plot.curves[index - 1].y, plot.y_log), points
            )[1]
            (
                axes.fill_between(x, y, lower_edge, color=color, alpha=0.12, linewidth=0)
                if len(lower_edge) == len(y)
                else None
            )
    for shade in plot.shades[:1]:
        for begin, end in shade.spans[:60]:
            axes.axvspan(begin, end, color=_PALETTE[4], alpha=0.2, linewidth=0)
    if plot.x_log and any(np.any(np.asarray(curve.x) > 0) for curve in plot.curves):
        axes.set_xscale("log")
    if plot.y_log and any(np.isfinite(finite_or_nan(curve.y, True)).any() for curve in plot.curves):
        axes.set_yscale("log")
        # References may leave the picture above: limit the axis to the results.
        axes.set_ylim(top=min(axes.get_ylim()[1], ceiling(plot) or math.inf))
    if plot.y_limit is not None:
        axes.set_ylim(-plot.y_limit, plot.y_limit)
    axes.margins(x=0.0)
    axes.set_xlabel(plot.x_label, color=ink)
    axes.set_ylabel(plot.y_label, color=ink)
    axes.tick_params(colors=ink, which="both")
    axes.spines[:].set_color(ink)
    axes.grid(color=ink, alpha=0.25)
    for axis in "xy":
        if getattr(axes, f"get_{axis}scale")() == "linear":
            axes.locator_params(axis=axis, nbins=5)
    for position, text in zip(
        itertools.product((0.015, 0.985), (0.985, 0.015)), plot.corners, strict=False
    ):
        horizontal_alignment = ("left", "right")[position[0] > 0.5]
        vertical_alignment = ("bottom", "top")[position[1] > 0.5]
        axes.text(
            *position,
            text,
            transform=axes.transAxes,
            color=ink,
            alpha=0.8,
            ha=horizontal_alignment,
            va=vertical_alignment,
        )
    if plot.second_axis is not None:
        label, scale = plot.second_axis
        right = axes.secondary_yaxis(
            "right", functions=(lambda value: scale * value, lambda value: value / scale)
        )
        right.set_ylabel(label, color=ink)
        right.tick_params(colors=ink)
