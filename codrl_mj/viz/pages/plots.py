"""Plots on pages: as JSON, which uPlot draws, and as SVG, if scripts do not run."""

import base64
import io
import json

import numpy as np
from numpy.typing import ArrayLike

from codrl_mj.plots import Plot, ceiling, decimate, draw, finite_or_nan

_SVG_POINTS = 240
"""Maximum number of points of a line in the SVG picture."""


def to_json(plot: Plot) -> str:
    """Return the plot as JSON for page.js; arrays are base64 of float32, each stored once."""
    arrays: dict[bytes, int] = {}

    def array_index(values: ArrayLike) -> int:
        # Values beyond float32 become infinite, which a plot cannot distinguish.
        with np.errstate(over="ignore"):
            return arrays.setdefault(np.asarray(values, dtype="<f4").tobytes(), len(arrays))

    curves = []
    for curve in plot.curves:
        x, y = (curve.x, curve.y) if curve.style == "trail" else decimate(curve.x, curve.y)
        entry = {
            "label": curve.label,
            "x": array_index(x),
            "y": array_index(finite_or_nan(y, plot.y_log)),
        }
        entry["style"] = "reference" if curve.reference else curve.style
        entry |= {
            name: getattr(curve, name) for name in ("dashed", "filled", "colour", "shared", "tags")
        }
        curves.append(
            entry | ({"times": array_index(curve.times)} if curve.times is not None else {})
        )
    content = {
        "title": plot.title,
        "x": {"label": plot.x_label, "log": plot.x_log},
        "y": {
            "label": plot.y_label,
            "log": plot.y_log,
            "most": plot.y_limit if plot.y_limit is not None else ceiling(plot),
        },
        "clock": plot.clock,
        "curves": curves,
        "shades": [
            {"label": shade.label, "spans": array_index(shade.spans.ravel()), "tags": shade.tags}
            for shade in plot.shades
        ],
    }
    content |= {"corners": plot.corners} if plot.corners else {}
    content |= {"scaled": plot.second_axis} if plot.second_axis is not None else {}
    content["arrays"] = [base64.b64encode(values).decode() for values in arrays]
    # An escaped < cannot close the script element that holds the JSON.
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def describe(plot: Plot) -> str:
    """Return a text for readers who do not see the plot: the range of each curve."""
    parts = []
    for curve in plot.curves:
        values = np.asarray(curve.y, dtype=float)[np.isfinite(curve.y)]
        if not len(values):
            parts.append(f"{curve.label}: nothing")
        elif np.ptp(values) == 0.0:
            parts.append(f"{curve.label}: {values[0]:.3g} throughout")
        else:
            parts.append(
                f"{curve.label}: {values.min():.3g} to {values.max():.3g}, at last {values[-1]:.3g}"
            )
    return (
        f"{plot.y_label} over {plot.x_label}."
        f" {'; '.join(parts[:12])}{'; and more' if len(parts) > 12 else ''}."
    )


def to_svg(plot: Plot, height: float = 3.2) -> str:
    """Return the first twelve curves as the text of a small, transparent SVG file.

    Args:
        plot: the plot.
        height: height of the picture [in].
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    # Text stays text instead of paths, and ids are reproducible, so that the file is small and
    # equal for equal plots.
    with mpl.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": "codrl_mj", "path.simplify_threshold": 0.5}
    ):
        figure = Figure(figsize=(6.4, height))
        figure.subplots_adjust(0.13, 0.17, 0.985 if plot.second_axis is None else 0.87, 0.97)
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        draw(plot, axes, "#767c84", _SVG_POINTS)
        if len(plot.curves) > 1:
            axes.legend(fontsize=8, frameon=False, labelcolor="#767c84")
        buffer = io.StringIO()
        figure.savefig(
            buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
        )
    return buffer.getvalue()
