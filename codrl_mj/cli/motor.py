"""`codrl-mj motor`: one dataclass for each verb."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.motor_choice import Choose, Feasible

MotorName = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="NAME",
        help="A motor of the catalogue (codrl-mj motor list), a TOML file with a datasheet, a YAML or JSON file with "
        "the fields of a drive, or module:NAME of your own.",
    ),
]


@dataclasses.dataclass(frozen=True)
class Changes:
    """Set over the named motor and its drive; what is left out is theirs."""

    gear_ratio: float | None = None
    """Turns of the rotor for a turn of the output."""
    sample_rate: float | None = None
    """Samples of the current loop a second [Hz]; 20000 of a motor of the catalogue."""
    bandwidth: float | None = None
    """Bandwidth [Hz] that the loop's gains are designed for, at most sample rate / (2 pi); 0: 0.0555 of the rate."""
    voltage: float | None = None
    """Voltage of the supply [V]; the nominal one of a motor of the catalogue, or 24."""
    delayed: tyro.conf.FlagCreatePairsOff[bool] = False
    """The voltage that a sample computes is applied in the next one, as by most digital drives."""
    not_delayed: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="no-delayed")] = False
    """It is applied at once, as by the drive of a motor of the catalogue."""
    max_current: float | None = None
    """Largest current [A] that the drive asks for."""

    def drive(self, name: str) -> Any:
        """The named drive with these set over it."""
        from codrl_mj.motor_design import find_drive

        given: dict[str, Any] = dict(vars(self))
        if given.pop("not_delayed") == given["delayed"]:
            given["delayed"] = None
        if self.delayed and self.not_delayed:
            raise ValueError("--delayed and --no-delayed: give one of them")
        return find_drive(name, **given)


Settings = tyro.conf.OmitArgPrefixes[Changes]
"""Type of a verb's field for `Changes`: `--gear-ratio` and not `--changes.gear-ratio`."""
AsJson = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(name="json", help="Print JSON, in SI units.")]
"""Type of a verb's field that chooses JSON instead of tables."""

_LISTED = {
    # column: header, its unit, SI values to it
    "name": ("name", "", 0.0),
    "voltage": ("V", "V", 1.0),
    "power": ("power", "W", 1.0),
    "continuous_torque": ("continuous", "N·m", 1.0),
    "stall_torque": ("stall", "N·m", 1.0),
    "no_load_speed": ("free", "rad/s", 1.0),
    "gear_ratio": ("gear", "", 1.0),
    "torque_constant": ("kT", "mN·m/A", 1e3),
    "rotor_inertia": ("J", "g·cm²", 1e7),
}


@dataclasses.dataclass(frozen=True)
class List:
    """List the motors of the catalogue, with what they can do at their nominal voltage.

    Power is the most that the motor makes; the torque that it bears for ever, that of the blocked shaft and the speed
    of the free one are those of the gear's output, past friction; kT and J are the motor's alone. --json has more.

    Example: codrl-mj motor list --sort power
    """

    sort: Literal[tuple(_LISTED)] = "name"  # type: ignore[valid-type]
    """Order: names from A, numbers from the highest."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print the table."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.motor_design import catalogue_rows

        rows = catalogue_rows(self.sort)
        if self.as_json:
            return _print_json(rows)
        columns = [f"{head}\n{unit}" for head, unit, _ in _LISTED.values()]
        scales = [(name, scale) for name, (*_, scale) in _LISTED.items() if name != "name"]
        cells = [(row["name"], *(_text(row[name] and row[name] * scale, 3) for name, scale in scales)) for row in rows]
        print_table("Motors of the catalogue", columns, cells, right=columns[1:], whole=columns[:1], padding=(0, 0))
        print("V: nominal, –: not printed, and taken as 24 V. codrl-mj motor show NAME says where each number is from.")
        return 0


@dataclasses.dataclass(frozen=True)
class Show:
    """Show a motor: every number with its unit and where it is from, and its torque-speed diagram.

    The diagram has the voltage limit (torque falls with speed, because the back-EMF takes its share of the voltage),
    the peak and the continuous current, at the output of the gear and past friction, in all four quadrants: what the
    motor drives with, and what it brakes with. Shaded is what it can do for a moment.

    Example: codrl-mj motor show maxon-ec45-flat-50w --gear-ratio 12 --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for torque_speed.png."""
    html: Path | None = None
    """Page with all of this, the current loop and its steps: one .html file."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print the tables, draw the diagram."""
        from codrl_mj.motor_design import explain, find_entry
        from codrl_mj.pages.diagrams import torque_speed_diagram

        drive, entry = self.changes.drive(self.name), find_entry(self.name)
        found = explain(drive, entry)
        figure = self.out and torque_speed_diagram(drive, entry and entry.numbers)
        if self.as_json:
            _print_json(found)
        else:
            _print_explained(f"{self.name}: {entry.title}" if entry else "", drive.voltage_limit, found)
        if self.html is not None:
            from codrl_mj.pages.motor import motor_page

            motor_page(self.name, drive, entry, self.html)
            if not self.as_json:
                print(f"wrote {self.html}")
        return _save(figure, self.out, "torque_speed.png", self.as_json)


