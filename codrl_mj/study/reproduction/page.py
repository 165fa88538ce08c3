"""The reproduction's page: Markdown, with figures and tables beside it."""

import collections
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from codrl_mj.actuators import IDEAL
from codrl_mj.evaluation.measures import Interval
from codrl_mj.runs.files import writing
from codrl_mj.study.conclusions import conclusions_section
from codrl_mj.study.figures import TITLES
from codrl_mj.study.reproduction import figures, tables
from codrl_mj.study.reproduction.claims import PAPER_SAYS, PORT, Claim
from codrl_mj.study.reproduction.reproduce import VALUE_TASK, Findings
from codrl_mj.study.reproduction.value_iteration import Optimum
from codrl_mj.study.reproduction.verdicts import NOT_CONFIRMED, NOT_TESTABLE, OUTCOMES, Verdict, number
from codrl_mj.study.tables import markdown_table
from codrl_mj.study.trials import numbers_as_text

PAGE, FOLDER = "reproduction.md", "reproduction"
"""The page, and the folder beside it with its figures and tables."""


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
        verdicts_section(findings.claims),
        *_tasks(findings, drawn),
    ]
    with writing(out / PAGE) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")
    return [out / PAGE, *written, *(path for paths in drawn.values() for path in paths)]


def _head(findings: Findings) -> str:
    plan, found = findings.plan, findings.found
    done, wanted, hours = len(found.folders), len(found.grid.cells()), found.seconds / 3600
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
{done} of {wanted} trainings are finished; they took {hours:.1f} hours of one core in all. Every trained policy was
tested, without exploration, in {plan.test_episodes} episodes on the actuator that it was trained on.

`codrl-mj reproduce` writes this page, its figures and its tables from run folders; do not edit it.
[How it is done](../reproduction.md). As files: [every claim with its check]({FOLDER}/{tables.CLAIMS}),
[every run]({FOLDER}/{tables.RUNS}), [every number]({FOLDER}/{tables.EVERYTHING}).
"""


def _missing(findings: Findings) -> str:
    """What is not there, and what went wrong."""
    lines = [f"- {name}: seeds {numbers_as_text(seeds)}" for name, seeds in findings.missing.items()]
    lines += [f"- {name} failed: {error}" for name, error in findings.found.failures.items()]
    if not lines:
        return ""
    return "\n".join(
        ["## What is missing\n", "The tables are of the runs that there are, and say how many.\n", *lines, ""]
    )


_SOURCES = {PAPER_SAYS: "the paper", PORT: "this port: MuJoCo against Gymnasium's equations"}


def verdicts_section(claims: Sequence[tuple[Claim, Verdict]]) -> str:
    """How many statements of whom came to what."""
    rows = []
    for source, who in _SOURCES.items():
        found = [(claim, verdict.outcome) for claim, verdict in claims if claim.source == source]
        if found:
            each = _of_statements(found)
            counts = collections.Counter(each.values())
            rows.append([who, *map(str, (len(found), len(each), *(counts[outcome] for outcome in OUTCOMES)))])
    header = ["said by", "verdicts", "statements", *OUTCOMES]
    return f"## Verdicts\n\n{_WORDS}\n{markdown_table(header, rows, numbers=len(header) - 1)}"


def _of_statements(found: Iterable[tuple[Claim, str]]) -> dict[tuple[str, ...], str]:
    """What every statement of somebody came to: judged on both kinds of physics, it has to pass on both."""
    several: dict[tuple[str, ...], set[str]] = {}
    for claim, outcome in found:
        several.setdefault((claim.task, claim.statement, claim.measure.text), set()).add(outcome)
    return {statement: min(outcomes, key=[NOT_CONFIRMED, *OUTCOMES].index) for statement, outcomes in several.items()}


_WORDS = """\
*Confirmed* is what holds over seeds; *compatible* is what is said of one run or one episode, and could be one of ours.
A statement that is judged on MuJoCo and on Gymnasium's equations has two verdicts and counts once, as passed if it is
on both.
"""


def _tasks(findings: Findings, drawn: Mapping[str, Mapping[Path, str]]) -> Iterable[str]:
    for task in findings.plan.tasks:
        section = next(claim.section for claim, _ in findings.claims if claim.task == task)
        yield f"## {TITLES[task]}: the paper's *{section}*\n"
        yield _claims(findings, task)
        if task == VALUE_TASK:
            yield _value_iteration(findings.optima)
        if drawn[task]:
            first, *others = (f"[{caption}]({FOLDER}/{path.name})" for path, caption in drawn[task].items())
            yield f"!{first}\n"
            yield ", ".join(others) + "\n"


def _claims(findings: Findings, task: str) -> str:
    """What the paper reports and what became of it, in MuJoCo where that is told apart; the rest is in the tables."""
    rows = []
    for claim, verdict in findings.claims:
        if (claim.task, claim.source) == (task, PAPER_SAYS) and claim.physics != "analytic":
            outcome = verdict.outcome if verdict.outcome == NOT_TESTABLE else f"**{verdict.outcome}**"
            ours = "–" if verdict.measured is None else _interval(verdict.measured)
            rows.append([outcome, claim.statement, claim.measure.text, ours, str(verdict.samples or "–")])
    return markdown_table(["verdict", "the paper reports", "measure", "ours [95 %]", "seeds"], rows)


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
        + markdown_table(header, rows)
    )


def _draw(findings: Findings, task: str, folder: Path) -> dict[Path, str]:
    """Draw what there is of a task: the files, and what they show."""
    mine = [one for one in findings.series.values() if one.arm.task == task and one.runs]
    title, paths = TITLES[task], {}
    if mine:
        path = folder / f"learning_{task}.svg"
        paths[path] = f"Learning, mean over seeds with its 95 % interval: {title}"
        figures.draw_learning(path, mine)
    for settings in dict.fromkeys(one.arm.settings for one in mine):
        shown = [one for one in mine if one.arm.settings == settings and one.arm.physics == "mujoco"]
        episodes = [(one.arm, figures.example(one)) for one in shown]
        if driven := [(arm, episode) for arm, episode in episodes if arm.actuator != IDEAL]:
            path = folder / f"torque_{task}_{settings}.svg"
            paths[path] = f"Desired and actual torque, and error, {settings} settings: {title}"
            figures.draw_torque(path, driven)
        if episodes:
            path = folder / f"states_{task}_{settings}.svg"
            paths[path] = f"States over a test episode, {settings} settings: {title}"
            figures.draw_states(path, task, episodes)
    if task == VALUE_TASK:
        path = folder / "discount.svg"
        paths[path] = "Value of the start, and the best policies, over discount factors"
        figures.draw_discounts(path, findings.values, findings.optima)
    return paths


def _interval(interval: Interval) -> str:
    mean, low, high = map(number, interval)
    return mean if low == high else f"{mean} [{low}, {high}]"
