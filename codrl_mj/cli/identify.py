"""`codrl-mj identify`: a motor from its bench logs, and what is done before."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import tyro

from codrl_mj.cli.identify_tools import TOOLS, Columns, IdentifyTools, Logs
from codrl_mj.cli.motor import AsJson


@dataclasses.dataclass(frozen=True)
class Identify:
    """Identify a motor from its bench logs: every number with an interval, and whether it can be relied on.

    Voltage and current tell the winding; torque, current or voltage, and a position or velocity, tell inertia, load and
    friction. The folder gets actuator.yaml, which --actuator takes, result.json and report.html; --env.randomize
    identified then draws within the intervals. What was not identified is refused until it is given with --known.
    Before that: codrl-mj identify check, plan and simulate. docs/identify.md has more.

    Example: codrl-mj identify swing1.csv swing2.csv --columns time=t:s,voltage=duty*vbus:V,current=i:A,position=q:rad
    --rig pendulum --known mgl=2.81 --friction auto --holdout swing3.csv --out motor
    """

    logs: Logs
    columns: Columns
    rig: Literal["pendulum", "free", "load"] | None = None
    """What the output moves: a pendulum that hangs at position 0, nothing but inertia, or inertia and a held load. A
    log in which nothing moves is of a locked rotor. A pendulum where mgl is known."""
    known: tuple[str, ...] = ()
    """What is not to be fitted, as NAME=VALUE in SI units: mgl, inertia, load_inertia and constant_torque at the
    output, the others (resistance, inductance, torque_constant, back_emf_constant, gear_ratio, rotor_inertia,
    coulomb_friction, viscous_friction, gear_efficiency, stribeck_friction, stribeck_speed) as a drive has them."""
    estimate: tuple[str, ...] = ()
    """What to fit that is otherwise taken as known, such as torque_gain."""
    friction: Literal["auto", "coulomb", "stribeck", "load", "both"] = "coulomb"
    """Viscous and Coulomb friction, or more; auto keeps more where it predicts left-out logs better."""
    segment: float = 0.5
    """Time [s] that the shaft is simulated for at once: short where it tips over by itself, a second or two where it
    only sticks and slides."""
    motor: str | None = None
    """Motor of the catalogue, or a file, that gives what the logs do not tell."""
    holdout: tuple[Path, ...] = ()
    """Logs that are only predicted."""
    out: Path | None = None
    """Folder for actuator.yaml, result.json, and report.html with what the fit looks like."""
    ignore_errors: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fit logs that the checks find errors in."""
    as_json: AsJson = False

    @classmethod
    def for_line(cls, words: Sequence[str]) -> Any:
        """The fit, or what is done before."""
        return IdentifyTools if words[:1] and words[0] in TOOLS else cls

    def run(self) -> int:
        """Check the logs, fit, print a table, write the files."""
        from codrl_mj.cli.terminal import console, progress_bar
        from codrl_mj.identify.identify import checked, foreseen, identify
        from codrl_mj.identify.reading import read_log
        from codrl_mj.motor_design import find_drive

        logs, held_out = ([read_log(path, self.columns) for path in paths] for paths in (self.logs, self.holdout))
        known = _numbers(self.known)
        base: Any = None if self.motor is None else find_drive(self.motor)
        if base is not None and "gear_ratio" in known:
            base = base.replaced({"motor.gear_ratio": known["gear_ratio"]})
        mapping = base and base.as_mapping()
        wanted = logs, self.rig, known, self.friction
        known_too = checked(*wanted, self.estimate, self.segment, mapping)
        if (lacking := foreseen(logs, known_too, mapping)) and not self.as_json:
            console().print(f"there will be no actuator. {lacking}", markup=False, highlight=False, style="yellow")
        held_out = self._check(logs, held_out, base)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("identifying", total=1)
            found = identify(
                *wanted,
                held_out,
                self.estimate,
                self.segment,
                mapping,
                lambda what, done, total: bar.update(row, description=f"fitting: {what}", completed=done, total=total),
            )
        if self.as_json:
            console().print_json(data=found.as_mapping())
        else:
            print_identified(found)
        if self.out is not None:
            for path in found.write(self.out):
                if not self.as_json:
                    print(f"wrote {path}")
            self._write_page(found, self.out / "report.html")
        return 0

    def _write_page(self, found: Any, path: Path) -> None:
        """Write the page, where what draws it is installed: the numbers are written already."""
        try:
            from codrl_mj.pages.identification import identification_page

            identification_page(found, path)
            told = f"wrote {path}"
        except ModuleNotFoundError as error:
            told = f"no {path}: {error}; pages need the extra 'validate': pip install 'codrl-mj[validate]'"
        if not self.as_json:
            print(told)

    def _check(self, logs: list[Any], held_out: list[Any], base: Any) -> list[Any]:
        """Print what is wrong with the logs; returns those held out that have no errors."""
        from codrl_mj.cli.identify_tools import findings_table
        from codrl_mj.cli.terminal import console
        from codrl_mj.identify.checks import check

        found = [(log, check(log, base and base.motor, self.rig)) for log in (*logs, *held_out)]
        wrong = [log for log, findings in found if any(one.severity == "error" for one in findings)]
        for log, findings in found:
            worth = [one for one in findings if one.severity != "info"]
            if worth and not self.as_json:
                console().print(findings_table(log.name, worth))
        if self.ignore_errors:
            return held_out
        if fitted := [log.name for log in logs if any(log is one for one in wrong)]:
            raise ValueError(
                f"logs {', '.join(fitted)} have errors, with which a fit would be wrong: see codrl-mj identify check; "
                "correct the columns, leave the logs out, or pass --ignore-errors"
            )
        for log in wrong:
            text = f"warning: {log.name}, which is held out, has errors, and is left out"
            console().print(text, markup=False, highlight=False, style="yellow")
        return [log for log in held_out if not any(log is one for one in wrong)]


