"""The study's figures: dose and response, bars of what was trained on what, and what to do about an actuator."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actuator_study import arms
from actuator_study.questions import on_loop, on_motor
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.study.advice import BUY, IDEAL, LOOP, MEASURE, THROUGH, advise, decide
from codrl_mj.study.doses import AXES, SECONDS, at_home, dosed, ideal, matched, undosed
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.pages import COLOURS, MARKERS, TITLES, legend, save
from codrl_mj.study.questions import MARGIN, Scores
from codrl_mj.study.trials import Trial

_LOWEST = -0.1  # of the span; what is worse is as lost
_REGIONS = {IDEAL: "#d9f0e3", LOOP: "#dbe9f6", THROUGH: "#fdebc8", BUY: "#f6d5cc", MEASURE: "#eeeeee"}


def doses(path: Path, scores: Scores) -> None:
    """Draw what ideal-trained policies score over every axis, a panel each, a line for each task.

    Where it is trained through, what policies score there that were: a star in the task's colour.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    panels: Any = figure.subplots(2, 3, sharey=True).ravel()
    for panel, (name, axis) in zip(panels, AXES.items(), strict=True):
        for number, task in enumerate(SECONDS):
            colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
            trials = [undosed(ideal(task), name), *(dosed(ideal(task), name, x) for x in axis.doses[1:])]
            there = [(place, found) for place, one in enumerate(trials) if (found := _values(scores, one)).size]
            if there:
                means = [bootstrap_mean(found) for _, found in there]
                places = np.array([place for place, _ in there]) + 0.06 * (number - 2.5)
                panel.plot(places, [max(one.mean, _LOWEST) for one in means], color=colour, lw=1.3)
                _bars(panel, places, means, colour, marker, TITLES[task])
            if task in axis.trained:
                place = axis.doses.index(axis.trained[task]) + 0.06 * (number - 2.5)
                through = _values(scores, dosed(matched(task, name), name, axis.trained[task]))
                if through.size:
                    panel.plot(place, through.mean(), "*", color=colour, markersize=13, markeredgecolor="white")
        panel.set_xticks(range(len(axis.doses)), [f"{dose:g}" for dose in axis.doses])
        panel.set(xlabel=axis.unit, title=axis.title, ylim=(_LOWEST - 0.04, 1.12))
        panel.grid(axis="y", color="0.9")
        panel.set_axisbelow(True)
    for panel in panels[::3]:
        panel.set_ylabel("score [share of the span]")
    panels[-1].plot([], [], "*", color="0.4", markersize=12, label="trained through it")
    legend(figure, 4)
    save(figure, path)


def bars(path: Path, scores: Scores, groups: Mapping[str, Sequence[tuple[str, Trial]]], title: str) -> None:
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
                colour, marker = COLOURS[kind % len(COLOURS)], MARKERS[kind % len(MARKERS)]
                dots = np.maximum(values, _LOWEST)
                axes.plot(np.full(len(dots), at + 0.06), dots, ".", color=colour, markersize=3, alpha=0.6)
                _bars(axes, np.array([at]), [bootstrap_mean(values)], colour, marker, label)
    axes.set_xticks(range(len(groups)), groups)
    axes.set(ylabel="score [share of the span]", title=title, xlim=(-0.5, len(groups) - 0.5))
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    legend(figure, 3)
    save(figure, path)


def chart(path: Path, evidence: Evidence) -> bool:
    """Draw what to do about an actuator that is late or short of voltage and nothing else, a panel for each task.

    Returns:
        Whether anything could be drawn: the results of a task are all there.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from scipy.ndimage import distance_transform_edt

    lags, lacks = np.geomspace(0.05, 8.0, 120), np.linspace(0.0, 0.8, 81)
    tasks = [task for task in SECONDS if all(evidence.loss(task, axis, 0.0) for axis in ("lag", "supply"))]
    if not tasks:
        return False
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    panels: Any = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for panel, task in zip(panels, tasks, strict=False):
        late, short = (
            [found for dose in doses if (found := evidence.loss(task, axis, dose))]
            for axis, doses in (("lag", lags), ("supply", lacks))
        )
        regions = np.array([[list(_REGIONS).index(decide([one, other], [other])) for one in late] for other in short])
        colours = ListedColormap(list(_REGIONS.values()))
        panel.pcolormesh(lags, 1.0 - lacks, regions, cmap=colours, vmin=-0.5, vmax=4.5, rasterized=True)
        for number, name in enumerate(_REGIONS):  # in words too, for print without colours
            room = distance_transform_edt(np.pad(regions == number, 1))[1:-1, 1:-1]
            row, column = np.unravel_index(np.argmax(room), room.shape)
            if room[row, column] > 5:
                words = {"ha": "center", "va": "center", "fontsize": 7, "color": "0.25"}
                panel.text(lags[column], 1.0 - lacks[row], name.replace(" ", "\n", 1), **words)
        panel.set(title=TITLES[task], xscale="log")
        panel.set_xticks([0.1, 0.3, 1.0, 3.0], ["0.1", "0.3", "1", "3"])
        panel.minorticks_off()
    for panel in panels[3:]:
        panel.set_xlabel("time constant of the loop, a third of\nits settling time to 5 % [policy steps]")
    for panel in panels[::3]:
        panel.set_ylabel("voltage there is [needed voltage]")
    handles = [Patch(facecolor=colour, edgecolor="0.6", label=name) for name, colour in _REGIONS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
    save(figure, path)
    return True


def foretold(path: Path, scores: Scores, evidence: Evidence) -> None:
    """Draw what the bench and the doses foretell that ideal-trained policies lose, over what they lost in tests."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.4, 4.6), layout="constrained")
    axes: Any = figure.subplots()
    for number, task in enumerate(SECONDS):
        arm = ideal(task)
        home = _values(scores, at_home(arm))
        tested = [on_motor(arm, "good"), *([on_motor(arm, "marginal")] if task in arms.MARGINAL else [])]
        tested += [on_loop(arm, loop) for loop in ("weaker", "paper", "designed") if task in arms.LOOPED]
        for trial in tested:
            values, advice = _values(scores, trial), advise(trial.env.actuator, task, evidence)
            if values.size and advice.losses:
                at = min(float(np.mean(home) - np.mean(values)), 1.0)
                colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
                axes.plot(at, advice.lost.mean, marker, color=colour, label=TITLES[task])
                if max(at, advice.lost.mean) > MARGIN:
                    name = trial.test.removesuffix(" motor")
                    where = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 7}
                    axes.annotate(name, (at, advice.lost.mean), **where)
    axes.plot([-0.1, 1.05], [-0.1, 1.05], color="0.7", lw=1, zorder=0)
    axes.set(xlabel="lost in tests [share of the span]", ylabel="foretold by bench and doses")
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    legend(figure, 3)
    save(figure, path)


def _values(scores: Scores, trial: Trial) -> np.ndarray:
    return np.array(list(scores.of(trial).values()))


def _bars(axes: Any, places: np.ndarray, means: Sequence[Any], colour: str, marker: str, label: str) -> None:
    """Means with their intervals; what is below the figure is drawn at its edge."""
    middle = np.maximum([one.mean for one in means], _LOWEST)
    low = np.maximum(middle - np.maximum([one.low for one in means], _LOWEST), 0.0)
    high = np.maximum(np.maximum([one.high for one in means], _LOWEST) - middle, 0.0)
    axes.errorbar(places, middle, [low, high], fmt=marker, color=colour, ms=5, lw=1.2, label=label)
