"""The reproduction's page: Markdown, with figures and tables beside it."""

import collections
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators import IDEAL
from codrl_mj.evaluation.measures import Interval
from codrl_mj.runs.files import writing
from codrl_mj.study.conclusions import conclusions_section
from codrl_mj.study.reproduction import figures, tables
from codrl_mj.study.reproduction.claims import PAPER_SAYS, PORT, STUDY_SAYS
from codrl_mj.study.reproduction.reproduce import VALUE_TASK, Findings
from codrl_mj.study.reproduction.series import interval_text
from codrl_mj.study.reproduction.value_iteration import Optimum
from codrl_mj.study.reproduction.verdicts import CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE, number

PAGE, FOLDER = "reproduction.md", "reproduction"
"""The page, and the folder beside it with its figures and tables."""
_TITLES = {
    "pendulum": "Pendulum",
    "mountain_car": "Mountain Car",
    "mountain_car_continuous": "Continuous Mountain Car",
    "acrobot": "Acrobot",
    "cartpole": "CartPole",
}


def write(findings: Findings, out: Path) -> list[Path]:
    """Write the page, its figures and its tables, each whole or not at all.

    Args:
        findings: what was found.
        out: folder for the page.

    Returns:
        The files, the page first.
    """
    folder = out / FOLDER
    drawn = {task: _draw(findings, task, folder) for task in findings.plan.tasks}
    written = tables.write(findings, folder)
    parts = [
        _head(findings),
        conclusions_section(out / PAGE),
        _missing(findings),
        _verdicts(findings),
        *_tasks(findings, drawn),
    ]
    with writing(out / PAGE) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")
    return [out / PAGE, *written, *(path for paths in drawn.values() for path in paths)]


def _head(findings: Findings) -> str:
    plan, series = findings.plan, findings.evidence.series.values()
    runs = [run for one in series for run in one.runs.values()]
    wanted = sum(len(plan.seeds_of(one.arm)) for one in series)
    hours = sum(run.seconds for run in runs) / 3600
    trial = ""
    if plan.episodes is not None:
        trial = (
            f"\n**A trial: every training was cut off after {plan.episodes} episodes. Its verdicts say nothing about "
            "the paper.**\n"
        )
    return f"""# The paper's experiments, done again
{trial}
*Control-Optimized Deep Reinforcement Learning* (arXiv 2507.00268) reports one run of each experiment. Here every one of
them is trained with many seeds, and each reported number is judged by a check that was written down before.
{len(runs)} of {wanted} trainings are finished; they took {hours:.1f} hours of one core in all. Every trained policy was
tested, without exploration, in {plan.test_episodes} episodes on the actuator that it was trained on.

`codrl-mj reproduce` writes this page, its figures and its tables from run folders; do not edit it.
[How it is done](../reproduction.md). As files: [every claim with its check]({FOLDER}/{tables.CLAIMS}),
[every run]({FOLDER}/{tables.RUNS}), [every number]({FOLDER}/{tables.EVERYTHING}).
"""


def _missing(findings: Findings) -> str:
    """What is not there, and what went wrong."""
    lines = []
    for name, series in findings.evidence.series.items():
        if series.missing:
            lines.append(f"- {name}: seeds {interval_text(series.missing)}")
        lines += [f"  - seed {seed} failed: {error}" for seed, error in series.failures.items()]
    if not lines:
        return ""
    return "\n".join(
        ["## What is missing\n", "The tables are of the runs that there are, and say how many.\n", *lines, ""]
    )


def _verdicts(findings: Findings) -> str:
    """How many claims of whom came to what; one that is judged on both kinds of physics is one claim."""
    outcomes = (CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE)
    rows = []
    for source in (PAPER_SAYS, STUDY_SAYS, PORT):
        found: dict[Any, set[str]] = {}
        for claim, verdict in findings.claims:
            if claim.source == source:
                found.setdefault((claim.task, claim.statement, claim.measure), set()).add(verdict.outcome)
        if found:
            decisive = (NOT_CONFIRMED, CONFIRMED, NOT_TESTABLE)  # confirmed if it is wherever it could be tested
            counts = collections.Counter(next(one for one in decisive if one in several) for several in found.values())
            rows.append([_SOURCES[source], *(str(counts[outcome]) for outcome in outcomes)])
    return f"## Verdicts\n\n{_ONCE}\n\n{_table(['said by', *outcomes], rows, numbers=3)}"


_ONCE = "A claim that is judged on MuJoCo and on Gymnasium's equations counts once, as confirmed if it is on both."


