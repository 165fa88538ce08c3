"""Page of the study: a table and a figure of all kinds of training, and the verdicts."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from actuator_study import questions as actuator_questions
from actuator_study.arms import DRAWN
from actuator_study.by_task import BY_TASK, RESTS, TaskVerdict, judge_by_task, rests_text
from actuator_study.figures import dots
from actuator_study.page import (
    HYPOTHESES,
    TRIALS,
    UNDECIDED,
    decided_table,
    effect_text,
    p_text,
    write_tables,
)
from actuator_study.units import THINGS, severity_text
from codrl_mj.study.axes import AXES, FLOORS, ideal_arm, ideal_trial
from codrl_mj.study.pages import (
    COLORS,
    TITLES,
    add_legend,
    markdown_table,
    read_conclusions,
    save_figure,
    write_csv,
    write_page,
)
from codrl_mj.study.questions import MARGIN, Scores, Verdict, judge
from codrl_mj.study.trials import FAILURE_MARGIN, RUNS, StudyResults, Trial, run_rows
from codrl_mj.tasks import find_task
from insurance_study.learning import LEARNING, learning_rows, still_rising
from insurance_study.questions import (
    KINDS,
    REMEMBERED,
    SEVERITIES,
    TASKS,
    home,
    needs_new_policies,
    primary,
    reach,
    secondary,
    trial_at,
    trials,
)

PAGE, FOLDER, FIGURE = "insurance.md", "insurance", "insured.svg"
"""The page, the folder beside it with its figure and tables, and the figure."""
KIND_NAMES: Mapping[str, str] = {
    "ideal": "ideal forces",
    "matched": "the same severity",
    "drawn": "the same effect, severity drawn (without delay, friction)",
    "remembering": "the same severity, observing the last commands (only lag, delay)",
    "random": "random actuators",
    "half": "random actuators, half the reach",
    "double": "random actuators, twice the reach",
    "pushes": "random pushes only",
    "strength": "random strength only",
}
"""Kind of training -> name on the page."""
SECTION_TITLES: Mapping[str, str] = {
    "insured": "at the trained severities",
    "home": "on ideal forces",
    "other doses": "at other severities",
}
"""Section of secondary questions, as in the published rows -> title on the page."""
PLANNED = 20
"""Number of policies of every kind that a verdict needs."""
_AXES: Mapping[str, Sequence[str]] = {"drawn": DRAWN, "remembering": REMEMBERED}


_SHOWN: Mapping[str, str] = {
    "ideal": "ideal forces",
    "matched": "the same severity",
    "drawn": "drawn",
    "random": "random",
    "double": "random, twice",
}
"""Kinds that are compared for every axis -> column name."""


class Summary(NamedTuple):
    """Results of a kind of policies in some tests, a value for each policy and test."""

    scores: np.ndarray
    success: np.ndarray

    @property
    def text(self) -> str:
        """Mean, median, number of failures, and success."""
        return (
            self._format(f", {np.median(self.scores):z.2f}", f" of {self.scores.size}")
            if self.scores.size
            else "–"
        )

    @property
    def short(self) -> str:
        """Mean, number of failures, and success."""
        return self._format("", "") if self.scores.size else "–"

    def _format(self, median: str, tests: str) -> str:
        failed, success = np.sum(self.scores < 1.0 - FAILURE_MARGIN), np.mean(self.success)
        return f"{np.mean(self.scores):z.2f}{median}; {failed}{tests}; {100 * success:.0f} %"


def summarize(collected: StudyResults, scores: Scores, trials: Iterable[Trial]) -> Summary:
    """Summarize the results of every policy in every trial."""
    pairs: list[tuple[float, float]] = []
    for trial in trials:
        success = collected.scores(trial, "success")
        pairs += [
            (score, success.get(seed, np.nan)) for seed, score in scores.by_seed(trial).items()
        ]
    values = np.reshape(pairs, (-1, 2))
    return Summary(values[:, 0], values[:, 1])


def write(collected: StudyResults, out: Path) -> list[Path]:
    """Write page, figures and tables; missing results are named on the page.

    Returns:
            Files that were written.
    """
    folder = out / FOLDER
    scores = Scores(collected, FLOORS, [ideal_trial(ideal_arm(task)) for task in TASKS])
    primary_verdicts = judge(scores, primary(), primary=True, min_policies=PLANNED)
    secondary_verdicts = judge(scores, secondary(), min_policies=PLANNED)
    by_task = judge_by_task(scores, primary_verdicts, min_policies=PLANNED)
    rows = _run_rows(collected, scores)
    tables = write_tables(
        folder, collected, scores, rows, primary_verdicts, secondary_verdicts, by_task
    )
    spans = {task: ceiling - FLOORS[task] for task, ceiling in scores.ceilings.items()}
    learned = learning_rows(collected, folder / LEARNING)
    write_csv(folder / LEARNING, learned)
    draw(folder / FIGURE, scores)
    parts = [
        "# What makes a policy robust to its motor?\n",
        read_conclusions(out / PAGE),
        _things(collected, scores),
        f"![Scores by kind of training]({FOLDER}/{FIGURE})\n",
        _task_verdicts(by_task),
        _secondary(secondary_verdicts),
        _verdicts(primary_verdicts, by_task),
        _kinds(collected, scores),
        _method(collected, rows, *still_rising(learned, spans, MARGIN)),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, folder / FIGURE, folder / LEARNING, *tables]


def _things(collected: StudyResults, scores: Scores) -> str:
    """Return a table for each task: a row for each axis, results of the kinds to choose from."""
    tables = []
    for task in TASKS:
        rows = []
        for axis, thing in THINGS.items():
            kinds = {
                kind: KINDS[kind](task, axis) for kind in _SHOWN if axis in _AXES.get(kind, AXES)
            }
            summaries = {
                kind: summarize(collected, scores, [trial_at(trained, axis)])
                for kind, trained in kinds.items()
            }
            means = {
                kind: np.mean(summary.scores)
                for kind, summary in summaries.items()
                if summary.scores.size
            }
            # Random actuators draw these axes; the weakness may go both ways.
            drawn_axes = {"lag": "", "delay": "", "weakness": "±"}
            drawn_to = (
                f" ({drawn_axes[axis]}{severity_text(task, axis, reach(task, axis))})"
                if axis in drawn_axes
                else ""
            )
            cells = [f"{thing} {severity_text(task, axis, SEVERITIES[task][axis])}{drawn_to}"]
            for kind in _SHOWN:
                text = summaries[kind].short.replace(" ", "\u00a0") if kind in summaries else "–"
                cells.append(
                    f"**{text}**" if kind in means and means[kind] == max(means.values()) else text
                )
            rows.append(cells)
        title = f"{TITLES[task]}, a step of {1000 * find_task(task).step_duration:g} ms"
        tables.append(markdown_table([title, *_SHOWN.values()], rows))
    margin = FAILURE_MARGIN
    text = f"""Look for the row that is closest to your case. A cell has the mean score, where 1 is the mean of
