"""The study's page: the answer to each hypothesis that was written down before, and the figures."""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from actuator_study import arms, figures
from actuator_study.exploration import around_the_paper, paper_loops, windup
from actuator_study.questions import on_loop, on_motor, primary, secondary, through_loop, through_motor
from codrl_mj.runs.files import write_json
from codrl_mj.study.doses import AXES, FLOORS, SECONDS, at_home, dosed, ideal
from codrl_mj.study.evidence import HYPOTHESES, Evidence
from codrl_mj.study.inference import detectable
from codrl_mj.study.pages import TITLES, conclusions_section, markdown_table, write_csv, write_page
from codrl_mj.study.questions import LEVEL, MARGIN, Scores, Verdict, judge
from codrl_mj.study.trials import RUNS, TOTALS, Collected, Trial, run_rows, trial_rows

PAGE, FOLDER = "actuators.md", "actuators"
"""The page, and the folder beside it with its figures and tables."""
TRIALS = "trials.csv"
"""A row for every trial."""
QUESTIONS: Mapping[str, str] = {
    "matters": "When does an actuator matter?",
    "tune": "Tune or train?",
    "wrong": "A wrong model",
    "motors": "Motors that exist",
    "command": "What should the policy command and see?",
}
"""The questions by name."""


def write(collected: Collected, out: Path) -> list[Path]:
    """Write page, figures and tables.

    Args:
        collected: of the study; whatever is missing is named on the page.
        out: folder for the page.

    Returns:
        The files that were written.
    """
    folder, scores = out / FOLDER, Scores(collected, FLOORS, [at_home(ideal(task)) for task in SECONDS])
    first, others = judge(scores, primary(), primary=True), judge(scores, secondary())
    drawn = _draw(scores, folder)
    rows = {
        RUNS: run_rows(collected, scores.of),
        TRIALS: trial_rows(collected, scores.of),
        HYPOTHESES: (verdict.row(len(first)) for verdict in (*first, *others)),
    }
    for name, table in rows.items():
        write_csv(folder / name, list(table))
    write_json(folder / TOTALS, collected.totals._asdict())
    advice = _advice(folder, scores)
    parts = [
        _head(collected),
        conclusions_section(out / PAGE),
        _verdicts(first),
        *(_question(name, title, others, drawn) for name, title in QUESTIONS.items()),
        _yours(advice),
        _explored(scores),
        _missing(collected),
        _method(collected, scores),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, *drawn.values(), *(folder / name for name in (*rows, TOTALS)), *advice]


def _draw(scores: Scores, folder: Path) -> dict[str, Path]:
    """The figures by question."""
    found = {name: folder / f"{name}.svg" for name in ("matters", "tune", "motors")}
    figures.doses(found["matters"], scores)
    loops: dict[str, list[tuple[str, Trial]]] = {
        f"{TITLES[task]},\n{loop}": [
            ("ideal-trained", on_loop(ideal(task), loop)),
            ("trained through it", on_loop(through_loop(task, loop), loop)),
        ]
        for task in arms.LOOPED
        for loop in ("weaker", "paper", "designed")
    }
    figures.bars(found["tune"], scores, loops, "The paper's motor under three loops")
    motors: dict[str, list[tuple[str, Trial]]] = {}
    for task in SECONDS:
        home = ideal(task)
        motors[TITLES[task].replace("Continuous ", "Continuous\n")] = [
            ("ideal-trained, on ideal forces", at_home(home)),
            ("ideal-trained, on the good motor", on_motor(home, "good")),
            *(
                [
                    ("ideal-trained, on the marginal motor", on_motor(home, "marginal")),
                    ("trained through the marginal motor", on_motor(through_motor(task), "marginal")),
                ]
                if task in arms.MARGINAL
                else []
            ),
        ]
    figures.bars(found["motors"], scores, motors, "Motors of the catalogue")
    return found


def _advice(folder: Path, scores: Scores) -> list[Path]:
    """Draw what is advised, and how well it was foretold; nothing where results are missing."""
    evidence, files = Evidence.read(folder / HYPOTHESES), [folder / "chart.svg", folder / "foretold.svg"]
    if not figures.chart(files[0], evidence):
        return []
    figures.foretold(files[1], scores, evidence)
    return files


