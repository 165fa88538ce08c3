"""`codrl-mj identify`: a motor from its bench logs; and `check`, `columns`, `plan` and `simulate`, done before."""

import dataclasses
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.environments import flags
from codrl_mj.cli.motor import MotorName
from codrl_mj.cli.parsing import AsJson, named_numbers
from codrl_mj.cli.terminal import number, print_table, progress_bar, say
from codrl_mj.fields import command
from codrl_mj.identify.plan import Sensing
from codrl_mj.identify.synthetic import FREE, Load, Sampler

Columns = Annotated[
    str,
    tyro.conf.arg(
        metavar="SIGNAL=COLUMN:UNIT,...",
        help=(
            "What the columns are, as time=t:s,voltage=duty*vbus:V,current=i:mA,position=q:deg."
            " Signals are voltage, current, position, velocity, torque, bus, duty, temperature and"
            " command; formulas have + - * /, twos_complement(column,16),"
            " sign_magnitude(column,11), unwrap(column,360), atan2(y,x), abs, sign, sqrt, column[0]"
            " of a list: docs/identify_logs.md."
        ),
    ),
]
"""Type of a verb's flag `--columns`."""
_FILE = tyro.conf.arg(metavar="LOG", help="CSV, JSON (or .gz), Parquet.")
Logs = Annotated[tyro.conf.Positional[tuple[Path, ...]], _FILE]
"""Type of a verb's files."""
_STYLES = {"error": "red", "warning": "yellow", "info": ""}


@dataclasses.dataclass(frozen=True)
class Identify:
    """Identify a motor from its bench logs: every number with an interval, and whether it can be relied on.

    Voltage and current tell the winding; torque, current or voltage, and a position or velocity,
    tell inertia, load and friction. The folder gets actuator.yaml, which --actuator takes,
    result.json and report.html; --env.randomize identified then draws within the intervals. What
    was not identified is refused until it is given with --known: the exit status is 1 then, and
    there is no actuator.yaml. Before that: codrl-mj identify check, plan and simulate.
    docs/identify.md has more.

    Example: codrl-mj identify swing1.csv swing2.csv --columns
    time=t:s,voltage=duty*vbus:V,current=i:A,position=q:rad --rig pendulum --known mgl=2.81
    --friction auto --holdout swing3.csv --out motor
    """

    logs: Logs
    columns: Columns
    rig: Literal["pendulum", "free", "load"] | None = None
    """What the output moves: a pendulum that hangs at position 0, nothing but inertia, or inertia
    and a held load. A log in which nothing moves is of a locked rotor. A pendulum where mgl is
    known.
    """
    known: tuple[str, ...] = ()
    """What is not to be fitted, as NAME=VALUE in SI units: mgl, inertia, load_inertia and
    constant_torque at the output, the others (resistance, inductance, torque_constant,
    back_emf_constant, gear_ratio, rotor_inertia, coulomb_friction, viscous_friction,
    gear_efficiency, stribeck_friction, stribeck_speed) as a drive has them.
    """
    estimate: tuple[str, ...] = ()
    """What to fit that is otherwise taken as known, such as torque_gain."""
    friction: Literal["auto", "coulomb", "stribeck", "load", "both"] = "coulomb"
    """Viscous and Coulomb friction, or more; auto keeps more where it predicts left-out logs better."""
    segment: float = 0.5
    """Time [s] that the shaft is simulated for at once: short where it tips over by itself, a
    second or two where it only sticks and slides.
    """
    motor: str | None = None
    """Motor of the catalogue, or a file, that gives what the logs do not tell."""
    holdout: tuple[Path, ...] = ()
    """Logs that are only predicted."""
    out: Path | None = None
    """Folder for actuator.yaml, result.json, and report.html with what the fit looks like."""
    ignore_errors: tyro.conf.FlagCreatePairsOff[bool] = False
    """Fit logs that the checks find errors in."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Check the logs, fit, print a table, write the files."""
        from codrl_mj.identify.identify import checked, foreseen, identify
        from codrl_mj.identify.reading import read_log
        from codrl_mj.identify.result import ACTUATOR
        from codrl_mj.sizing import find_drive

        logs, held_out = (
            [read_log(path, self.columns) for path in paths] for paths in (self.logs, self.holdout)
        )
        known = named_numbers("--known", self.known, "mgl=2.81, in SI units")
        base: Any = None if self.motor is None else find_drive(self.motor)
        if base is not None and "gear_ratio" in known:
            base = base.replaced({"motor.gear_ratio": known["gear_ratio"]})
        mapping = base and base.as_mapping()
        wanted = logs, self.rig, known, self.friction
        known_too = checked(*wanted, self.estimate, self.segment, mapping)
        if lacking := foreseen(logs, known_too, mapping):
            say(f"there will be no actuator. {lacking}", style="yellow")
        held_out = self._check(logs, held_out, base)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("identifying", total=1)
            found = identify(
                *wanted,
                held_out,
                self.estimate,
                self.segment,
                mapping,
                lambda what, done, total: bar.update(
                    row, description=f"fitting: {what}", completed=done, total=total
                ),
            )
        print_identified(found)
        problem = found.problem()
        if self.out is not None:
            if problem is not None and (self.out / ACTUATOR).exists():
                print(
                    f"removed {self.out / ACTUATOR}: it was an earlier fit's, and this one has no"
                    " actuator"
                )
            for path in found.write(self.out):
                print(f"wrote {path}")
            page = self.out / "report.html"
            try:  # where what draws it is installed: the numbers are written already
                from codrl_mj.viz.pages.identification import identification_page

                identification_page(found, page)
                print(f"wrote {page}")
            except ModuleNotFoundError as error:
                print(
                    f"no {page}: {error}; pages need the extra 'validate': pip install"
                    " 'codrl-mj[validate]'"
                )
        units = {one.name: one.unit for one in found.estimates}
        return int(problem is not None), found.as_mapping() | {"units": units}

    def _check(self, logs: list[Any], held_out: list[Any], base: Any) -> list[Any]:
        """Print what is wrong with the logs; returns those held out that have no errors."""
        from codrl_mj.identify.checks import check

        found = [(log, check(log, base and base.motor, self.rig)) for log in (*logs, *held_out)]
        wrong = [log for log, findings in found if any(one.severity == "error" for one in findings)]
        for log, findings in found:
            worth = [one for one in findings if one.severity != "info"]
            if worth:
                print_findings(log.name, worth)
        if self.ignore_errors:
            return held_out
        if fitted := [log.name for log in logs if any(log is one for one in wrong)]:
            raise ValueError(
                f"logs {', '.join(fitted)} have errors, with which a fit would be wrong: see"
                " codrl-mj identify check; correct the columns, leave the logs out, or pass"
                " --ignore-errors"
            )
        for log in wrong:
            say(
                f"warning: {log.name}, which is held out, has errors, and is left out",
                style="yellow",
            )
        return [log for log in held_out if not any(log is one for one in wrong)]


