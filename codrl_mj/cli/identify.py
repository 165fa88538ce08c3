"""`codrl-mj identify`: identify a motor from its bench logs, and the verbs that prepare it."""

import dataclasses
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from codrl_mj.actuators import Drive
from codrl_mj.cli.environments import flag_dataclass
from codrl_mj.cli.motor import MotorName
from codrl_mj.cli.parsing import AsJson, Output, parse_named_numbers
from codrl_mj.cli.terminal import format_number, print_table, print_text, progress_bar
from codrl_mj.fields import command
from codrl_mj.identify.log import Finding, Log
from codrl_mj.identify.plan import Sensing
from codrl_mj.identify.result import Identified
from codrl_mj.identify.synthetic import FREE, Load, Sampler, Sensor

Columns = Annotated[
    str,
    tyro.conf.arg(
        metavar="SIGNAL=COLUMN:UNIT,...",
        help=(
            "Columns of the signals, such as"
            " time=t:s,voltage=duty*vbus:V,current=i:mA,position=q:deg. Signals are voltage,"
            " current, position, velocity, torque, bus, duty, temperature, command and gain;"
            " formulas can contain + - * /, twos_complement(column,16), sign_magnitude(column,11),"
            " unwrap(column,360), atan2(y,x), abs, sign, sqrt, and column[0] of a list"
            " (docs/identify_logs.md)."
        ),
    ),
]
"""Type of a verb's flag `--columns`."""
_FILE = tyro.conf.arg(metavar="LOG", help="Log files: CSV, JSON (both also as .gz) or Parquet.")
Logs = Annotated[tyro.conf.Positional[tuple[Path, ...]], _FILE]
"""Type of a verb's field for log files."""
# A guessed rig would be pasted, and an assumed inertia of 0 falsifies the rotor's.
OPEN_RIG = "RIG"
"""Placeholder in a proposed command for the rig that the user has to fill in."""
_STYLES = {"error": "red", "warning": "yellow", "info": ""}


