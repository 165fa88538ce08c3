"""Page of the reproduction: Markdown, with figures and tables beside it."""

import collections
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from codrl_mj.study.pages import TITLES, markdown_table, read_conclusions, write_page
from codrl_mj.study.trials import format_ranges
from reproduction import figures
from reproduction.checks import NOT_TESTABLE, OUTCOMES, Verdict, medians, number
from reproduction.claims import PAPER_SAYS, STEP_TRACKING, TIMES, TRACKING, UPRIGHT, Claim, as_text
from reproduction.drawn import CURVES, STATES, TORQUES, Table
from reproduction.findings import CLAIM_ROWS, EVERYTHING, Findings, write_files
from reproduction.rows import RUNS, times_of
from reproduction.value_iteration import TASK as VALUE_TASK

PAGE, FOLDER = "reproduction.md", "reproduction"
"""The page, and the folder beside it with its figures and tables."""
Judged = Sequence[tuple[Claim, Verdict]]
"""Claims with their verdicts."""


def write(findings: Findings, out: Path) -> list[Path]:
    """Write the page, its figures and its tables, each of them atomically.

    Args:
        findings: results of the reproduction.
        out: folder of the page.

    Returns:
            Files that were written, the page first.
    """
    folder = out / FOLDER
    written, drawn = write_files(findings, folder), _draw(findings, folder)
    parts = [
        _head(findings),
        statements_table(findings),
        verdicts_line(findings.verdicts),
        f"## Conclusions\n\n{read_conclusions(out / PAGE)}",
        f"## Figures\n\n{_pictures(drawn)}",
        _method(findings),
        _missing(findings),
    ]
    write_page(out / PAGE, parts)
    return [out / PAGE, *written, *drawn]


def _head(findings: Findings) -> str:
    trial = ""
    if findings.plan["episodes"] is not None:
        trial = (
            f"\n**A trial: every training was cut off after {findings.plan['episodes']} episodes. "
            "Its verdicts say nothing about the paper.**\n"
        )
    return f"""# Reproduction of the paper's experiments
{trial}
*Control-Optimized Deep Reinforcement Learning* (arXiv 2507.00268) reports one run of each experiment. We train
each experiment with several seeds, and judge every statement [by a rule](../reproduction.md#how-it-is-judged).
"""


def statements_table(findings: Findings) -> str:
    """Return a table of the paper's statements: figure, its number, ours, and the verdict."""
    statements: dict[tuple[str, str, str], dict[str, tuple[Claim, Verdict]]] = {}
    for claim, verdict in findings.verdicts:
        if claim.source == PAPER_SAYS:
            key = claim.task, claim.statement, claim.measure.text
            statements.setdefault(key, {})[claim.settings] = claim, verdict
    rows, last_task = [], ""
    for (task, *_), by_settings in statements.items():
        claim, verdict = list(by_settings.values())[-1]
        if not claim.counted:
            continue
        cells = [
            _ours(findings, *by_settings[settings]) if settings in by_settings else ""
            for settings in ("paper", "repaired")
        ]
        cells += [_without(findings, claim)]
        if claim.motors == ("ideal",):
            cells = ["", "", cells[0]]
        outcome = verdict.outcome if verdict.outcome == NOT_TESTABLE else f"**{verdict.outcome}**"
        title = f"*{TITLES[task]}*: " if task != last_task else ""
        rows.append([title + claim.statement, claim.figure, _minus(claim.says), *cells, outcome])
        last_task = task
    header = [
        "statement",
        "figure",
        "the paper",
        "ours, its settings",
        "repaired",
        "no motor",
        "verdict",
    ]
    return markdown_table(header, rows)


def _ours(findings: Findings, claim: Claim, verdict: Verdict) -> str:
    """Format the measured value of a claim, with its interval; for times the median."""
    if claim.measure is UPRIGHT and verdict.measured:
        return f"{as_text(UPRIGHT, verdict.measured.mean)}{_after(findings, claim.arms[0])}"
    if claim.measure is STEP_TRACKING:
        step = as_text(STEP_TRACKING, verdict.measured.mean) if verdict.measured else "–"
        runs = findings.runs[claim.arms[0]]
        every_step = TRACKING.values([row for row in runs if row[STEP_TRACKING.column]] or runs)
        return f"{step} ({as_text(TRACKING, every_step.mean())})" if len(every_step) else "–"
    if verdict.measured is None:
        return "never" if claim.measure is TIMES and verdict.outcome != NOT_TESTABLE else "–"
    mean, low, high = verdict.measured
    text = as_text(claim.measure, mean)
    if low == high or claim.measure.unit in ("%", "share", "N·m"):
        return _minus(text)
    return _minus(f"{text} [{number(low)}, {number(high)}]")