ideal-trained policies on ideal forces and 0 that of random actions; the number of {PLANNED} policies that fail, because
they lose more than {margin:g}; and the share of successful episodes. The highest mean is bold. *Random* actuators draw
strength, lag and delay for every episode, and push. Their reach is given in brackets; *random, twice* reaches twice as
far. *The same severity* trains on the tested severity. *Drawn* draws the severity of this one effect from zero to twice
the tested one, at most 70 % for forces and voltages. A force is a share of the largest one, or in N·m. A voltage is a
share of [the voltage that the task needs](plan.md#severities)."""
    return f"""## Results by kind of training

{textwrap.fill(" ".join(text.split()), 120, break_long_words=False)}

{chr(10).join(tables)}"""


def _kinds(collected: StudyResults, scores: Scores) -> str:
    rows = []
    for kind, name in KIND_NAMES.items():
        cells = [name]
        for task in TASKS:
            axes = list(_AXES.get(kind, AXES))
            tests = [trial_at(KINDS[kind](task, axis), axis) for axis in axes]
            home_trials = {
                trial.name: trial for axis in axes for trial in [home(KINDS[kind](task, axis))]
            }
            home_scores = summarize(collected, scores, home_trials.values()).scores
            cells.append(f"{np.mean(home_scores):z.2f}" if home_scores.size else "–")
            cells.append(summarize(collected, scores, tests).text)
        rows.append(cells)
    header = [
        "trained on",
        *(text for task in TASKS for text in (f"{TITLES[task]}: ideal", "six severities")),
    ]
    return f"""## Means over all effects

The columns *ideal* have the mean score on ideal forces. The columns *six severities* pool the severities of the tables
above, or those of the named effects. They have the mean and the median score, the number of failed tests, and the
success. One test is one policy at one severity. These means hide large differences: compare the rows above first.

{markdown_table(header, rows)}"""


def draw(path: Path, scores: Scores) -> None:
    """Draw the scores at the trained severities, a panel for each task, a dot for each policy."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.4), layout="constrained")
    panels: Any = figure.subplots(len(TASKS), 1, sharey=True)
    # Kind -> index of its color.
    shown = {
        "ideal": 0,
        "random": 1,
        "drawn": 2,
        "matched": 3,
        "remembering": 4,
        "pushes": 5,
    }
    for panel, task in zip(panels, TASKS, strict=True):
        for axis_index, axis in enumerate(AXES):
            for number, kind in enumerate(kind for kind in KIND_NAMES if kind in shown):
                if axis in _AXES.get(kind, AXES):
                    values = list(scores.by_seed(trial_at(KINDS[kind](task, axis), axis)).values())
                    if values:
                        dots(
                            panel,
                            axis_index + 0.14 * (number - 2.5),
                            values,
                            COLORS[shown[kind]],
                            KIND_NAMES[kind],
                        )
        severities = [
            f"{thing} {severity_text(task, name, SEVERITIES[task][name])}"
            for name, thing in THINGS.items()
        ]
        panel.set_xticks(range(len(AXES)), severities)
        panel.set(title=TITLES[task], ylabel="score [share of the span]")
        panel.grid(axis="y", color="0.9")
        panel.set_axisbelow(True)
    add_legend(figure, 3)
    save_figure(figure, path)


def _task_verdicts(by_task: Sequence[TaskVerdict]) -> str:
    """Return the section with the verdict on every hypothesis on every task."""
    statements: dict[str, list[str]] = {}
    for verdict in by_task:
        question = verdict.question
        statements.setdefault(f"{question.name} | {question.statement}", []).append(verdict.text)
    header = ["", "hypothesis", *(TITLES[task] for task in TASKS)]
    rows = [[*name.split(" | "), *texts] for name, texts in statements.items()]
    return f"""## Task by task

The ten hypotheses of the plan, each on one task. A cell has the verdict and the difference of the mean scores with its
95 % interval. The plan has only the verdicts [that pool the tasks](insurance.md#the-ten-hypotheses). These {len(by_task)}
were added later; their false discovery rate is 5 %. *The other way* means a decided difference of the opposite sign.

{markdown_table(header, rows)}"""


def _verdicts(verdicts: Sequence[Verdict], by_task: Sequence[TaskVerdict]) -> str:
    rows = []
    for verdict in verdicts:
        name, statement = verdict.question.name, verdict.question.statement
        tested, planned = verdict.strata
        if tested < planned:
            statement += f" ({tested} of {planned} comparisons have runs)"
        judged = [
            verdict.outcome,
            effect_text(verdict),
            p_text(verdict.corrected_p),
            rests_text(name, by_task),
        ]
        rows.append([name, *judged, str(min(verdict.runs)), statement])
    header = ["", "holds", "effect [95 %]", "corrected p", "rests on", "policies", "hypothesis"]
    return f"""## The ten hypotheses

The verdicts of the plan, pooled over the three tasks. A hypothesis is judged only with {PLANNED} policies of every kind.
{RESTS}

{markdown_table(header, rows)}"""


def _secondary(verdicts: Sequence[Verdict]) -> str:
    if all(np.isnan(verdict.p) for verdict in verdicts):
        return f"The {len(verdicts)} secondary comparisons, each of one task, are not judged yet.\n"
    return f"""All secondary comparisons of the plan are of one task and one severity each. Their false discovery rate is 5 %.
{UNDECIDED}

{decided_table(verdicts, SECTION_TITLES)}"""


def _run_rows(collected: StudyResults, scores: Scores) -> list[dict[str, object]]:
    """Return a row for every policy and test, with a mark for retrained policies."""
    # Rows of trials that the first study has are its own.
    first = {trial.name for trial in actuator_questions.trials()}
    again = {trial.name for trial in trials() if not needs_new_policies(trial)} - first
    return [
        row | {"trained_again": f"{row['task']}: {row['trained']} on {row['tested']}" in again}
        for row in run_rows(collected, scores.by_seed)
    ]


def _method(
    collected: StudyResults, rows: Sequence[Mapping[str, object]], rising: Sequence[str], count: int
) -> str:
    totals, num_planned = collected.totals, len(collected.grid.cells)
    num_tested = sum(map(len, collected.evaluations.values()))
    num_tests = len(collected.grid.policy_tests)
    new = {trial.arm.name for trial in trials() if needs_new_policies(trial)}
    num_new = sum(name in new for name, _ in collected.folders)
    again = [row for row in rows if row["trained_again"]]
    num_again = len({row["run"] for row in again})
    text = f"""The study follows [its plan](insurance_plan.md), with the scores and tests of [the first
study](actuators.md). It has {num_tested} of {num_tests} tests of {num_planned} policies. {num_new} of these policies
were trained for it, and {num_again} of the first study were trained again. The time of {sum(totals.codes.values())} of
these {num_new + num_again} trainings is known: {totals.seconds / 3600:.1f} hours of one core.
`scripts/study_insurance.py` ([how](../studies.md)) writes this page and five tables: [policies]({FOLDER}/{RUNS}),
[trials]({FOLDER}/{TRIALS}) with medians and failures, [comparisons]({FOLDER}/{HYPOTHESES}),
[hypotheses by task]({FOLDER}/{BY_TASK}), and [mean returns in each tenth of a training]({FOLDER}/{LEARNING}). Of
{count} kinds of training {len(rising)} had not leveled off ({"; ".join(rising) or "none"}). Their mean return in the last
tenth is more than {MARGIN:g} of the span above that in the eighth."""
    repeated = f"""{RUNS} marks the {len(again)} rows of the {num_again} retrained policies in the column `trained_again`.
Their runs have the same names as those of the first study, but they are [other policies](insurance_plan.md#changes): a
comparison of a score at the trained severity with one elsewhere compares two policies. Their own scores at the trained
severity were not kept, so that it cannot be checked if the two sets agree there."""
    paragraphs = (
        textwrap.fill(" ".join(part.split()), 120, break_long_words=False)
        for part in (text, repeated)
    )
    return "\n\n".join(["## How it was measured", *paragraphs]) + "\n"
