"""Certificates and the faults that they catch, as tables for a terminal."""

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.text import Text

from codrl_mj.cli.terminal import console, print_table, say
from codrl_mj.validation import GROUPS, Caught, Certificate, Check
from codrl_mj.validation.mutations import margin

_FRAMED: dict[str, Any] = {"box": box.HEAVY_HEAD, "pad_edge": True, "padding": (0, 1)}


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
