"""Plots as data: a page draws them with uPlot, a still picture stands in where no script may run, a file is a PNG."""

import base64
import dataclasses
import io
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from codrl_mj.runs.files import atomic_write

POINTS = 6000
"""Most points of a line: more than there are pixels on a zoomed screen show nothing."""
_STILL = 240
"""Points of a line in a still picture."""
_FEW = 25
"""Up to so many points of a curve are marked each."""
_PALETTE = ("#2b7de0", "#d2691e", "#2e9e62", "#a24fc0", "#d1456b", "#6d78d8")
"""Of the still picture, legible on white and on black; the page's own colours are in page.css."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """One line of a plot."""

    label: str
    """Its name in the legend."""
    x: np.ndarray
    """Shape (n,); increasing, but of a trail."""
    y: np.ndarray
    """Shape (n,); what is not finite is a gap."""
    reference: bool = False
    """Whether it is drawn as a reference (the oracle, a promised slope, a bound) rather than as a result."""
    style: Literal["line", "step", "dots", "trail"] = "line"
    """A step holds its value until the next point; a trail is dots in any order."""
    colour: int | None = None
    """Which of six colours; None: the next."""
    shared: int | None = None
    """Its colour while curves with other tags are shown beside it."""
    dashed: bool = False
    """Whether the line is dashed."""
    filled: bool = False
    """Whether the area up to the curve before, which has the same x, is filled."""
    tags: tuple[str, ...] = ()
    """What it belongs to, such as a run and a motor: it is hidden with any of these."""
    times: np.ndarray | None = None
    """Of a trail, the times of its points on the page's clock [s], shape (n,): the present one is marked."""


@dataclasses.dataclass(frozen=True)
class Shade:
    """Stretches of the horizontal axis that are shaded."""

    label: str
    spans: np.ndarray
    """Beginnings and ends, shape (n, 2)."""
    tags: tuple[str, ...] = ()
    """As a curve's."""


@dataclasses.dataclass(frozen=True)
class Plot:
    """Curves over a common axis."""

    title: str
    """What is shown."""
    x_label: str
    """With its unit."""
    y_label: str
    """With its unit."""
    curves: tuple[Curve, ...]
    """The lines."""
    x_log: bool = False
    """Whether the horizontal axis is logarithmic."""
    y_log: bool = False
    """Whether the vertical axis is logarithmic."""
    y_most: float | None = None
    """Where the vertical axis ends at most, to either side."""
    clock: bool = False
    """Whether the horizontal axis is the page's clock, which films share."""
    shades: tuple[Shade, ...] = ()
    """What is shaded behind them."""
    corners: tuple[str, ...] = ()
    """What the corners are: above and below at the left, above and below at the right."""
    scaled: tuple[str, float] | None = None
    """Of a second vertical axis, at the right: its label with its unit, and its values over those of the first."""


def spans(times: np.ndarray, flags: np.ndarray) -> np.ndarray:
    """Beginnings and ends, shape (m, 2), of the intervals with a flag; `times` are the edges of all, shape (n+1,)."""
    edges = np.diff(np.concatenate([[0], np.asarray(flags, dtype=int) != 0, [0]]).astype(int))
    return np.column_stack([times[np.flatnonzero(edges == 1)], times[np.flatnonzero(edges == -1)]])