@dataclasses.dataclass(frozen=True)
class Identify:
    """Identify a motor from its bench logs: parameters, 95 % intervals, and their reliability.

    Voltage and current determine the winding; torque, current or voltage, together with a position
    or velocity, determine inertia, load and friction. The files in the folder --out are
    actuator.yaml, which --actuator accepts, result.json and report.html. A training with this
    actuator and --env.randomize identified draws the parameters from their intervals. If an
    actuator needs a parameter that the logs do not determine, there is no actuator.yaml and the
    exit status is 1, until you give its value with --known. Logs of a torque give a joint.yaml
    instead: friction, damping and armature for --actuator ideal. codrl-mj identify servo fits a
    position servo to its commands and positions. See also codrl-mj identify check, plan and
    simulate, which prepare a fit, and docs/identify.md.

    Example: codrl-mj identify swing1.csv swing2.csv --columns
    time=t:s,voltage=duty*vbus:V,current=i:A,position=q:rad --rig pendulum --known mgl=2.81
    --friction auto --holdout swing3.csv --out motor
    """

    logs: Logs
    columns: Columns
    rig: Literal["pendulum", "free", "load"] | None = None
    """Load on the output: a pendulum that hangs at position 0, only an inertia (free), or an
    inertia and a constant torque, such as a lifted weight (load). The rotor counts as locked in
    logs without motion. Default: pendulum if mgl is known.
    """
    known: tuple[str, ...] = ()
    """Values that are not fitted, as NAME=VALUE in SI units. The values mgl, inertia, load_inertia
    and constant_torque refer to the output. The others are the fields of a drive (resistance,
    inductance, torque_constant, back_emf_constant, gear_ratio, rotor_inertia, coulomb_friction,
    viscous_friction, gear_efficiency, stribeck_friction, stribeck_speed).
    """
    estimate: tuple[str, ...] = ()
    """Parameters to fit that are fixed by default, such as torque_gain."""
    friction: Literal["auto", "coulomb", "stribeck", "load", "both"] = "coulomb"
    """Friction model: coulomb (with viscous friction), stribeck, load (friction that grows with the
    load), both, or auto, which adds the terms that improve the prediction of left-out logs.
    """
    segment: float = 0.5
    """Duration [s] of the simulated segments of a log. Use short segments if the rig is unstable,
    and one or two seconds if the shaft only sticks and slides.
    """
    motor: str | None = None
    """Motor of the catalogue, or a datasheet file, for values that the logs do not determine."""
    holdout: tuple[Path, ...] = ()
    """Logs that are only predicted, not fitted."""
    out: Path | None = None
    """Folder for actuator.yaml, result.json, and report.html with plots of the fit."""
    ignore_errors: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fit the logs even if the checks find errors in them."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Check the logs, fit the parameters, print a table, and write the files."""
        from codrl_mj.identify.identify import check_arguments, identify, predict_missing
        from codrl_mj.identify.log import assign_log_roles
        from codrl_mj.identify.reading import read_log
        from codrl_mj.identify.result import JOINT
        from codrl_mj.sizing import find_drive

        logs, held_out = (
            [read_log(path, self.columns) for path in paths] for paths in (self.logs, self.holdout)
        )
        known = parse_named_numbers("--known", self.known, "mgl=2.81, in SI units")
        base_drive = None if self.motor is None else find_drive(self.motor)
        if base_drive is not None and "gear_ratio" in known:
            base_drive = base_drive.replaced({"motor.gear_ratio": known["gear_ratio"]})
        mapping = None if base_drive is None else base_drive.as_mapping()
        fit_arguments = logs, self.rig, known, self.friction
        all_known = check_arguments(*fit_arguments, self.estimate, self.segment, mapping)
        if problem_text := predict_missing(logs, all_known, mapping):
            file = f", only a {JOINT}" if assign_log_roles(logs).driven_by == "torque" else ""
            print_text(f"there will be no actuator{file}. {problem_text}", style="yellow")
        held_out = self._check(logs, held_out, base_drive)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("identifying", total=1)
            result = identify(
                *fit_arguments,
                held_out,
                self.estimate,
                self.segment,
                mapping,
                lambda label, completed, total: bar.update(
                    row, description=f"fitting: {label}", completed=completed, total=total
                ),
            )
        print_identification(result)
        problem = result.problem()
        if self.out is not None:
            write_files(result, self.out)
        units = {estimate.name: estimate.unit for estimate in result.estimates}
        has_result = problem is None or result.joint_text is not None
        return int(not has_result), result.as_mapping() | {"units": units}

    def _check(self, logs: list[Log], held_out: list[Log], base_drive: Drive | None) -> list[Log]:
        """Print the problems of the logs, and return the held-out logs that have no errors."""
        from codrl_mj.identify.checks import check

        checked_logs = [
            (log, check(log, None if base_drive is None else base_drive.motor, self.rig))
            for log in (*logs, *held_out)
        ]
        bad_logs = [
            log
            for log, findings in checked_logs
            if any(finding.severity == "error" for finding in findings)
        ]
        for log, findings in checked_logs:
            shown_findings = [finding for finding in findings if finding.severity != "info"]
            if shown_findings:
                print_findings(log.name, shown_findings)
        if self.ignore_errors:
            return held_out
        if fitted := [log.name for log in logs if any(log is bad_log for bad_log in bad_logs)]:
            raise ValueError(
                f"logs {', '.join(fitted)} have errors that would make the fit wrong: see"
                " codrl-mj identify check; correct the columns, leave the logs out, or pass"
                " --ignore-errors"
            )
        for log in bad_logs:
            print_text(
                f"warning: the held-out log {log.name} has errors and is left out",
                style="yellow",
            )
        return [log for log in held_out if not any(log is bad_log for bad_log in bad_logs)]


def write_files(result: Identified, folder: Path) -> None:
    """Write the files and the page of an identification, and print their names."""
    from codrl_mj.identify.result import ACTUATOR

    if result.problem() is not None and (folder / ACTUATOR).exists():
        print(
            f"removed {folder / ACTUATOR}: it was from an earlier fit, and this fit has no actuator"
        )
    for path in result.write(folder):
        print(f"wrote {path}")
    write_page(result, folder / "report.html")


