"""The study's figures: dose and response, bars of what was trained on what, and what to do about an actuator."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actuator_study import arms
from actuator_study.units import THINGS, dose_text, size
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.study.advice import (
    BUY,
    IDEAL,
    MEASURE,
    RANDOMIZE,
    THROUGH,
    decide,
    option_bounds,
    tested_points,
)
from codrl_mj.study.axes import AXES, SECONDS
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.pages import COLORS, MARKERS, TITLES, add_legend, save_figure
from codrl_mj.study.questions import Scores
from codrl_mj.study.trials import Trial

_LOWEST = -0.1  # of the span; what is worse is as lost
_REGIONS = {
    IDEAL: "#d9f0e3",
    RANDOMIZE: "#dbe9f6",
    THROUGH: "#fdebc8",
    BUY: "#f6d5cc",
    MEASURE: "#eeeeee",
}


def losses(path: Path, evidence: Evidence) -> bool:
    """Draw what ideal-trained policies lose, a panel for each axis, a row for each task, a column for each dose.

    A cell has the mean loss, and below it how many policies lose more than `FAILURE_MARGIN`, where any
    does.

    Returns:
        Whether anything could be drawn.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    panels: Any = figure.subplots(2, 3).ravel()
    drawn = False
    for number, (panel, (name, axis)) in enumerate(zip(panels, AXES.items(), strict=True)):
        means = np.full((len(SECONDS), len(axis.severities) - 1), np.nan)
        for row, task in enumerate(SECONDS):
            for column, dose in enumerate(axis.severities[1:]):
                if (found := evidence.loss(task, name, dose)) is None:
                    continue
                outcome, drawn = found.outcome, True
                means[row, column] = outcome.loss.mean
                text = f"{outcome.loss.mean:z.2f}" + (
                    f"\n{outcome.failed:.0%} fail" if outcome.failed else ""
                )
                dark = "white" if outcome.loss.mean > 0.45 else "0.15"
                panel.text(column, row, text, ha="center", va="center", fontsize=6.5, color=dark)
        shown = panel.imshow(
            np.clip(means, 0.0, 1.0), cmap="YlOrBr", vmin=0.0, vmax=1.0, aspect="auto"
        )
        panel.set_xticks(range(len(axis.severities) - 1), [f"{dose:g}" for dose in axis.severities[1:]])
        named = [f"{TITLES[task]}\n{size(task)}" for task in SECONDS]
        panel.set_yticks(range(len(SECONDS)), named if number % 3 == 0 else [], fontsize=8)
        panel.set(xlabel=axis.unit, title=THINGS[name].capitalize())
    figure.colorbar(shown, ax=panels, label="lost [share of the span]", shrink=0.6)
    save_figure(figure, path)
    return drawn


def insured(path: Path, evidence: Evidence) -> bool:
    """Draw what policies score at the doses that were trained through, by what they were trained on; every one a dot.

    Returns:
        Whether anything could be drawn.
    """
    from matplotlib.figure import Figure

    kinds = {
        "ideal": "ideal forces",
        "generic": "random actuators",
        "drawn": "drawn doses",
        "matched": "that dose",
    }
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharey=True)
    drawn = False
    for panel, task in zip(panels, arms.TRAINED, strict=True):
        for place, (name, axis) in enumerate(AXES.items()):
            trained = {"drawn": f"{name}, drawn", "matched": name}
            for number, (kind, label) in enumerate(kinds.items()):
                found = evidence.outcome(
                    task, trained.get(kind, kind), f"{name} {axis.training_severity[task]:g}"
                )
                if found is not None:
                    drawn = True
                    dots(
                        panel,
                        place + 0.19 * (number - 1.5),
                        1.0 - found.lost,
                        COLORS[number],
                        label,
                    )
        named = [
            f"{thing} {dose_text(task, name, AXES[name].training_severity[task])}"
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
    panel: Any, at: float, scores: Sequence[float] | np.ndarray, colour: str, label: str
) -> None:
    """Draw every policy's score as a dot, and a line at their mean; what is below the panel is drawn at its end."""
    clipped = np.sort(np.maximum(scores, _LOWEST))
    spread = np.linspace(-0.045, 0.045, len(clipped))
    panel.plot(at + spread, clipped, ".", color=colour, markersize=3.5, alpha=0.7, label=label)
    panel.plot([at - 0.06, at + 0.06], [np.mean(clipped)] * 2, color=colour, lw=1.5)


