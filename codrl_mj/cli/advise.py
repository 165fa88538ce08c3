"""`codrl-mj advise`."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import ActuatorSetting
from codrl_mj.cli.parsing import AsJson, Output, Trust
from codrl_mj.cli.terminal import print_table, print_text
from codrl_mj.fields import did_you_mean
from codrl_mj.study.evidence import Evidence, LossBounds, Outcome

POLICIES = 10
"""Number of policies of each kind that `--measure` trains if none is given."""

# `codrl_mj.study.advice` loads the engine, so only the running verb imports it.
Advice = Any
"""Class of this name in `codrl_mj.study.advice`."""

_DELIVERED = {
    # field of Delivery: (label, unit, number format)
    "lag": ("lag, as a first-order time constant", "policy steps", ".3g"),
    "dead_time": ("dead time", "policy steps", ".3g"),
    "at_rest": ("delivered share of the largest force, at rest", "", ".0%"),
    "at_speed": ("delivered share of the largest force, at the reference speed", "", ".0%"),
    "friction": ("friction", "largest force", ".3g"),
    "noise": ("noise of the force", "largest force", ".3g"),
    "unasked": ("force at a command of zero", "largest force", ".3g"),
}


def _count(words: list[str]) -> int:
    if len(words) > 1:
        raise ValueError(f"--measure {' '.join(words)}: must be one number of policies, or none")
    return int(words[0]) if words else POLICIES


_COUNT = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="[INT]",
    instance_from_str=_count,
    is_instance=lambda value: value is None or isinstance(value, int),
    str_from_instance=lambda value: [str(value)],
)
"""Parser of a number that may be left out."""


@dataclasses.dataclass(frozen=True)
class Advise:
    """Recommend what to do about an actuator: train on ideal forces, tune, randomize or replace it.

    A simulated bench test commands the task's largest force and measures the delay, the size and
    the noise of the force that the actuator delivers. The results of a study tell how much score
    such errors cost policies (docs/advise.md). --measure trains policies on ideal forces, on random
    actuators and through this actuator, and tests all of them on this actuator. This takes minutes;
    if you interrupt it, the same command continues.

    Example: codrl-mj advise maxon-ec45-flat-50w pendulum --gear-ratio 20, or codrl-mj advise paper
    cartpole --measure 10
    """

    actuator: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="ACTUATOR",
            help=(
                "A motor of the catalogue (codrl-mj motor list), a variant of the paper's motor"
                " (paper, weak ...), a file with the fields of an actuator or a datasheet, or your"
                " own as module:NAME."
            ),
        ),
    ]
    task: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="TASK",
            help=(
                "One of the tasks of the study, such as pendulum; with --measure also a custom task"
                " (module:NAME), an environment (HalfCheetah-v5), or a run folder, whose"
                " environment, agent and training length are used."
            ),
        ),
    ]
    gear_ratio: float | None = None
    """Turns of the rotor per turn of the joint, or radians per meter; default: the motor's own."""
    voltage: float | None = None
    """Voltage of the supply [V]; default: the motor's nominal voltage."""
    measure: Annotated[int | None, _COUNT] = None
    """Number of policies that are trained in each way and tested on the actuator, at least 2; 10 if
    no number follows."""
    root: Path = Path("runs/advise")
    """Folder in which --measure creates its run folders."""
    jobs: int = -1
    """Number of trainings at the same time; -1: one for each CPU."""
    evidence: Path | None = None
    """Table of results, with the columns of the study's runs.csv; default: the installed runs.csv.
    """
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> Output:
        """Print the severities and the known remedies, then the verdict."""
        from codrl_mj.study.advice import advise
        from codrl_mj.study.axes import REFERENCE_SPEEDS, study_env

        is_studied = self.task in REFERENCE_SPEEDS
        if not is_studied and self.measure is None:
            raise ValueError(
                f"TASK = {self.task!r}: {did_you_mean(self.task, REFERENCE_SPEEDS)}The study covers"
                f" {', '.join(REFERENCE_SPEEDS)}; for other tasks and for runs, train and test with"
                " --measure 10"
            )
        if self.measure is not None and self.measure < 2:
            raise ValueError(
                f"--measure {self.measure}: must be >= 2, because an interval needs two policies"
            )
        actuator_spec: ActuatorSetting = self.actuator
        if self.gear_ratio is not None or self.voltage is not None:
            motor = {} if self.gear_ratio is None else {"motor": {"gear_ratio": self.gear_ratio}}
            supply = {} if self.voltage is None else {"supply": {"voltage": self.voltage}}
            actuator_spec = {"name": self.actuator, **motor, **supply}
        advice = None
        if is_studied:
            try:
                actuator = study_env(self.task, actuator_spec).actuators[0]
            except ValueError as error:
                overrides = {"--gear-ratio": self.gear_ratio, "--voltage": self.voltage}
                flags = ", ".join(flag for flag, value in overrides.items() if value is not None)
                raise ValueError(f"{flags}: {error}" if flags else str(error)) from error
            advice = advise(actuator, self.task, Evidence.read(*filter(None, [self.evidence])))
            _print_advice(self.actuator, advice)
            if advice.command:
                # Commands are not wrapped, so that they can be copied.
                print(advice.command)
            print_text(actuator.assumed)
        measured = None
        if self.measure is not None:
            from codrl_mj.study.advice import RANDOMIZE, decide, plan_measurement
            from codrl_mj.study.axes import random_training
            from codrl_mj.study.parallel import Workers
            from codrl_mj.study.program import compute

            # The run folders below --root hold the finished trainings: a second call computes only
            # the missing ones.
            measurement_plan = plan_measurement(
                actuator_spec, self.task, self.measure, self.root, trust=self.trust
            )
            compute(measurement_plan.grid, Workers(self.jobs))
            options = measurement_plan.loss_bounds(measurement_plan.grid.collect())
            verdict = decide(options)
            measured = {"options": options, "verdict": verdict}
            _print_options(
                f"Measured: {self.measure} policies of each kind, 50 episodes each", options
            )
            more = " by more policies (--measure)" * (verdict == "measure it")
            print_text(f"measured: {verdict}{more}")
            # Without failures, the share f is plausible while (1 - f)^n is at least 5 %.
            bound = 1.0 - 0.05 ** (1.0 / self.measure)
            print_text(
                f"If none of {self.measure} policies fails, up to {bound:.0%} may fail (95 %)."
            )
            if verdict == RANDOMIZE and is_studied:
                print(random_training(self.task))
        units = {name: unit or "1" for name, (_, unit, _) in _DELIVERED.items()} | {
            "loss": "share of the task's span"
        }
        return 0, {"units": units, "advice": advice, "measured": measured}


