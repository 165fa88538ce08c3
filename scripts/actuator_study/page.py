"""Page of the study: the verdict on each preregistered hypothesis, and the figures."""

import collections
import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actuator_study import advised, arms, figures
from actuator_study.by_task import BY_TASK, RESTS, TaskVerdict, judge_by_task, rests_text
from actuator_study.questions import (
    on_loop,
    on_motor,
    primary,
    secondary,
    through_loop,
    through_motor,
)
from actuator_study.units import THINGS, scale, severity_text, short, size
from codrl_mj.runs.files import write_json
from codrl_mj.study.advice import IDEAL, THROUGH
from codrl_mj.study.axes import AXES, FLOORS, SECONDS, ideal_arm, ideal_trial
from codrl_mj.study.evidence import STUDIES, Evidence, Outcome
from codrl_mj.study.inference import detectable_difference
from codrl_mj.study.pages import TITLES, markdown_table, read_conclusions, write_csv, write_page
from codrl_mj.study.questions import LEVEL, MARGIN, Scores, Verdict, judge
from codrl_mj.study.trials import (
    FAILURE_MARGIN,
    RUNS,
    TOTALS,
    StudyResults,
    Trial,
    run_rows,
    trial_rows,
)

PAGE, FOLDER = "actuators.md", "actuators"
"""The page, and the folder beside it with its figures and tables."""
TRIALS, HYPOTHESES, ADVISED = "trials.csv", "hypotheses.csv", "advised.csv"
"""Tables with a row for every trial, for every question, and for every actuator of `advise`."""
QUESTIONS: Mapping[str, str] = {
    "matters": "When does an actuator matter?",
    "tune": "Tune the loop, or train through it?",
    "wrong": "A wrong model",
    "motors": "Off-the-shelf motors",
    "command": "What should the policy command and see?",
}
"""Titles of the sections of questions, by name."""


def write(collected: StudyResults, out: Path) -> list[Path]:
    """Write page, figures and tables.

    Args:
        collected: results of the study; missing ones are named on the page.
        out: folder of the page.

    Returns:
        Files that were written.
    """
    folder = out / FOLDER
    scores = Scores(collected, FLOORS, [ideal_trial(ideal_arm(task)) for task in SECONDS])
    primary_verdicts = judge(scores, primary(), primary=True)
    secondary_verdicts = judge(scores, secondary())
    by_task = judge_by_task(scores, primary_verdicts)
    rows = list(run_rows(collected, scores.by_seed))
    tables = write_tables(
        folder, collected, scores, rows, primary_verdicts, secondary_verdicts, by_task
    )
    evidence = Evidence.read(*(path for study in STUDIES if (path := out / study / RUNS).is_file()))
    advice_rows = list(advised.rows(evidence))
    write_csv(folder / ADVISED, advice_rows)
    drawn = _draw(scores, evidence, folder)
    parts = [
        "# What does an actuator cost?\n",
        read_conclusions(out / PAGE),
        _tolerated(evidence, drawn),
        _compare_trainings(drawn),
        _motors(evidence, drawn),
        _advised(evidence, advice_rows, drawn),
        _verdicts(primary_verdicts, secondary_verdicts, by_task),
        _secondary(secondary_verdicts, drawn),
        _method(collected, scores),
        _missing(collected),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, *drawn.values(), *tables, folder / ADVISED]


def write_tables(
    folder: Path,
    collected: StudyResults,
    scores: Scores,
    rows: Sequence[Mapping[str, object]],
    primary_verdicts: Sequence[Verdict],
    secondary_verdicts: Sequence[Verdict],
    by_task: Sequence[TaskVerdict],
) -> list[Path]:
    """Write the tables: policies by test, trials, questions, and the cost of the trainings."""
    tables: dict[str, Iterable[Mapping[str, object]]] = {
        RUNS: rows,
        TRIALS: trial_rows(collected, scores.by_seed),
        HYPOTHESES: (
            verdict.row(len(primary_verdicts))
            for verdict in (*primary_verdicts, *secondary_verdicts)
        ),
        BY_TASK: (verdict.row for verdict in by_task),
    }
    for name, table in tables.items():
        write_csv(folder / name, list(table))
    write_json(folder / TOTALS, collected.totals._asdict())
    return [folder / name for name in (*tables, TOTALS)]


