"""`codrl-mj motor feasible` and `codrl-mj motor choose`."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.text import Text

from codrl_mj.cli.motor import save_plot
from codrl_mj.cli.parsing import AsJson, Trust
from codrl_mj.cli.terminal import print_table, say
from codrl_mj.runs import unique_names

Asked = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="TASK|RUN",
        help=(
            "A task, which a scripted controller drives; a run folder, trained on the ideal"
            " actuator, of a task or of somebody else's environment; or an .npz file with the"
            " arrays time [s], torque [N*m] and speed [rad/s] of a joint."
        ),
    ),
]
OfMotor = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME",
        help="Of a run with several motors, the one that is asked about, by its name.",
    ),
]


@dataclasses.dataclass(frozen=True)
class Feasible:
    """Ask whether a motor can do a task, before training; docs/motors.md.

    The last line is surely, it depends (on what the datasheet lacks), try it, hopeless or surely
    not; exit status 1 for the last two. Example: codrl-mj motor feasible maxon-ec45-flat-50w
    pendulum --gear-ratio 20
    """

    name: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="NAME",
            help="A motor of the catalogue (codrl-mj motor list), or a file or module:NAME.",
        ),
    ]
    asked: Asked
    gear_ratio: float | None = None
    """Turns of the rotor for a turn of the joint, or radians for a metre; the motor's own unless given."""
    voltage: float | None = None
    """Voltage of the supply [V]."""
    max_current: float | None = None
    """Largest current that the drive gives [A]; the motor's own unless given."""
    motor: OfMotor = None
    out: Path | None = None
    """Folder for torque_speed.png: what was asked for over what the motor can do."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the bounds, and the verdict last."""
        from codrl_mj import sizing
        from codrl_mj.sizing import (
            demand_of,
            feasibility,
            find_drive,
            find_entry,
            with_best_gear,
            ignored_quantities,
        )

        drive = find_drive(
            self.name, self.gear_ratio, voltage=self.voltage, max_current=self.max_current
        )
        entry = find_entry(self.name)
        continuous, unknown = entry.numbers.continuous_current if entry else None, ignored_quantities(entry)
        demand = demand_of(self.asked, trust=self.trust, motor=self.motor)
        found = feasibility(drive, demand, continuous)
        title = f"{self.name}, {_gear(drive, demand)}, {drive.voltage_limit:g} V: {demand.source}"
        rows: list[Any] = []
        for bound in found.bounds:
            numbers = (
                f"{value:.4g}" if value == value else "unknown"
                for value in (bound.needed, bound.available)
            )
            mark = Text("holds", "green") if bound.holds else Text("fails", "red")
            mark = Text("unknown", "yellow") if bound.verdict == sizing.DEPENDS else mark
            rows.append((bound.name, bound.formula, *numbers, bound.unit, mark, bound.verdict))
        print_table(
            title, ("bound", "of", "needs", "has", "unit", "", "says"), rows, right=("needs", "has")
        )
        asked, best = found.operation, with_best_gear(drive, demand, continuous)
        at_best, (low, high) = (
            feasibility(best, demand, continuous),
            sizing.equivalent_gears(best, demand, continuous),
        )
        say(
            f"{asked.energy_drawn:.3g} J drawn and {asked.copper_loss:.3g} J of heat in an episode,"
            f" {asked.rms_current:.3g} A rms; share of rotor and friction in the largest load:"
            f" {_share(drive, asked)}",
            *map(str, found.failed_bounds),
            f"best {_gear(best, demand)}: {at_best.verdict}, with a margin of {at_best.margin:.0%};"
            f" the verdict is the same from {low:.3g} to {high:.3g}",
            _uncounted(unknown, found.reason),
            drive.assumed,
        )
        if self.out is not None:
            _draw(drive, demand, self.name, self.out / "torque_speed.png")
        say(found.verdict)
        content = {
            "units": _UNITS,
            "motor": self.name,
            "gear_ratio": 1.0 / drive.arm_radius,
            "voltage": drive.voltage_limit,
            "demand": demand.source,
            "verdict": found.verdict,
            "margin": found.margin,
            "bounds": found.bounds,
            **_asked(asked),
            "best": {
                "gear_ratio": 1.0 / best.arm_radius,
                "verdict": at_best.verdict,
                "margin": at_best.margin,
            },
            "gear_ratios_as_good": (low, high),
            "unknown": unknown,
        }
        return int(found.verdict in (sizing.HOPELESS, sizing.SURELY_NOT)), content