def print_identified(found: Any) -> None:
    """Print parameters and errors of the simulation, and what is to be known of them."""
    from codrl_mj.identify.log import SIGNALS
    from codrl_mj.identify.result import USABLE

    rows: list[Any] = []
    for one in found.estimates:
        interval = "" if one.status == "given" else f"{one.low:.4g} to {one.high:.4g}"
        rows.append((one.name, f"{one.value:.4g}", interval, one.unit, one.status, one.why))
    styles = ["" if one.status in USABLE else "yellow" for one in found.estimates]
    columns = "parameter", "value", "95 % interval", "unit", "status", "why"
    print_table(
        f"Identified from {', '.join(found.logs)}",
        columns,
        rows,
        columns[1:3],
        ("parameter", "unit"),
        styles,
    )
    rows = [
        (one.log, kind, f"{one.output} {SIGNALS[one.output]}", f"{one.open_loop:.3g}",
         "" if one.closed_loop is None else f"{one.closed_loop:.3g}")
        for kind, several in (("fitted", found.fitted), ("held out", found.held_out)) for one in several
    ]  # fmt: skip
    if rows:
        heads = "log", "", "of", "open loop, 0.5 s", "closed loop"
        print_table("Errors of the simulation, mean absolute", heads, rows, right=heads[3:])
    for part, late in found.delays.items():
        if late:
            say(
                f"{part}: the input is late by {late} row{'s' if abs(late) > 1 else ''}, which is"
                " allowed for"
            )
    say(*(f"warning: {text}" for text in found.warnings), style="yellow")
    say(found.friction_reason, found.supply_text or "", found.base_text or "")
    if problem := found.problem():
        say(f"not to be used as an actuator: {problem}", style="yellow")


