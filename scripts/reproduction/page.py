"""The reproduction's page: Markdown, with figures and tables beside it."""

import collections
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators import IDEAL
from codrl_mj.study.pages import TITLES, conclusions, markdown_table, write_page
from codrl_mj.study.trials import numbers_as_text
from reproduction import figures
from reproduction.arms import ARMS
from reproduction.checks import NOT_CONFIRMED, NOT_TESTABLE, OUTCOMES, number
from reproduction.claims import CLAIMS, PAPER_SAYS, PORT
from reproduction.findings import EVERYTHING, FILES, Findings, write_files
from reproduction.value_iteration import TASK as VALUE_TASK

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
    folder, rows = out / FOLDER, findings.rows
    for task in rows["plan"]["tasks"]:
        _draw(findings, task, folder)
    written = write_files(rows, folder)
    drawn = {task: _figures(task, folder) for task in rows["plan"]["tasks"]}
    parts = [
        _head(findings),
        f"## Conclusions\n\n{conclusions(out / PAGE)}",
        verdicts_section(rows["claims"]),
        *_tasks(rows, drawn),
        _how(findings),
        _missing(rows),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, *written, *(path for paths in drawn.values() for path in paths)]


def _head(findings: Findings) -> str:
    plan, trial = findings.rows["plan"], ""
    if plan["episodes"] is not None:
        trial = (
            f"\n**A trial: every training was cut off after {plan['episodes']} episodes. "
            "Its verdicts say nothing about the paper.**\n"
        )
    return f"""# The paper's experiments, done again
{trial}
*Control-Optimized Deep Reinforcement Learning* (arXiv 2507.00268) reports one run of each experiment. Here each is
trained with many seeds, and judged by a check that was written down before.
"""


def _how(findings: Findings) -> str:
    """How it was measured, and where the numbers are."""
    plan, runs = findings.rows["plan"], findings.rows["runs"]
    hours = sum(row["seconds"] for row in runs) / 3600
    return f"""## How it was measured

{len(runs)} of {len(findings.found.grid.cells())} trainings are finished, {plan["seeds"]} of a kind,
{plan["sarsa_seeds"]} of SARSA; they took {hours:.1f} hours of one core. Every policy was tested greedily in
{plan["test_episodes"]} episodes on the actuator of its training. `scripts/reproduce.py` ([how](../reproduction.md))
writes this page, its figures and its tables: [every claim with its check]({FOLDER}/{FILES["claims"]}),
[every run]({FOLDER}/{FILES["runs"]}), [every number]({FOLDER}/{EVERYTHING}).
"""


def _missing(findings: Mapping[str, Any]) -> str:
    """What is not there, and what went wrong."""
    lines = [f"- {name}: seeds {numbers_as_text(seeds)}" for name, seeds in findings["missing"].items()]
    lines += [f"- {name} failed: {error}" for name, error in findings["failures"].items()]
    if not lines:
        return ""
    return "\n".join(
        ["## What is missing\n", "The tables are of the runs that there are, and say how many.\n", *lines, ""]
    )


_SOURCES = {PAPER_SAYS: "the paper", PORT: "this port: MuJoCo against Gymnasium's equations"}


def verdicts_section(claims: Sequence[Mapping[str, Any]]) -> str:
    """How many statements of whom came to what, of the rows of claims."""
    rows = []
    for source, who in _SOURCES.items():
        mine = [claim for claim in claims if claim["source"] == source]
        several: dict[tuple[str, ...], set[str]] = {}
        for claim in mine:  # judged on both kinds of physics, a statement has to pass on both
            statement = claim["task"], claim["statement"], claim["measure"]
            several.setdefault(statement, set()).add(claim["verdict"])
        if mine:
            each = [min(outcomes, key=[NOT_CONFIRMED, *OUTCOMES].index) for outcomes in several.values()]
            counts = collections.Counter(each)
            rows.append([who, *map(str, (len(mine), len(each), *(counts[outcome] for outcome in OUTCOMES)))])
    header = ["said by", "verdicts", "statements", *OUTCOMES]
    return f"## Verdicts\n\n{_WORDS}\n{markdown_table(header, rows, numbers=len(header) - 1)}"


_WORDS = """\
*Confirmed* holds over seeds; *compatible* is said of one run or one episode, and could be one of ours
([all checks](../reproduction.md#how-it-is-judged)). A statement judged on MuJoCo and on Gymnasium's equations has two
verdicts and counts once, as passed if it is on both.
"""


