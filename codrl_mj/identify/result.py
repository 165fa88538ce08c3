"""What identification found: parameters with intervals, how well they foretell logs, and the actuator that follows."""

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit, settled_state
from codrl_mj.identify.log import Log, Segment, initial_state, usable
from codrl_mj.identify.parameters import DEFAULTS, OF_MOTOR, PARAMETERS
from codrl_mj.runs.files import write_json, atomic_write

Status = Literal["identified", "rough", "given", "ratio", "unidentifiable", "refused"]
ACTUATOR = "actuator.yaml"  # name of the file in a folder of results
MISUNDERSTOOD = 0.2  # share of the motion beyond which it is not single numbers that are amiss
USABLE = ("identified", "rough", "given")
HORIZON = 0.5  # time [s] that is foretold at once,
KNOWN = 0.03  # from where and how fast the shaft was in its first so many [s], five rows at least


def motor_of(base: Mapping[str, Any] | None) -> Any:
    """Return the `GearMotor` of a drive's mapping; None if it has none."""
    from codrl_mj.actuators import Drive, actuator_from_mapping

    drive = None if base is None else actuator_from_mapping(base)
    return drive.motor if isinstance(drive, Drive) else None


def missing(names: Collection[str], base: Mapping[str, Any] | None) -> str | None:
    """Which numbers of a motor are neither among these nor in a base, and what to do; None: none."""
    motor = motor_of(base)
    if (
        motor is not None
        and motor.rotor_inertia == 0.0
        and "inertia" in names
        and "rotor_inertia" not in names
    ):
        return (
            "rotor_inertia is unknown (0) in the datasheet, and the logs tell the inertia of all"
            " that moves. Give what is not the motor's, at the output: --known load_inertia=VALUE;"
            " or --known rotor_inertia=0 if the model that you train in has all of it"
        )
    needed = ("resistance", "inductance", "torque_constant", "back_emf_constant", "rotor_inertia")
    lacking = [name for name in needed if name not in names]
    if not lacking or base is not None:
        return None
    flags = " ".join(f"{name}=VALUE" for name in lacking)
    remedy = f"--known {flags}, or the motor that has the rest of its numbers with --motor NAME"
    if lacking[-1] == "rotor_inertia":
        remedy += (
            "; of the inertia that is found give the load's share: --known load_inertia=VALUE, 0"
            " for a motor alone"
        )
    return (
        f"{', '.join(lacking)}: these logs say nothing of {'it' if len(lacking) == 1 else 'them'}."
        f" Give {remedy}"
    )


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter."""

    name: str
    value: float
    """In `unit`."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    status: Status
    why: str = ""
    """What the status comes from."""
    causes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Half-widths of the interval by cause."""

    @property
    def unit(self) -> str:
        """Of its value."""
        return PARAMETERS[self.name].unit


class Trace(NamedTuple):
    """A simulation beside what was measured, in pieces that each begin from a state of their own."""

    log: str
    part: str  # `winding` or `shaft`
    output: str  # what is compared: `current` [A], `position` [rad] or `velocity` [rad/s]
    time: np.ndarray  # [s], shape (n,)
    measured: np.ndarray  # shape (n,)
    simulated: np.ndarray  # shape (n,)
    starts: np.ndarray  # rows at which pieces begin


def traced(
    log: str, part: str, output: str, segments: Sequence[Segment], made: Sequence[np.ndarray]
) -> Trace:
    """A trace of segments of a log, beside what a simulation made of each, of shape (m,)."""
    times, measured = (
        np.concatenate([getattr(one, name) for one in segments]) for name in ("times", "measured")
    )
    starts = np.cumsum([0, *(len(one.times) for one in segments)])[:-1]
    return Trace(log, part, output, times, measured, np.concatenate(made), starts)


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Mean absolute errors on a log, in the unit of what is foretold."""

    log: str
    output: str
    """`position` [rad] or `velocity` [rad/s]."""
    open_loop: float
    """Over `HORIZON`, under the logged input, each time from the state that its first `KNOWN` tell."""
    closed_loop: float | None
    """Over the whole log, under the law by which the servo makes a voltage of its error; None where there is none."""
    trace: Trace | None = dataclasses.field(default=None, compare=False, repr=False)
    """What `open_loop` is the error of; in no file."""


