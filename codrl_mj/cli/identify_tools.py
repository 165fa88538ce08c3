"""`codrl-mj identify check`, `plan` and `simulate`: what is done before motors are fitted to logs."""

import dataclasses
import json
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.compare import CompareLog
from codrl_mj.cli.motor import AsJson, MotorName

Columns = Annotated[
    str,
    tyro.conf.arg(
        metavar="SIGNAL=COLUMN:UNIT,...",
        help="What the columns are, as time=t:s,voltage=duty*vbus:V,current=i:mA,position=q:deg. Signals are voltage, "
        "current, position, velocity, torque, bus, duty, temperature and command; formulas have + - * /, "
        "twos_complement(column,16), unwrap(column,360), atan2(y,x), abs, sign, sqrt: docs/identify_logs.md.",
    ),
]
"""Type of a verb's flag `--columns`."""
_FILE = tyro.conf.arg(metavar="LOG", help="CSV, JSON (or .gz), Parquet.")
Logs = Annotated[tyro.conf.Positional[tuple[Path, ...]], _FILE]
"""Type of a verb's files."""
_STYLES = {"error": "red", "warning": "yellow", "info": ""}


@dataclasses.dataclass(frozen=True)
class CheckLogs:
    """Check bench logs before anything is fitted to them: rows, sensors, lags, signs, units, what does not show.

    Exit status 1 if a log has errors, with which a fit would be wrong. Example: codrl-mj identify check log.csv
    --columns time=t:s,voltage=u:V,current=i:A,position=q:rad
    """

    logs: Logs
    columns: Columns
    motor: str | None = None
    """Motor of the catalogue, or a file with a datasheet, that resistance and back-EMF are compared with."""
    rig: Literal["pendulum", "free", "load"] | None = None
    """What the output moves, as for the fit; where it is not said, it may be a pendulum."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print a table for each log."""
        from codrl_mj.cli.terminal import console
        from codrl_mj.drives import find_drive
        from codrl_mj.identify.checks import check
        from codrl_mj.identify.reading import read_log

        motor = None if self.motor is None else find_drive(self.motor).motor
        if not self.logs:
            raise ValueError("no log is given: name one or more files")
        logs = [read_log(path, self.columns) for path in self.logs]
        found = {path: check(log, motor, self.rig) for path, log in zip(self.logs, logs, strict=True)}
        if self.as_json:
            content = [{"log": str(path), **vars(one)} for path, findings in found.items() for one in findings]
            print(json.dumps(content, indent=2))
        else:
            for log, findings in zip(logs, found.values(), strict=True):
                title = f"{log.name}: {len(log.time)} rows, {log.time[-1]:.4g} s, a row every {1e3 * log.step:.4g} ms"
                console().print(findings_table(title, findings))
        return int(any(one.severity == "error" for findings in found.values() for one in findings))


def findings_table(title: str, findings: Sequence[Any]) -> Any:
    """Findings of `codrl_mj.identify.checks.check` as a rich table, or a line where there are none."""
    from rich.markup import escape

    from codrl_mj.cli.terminal import titled_table

    if not findings:
        return f"{escape(title)}: nothing is wrong with it"
    table = titled_table(title, ("", "check", "row", "what", "remedy"), right=["row"])
    for one in findings:
        texts = one.severity, one.check, "" if one.row is None else str(one.row), one.message, one.remedy
        table.add_row(*map(escape, texts), style=_STYLES[one.severity])
    return table


@dataclasses.dataclass(frozen=True)
class Turned:
    """What the motor turns on the bench."""

    inertia: float = 0.0
    """Inertia of the load [kg*m^2], at the output, besides the rotor's."""
    gravity: float = 0.0
    """m*g*l [N*m] of a pendulum that hangs at position 0."""
    against: float = 0.0
    """Constant torque [N*m] against the motor."""
    locked: tyro.conf.FlagCreatePairsOff[bool] = False
    """The shaft is held."""

    def load(self) -> Any:
        """As `codrl_mj.identify.synthetic` has it."""
        from codrl_mj.identify.synthetic import Load

        return Load(self.inertia, self.gravity, self.against, self.locked)