def write_page(result: Identified, page: Path) -> None:
    """Write the page of an identification, or print what is missing for it."""
    try:
        # The page needs optional libraries. The results are already on disk, so a missing library
        # is only reported.
        from codrl_mj.viz.pages.identification import identification_page

        identification_page(result, page)
        print(f"wrote {page}")
    except ModuleNotFoundError as error:
        print(
            f"no {page}: {error}; pages need the extra 'validate': pip install 'codrl-mj[validate]'"
        )


def print_identification(result: Identified) -> None:
    """Print parameters and simulation errors, and the notes on them."""
    from codrl_mj.identify.log import SIGNALS
    from codrl_mj.identify.result import USABLE

    rows: list[tuple[str, ...]] = []
    for estimate in result.estimates:
        interval = (
            "" if estimate.status == "given" else f"{estimate.low:.4g} to {estimate.high:.4g}"
        )
        rows.append(
            (
                estimate.name,
                f"{estimate.value:.4g}",
                interval,
                estimate.unit,
                estimate.status,
                estimate.why,
            )
        )
    styles = ["" if estimate.status in USABLE else "yellow" for estimate in result.estimates]
    columns = "parameter", "value", "95 % interval", "unit", "status", "why"
    print_table(
        f"Identified from {', '.join(result.logs)}",
        columns,
        rows,
        columns[1:3],
        ("parameter", "unit"),
        styles,
    )
    rows = [
        (error.log, kind, f"{error.output} {SIGNALS[error.output]}", f"{error.open_loop:.3g}",
         "" if error.closed_loop is None else f"{error.closed_loop:.3g}")
        for kind, errors in (("fitted", result.fitted), ("held out", result.held_out))
        for error in errors
    ]  # fmt: skip
    if rows:
        heads = "log", "", "of", "open loop, 0.5 s", "closed loop"
        print_table("Errors of the simulation, mean absolute", heads, rows, right=heads[3:])
    for part, rows_late in result.delays.items():
        if rows_late:
            print_text(
                f"{part}: the input is late by {rows_late} row{'s' if abs(rows_late) > 1 else ''},"
                " which the fit accounts for"
            )
    print_text(*(f"warning: {text}" for text in result.warnings), style="yellow")
    print_text(result.friction_reason, result.supply_text or "", result.base_text or "")
    if joint_text := result.joint_text:
        print_text(joint_text)
    elif problem := result.problem():
        print_text(f"not to be used as an actuator: {problem}", style="yellow")


@dataclasses.dataclass(frozen=True)
class CheckLogs:
    """Check bench logs before a fit: rows, sensors, delays, signs, units, undetermined parameters.

    The exit status is 1 if a log has errors that would make a fit wrong. Example: codrl-mj identify
    check log.csv --columns time=t:s,voltage=u:V,current=i:A,position=q:rad
    """

    logs: Logs
    columns: Columns
    motor: str | None = None
    """Motor of the catalogue, or a file with a datasheet, whose resistance and back-EMF are
    compared with the log.
    """
    rig: Literal["pendulum", "free", "load"] | None = None
    """Load on the output, as for the fit. Without this flag, the checks allow for a pendulum."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Print a table of findings for each log."""
        from codrl_mj.identify.checks import check
        from codrl_mj.identify.reading import read_log
        from codrl_mj.sizing import find_drive

        motor = None if self.motor is None else find_drive(self.motor).motor
        if not self.logs:
            raise ValueError("no log is given: name one or more files")
        logs = {path: read_log(path, self.columns) for path in self.logs}
        findings_by_path = {path: check(log, motor, self.rig) for path, log in logs.items()}
        for log, findings in zip(logs.values(), findings_by_path.values(), strict=True):
            title = (
                f"{log.name}: {len(log.time)} rows, {log.time[-1]:.4g} s, a row every"
                f" {1e3 * log.step:.4g} ms"
            )
            print_findings(title, findings)
        failed = any(
            finding.severity == "error"
            for findings in findings_by_path.values()
            for finding in findings
        )
        return int(failed), [
            {"log": path, **vars(finding)}
            for path, findings in findings_by_path.items()
            for finding in findings
        ]


