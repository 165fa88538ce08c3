"""The mismatch study's figures: SVG on white, so that they read alike in print, on a light and on a dark page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import writing

COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
"""Of Okabe and Ito's palette, which the colour-blind can tell apart."""
MARKERS = ("o", "s", "^", "D", "v", "P")
_MISSING = "#d9d9d9"
_SVG = {"svg.hashsalt": "codrl_mj", "svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans", "sans-serif"]}
"""The same bytes for the same figure; text as text, which a reader can search and edit."""


def heat_map(path: Path, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], title: str) -> None:
    """Draw mean returns as a heat map with the numbers in it; framed is what is tested where it was trained.

    Args:
        path: SVG file.
        values: shape (rows, columns); NaN is drawn as missing.
        rows: what policies were trained on.
        columns: what they were tested on.
        title: above it.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(2.9 + 0.72 * len(columns), 1.9 + 0.34 * len(rows)), layout="constrained")
    axes: Any = figure.subplots()
    import matplotlib

    colours = matplotlib.colormaps["cividis"].with_extremes(bad=_MISSING)
    image = axes.pcolormesh(np.ma.masked_invalid(values), cmap=colours)  # vectors: small, and sharp in print
    axes.invert_yaxis()
    axes.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=35, ha="right", rotation_mode="anchor")
    axes.set_yticks(np.arange(len(rows)) + 0.5, rows)
    axes.set(xlabel="tested on", ylabel="trained on", title=f"{title}: mean returns")
    for (row, column), value in np.ndenumerate(values):
        text = f"{value:.0f}".replace("-", "\N{MINUS SIGN}") if np.isfinite(value) else "–"
        colour = _legible_on(image.cmap(image.norm(value))) if np.isfinite(value) else "black"
        axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=9, color=colour)
        if rows[row] == columns[column]:  # trained on what it is tested on
            axes.add_patch(
                Rectangle((column + 0.03, row + 0.04), 0.94, 0.92, fill=False, edgecolor=colour, linewidth=1.2)
            )
    save(figure, path)


def _legible_on(background: Sequence[float]) -> str:
    """Black or white, whichever contrasts more with an RGB colour: WCAG 2's relative luminance, equal at 0.179."""
    channels = np.array(background[:3])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return "black" if linear @ [0.2126, 0.7152, 0.0722] > 0.179 else "white"


def points(
    path: Path,
    series: Mapping[str, Mapping[str, np.ndarray]],
    tests: Sequence[str],
    title: str,
) -> None:
    """Draw means with a line from the worst run to the best, and every run as a small dot, over the test conditions.

    Args:
        path: SVG file.
        series: label -> test condition -> the runs' mean returns, shape (runs,).
        tests: the test conditions, in order.
        title: above it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(7.0, 2.6 + 1.0 * len(tests)), 4.0 + 0.16 * len(series)), layout="constrained")
    axes: Any = figure.subplots()
    for index, (label, by_test) in enumerate(series.items()):
        shift = 0.62 * ((index + 0.5) / len(series) - 0.5)
        there = [test for test in tests if test in by_test]
        places = np.array([tests.index(test) + shift for test in there])
        colour, marker = COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]
        means = [by_test[test].mean() for test in there]
        axes.plot(places, means, marker, color=colour, markersize=7, label=label)
        lowest, highest = np.array([[by_test[test].min(), by_test[test].max()] for test in there]).reshape(-1, 2).T
        axes.vlines(places, lowest, highest, color=colour, linewidth=1.4)
        for place, test in zip(places, there, strict=True):
            runs = by_test[test]
            axes.plot(np.full(len(runs), place + 0.07), runs, ".", color=colour, markersize=4, alpha=0.6)
    axes.set_xticks(range(len(tests)), tests, rotation=20, ha="right", rotation_mode="anchor")
    for edge in np.arange(len(tests) - 1) + 0.5:
        axes.axvline(edge, color="0.85", linewidth=0.8)
    axes.set_xlim(-0.5, len(tests) - 0.5)
    axes.set(xlabel="tested on", ylabel="return", title=title)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize="small")
    save(figure, path)


def save(figure: Any, path: Path) -> None:
    """Write a figure on white as SVG; the same bytes for the same figure."""
    import matplotlib

    figure.set_facecolor("white")
    with writing(path) as temporary, matplotlib.rc_context(_SVG):
        figure.savefig(temporary, format="svg", metadata={"Date": None})