def predict(fit: Fit, log: Log) -> Prediction:
    """Errors of a fitted shaft's simulations of a log."""
    model, simulate, errors, made = fit.model, fit.model.at(fit.values), [], []
    segments = dataclasses.replace(model, segment=HORIZON).segments([log])
    for segment in segments:
        known = max(int(np.searchsorted(segment.times, segment.times[0] + KNOWN)), 5)
        made.append(simulate(segment, settled_state(model, fit.values, segment.first(known))))
        errors.append(np.abs(made[-1] - segment.measured)[known:])
    foretold, error = (
        traced(log.name, "shaft", model.output, segments, made),
        float(np.concatenate(errors).mean()),
    )
    return Prediction(log.name, model.output, error, closed_loop_error(fit, log), foretold)


def closed_loop_error(fit: Fit, log: Log) -> float | None:
    """Mean absolute error [rad] of a whole log under its own command, by a proportional law found in the log.

    The law is the straight line through the origin from the command's error to the input, where the
    input is not at its limit: a voltage's `bus`, or the largest that the log has. None where the
    log has no command that explains it.
    """
    from codrl_mj.identify.simulation import served

    model = fit.model
    if model.output != "position" or not log.has("command", model.driven_by):
        return None
    wanted, given = log.signals["command"], log.signals[model.driven_by]
    error = wanted - log.signals["position"]
    limits = (
        log.signals["bus"]
        if log.has("bus") and model.driven_by == "voltage"
        else np.full(len(error), np.abs(given).max())
    )
    free = np.abs(given) < 0.98 * limits
    if not np.any(error[free]):
        return None
    law = float(given[free] @ error[free] / (error[free] @ error[free]))
    lawful = np.clip(law * error, -limits, limits)
    if not np.mean((given - lawful) ** 2) < 0.25 * np.mean(given**2):
        return None
    moved, found = model.moved(fit.values), []
    for stretch in usable(log):
        position, speed = initial_state(log, stretch)
        simulated = served(
            log.time[stretch], wanted[stretch], limits[stretch], law, position, speed, moved
        )
        found.append(np.abs(simulated - log.signals["position"][stretch]))
    total = float(np.concatenate(found).mean())
    return total if math.isfinite(total) else None


def fitted_traces(part: str, fit: Fit) -> Iterator[Trace]:
    """The fit of `winding` or `shaft` to each of its logs."""
    for place, log in enumerate(fit.logs):
        pairs = zip(fit.segments, fit.residuals, strict=True)
        own = [
            (one, one.measured + residuals * one.deviation)
            for one, residuals in pairs
            if one.log == place
        ]
        if own:
            yield traced(log.name, part, fit.model.output, *zip(*own, strict=True))