@dataclasses.dataclass(frozen=True)
class CheckLogs:
    """Check bench logs before anything is fitted to them: rows, sensors, lags, signs, units, what does not show.

    Exit status 1 if a log has errors, with which a fit would be wrong. Example: codrl-mj identify
    check log.csv --columns time=t:s,voltage=u:V,current=i:A,position=q:rad
    """

    logs: Logs
    columns: Columns
    motor: str | None = None
    """Motor of the catalogue, or a file with a datasheet, that resistance and back-EMF are compared with."""
    rig: Literal["pendulum", "free", "load"] | None = None
    """What the output moves, as for the fit; where it is not said, it may be a pendulum."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print a table for each log."""
        from codrl_mj.identify.checks import check
        from codrl_mj.identify.reading import read_log
        from codrl_mj.sizing import find_drive

        motor = None if self.motor is None else find_drive(self.motor).motor
        if not self.logs:
            raise ValueError("no log is given: name one or more files")
        logs = {path: read_log(path, self.columns) for path in self.logs}
        found = {path: check(log, motor, self.rig) for path, log in logs.items()}
        for log, findings in zip(logs.values(), found.values(), strict=True):
            title = (
                f"{log.name}: {len(log.time)} rows, {log.time[-1]:.4g} s, a row every"
                f" {1e3 * log.step:.4g} ms"
            )
            print_findings(title, findings)
        failed = any(one.severity == "error" for findings in found.values() for one in findings)
        return int(failed), [
            {"log": path, **vars(one)} for path, findings in found.items() for one in findings
        ]


def print_findings(title: str, findings: Sequence[Any]) -> None:
    """Print findings of `codrl_mj.identify.checks.check` as a table, or a line where there are none."""
    if not findings:
        say(f"{title}: nothing is wrong with it")
        return
    rows = [
        (one.severity, one.check, "" if one.row is None else str(one.row), one.message, one.remedy)
        for one in findings
    ]
    styles = [_STYLES[one.severity] for one in findings]
    print_table(title, ("", "check", "row", "what", "remedy"), rows, right=["row"], styles=styles)


LOAD, SENSING, SAMPLER = flags(Load, FREE), flags(Sensing, Sensing()), flags(Sampler, Sampler())
"""Their fields as flags."""


@dataclasses.dataclass(frozen=True)
class PlanExperiment:
    """Plan an experiment: which excitation, sample rate and amplitude a motor needs, and what each would tell.

    The errors are those to be expected at best, of a motor that is about as its datasheet says; of
    a drive at the bench they are some times larger. Example: codrl-mj identify plan
    maxon-ec45-flat-50w --inertia 1e-4 --out plan
    """

    name: MotorName
    load: tyro.conf.OmitArgPrefixes[LOAD] = LOAD()  # type: ignore[valid-type]
    """What the motor turns on the bench."""
    sensing: tyro.conf.OmitArgPrefixes[SENSING] = SENSING()  # type: ignore[valid-type]
    """What is measured, how well."""
    duration: float = 4.0
    """Of a log [s]."""
    max_current: float = math.inf
    """Largest current [A] that the bench allows; that of the drive and the continuous one of a datasheet count too."""
    out: Path | None = None
    """Folder for excitation.csv: the voltage to play."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the options, the best one last."""
        from codrl_mj.identify.plan import GOALS, plan, write_excitation
        from codrl_mj.sizing import find_drive, find_entry

        sensing, entry = Sensing(**vars(self.sensing)), find_entry(self.name)
        bears = None if entry is None else entry.parameters.continuous_current
        limits = self.max_current, math.inf if bears is None else bears
        found = plan(
            find_drive(self.name), Load(**vars(self.load)), sensing, self.duration, *limits
        )
        heads = (
            "kHz",
            "V",
            "peak\nA",
            "rms\nA",
            *(f"{_SHORT[name]}\n≤ {GOALS[name]:.0%}" for name in GOALS),
        )
        rows = []
        for option in found.options:
            mark = "*" if option is found.best else ""
            values = (
                option.rate / 1e3,
                option.excitation.amplitude,
                option.peak_current,
                option.rms_current,
            )
            errors = (option.errors.get(name) for name in GOALS)
            texts = (number(error and 100.0 * error, 2) for error in errors)
            rows.append(
                (f"{mark}{option.excitation.kind}", *(f"{one:.3g}" for one in values), *texts)
            )
        print_table(
            f"{self.name}: errors to be expected [%]",
            ("excitation", *heads),
            rows,
            heads,
            ("excitation", *heads),
            padding=(0, 0),
        )
        best = found.best.excitation
        clock = f", a clock of {1e3 * best.clock:.3g} ms" if "prbs" in best.kind else ""
        say(
            f"* play {best.kind}, {best.amplitude:.4g} V, {best.duration:g} s{clock}, rows at"
            f" {found.best.rate:g} Hz"
        )
        if found.missed:
            say(
                f"it misses the goals of {', '.join(found.missed)}: a larger current, a longer log,"
                " or other sensors"
            )
        if found.unknown:
            say(f"nothing is said of {', '.join(found.unknown)}: 0 on the datasheet")
        if self.out is not None:
            write_excitation(self.out / "excitation.csv", found.best)
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
        return 0, {"units": units, **found._asdict()}