def _without(findings: Findings, claim: Claim) -> str:
    mean = claim.without_motor(findings.runs)
    ideal = f"{claim.task}, {claim.settings}, ideal, mujoco"
    if mean is None:
        return ""
    return _minus(as_text(claim.measure, mean)) + (
        _after(findings, ideal) if claim.measure is UPRIGHT else ""
    )


def _after(findings: Findings, arm: str) -> str:
    """Format the mean over seeds of the median time after which an arm's pendulums are upright."""
    times = medians([times_of(row["times"]) for row in findings.runs[arm] if row["times"]])
    return f", after {number(float(times.mean()))} s" if len(times) else ""


def _minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")


def verdicts_line(verdicts: Judged) -> str:
    """Return a line with the number of statements by outcome."""
    paper = [(claim, verdict) for claim, verdict in verdicts if claim.source == PAPER_SAYS]
    counts = collections.Counter(verdict.outcome for claim, verdict in paper if claim.counted)
    outcomes = ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome])
    return f"""\
**Of {counts.total()} statements: {outcomes}.** The 95 % interval [in brackets] is inside the stated
range (*confirmed*), outside (*not confirmed*), or across its edge (*open*). *Compatible* means that the paper's single
run or episode could be one of ours. This is easier to reach if ours scatter more. Torque errors are those at the agent's steps, as the
paper reports them. Those over all integration steps are in parentheses.
"""


def _draw(findings: Findings, folder: Path) -> dict[Path, str]:
    """Draw all figures that have data; return their captions."""
    shown: dict[Path, str] = {}
    for task in dict.fromkeys(claim.task for claim, _ in findings.verdicts):
        kinds: dict[str, tuple[Callable[[Path, str, Table], bool], str]] = {
            "learning": (figures.draw_learning, CURVES),
            "torque": (figures.draw_torque, TORQUES),
            "states": (figures.draw_states, STATES),
        }
        for kind, (draw, table) in kinds.items():
            path = folder / f"{kind}_{task}.svg"
            if draw(path, task, findings.tables[table]):
                shown[path] = f"{TITLES[task]}: {kind}"
    if findings.optima:
        figures.draw_discounts(folder / "discount.svg", findings.values, findings.optima)
        shown[folder / "discount.svg"] = f"{TITLES[VALUE_TASK]}: best policy by discount factor"
    return shown


def _pictures(drawn: dict[Path, str]) -> str:
    """Return Markdown that shows the learning curves and links the other figures."""
    lines: dict[str, list[str]] = {}
    for path, caption in drawn.items():
        title, _, kind = caption.partition(": ")
        link = f"![{caption}]" if kind == "learning" else f"[{kind}]"
        lines.setdefault(title, []).append(f"{link}({FOLDER}/{path.name})")
    return "\n\n".join(f"{title}: {', '.join(links)}" for title, links in lines.items()) + "\n"


def _method(findings: Findings) -> str:
    """Return the section on the method, with links to the numbers."""
    rows = [row for arm_rows in findings.runs.values() for row in arm_rows]
    hours = sum(float(row["seconds"]) for row in rows) / 3600
    files = (
        (CLAIM_ROWS, "verdicts"),
        (RUNS, "trainings"),
        (CURVES, "curves"),
        (EVERYTHING, "everything else"),
    )
    links = ", ".join(f"[{name}]({FOLDER}/{file})" for file, name in files)
    episodes = findings.plan["test_episodes"]
    return f"""## How it was measured

The {len(rows)} trainings took {hours:.1f} hours on one core. Every policy was tested with greedy actions in {episodes} episodes
on the actuator of its training. `scripts/reproduce.py` ([how](../reproduction.md)) writes this page and its data:
{links}. `examples/recompute_reproduction.py` recomputes every verdict from the first two, without the package.
"""


def _missing(findings: Findings) -> str:
    """Return the section on missing and failed trainings."""
    lines: Iterable[str] = [
        f"- {name}: seeds {format_ranges(seeds)}" for name, seeds in findings.missing.items()
    ]
    lines = [*lines, *(f"- {name} failed: {error}" for name, error in findings.failures.items())]
    if not lines:
        return ""
    return "\n".join(["## Missing results\n", _MISSING, *lines, ""])


_MISSING = (
    "These trainings are planned, but either not finished or without all of today's columns. The"
    " verdicts use the others.\n"
)