@dataclasses.dataclass(frozen=True)
class Identified:
    """A motor as its logs show it.

    Raises:
        ValueError: by `actuator`, of a parameter that was not identified.
    """

    logs: tuple[str, ...]
    """Names of the logs."""
    rig: str
    friction: str
    driven_by: str | None
    """What drives the shaft in the fit; None where only the winding was fitted."""
    delays: Mapping[str, float]
    """Rows by which the input of `winding` and `shaft` was found late; a voltage of the rows' times by half of one."""
    estimates: tuple[Estimate, ...]
    fitted: tuple[Prediction, ...]
    """Errors on the logs that were fitted."""
    held_out: tuple[Prediction, ...]
    """And on those that were not."""
    warnings: tuple[str, ...]
    base: Mapping[str, Any] | None = None
    """The drive that gives what the logs do not tell, as a mapping; None: none."""
    traces: tuple[Trace, ...] = ()
    """Winding and shaft beside the logs that were fitted; in no file."""
    correlations: Mapping[str, Mapping[str, Mapping[str, float]]] = dataclasses.field(
        default_factory=dict
    )
    """Of the parameters of `winding` and `shaft`, each with each."""
    supply: float | None = None
    """Largest voltage [V] of the supply, or at the terminals, that the logs have; None: they have none."""
    unexplained: float = 0.0
    """Largest share of what moves in a log that the fit leaves unexplained, if that is more than sensors do."""
    friction_reason: str = ""
    """Why `friction` was chosen; empty if it was asked for."""

    def __getitem__(self, name: str) -> Estimate:
        """A parameter by its name."""
        for one in self.estimates:
            if one.name == name:
                return one
        raise KeyError(name)

    def problem(self) -> str | None:
        """What stands against an actuator of these numbers, with a remedy; None: nothing."""
        if self.unexplained > MISUNDERSTOOD:
            return (
                f"the fit leaves {self.unexplained:.0%} of what moves in a log unexplained, so that"
                " numbers mean little. Correct the columns, their units and signs, or the rig:"
                " codrl-mj identify check"
            )
        bad = [one for one in self.estimates if one.name in OF_MOTOR and one.status not in USABLE]
        alike: dict[str, list[str]] = {}
        for one in bad:
            alike.setdefault(f"{one.status}: {one.why}", []).append(one.name)
        told = "; ".join(
            f"{', '.join(s)} {'is' if len(s) == 1 else 'are'} {why}" for why, s in alike.items()
        )
        if bad:
            them = "it" if len(bad) == 1 else "them"
            return (
                f"{told}. Give {them} with --known {' '.join(f'{one.name}=VALUE' for one in bad)}"
            )
        return missing([one.name for one in self.estimates], self.base)

    @property
    def supply_text(self) -> str | None:
        """What feeds the actuator that is written, and where that is from; None where there is none."""
        if self.problem() is not None:
            return None
        volts, of = self.actuator().voltage_limit, "assumed: set supply.voltage in actuator.yaml"
        if self.base is not None:
            of = "the motor's, by --motor"
        elif self.supply is not None:
            of = (
                "the largest of the logs; no current limit: set controller.max_current in"
                f" {ACTUATOR}"
            )
        return f"supply {volts:.4g} V: {of}"

    @property
    def base_text(self) -> str | None:
        """The numbers of the actuator that are the base's and not of the logs; None without a base or an actuator."""
        motor = motor_of(self.base)
        if motor is None or self.problem() is not None:
            return None
        own = {*DEFAULTS, *(one.name for one in self.estimates)}
        told = [
            f"{name} = {getattr(motor, name):.4g} {PARAMETERS[name].unit}"
            for name in OF_MOTOR
            if name not in own
        ]
        return (
            f"not from these logs but the motor's, by --motor: {', '.join(map(str.strip, told))}"
            if told
            else None
        )

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Field of a drive -> interval, of what is used and is not a point."""
        return {
            f"motor.{one.name}": (one.low, one.high)
            for one in self.estimates
            if one.name in OF_MOTOR and one.status in USABLE and one.low < one.high
        }

    def actuator(self) -> Any:
        """The drive with the numbers that were identified or given.

        Raises:
            ValueError: one of them is neither; the message names it and what to do.
        """
        from codrl_mj.actuators import Drive, Supply, actuator_from_mapping

        problem = self.problem()
        if problem is not None:
            raise ValueError(problem)
        own = None if self.supply is None else Supply(self.supply)
        base = Drive(supply=own) if self.base is None else actuator_from_mapping(self.base)
        return base.replaced(
            {f"motor.{one.name}": one.value for one in self.estimates if one.name in OF_MOTOR}
        )

    def as_mapping(self) -> dict[str, Any]:
        """As JSON-serialisable values."""
        found = dataclasses.asdict(self) | {"problem": self.problem()}
        found |= {"supply_text": self.supply_text, "base_text": self.base_text}
        del found["traces"]
        for one in (*found["fitted"], *found["held_out"]):
            del one["trace"]
        return found

    def write(self, folder: Path) -> list[Path]:
        """Write result.json and, without a problem, actuator.yaml into a folder, whole or not at all.

        The actuator's file has a drive's fields and `identified`: their intervals. With a problem,
        an actuator.yaml of an earlier fit is removed, because it would be taken for this one's.

        Returns:
            The paths of the files written.
        """
        import yaml

        actuator, result = folder / ACTUATOR, folder / "result.json"
        write_json(result, self.as_mapping())
        if self.problem():
            actuator.unlink(missing_ok=True)
            return [result]
        intervals = {name: list(ends) for name, ends in self.intervals().items()}
        section: dict[str, Any] = {"logs": list(self.logs), "intervals": intervals}
        content = {**self.actuator().as_mapping(), "identified": section}
        with atomic_write(actuator) as temporary:
            temporary.write_text(yaml.safe_dump(content, sort_keys=False))
        return [actuator, result]
