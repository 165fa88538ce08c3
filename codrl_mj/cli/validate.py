"""`codrl-mj validate`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.text import Text

from codrl_mj.cli.parsing import AsJson
from codrl_mj.cli.terminal import console, print_table, progress_bar, say
from codrl_mj.tasks import TASKS
from codrl_mj.validation import GROUPS, Certificate, Check, MutationResult


@dataclasses.dataclass(frozen=True)
class Validate:
    """Certify that the port is right: every check by name, with its oracle, its tolerance and the worst case found.

    The exit status is 1 if a check fails. Example: codrl-mj validate cartpole --out certificate, or
    codrl-mj validate --model robot.xml (your own model with our motors).
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="{" + ",".join(TASKS) + "}",
            help="What to validate, module:NAME of your own; all tasks if none is named.",
        ),
    ] = ()
    model: Path | None = None
    """MJCF file of your own with any number of our motors, motorised or behind the control
    callback, to be put through the checks that apply to it.
    """
    quick: bool = False
    """Fewer states, runs and step sizes: seconds instead of minutes."""
    mutations: bool = False
    """Put the certificate to the test as well: make faults on purpose and see which checks fail."""
    out: Path | None = None
    """Folder for the certificate: certificate.json, and certificate.html with plots."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Validate and print a table for each group."""
        from codrl_mj.validation import own_model, try_mutations, validate, validate_model
        from codrl_mj.validation.mutations import as_mapping, mutation_tasks, undetected_checks

        if self.model is not None and (self.tasks or self.mutations):
            raise ValueError(
                "--model: give a model or tasks, and no --mutations, which are faults of the tasks"
            )
        tasks = mutation_tasks(self.tasks) if self.mutations else self.tasks or None
        model = None if self.model is None else own_model.load_model(self.model)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("validating", total=None)

            def show(done: int, total: int, name: str) -> None:
                bar.update(row, completed=done, total=total, description=f"validating: {name}")

            if model is not None:
                certificate = validate_model(model, str(self.model), quick=self.quick, on_part=show)
            else:
                certificate = validate(tasks, quick=self.quick, on_part=show)
            caught = try_mutations(tasks, on_part=show) if self.mutations else []
        print_certificate(certificate)
        blind = undetected_checks(certificate.checks, caught) if caught else []
        if caught:
            print_mutations(caught, blind)
        if self.out is not None:
            from codrl_mj.viz.pages.certificate import write

            for file in write(certificate, self.out, caught):
                print(f"wrote {file}")
        failed = not certificate.passed or blind or not all(outcome.failed for outcome in caught)
        return int(bool(failed)), certificate.as_mapping() | as_mapping(certificate, caught)


_FRAMED: dict[str, Any] = {"box": box.HEAVY_HEAD, "pad_edge": True, "padding": (0, 1)}


def print_checks(checks: Sequence[Check], title: str = "MuJoCo against Gymnasium") -> None:
    """Print one table, a row for each check, and under it where those that failed did so."""
    columns = "check", "samples", "worst", "allowed", "margin", "unit", "verdict"
    rows: list[Any] = []
    for check in checks:
        numbers = f"{check.samples:,}", f"{check.worst:.1e}", f"{check.tolerance:.0e}", check.margin
        verdict = Text("passed", "green") if check.passed else Text("FAILED", "red")
        rows.append((check.name, *numbers, check.unit, verdict))
    print_table(
        title, columns, rows, right=columns[1:5], whole=("worst", "allowed", "verdict"), **_FRAMED
    )
    for check in checks:
        if not check.passed:
            said = f". Whose fault: {check.fault}" if check.fault else ""
            say(f"{check.name}, against {check.oracle}: FAILED at {check.where}{said}", style="red")


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
        f"[{colour}]{certificate.verdict}[/] of {certificate.subject}{form}, in"
        f" {certificate.seconds:.0f} s",
        highlight=False,
    )


def print_mutations(caught: Sequence[MutationResult], blind: Sequence[Check]) -> None:
    """Print one table, a row for each fault made on purpose, and the checks that none of them fails."""
    columns = "fault", "in", "failed", "clearest check", "worst", "allowed", "beyond"
    rows: list[Any] = []
    for outcome in caught:
        check = outcome.clearest_failure
        shown: list[Any] = [Text("MISSED", "red"), "", "", ""]
        if check is not None:
            numbers = f"{check.worst:.1e}", f"{check.tolerance:.0e}", f"{check.tolerance_ratio:.1e}"
            shown = [f"{check.group}: {check.name}", *numbers]
        failed = f"{len(outcome.failed)} of {outcome.num_checks}"
        rows.append((outcome.mutation, outcome.task or "the motor", failed, *shown))
    print_table("Faults made on purpose", columns, rows, right=("failed", *columns[4:]), **_FRAMED)
    for check in blind:
        say(f"no fault fails {check.group}, {check.task}: {check.name}", style="red")