_SOURCES = {
    PAPER_SAYS: "the paper",
    STUDY_SAYS: "a quick study of the paper's loop on Gymnasium's dynamics, before this port",
    PORT: "this port: MuJoCo against Gymnasium's equations",
}


def _tasks(findings: Findings, drawn: dict[str, list[Path]]) -> Iterable[str]:
    for task in findings.plan.tasks:
        section = next(claim.section for claim, _ in findings.claims if claim.task == task)
        yield f"## {_TITLES[task]}: the paper's *{section}*\n"
        yield _claims(findings, task)
        if task == VALUE_TASK:
            yield _value_iteration(findings.evidence.optima)
        if drawn[task]:
            first, *others = drawn[task]
            yield f"![{_caption(first)}]({FOLDER}/{first.name})\n"
            yield ", ".join(f"[{_caption(path)}]({FOLDER}/{path.name})" for path in others) + "\n"


def _claims(findings: Findings, task: str) -> str:
    """What the paper reports and what became of it, in MuJoCo where that is told apart; the rest is in the tables."""
    rows = []
    for claim, verdict in findings.claims:
        if (claim.task, claim.source) == (task, PAPER_SAYS) and claim.physics != "analytic":
            outcome = verdict.outcome if verdict.outcome == NOT_TESTABLE else f"**{verdict.outcome}**"
            ours = "–" if verdict.measured is None else _interval(verdict.measured)
            rows.append([outcome, claim.statement, claim.measure, ours, str(verdict.samples or "–")])
    return _table(["verdict", "the paper reports", "measure", "ours [95 %]", "seeds"], rows)


def _value_iteration(optima: Sequence[Optimum]) -> str:
    """What the best policy does at each discount factor."""
    rows = [
        [
            number(one.discount),
            "yes" if one.stands_still else "no",
            _interval(one.returns),
            f"{100 * one.success:.0f} %",
            "–" if one.steps is None else number(one.steps.median),
        ]
        for one in optima
    ]
    header = ["discount factor", "standing still is best", "return of the best policy", "success", "steps to the goal"]
    return (
        "Why the printed settings fail: value iteration of Gymnasium's own dynamics, on a grid with interpolation,\n"
        "and its policy at work in Gymnasium's environment, without a motor. Returns are not discounted.\n\n"
        + _table(header, rows)
    )


def _draw(findings: Findings, task: str, folder: Path) -> list[Path]:
    """Draw what there is of a task."""
    mine = [one for one in findings.evidence.series.values() if one.arm.task == task]
    paths = []
    if any(one.runs for one in mine):
        paths.append(folder / f"learning_{task}.svg")
        (figures.draw_epochs if task == "cartpole" else figures.draw_learning)(paths[-1], mine)
    for settings in dict.fromkeys(one.arm.settings for one in mine):
        shown = [one for one in mine if one.arm.settings == settings and one.arm.physics == "mujoco"]
        episodes = [(one.arm, episode) for one in shown if (episode := figures.example(one)) is not None]
        driven = [(arm, episode) for arm, episode in episodes if arm.actuator != IDEAL]
        if driven:
            paths.append(folder / f"torque_{task}_{settings}.svg")
            figures.draw_torque(paths[-1], driven)
        if episodes:
            paths.append(folder / f"states_{task}_{settings}.svg")
            figures.draw_states(paths[-1], task, episodes)
    if task == VALUE_TASK:
        paths.append(folder / "discount.svg")
        figures.draw_discounts(paths[-1], findings.values, findings.evidence.optima)
    return paths


def _caption(path: Path) -> str:
    """What a figure shows."""
    kind, _, rest = path.stem.partition("_")
    task, _, settings = rest.rpartition("_")
    return {
        "learning": f"Learning, mean over seeds with its 95 % interval: {_TITLES.get(rest, '')}",
        "torque": f"Desired and actual torque, and error, {settings} settings: {_TITLES.get(task, '')}",
        "states": f"States over a test episode, {settings} settings: {_TITLES.get(task, '')}",
        "discount": "Value of the start, and the best policies, over discount factors",
    }[kind]


def _interval(interval: Interval) -> str:
    mean, low, high = map(number, interval)
    return mean if low == high else f"{mean} [{low}, {high}]"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """A Markdown table; the last columns, as many as are `numbers`, are aligned to the right."""
    marks = ["---"] * (len(header) - numbers) + ["---:"] * numbers
    lines = [header, marks, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