def print_findings(title: str, findings: Sequence[Finding]) -> None:
    """Print findings of `codrl_mj.identify.checks.check` as a table, or that there are none."""
    if not findings:
        print_text(f"{title}: no problems found")
        return
    rows = [
        (
            finding.severity,
            finding.check,
            "" if finding.row is None else str(finding.row),
            finding.message,
            finding.remedy,
        )
        for finding in findings
    ]
    styles = [_STYLES[finding.severity] for finding in findings]
    print_table(
        title, ("", "check", "row", "finding", "remedy"), rows, right=["row"], styles=styles
    )


LOAD, SENSING, SAMPLER = (
    flag_dataclass(Load, FREE),
    flag_dataclass(Sensing, Sensing()),
    flag_dataclass(Sampler, Sampler()),
)
"""Dataclasses of the flags for `Load`, `Sensing` and `Sampler`."""


@dataclasses.dataclass(frozen=True)
class PlanExperiment:
    """Plan an experiment: excitation, amplitude and sample rate, with the expected errors.

    It plans voltages for a motor; docs/identify_servo.md lists the commands for a position servo.
    The errors are lower bounds for a motor that agrees with its datasheet; on a real bench they are
    several times larger. Example: codrl-mj identify plan maxon-ec45-flat-50w --inertia 1e-4 --out
    plan
    """

    name: MotorName
    load: tyro.conf.OmitArgPrefixes[LOAD] = LOAD()  # type: ignore[valid-type]
    """Load that the motor turns on the bench."""
    sensing: tyro.conf.OmitArgPrefixes[SENSING] = SENSING()  # type: ignore[valid-type]
    """Measured signals and their accuracy."""
    duration: float = 4.0
    """Duration of the log [s]."""
    max_current: float = math.inf
    """Largest current [A] that the bench allows. The limits of the drive and the datasheet also
    apply.
    """
    out: Path | None = None
    """Folder for excitation.csv, the voltage to apply to the motor."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the options, the best one last."""
        from codrl_mj.identify.plan import GOALS, plan, write_excitation
        from codrl_mj.sizing import find_drive, find_entry

        sensing, entry = Sensing(**vars(self.sensing)), find_entry(self.name)
        continuous_current = None if entry is None else entry.parameters.continuous_current
        limits = self.max_current, math.inf if continuous_current is None else continuous_current
        experiments = plan(
            find_drive(self.name), Load(**vars(self.load)), sensing, self.duration, *limits
        )
        heads = (
            "kHz",
            "V",
            "peak\nA",
            "rms\nA",
            *(f"{_PARAMETER_SYMBOLS[name]}\n≤ {GOALS[name]:.0%}" for name in GOALS),
        )
        rows = []
        for option in experiments.options:
            mark = "*" if option is experiments.best else ""
            values = (
                option.rate / 1e3,
                option.excitation.amplitude,
                option.peak_current,
                option.rms_current,
            )
            errors = (option.errors.get(name) for name in GOALS)
            texts = (format_number(error and 100.0 * error, 2) for error in errors)
            rows.append(
                (f"{mark}{option.excitation.kind}", *(f"{value:.3g}" for value in values), *texts)
            )
        print_table(
            f"{self.name}: errors to be expected [%]",
            ("excitation", *heads),
            rows,
            heads,
            ("excitation", *heads),
            padding=(0, 0),
        )
        best = experiments.best.excitation
        clock = f", a clock of {1e3 * best.clock:.3g} ms" if "prbs" in best.kind else ""
        print_text(
            f"* play {best.kind}, {best.amplitude:.4g} V, {best.duration:g} s{clock}, rows at"
            f" {experiments.best.rate:g} Hz"
        )
        if experiments.missed_goals:
            print_text(
                f"it misses the goals of {', '.join(experiments.missed_goals)}: use a larger"
                " current, a longer log, or other sensors"
            )
        if experiments.unknown:
            print_text(
                f"not predicted: {', '.join(experiments.unknown)}, which the datasheet gives as 0"
            )
        if self.out is not None:
            write_excitation(self.out / "excitation.csv", experiments.best)
            print(
                f"wrote {self.out / 'excitation.csv'}: play each voltage [V] until the time [s] of"
                " the next"
            )
        units = {
            "errors": "1",
            "amplitude": "V",
            "peak_current": "A",
            "rms_current": "A",
            "duration": "s",
            "clock": "s",
        }
        units |= dict.fromkeys(("rate", "frequency", "highest"), "Hz")
        return 0, {"units": units, **experiments._asdict()}


