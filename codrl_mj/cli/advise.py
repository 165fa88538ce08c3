"""`codrl-mj advise`."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.fields import did_you_mean

_DELIVERED = {
    # field of Delivery: what it is, unit, digits
    "lag": ("lag: time constant of a first-order one that is as late", "policy steps", ".3g"),
    "dead_time": ("dead time", "policy steps", ".3g"),
    "at_rest": ("delivered of the largest force, at rest", "", ".0%"),
    "at_speed": ("delivered of it at the reference speed", "", ".0%"),
    "friction": ("friction", "largest force", ".3g"),
    "noise": ("noise of the force", "largest force", ".3g"),
    "unasked": ("force while nothing is asked for", "largest force", ".3g"),
}


@dataclasses.dataclass(frozen=True)
class Advise:
    """Say whether to train on ideal forces, design the loop, train through an actuator, or buy another: docs/advise.md.

    A bench measures how late, how much and how noisily the actuator delivers the task's largest force; the study's
    results say what policies that were trained on ideal forces lose by that. --measure trains some, on ideal forces
    and through it, and tests them on it, which takes minutes; killed, it goes on where it was.

    Example: codrl-mj advise maxon-ec45-flat-50w pendulum --gear-ratio 20, or codrl-mj advise paper cartpole --measure 5
    """

    actuator: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="ACTUATOR",
            help="A motor of the catalogue (codrl-mj motor list), a variation of the paper's (paper, weak "
            "...), a file with the fields of an actuator or a datasheet, or module:NAME of your own.",
        ),
    ]
    task: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="TASK", help="One of the study's tasks, such as pendulum."),
    ]
    gear_ratio: float | None = None
    """Turns of the rotor for a turn of the joint, or radians for a metre; the motor's own unless given."""
    voltage: float | None = None
    """Voltage of the supply [V]; the motor's nominal one unless given."""
    measure: int | None = None
    """Train so many policies of either kind, at least 2, and test them on it."""
    root: Path = Path("runs/advise")
    """Folder of the run folders of --measure."""
    jobs: int = -1
    """Trainings at once; -1 for one on each CPU."""
    evidence: Path | None = None
    """The study's hypotheses.csv, unless that of the installation is meant."""
    as_json: Annotated[
        bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(name="json", help="Print JSON instead of tables.")
    ] = False

    def run(self) -> int:
        """Print the doses, what they cost, and the verdict last."""
        from codrl_mj.cli.terminal import say
        from codrl_mj.study.advice import advise
        from codrl_mj.study.doses import REFERENCE_SPEEDS, posed
        from codrl_mj.study.evidence import Evidence

        if self.task not in REFERENCE_SPEEDS:
            raise ValueError(
                f"TASK = {self.task!r}: {did_you_mean(self.task, REFERENCE_SPEEDS)}The study, and so --measure, knows "
                f"{', '.join(REFERENCE_SPEEDS)}; for any other train a policy on ideal forces and one through the "
                f"actuator, and compare them on it: codrl-mj evaluate RUN RUN --actuator {self.actuator}"
            )
        if self.measure is not None and self.measure < 2:
            raise ValueError(f"--measure {self.measure}: must be >= 2, or there is no interval")
        try:
            actuator = posed(self.task, self._named()).actuator
        except ValueError as error:
            given = {"--gear-ratio": self.gear_ratio, "--voltage": self.voltage}
            about = ", ".join(flag for flag, value in given.items() if value is not None)
            raise ValueError(f"{about}: {error}" if about else str(error)) from error
        found = advise(actuator, self.task, Evidence.read(self.evidence))
        if not self.as_json:
            _print(self.actuator, found)
            say(actuator.assumed)
        measured = None if self.measure is None else self._measured(actuator, self.measure)
        if self.as_json:
            print(json.dumps({"advice": _plain(found), "measured": measured and _plain(measured)}, indent=2))
        return 0

    def _named(self) -> Any:
        changed: dict[str, Any] = {}
        if self.gear_ratio is not None:
            changed["motor"] = {"gear_ratio": self.gear_ratio}
        if self.voltage is not None:
            changed["supply"] = {"voltage": self.voltage}
        return {"name": self.actuator, **changed} if changed else self.actuator

    def _measured(self, actuator: Any, seeds: int) -> Any:
        from codrl_mj.cli.terminal import print_table, say
        from codrl_mj.study.measured import measured, measured_grid
        from codrl_mj.study.parallel import Workers
        from codrl_mj.study.program import compute

        grid = measured_grid(actuator, self.task, seeds, self.root)
        if self.as_json:
            grid.compute(Workers(self.jobs))
        else:
            compute(grid, Workers(self.jobs))
        found = measured(actuator, self.task, grid.collect())
        if not self.as_json:
            rows = [
                (name, f"{mean:.2f}", f"{low:.2f} to {high:.2f}") for name, (mean, low, high) in found.scores.items()
            ]
            title = f"Measured: {seeds} policies of either kind, 50 episodes each"
            print_table(title, ("what is done", "score on it", "95 %"), rows)
            say(f"measured: {found.verdict}")
        return found


def _print(name: str, found: Any) -> None:
    from codrl_mj.cli.terminal import print_table, say
    from codrl_mj.study.advice import LOOP
    from codrl_mj.study.doses import AXES

    columns = "what it does to the largest force", "value", "unit"
    rows: list[tuple[Any, ...]] = [
        (title, format(getattr(found.found, field), digits), unit)
        for field, (title, unit, digits) in _DELIVERED.items()
    ]
    print_table(f"{name} on {found.task}, on the bench", columns, rows, right=("value",))
    if found.losses:
        rows = []
        for loss in found.losses:
            mean = f"{'at least ' if loss.beyond else ''}{loss.loss.mean:z.2f}"
            bounds = f"{loss.loss.low:z.2f} to {loss.loss.high:z.2f}"
            rows.append((loss.axis, f"{loss.dose:.3g}", AXES[loss.axis].unit, mean, bounds, ", ".join(loss.rows)))
        title = "What policies lose by it that were trained on ideal forces [shares of the task's span]"
        print_table(title, ("by", "dose", "unit", "loss", "95 %", "rows"), rows, right=("dose", "loss"))
    better = found.redesigned
    if better is not None and better.verdict is not None and found.verdict != LOOP:
        say(f"the same motor under a designed loop: {better.verdict}, {better.reason}")
    say(f"{found.verdict}: {found.reason}" if found.verdict else f"no verdict: {found.reason} (--measure 5)")


def _plain(value: Any) -> Any:
    """Named tuples as mappings, recursively."""
    if hasattr(value, "_asdict"):
        extra = {"lost": _plain(value.lost)} if getattr(value, "losses", ()) else {}
        return {name: _plain(part) for name, part in value._asdict().items()} | extra
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return [_plain(part) for part in value] if isinstance(value, tuple) else value
