"""`codrl-mj advise`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.parsing import AsJson, Trust
from codrl_mj.cli.terminal import print_table, say
from codrl_mj.fields import did_you_mean

_DELIVERED = {
    # field of Delivery: what it is, unit, digits
    "lag": ("lag, as a first-order time constant", "policy steps", ".3g"),
    "dead_time": ("dead time", "policy steps", ".3g"),
    "at_rest": ("delivered of the largest force, at rest", "", ".0%"),
    "at_speed": ("delivered of it at the reference speed", "", ".0%"),
    "friction": ("friction", "largest force", ".3g"),
    "noise": ("noise of the force", "largest force", ".3g"),
    "unasked": ("force while nothing is asked for", "largest force", ".3g"),
}


@dataclasses.dataclass(frozen=True)
class Advise:
    """Say what to do about an actuator: train on ideal forces, tune, randomise, train through it, or buy another.

    A bench measures how late, how much and how noisily the actuator delivers the task's largest
    force; the study's results say what policies lose by that (docs/advise.md). --measure trains
    some, on ideal forces, on random actuators and through it, and tests them on it, which takes
    minutes; killed, it goes on where it was.

    Example: codrl-mj advise maxon-ec45-flat-50w pendulum --gear-ratio 20, or codrl-mj advise paper
    cartpole --measure 5
    """

    actuator: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="ACTUATOR",
            help=(
                "A motor of the catalogue (codrl-mj motor list), a variation of the paper's (paper,"
                " weak ...), a file with the fields of an actuator or a datasheet, or module:NAME"
                " of your own."
            ),
        ),
    ]
    task: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="TASK",
            help=(
                "One of the study's tasks, such as pendulum; with --measure also a task of your own"
                " (module:NAME), an environment (HalfCheetah-v5), or the folder of a run, whose"
                " environment, agent and budget are taken."
            ),
        ),
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
    """The study's runs.csv, unless that of the installation is meant."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Print the doses, what is known of what can be done, and the verdict last."""
        from codrl_mj.study.advice import advise
        from codrl_mj.study.axes import REFERENCE_SPEEDS, study_env
        from codrl_mj.study.evidence import Evidence

        known = self.task in REFERENCE_SPEEDS
        if not known and self.measure is None:
            raise ValueError(
                f"TASK = {self.task!r}: {did_you_mean(self.task, REFERENCE_SPEEDS)}The study knows"
                f" {', '.join(REFERENCE_SPEEDS)}; for any other, and for a run, train and test:"
                " --measure 5"
            )
        if self.measure is not None and self.measure < 2:
            raise ValueError(f"--measure {self.measure}: must be >= 2, or there is no interval")
        named: Any = self.actuator
        if self.gear_ratio is not None or self.voltage is not None:
            motor = {} if self.gear_ratio is None else {"motor": {"gear_ratio": self.gear_ratio}}
            supply = {} if self.voltage is None else {"supply": {"voltage": self.voltage}}
            named = {"name": self.actuator, **motor, **supply}
        found = None
        if known:
            try:
                actuator = study_env(self.task, named).actuator
            except ValueError as error:
                given = {"--gear-ratio": self.gear_ratio, "--voltage": self.voltage}
                about = ", ".join(flag for flag, value in given.items() if value is not None)
                raise ValueError(f"{about}: {error}" if about else str(error)) from error
            found = advise(actuator, self.task, Evidence.read(*filter(None, [self.evidence])))
            _print(self.actuator, found)
            say(actuator.assumed)
        measured = None
        if self.measure is not None:
            from codrl_mj.study.advice import decide, plan_measurement
            from codrl_mj.study.parallel import Workers
            from codrl_mj.study.program import compute

            asked = plan_measurement(named, self.task, self.measure, self.root, trust=self.trust)
            compute(asked.grid, Workers(self.jobs))
            options = asked.loss_bounds(asked.grid.collect())
            measured = {"options": options, "verdict": decide(options)}
            _print_options(
                f"Measured: {self.measure} policies of either kind, 50 episodes each", options
            )
            more = " by more policies (--measure)" * (measured["verdict"] == "measure it")
            say(f"measured: {measured['verdict']}{more}")
        units = {name: unit or "1" for name, (_, unit, _) in _DELIVERED.items()} | {
            "loss": "share of the task's span"
        }
        return 0, {"units": units, "advice": found, "measured": measured}


def _print(name: str, found: Any) -> None:
    from codrl_mj.study.axes import AXES

    columns = "what it does to the largest force", "value", "unit"
    rows: list[tuple[Any, ...]] = [
        (title, format(getattr(found.delivery, field), digits), unit)
        for field, (title, unit, digits) in _DELIVERED.items()
    ]
    print_table(f"{name} on {found.task}, on the bench", columns, rows, right=("value",))
    if found.losses:
        rows = []
        for one in found.losses:
            unit = AXES[one.axis].unit.rpartition("[")[2].removesuffix("]").removeprefix("missing ")
            tested = ", ".join(dose.removeprefix(f"{one.axis} ") for dose in one.between)
            lost = _lost(one.outcome, "at least " * one.beyond)
            rows.append((one.axis, f"{one.severity:.3g}", unit, *lost, tested))
        title = (
            "What policies lose by it that were trained on ideal forces [shares of the task's span]"
        )
        print_table(
            title,
            ("by", "dose", "unit", *_LOST, "tested at"),
            rows,
            right=("dose", *_LOST),
            whole=_LOST,
        )
        _print_options("What is known of what can be done", found.options)
    say(
        f"{found.verdict}: {found.reason}"
        if found.verdict
        else f"no verdict: {found.reason} (--measure 5)"
    )


_LOST = "loss", "95 %", "fail", "success\nlost"


def _print_options(title: str, options: Any) -> None:
    from codrl_mj.study.advice import OPTIONS

    rows = []
    for name in OPTIONS:
        if name in options:
            told = options[name].upper or options[name].lower
            rows.append(
                (name, *(_lost(told, options[name].bound) if told else ("not tested", "", "", "")))
            )
    print_table(f"{title} [shares of the task's span]", ("what is done", *_LOST), rows, right=_LOST)


def _lost(outcome: Any, bound: str) -> tuple[str, ...]:
    mean, low, high = outcome.loss
    count = len(outcome.lost)
    failed = f"{round(outcome.failed * count)} of {count}"
    return (
        f"{bound}{mean:z.2f}",
        f"{low:z.2f} to {high:z.2f}",
        failed,
        f"{100 * outcome.success_lost.mean:z.0f} %",
    )