@dataclasses.dataclass(frozen=True)
class PlanExperiment:
    """Plan an experiment: which excitation, sample rate and amplitude a motor needs, and what each would tell.

    The errors are those to be expected at best, of a motor that is about as its datasheet says; of a drive at the bench
    they are some times larger. Example: codrl-mj identify plan maxon-ec45-flat-50w --inertia 1e-4 --out plan
    """

    name: MotorName
    load: tyro.conf.OmitArgPrefixes[Turned] = Turned()
    current_noise: float = 0.01
    """Noise of the current (standard deviation) as a share of the largest current."""
    encoder: float = 4096.0
    """Steps of the position for a turn of the output."""
    voltage: Literal["together", "instantaneous", "mean"] = "together"
    """The voltage changes together with the rows; else a row has what it is at the time, or its mean to the next."""
    duration: float = 4.0
    """Of a log [s]."""
    max_current: float = math.inf
    """Largest current [A] that the bench allows; that of the drive and the continuous one of a datasheet count too."""
    out: Path | None = None
    """Folder for excitation.csv: the voltage to play."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print the options, the best one last."""
        from codrl_mj.drives import find_drive, find_entry
        from codrl_mj.identify.plan import GOALS, Sensing, plan, write_excitation

        sensing, entry = Sensing(self.current_noise, self.encoder, self.voltage), find_entry(self.name)
        bears = None if entry is None else entry.numbers.continuous_current
        limits = self.max_current, math.inf if bears is None else bears
        found = plan(find_drive(self.name), self.load.load(), sensing, self.duration, *limits)
        if self.as_json:
            options = [{**one._asdict(), "excitation": vars(one.excitation)} for one in (found.best, *found.options)]
            content = {"best": options[0], "missed": found.missed, "unknown": found.unknown, "options": options[1:]}
            print(json.dumps(content, indent=2))
        else:
            self._print(found, GOALS)
        if self.out is not None:
            write_excitation(self.out / "excitation.csv", found.best)
            if not self.as_json:
                print(f"wrote {self.out / 'excitation.csv'}: play each voltage [V] until the time [s] of the next")
        return 0

    def _print(self, found: Any, goals: dict[str, float]) -> None:
        from codrl_mj.cli.terminal import console, titled_table

        heads = "kHz", "V", "peak A", "rms A", *(f"{_SHORT[name]}\n≤ {goals[name]:.0%}" for name in goals)
        rows = []
        for option in found.options:
            mark = "*" if option is found.best else ""
            numbers = option.rate / 1e3, option.excitation.amplitude, option.peak_current, option.rms_current
            errors = (option.errors.get(name) for name in goals)
            texts = (("–" if error is None else f"{100.0 * error:.2g}") for error in errors)
            rows.append((f"{mark}{option.excitation.kind}", *(f"{one:.3g}" for one in numbers), *texts))
        title = f"{self.name}: errors to be expected [%]"
        console().print(titled_table(title, ("excitation", *heads), rows, right=heads))
        best = found.best.excitation
        clock = f", a clock of {1e3 * best.clock:.3g} ms" if "prbs" in best.kind else ""
        print(f"* play {best.kind}, {best.amplitude:.4g} V, {best.duration:g} s{clock}, rows at {found.best.rate:g} Hz")
        if found.missed:
            print(f"it misses the goals of {', '.join(found.missed)}: a larger current, a longer log, or other sensors")
        if found.unknown:
            print(f"nothing is said of {', '.join(found.unknown)}: 0 on the datasheet")


_SHORT = {
    "resistance": "R",
    "inductance": "L",
    "back_emf_constant": "kE",
    "inertia": "J",
    "coulomb_friction": "Coulomb",
    "viscous_friction": "viscous",
}


