"""`codrl-mj motor feasible` and `codrl-mj motor choose`."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import RenderableType
from rich.text import Text

from codrl_mj.actuators import Drive
from codrl_mj.cli.motor import save_plot
from codrl_mj.cli.parsing import AsJson, Output, Trust
from codrl_mj.cli.terminal import print_table, print_text
from codrl_mj.runs import unique_names
from codrl_mj.sizing.choice import Candidate
from codrl_mj.sizing.feasibility import OperatingPoints
from codrl_mj.sizing.joint_demand import Demand

TaskOrRun = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="TASK|RUN",
        help=(
            "A task, which a scripted controller drives; a run folder, trained on the ideal"
            " actuator, of a task or a third-party environment; or an .npz file with the arrays"
            " time [s], torque [N*m] and speed [rad/s] of a joint."
        ),
    ),
]
MotorOfRun = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME",
        help="Name of the motor to consider, for a run with several motors.",
    ),
]


@dataclasses.dataclass(frozen=True)
class Feasible:
    """Check before training whether a motor can do a task (docs/motors.md).

    The last line is the verdict: "surely", "it depends" (on values that the datasheet lacks), "try
    it", "hopeless" or "surely not". The exit status is 1 for the last two.

    Example: codrl-mj motor feasible maxon-ec45-flat-50w pendulum --gear-ratio 20
    """

    name: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="NAME",
            help=(
                "A motor of the catalogue (codrl-mj motor list), a file, or your own motor as"
                " module:NAME."
            ),
        ),
    ]
    task_or_run: TaskOrRun
    gear_ratio: float | None = None
    """Turns of the rotor per turn of the joint, or radians per meter; default: the motor's own."""
    voltage: float | None = None
    """Voltage of the supply [V]."""
    max_current: float | None = None
    """Current limit of the drive [A]; default: the motor's own."""
    motor: MotorOfRun = None
    out: Path | None = None
    """Folder for torque_speed.png: the demanded operating points and the motor's limits."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the bounds, then the verdict."""
        from codrl_mj import sizing
        from codrl_mj.sizing import (
            demand_of,
            feasibility,
            find_drive,
            find_entry,
            ignored_quantities,
            with_best_gear,
        )

        drive = find_drive(
            self.name, self.gear_ratio, voltage=self.voltage, max_current=self.max_current
        )
        entry = find_entry(self.name)
        continuous = entry.parameters.continuous_current if entry else None
        unknown = ignored_quantities(entry)
        demand = demand_of(self.task_or_run, trust=self.trust, motor=self.motor)
        judgment = feasibility(drive, demand, continuous)
        title = (
            f"{self.name}, {_gear_text(drive, demand)}, {drive.voltage_limit:g} V: {demand.source}"
        )
        rows: list[tuple[RenderableType, ...]] = []
        for bound in judgment.bounds:
            # Unknown numbers are NaN, which differs from itself.
            numbers = (
                f"{value:.4g}" if value == value else "unknown"
                for value in (bound.needed, bound.available)
            )
            mark = Text("holds", "green") if bound.holds else Text("fails", "red")
            mark = Text("unknown", "yellow") if bound.verdict == sizing.DEPENDS else mark
            rows.append((bound.name, bound.formula, *numbers, bound.unit, mark, bound.verdict))
        print_table(
            title,
            ("bound", "of", "needs", "has", "unit", "", "verdict"),
            rows,
            right=("needs", "has"),
        )
        required = judgment.operating_points
        best_drive = with_best_gear(drive, demand, continuous)
        best_judgment = feasibility(best_drive, demand, continuous)
        (low, high) = sizing.equivalent_gears(best_drive, demand, continuous)
        print_text(
            f"{required.energy_drawn:.3g} J drawn and {required.copper_loss:.3g} J of heat per"
            f" episode, {required.rms_current:.3g} A rms; share of rotor and friction in the"
            f" largest load: {_own_share_text(drive, required)}",
            *map(str, judgment.failed_bounds),
            f"best {_gear_text(best_drive, demand)}: {best_judgment.verdict}, with a margin of"
            f" {best_judgment.margin:.0%}; the verdict is the same from {low:.3g} to {high:.3g}",
            _unknown_text(unknown, judgment.reason),
            drive.assumed,
        )
        if self.out is not None:
            _draw(drive, demand, self.name, self.out / "torque_speed.png")
        print_text(judgment.verdict)
        content = {
            "units": _UNITS,
            "motor": self.name,
            "gear_ratio": 1.0 / drive.arm_radius,
            "voltage": drive.voltage_limit,
            "demand": demand.source,
            "verdict": judgment.verdict,
            "margin": judgment.margin,
            "bounds": judgment.bounds,
            **_operation_mapping(required),
            "best": {
                "gear_ratio": 1.0 / best_drive.arm_radius,
                "verdict": best_judgment.verdict,
                "margin": best_judgment.margin,
            },
            "gear_ratios_as_good": (low, high),
            "unknown": unknown,
        }
        return int(judgment.verdict in (sizing.HOPELESS, sizing.SURELY_NOT)), content