def _draw(scores: Scores, evidence: Evidence, folder: Path) -> dict[str, Path]:
    """Draw the figures; return their paths by name, without those that have no data."""
    # Names of files are published and stay.
    drawers = {"losses": figures.losses, "insured": figures.trainings, "chart": figures.chart}
    paths = {
        name: path
        for name, draw in drawers.items()
        if draw(path := folder / f"{name}.svg", evidence)
    }
    paths |= {name: folder / f"{name}.svg" for name in ("tune", "motors")}
    loops: dict[str, list[tuple[str, Trial]]] = {
        f"{TITLES[task]},\n{loop}": [
            ("ideal-trained", on_loop(ideal_arm(task), loop)),
            ("trained through it", on_loop(through_loop(task, loop), loop)),
        ]
        for task in arms.LOOPED
        for loop in ("weaker", "paper", "designed")
    }
    figures.bars(paths["tune"], scores, loops, "The paper's motor under three loops")
    motors: dict[str, list[tuple[str, Trial]]] = {}
    for task in SECONDS:
        home = ideal_arm(task)
        motors[TITLES[task].replace("Continuous ", "Continuous\n")] = [
            ("ideal-trained, on ideal forces", ideal_trial(home)),
            ("ideal-trained, on the good motor", on_motor(home, "good")),
            *(
                [
                    ("ideal-trained, on the marginal motor", on_motor(home, "marginal")),
                    (
                        "trained through the marginal motor",
                        on_motor(through_motor(task), "marginal"),
                    ),
                ]
                if task in arms.MARGINAL
                else []
            ),
        ]
    figures.bars(paths["motors"], scores, motors, "Motors of the catalog")
    return paths


def _figure(drawn: Mapping[str, Path], name: str, caption: str) -> str:
    return f"![{caption}]({FOLDER}/{drawn[name].name})\n" if name in drawn else ""


def _tolerated(evidence: Evidence, drawn: Mapping[str, Path]) -> str:
    """Return the section on tolerated severities, in a task's units, with the map of all losses."""
    rows = []
    for task in SECONDS:
        rows.append([f"{TITLES[task]}: {size(task)}"])
        for name, axis in AXES.items():
            known = [
                (severity, loss.outcome)
                for severity in axis.severities[1:]
                if (loss := evidence.loss(task, name, severity))
            ]
            # Only severities below the first harmful one count. Later ones are ignored.
            harmless = [
                severity
                for severity, _ in itertools.takewhile(lambda pair: pair[1].is_negligible, known)
            ]
            harmful = next(
                ((severity, outcome) for severity, outcome in known if outcome.is_harmful), None
            )
            factor, unit_text = scale(task, name)
            text = f"≤{short(factor * harmless[-1] if harmless else 0.0)}"
            if harmful is not None:
                text += (
                    f", ≥{short(factor * harmful[0])} {unit_text}"
                    f" ({round(harmful[1].failed * len(harmful[1].lost))})"
                )
            else:
                text += f" {unit_text}"
            rows[-1].append(text if known else "–")
    margin = FAILURE_MARGIN
    return f"""## What policies tolerate

Severities up to the first number are harmless: ideal-trained policies lose at most {MARGIN:g} of the score on average,
the confidence interval ends at or below {margin:g}, at most a tenth of the policies fail, and at most a tenth of the success is
lost. Severities from the second number on hurt: the whole interval of the loss is above {margin:g}, or that of the lost
success is above a tenth. The number in brackets says how many of 20 policies fail there, because they lose more than
{margin:g}. Between the two numbers, measure.

*Lag* is a time constant: a loop of bandwidth f has 1/(2 π f). *Missing force* is the share that a gear loses. *Friction*
brakes at any command. *Missing voltage* is a share of [the voltage that the task needs](plan.md#severities). It is
missing all the time, under a loop with anti-windup. Without anti-windup 35 % ruins four of 20 policies on Furuta. Each
effect was tested separately.

{markdown_table(["task: policy step, largest force", *THINGS.values()], rows)}
{_figure(drawn, "losses", "Losses of ideal-trained policies, by task and severity")}"""


def _compare_trainings(drawn: Mapping[str, Path]) -> str:
    if "insured" not in drawn:
        return ""
    rows = [
        [
            TITLES[task],
            *(
                severity_text(task, name, axis.training_severity[task])
                for name, axis in AXES.items()
            ),
        ]
        for task in arms.TRAINED
    ]
    return f"""## Train through it, or randomize?

Every column has twenty policies. They are tested at a single severity of each effect, which was chosen to hurt. Larger
severities were not tested: measure.

{markdown_table(["trained and tested at", *THINGS.values()], rows)}
*Random actuators* draw strength, lag, delay and pushes. These cover three of the six effects. On Pendulum they reach the
tested lag, and 0.8 of the tested two steps of delay. On Furuta they reach four times the lag and 1.6 times the delay.

{_figure(drawn, "insured", "Scores by kind of training")}"""


