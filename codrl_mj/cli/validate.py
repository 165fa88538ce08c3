"""`codrl-mj validate`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from codrl_mj.tasks import TASKS, find_task


@dataclasses.dataclass(frozen=True)
class Validate:
    """Certify that the port is right: every check by name, with its oracle, its tolerance and the worst case found.

    The exit status is 1 if a check fails. Example: codrl-mj validate cartpole --out certificate, or codrl-mj validate
    --model robot.xml (your own model with our motors).
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="{" + ",".join(TASKS) + "}",
            help="What to validate, module:NAME of your own; all tasks if none is named.",
        ),
    ] = ()
    model: Path | None = None
    """MJCF file of your own with any number of our motors, motorised or behind the control callback, to be put through
    the checks that apply to it."""
    quick: bool = False
    """Fewer states, runs and step sizes: seconds instead of minutes."""
    mutations: bool = False
    """Put the certificate to the test as well: make faults on purpose and see which checks fail."""
    out: Path | None = None
    """Folder for the certificate: certificate.json, and certificate.html with plots."""

    def run(self) -> int:
        """Validate and print a table for each group."""
        from codrl_mj.cli.certificate import print_certificate, print_mutations
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.validation import own_model, try_mutations, validate, validate_model
        from codrl_mj.validation.mutations import faulty, unfailed

        if self.model is not None and (self.tasks or self.mutations):
            raise ValueError("--model: give a model or tasks, and no --mutations, which are faults of the tasks")
        tasks = faulty(self.tasks) if self.mutations else self.tasks
        for task in self.tasks:
            find_task(task)
        model = None if self.model is None else own_model.load(self.model)
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
        blind = unfailed(certificate.checks, caught) if caught else []
        if caught:
            print_mutations(caught, blind)
        if self.out is not None:
            from codrl_mj.pages.certificate import write

            for file in write(certificate, self.out, caught):
                print(f"wrote {file}")
        return 0 if certificate.passed and not blind and all(outcome.failed for outcome in caught) else 1
