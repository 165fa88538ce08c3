"""`codrl-mj motor feasible` and `codrl-mj motor choose`."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

Asked = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="TASK|RUN",
        help="A task, which a scripted controller drives; a run folder, trained on the ideal actuator, of a task or of "
        "somebody else's environment; or an .npz file with the arrays time [s], torque [N*m] and speed [rad/s] of a "
        "joint.",
    ),
]
OfMotor = Annotated[
    str | None,
    tyro.conf.arg(metavar="NAME", help="Of a run with several motors, the one that is asked about, by its name."),
]
Trust = Annotated[
    bool, tyro.conf.arg(help="Import the modules of a run folder's task or agent if these are somebody's own.")
]


@dataclasses.dataclass(frozen=True)
class Feasible:
    """Ask whether a motor can do a task, before anything is trained: surely, surely not, or try it. docs/motors.md.

    Exit status 1 if surely not. Example: codrl-mj motor feasible maxon-ec45-flat-50w pendulum --gear-ratio 20
    """

    name: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="NAME", help="A motor of the catalogue (codrl-mj motor list), or a file or module:NAME."),
    ]
    asked: Asked
    gear_ratio: float | None = None
    """Turns of the rotor for a turn of the joint, or radians for a metre; the motor's own unless given."""
    voltage: float | None = None
    """Voltage of the supply [V]."""
    motor: OfMotor = None
    out: Path | None = None
    """Folder for torque_speed.png: what was asked for over what the motor can do."""
    trust: Trust = False

    def run(self) -> int:
        """Print the bounds, and the verdict last."""
        from codrl_mj.cli.look import titled_table
        from codrl_mj.cli.terminal import console
        from codrl_mj.sizing import SURELY_NOT, catalogued, demand_of, feasibility

        drive, continuous, unknown = catalogued(self.name, self.gear_ratio, self.voltage)
        demand = demand_of(self.asked, trust=self.trust, motor=self.motor)
        found = feasibility(drive, demand, continuous)
        table = titled_table(
            f"{self.name}, gear {1.0 / drive.arm_radius:.4g}, {drive.voltage_limit:g} V: {demand.source}"
        )
        for header in ("bound", "of", "needs", "has", "unit", "", "says"):
            table.add_column(header, justify="right" if header in ("needs", "has") else "left")
        for bound in found.bounds:
            numbers = f"{bound.needed:.4g}", f"{bound.available:.4g}"
            table.add_row(bound.name, bound.formula, *numbers, bound.unit, _mark(bound.holds), bound.verdict)
        console().print(table)
        asked = found.operation
        lines = [
            f"{asked.energy_drawn:.3g} J drawn and {asked.copper_loss:.3g} J of heat in an episode, "
            f"{asked.rms_current:.3g} A rms; rotor and friction add up to {asked.own_share:.0%} of the largest load",
            *(f"{bound.name}: {bound.remedy}" for bound in found.bounds if not bound.holds),
        ]
        if unknown:
            lines.append(f"not in the datasheet, and not counted: {', '.join(unknown)}")
        for line in lines:
            console().print(line, markup=False, highlight=False)
        if self.out is not None:
            _draw(drive, demand, self.name, self.out / "torque_speed.png")
        console().print(found.verdict, markup=False, highlight=False)
        return 1 if found.verdict == SURELY_NOT else 0