def _motors(evidence: Evidence, drawn: Mapping[str, Path]) -> str:
    """Return the section on motors: for each motor and task, loss, failures and success."""
    rows = []
    for task in SECONDS:
        for test, (name, _) in advised.tested(task).items():
            if test.endswith("motor"):
                prospects = advised.measured(evidence, task, test)
                cells = [
                    _lost(prospects[kind].upper) if kind in prospects else "–"
                    for kind in (IDEAL, THROUGH)
                ]
                rows.append([TITLES[task], name, test.removesuffix(" motor"), *cells])
    header = ["task", "motor, gear", "", "trained on ideal forces", "trained through it"]
    return f"""## Off-the-shelf motors

A cell has the lost score with its interval, the number of 20 policies that fail, and the lost success. *Good* is the smallest motor that
`codrl-mj motor choose` found sufficient, and *marginal* is one for which it answered `try it`. On the cars, friction of
the good motor takes an eighth of the largest force. `motor choose` now allows only a twentieth.

{markdown_table(header, rows)}
{_figure(drawn, "motors", "Scores on motors of the catalog")}"""


def _lost(outcome: Outcome | None) -> str:
    if outcome is None:
        return "–"
    mean, low, high = outcome.loss
    count = len(outcome.lost)
    failed = (
        f"{round(outcome.failed * count)}"
        if count == 20
        else f"{round(outcome.failed * count)} of {count}"
    )
    return (
        f"{mean:z.2f} [{low:z.2f}, {high:z.2f}]; {failed}; {100 * outcome.success_lost.mean:z.0f} %"
    )


_JUDGED: Mapping[str, str] = {
    "right": "right",
    "wrong": "wrong",
    "not tested": "not tested",
    "says nothing": "*measure it*",
}
"""Judgment of an answer of `advise` -> title of its column."""


def _advised(
    evidence: Evidence, advice_rows: Sequence[Mapping[str, Any]], drawn: Mapping[str, Path]
) -> str:
    """Return the section on the accuracy of `codrl-mj advise` on every tested actuator."""
    if not advice_rows:
        return ""
    rows = []
    for row in advice_rows:
        if row["judged"] != "right":
            numbers = (
                f"{'≥ ' * row['beyond']}{'≤ ' * row['at_most']}{row['predicted_mean']:z.2f}",
                f"{row['measured_mean']:z.2f}",
            )
            rows.append(
                [TITLES[row["task"]], row["actuator"], *numbers, row["said"], row["measured"]]
            )
    exact = [row for row in advice_rows if not row["at_most"]]
    errors = [abs(row["predicted_mean"] - row["measured_mean"]) for row in exact]
    large = [
        error for error, row in zip(errors, exact, strict=True) if row["measured_mean"] > MARGIN
    ] or [0.0]
    judgments: dict[str, list[tuple[str, str]]] = {
        kind: [(row["said"], row["judged"]) for row in advice_rows if row["kind"] == kind]
        for kind in advised.KINDS
    }
    judgments["severities of one effect"] = list(advised.severity_judgments(evidence))
    counts = []
    for kind, answers in judgments.items():
        judged = collections.Counter(judgment for _, judgment in answers)
        counts.append([f"{len(answers)} {kind}", *(f"{judged[name]}" for name in _JUDGED)])
    right = collections.Counter(row["said"] for row in advice_rows if row["judged"] == "right")
    silent = [row for row in advice_rows if row["judged"] == "says nothing"]
    cars = [row for row in silent if row["task"].startswith("mountain_car")]
    left = advised.left_out(evidence)
    header = ["task", "actuator", "predicted", "measured", "advise says", "measurement says"]
    text = f"""We asked `codrl-mj advise` ([how](../advise.md)) about all {len(advice_rows)} actuators that were tested and
are not a severity of one effect, without the measurements on the actuator itself, and about each severity without its tests.
An answer is *right* if the measured losses lead to it by the same rule. *Wrong* includes a remedy where nothing is
lost. *Not tested* is a remedy without rows there. The right answers on actuators are
{", ".join(f"{count} *{verdict}*" for verdict, count in right.most_common())}. Of its {len(silent)} answers *measure it*
on actuators, {len(cars)} are about the mountain cars, where no training through an actuator or on random ones was tested.
**The rules of `advise` were revised with these rows in sight**, so that the table shows how well they agree with the
rows, and is no test of them."""
    return f"""## The accuracy of `advise`

{textwrap.fill(" ".join(text.split()), 120, break_long_words=False)}

{markdown_table(["asked about", *_JUDGED.values()], counts, numeric_columns=len(_JUDGED))}
The actuators for which it was not right:

{markdown_table(header, rows)}
The mean error of the {len(exact)} predicted losses without ≤ is {np.mean(errors):.2f}, and {np.mean(large):.2f} where policies lose more than
{MARGIN:g}. We also predicted {left["severities"]} severities from their neighbors: {left["off"]} errors exceed {MARGIN:g}
(mean {left["mean_error"]:.3f}), and {left["flips"]} severities change between harmless and not harmless.

{_figure(drawn, "chart", "Recommended option for an actuator with a lag or with too little voltage")}"""