def _yours(drawn: Sequence[Path]) -> str:
    if not drawn:
        return ""
    chart, foretold = (path.name for path in drawn)
    return f"""## What to do about yours

`codrl-mj advise ACTUATOR TASK` measures an actuator on a bench and says it for yours ([how](../advise.md)). By the same
rules, of one that is late or short of voltage and nothing else:

![Train on ideal, design the loop, train through it, or buy another]({FOLDER}/{chart})

Training through a dose was tried on Pendulum and Furuta alone. Losses of several things at once are added up. How well
that foretells what ideal-trained policies lose on the motors and loops of this study, none of which the doses were
taken from:

![Foretold and measured losses]({FOLDER}/{foretold})
"""


def _explored(scores: Scores) -> str:
    """Tables of what was not planned: mean scores."""
    doses = AXES["supply"].doses[1:]
    wound = [
        [TITLES[task], *(" / ".join(_mean(scores, one) for one in pair) for pair in pairs)]
        for task, pairs in windup().items()
    ]
    columns = around_the_paper()
    names = ["the paper's", *paper_loops(arms.LOOPED[0])]
    around = [
        [
            name,
            *(
                "the same" if row and column[row].env == column[0].env else _mean(scores, column[row])
                for column in columns.values()
            ),
        ]
        for row, name in enumerate(names)
    ]
    return f"""## Exploration

Not planned, and without p: mean scores of the same policies, rows of [trials]({FOLDER}/{TRIALS}). A supply that
lacks a share of what is needed, under ideal-trained policies, with anti-windup / with an integrator that goes on while
the voltage saturates:

{markdown_table(["supply lacks", *(f"{dose:g}" for dose in doses)], wound)}
The paper's motor and loop, and otherwise, under policies that were trained on ideal forces and on it:

{markdown_table(["loop", *columns], around)}"""


def _mean(scores: Scores, trial: Trial) -> str:
    found = list(scores.of(trial).values())
    return f"{np.mean(found):.2f}" if found else "–"


def _head(collected: Collected) -> str:
    grid, totals = collected.grid, collected.totals
    done, wanted = totals.trainings, len(grid.cells())
    tested, tests = sum(map(len, collected.evaluations.values())), len(grid.deployments())
    codes = ", ".join(f"`{code}` ({count})" for code, count in sorted(totals.codes.items())) or "none"
    return f"""# What does an actuator cost?

{done} of {wanted} trainings are finished ({totals.seconds / 3600:.1f} hours of one core), and {tested} of {tests}
tests. [The plan](plan.md) was written before the first of them: questions, hypotheses, tests.
Versions of the code that trained, with the number of runs: {codes}.

`python scripts/study_actuators.py` writes this page, its figures and its tables; do not edit it
([how to run it](../studies.md)). The numbers are files: [hypotheses]({FOLDER}/{HYPOTHESES}),
[trials]({FOLDER}/{TRIALS}), [runs]({FOLDER}/{RUNS}).
"""


def _verdicts(verdicts: Sequence[Verdict]) -> str:
    """The primary hypotheses, one row each."""
    rows = []
    for verdict in verdicts:
        says = verdict.question.statement
        if verdict.outcome == "open" and (seeds := verdict.seeds_to_close(len(verdicts))) is not None:
            says += f" (about {seeds} seeds would tell)"
        tested, wanted = verdict.strata
        if tested < wanted:
            says += f" ({tested} of {wanted} comparisons have runs)"
        policies = str(min(verdict.runs))
        name = verdict.question.name
        rows.append([name, verdict.outcome, _effect(verdict), _p(verdict.corrected), policies, says])
    header = ["", "holds", "effect [95 %]", "corrected p", "policies", "says"]
    return f"## The twelve hypotheses\n\n{markdown_table(header, rows)}"