def _numbers(texts: tuple[str, ...]) -> dict[str, float]:
    """NAME=VALUE, each."""
    found: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name in found:
            raise ValueError(f"known {name}: given twice; give it one value")
        try:
            found[name] = float(value)
        except ValueError:
            raise ValueError(f"known {text!r}: must be NAME=NUMBER in SI units, such as mgl=2.81") from None
    return found


def print_identified(found: Any) -> None:
    """Print parameters and errors of the simulation, and what is to be known of them."""
    from rich.markup import escape

    from codrl_mj.cli.terminal import console, titled_table
    from codrl_mj.identify.log import SIGNALS
    from codrl_mj.identify.result import USABLE

    columns = "parameter", "value", "95 % interval", "unit", "status", "why"
    table = titled_table(f"Identified from {', '.join(found.logs)}", columns, right=columns[1:3])
    for one in found.estimates:
        interval = "" if one.status == "given" else f"{one.low:.4g} to {one.high:.4g}"
        texts = one.name, f"{one.value:.4g}", interval, one.unit, one.status, one.why
        table.add_row(*map(escape, texts), style="" if one.status in USABLE else "yellow")
    console().print(table)
    rows = [
        (one.log, kind, f"{one.output} {SIGNALS[one.output]}", f"{one.open_loop:.3g}",
         "" if one.closed_loop is None else f"{one.closed_loop:.3g}")
        for kind, several in (("fitted", found.fitted), ("held out", found.held_out)) for one in several
    ]  # fmt: skip
    if rows:
        heads = "log", "", "of", "open loop, 0.5 s", "closed loop"
        console().print(titled_table("Errors of the simulation, mean absolute", heads, rows, right=heads[3:]))
    for part, late in found.delays.items():
        if late:
            print(f"{part}: the input is late by {late} row{'s' if abs(late) > 1 else ''}, which is allowed for")
    for text in found.warnings:
        console().print(f"warning: {text}", markup=False, highlight=False, style="yellow")
    if found.supply_text:
        print(found.supply_text)
    problem = found.problem()
    if problem:
        console().print(f"not to be used as an actuator: {problem}", markup=False, highlight=False, style="yellow")
