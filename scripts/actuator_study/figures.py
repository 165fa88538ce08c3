"""Figures of the study: losses by severity, scores by training arm, and a map of verdicts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actuator_study import arms
from actuator_study.units import THINGS, severity_text, size
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.study.advice import (
    BUY,
    IDEAL,
    MEASURE,
    RANDOMIZE,
    THROUGH,
    decide,
    option_bounds,
    tested_arms,
)
from codrl_mj.study.axes import AXES, SECONDS
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.pages import COLORS, MARKERS, TITLES, add_legend, save_figure
from codrl_mj.study.questions import Scores
from codrl_mj.study.trials import Trial

# Lowest score that is drawn, as a share of the span: worse policies are equally lost.
_LOWEST = -0.1
_REGIONS = {
    IDEAL: "#d9f0e3",
    RANDOMIZE: "#dbe9f6",
    THROUGH: "#fdebc8",
    BUY: "#f6d5cc",
    MEASURE: "#eeeeee",
}


def losses(path: Path, evidence: Evidence) -> bool:
    """Draw the losses of ideal-trained policies: panel per axis, row per task, column per severity.

    A cell shows the mean loss, and below it the share of policies that lose more than `FAILURE_MARGIN`,
    if there are any.

    Returns:
        True if there was anything to draw.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    panels: Any = figure.subplots(2, 3).ravel()
    drawn = False
    for number, (panel, (name, axis)) in enumerate(zip(panels, AXES.items(), strict=True)):
        means = np.full((len(SECONDS), len(axis.severities) - 1), np.nan)
        for row, task in enumerate(SECONDS):
            for column, severity in enumerate(axis.severities[1:]):
                if (loss := evidence.loss(task, name, severity)) is None:
                    continue
                outcome, drawn = loss.outcome, True
                means[row, column] = outcome.loss.mean
                text = f"{outcome.loss.mean:z.2f}" + (
                    f"\n{outcome.failed:.0%} fail" if outcome.failed else ""
                )
                dark = "white" if outcome.loss.mean > 0.45 else "0.15"
                panel.text(column, row, text, ha="center", va="center", fontsize=6.5, color=dark)
        shown = panel.imshow(
            np.clip(means, 0.0, 1.0), cmap="YlOrBr", vmin=0.0, vmax=1.0, aspect="auto"
        )
        panel.set_xticks(
            range(len(axis.severities) - 1), [f"{severity:g}" for severity in axis.severities[1:]]
        )
        named = [f"{TITLES[task]}\n{size(task)}" for task in SECONDS]
        panel.set_yticks(range(len(SECONDS)), named if number % 3 == 0 else [], fontsize=8)
        panel.set(xlabel=axis.unit, title=THINGS[name].capitalize())
    figure.colorbar(shown, ax=panels, label="lost [share of the span]", shrink=0.6)
    save_figure(figure, path)
    return drawn


def trainings(path: Path, evidence: Evidence) -> bool:
    """Draw policies' scores at the trained severities as dots, grouped by training arm.

    Returns:
        True if there was anything to draw.
    """
    from matplotlib.figure import Figure

    kinds = {
        "ideal": "ideal forces",
        "generic": "random actuators",
        "drawn": "drawn severities",
        "matched": "the same severity",
    }
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharey=True)
    drawn = False
    for panel, task in zip(panels, arms.TRAINED, strict=True):
        for axis_index, (name, axis) in enumerate(AXES.items()):
            trained = {"drawn": f"{name}, drawn", "matched": name}
            for number, (kind, label) in enumerate(kinds.items()):
                outcome = evidence.outcome(
                    task, trained.get(kind, kind), f"{name} {axis.training_severity[task]:g}"
                )
                if outcome is not None:
                    drawn = True
                    dots(
                        panel,
                        axis_index + 0.19 * (number - 1.5),
                        1.0 - outcome.lost,
                        COLORS[number],
                        label,
                    )
        named = [
            f"{thing} {severity_text(task, name, AXES[name].training_severity[task])}"
            for name, thing in THINGS.items()
        ]
        panel.set_xticks(range(len(AXES)), named)
        panel.set(title=TITLES[task], ylabel="score [share of the span]")
        panel.grid(axis="y", color="0.9")
        panel.set_axisbelow(True)
    if drawn:
        add_legend(figure, 4)
    save_figure(figure, path)
    return drawn


def dots(
    panel: Any, x: float, scores: Sequence[float] | np.ndarray, color: str, label: str
) -> None:
    """Draw each policy's score as a dot and their mean as a line; clip scores below the panel."""
    clipped = np.sort(np.maximum(scores, _LOWEST))
    spread = np.linspace(-0.045, 0.045, len(clipped))
    panel.plot(x + spread, clipped, ".", color=color, markersize=3.5, alpha=0.7, label=label)
    panel.plot([x - 0.06, x + 0.06], [np.mean(clipped)] * 2, color=color, lw=1.5)