_PARAMETER_SYMBOLS = {
    "resistance": "R",
    "inductance": "L",
    "back_emf_constant": "kE",
    "inertia": "J",
    "coulomb_friction": "Cou-\nlomb",
    "viscous_friction": "vis-\ncous",
}


@dataclasses.dataclass(frozen=True)
class SimulateLog:
    """Simulate a bench log of a motor, with sensors, a sampler and optional faults.

    The command prints the --columns that describe the file. Example: codrl-mj identify simulate
    maxon-ec45-flat-50w --out log.csv.gz --kind prbs --amplitude 12 --inertia 1e-4 --rate 5000
    --sensor current:noise=0.05 position:resolution=0.0015
    """

    name: MotorName
    out: Path
    """File to write, .csv or .csv.gz."""
    load: tyro.conf.OmitArgPrefixes[LOAD] = LOAD()  # type: ignore[valid-type]
    """Load that the motor turns on the bench."""
    kind: Literal["slow_sine", "square", "chirp", "prbs", "locked_prbs"] = "prbs"
    """Kind of the excitation."""
    amplitude: float | None = None
    """Largest voltage [V]; default: half of the supply's."""
    duration: float = 4.0
    """Duration [s]."""
    frequency: float | None = None
    """Frequency of sine and square, and start of the chirp [Hz]; default: 2 for a square, 0.5
    otherwise.
    """
    clock: float | None = None
    """Clock period of a PRBS [s]; default: 4 L/R, four electrical time constants."""
    sampler: tyro.conf.OmitArgPrefixes[SAMPLER] = SAMPLER()  # type: ignore[valid-type]
    """Times at which rows are written."""
    sag: float = 0.0
    """Resistance of the supply [ohm]. The logged voltage does not include the drop across it."""
    sensor: tuple[str, ...] = ()
    """Properties of a sensor as SIGNAL:FIELD=VALUE,..., with the fields noise, resolution and bias
    (in SI units), delay [s], gain, and outliers (share of the rows).
    """
    seed: int = 0
    """Seed of noise, jitter and lost rows."""

    def run(self) -> int:
        """Simulate and write the log."""
        from codrl_mj.actuators import Supply
        from codrl_mj.identify.synthetic import Excitation, simulate, write_log
        from codrl_mj.sizing import find_drive

        if not self.out.name.endswith((".csv", ".csv.gz")):
            raise ValueError(f"out = {self.out}: must end in .csv or .csv.gz")
        drive = find_drive(self.name)
        if self.sag != 0.0:
            drive = drive.replaced({"supply": Supply(drive.voltage_limit, self.sag)})
        clock = 4.0 * drive.motor.electrical_time_constant if self.clock is None else self.clock
        frequency = (
            (2.0 if self.kind == "square" else 0.5) if self.frequency is None else self.frequency
        )
        amplitude = 0.5 * drive.voltage_limit if self.amplitude is None else self.amplitude
        if abs(amplitude) > drive.voltage_limit:
            raise ValueError(
                f"amplitude = {amplitude:g}: must be at most the supply's {drive.voltage_limit:g} V"
            )
        excitation = Excitation(self.kind, amplitude, self.duration, frequency, clock=clock)
        load, sampler = Load(**vars(self.load)), Sampler(**vars(self.sampler))
        log = simulate(drive, excitation, load, _sensors(self.sensor), sampler, self.seed)
        columns = write_log(self.out, log)
        print(f"wrote {self.out}: {len(log.time)} rows; read it with --columns '{columns}'")
        return 0