@dataclasses.dataclass(frozen=True)
class Choose:
    """Rank the catalogue's motors for a task, the smallest that does it first, and say what is wrong with the others.

    Each is taken at its best gear. It does the task if voltage, largest current and heat hold with the margin, its heat
    is known, and the rotor leaves half to the load; smallest means by the most mechanical power at its supply. A run
    with several motors gets one for each of them. With --out there is the file actuators.yaml, which train, evaluate
    and render take as --actuators FILE.

    Example: codrl-mj motor choose pendulum --top 5 --out chosen, or codrl-mj motor choose runs/Hopper_v5-sac-ideal-0
    """

    asked: Asked
    top: int = 5
    """How many to show in the table; of those that do not do it is told why."""
    margin: float = 0.2
    """Share of voltage, largest and continuous current that has to be left."""
    voltage: float | None = None
    """Voltage of the supply [V]; each motor's own unless given."""
    motor: OfMotor = None
    out: Path | None = None
    """Folder for NAME.png of those shown: what was asked for over what the motor can do."""
    trust: Trust = False

    def run(self) -> int:
        """Print the ranking."""
        from codrl_mj.cli.terminal import console
        from codrl_mj.sizing import choose, demand_of, demands_of

        if self.top < 1:
            raise ValueError(f"--top {self.top}: must be >= 1")
        if self.motor is None and len(demands := demands_of(self.asked, trust=self.trust)) > 1:
            return self._for_each(demands)
        demand = demand_of(self.asked, trust=self.trust, motor=self.motor)
        choices = choose(demand, voltage=self.voltage, least_margin=self.margin)
        shown, console_ = choices[: self.top], console()
        if demand.model_gear != 1.0:
            text = f"gears are at the joint; the model's actuator has one of {demand.model_gear:g}, which the motor's "
            console_.print(f"{text}arm_radius {demand.model_gear:g} undoes", markup=False, highlight=False)
        console_.print(_ranking(shown, f"smallest that does it with {self.margin:.0%} left first: {demand.source}"))
        for choice in shown:
            if choice.unknown:
                text = f"{choice.name}: not in its datasheet, and not counted: {', '.join(choice.unknown)}"
                console_.print(text, markup=False, highlight=False)
        for choice in choices:
            if choice.lacks:
                text = f"{choice.name} at gear {choice.ratio:.4g}: {choice.lacks}"
                console_.print(text, markup=False, highlight=False)
        for choice in shown if self.out is not None else ():
            assert self.out is not None
            _draw(choice.drive, demand, choice.name, self.out / f"{Path(choice.name).stem}.png")
        self._write({self.motor or "": (choices[0], demand)})
        return 0

    def _for_each(self, demands: Mapping[str, Any]) -> int:
        """Choose for each of several motors, and say how to go on."""
        from codrl_mj.cli.terminal import console
        from codrl_mj.sizing import choose

        best = {}
        for name, demand in demands.items():
            ranked = choose(demand, voltage=self.voltage, least_margin=self.margin)
            best[name] = ranked[0]
            if self.out is not None:
                _draw(ranked[0].drive, demand, ranked[0].name, self.out / f"{name}.png")
        console().print(_ranking(best.values(), f"smallest with {self.margin:.0%} left: {self.asked}", list(best)))
        for name, choice in best.items():
            if choice.lacks:
                text = f"{name}: none does it; {choice.name} comes nearest at gear {choice.ratio:.4g}: {choice.lacks}"
                console().print(text, markup=False, highlight=False)
        self._write({name: (choice, demands[name]) for name, choice in best.items()})
        return 0

    def _write(self, choices: Mapping[str, Any]) -> None:
        """Leave what --actuators takes."""
        if self.out is None:
            return
        import yaml

        from codrl_mj.runs.files import writing
        from codrl_mj.sizing import actuators_of

        with writing(self.out / "actuators.yaml") as temporary:
            temporary.write_text(yaml.safe_dump(actuators_of(choices), sort_keys=False))
        print(f"wrote {self.out / 'actuators.yaml'}")


def _ranking(choices: Iterable[Any], title: str, driven: Sequence[str] = ()) -> Any:
    """A row for each choice; of several motors, each with what it drives."""
    from codrl_mj.cli.look import titled_table

    table = titled_table(title)
    if driven:
        table.add_column("drives", overflow="fold")
    columns = ("motor", "gear", "supply\n[V]", "power\n[W]", "does\nit", "margin", "rotor's\nshare", "peak\n[A]")
    for header in (*columns, "rms\n[A]", "drawn\n[J]", "heat\n[J]"):
        table.add_column(header, justify="left" if header in ("motor", "does\nit") else "right", no_wrap=True)
    for choice, name in itertools.zip_longest(choices, driven):
        asked = choice.feasibility.operation
        numbers = abs(asked.current).max(), asked.rms_current, asked.energy_drawn, asked.copper_loss
        table.add_row(
            *((name,) if driven else ()),
            *(choice.name, f"{choice.ratio:.4g}", f"{choice.drive.voltage_limit:g}", f"{choice.power:,.0f}"),
            "[red]no" if choice.lacks else "[green]yes",
            *(f"{choice.feasibility.margin:.0%}", f"{asked.own_share:.0%}", *(f"{number:.3g}" for number in numbers)),
        )
    return table


def _mark(holds: bool) -> str:
    return "[green]holds" if holds else "[red]fails"


def _draw(drive: Any, demand: Any, name: str, path: Path) -> None:
    """The torque-speed diagram with what the demand asks at the gear's output, the rotor's inertia included."""
    import numpy as np

    from codrl_mj.motor_design.drives import find_entry
    from codrl_mj.motor_design.figures import save, torque_speed_diagram

    radius, entry = drive.motor.arm_radius, find_entry(name)
    torque = radius * (demand.torque + drive.additions.armature * demand.acceleration)
    points = np.column_stack([demand.speed / radius, torque])
    path.parent.mkdir(parents=True, exist_ok=True)
    save(torque_speed_diagram(drive, None if entry is None else entry.numbers, points), path)
    print(f"wrote {path}")