@dataclasses.dataclass(frozen=True)
class Choose:
    """Rank motors for a task, the smallest that does it first, and say what is wrong with the others.

    Exit status 1 if none does it. Motors of your own (files) or of the catalogue are named beside
    the task; without any the catalogue's are ranked. Each keeps the gear of its datasheet, gets its
    best one if it has none, or is judged with each of --gears. It does the task if motor feasible
    says surely, with the margin; smallest means by the most mechanical power at its supply. A run
    with several motors gets one for each of them. With --out there is the file actuators.yaml,
    which train, evaluate and render take as --actuators FILE.

    Example: codrl-mj motor choose pendulum --top 5 --out chosen, codrl-mj motor choose a.toml
    b.toml pendulum, codrl-mj motor choose a.toml pendulum --gears 6.25 18.75 30, or codrl-mj motor
    choose runs/Hopper_v5-sac-ideal-0
    """

    words: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="[MOTOR ...] TASK|RUN",
            help=(
                "Motors to rank, as for motor show, if not the whole catalogue; and a task, run"
                " folder or .npz file, as for motor feasible."
            ),
        ),
    ]
    top: int = 5
    """How many to show in the table; of those that do not do it is told why."""
    margin: float = 0.2
    """Share of voltage, largest and continuous current that has to be left."""
    voltage: float | None = None
    """Voltage of the supply [V]; each motor's own unless given."""
    max_current: float | None = None
    """Largest current that the drive gives [A]; each motor's own unless given."""
    gears: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RATIO ...")] = ()
    """Gears that can be bought, turns of the rotor for a turn of the joint, or radians for a metre:
    every motor is judged with each of them. None: the motor's own gear, or its best one if it has
    none.
    """
    motor: OfMotor = None
    out: Path | None = None
    """Folder for NAME.png of those shown: what was asked for over what the motor can do."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the ranking, or of several motors the best for each."""
        import yaml

        from codrl_mj.runs.files import atomic_write
        from codrl_mj.sizing import actuators_of, choose, demand_of, demands_of

        if self.top < 1:
            raise ValueError(f"--top {self.top}: must be >= 1")
        asked, motors = _told_apart(self.words)
        one = self.motor is not None and {
            self.motor: demand_of(asked, trust=self.trust, motor=self.motor)
        }
        demands = one or demands_of(asked, trust=self.trust)
        settings = motors or None, self.voltage, self.margin, self.gears, self.max_current
        ranked = {name: choose(demand, *settings) for name, demand in demands.items()}
        alone = next(iter(demands.values())) if len(demands) == 1 else None
        if alone is not None and alone.model_gear != 1.0:
            text = (
                f"gears are at the joint; the model's actuator has one of {alone.model_gear:g},"
                " which the motor's "
            )
            say(f"{text}arm_radius {alone.model_gear:g} undoes")
        told = [
            (name, choice)
            for name, found in ranked.items()
            for choice in (found if alone else found[:1])
        ]
        shown = told[: self.top] if alone else told
        source = alone.source if alone else asked
        _print_ranking(
            shown, demands, f"smallest that does it with {self.margin:.0%} left first: {source}"
        )
        for place, (name, choice) in enumerate(told):
            at = f"{choice.name} at {_gear(choice.drive, demands[name])}"
            unknown = _uncounted(choice.unknown, choice.rejection_reason)
            about = "; ".join(filter(None, (choice.rejection_reason, unknown, choice.drive.assumed)))
            if about and (choice.rejection_reason or place < len(shown)):
                say(f"{at}: {about}" if alone else f"{name}: {at}: {about}")
        short = [found[0].name for found in ranked.values() if found[0].rejection_reason]
        if self.out is not None:
            gears = [f"-{choice.ratio:.4g}" if self.gears else "" for _, choice in shown]
            stems = [choice.name.removesuffix(Path(choice.name).suffix) for _, choice in shown]
            motors = unique_names(
                [Path(f"{stem}{gear}") for stem, gear in zip(stems, gears, strict=True)]
            )
            for (name, choice), motor in zip(shown, motors, strict=True):
                picture = motor.replace("/", "-") if alone else name
                _draw(choice.drive, demands[name], choice.name, self.out / f"{picture}.png")
            with atomic_write(self.out / "actuators.yaml") as temporary:
                chosen = actuators_of(
                    {name: (found[0], demands[name]) for name, found in ranked.items()}
                )
                temporary.write_text(yaml.safe_dump(chosen, sort_keys=False))
            print(f"wrote {self.out / 'actuators.yaml'}")
            if short:
                say(
                    "no motor surely does it with that margin; written is the nearest:"
                    f" {', '.join(short)}"
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
                **_asked(choice.feasibility.operation),
                "unknown": choice.unknown,
            }
            for name, choice in told
        ]
        return int(bool(short)), {"units": _UNITS, "demand": source, "ranking": content}


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


