"""The page of what insures a policy: a table and a figure of all kinds of training, and the verdicts."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from actuator_study.arms import DRAWN
from actuator_study.figures import dots
from actuator_study.page import (
    HYPOTHESES,
    TRIALS,
    decided_table,
    effect_text,
    p_text,
    write_tables,
)
from actuator_study.units import THINGS, dose_text
from codrl_mj.study.axes import AXES, FLOORS, ideal_trial, ideal
from codrl_mj.study.pages import (
    COLORS,
    TITLES,
    read_conclusions,
    add_legend,
    markdown_table,
    save_figure,
    write_csv,
    write_page,
)
from codrl_mj.study.questions import MARGIN, Scores, Verdict, judge
from codrl_mj.study.trials import FAILURE_MARGIN, RUNS, Collected, Trial
from codrl_mj.tasks import find_task
from insurance_study.learning import LEARNING, learning_rows, still_rising
from insurance_study.questions import (
    DOSES,
    KINDS,
    REMEMBERED,
    TASKS,
    home,
    primary,
    reach,
    secondary,
    under,
)

PAGE, FOLDER, FIGURE = "insurance.md", "insurance", "insured.svg"
"""The page, the folder beside it with its figure and tables, and the figure."""
SAYS: Mapping[str, str] = {
    "ideal": "ideal forces",
    "matched": "the very dose",
    "drawn": "the very thing, drawn (without delay, friction)",
    "remembering": "the very dose, seeing its last commands (lag, delay alone)",
    "random": "random actuators",
    "half": "random actuators, half the reach",
    "double": "random actuators, twice the reach",
    "pushes": "random pushes alone",
    "strength": "random strength alone",
}
"""What policies of each kind were trained on."""
PLANNED = 20
"""Policies of every kind, without which nothing is judged."""
_AXES: Mapping[str, Sequence[str]] = {"drawn": DRAWN, "remembering": REMEMBERED}


_SHOWN: Mapping[str, str] = {
    "ideal": "ideal forces",
    "matched": "the very dose",
    "drawn": "drawn",
    "random": "random",
    "double": "random, twice",
}
"""Kinds that stand beside each other for every thing, and the columns' names."""


class Found(NamedTuple):
    """What policies of a kind came to in some tests, a number for each policy and test."""

    scores: np.ndarray
    success: np.ndarray

    @property
    def text(self) -> str:
        """Mean, median, how many fail, success."""
        return (
            self._told(f", {np.median(self.scores):z.2f}", f" of {self.scores.size}")
            if self.scores.size
            else "–"
        )

    @property
    def short(self) -> str:
        """Mean, how many fail, success."""
        return self._told("", "") if self.scores.size else "–"

    def _told(self, median: str, tests: str) -> str:
        failed, success = np.sum(self.scores < 1.0 - FAILURE_MARGIN), np.mean(self.success)
        return f"{np.mean(self.scores):z.2f}{median}; {failed}{tests}; {100 * success:.0f} %"


def found(collected: Collected, scores: Scores, trials: Iterable[Trial]) -> Found:
    """Of every policy in every trial."""
    both: list[tuple[float, float]] = []
    for trial in trials:
        success = collected.scores(trial, "success")
        both += [(score, success.get(seed, np.nan)) for seed, score in scores.by_seed(trial).items()]
    values = np.reshape(both, (-1, 2))
    return Found(values[:, 0], values[:, 1])


def write(collected: Collected, out: Path) -> list[Path]:
    """Write page, figure and tables; whatever is missing is named on the page.

    Returns:
        The files that were written.
    """
    folder, scores = (
        out / FOLDER,
        Scores(collected, FLOORS, [ideal_trial(ideal(task)) for task in TASKS]),
    )
    first = judge(scores, primary(), primary=True, min_policies=PLANNED)
    others = judge(scores, secondary(), min_policies=PLANNED)
    tables = write_tables(folder, collected, scores, first, others)
    spans = {task: ceiling - FLOORS[task] for task, ceiling in scores.ceilings.items()}
    learned = learning_rows(collected, folder / LEARNING)
    write_csv(folder / LEARNING, learned)
    draw(folder / FIGURE, scores)
    parts = [
        "# What insures a policy?\n",
        read_conclusions(out / PAGE),
        _things(collected, scores),
        _kinds(collected, scores),
        f"![Scores by what policies were trained on]({FOLDER}/{FIGURE})\n",
        _verdicts(first, scores),
        _secondary(others),
        _method(collected, *still_rising(learned, spans, MARGIN)),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, folder / FIGURE, folder / LEARNING, *tables]