def _print_advice(name: str, advice: Advice) -> None:
    from codrl_mj.study.axes import AXES

    columns = "effect on the largest force", "value", "unit"
    rows: list[tuple[str, ...]] = [
        (label, format(getattr(advice.response, field), digits), unit)
        for field, (label, unit, digits) in _DELIVERED.items()
    ]
    print_table(f"{name} on {advice.task}, on the bench", columns, rows, right=("value",))
    if advice.losses:
        rows = []
        for loss in advice.losses:
            # Wind-up is tested on supplies.
            axis = loss.axis if loss.axis in AXES else "supply"
            unit = AXES[axis].unit.rpartition("[")[2].removesuffix("]").removeprefix("missing ")
            tested = ", ".join(test.split()[1].strip(",") for test in loss.between)
            bound = "at most " * (loss.lower is not loss.outcome)
            cells = _loss_cells(loss.outcome, "at least " if loss.beyond else bound)
            rows.append((loss.axis, f"{loss.severity:.3g}", unit, *cells, tested))
        label = "Losses of policies that were trained on ideal forces [shares of the task's span]"
        print_table(
            label,
            ("effect", "severity", "unit", *_LOSS_COLUMNS, "tested at"),
            rows,
            right=("severity", *_LOSS_COLUMNS),
            whole=_LOSS_COLUMNS,
        )
        _print_options("Known remedies", advice.options)
    print_text(
        f"{advice.verdict}: {advice.reason}"
        if advice.verdict
        else f"no verdict: {advice.reason} (--measure 10)"
    )


_LOSS_COLUMNS = "loss", "95 %", "fail", "success\nlost"


def _print_options(title: str, options: Mapping[str, LossBounds]) -> None:
    from codrl_mj.study.advice import OPTIONS

    rows = []
    for name in OPTIONS:
        if name in options:
            outcome = options[name].upper or options[name].lower
            rows.append(
                (
                    name,
                    *(
                        _loss_cells(outcome, options[name].prefix)
                        if outcome
                        else ("not tested", "", "", "")
                    ),
                )
            )
    print_table(
        f"{title} [shares of the task's span]",
        ("remedy", *_LOSS_COLUMNS),
        rows,
        right=_LOSS_COLUMNS,
    )


def _loss_cells(outcome: Outcome, bound: str) -> tuple[str, ...]:
    mean, low, high = outcome.loss
    count = len(outcome.lost)
    failed = f"{round(outcome.failed * count)} of {count}"
    return (
        f"{bound}{mean:z.2f}",
        f"{low:z.2f} to {high:z.2f}",
        failed,
        f"{100 * outcome.success_lost.mean:z.0f} %",
    )