@dataclasses.dataclass(frozen=True)
class Choose:
    """Rank motors for a task, the smallest suitable one first, and say why others are unsuitable.

    Before the task, name the motors to rank, from the catalogue or as files; the default is the
    whole catalogue. Each motor keeps the gear of its datasheet, or gets the best gear if the
    datasheet has none. With --gears, each motor is judged with each of these gears. A motor is
    suitable if `motor feasible` would answer "surely" with --margin in reserve. The smallest motor
    is the one with the least maximum mechanical power at its supply. If the run has several motors,
    the command chooses one for each of them. --out also writes actuators.yaml, which train,
    evaluate and render accept as --actuators FILE. The exit status is 1 if no motor is suitable.

    Example: codrl-mj motor choose pendulum --top 5 --out chosen, codrl-mj motor choose a.toml
    b.toml pendulum, codrl-mj motor choose a.toml pendulum --gears 6.25 18.75 30, or codrl-mj motor
    choose runs/Hopper_v5-sac-ideal-0
    """

    words: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="[MOTOR ...] TASK|RUN",
            help=(
                "Motors to rank, as for motor show (default: the whole catalogue); and a task, run"
                " folder or .npz file, as for motor feasible."
            ),
        ),
    ]
    top: int = 5
    """Number of motors in the table; the reasons against unsuitable ones are printed below it."""
    margin: float = 0.2
    """Share of the voltage, the peak current and the continuous current to keep in reserve."""
    voltage: float | None = None
    """Voltage of the supply [V]; default: each motor's own."""
    max_current: float | None = None
    """Current limit of the drive [A]; default: each motor's own."""
    gears: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RATIO ...")] = ()
    """Available gear ratios [turns of the rotor per turn of the joint, or radians per meter]. Each
    motor is judged with each of them. Default: the motor's own gear, or its best one if it has
    none.
    """
    motor: MotorOfRun = None
    out: Path | None = None
    """Folder for a diagram NAME.png of each motor in the table, with the demanded operating points
    and the motor's limits.
    """
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the ranking, or for several motors the best choice for each."""
        import yaml

        from codrl_mj.runs.files import atomic_write
        from codrl_mj.sizing import actuators_of, choose, demand_of, demands_of

        if self.top < 1:
            raise ValueError(f"--top {self.top}: must be >= 1")
        task_or_run, motors = _split_words(self.words)
        single_demand = self.motor is not None and {
            self.motor: demand_of(task_or_run, trust=self.trust, motor=self.motor)
        }
        demands = single_demand or demands_of(task_or_run, trust=self.trust)
        settings = motors or None, self.voltage, self.margin, self.gears, self.max_current
        ranked = {name: choose(demand, *settings) for name, demand in demands.items()}
        only_demand = next(iter(demands.values())) if len(demands) == 1 else None
        # MuJoCo multiplies the force of an actuator by the actuator's gear. The motor's arm radius
        # divides by this gear, so that the motor acts on the joint as it does in this ranking.
        if only_demand is not None and only_demand.model_gear != 1.0:
            text = (
                f"gears act at the joint; the model's actuator has a gear of"
                f" {only_demand.model_gear:g}, which the motor's "
            )
            print_text(f"{text}arm_radius {only_demand.model_gear:g} cancels")
        choices = [
            (name, choice)
            for name, ranking in ranked.items()
            for choice in (ranking if only_demand else ranking[:1])
        ]
        shown = choices[: self.top] if only_demand else choices
        source = only_demand.source if only_demand else task_or_run
        _print_ranking(
            shown,
            demands,
            f"smallest suitable motor with a margin of {self.margin:.0%} first: {source}",
        )
        for rank, (name, choice) in enumerate(choices):
            label = f"{choice.name} at {_gear_text(choice.drive, demands[name])}"
            unknown = _unknown_text(choice.unknown, choice.rejection_reason)
            notes = "; ".join(
                filter(None, (choice.rejection_reason, unknown, choice.drive.assumed))
            )
            if notes and (choice.rejection_reason or rank < len(shown)):
                print_text(f"{label}: {notes}" if only_demand else f"{name}: {label}: {notes}")
        unsuitable = [ranking[0].name for ranking in ranked.values() if ranking[0].rejection_reason]
        if self.out is not None:
            gears = [f"-{choice.ratio:.4g}" if self.gears else "" for _, choice in shown]
            stems = [choice.name.removesuffix(Path(choice.name).suffix) for _, choice in shown]
            motors = unique_names(
                [Path(f"{stem}{gear}") for stem, gear in zip(stems, gears, strict=True)]
            )
            for (name, choice), motor in zip(shown, motors, strict=True):
                picture = motor.replace("/", "-") if only_demand else name
                _draw(choice.drive, demands[name], choice.name, self.out / f"{picture}.png")
            with atomic_write(self.out / "actuators.yaml") as temporary:
                chosen = actuators_of(
                    {name: (ranking[0], demands[name]) for name, ranking in ranked.items()}
                )
                temporary.write_text(yaml.safe_dump(chosen, sort_keys=False))
            print(f"wrote {self.out / 'actuators.yaml'}")
            if unsuitable:
                print_text(
                    "no motor is surely suitable with that margin; the nearest was written:"
                    f" {', '.join(unsuitable)}"
                )
        content = [
            {
                "drives": name or None,
                "motor": choice.name,
                "gear_ratio": choice.ratio,
                "voltage": choice.drive.voltage_limit,
                "power": choice.power,
                "verdict": choice.feasibility.verdict,
                "does_it": not choice.rejection_reason,
                "lacks": choice.rejection_reason,
                "margin": choice.feasibility.margin,
                **_operation_mapping(choice.feasibility.operating_points),
                "unknown": choice.unknown,
            }
            for name, choice in choices
        ]
        return int(bool(unsuitable)), {"units": _UNITS, "demand": source, "ranking": content}


_UNITS = {
    "gear_ratio": "1, or rad/m on a slide",
    "gear_ratios_as_good": "1, or rad/m on a slide",
    "voltage": "V",
    "power": "W",
    "margin": "1",
    "own_share": "1",
    "peak_current": "A",
    "rms_current": "A",
    "energy_drawn": "J",
    "copper_loss": "J",
}


def _operation_mapping(required: OperatingPoints) -> dict[str, float]:
    """Return the numbers of an episode's operation, with names as in `_UNITS`."""
    fields = {
        name: getattr(required, name)
        for name in ("own_share", "rms_current", "energy_drawn", "copper_loss")
    }
    return {"peak_current": float(abs(required.current).max()), **fields}


