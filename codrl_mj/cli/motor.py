"""`codrl-mj motor list`, `new`, `show`, `design`, `step`, `write`: off-the-shelf, custom motors."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Literal

import tyro

from codrl_mj.actuators import ActuatorModel, ActuatorSetting, Drive, TorqueSpeed, resolve
from codrl_mj.arrays.written_losses import LostField, WrittenComparison
from codrl_mj.boundary import Argument
from codrl_mj.catalogue import MotorEntry, TorqueSpeedLine, joint_names
from codrl_mj.cli.parsing import AsJson, Output
from codrl_mj.cli.servo import AsServo, ServoSettings, analyze_position_servo, print_servo
from codrl_mj.cli.terminal import format_number, print_table, print_text
from codrl_mj.fields import command
from codrl_mj.plots import Plot
from codrl_mj.sizing.limits import MotorReport, Quantity

MotorName = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="NAME",
        help=(
            "A motor of the catalogue (codrl-mj motor list), a TOML file with a datasheet, a YAML"
            " or JSON file with the fields of a drive, or your own motor as module:NAME."
        ),
    ),
]


@dataclasses.dataclass(frozen=True)
class Changes:
    """Values that override those of the named motor and its drive."""

    gear_ratio: float | None = None
    """Turns of the rotor per turn of the output."""
    sample_rate: float | None = None
    """Samples per second of the current loop [Hz]; motors of the catalogue: 20000."""
    bandwidth: float | None = None
    """Bandwidth [Hz] for which the gains are designed, at most sample rate / (2 pi); 0: 0.0555
    times the sample rate.
    """
    voltage: float | None = None
    """Voltage of the supply [V]; motors of the catalogue: the nominal voltage, or 24."""
    delayed: tyro.conf.FlagCreatePairsOff[bool] = False
    """Apply each computed voltage in the next sample, as most digital drives do."""
    not_delayed: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="no-delayed")] = (
        False
    )
    """Apply each computed voltage at once, as the drives of the catalogue's motors do."""
    max_current: float | None = None
    """Current limit of the drive [A]."""

    def drive(self, name: ActuatorSetting) -> Drive:
        """Return the named drive, changed to these values."""
        from codrl_mj.sizing import find_drive

        overrides: dict[str, Argument] = dict(vars(self))
        if overrides.pop("not_delayed") == overrides["delayed"]:
            overrides["delayed"] = None
        if self.delayed and self.not_delayed:
            raise ValueError("--delayed and --no-delayed: use only one of them")
        return find_drive(name, **overrides)