def _verdicts(
    verdicts: Sequence[Verdict], others: Sequence[Verdict], by_task: Sequence[TaskVerdict]
) -> str:
    """Return the section on the primary hypotheses, a row each, with a comment on their worth."""
    rows = []
    for verdict in verdicts:
        statement = verdict.question.statement.replace(_EACH, " *")
        if (
            verdict.outcome == "open"
            and (seeds := verdict.seeds_to_close(len(verdicts))) is not None
        ):
            statement += f" (about {seeds} seeds would decide it)"
        tested, planned = verdict.strata
        if tested < planned:
            statement += f" ({tested} of {planned} comparisons have runs)"
        rows.append(
            [
                verdict.question.name,
                verdict.outcome,
                effect_text(verdict),
                p_text(verdict.corrected_p),
                rests_text(verdict.question.name, by_task),
                statement,
            ]
        )
    header = ["", "holds", "effect [95 %]", "corrected p", "rests on", "hypothesis"]
    tasks: dict[str, list[str]] = {}
    for part in by_task:
        tasks.setdefault(part.question.name, []).append(f"{TITLES[part.task]}: {part.text}")
    wrong = [
        verdict
        for verdict in others
        if " 25 % over nominal" in verdict.question.statement.replace("-", "").replace("+", "")
    ]
    sizes = [
        abs(verdict.effect.mean) for verdict in wrong if not np.isnan(verdict.effect.mean)
    ] or [0.0]
    return f"""## The twelve hypotheses

First task by task, with the difference of the mean scores and its 95 % interval. The plan has only the pooled verdicts
below. These {len(by_task)} were added later; their false discovery rate is 5 %. *The other way* means a decided difference of
the opposite sign.

{markdown_table(["", "by task"], ([name, "; ".join(texts)] for name, texts in tasks.items()))}
The verdicts of the plan pool the tasks.
{RESTS}

{markdown_table(header, rows)}
\\* P{_EACH[3:]}.

Seven of the confirmed hypotheses could hardly fail. P1 to P5: the severities were chosen in a pilot so that
ideal-trained policies lose. P9: the loop was badly detuned. P10: errors of both signs cancel in the mean; their mean
*size* is {np.mean(sizes):.3f} over {len(wrong)} cases, and the largest is {np.max(sizes):.3f}. P6, P7, P8, P11 and P12
could have gone either way.
"""


_EACH = ": policies trained through it score higher on it than policies trained on ideal forces"
"""Common ending of the statements of six hypotheses."""


def effect_text(verdict: Verdict) -> str:
    """Format a difference of scores with its interval."""
    mean, low, high = verdict.effect
    return "–" if np.isnan(mean) else f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]"


def p_text(value: float) -> str:
    """Format a p-value with three digits."""
    if np.isnan(value):
        return "–"
    return "<0.001" if value < 0.001 else f"{value:.3f}"


def decided_table(verdicts: Sequence[Verdict], titles: Mapping[str, str]) -> str:
    """Return a table of each section's comparisons: how many were judged and how many decided."""
    rows = []
    for name, title in titles.items():
        judged = [
            verdict
            for verdict in verdicts
            if verdict.question.section == name and not np.isnan(verdict.p)
        ]
        decided = [verdict for verdict in judged if verdict.outcome != "open"]
        beyond = sum(
            verdict.effect.low > MARGIN or verdict.effect.high < -MARGIN for verdict in decided
        )
        over_zero = sum(verdict.effect.low <= 0 <= verdict.effect.high for verdict in decided)
        rows.append([title, *map(str, (len(judged), len(decided), beyond, over_zero))])
    header = ["secondary comparisons", "of", "decided", f"by more than {MARGIN:g}"]
    return markdown_table([*header, "interval includes 0"], rows, numeric_columns=4)