def _effect(verdict: Verdict) -> str:
    mean, low, high = verdict.effect
    return "–" if np.isnan(mean) else f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _question(name: str, title: str, verdicts: Sequence[Verdict], drawn: Mapping[str, Path]) -> str:
    """A question: its figure, and how many of its secondary comparisons were decided, with the largest effects."""
    mine = [verdict for verdict in verdicts if verdict.question.section == name and verdict.runs != (0, 0)]
    decided = [verdict for verdict in mine if verdict.outcome != "open"]
    lines = [f"## {title}", ""]
    if name in drawn:
        lines += [f"![{title}]({FOLDER}/{drawn[name].name})", ""]
    if name == "matters":
        lines.append(_harm(mine))
    beyond = sum(one.effect.low > MARGIN or one.effect.high < -MARGIN for one in decided)
    lines.append(
        f"Of {len(mine)} secondary comparisons {len(decided) or 'none'} differ with a false discovery rate of 5 %, "
        f"{beyond or 'none'} by more than {MARGIN:g} of the span (its 95 % interval)." + " The largest:" * bool(decided)
    )
    largest = sorted(decided, key=lambda verdict: -abs(verdict.effect.mean))[:3]
    lines += ["", *(f"- {one.question.statement}: {_effect(one)}" for one in largest)] if largest else []
    return "\n".join(lines) + "\n"


def _harm(verdicts: Sequence[Verdict]) -> str:
    """A table of the doses that do no harm, and of those that do, to ideal-trained policies."""
    effects = {pair.one.name: one.effect for one in verdicts for pair in one.question.contrasts}
    rows = []
    for task in SECONDS:
        rows.append([TITLES[task]])
        for name, axis in AXES.items():
            known = [effects.get(dosed(ideal(task), name, dose).name) for dose in axis.doses[1:]]
            borne = list(itertools.takewhile(lambda one: one is not None and one.low > -MARGIN, known))
            beyond = [dose for dose, one in zip(axis.doses[1:], known, strict=True) if one and one.high < -MARGIN]
            rows[-1].append(f"{axis.doses[len(borne)]:g}, {format(beyond[0], 'g') if beyond else '–'}")
    return f"""\
What policies bear that were trained on ideal forces: the largest dose up to which the 95 % intervals of what they lose
lie within {MARGIN:g} of the span, and the smallest whose interval lies beyond it.

{markdown_table(["", *(f"{axis.title}: {axis.unit}" for axis in AXES.values())], rows)}"""


def _missing(collected: Collected) -> str:
    if not collected.totals.missing:
        return ""
    shown = [f"- failed: {name}: {error}" for name, error in list(collected.failures.items())[:10]]
    return (
        "\n".join(
            [
                "## What is missing",
                "",
                f"{collected.totals.missing} trainings and tests, of which "
                f"{len(collected.failures)} failed. `python scripts/study_actuators.py --dry-run` lists them.",
                *shown,
            ]
        )
        + "\n"
    )


def _method(collected: Collected, scores: Scores) -> str:
    known = [f"{task} {FLOORS[task]:g} to {ceiling:.1f}" for task, ceiling in scores.ceilings.items()]
    grid = collected.grid
    runs = max(len(grid.seeds_of(grid.arms[0])), 2)
    text = f"""A policy's score is its mean return over {grid.episodes} test episodes, in shares of the span: 0 is
what random actions get on ideal forces, 1 what policies get there on the mean that were trained there
({"; ".join(known) or "none is known yet"}). CartPole's return is the paper's: steps within 0.1 m of the centre.
Effects are differences of mean scores, pooled over tasks or doses where a hypothesis has several: policies count once
on every task, by their mean over its comparisons. Intervals are by Student's t. p are of permutation tests, of
equivalence by two one-sided ones with a margin of
{MARGIN:g}; primary ones are corrected by Holm, the others by Benjamini and Hochberg. With {runs} seeds a difference of
{detectable(runs, LEVEL / 12):.2f} standard deviations of a run is found with a chance of 80 % at the strictest of
Holm's levels."""
    return f"## How the numbers are made\n\n{textwrap.fill(' '.join(text.split()), 120, break_long_words=False)}\n"