def _unknown_text(unknown: Sequence[str], judgment_text: str) -> str:
    """Return a sentence with the unknown numbers that the judgment's text does not mention."""
    omitted = ", ".join(name for name in unknown if name not in judgment_text)
    return f"unknown and not counted: {omitted}" if omitted else ""


def _split_words(words: Sequence[str]) -> tuple[str, list[str]]:
    """Return the task, run or recording among some words, and the motors."""
    from codrl_mj.catalogue import motor_names
    from codrl_mj.tasks import TASKS

    subjects = [
        word
        for word in words
        if word in TASKS or Path(word).suffix == ".npz" or Path(word).is_dir()
    ]
    files = ".toml", ".yaml", ".yml", ".json"
    subjects = subjects or [
        word for word in words if not word.endswith(files) and word not in motor_names()
    ]
    if len(subjects) != 1:
        raise ValueError(
            f"motor choose: got {' and '.join(subjects) or 'no task'}: name exactly one task, run"
            " folder or .npz file, such as codrl-mj motor choose a.toml b.toml pendulum"
        )
    return subjects[0], [word for word in words if word != subjects[0]]


def _gear_text(drive: Drive, demand: Demand) -> str:
    """Return the gear of a drive as text, in rad/m on a slide."""
    return f"gear {1.0 / drive.arm_radius:.4g}{' rad/m' if demand.linear else ''}"