Settings = tyro.conf.OmitArgPrefixes[Changes]
"""Type of a verb's field for `Changes`, with flags `--gear-ratio` instead of
`--changes.gear-ratio`.
"""
_LIST_COLUMNS = {
    # field: (header, unit, factor from SI units)
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
    """List the motors of the catalogue with their limits at nominal voltage.

    Power is the maximum mechanical power. Continuous torque, stall torque and no-load speed are
    those of the gear's output, with friction subtracted; kT and J are those of the motor without
    its gear. --json prints more columns.

    Example: codrl-mj motor list --sort power
    """

    sort: Literal[tuple(_LIST_COLUMNS)] = "name"  # type: ignore[valid-type]
    """Order: names from A to Z, numbers descending."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the table."""
        from codrl_mj.catalogue.datasheet import QUANTITY_SPECS
        from codrl_mj.catalogue.derivation import PRINTED_NAMES
        from codrl_mj.sizing import catalogue_rows
        from codrl_mj.sizing.limits import LIMIT_UNITS

        rows = catalogue_rows(self.sort)
        columns = [f"{head}\n{unit}" for head, unit, _ in _LIST_COLUMNS.values()]
        scales = [(name, scale) for name, (*_, scale) in _LIST_COLUMNS.items() if name != "name"]
        cells = [
            (
                row["name"],
                *(format_number(row[name] and row[name] * scale) for name, scale in scales),
            )
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
        print_text(
            "at: nominal voltage, or 24 V if the datasheet has none. –: not on the datasheet."
        )
        joints = joint_names()
        print_table("Known only by a torque-speed line", ("name",), [(name,) for name in joints])
        print("codrl-mj motor show NAME gives the source of each number")
        specs = {name: QUANTITY_SPECS.get(PRINTED_NAMES.get(name, name)) for name in rows[0]}
        units = LIMIT_UNITS | {name: spec.unit for name, spec in specs.items() if spec is not None}
        return 0, {"units": units, "motors": rows, "torque_speed_lines": joints}


@dataclasses.dataclass(frozen=True)
class Show:
    """Show every number of a motor with its unit and source, and the torque-speed diagram.

    The diagram shows the voltage limit (torque falls with speed, because the back-EMF uses up a
    part of the voltage), the peak current and the continuous current, at the output of the gear and
    with friction subtracted. It covers all four quadrants, both driving and braking. The shaded
    area is available for short times only. A motor known only by its torque-speed line has a table
    of this line, and no diagram. A servo that takes positions also has its step response, its error
    under a load and its bandwidth.

    Example: codrl-mj motor show maxon-ec45-flat-50w --gear-ratio 12 --out motor
    Example: codrl-mj motor show feetech-sts3215-7v4 --family pwm_servo --position-p 32 --out servo
    """

    name: MotorName
    changes: Settings = Changes()
    servo: AsServo = ServoSettings()
    out: Path | None = None
    """Folder for torque_speed.png, and servo.png if it is a servo."""
    html: Path | None = None
    """HTML file for a page with these tables, the current loop and its step responses, or the
    responses of a servo.
    """
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the tables and draw the diagram."""
        from codrl_mj.sizing import describe_motor, find_entry, find_servo

        entry = find_entry(self.name)
        line = None if entry is None else entry.line
        # Without a winding there is no diagram, no loop and nothing to change: naming the drive
        # says so.
        is_plain = self.out is None and self.html is None and self.changes == Changes()
        if entry is not None and line is not None and is_plain and self.servo == ServoSettings():
            return _print_line(entry, line)
        setting = self.servo.setting(self.name)
        drive = self.changes.drive(setting)
        servo = find_servo(setting, drive)
        explanation = describe_motor(drive, entry, None if servo is None else servo.loop)
        response = None if servo is None else analyze_position_servo(servo, self.servo.inertia)
        if self.out is not None:
            from codrl_mj.viz.pages.diagrams import torque_speed_diagram

            figure = torque_speed_diagram(drive, None if entry is None else entry.parameters)
        _print_explanation(
            f"{self.name}: {entry.title}" if entry else "", drive.voltage_limit, explanation
        )
        content = {} if servo is None else print_servo(servo, response)
        if self.html is not None:
            from codrl_mj.viz.pages.motor import motor_page

            motor_page(self.name, drive, entry, self.html, servo, response)
            print(f"wrote {self.html}")
        if self.out is not None:
            save_plot(figure, self.out / "torque_speed.png")
            if servo is not None and response is not None:
                from codrl_mj.viz.pages.servo_diagrams import servo_plots

                save_plot(servo_plots(servo, response), self.out / "servo.png")
        return 0, {**explanation, **content}


def _print_line(entry: MotorEntry, line: TorqueSpeedLine) -> Output:
    """Print the torque-speed line of a motor without a winding, its notes and its sources."""
    limit = line.stall_torque if line.max_torque is None else line.max_torque
    torque = min(limit, line.stall_torque / 2.0)
    power = torque * line.no_load_speed * (1.0 - torque / line.stall_torque)
    values = {
        "power": (power, "W"),
        "max_torque": (limit, "N*m"),
        "stall_torque": (line.stall_torque, "N*m"),
        "no_load_speed": (line.no_load_speed, "rad/s"),
    }
    rows = [(name, format_number(value, 4), unit) for name, (value, unit) in values.items()]
    print_text(f"{entry.name}: {entry.title}")
    print_table("At the output", ("number", "value", "unit"), rows, right=("value",))
    print_text(
        f"simulated by this line, without winding, current loop and heating: {line.reason}",
        *([f"note: {' '.join(entry.notes.split())}"] if entry.notes else []),
        *(f"estimated: {field}: {why}" for field, why in entry.estimated.items()),
        *(f"source: {source}" for source in dict.fromkeys(entry.sources.values())),
    )
    return 0, {
        "units": {name: unit for name, (_, unit) in values.items()},
        **{name: value for name, (value, _) in values.items()},
        "reason": line.reason,
        "notes": entry.notes,
        "estimated": dict(entry.estimated),
        "sources": dict(entry.sources),
    }


def _print_explanation(title: str, volts: float, explanation: MotorReport) -> None:
    """Print the limits of a motor, then its parameters, then the notes on them."""
    from codrl_mj.sizing import describe_unknown

    def show(title: str, quantities: Iterable[Quantity]) -> None:
        rows = [(row["name"], format_number(row["value"], 4), row["unit"]) for row in quantities]
        print_table(title, ("number", "value", "unit"), rows, right=("value",))

    print_text(title)
    show(f"Limits at the output, at {volts:g} V", explanation["abilities"])
    print_text(explanation["assumed"])
    if "numbers" in explanation:
        rows = []
        for row in explanation["numbers"]:
            derivation = row["how"].removeprefix(f"{row['name']} = ")
            estimated = "" if row["name"] not in explanation["estimated"] else " (estimated)"
            rows.append(
                (
                    row["name"],
                    format_number(row["value"], 4),
                    row["unit"],
                    derivation + estimated,
                    row["places"],
                )
            )
        columns = "number", "value", "unit", "derivation", "source"
        print_table(
            "The motor, at its rotor", columns, rows, right=("value",), whole=("number", "unit")
        )
    show("As it is simulated", explanation["drive"])
    if "numbers" in explanation:
        for kind, texts in (
            ("disagreement", explanation["disagreements"]),
            ("note", [" ".join(explanation["notes"].split())] if explanation["notes"] else []),
            ("estimated", [f"{field}: {why}" for field, why in explanation["estimated"].items()]),
            (
                "source",
                [f"{index}: {source}" for index, source in enumerate(explanation["cited"], 1)],
            ),
        ):
            print_text(
                *(f"{kind} {text}" if kind == "source" else f"{kind}: {text}" for text in texts)
            )
        print_text(describe_unknown(explanation["unknown"]))


_DESIGN_COLUMNS = (
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
    """Design the current loop: gains, margins, bandwidth and settling time, with and without delay.

    The zero of the PI controller cancels the pole of the winding, so that only the bandwidth is
    left to choose. A loop with a larger bandwidth follows faster and tolerates less delay: at a
    phase margin of 60 degrees the current settles well, at 30 it rings, at 0 it oscillates. A
    digital drive computes a voltage from one sample and applies it in the next (--delayed), and the
    hold costs another half sample, so that a larger bandwidth needs a higher sample rate. The
    margins include the delay and the hold. The reported bandwidth is the -3 dB frequency of the
    closed loop, which exceeds the designed bandwidth if a delayed loop overshoots. Settling time
    and overshoot are those of a small step of the simulated drive.

    Example: codrl-mj motor design quanser-qube-servo-2 --bandwidth 1000 --delayed --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for bode.png: the open and the closed loop, with the margins."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the table and draw the Bode plot."""
        from codrl_mj.sizing import (
            LoopAnalysis,
            analyze_loop,
            analyze_sample_rates,
            undersampling_warning,
        )

        drive = self.changes.drive(self.name)
        chosen, all_designs = analyze_loop(drive), analyze_sample_rates(drive)
        delay_text = "a sample of delay" if chosen.delayed else "no delay"
        print_text(
            f"{self.name} at {chosen.sample_rate:g} Hz, {delay_text}: kp = {chosen.kp:.6g} V/A,"
            f" ki = {chosen.ki:.6g} V/(A·s)"
        )
        rows = []
        for (rate, delayed), candidate in all_designs.items():
            mark = "*" if (rate, delayed) == (chosen.sample_rate, chosen.delayed) else ""
            row = [f"{mark}{rate / 1e3:g}", "1" if delayed else "0"]
            if isinstance(candidate, LoopAnalysis):
                margin = 20.0 * math.log10(candidate.gain_margin)
                rest = (
                    candidate.kp,
                    candidate.ki,
                    margin,
                    candidate.phase_margin,
                    candidate.crossover,
                    candidate.bandwidth,
                )
                row += [
                    format_number(value, 4)
                    for value in (*rest, 1e3 * candidate.settling_time, 100.0 * candidate.overshoot)
                ]
            rows.append(row)
        print_table(
            "The loop at other rates, with and without delay (*: the chosen one)",
            _DESIGN_COLUMNS,
            rows,
            _DESIGN_COLUMNS,
            padding=(0, 0),
        )
        impossible = dict.fromkeys(
            candidate for candidate in all_designs.values() if isinstance(candidate, str)
        )
        print_text(
            *(f"not possible: {why}" for why in impossible),
            undersampling_warning(drive),
            drive.assumed,
        )
        if self.out is not None:
            from codrl_mj.viz.pages.diagrams import bode_diagram

            save_plot(bode_diagram(drive), self.out / "bode.png")
        others = [
            candidate for candidate in all_designs.values() if isinstance(candidate, LoopAnalysis)
        ]
        return 0, {"units": _LOOP_UNITS, **vars(chosen), "others": others}


@dataclasses.dataclass(frozen=True)
class Step:
    """Simulate a small step of the current, and one from saturation with each anti-windup.

    In the second step, the reference is for 20 ms larger than the current that the voltage can
    drive against the back-EMF; then it is smaller. Without anti-windup, the controller's integral
    has grown in the meantime and must unwind before the current falls (recovery). Clamping stops
    the integral; back-calculation makes it follow the achievable current.

    Example: codrl-mj motor step quanser-qube-servo-2 --out motor
    """

    name: MotorName
    changes: Settings = Changes()
    out: Path | None = None
    """Folder for step.png: current, torque and voltage."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the table and draw the responses."""
        from codrl_mj.sizing import step_responses, undersampling_warning

        drive = self.changes.drive(self.name)
        steps = step_responses(drive)
        small, constant = steps.small, drive.motor.torque_constant
        settled, amplitude = small.settling_time(), float(small.reference[-1])
        responses = steps.recoveries.items()
        recoveries = {
            kind: {"time": response.settling_time(0.05), "undershoot": response.undershoot}
            for kind, response in responses
        }
        print_text(
            f"{self.name}: a step to {amplitude:.4g} A, {constant * amplitude:.4g} N·m at the"
            f" rotor, stays within 2 % after {format_number(1e3 * settled, 4)} ms and overshoots by"
            f" {100.0 * small.overshoot:.2g} %",
            f"at {steps.speed:.4g} rad/s of the rotor the reference is {steps.unreachable:.4g} A,"
            f" which is out of reach, for 20 ms, then {steps.reachable:.4g} A, which is reached:",
        )
        columns = "anti-windup", "within 5 %\nafter ms", "undershoot\n%"
        rows = [
            (
                kind,
                format_number(1e3 * response["time"]),
                format_number(100.0 * response["undershoot"], 2),
            )
            for kind, response in recoveries.items()
        ]
        print_table("", columns, rows, right=columns[1:])
        print_text(undersampling_warning(drive), drive.assumed)
        if self.out is not None:
            from codrl_mj.viz.pages import diagrams

            plots = [
                *diagrams.small_step_plots({"": (drive, None)}),
                *diagrams.recovery_plots(drive, steps),
            ]
            save_plot(plots, self.out / "step.png")
        content = {"current": amplitude, "settling_time": settled, "overshoot": small.overshoot}
        currents = {name: getattr(steps, name) for name in ("speed", "unreachable", "reachable")}
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
            "saturated": {**currents, "recoveries": recoveries},
        }


@dataclasses.dataclass(frozen=True)
class New:
    """Write a template for a custom motor, to be filled in from its datasheet (docs/motors.md).

    Example: codrl-mj motor new my_motor.toml
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE.toml")]
    """File to write; an existing file is not changed."""

    def run(self) -> int:
        """Write the file."""
        from codrl_mj.catalogue import new_motor

        new_motor(self.file)
        print(f"wrote {self.file}: fill it in; next: {command('motor', 'show', self.file)}")
        return 0


@dataclasses.dataclass(frozen=True)
class Write:
    """Write a motor and its drive for other simulators and controllers.

    As C, the motor is a function that advances the drive by one step: it takes the state and the
    desired torque, position and speed, and returns the torque, exactly as in the simulation. Other
    notations know less of a motor, so tables show the fields without a place, the largest error of
    the torque, and how far the motor and the written one move apart (docs/arrays.md).

    Example: codrl-mj motor write maxon-ec45-flat-50w --gear-ratio 20 --as c --out motor.c
    """

    name: MotorName
    changes: Settings = Changes()
    target: Annotated[
        Literal["c", "mjlab", "isaaclab", "newton", "dcmotor", "bam"], tyro.conf.arg(name="as")
    ] = "c"
    """Notation: C99; a configuration of mjlab or Isaac Lab; Python for Newton's model builder;
    MuJoCo's <dcmotor>; or the parameters of BAM.
    """
    joint: str | None = None
    """Regular expression of the joints' names, by default all; for <dcmotor> the joint's name."""
    out: Path | None = None
    """File to write. Without it the text is printed."""

    def run(self) -> int:
        """Write the file, and print what is lost."""
        from codrl_mj.arrays import write_motor
        from codrl_mj.runs.files import atomic_write

        written = write_motor(self._actuator(), self.target, self.joint)
        if self.out is None:
            print(written.text, end="")
        else:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.out) as temporary:
                temporary.write_text(written.text)
            print(f"wrote {self.out}")
        if written.comparison is not None:
            _print_losses(written.lost, written.comparison, written.slides)
        return 0

    def _actuator(self) -> ActuatorModel:
        """Return the named torque-speed line, or the named drive with its changes."""
        if self.changes == Changes():
            actuator = resolve(self.name, None, "a motor on its own")
            if isinstance(actuator, TorqueSpeed):
                return actuator
        return self.changes.drive(self.name)


def _print_losses(lost: Sequence[LostField], comparison: WrittenComparison, slides: bool) -> None:
    """Print what a notation cannot say of a motor."""
    if lost:
        columns = "field", "value", "effect"
        rows = [
            (path, value if isinstance(value, str) else format_number(value, 4), effect)
            for row in lost
            # The effect is that of all fields of the row, and is printed beside the first.
            for path, value, effect in zip_longest(row.fields, row.values, [row.effect])
        ]
        print_table(
            "Fields without a place", columns, rows, right=("value",), whole=("field", "value")
        )
    force, speed, position = ("N", "m/s", "m") if slides else ("N·m", "rad/s", "rad")
    share = 100.0 * comparison.torque_error / comparison.stall_torque
    print_text(
        f"largest error of the steady torque: {comparison.torque_error:.3g} {force}, {share:.2g} %"
        f" of the stall torque, at {comparison.error_speed:.4g} {speed} and a command of"
        f" {comparison.error_torque:.4g} {force}"
        if share > 1e-7
        else "the steady torques are equal",
        f"largest gap in a test motion of one second: {comparison.motion_gap:.2g} {position} of"
        f" {comparison.motion_range:.3g} {position}",
    )


def save_plot(figure: Plot | Sequence[Plot], path: Path) -> None:
    """Write a figure to a PNG file and print its path."""
    from codrl_mj.plots import save_png

    save_png(figure, path)
    print(f"wrote {path}")
