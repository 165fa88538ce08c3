"""What a person sees in a terminal: progress bars and tables."""

import contextlib
import math
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

from codrl_mj.cli.look import titled_table
from codrl_mj.cli.tables import evaluation_tables
from codrl_mj.evaluation import Evaluation
from codrl_mj.runs.layout import PROGRESS
from codrl_mj.runs.summaries import last_report
from codrl_mj.training import TrainConfig
from codrl_mj.training.history import REPORT_COLUMNS
from codrl_mj.validation import GROUPS, Caught, Certificate, Check
from codrl_mj.validation.mutations import margin

_FRAMED: dict[str, Any] = {"box": box.HEAVY_HEAD, "pad_edge": True, "padding": (0, 1)}


def console() -> Console:
    """A console on standard output; 110 columns where it goes to a file, which has no width of its own."""
    return Console() if sys.stdout.isatty() else Console(width=110)


def say(*texts: str, style: str | None = None) -> None:
    """Print each text that is not empty, as wide as the terminal."""
    for text in filter(None, texts):
        console().print(text, markup=False, highlight=False, style=style)


def print_table(*content: Any, **look: Any) -> None:
    """Print a `titled_table`."""
    console().print(titled_table(*content, **look))


class _Line(TextColumn):
    """Text in one line; nothing while numbers in it are not known, such as of how many a count is."""

    def render(self, task: Task) -> Text:
        """The text of a task."""
        text = super().render(task)
        text = Text() if "/None" in text.plain or " nan" in f" {text.plain}" else text
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


def progress_bar(*columns: str) -> Progress:
    """A progress display with the given text columns, the time elapsed and the time left.

    Where all is too long for a line, the bar and the description give way.
    """
    return Progress(
        _Line("{task.description}", table_column=Column()),
        BarColumn(),
        *(_Line(column) for column in columns if column),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TextColumn("left"),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=console(),
    )


@contextlib.contextmanager
def training_bars(runs: Mapping[str, tuple[TrainConfig, Path]]) -> Iterator[None]:
    """Show a bar for each training while the block runs, by what the run folders say, whatever process writes them."""
    columns = (
        "{task.completed:,}/{task.total:,} {task.fields[unit]}",
        "return {task.fields[mean_return]:.1f}",
        "end torque err {task.fields[torque_error]:.2g} N·m",
        "{task.fields[steps_per_second]:.0f}/s",
    )
    with progress_bar(*(one for one in columns if "torque" not in one or console().width >= 100)) as bar:
        rows = {}
        for name, (config, folder) in runs.items():
            unit, total = (
                ("episodes", config.total_episodes) if config.total_episodes else ("steps", config.total_steps)
            )
            nothing: dict[str, Any] = dict.fromkeys(REPORT_COLUMNS, math.nan)
            rows[bar.add_task(name, total=total, unit=unit, **nothing)] = folder / PROGRESS, unit, total or 0

        def show() -> None:
            for row, (file, unit, total) in rows.items():
                report: dict[str, Any] = {name: float(value) for name, value in last_report(file, []).items()}
                if report:
                    bar.update(row, completed=min(int(report[unit]), total), **report)

        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(0.2):
                show()

        follower = threading.Thread(target=follow)
        follower.start()
        try:
            yield
        finally:
            ended.set()
            follower.join()
            show()


def print_evaluations(evaluations: Mapping[str, Evaluation], details: bool = True) -> None:
    """Print the most telling measures in one table, a row for each evaluation by its name, and details below it."""
    for table in evaluation_tables(evaluations, details):
        console().print(table)


def print_checks(checks: Sequence[Check], title: str = "MuJoCo against Gymnasium") -> None:
    """Print one table, a row for each check, and under it where those that failed did so."""
    columns = "check", "samples", "worst", "allowed", "margin", "unit", "verdict"
    rows: list[Any] = []
    for check in checks:
        numbers = f"{check.samples:,}", f"{check.worst:.1e}", f"{check.tolerance:.0e}", check.margin
        verdict = Text("passed", "green") if check.passed else Text("FAILED", "red")
        rows.append((check.name, *numbers, check.unit, verdict))
    print_table(title, columns, rows, right=columns[1:5], whole=("worst", "allowed", "verdict"), **_FRAMED)
    for check in checks:
        if not check.passed:
            say(f"{check.name}, against {check.oracle}: FAILED at {check.where}", style="red")


def print_certificate(certificate: Certificate) -> None:
    """Print a table for each group and task, what was not checked, and the verdict."""
    for group, description in GROUPS.items():
        checks = [check for check in certificate.checks if check.group == group]
        for task in dict.fromkeys(check.task for check in checks):
            title = f"{group}, {task}" if task else f"{group}: {description}"
            print_checks([check for check in checks if check.task == task], title)
    for skip in certificate.skipped:
        say(f"not checked: {skip.group}, {skip.name}: {skip.reason}")
    colour = "green" if certificate.passed else "red"
    form = " (the quick form)" if certificate.quick else ""
    console().print(
        f"[{colour}]{certificate.verdict}[/] of {certificate.subject}{form}, in {certificate.seconds:.0f} s",
        highlight=False,
    )


def print_mutations(caught: Sequence[Caught], blind: Sequence[Check]) -> None:
    """Print one table, a row for each fault made on purpose, and the checks that none of them fails."""
    columns = "fault", "in", "failed", "clearest check", "worst", "allowed", "beyond"
    rows: list[Any] = []
    for outcome in caught:
        check = outcome.clearest
        shown: list[Any] = [Text("MISSED", "red"), "", "", ""]
        if check is not None:
            numbers = f"{check.worst:.1e}", f"{check.tolerance:.0e}", f"{margin(check):.1e}"
            shown = [f"{check.group}: {check.name}", *numbers]
        failed = f"{len(outcome.failed)} of {outcome.made}"
        rows.append((outcome.mutation, outcome.task or "the motor", failed, *shown))
    print_table("Faults made on purpose", columns, rows, right=("failed", *columns[4:]), **_FRAMED)
    for check in blind:
        say(f"no fault fails {check.group}, {check.task}: {check.name}", style="red")