def _own_share_text(drive: Drive, required: OperatingPoints) -> str:
    """Return the share of the load that rotor and friction take, if the inertia is known."""
    return f"{required.own_share:.0%}" if drive.motor.rotor_inertia > 0.0 else "unknown"


def _print_ranking(
    choices: Sequence[tuple[str, Candidate]], demands: Mapping[str, Demand], title: str
) -> None:
    """Print a row for each choice; with several motors, the first column is the driven motor."""
    columns: tuple[str, ...]
    columns = (
        "motor",
        "gear",
        "supply\n[V]",
        "power\n[W]",
        "verdict",
        "mar-\ngin",
        "rotor\nshare",
        "peak\n[A]",
    )
    columns += ("rms\n[A]", "drawn\n[J]", "heat\n[J]")
    right, rows = [name for name in columns if name not in ("motor", "verdict")], []
    has_motor_names = len(demands) > 1
    for name, choice in choices:
        required = choice.feasibility.operating_points
        numbers = (
            abs(required.current).max(),
            required.rms_current,
            required.energy_drawn,
            required.copper_loss,
        )
        gear = _gear_text(choice.drive, demands[name])
        verdict = Text(choice.feasibility.verdict, "red" if choice.rejection_reason else "green")
        row = (
            *((name, choice.name) if has_motor_names else (choice.name,)),
            *(
                gear.removeprefix("gear "),
                f"{choice.drive.voltage_limit:g}",
                f"{choice.power:,.0f}",
                verdict,
            ),
            *(
                f"{choice.feasibility.margin:.0%}",
                _own_share_text(choice.drive, required),
                *(f"{value:.3g}" for value in numbers),
            ),
        )
        rows.append(row)
    print_table(
        title,
        (*(("drives",) if has_motor_names else ()), *columns),
        rows,
        right,
        columns[1:],
        padding=(0, 0),
    )


def _draw(drive: Drive, demand: Demand, name: str, path: Path) -> None:
    """Draw the torque-speed diagram of a drive with the operating points of a demand.

    The points are at the output of the gear and include the torque that the rotor's inertia needs.
    """
    import numpy as np

    from codrl_mj.sizing.limits import find_entry
    from codrl_mj.viz.pages.diagrams import torque_speed_diagram

    radius, entry = drive.motor.arm_radius, find_entry(name)
    # The demand is at the joint. Dividing speeds and multiplying torques by the arm radius refers
    # it to the gear's output.
    torque = radius * (demand.torque + drive.additions.armature * demand.acceleration)
    points = np.column_stack([demand.speed / radius, torque])
    save_plot(
        torque_speed_diagram(drive, None if entry is None else entry.parameters, points), path
    )