def _print_explained(title: str, volts: float, found: dict[str, Any]) -> None:
    """What it can do first, then its numbers, then what to know of them."""
    from codrl_mj.cli.terminal import print_table, say
    from codrl_mj.motor_design import unknown_in_words

    def show(title: str, part: str) -> None:
        rows = [(row["name"], _text(row["value"]), row["unit"]) for row in found[part]]
        print_table(title, ("number", "value", "unit"), rows, right=("value",))

    sources: list[str] = []
    say(title)
    show(f"What it can do at its output, at {volts:g} V", "abilities")
    say(found["assumed"])
    if "numbers" in found:
        rows = []
        for row in found["numbers"]:
            sources += [source for source in row["sources"] if source not in sources]
            places = ", ".join(str(1 + sources.index(source)) for source in row["sources"])
            estimated = "" if row["name"] not in found["estimated"] else " (estimated)"
            rows.append((row["name"], _text(row["value"]), row["unit"], row["how"] + estimated, places))
        columns = "number", "value", "unit", "how it came about", "source"
        print_table("The motor, at its rotor", columns, rows, right=("value",))
    show("As it is simulated", "drive")
    if "numbers" in found:
        for kind, texts in (
            ("disagreement", found["disagreements"]),
            ("note", [" ".join(found["notes"].split())] if found["notes"] else []),
            ("estimated", [f"{field}: {why}" for field, why in found["estimated"].items()]),
            ("source", [f"{number}: {source}" for number, source in enumerate(sources, 1)]),
        ):
            say(*(f"{kind} {text}" if kind == "source" else f"{kind}: {text}" for text in texts))
        say(unknown_in_words(found["unknown"]))


_DESIGNED = (
    *("rate\nkHz", "delay\nsamples", "kp\nV/A", "ki\nV/(A·s)", "gain\nmargin dB", "phase\nmargin °"),
    *("crossover\nHz", "bandwidth\nHz", "settled to\n2 % in ms", "overshoot\n%"),
)


@dataclasses.dataclass(frozen=True)
class Design:
    """Design the current loop: gains, margins, bandwidth, settling time, with and without a sample of delay.

    The PI controller's zero cancels the winding's pole, which leaves one choice, the bandwidth. More of it follows
    faster and stands less delay: a phase margin of 60 degrees is comfortable, 30 rings, 0 oscillates. A digital drive
    computes a voltage from one sample and applies it in the next (--delayed), and the hold costs half a sample more,
    so bandwidth is bought with sample rate. Margins count the delay and the hold; bandwidth is where the closed loop's
    gain is -3 dB, above the one designed for where a delayed loop swings; settling time and overshoot are those of a
    small step of the simulated drive.

    Example: codrl-mj motor design quanser-qube-servo-2 --bandwidth 1000 --delayed --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for bode.png: the loop, open and closed, with its margins."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print the table, draw Bode's diagram."""
        from codrl_mj.cli.terminal import print_table, say
        from codrl_mj.motor_design import LoopDesign, design, designs, sampled_too_seldom
        from codrl_mj.pages.diagrams import bode_diagram

        drive = self.changes.drive(self.name)
        own, every = design(drive), designs(drive)
        figure = self.out and bode_diagram(drive)
        if self.as_json:
            others = [vars(one) for one in every.values() if isinstance(one, LoopDesign)]
            _print_json({**vars(own), "others": others})
            return _save(figure, self.out, "bode.png", True)
        late = "a sample of delay" if own.delayed else "no delay"
        print(f"{self.name} at {own.sample_rate:g} Hz, {late}: kp = {own.kp:.6g} V/A, ki = {own.ki:.6g} V/(A*s)")
        rows = []
        for (rate, delayed), one in every.items():
            mark = "*" if (rate, delayed) == (own.sample_rate, own.delayed) else ""
            row = [f"{mark}{rate / 1e3:g}", "1" if delayed else "0"]
            if isinstance(one, LoopDesign):
                margin = 20.0 * math.log10(one.gain_margin)
                rest = one.kp, one.ki, margin, one.phase_margin, one.crossover, one.bandwidth
                row += [_text(value) for value in (*rest, 1e3 * one.settling_time, 100.0 * one.overshoot)]
            rows.append(row)
        print_table("The loop at other rates, with and without delay (*: as asked for)", _DESIGNED, rows, _DESIGNED)
        for why in dict.fromkeys(one for one in every.values() if isinstance(one, str)):
            print(f"not possible: {why}")
        say(sampled_too_seldom(drive), drive.assumed)
        return _save(figure, self.out, "bode.png", False)