def is_servo(columns: str) -> bool:
    """Return True if a mapping has commands and positions, but no input of a motor."""
    signals = {entry.partition("=")[0].strip() for entry in columns.split(",")}
    return {"command", "position"} <= signals and not signals & {"voltage", "current", "torque"}


def _sensors(texts: Sequence[str]) -> dict[str, Sensor]:
    from codrl_mj.fields import check_names

    field_names = [field.name for field in dataclasses.fields(Sensor)]
    sensors: dict[str, Sensor] = {}
    for text in texts:
        signal, _, rest = text.partition(":")
        if signal in sensors:
            raise ValueError(
                f"sensor = {text!r}: {signal} is given twice; give all its fields at once,"
                " with commas"
            )
        pairs = [pair.partition("=") for pair in rest.split(",")]
        check_names([name for name, *_ in pairs], field_names, "field of a sensor")
        try:
            sensors[signal] = Sensor(**{name: float(value) for name, _, value in pairs})
        except ValueError as error:
            remedy = "write SIGNAL:FIELD=NUMBER,..., such as current:noise=0.02"
            raise ValueError(f"sensor = {text!r}: {error}; {remedy}") from None
    return sensors


@dataclasses.dataclass(frozen=True)
class ProposeColumns:
    """Propose the --columns of a log from its names, units and values, and print the next command.

    If the unit of a column is unknown, it is printed as UNIT; replace it by the unit, and RIG by
    the load on the output. The exit status is 1 if no parameter can be identified from these
    columns. Example: codrl-mj identify columns log.csv
    """

    log: Annotated[tyro.conf.Positional[Path], _FILE]
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the mapping, the doubtful columns, and the next command."""
        from codrl_mj.identify.columns import OPEN_UNIT
        from codrl_mj.identify.proposal import propose_columns

        proposal = propose_columns(self.log)
        for doubt in proposal.doubts:
            print_text(f"please check: {doubt}")
        if proposal.problem:
            print_text(proposal.problem, style="yellow")
            print(f"--columns {shlex.quote(proposal.columns)}")
            return 1, proposal
        is_open, verb, rig = f":{OPEN_UNIT}" in proposal.columns, "identify", ""
        if not is_open and self._has_errors(proposal.columns):
            verb = "identify check"
        elif is_servo(proposal.columns):
            verb, rig = "identify servo", " --load pendulum --known mass=0.5 length=0.1"
        elif re.search("(position|velocity)=", proposal.columns):
            rig = f" --rig {OPEN_RIG}"
        unit_hint = ", with its unit for each UNIT" if is_open else ""
        out = "" if "check" in verb else " --out motor"
        rig_hint = (
            f"; {OPEN_RIG} is pendulum if a load hangs at position 0, load if the motor lifts one,"
            " and otherwise free (add --known load_inertia=0 if nothing is mounted on the motor)"
        )
        if "servo" in verb:
            rig_hint = (
                ", for a servo with a pendulum of 0.5 kg at 0.1 m (--load free without a load, but"
                " then torques are known only as ratios to the inertia)"
            )
        print_text(f"next{unit_hint}{rig_hint if rig else ''}:")
        print(
            command(
                *verb.split(), self.log, "--columns", proposal.columns, *rig.split(), *out.split()
            )
        )
        return 0, proposal

    def _has_errors(self, columns: str) -> bool:
        """Return True if the checks find errors, so that a fit would be refused."""
        from codrl_mj.identify.checks import check
        from codrl_mj.identify.reading import read_log

        return any(
            finding.severity == "error"
            for finding in check(read_log(self.log, columns), rig="free")
        )
