"""The mismatch study's figures: SVG on white, so that they read alike in print, on a light and on a dark page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.runs.files import writing

COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
"""Of Okabe and Ito's palette, which the colour-blind can tell apart."""
MARKERS = ("o", "s", "^", "D", "v", "P")
_MISSING = "#d9d9d9"


def heat_map(path: Path, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], title: str) -> None:
    """Draw mean returns as a heat map with the numbers in it.

    Args:
        path: SVG file.
        values: shape (rows, columns); NaN is drawn as missing.
        rows: what policies were trained on.
        columns: what they were tested on.
        title: above it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.9 + 0.72 * len(columns), 1.9 + 0.34 * len(rows)), layout="constrained")
    axes: Any = figure.subplots()
    import matplotlib

    colours = matplotlib.colormaps["cividis"].with_extremes(bad=_MISSING)
    image = axes.imshow(np.ma.masked_invalid(values), cmap=colours, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=35, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows)
    axes.set(xlabel="tested on", ylabel="trained on", title=title)
    for (row, column), value in np.ndenumerate(values):
        text = f"{value:.0f}".replace("-", "\N{MINUS SIGN}") if np.isfinite(value) else "–"
        colour = _legible_on(image.cmap(image.norm(value))) if np.isfinite(value) else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color=colour)
    figure.colorbar(image, ax=axes, label="mean return")
    save(figure, path)


def _legible_on(background: Sequence[float]) -> str:
    """Black or white, whichever contrasts more with an RGB colour: WCAG 2's relative luminance, equal at 0.179."""
    channels = np.array(background[:3])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return "black" if linear @ [0.2126, 0.7152, 0.0722] > 0.179 else "white"


def points(
    path: Path,
    series: Mapping[str, Mapping[str, tuple[Interval, np.ndarray]]],
    tests: Sequence[str],
    title: str,
) -> None:
    """Draw interquartile means with their intervals, and every run as a small dot, over the test conditions.

    Args:
        path: SVG file.
        series: label -> test condition -> interquartile mean, and the runs' mean returns.
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
        means = np.array([by_test[test][0] for test in there]).reshape(-1, 3)
        below, above = means[:, 0] - means[:, 1], means[:, 2] - means[:, 0]
        spread = np.nan_to_num(np.maximum([below, above], 0.0))  # rounding; a single run has no interval
        axes.errorbar(
            places, means[:, 0], spread, fmt=marker, color=colour, markersize=7, capsize=3, linewidth=1.4, label=label
        )
        for place, test in zip(places, there, strict=True):
            runs = by_test[test][1]
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


def probabilities(path: Path, questions: Mapping[str, Mapping[str, Interval]], title: str) -> None:
    """Draw probabilities of improvement with their intervals, beside the line of no improvement.

    Args:
        path: SVG file.
        questions: what is asked -> test condition -> the probability.
        title: above it.
    """
    from matplotlib.figure import Figure

    sizes = [len(rows) for rows in questions.values()]
    height = 1.1 + sum(0.42 + 0.24 * size for size in sizes)
    figure = Figure(figsize=(7.0, height), layout="constrained")
    ratios = [0.7 + size for size in sizes]
    every = figure.subplots(len(sizes), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    for axes, (question, rows) in zip(every, questions.items(), strict=True):
        means = np.array(list(rows.values())).reshape(-1, 3)
        places = np.arange(len(rows))[::-1]
        spread = np.nan_to_num(np.maximum([means[:, 0] - means[:, 1], means[:, 2] - means[:, 0]], 0.0))
        axes.axvline(0.5, color="0.4", linewidth=1, linestyle="--")
        axes.errorbar(means[:, 0], places, xerr=spread, fmt="o", color=COLOURS[1], capsize=3, linewidth=1.4)
        axes.set_yticks(places, rows, fontsize=9)
        axes.set(xlim=(-0.03, 1.03), ylim=(-0.6, len(rows) - 0.4))
        axes.set_title(question, loc="left", fontsize=9)
        axes.grid(axis="x", color="0.9")
        axes.set_axisbelow(True)
    every[-1].set_xlabel("probability of improvement (0.5: none)")
    figure.suptitle(title)
    save(figure, path)


def save(figure: Any, path: Path) -> None:
    """Write a figure on white as SVG; the same bytes for the same figure."""
    import matplotlib

    figure.set_facecolor("white")
    with writing(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "codrl_mj"}):
        figure.savefig(temporary, format="svg", metadata={"Date": None})