def thinned(x: np.ndarray, y: np.ndarray, points: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most some `points` of a curve: the lowest and the highest of each stretch, so that no peak is lost."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(x) <= points:
        return x, y
    kept: set[int] = {0, len(x) - 1}
    for stretch in np.array_split(np.arange(len(x)), points // 2):
        part = np.where(np.isfinite(y[stretch]), y[stretch], 0.0)
        kept |= {int(stretch[np.argmin(part)]), int(stretch[np.argmax(part)])}
    chosen = np.array(sorted(kept))
    return x[chosen], y[chosen]


def as_json(plot: Plot) -> str:
    """The plot as page.js reads it; arrays are base64 of float32, each stored once."""
    arrays: dict[bytes, int] = {}

    def stored(values: Any) -> int:
        with np.errstate(over="ignore"):  # beyond float32 is as good as infinite on a screen
            return arrays.setdefault(np.asarray(values, dtype="<f4").tobytes(), len(arrays))

    curves = []
    for curve in plot.curves:
        x, y = (curve.x, curve.y) if curve.style == "trail" else thinned(curve.x, curve.y)
        drawn = {"label": curve.label, "x": stored(x), "y": stored(_drawable(y, plot.y_log))}
        drawn["style"] = "reference" if curve.reference else curve.style
        drawn |= {
            name: getattr(curve, name) for name in ("dashed", "filled", "colour", "shared", "tags")
        }
        curves.append(drawn | ({"times": stored(curve.times)} if curve.times is not None else {}))
    content = {
        "title": plot.title,
        "x": {"label": plot.x_label, "log": plot.x_log},
        "y": {
            "label": plot.y_label,
            "log": plot.y_log,
            "most": plot.y_most if plot.y_most is not None else _ceiling(plot),
        },
        "clock": plot.clock,
        "curves": curves,
        "shades": [
            {"label": shade.label, "spans": stored(shade.spans.ravel()), "tags": shade.tags}
            for shade in plot.shades
        ],
    }
    content |= {"corners": plot.corners} if plot.corners else {}
    content |= {"scaled": plot.scaled} if plot.scaled is not None else {}
    content["arrays"] = [base64.b64encode(values).decode() for values in arrays]
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def _drawable(values: np.ndarray, log: bool) -> np.ndarray:
    """With a gap where nothing can be drawn."""
    values = np.asarray(values, dtype=float)
    fits = np.isfinite(values) & (np.abs(values) < 3e38) & (values > 1e-37 if log else True)
    return np.where(fits, values, np.nan)


def _ceiling(plot: Plot) -> float | None:
    """The top of a logarithmic axis that references leave: a reference may leave the picture, a result may not."""
    results = [_drawable(curve.y, True) for curve in plot.curves if not curve.reference]
    if (
        not plot.y_log
        or len(results) == len(plot.curves)
        or not any(np.isfinite(one).any() for one in results)
    ):
        return None
    return 1e6 * max(float(np.nanmax(one)) for one in results if np.isfinite(one).any())


def description(plot: Plot) -> str:
    """What the plot shows, in words: the range of each of its curves."""
    told = []
    for curve in plot.curves:
        values = np.asarray(curve.y, dtype=float)[np.isfinite(curve.y)]
        if not len(values):
            told.append(f"{curve.label}: nothing")
        elif np.ptp(values) == 0.0:
            told.append(f"{curve.label}: {values[0]:.3g} throughout")
        else:
            told.append(
                f"{curve.label}: {values.min():.3g} to {values.max():.3g}, at last {values[-1]:.3g}"
            )
    return (
        f"{plot.y_label} over {plot.x_label}."
        f" {'; '.join(told[:12])}{'; and more' if len(told) > 12 else ''}."
    )


def still(plot: Plot, height: float = 3.2) -> str:
    """The plot, its first twelve curves, as the text of an SVG file of this height [in], transparent and small."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": "codrl_mj", "path.simplify_threshold": 0.5}
    ):
        figure = Figure(figsize=(6.4, height))
        figure.subplots_adjust(0.13, 0.17, 0.985 if plot.scaled is None else 0.87, 0.97)
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        _draw(plot, axes, "#767c84", _STILL)
        if len(plot.curves) > 1:
            axes.legend(fontsize=8, frameon=False, labelcolor="#767c84")
        buffer = io.StringIO()
        figure.savefig(
            buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
        )
    return buffer.getvalue()


def save(
    several: Plot | Sequence[Plot], path: Path, size: tuple[float, float] | None = None
) -> None:
    """Write a plot, or some in two rows, column by column, as a PNG file on white, whole or not at all.

    Args:
        several: what to draw, the first twelve curves of each.
        path: the file.
        size: width and height of the picture [in]; None: what they need.
    """
    from matplotlib.figure import Figure

    drawn = [several] if isinstance(several, Plot) else several
    rows = min(2, len(drawn))
    columns = math.ceil(len(drawn) / rows)
    figure = Figure(
        figsize=size or (8.0 if columns == 1 else 4.8 * columns, 2.0 + 3.2 * rows),
        layout="constrained",
    )
    panels = figure.subplots(rows, columns, squeeze=False)
    for plot, axes in zip(drawn, panels.T.flat, strict=True):
        _draw(plot, axes, "#22313f", POINTS)
        axes.set_title(plot.title.replace("$", r"\$"), fontsize="medium", color="#22313f")
        beside = min(len(plot.curves), 3 if columns == 1 else 2)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.15),
            ncols=beside,
            fontsize="small",
            frameon=False,
        )
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)


def _draw(plot: Plot, axes: Any, ink: str, points: int) -> None:
    """Draw a plot's first twelve curves, each of at most so many points, on matplotlib's axes."""
    for index, curve in enumerate(plot.curves[:12]):
        label = curve.label.replace("$", r"\$")  # a name, and no formula
        colour = (
            ink
            if curve.reference
            else _PALETTE[(index if curve.colour is None else curve.colour) % 6]
        )
        x, y = thinned(curve.x, _drawable(curve.y, plot.y_log), points)
        dots = curve.style in ("dots", "trail")
        few = len(curve.x) <= _FEW and not curve.reference
        axes.plot(
            x,
            y,
            linestyle="none" if dots else "--" if curve.dashed or curve.reference else "-",
            linewidth=1.3,
            color=colour,
            marker="." if dots or few else "",
            markersize=9.0 if dots and few else 5.0 if few else 3.0,
            drawstyle="steps-post" if curve.style == "step" else "default",
            label=label if label not in axes.get_legend_handles_labels()[1] else None,
        )
        if curve.filled:
            other = thinned(curve.x, _drawable(plot.curves[index - 1].y, plot.y_log), points)[1]
            (
                axes.fill_between(x, y, other, color=colour, alpha=0.12, linewidth=0)
                if len(other) == len(y)
                else None
            )
    for shade in plot.shades[:1]:
        for begin, end in shade.spans[:60]:
            axes.axvspan(begin, end, color=_PALETTE[4], alpha=0.2, linewidth=0)
    if plot.x_log and any(np.any(np.asarray(curve.x) > 0) for curve in plot.curves):
        axes.set_xscale("log")
    if plot.y_log and any(np.isfinite(_drawable(curve.y, True)).any() for curve in plot.curves):
        axes.set_yscale("log")
        axes.set_ylim(top=min(axes.get_ylim()[1], _ceiling(plot) or math.inf))
    if plot.y_most is not None:
        axes.set_ylim(-plot.y_most, plot.y_most)
    axes.margins(x=0.0)
    axes.set_xlabel(plot.x_label, color=ink)
    axes.set_ylabel(plot.y_label, color=ink)
    axes.tick_params(colors=ink, which="both")
    axes.spines[:].set_color(ink)
    axes.grid(color=ink, alpha=0.25)
    for axis in "xy":
        if getattr(axes, f"get_{axis}scale")() == "linear":
            axes.locator_params(axis=axis, nbins=5)
    for place, text in zip(
        itertools.product((0.015, 0.985), (0.985, 0.015)), plot.corners, strict=False
    ):
        along, up = ("left", "right")[place[0] > 0.5], ("bottom", "top")[place[1] > 0.5]
        axes.text(*place, text, transform=axes.transAxes, color=ink, alpha=0.8, ha=along, va=up)
    if plot.scaled is not None:
        label, scale = plot.scaled
        right = axes.secondary_yaxis(
            "right", functions=(lambda value: scale * value, lambda value: value / scale)
        )
        right.set_ylabel(label, color=ink)
        right.tick_params(colors=ink)