def _asked(found: Any) -> dict[str, Any]:
    """What an episode asks of a motor, by names in `_UNITS`."""
    named = {
        name: getattr(found, name)
        for name in ("own_share", "rms_current", "energy_drawn", "copper_loss")
    }
    return {"peak_current": float(abs(found.current).max()), **named}


def _uncounted(unknown: Sequence[str], said: str) -> str:
    """Say which numbers a judgment leaves out, but for those that it names itself."""
    rest = ", ".join(name for name in unknown if name not in said)
    return f"not known, and not counted: {rest}" if rest else ""


def _told_apart(words: Sequence[str]) -> tuple[str, list[str]]:
    """The task, run or recording among some words, and the motors."""
    from codrl_mj.catalogue import motor_names
    from codrl_mj.tasks import TASKS

    asked = [
        word
        for word in words
        if word in TASKS or Path(word).suffix == ".npz" or Path(word).is_dir()
    ]
    files = ".toml", ".yaml", ".yml", ".json"
    asked = asked or [
        word for word in words if not word.endswith(files) and word not in motor_names()
    ]
    if len(asked) != 1:
        raise ValueError(
            f"motor choose: {' and '.join(asked) or 'nothing'} to choose for: name one task, run"
            " folder or .npz file, such as codrl-mj motor choose a.toml b.toml pendulum"
        )
    return asked[0], [word for word in words if word != asked[0]]


def _gear(drive: Any, demand: Any) -> str:
    """Its gear, with the unit that it has on a slide."""
    return f"gear {1.0 / drive.arm_radius:.4g}{' rad/m' if demand.linear else ''}"


def _share(drive: Any, asked: Any) -> str:
    """What rotor and friction take of the load, where the rotor is known."""
    return f"{asked.own_share:.0%}" if drive.motor.rotor_inertia > 0.0 else "unknown"


def _print_ranking(
    choices: Sequence[tuple[str, Any]], demands: Mapping[str, Any], title: str
) -> None:
    """A row for each choice; of several motors, each with what it drives."""
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
    several = len(demands) > 1
    for name, choice in choices:
        asked = choice.feasibility.operation
        numbers = abs(asked.current).max(), asked.rms_current, asked.energy_drawn, asked.copper_loss
        gear, does = (
            _gear(choice.drive, demands[name]),
            Text(choice.feasibility.verdict, "red" if choice.rejection_reason else "green"),
        )
        row = (
            *((name, choice.name) if several else (choice.name,)),
            *(
                gear.removeprefix("gear "),
                f"{choice.drive.voltage_limit:g}",
                f"{choice.power:,.0f}",
                does,
            ),
            *(
                f"{choice.feasibility.margin:.0%}",
                _share(choice.drive, asked),
                *(f"{one:.3g}" for one in numbers),
            ),
        )
        rows.append(row)
    print_table(
        title,
        (*(("drives",) if several else ()), *columns),
        rows,
        right,
        columns[1:],
        padding=(0, 0),
    )


def _draw(drive: Any, demand: Any, name: str, path: Path) -> None:
    """The torque-speed diagram with what the demand asks at the gear's output, the rotor's inertia included."""
    import numpy as np

    from codrl_mj.sizing.abilities import find_entry
    from codrl_mj.viz.pages.diagrams import torque_speed_diagram

    radius, entry = drive.motor.arm_radius, find_entry(name)
    torque = radius * (demand.torque + drive.additions.armature * demand.acceleration)
    points = np.column_stack([demand.speed / radius, torque])
    save_plot(torque_speed_diagram(drive, None if entry is None else entry.numbers, points), path)
