"""`codrl-mj validate`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich import box
from rich.console import RenderableType
from rich.text import Text

from codrl_mj.boundary import Argument
from codrl_mj.cli.parsing import AsJson, Output
from codrl_mj.cli.terminal import console, print_table, print_text, progress_bar
from codrl_mj.tasks import TASKS
from codrl_mj.validation import GROUPS, Certificate, Check, MutationResult


@dataclasses.dataclass(frozen=True)
class Validate:
    """Check tasks and motors against independent references, and write a certificate.

    The tables show the tolerance and the worst case of each check. The exit status is 1 if a check
    fails.

    Example: codrl-mj validate cartpole --out certificate, or codrl-mj validate --model robot.xml
    (your own model with our motors).
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="{" + ",".join(TASKS) + "}",
            help="Tasks to validate, or your own task as module:NAME; default: all built-in tasks.",
        ),
    ] = ()
    model: Path | None = None
    """Your own MJCF file, on which the applicable checks are run. It can have any number of our
    motors, added to the model or run by the control callback.
    """
    quick: bool = False
    """Use fewer states, runs and step sizes, which takes seconds instead of minutes."""
    mutations: bool = False
    """Also test the checks themselves: inject faults, and list the checks that detect them."""
    out: Path | None = None
    """Folder for the certificate: certificate.json, and certificate.html with plots."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Validate and print a table for each group."""
        from codrl_mj.validation import own_model, try_mutations, validate, validate_model
        from codrl_mj.validation.mutations import as_mapping, mutation_tasks, undetected_checks

        if self.model is not None and (self.tasks or self.mutations):
            raise ValueError(
                "--model: give either a model or tasks; --mutations works only with tasks"
            )
        tasks = mutation_tasks(self.tasks) if self.mutations else self.tasks or None
        model = None if self.model is None else own_model.load_model(self.model)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("validating", total=None)

            def show(completed: int, total: int, name: str) -> None:
                bar.update(row, completed=completed, total=total, description=f"validating: {name}")

            if model is not None:
                certificate = validate_model(model, str(self.model), quick=self.quick, on_part=show)
            else:
                certificate = validate(tasks, quick=self.quick, on_part=show)
            results = try_mutations(tasks, on_part=show) if self.mutations else []
        print_certificate(certificate)
        never_failed = undetected_checks(certificate.checks, results) if results else []
        if results:
            print_mutations(results, never_failed)
        if self.out is not None:
            from codrl_mj.viz.pages.certificate import write

            for file in write(certificate, self.out, results):
                print(f"wrote {file}")
        failed = (
            not certificate.passed or never_failed or not all(outcome.failed for outcome in results)
        )
        return int(bool(failed)), certificate.as_mapping() | as_mapping(certificate, results)


_FRAMED: dict[str, Argument] = {"box": box.HEAVY_HEAD, "pad_edge": True, "padding": (0, 1)}


def print_checks(checks: Sequence[Check], title: str = "MuJoCo against Gymnasium") -> None:
    """Print one table with a row for each check, and below it the details of failed checks."""
    columns = "check", "samples", "worst", "allowed", "margin", "unit", "verdict"
    rows: list[tuple[RenderableType, ...]] = []
    for check in checks:
        numbers = f"{check.samples:,}", f"{check.worst:.1e}", f"{check.tolerance:.0e}", check.margin
        verdict = Text("passed", "green") if check.passed else Text("FAILED", "red")
        rows.append((check.name, *numbers, check.unit, verdict))
    print_table(
        title, columns, rows, right=columns[1:5], whole=("worst", "allowed", "verdict"), **_FRAMED
    )
    for check in checks:
        if not check.passed:
            fault_text = f". Likely cause: {check.fault}" if check.fault else ""
            print_text(
                f"{check.name}, against {check.oracle}: FAILED at {check.where}{fault_text}",
                style="red",
            )


def print_certificate(certificate: Certificate) -> None:
    """Print a table for each group and task, the skipped checks, and the verdict."""
    for group, description in GROUPS.items():
        checks = [check for check in certificate.checks if check.group == group]
        for task in dict.fromkeys(check.task for check in checks):
            title = f"{group}, {task}" if task else f"{group}: {description}"
            print_checks([check for check in checks if check.task == task], title)
    for skip in certificate.skipped:
        print_text(f"not checked: {skip.group}, {skip.name}: {skip.reason}")
    color = "green" if certificate.passed else "red"
    form = " (the quick form)" if certificate.quick else ""
    console().print(
        f"[{color}]{certificate.verdict}[/] of {certificate.subject}{form}, in"
        f" {certificate.seconds:.0f} s",
        highlight=False,
    )


def print_mutations(results: Sequence[MutationResult], never_failed: Sequence[Check]) -> None:
    """Print one table with a row for each injected fault, and the checks that no fault fails."""
    columns = "fault", "in", "failed", "clearest check", "worst", "allowed", "beyond"
    rows: list[tuple[RenderableType, ...]] = []
    for outcome in results:
        check = outcome.clearest_failure
        shown: list[RenderableType] = [Text("MISSED", "red"), "", "", ""]
        if check is not None:
            numbers = f"{check.worst:.1e}", f"{check.tolerance:.0e}", f"{check.tolerance_ratio:.1e}"
            shown = [f"{check.group}: {check.name}", *numbers]
        failed = f"{len(outcome.failed)} of {outcome.num_checks}"
        rows.append((outcome.mutation, outcome.task or "the motor", failed, *shown))
    print_table("Injected faults", columns, rows, right=("failed", *columns[4:]), **_FRAMED)
    for check in never_failed:
        print_text(f"no fault fails {check.group}, {check.task}: {check.name}", style="red")