@dataclasses.dataclass(frozen=True)
class Step:
    """Step the current: a small step, and one out of saturation with each kind of anti-windup.

    For 20 ms more current is asked for than the voltage can make against the back-EMF, then less. Without anti-windup
    the controller's integral has grown meanwhile and has to be worked off before the current comes down
    (recovery); with clamping it stands still, with back-calculation it follows what was possible.

    Example: codrl-mj motor step quanser-qube-servo-2 --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for step.png: current, torque and voltage."""
    as_json: AsJson = False

    def run(self) -> int:
        """Print the table, draw the responses."""
        from codrl_mj.cli.terminal import print_table, say
        from codrl_mj.motor_design import sampled_too_seldom, step
        from codrl_mj.pages.diagrams import step_diagram

        drive = self.changes.drive(self.name)
        steps = step(drive)
        figure = self.out and step_diagram(drive, steps)
        small, constant = steps.small, drive.motor.torque_constant
        settled, amplitude = small.settling_time(), float(small.reference[-1])
        recoveries = {kind: {"time": one.time, "undershoot": one.undershoot} for kind, one in steps.recoveries.items()}
        if self.as_json:
            content = {"current": amplitude, "settling_time": settled, "overshoot": small.overshoot}
            asked = {name: getattr(steps, name) for name in ("speed", "unreachable", "reachable")}
            _print_json({"small": content, "saturated": {**asked, "recoveries": recoveries}})
            return _save(figure, self.out, "step.png", True)
        print(
            f"{self.name}: a step to {amplitude:.4g} A, {constant * amplitude:.4g} N*m at the rotor, stays within "
            f"2 % after {_text(1e3 * settled)} ms and overshoots by {100.0 * small.overshoot:.2g} %"
        )
        asked_text = f"{steps.unreachable:.4g} A, out of reach, for 20 ms, then {steps.reachable:.4g} A"
        print(f"at {steps.speed:.4g} rad/s of the rotor it is asked for {asked_text}, which it reaches:")
        columns = "anti-windup", "within 5 %\nafter ms", "undershoot\n%"
        rows = [
            (kind, _text(1e3 * one["time"], 3), _text(100.0 * one["undershoot"], 2)) for kind, one in recoveries.items()
        ]
        print_table("", columns, rows, right=columns[1:])
        say(sampled_too_seldom(drive), drive.assumed)
        return _save(figure, self.out, "step.png", False)


@dataclasses.dataclass(frozen=True)
class New:
    """Write a file for a motor of your own, to be filled in with what its datasheet prints; docs/own_motor.md.

    Example: codrl-mj motor new my_motor.toml
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE.toml")]
    """The file; one that exists is left alone."""

    def run(self) -> int:
        """Write it."""
        from codrl_mj.catalogue import new_motor

        new_motor(self.file)
        print(f"wrote {self.file}: fill it in; next: codrl-mj motor show {self.file}")
        return 0


@dataclasses.dataclass(frozen=True)
class MotorTools:
    """Off-the-shelf motors: list them, look at one, design its current loop, and see it step; or write one down.

    New writes a file to fill in with a datasheet, show says what the motor is and can do, design what its drive makes
    of it, step how that looks; feasible and choose say whether it can do a task. docs/motors.md has more.
    Example: codrl-mj motor show maxon-ec45-flat-50w
    """

    verb: tyro.conf.OmitSubcommandPrefixes[
        Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[New, tyro.conf.subcommand("new")]
        | Annotated[Show, tyro.conf.subcommand("show")]
        | Annotated[Design, tyro.conf.subcommand("design")]
        | Annotated[Step, tyro.conf.subcommand("step")]
        | Annotated[Feasible, tyro.conf.subcommand("feasible")]
        | Annotated[Choose, tyro.conf.subcommand("choose")]
    ]
    """What to do; each has its own --help."""

    def run(self) -> int:
        """Do it."""
        return self.verb.run()


def _text(value: Any, digits: int = 4) -> str:
    """A number, or what stands for one, as text."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 1e3 <= abs(rounded) < 1e6 else f"{rounded:.{digits}g}"


def _print_json(content: Any) -> int:
    """Print JSON; numbers that are not finite, which it has no word for, are null."""
    print(json.dumps(_finite(content), indent=2, allow_nan=False))
    return 0


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _finite(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _save(figure: Any, folder: Path | None, name: str, quiet: bool) -> int:
    """Write a figure into a folder, if there is one, and say so."""
    if folder is not None:
        from codrl_mj.pages.plots import save

        save(figure, folder / name)
        if not quiet:
            print(f"wrote {folder / name}")
    return 0
