"""`codrl-mj identify servo`: identify a position servo from its commands and its encoder."""

import dataclasses
from pathlib import Path
from typing import Literal

import tyro

from codrl_mj.cli.identify import (
    Columns,
    Logs,
    print_findings,
    print_identification,
    write_files,
)
from codrl_mj.cli.parsing import AsJson, Output, parse_named_numbers
from codrl_mj.cli.terminal import progress_bar
from codrl_mj.identify.log import Log


@dataclasses.dataclass(frozen=True)
class IdentifyServo:
    """Identify a position servo from logs of its commands and its encoder.

    With a pendulum of a known mass and length at its output, the logs determine the delay of the
    commands, the position gain, damping, friction, inertia and, if it is reached, the stall torque.
    Without a known load only ratios to the inertia can be told. The columns duty, bus (the input
    voltage) and gain (the register of the position gain, if it differs between logs) are used if
    they are mapped. The files in the folder --out are actuator.yaml (family pwm_servo), result.json
    and report.html. See docs/identify_servo.md.

    Example: codrl-mj identify servo swing1.csv swing2.csv --columns
    time=t:s,command=goal:rad,position=present:rad --load pendulum --known mass=0.49 length=0.1
    --holdout swing3.csv --out servo
    """

    logs: Logs
    columns: Columns
    load: Literal["pendulum", "free"] = "pendulum"
    """Load at the output: a pendulum that hangs near position 0, or only an inertia (free)."""
    known: tuple[str, ...] = ()
    """Values that are not fitted, as NAME=VALUE in SI units at the output: mass and length of the
    pendulum (or mgl and load_inertia), armature, stall_torque, resistance, supply_voltage and
    others.
    """
    estimate: tuple[str, ...] = ()
    """Parameters to fit that are fixed by default: max_velocity, if the firmware limits the speed
    of its target, or load_inertia.
    """
    friction: Literal["auto", "coulomb", "stribeck", "load", "both"] = "coulomb"
    """Friction model, as for codrl-mj identify."""
    segment: float = 1.0
    """Duration [s] of the simulated segments of a log."""
    holdout: tuple[Path, ...] = ()
    """Logs that are only predicted, not fitted."""
    out: Path | None = None
    """Folder for actuator.yaml, result.json, and report.html with plots of the fit."""
    ignore_errors: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fit the logs even if the checks find errors in them."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Check the logs, fit the servo, print a table, and write the files."""
        from codrl_mj.identify.reading import read_log
        from codrl_mj.identify.servo import identify_servo

        logs, held_out = (
            [read_log(path, self.columns) for path in paths] for paths in (self.logs, self.holdout)
        )
        known = parse_named_numbers("--known", self.known, "mass=0.49, in SI units")
        self._check([*logs, *held_out])
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("identifying", total=1)
            result = identify_servo(
                logs,
                self.load,
                known,
                self.friction,
                held_out,
                self.estimate,
                self.segment,
                lambda label, completed, total: bar.update(
                    row, description=f"fitting: {label}", completed=completed, total=total
                ),
            )
        print_identification(result)
        problem = result.problem()
        if self.out is not None:
            write_files(result, self.out)
        units = {estimate.name: estimate.unit for estimate in result.estimates}
        return int(problem is not None), result.as_mapping() | {"units": units}

    def _check(self, logs: list[Log]) -> None:
        """Print the findings of the checks; raise if there is an error."""
        from codrl_mj.identify.checks import check

        bad = []
        for log in logs:
            findings = [
                finding for finding in check(log, rig=self.load) if finding.severity != "info"
            ]
            if findings:
                print_findings(log.name, findings)
            if any(finding.severity == "error" for finding in findings):
                bad.append(log.name)
        if bad and not self.ignore_errors:
            raise ValueError(
                f"logs {', '.join(bad)} have errors that would make the fit wrong: correct the"
                " columns, leave the logs out, or pass --ignore-errors"
            )
