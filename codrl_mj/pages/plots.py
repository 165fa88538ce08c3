"""Plots as data: what a page draws with uPlot, and the still picture that stands in where no script may run."""

import base64
import dataclasses
import io
import json
import math
from typing import Any, Literal

import numpy as np

POINTS = 6000
"""Most points of a line: more than there are pixels on a zoomed screen show nothing."""
_STILL = 240
"""Points of a line in the still picture."""
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


def spans(times: np.ndarray, flags: np.ndarray) -> np.ndarray:
    """Stretches in which a flag is set.

    Args:
        times: edges of the intervals, shape (n+1,).
        flags: of each interval, shape (n,).

    Returns:
        Beginnings and ends, shape (m, 2).
    """
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

    def drawn(curve: Curve) -> dict[str, Any]:
        trail = curve.style == "trail"
        x, y = (curve.x, curve.y) if trail else thinned(curve.x, curve.y)
        found = {
            "label": curve.label,
            "x": stored(x),
            "y": stored(_drawable(y, plot.y_log)),
            "style": "reference" if curve.reference else curve.style,
            "dashed": curve.dashed,
            "filled": curve.filled,
            "colour": curve.colour,
            "shared": curve.shared,
            "tags": curve.tags,
        }
        return found | ({"times": stored(curve.times)} if curve.times is not None else {})

    content = {
        "title": plot.title,
        "x": {"label": plot.x_label, "log": plot.x_log},
        "y": {
            "label": plot.y_label,
            "log": plot.y_log,
            "most": plot.y_most if plot.y_most is not None else _ceiling(plot),
        },
        "clock": plot.clock,
        "curves": [drawn(curve) for curve in plot.curves],
        "shades": [
            {"label": shade.label, "spans": stored(shade.spans.ravel()), "tags": shade.tags} for shade in plot.shades
        ],
    }
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
    if not plot.y_log or len(results) == len(plot.curves) or not any(np.isfinite(one).any() for one in results):
        return None
    return 1e6 * max(float(np.nanmax(one)) for one in results if np.isfinite(one).any())


def description(plot: Plot) -> str:
    """What the plot shows, in words: the range of each of its curves."""
    told = []
    for curve in plot.curves:
        values = np.asarray(curve.y, dtype=float)
        values = values[np.isfinite(values)]
        if not len(values):
            told.append(f"{curve.label}: nothing")
        elif np.ptp(values) == 0.0:
            told.append(f"{curve.label}: {values[0]:.3g} throughout")
        else:
            told.append(f"{curve.label}: {values.min():.3g} to {values.max():.3g}, at last {values[-1]:.3g}")
    return f"{plot.y_label} over {plot.x_label}. {'; '.join(told[:12])}{'; and more' if len(told) > 12 else ''}."


def still(plot: Plot, width: float = 6.4, height: float = 3.2) -> str:
    """The plot as the text of an SVG file, without a background and small.

    Args:
        plot: what to draw, its first twelve curves.
        width: of the picture [in].
        height: of the picture [in].
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    ink = "#767c84"
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "codrl_mj", "path.simplify_threshold": 0.5}):
        figure = Figure(figsize=(width, height))
        figure.subplots_adjust(0.13, 0.17, 0.985, 0.97)
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        for index, curve in enumerate(plot.curves[:12]):
            x, y = thinned(curve.x, _drawable(curve.y, plot.y_log), _STILL)
            colour = ink if curve.reference else _PALETTE[(index if curve.colour is None else curve.colour) % 6]
            dots = curve.style in ("dots", "trail")
            line = "none" if dots else "--" if curve.dashed or curve.reference else "-"
            axes.plot(x, y, line, color=colour, linewidth=1.3, label=curve.label, marker="." if dots else "",
                      markersize=3, drawstyle="steps-post" if curve.style == "step" else "default")  # fmt: skip
            if curve.filled:
                other = thinned(curve.x, _drawable(plot.curves[index - 1].y, plot.y_log), _STILL)[1]
                axes.fill_between(x, y, other, color=colour, alpha=0.12, linewidth=0) if len(other) == len(y) else None
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
        axes.set_xlabel(plot.x_label, color=ink)
        axes.set_ylabel(plot.y_label, color=ink)
        axes.tick_params(colors=ink, which="both")
        axes.spines[:].set_color(ink)
        axes.grid(color=ink, alpha=0.25)
        if axes.get_xscale() == "linear":
            axes.locator_params(axis="x", nbins=5)
        if axes.get_yscale() == "linear":
            axes.locator_params(axis="y", nbins=5)
        if len(plot.curves) > 1:
            axes.legend(fontsize=8, frameon=False, labelcolor=ink)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()