def bars(
    path: Path, scores: Scores, groups: Mapping[str, Sequence[tuple[str, Trial]]], title: str
) -> None:
    """Draw scores of groups of trials: a dot per policy, and the mean with its 95 % interval.

    Args:
        path: SVG file.
        scores: of the study.
        groups: name -> label and trial of each bar; bars of the same label have the same color.
        title: title above the figure.
    """
    from matplotlib.figure import Figure

    labels = list(dict.fromkeys(label for group in groups.values() for label, _ in group))
    figure = Figure(figsize=(max(6.0, 1.2 + 1.5 * len(groups)), 3.9), layout="constrained")
    axes: Any = figure.subplots()
    for group_index, group in enumerate(groups.values()):
        for number, (label, trial) in enumerate(group):
            values = _values(scores, trial)
            if values.size:
                x = group_index + 0.8 * ((number + 0.5) / len(group) - 0.5)
                kind = labels.index(label)
                color, marker = COLORS[kind % len(COLORS)], MARKERS[kind % len(MARKERS)]
                clipped = np.maximum(values, _LOWEST)
                # The dots stand beside the error bar so that they do not hide it.
                axes.plot(
                    np.full(len(clipped), x + 0.06),
                    clipped,
                    ".",
                    color=color,
                    markersize=3,
                    alpha=0.6,
                )
                _bars(axes, np.array([x]), [bootstrap_mean(values)], color, marker, label)
    axes.set_xticks(range(len(groups)), groups)
    axes.set(ylabel="score [share of the span]", title=title, xlim=(-0.5, len(groups) - 0.5))
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    add_legend(figure, 3)
    save_figure(figure, path)


def chart(path: Path, evidence: Evidence) -> bool:
    """Draw the verdicts for an actuator that only lags or lacks voltage, a panel for each task.

    Tasks on which nothing was trained through a single axis are hatched.

    Returns:
        True if there was anything to draw: all results of a task are present.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    lags, shortfalls = np.geomspace(0.05, 8.0, 41), np.linspace(0.0, 0.8, 33)
    tasks = [
        task
        for task in SECONDS
        if all(evidence.loss(task, axis, 0.0) for axis in ("lag", "supply"))
    ]
    if not tasks:
        return False
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    panels: Any = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    zero_severities, shown_regions = dict.fromkeys(AXES, 0.0), set[int]()
    for panel, task in zip(panels, tasks, strict=False):
        tests = tested_arms(evidence, task)
        regions = np.array(
            [
                [
                    list(_REGIONS).index(
                        decide(
                            option_bounds(
                                evidence,
                                task,
                                zero_severities | {"lag": lag, "supply": shortfall},
                                tests,
                            )
                        )
                    )
                    for lag in lags
                ]
                for shortfall in shortfalls
            ]
        )
        shown_regions.update(regions.flat)
        colors = ListedColormap(list(_REGIONS.values()))
        panel.pcolormesh(
            lags,
            1.0 - shortfalls,
            regions,
            cmap=colors,
            vmin=-0.5,
            vmax=len(_REGIONS) - 0.5,
            rasterized=True,
        )
        if task not in arms.TRAINED:
            panel.contourf(
                lags, 1.0 - shortfalls, regions, levels=[0.5, 99], colors="none", hatches=["//"]
            )
        panel.set(title=TITLES[task], xscale="log")
        panel.set_xticks([0.1, 0.3, 1.0, 3.0], ["0.1", "0.3", "1", "3"])
        panel.minorticks_off()
    for panel in panels[3:]:
        panel.set_xlabel(
            "time constant of the loop, a third of\nits settling time to 5 % [policy steps]"
        )
    for panel in panels[::3]:
        panel.set_ylabel("available voltage [needed voltage]")
    shown = [region for number, region in enumerate(_REGIONS.items()) if number in shown_regions]
    handles = [Patch(facecolor=color, edgecolor="0.6", label=name) for name, color in shown]
    handles.append(
        Patch(
            facecolor="white",
            edgecolor="0.4",
            hatch="//",
            label="trained at most through real motors",
        )
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    save_figure(figure, path)
    return True


def _values(scores: Scores, trial: Trial) -> np.ndarray:
    return np.array(list(scores.by_seed(trial).values()))


def _bars(
    axes: Any, x: np.ndarray, means: Sequence[Any], color: str, marker: str, label: str
) -> None:
    """Draw means with their intervals; clip values below the figure."""
    middle = np.maximum([mean.mean for mean in means], _LOWEST)
    low = np.maximum(middle - np.maximum([mean.low for mean in means], _LOWEST), 0.0)
    high = np.maximum(np.maximum([mean.high for mean in means], _LOWEST) - middle, 0.0)
    axes.errorbar(x, middle, [low, high], fmt=marker, color=color, ms=5, lw=1.2, label=label)