_SHORT = {
    "resistance": "R",
    "inductance": "L",
    "back_emf_constant": "kE",
    "inertia": "J",
    "coulomb_friction": "Cou-\nlomb",
    "viscous_friction": "vis-\ncous",
}


@dataclasses.dataclass(frozen=True)
class SimulateLog:
    """Simulate a bench log of a motor, through sensors and a sampler, with faults to order.

    Prints the --columns that read the file. Example: codrl-mj identify simulate maxon-ec45-flat-50w
    --out log.csv.gz --kind prbs --amplitude 12 --inertia 1e-4 --rate 5000 --sensor
    current:noise=0.05 position:resolution=0.0015
    """

    name: MotorName
    out: Path
    """File to write, .csv or .csv.gz."""
    load: tyro.conf.OmitArgPrefixes[LOAD] = LOAD()  # type: ignore[valid-type]
    """What the motor turns on the bench."""
    kind: Literal["slow_sine", "square", "chirp", "prbs", "locked_prbs"] = "prbs"
    """Excitation."""
    amplitude: float | None = None
    """Largest voltage [V]; half of the supply's unless given."""
    duration: float = 4.0
    """[s]"""
    frequency: float | None = None
    """Of sine and square, where the chirp begins [Hz]; 2 of a square, 0.5 of others."""
    clock: float | None = None
    """Of a PRBS [s]; 4 L/R unless given."""
    sampler: tyro.conf.OmitArgPrefixes[SAMPLER] = SAMPLER()  # type: ignore[valid-type]
    """When rows are written."""
    sag: float = 0.0
    """Resistance of the supply [ohm], of which the logged voltage knows nothing."""
    sensor: tuple[str, ...] = ()
    """SIGNAL:FIELD=VALUE,..., with the fields noise, resolution, bias (in SI), delay [s], gain and outliers (share)."""
    seed: int = 0
    """Of noise, jitter and losses."""

    def run(self) -> int:
        """Write the log."""
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
        print(f"wrote {self.out}: {len(log.time)} rows; read it by --columns '{columns}'")
        return 0


def _sensors(texts: Sequence[str]) -> dict[str, Any]:
    from codrl_mj.fields import check_names
    from codrl_mj.identify.synthetic import Sensor

    known, found = [field.name for field in dataclasses.fields(Sensor)], {}
    for text in texts:
        signal, _, rest = text.partition(":")
        if signal in found:
            raise ValueError(
                f"sensor = {text!r}: {signal} is given twice; give its fields once, with commas"
            )
        pairs = [pair.partition("=") for pair in rest.split(",")]
        check_names([name for name, *_ in pairs], known, "field of a sensor")
        try:
            found[signal] = Sensor(**{name: float(value) for name, _, value in pairs})
        except ValueError as error:
            remedy = "write SIGNAL:FIELD=NUMBER,..., such as current:noise=0.02"
            raise ValueError(f"sensor = {text!r}: {error}; {remedy}") from None
    return found


@dataclasses.dataclass(frozen=True)
class ProposeColumns:
    """Propose the --columns of a log, by its names, units and values, and print what to type next.

    A unit that neither the file nor its values tell stays open: replace each UNIT. Exit status 1 if
    nothing can be identified from the columns. Example: codrl-mj identify columns log.csv
    """

    log: Annotated[tyro.conf.Positional[Path], _FILE]
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the mapping, what could not be told, and the next line."""
        from codrl_mj.identify.columns import OPEN_UNIT
        from codrl_mj.identify.proposal import propose_columns

        found = propose_columns(self.log)
        for doubt in found.doubts:
            say(f"to be checked: {doubt}")
        if found.problem:
            say(found.problem, style="yellow")
            print(f"--columns {shlex.quote(found.columns)}")
            return 1, found
        is_open, verb, rig = f":{OPEN_UNIT}" in found.columns, "identify", ""
        if not is_open and self._has_errors(found.columns):
            verb = "identify check"
        elif re.search("(position|velocity)=", found.columns):
            rig = " --rig free --known load_inertia=0"
        how = ", with its unit for each UNIT" if is_open else ""
        out = "" if "check" in verb else " --out motor"
        alone = (
            ", of a motor on its own (else --rig pendulum if one hangs at position 0, load if it"
            " lifts one)"
        )
        say(f"next{how}{alone if rig else ''}:")
        print(
            command(*verb.split(), self.log, "--columns", found.columns, *rig.split(), *out.split())
        )
        return 0, found

    def _has_errors(self, columns: str) -> bool:
        """Return True if the checks find errors, with which a fit would be refused."""
        from codrl_mj.identify.checks import check
        from codrl_mj.identify.reading import read_log

        return any(
            one.severity == "error" for one in check(read_log(self.log, columns), rig="free")
        )