UNDECIDED = """Permutation tests compare distributions. Some comparisons are therefore decided although the interval of their
mean difference includes 0. These show that the policies differ, and not which training is better on average."""
"""Explanation of the last column of `decided_table`."""


def _secondary(verdicts: Sequence[Verdict], drawn: Mapping[str, Path]) -> str:
    """Return the section on secondary comparisons, with the figure of current loops."""
    return f"""## The other comparisons

All secondary comparisons have a false discovery rate of 5 %. The third column of numbers counts those whose 95 %
interval is beyond the margin.
{UNDECIDED}

{decided_table(verdicts, QUESTIONS)}
The table of [trials]({FOLDER}/{TRIALS}) also has tests beyond the plan, without p-values: loops without anti-windup, and
variants of the paper's loop.

{_figure(drawn, "tune", QUESTIONS["tune"])}"""


def _missing(collected: StudyResults) -> str:
    if not collected.totals.missing:
        return ""
    shown = [f"- failed: {name}: {error}" for name, error in list(collected.failures.items())[:10]]
    return (
        "\n".join(
            [
                "## Missing results",
                "",
                (
                    f"{collected.totals.missing} trainings and tests are missing;"
                    f" {len(collected.failures)} of them failed. `python scripts/study_actuators.py"
                    " --dry-run` lists them."
                ),
                *shown,
            ]
        )
        + "\n"
    )


def _method(collected: StudyResults, scores: Scores) -> str:
    grid, totals = collected.grid, collected.totals
    num_trained, num_planned = totals.trainings, len(grid.cells)
    tested, tests = sum(map(len, collected.evaluations.values())), len(grid.policy_tests)
    codes = (
        ", ".join(f"`{code}` ({count})" for code, count in sorted(totals.codes.items())) or "none"
    )
    known = [
        f"{task} {FLOORS[task]:g} to {ceiling:.1f}" for task, ceiling in scores.ceilings.items()
    ]
    runs = max(len(grid.seeds_of(grid.arms[0])), 2)
    num_tested = len(
        {
            cell
            for trial in grid.trials
            for cell in [(trial.arm.name, seed) for seed in collected.evaluations[trial.name]]
        }
    )
    about = f"""The study follows [its plan](plan.md). It has {num_trained} of {num_planned} trainings
({totals.seconds / 3600:.1f} hours of one core), of which {num_tested} were tested, and {tested} of {tests} tests. Versions of the code, with the number of
their runs: {codes}. `scripts/study_actuators.py` ([how](../studies.md)) writes this page and five tables:
[hypotheses]({FOLDER}/{HYPOTHESES}), [those by task]({FOLDER}/{BY_TASK}), [trials]({FOLDER}/{TRIALS}), [runs]({FOLDER}/{RUNS}) and
[answers of `advise`]({FOLDER}/{ADVISED}). `examples/recompute.py` recomputes the conclusions without this package."""
    text = f"""A score is the mean return over {grid.episodes} test episodes as a share of the span: 0 is the return of
random actions on ideal forces, and 1 is the mean return of ideal-trained policies there
({"; ".join(known) or "none yet"}). On CartPole the return counts the steps within 0.1 m of the center, as in the paper.
In {TRIALS} *failed* is the share of policies that score below {1 - FAILURE_MARGIN:g}. Effects are differences of mean
scores, and a policy counts once on every task. Intervals are Student's t intervals. The p-values come from permutation
tests; equivalence takes two one-sided tests with a margin of {MARGIN:g}. Primary p-values are corrected by Holm's method,
the others by that of Benjamini and Hochberg. With {runs} seeds, a difference of
{detectable_difference(runs, LEVEL / 12):.2f} standard deviations is found with a probability of 80 % at the strictest
level."""
    # Links may be longer than a line and must not be broken.
    wrapped = (
        textwrap.fill(" ".join(paragraph.split()), 120, break_long_words=False)
        for paragraph in (about, text)
    )
    return "## How it was measured\n\n" + "\n\n".join(wrapped) + "\n"