def _things(collected: Collected, scores: Scores) -> str:
    """A table a task, a row for every thing: what policies of the kinds that an owner chooses between come to there."""
    tables = []
    for task in TASKS:
        rows = []
        for axis, thing in THINGS.items():
            kinds = {
                kind: KINDS[kind](task, axis) for kind in _SHOWN if axis in _AXES.get(kind, AXES)
            }
            there = {
                kind: found(collected, scores, [under(trained, axis)])
                for kind, trained in kinds.items()
            }
            means = {kind: np.mean(one.scores) for kind, one in there.items() if one.scores.size}
            far = {"lag": "", "delay": "", "weakness": "±"}  # what random actuators draw
            drawn_to = (
                f" ({far[axis]}{dose_text(task, axis, reach(task, axis))})" if axis in far else ""
            )
            cells = [f"{thing} {dose_text(task, axis, DOSES[task][axis])}{drawn_to}"]
            for kind in _SHOWN:
                text = there[kind].short.replace(" ", "\u00a0") if kind in there else "–"
                cells.append(
                    f"**{text}**" if kind in means and means[kind] == max(means.values()) else text
                )
            rows.append(cells)
        title = f"{TITLES[task]}, a step of {1000 * find_task(task).step_duration:g} ms"
        tables.append(markdown_table([title, *_SHOWN.values()], rows))
    text = f"""Look for what is most like yours. Mean score, 1 being ideal-trained policies on ideal forces and 0 random
actions; how many of {PLANNED} policies fail, by losing more than {FAILURE_MARGIN:g}; how often episodes succeed. The highest
mean is bold. *Random* actuators draw strength, lag and delay for every episode, and push; they reach as far as is said
in brackets, or twice as far. *The very dose* is what it is tested on; *drawn* is that one thing alone, from none
to twice as much, of forces and voltages at most 70 %. Forces are shares of the largest one, or N·m; voltages are shares
of [what the task needs](plan.md#doses)."""
    return f"""## What each kind of training comes to

{textwrap.fill(" ".join(text.split()), 120, break_long_words=False)}

{chr(10).join(tables)}"""


def _kinds(collected: Collected, scores: Scores) -> str:
    rows = []
    for kind, says in SAYS.items():
        cells = [says]
        for task in TASKS:
            axes = list(_AXES.get(kind, AXES))
            there = [under(KINDS[kind](task, axis), axis) for axis in axes]
            at = {trial.name: trial for axis in axes for trial in [home(KINDS[kind](task, axis))]}
            lost = found(collected, scores, at.values()).scores
            cells.append(f"{np.mean(lost):z.2f}" if lost.size else "–")
            cells.append(found(collected, scores, there).text)
        rows.append(cells)
    header = [
        "trained on",
        *(text for task in TASKS for text in (f"{TITLES[task]}: ideal", "six doses")),
    ]
    return f"""## Every kind of training, on the mean

Mean score on ideal forces. Then on the six doses above, or those of them that are named: mean, median; how many tests
failed, a policy's on a dose each; success. The six hide much: compare rows above first.

{markdown_table(header, rows)}"""