@dataclasses.dataclass(frozen=True)
class SimulateLog:
    """Simulate a bench log of a motor, through sensors and a sampler, with faults to order.

    Prints the --columns that read the file. Example: codrl-mj identify simulate maxon-ec45-flat-50w --out log.csv.gz
    --kind prbs --amplitude 12 --inertia 1e-4 --rate 5000 --sensor current:noise=0.05 position:resolution=0.0015
    """

    name: MotorName
    out: Path
    """File to write, .csv or .csv.gz."""
    load: tyro.conf.OmitArgPrefixes[Turned] = Turned()
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
    rate: float = 5000.0
    """Rows a second [Hz]."""
    jitter: float = 0.0
    """Standard deviation of the stamps, as a share of the period."""
    dropped: float = 0.0
    """Share of rows that are lost."""
    mean_voltage: tyro.conf.FlagCreatePairsOff[bool] = False
    """Rows have the mean voltage to the next row."""
    sag: float = 0.0
    """Resistance of the supply [ohm], of which the logged voltage knows nothing."""
    sensor: tuple[str, ...] = ()
    """SIGNAL:FIELD=VALUE,..., with the fields noise, resolution, bias (in SI), delay [s], gain and outliers (share)."""
    seed: int = 0
    """Of noise, jitter and losses."""

    def run(self) -> int:
        """Write the log."""
        from codrl_mj.actuators import Supply
        from codrl_mj.drives import find_drive
        from codrl_mj.identify.synthetic import Excitation, Sampler, simulate, write_log

        if not self.out.name.endswith((".csv", ".csv.gz")):
            raise ValueError(f"out = {self.out}: must end in .csv or .csv.gz")
        drive = find_drive(self.name)
        if self.sag != 0.0:
            drive = drive.replaced({"supply": Supply(drive.voltage_limit, self.sag)})
        clock = 4.0 * drive.motor.electrical_time_constant if self.clock is None else self.clock
        frequency = (2.0 if self.kind == "square" else 0.5) if self.frequency is None else self.frequency
        amplitude = 0.5 * drive.voltage_limit if self.amplitude is None else self.amplitude
        excitation = Excitation(self.kind, amplitude, self.duration, frequency, clock=clock)
        sampler = Sampler(self.rate, self.jitter, self.dropped, self.mean_voltage)
        log = simulate(drive, excitation, self.load.load(), _sensors(self.sensor), sampler, self.seed)
        columns = write_log(self.out, log)
        print(f"wrote {self.out}: {len(log.time)} rows; read it by --columns '{columns}'")
        return 0


def _sensors(texts: Sequence[str]) -> dict[str, Any]:
    from codrl_mj.fields import check_names
    from codrl_mj.identify.synthetic import Sensor

    known, found = [field.name for field in dataclasses.fields(Sensor)], {}
    for text in texts:
        signal, _, rest = text.partition(":")
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

    Example: codrl-mj identify columns log.csv
    """

    log: Annotated[tyro.conf.Positional[Path], _FILE]
    as_json: AsJson = False

    def run(self) -> int:
        """Print the mapping, what could not be told, and the next line."""
        from codrl_mj.identify.reading import propose_columns

        found = propose_columns(self.log)
        if self.as_json:
            print(json.dumps(found._asdict(), indent=2))
            return 0
        for doubt in found.doubts:
            print(f"to be checked: {doubt}")
        rig = " --rig free --known load_inertia=0" if any(f"{one}=" in found.columns for one in _MOTION) else ""
        print("next (--rig pendulum if one hangs at position 0, load if it lifts one):" if rig else "next:")
        print(f"codrl-mj identify {shlex.quote(str(self.log))} --columns {shlex.quote(found.columns)}{rig} --out motor")
        return 0


_MOTION = "position", "velocity"
TOOLS: dict[str, Any] = {
    "check": CheckLogs,
    "columns": ProposeColumns,
    "plan": PlanExperiment,
    "simulate": SimulateLog,
    "compare": CompareLog,
}
"""What `codrl-mj identify` does besides fitting, by its word."""


@dataclasses.dataclass(frozen=True)
class IdentifyTools:
    """Motors from bench logs: check logs, plan experiments, simulate logs, compare rigs. See docs/identify_logs.md."""

    verb: tyro.conf.OmitSubcommandPrefixes[
        Annotated[CheckLogs, tyro.conf.subcommand("check")]
        | Annotated[ProposeColumns, tyro.conf.subcommand("columns")]
        | Annotated[PlanExperiment, tyro.conf.subcommand("plan")]
        | Annotated[SimulateLog, tyro.conf.subcommand("simulate")]
        | Annotated[CompareLog, tyro.conf.subcommand("compare")]
    ]
    """What to do; each has its own --help."""

    def run(self) -> int:
        """Do it."""
        return self.verb.run()
