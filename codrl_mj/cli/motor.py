"""`codrl-mj motor list`, `new`, `show`, `design` and `step`: off-the-shelf motors, and your own."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.parsing import AsJson
from codrl_mj.cli.terminal import number, print_table, say
from codrl_mj.fields import command

MotorName = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="NAME",
        help=(
            "A motor of the catalogue (codrl-mj motor list), a TOML file with a datasheet, a YAML"
            " or JSON file with the fields of a drive, or module:NAME of your own."
        ),
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
    not_delayed: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="no-delayed")] = (
        False
    )
    """It is applied at once, as by the drive of a motor of the catalogue."""
    max_current: float | None = None
    """Largest current [A] that the drive asks for."""

    def drive(self, name: str) -> Any:
        """The named drive with these set over it."""
        from codrl_mj.sizing import find_drive

        given: dict[str, Any] = dict(vars(self))
        if given.pop("not_delayed") == given["delayed"]:
            given["delayed"] = None
        if self.delayed and self.not_delayed:
            raise ValueError("--delayed and --no-delayed: give one of them")
        return find_drive(name, **given)


Settings = tyro.conf.OmitArgPrefixes[Changes]
"""Type of a verb's field for `Changes`: `--gear-ratio` and not `--changes.gear-ratio`."""
_LISTED = {
    # column: header, its unit, SI values to it
    "name": ("name", "", 0.0),
    "voltage": ("at", "V", 1.0),
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

    Power is the most that the motor makes; the torque that it bears for ever, that of the blocked
    shaft and the speed of the free one are those of the gear's output, past friction; kT and J are
    the motor's alone. --json has more.

    Example: codrl-mj motor list --sort power
    """

    sort: Literal[tuple(_LISTED)] = "name"  # type: ignore[valid-type]
    """Order: names from A, numbers from the highest."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the table."""
        from codrl_mj.catalogue.datasheet import KINDS
        from codrl_mj.catalogue.derivation import OTHER_NAMES
        from codrl_mj.sizing import catalogue_rows
        from codrl_mj.sizing.abilities import ABILITY_UNITS

        rows = catalogue_rows(self.sort)
        columns = [f"{head}\n{unit}" for head, unit, _ in _LISTED.values()]
        scales = [(name, scale) for name, (*_, scale) in _LISTED.items() if name != "name"]
        cells = [
            (row["name"], *(number(row[name] and row[name] * scale) for name, scale in scales))
            for row in rows
        ]
        print_table(
            "Motors of the catalogue",
            columns,
            cells,
            right=columns[1:],
            whole=columns[:1],
            padding=(0, 0),
        )
        say("at: nominal voltage. –: not printed; a voltage is then taken as 24 V.")
        print("codrl-mj motor show NAME says where each number is from")
        kinds = {name: KINDS.get(OTHER_NAMES.get(name, name)) for name in rows[0]}
        units = ABILITY_UNITS | {
            name: kind.unit for name, kind in kinds.items() if kind is not None
        }
        return 0, {"units": units, "motors": rows}


@dataclasses.dataclass(frozen=True)
class Show:
    """Show a motor: every number with its unit and where it is from, and its torque-speed diagram.

    The diagram has the voltage limit (torque falls with speed, because the back-EMF takes its share
    of the voltage), the peak and the continuous current, at the output of the gear and past
    friction, in all four quadrants: what the motor drives with, and what it brakes with. Shaded is
    what it can do for a moment.

    Example: codrl-mj motor show maxon-ec45-flat-50w --gear-ratio 12 --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for torque_speed.png."""
    html: Path | None = None
    """Page with all of this, the current loop and its steps: one .html file."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the tables, draw the diagram."""
        from codrl_mj.sizing import explain, find_entry, find_loop

        drive, entry = self.changes.drive(self.name), find_entry(self.name)
        found = explain(drive, entry, find_loop(self.name))
        if self.out is not None:
            from codrl_mj.viz.pages.diagrams import torque_speed_diagram

            figure = torque_speed_diagram(drive, entry and entry.numbers)
        _print_explained(f"{self.name}: {entry.title}" if entry else "", drive.voltage_limit, found)
        if self.html is not None:
            from codrl_mj.viz.pages.motor import motor_page

            motor_page(self.name, drive, entry, self.html)
            print(f"wrote {self.html}")
        if self.out is not None:
            save_plot(figure, self.out / "torque_speed.png")
        return 0, found


def _print_explained(title: str, volts: float, found: dict[str, Any]) -> None:
    """What it can do first, then its numbers, then what to know of them."""
    from codrl_mj.sizing import describe_unknown

    def show(title: str, part: str) -> None:
        rows = [(row["name"], number(row["value"], 4), row["unit"]) for row in found[part]]
        print_table(title, ("number", "value", "unit"), rows, right=("value",))

    say(title)
    show(f"What it can do at its output, at {volts:g} V", "abilities")
    say(found["assumed"])
    if "numbers" in found:
        rows = []
        for row in found["numbers"]:
            how = row["how"].removeprefix(f"{row['name']} = ")
            estimated = "" if row["name"] not in found["estimated"] else " (estimated)"
            rows.append(
                (row["name"], number(row["value"], 4), row["unit"], how + estimated, row["places"])
            )
        columns = "number", "value", "unit", "how it came about", "source"
        print_table(
            "The motor, at its rotor", columns, rows, right=("value",), whole=("number", "unit")
        )
    show("As it is simulated", "drive")
    if "numbers" in found:
        for kind, texts in (
            ("disagreement", found["disagreements"]),
            ("note", [" ".join(found["notes"].split())] if found["notes"] else []),
            ("estimated", [f"{field}: {why}" for field, why in found["estimated"].items()]),
            ("source", [f"{number}: {source}" for number, source in enumerate(found["cited"], 1)]),
        ):
            say(*(f"{kind} {text}" if kind == "source" else f"{kind}: {text}" for text in texts))
        say(describe_unknown(found["unknown"]))


_DESIGNED = (
    *(
        "rate\nkHz",
        "delay\nsamples",
        "kp\nV/A",
        "ki\nV/(A·s)",
        "gain\nmargin dB",
        "phase\nmargin °",
    ),
    *("cross-\nover Hz", "band-\nwidth Hz", "2 % in\nms", "over-\nshoot %"),
)


_LOOP_UNITS = {
    "gain_margin": "1",
    "phase_margin": "deg",
    "kp": "V/A",
    "ki": "V/(A*s)",
    "settling_time": "s",
}
_LOOP_UNITS |= dict.fromkeys(("sample_rate", "phase_crossover", "crossover", "bandwidth"), "Hz") | {
    "overshoot": "1"
}


@dataclasses.dataclass(frozen=True)
class Design:
    """Design the current loop: gains, margins, bandwidth, settling time, with and without a sample of delay.

    The PI controller's zero cancels the winding's pole, which leaves one choice, the bandwidth.
    More of it follows faster and stands less delay: a phase margin of 60 degrees is comfortable, 30
    rings, 0 oscillates. A digital drive computes a voltage from one sample and applies it in the
    next (--delayed), and the hold costs half a sample more, so bandwidth is bought with sample
    rate. Margins count the delay and the hold; bandwidth is where the closed loop's gain is -3 dB,
    above the one designed for where a delayed loop swings; settling time and overshoot are those of
    a small step of the simulated drive.

    Example: codrl-mj motor design quanser-qube-servo-2 --bandwidth 1000 --delayed --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for bode.png: the loop, open and closed, with its margins."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the table, draw Bode's diagram."""
        from codrl_mj.sizing import LoopDesign, design, designs, undersampling_warning

        drive = self.changes.drive(self.name)
        own, every = design(drive), designs(drive)
        late = "a sample of delay" if own.delayed else "no delay"
        say(
            f"{self.name} at {own.sample_rate:g} Hz, {late}: kp = {own.kp:.6g} V/A, ki ="
            f" {own.ki:.6g} V/(A·s)"
        )
        rows = []
        for (rate, delayed), one in every.items():
            mark = "*" if (rate, delayed) == (own.sample_rate, own.delayed) else ""
            row = [f"{mark}{rate / 1e3:g}", "1" if delayed else "0"]
            if isinstance(one, LoopDesign):
                margin = 20.0 * math.log10(one.gain_margin)
                rest = one.kp, one.ki, margin, one.phase_margin, one.crossover, one.bandwidth
                row += [
                    number(value, 4)
                    for value in (*rest, 1e3 * one.settling_time, 100.0 * one.overshoot)
                ]
            rows.append(row)
        print_table(
            "The loop at other rates, with and without delay (*: as asked for)",
            _DESIGNED,
            rows,
            _DESIGNED,
            padding=(0, 0),
        )
        impossible = dict.fromkeys(one for one in every.values() if isinstance(one, str))
        say(
            *(f"not possible: {why}" for why in impossible),
            undersampling_warning(drive),
            drive.assumed,
        )
        if self.out is not None:
            from codrl_mj.viz.pages.diagrams import bode_diagram

            save_plot(bode_diagram(drive), self.out / "bode.png")
        others = [one for one in every.values() if isinstance(one, LoopDesign)]
        return 0, {"units": _LOOP_UNITS, **vars(own), "others": others}


@dataclasses.dataclass(frozen=True)
class Step:
    """Step the current: a small step, and one out of saturation with each kind of anti-windup.

    For 20 ms more current is asked for than the voltage can make against the back-EMF, then less.
    Without anti-windup the controller's integral has grown meanwhile and has to be worked off
    before the current comes down (recovery); with clamping it stands still, with back-calculation
    it follows what was possible.

    Example: codrl-mj motor step quanser-qube-servo-2 --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for step.png: current, torque and voltage."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the table, draw the responses."""
        from codrl_mj.sizing import undersampling_warning, step_responses

        drive = self.changes.drive(self.name)
        steps = step_responses(drive)
        small, constant = steps.small, drive.motor.torque_constant
        settled, amplitude = small.settling_time(), float(small.reference[-1])
        responses = steps.recoveries.items()
        recoveries = {
            k: {"time": one.settling_time(0.05), "undershoot": one.undershoot}
            for k, one in responses
        }
        say(
            f"{self.name}: a step to {amplitude:.4g} A, {constant * amplitude:.4g} N·m at the"
            f" rotor, stays within 2 % after {number(1e3 * settled, 4)} ms and overshoots by"
            f" {100.0 * small.overshoot:.2g} %",
            f"at {steps.speed:.4g} rad/s of the rotor it is asked for {steps.unreachable:.4g} A,"
            f" out of reach, for 20 ms, then {steps.reachable:.4g} A, which it reaches:",
        )
        columns = "anti-windup", "within 5 %\nafter ms", "undershoot\n%"
        rows = [
            (kind, number(1e3 * one["time"]), number(100.0 * one["undershoot"], 2))
            for kind, one in recoveries.items()
        ]
        print_table("", columns, rows, right=columns[1:])
        say(undersampling_warning(drive), drive.assumed)
        if self.out is not None:
            from codrl_mj.viz.pages import diagrams

            shown = [*diagrams.small_steps({"": (drive, None)}), *diagrams.recoveries(drive, steps)]
            save_plot(shown, self.out / "step.png")
        content = {"current": amplitude, "settling_time": settled, "overshoot": small.overshoot}
        asked = {name: getattr(steps, name) for name in ("speed", "unreachable", "reachable")}
        units = {
            "current": "A",
            "settling_time": "s",
            "overshoot": "1",
            "speed": "rad/s",
            "unreachable": "A",
        }
        units |= {"reachable": "A", "time": "s", "undershoot": "1"}
        return 0, {
            "units": units,
            "small": content,
            "saturated": {**asked, "recoveries": recoveries},
        }


@dataclasses.dataclass(frozen=True)
class New:
    """Write a file for a motor of your own, to be filled in with what its datasheet prints; docs/motors.md.

    Example: codrl-mj motor new my_motor.toml
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE.toml")]
    """The file; one that exists is left alone."""

    def run(self) -> int:
        """Write it."""
        from codrl_mj.catalogue import new_motor

        new_motor(self.file)
        print(f"wrote {self.file}: fill it in; next: {command('motor', 'show', self.file)}")
        return 0


def save_plot(figure: Any, path: Path) -> None:
    """Write a figure, and say so."""
    from codrl_mj.viz.pages.plots import save

    save(figure, path)
    print(f"wrote {path}")