def draw(path: Path, scores: Scores) -> None:
    """Draw what policies score at the trained doses, a panel a task, by what they were trained on; every one a dot."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.4), layout="constrained")
    panels: Any = figure.subplots(len(TASKS), 1, sharey=True)
    shown = {
        "ideal": 0,
        "random": 1,
        "drawn": 2,
        "matched": 3,
        "remembering": 4,
        "pushes": 5,
    }  # colours of the kinds
    for panel, task in zip(panels, TASKS, strict=True):
        for place, axis in enumerate(AXES):
            for number, kind in enumerate(kind for kind in SAYS if kind in shown):
                if axis in _AXES.get(kind, AXES):
                    values = list(scores.by_seed(under(KINDS[kind](task, axis), axis)).values())
                    if values:
                        dots(
                            panel,
                            place + 0.14 * (number - 2.5),
                            values,
                            COLORS[shown[kind]],
                            SAYS[kind],
                        )
        doses = [
            f"{thing} {dose_text(task, name, DOSES[task][name])}" for name, thing in THINGS.items()
        ]
        panel.set_xticks(range(len(AXES)), doses)
        panel.set(title=TITLES[task], ylabel="score [share of the span]")
        panel.grid(axis="y", color="0.9")
        panel.set_axisbelow(True)
    add_legend(figure, 3)
    save_figure(figure, path)


def _verdicts(verdicts: Sequence[Verdict], scores: Scores) -> str:
    rows = []
    for verdict in verdicts:
        says = verdict.question.statement
        tested, wanted = verdict.strata
        if tested < wanted:
            says += f" ({tested} of {wanted} comparisons have runs)"
        judged = [
            verdict.outcome,
            effect_text(verdict),
            _by_task(verdict, scores),
            p_text(verdict.corrected_p),
        ]
        rows.append([verdict.question.name, *judged, str(min(verdict.runs)), says])
    header = ["", "holds", "effect [95 %]", "by task", "corrected p", "policies", "says"]
    return f"""## The ten hypotheses

Nothing is judged before there are {PLANNED} policies of every kind. Tasks: {_TASKS}.

{markdown_table(header, rows)}"""


_TASKS = ", ".join(TITLES[task] for task in TASKS)


def _by_task(verdict: Verdict, scores: Scores) -> str:
    """The mean effect on each task, of the contrasts that have runs."""
    texts = []
    for task in TASKS:
        pairs = [
            pair
            for pair in verdict.question.contrasts
            if pair.treatment.arm.task == task and scores.stratum([pair])
        ]
        stratum = scores.stratum(pairs) if pairs else None
        texts.append(
            "–" if stratum is None else f"{np.mean(stratum.treatment) - np.mean(stratum.control):+.2f}"
        )
    return ", ".join(texts)


def _secondary(verdicts: Sequence[Verdict]) -> str:
    titles = {one.question.section: one.question.section for one in verdicts}
    if all(np.isnan(one.p) for one in verdicts):
        return f"The {len(verdicts)} others, each of one task, are not judged yet either.\n"
    return f"""Others, each of one task, with a false discovery rate of 5 %:

{decided_table(verdicts, titles)}"""


def _method(collected: Collected, rising: Sequence[str], count: int) -> str:
    totals, wanted = collected.totals, len(collected.grid.cells)
    done, tests = sum(map(len, collected.evaluations.values())), len(collected.grid.deployments)
    text = f"""By [the plan](insurance_plan.md), scores and tests as in [what an actuator costs](actuators.md). {done}
of {tests} tests of {wanted} policies are there ({totals.seconds / 3600:.1f} hours of one core at hand).
`scripts/study_insurance.py` ([how](../studies.md)) writes this page, [every
policy]({FOLDER}/{RUNS}), [trials]({FOLDER}/{TRIALS}) with medians and
failures, [every comparison]({FOLDER}/{HYPOTHESES}), and [what was returned in tenths of the
training]({FOLDER}/{LEARNING}). Of {count} kinds of training {len(rising)} had not levelled off
({"; ".join(rising) or "none"}): in their last tenth they return more than in the eighth, on the mean by more than
{MARGIN:g} of the span."""
    return (
        "## How it was measured\n\n"
        + textwrap.fill(" ".join(text.split()), 120, break_long_words=False)
        + "\n"
    )