def bars(
    path: Path, scores: Scores, groups: Mapping[str, Sequence[tuple[str, Trial]]], title: str
) -> None:
    """Draw scores of trials in groups, every policy as a dot, and the mean with its 95 % interval.

    Args:
        path: SVG file.
        scores: of the study.
        groups: name -> label and trial of each of its bars; the same label has the same colour.
        title: above it.
    """
    from matplotlib.figure import Figure

    labels = list(dict.fromkeys(label for each in groups.values() for label, _ in each))
    figure = Figure(figsize=(max(6.0, 1.2 + 1.5 * len(groups)), 3.9), layout="constrained")
    axes: Any = figure.subplots()
    for place, each in enumerate(groups.values()):
        for number, (label, trial) in enumerate(each):
            values = _values(scores, trial)
            if values.size:
                at = place + 0.8 * ((number + 0.5) / len(each) - 0.5)
                kind = labels.index(label)
                colour, marker = COLORS[kind % len(COLORS)], MARKERS[kind % len(MARKERS)]
                seen = np.maximum(values, _LOWEST)
                axes.plot(
                    np.full(len(seen), at + 0.06), seen, ".", color=colour, markersize=3, alpha=0.6
                )
                _bars(axes, np.array([at]), [bootstrap_mean(values)], colour, marker, label)
    axes.set_xticks(range(len(groups)), groups)
    axes.set(ylabel="score [share of the span]", title=title, xlim=(-0.5, len(groups) - 0.5))
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    add_legend(figure, 3)
    save_figure(figure, path)


def chart(path: Path, evidence: Evidence) -> bool:
    """Draw what to do about an actuator that is late or short of voltage and nothing else, a panel for each task.

    A task on which nothing was trained through one thing alone is hatched.

    Returns:
        Whether anything could be drawn: the results of a task are all there.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    lags, lacks = np.geomspace(0.05, 8.0, 41), np.linspace(0.0, 0.8, 33)
    tasks = [
        task
        for task in SECONDS
        if all(evidence.loss(task, axis, 0.0) for axis in ("lag", "supply"))
    ]
    if not tasks:
        return False
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    panels: Any = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    none, seen = dict.fromkeys(AXES, 0.0), set[int]()
    for panel, task in zip(panels, tasks, strict=False):
        points = tested_points(evidence, task)
        regions = np.array(
            [
                [
                    list(_REGIONS).index(
                        decide(option_bounds(evidence, task, none | {"lag": lag, "supply": lack}, points))
                    )
                    for lag in lags
                ]
                for lack in lacks
            ]
        )
        seen.update(regions.flat)
        colours = ListedColormap(list(_REGIONS.values()))
        panel.pcolormesh(
            lags,
            1.0 - lacks,
            regions,
            cmap=colours,
            vmin=-0.5,
            vmax=len(_REGIONS) - 0.5,
            rasterized=True,
        )
        if task not in arms.TRAINED:
            panel.contourf(
                lags, 1.0 - lacks, regions, levels=[0.5, 99], colors="none", hatches=["//"]
            )
        panel.set(title=TITLES[task], xscale="log")
        panel.set_xticks([0.1, 0.3, 1.0, 3.0], ["0.1", "0.3", "1", "3"])
        panel.minorticks_off()
    for panel in panels[3:]:
        panel.set_xlabel(
            "time constant of the loop, a third of\nits settling time to 5 % [policy steps]"
        )
    for panel in panels[::3]:
        panel.set_ylabel("voltage there is [needed voltage]")
    shown = [one for number, one in enumerate(_REGIONS.items()) if number in seen]
    handles = [Patch(facecolor=colour, edgecolor="0.6", label=name) for name, colour in shown]
    handles.append(
        Patch(
            facecolor="white",
            edgecolor="0.4",
            hatch="//",
            label="trained through whole motors at most",
        )
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    save_figure(figure, path)
    return True


def _values(scores: Scores, trial: Trial) -> np.ndarray:
    return np.array(list(scores.by_seed(trial).values()))


def _bars(
    axes: Any, places: np.ndarray, means: Sequence[Any], colour: str, marker: str, label: str
) -> None:
    """Means with their intervals; what is below the figure is drawn at its edge."""
    middle = np.maximum([one.mean for one in means], _LOWEST)
    low = np.maximum(middle - np.maximum([one.low for one in means], _LOWEST), 0.0)
    high = np.maximum(np.maximum([one.high for one in means], _LOWEST) - middle, 0.0)
    axes.errorbar(places, middle, [low, high], fmt=marker, color=colour, ms=5, lw=1.2, label=label)