def _tasks(rows: Mapping[str, Any], drawn: Mapping[str, Mapping[Path, str]]) -> Iterable[str]:
    for task in rows["plan"]["tasks"]:
        section = next(claim.section for claim in CLAIMS if claim.task == task)
        yield f"## {TITLES[task]}\n\nThe paper's *{section}*.\n"
        yield _claims([claim for claim in rows["claims"] if claim["task"] == task])
        if drawn[task]:
            first, *others = (f"[{caption}]({FOLDER}/{path.name})" for path, caption in drawn[task].items())
            yield f"!{first}\n"
            yield f"A test episode: {', '.join(others)}\n"


def _claims(claims: Iterable[Mapping[str, Any]]) -> str:
    """What the paper reports and what became of it, in MuJoCo where that is told apart; the rest is in the tables."""
    rows = []
    for claim in claims:
        if claim["source"] == PAPER_SAYS and claim["physics"] != "analytic":
            outcome = claim["verdict"] if claim["verdict"] == NOT_TESTABLE else f"**{claim['verdict']}**"
            ours = "–" if claim["mean"] is None else _interval(claim)
            rows.append([shorter(claim["statement"]), f"{shorter(claim['measure'])}: {ours}", outcome])
    return markdown_table(["the paper reports", "ours [95 %]", "verdict"], rows)


_SHORTER = {
    "rms torque error / rms desired torque [%]": "rms error [%]",
    "mean return of the last 50 training episodes": "last 50",
    "mean return in test": "test",
    "time to the goal in test [s]": "[s]",
    "share of test episodes that succeed": "success",
    ": the first minus the second": ", difference",
    ": with the motor minus ideal": ", difference",
    "share of the 500 steps with |x| <= 0.1 m": "share of steps",
    "largest torque error in test [N·m]": "largest [N·m]",
    "first epoch of length 4000": "epoch",
    "first epoch with a return of 3800": "epoch",
    "imperfect tracking (gains 1, 1, 1e-2)": "imperfect tracking",
    "perfect tracking (gains 2, 10, 1e-6)": "perfect tracking",
    "the desired torque is tracked almost perfectly": "tracked almost perfectly",
    "the desired torque is well tracked": "well tracked",
}


def shorter(text: str) -> str:
    """What is reported or measured, in as few words as what stands beside it allows."""
    for long, short in _SHORTER.items():
        text = text.replace(long, short)
    return text


def _draw(findings: Findings, task: str, folder: Path) -> None:
    """Draw what is at hand of a task; figures of runs that are gone stay as they are."""
    mine = [one for one in findings.series.values() if one.arm.task == task and one.runs]
    if mine:
        figures.draw_learning(folder / f"learning_{task}.svg", mine)
    for settings in dict.fromkeys(one.arm.settings for one in mine):
        shown = [one for one in mine if one.arm.settings == settings and one.arm.physics == "mujoco"]
        episodes = [(one.arm, figures.example(one)) for one in shown]
        if driven := [(arm, episode) for arm, episode in episodes if arm.actuator != IDEAL]:
            figures.draw_torque(folder / f"torque_{task}_{settings}.svg", driven)
        if episodes:
            figures.draw_states(folder / f"states_{task}_{settings}.svg", task, episodes)
    if task == VALUE_TASK:
        values = {row["discount"]: row["value"] for row in findings.rows["values_of_start"]}
        figures.draw_discounts(folder / "discount.svg", values, findings.optima)


def _figures(task: str, folder: Path) -> dict[Path, str]:
    """The figures of a task that there are, and what they show."""
    title = TITLES[task]
    shown = {f"learning_{task}": f"Learning on {title}: mean over seeds with its 95 % interval"}
    for settings in dict.fromkeys(arm.settings for arm in ARMS if arm.task == task):
        torque, states = f"torque, {settings} settings", f"states, {settings} settings"
        shown |= {f"torque_{task}_{settings}": torque, f"states_{task}_{settings}": states}
    if task == VALUE_TASK:
        shown["discount"] = "the best policy by discount factor"
    files = {folder / f"{name}.svg": caption for name, caption in shown.items()}
    return {path: caption for path, caption in files.items() if path.is_file()}


def _interval(row: Mapping[str, Any]) -> str:
    mean, low, high = (number(row[name]) for name in ("mean", "low", "high"))
    return mean if low == high else f"{mean} [{low}, {high}]"
