"""Results of an identification: parameters with intervals, prediction errors, and the actuator."""

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from codrl_mj.actuators import Drive, GearMotor, Supply, actuator_from_mapping
from codrl_mj.disturbances import Joint
from codrl_mj.identify.estimate import Fit, Model, best_initial_state
from codrl_mj.identify.log import Log, Segment, gapless_stretches, initial_state
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.parameters import DEFAULTS, MOTOR_PARAMETERS, PARAMETERS
from codrl_mj.runs.files import atomic_write, write_json

Status = Literal["identified", "rough", "given", "ratio", "unidentifiable", "refused"]
ACTUATOR = "actuator.yaml"  # name of the file in a folder of results
JOINT = "joint.yaml"  # name of the file for logs that determine a joint, but no motor
# Above this share, the columns or the model must be wrong, and the parameters are meaningless.
MAX_UNEXPLAINED = 0.2
"""Largest unexplained share of a log's variation at which parameters are usable."""
USABLE = ("identified", "rough", "given")
"""Status of parameters from which an actuator can be made."""
HORIZON = 0.5  # duration [s] of a prediction
START_DURATION = 0.03
"""Duration [s] at the start of a prediction to which the initial state is fitted; >= 5 rows."""


def base_motor(base: Mapping[str, object] | None) -> GearMotor | None:
    """Return the motor of a drive's mapping; None if it has none.

    Raises:
        ValueError: the drive has the part `friction`, which a fit does not estimate.
    """
    drive = None if base is None else actuator_from_mapping(base)
    if isinstance(drive, Drive) and drive.friction is not None:
        raise ValueError(
            "friction: identification estimates the friction of the motor's fields, such as"
            " motor.coulomb_friction and motor.gear_efficiency; remove friction from the base"
        )
    return drive.motor if isinstance(drive, Drive) else None


def missing_parameters(names: Collection[str], base: Mapping[str, object] | None) -> str | None:
    """Return a message on parameters that are neither in `names` nor in a base, or None."""
    motor = base_motor(base)
    if (
        motor is not None
        and motor.rotor_inertia == 0.0
        and "inertia" in names
        and "rotor_inertia" not in names
    ):
        return (
            "rotor_inertia is unknown (0) in the datasheet, and the logs show only the total"
            " moving inertia. Give the inertia of the load at the output: --known"
            " load_inertia=VALUE; or --known rotor_inertia=0 if the model that you train in"
            " contains the rotor"
        )
    needed = ("resistance", "inductance", "torque_constant", "back_emf_constant", "rotor_inertia")
    lacking = [name for name in needed if name not in names]
    if not lacking or base is not None:
        return None
    flags = " ".join(f"{name}=VALUE" for name in lacking)
    remedy = f"--known {flags}, or name the motor that has the other parameters with --motor NAME"
    if lacking[-1] == "rotor_inertia":
        remedy += (
            "; instead of rotor_inertia you can give that of the load: --known load_inertia=VALUE,"
            " 0 for a motor without load"
        )
    return (
        f"{', '.join(lacking)}: these logs do not determine"
        f" {'it' if len(lacking) == 1 else 'them'}. Give {remedy}"
    )


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter with its interval and status."""

    name: str
    value: float
    """Value in `unit`."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    status: Status
    why: str = ""
    """Reason for the status."""
    causes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Half-widths of the interval by cause."""

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return PARAMETERS[self.name].unit


class Trace(NamedTuple):
    """Measured and simulated output of a log, in segments with separate initial states."""

    log: str
    part: str  # `winding` or `shaft`
    output: str  # `current` [A], `position` [rad] or `velocity` [rad/s]
    time: np.ndarray  # [s], shape (n,)
    measured: np.ndarray  # shape (n,)
    simulated: np.ndarray  # shape (n,)
    starts: np.ndarray  # rows at which segments begin


def make_trace(
    log: str, part: str, output: str, segments: Sequence[Segment], simulated: Sequence[np.ndarray]
) -> Trace:
    """Return a trace of segments of a log and of their simulated outputs, each of shape (m,)."""
    times, measured = (
        np.concatenate([getattr(segment, name) for segment in segments])
        for name in ("times", "measured")
    )
    starts = np.cumsum([0, *(len(segment.times) for segment in segments)])[:-1]
    return Trace(log, part, output, times, measured, np.concatenate(simulated), starts)


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Mean absolute prediction errors on a log, in the unit of the output."""

    log: str
    output: str
    """Predicted signal, `position` [rad] or `velocity` [rad/s]."""
    open_loop: float
    """Error with the logged input, in predictions that last `HORIZON`, after `START_DURATION`."""
    closed_loop: float | None
    """Error of a simulation of the whole log with its controller; see `closed_loop_error`."""
    trace: Trace | None = dataclasses.field(default=None, compare=False, repr=False)
    """Simulation of `open_loop`; not written to files."""


def predict(fit: Fit[ShaftModel], log: Log) -> Prediction:
    """Simulate a log with a fitted shaft, and return the prediction errors."""
    model, simulate, errors, simulated = fit.model, fit.model.simulator(fit.values), [], []
    segments = dataclasses.replace(model, segment=HORIZON).segments([log])
    for segment in segments:
        count = max(int(np.searchsorted(segment.times, segment.times[0] + START_DURATION)), 5)
        simulated.append(
            simulate(segment, best_initial_state(model, fit.values, segment.first(count)))
        )
        # The rows that the initial state was fitted to are not predicted.
        errors.append(np.abs(simulated[-1] - segment.measured)[count:])
    trace = make_trace(log.name, "shaft", model.output, segments, simulated)
    error = float(np.concatenate(errors).mean())
    return Prediction(log.name, model.output, error, closed_loop_error(fit, log), trace)


def closed_loop_error(fit: Fit[ShaftModel], log: Log) -> float | None:
    """Return the mean absolute error [rad] over a whole log under its command.

    The servo is modeled as a proportional controller. Its gain is fitted to those rows in which the
    input is not at its limit. The limit of a voltage is the supply's, if `bus` was logged;
    otherwise the limit is the largest input of the log.

    Returns:
        None if the log has no command, or if no proportional controller explains the input.
    """
    from codrl_mj.identify.simulation import simulate_servo

    model = fit.model
    if model.driven_by == "command":
        return _error_under_command(fit, log)
    if model.output != "position" or not log.has("command", model.driven_by):
        return None
    target, drive = log.signals["command"], log.signals[model.driven_by]
    control_error = target - log.signals["position"]
    limits = (
        log.signals["bus"]
        if log.has("bus") and model.driven_by == "voltage"
        else np.full(len(control_error), np.abs(drive).max())
    )
    unsaturated = np.abs(drive) < 0.98 * limits
    if not np.any(control_error[unsaturated]):
        return None
    gain = float(
        drive[unsaturated]
        @ control_error[unsaturated]
        / (control_error[unsaturated] @ control_error[unsaturated])
    )
    predicted_drive = np.clip(gain * control_error, -limits, limits)
    if not np.mean((drive - predicted_drive) ** 2) < 0.25 * np.mean(drive**2):
        return None
    shaft, errors = model.shaft_parameters(fit.values), []
    for stretch in gapless_stretches(log):
        position, speed = initial_state(log, stretch)
        simulated = simulate_servo(
            log.time[stretch], target[stretch], limits[stretch], gain, position, speed, shaft
        )
        errors.append(np.abs(simulated - log.signals["position"][stretch]))
    mean_error = float(np.concatenate(errors).mean())
    return mean_error if math.isfinite(mean_error) else None


def _error_under_command(fit: Fit[ShaftModel], log: Log) -> float:
    """Return the mean absolute error [rad] of a servo over a whole log, from its first row."""
    simulate = fit.model.simulator(fit.values)
    segments = dataclasses.replace(fit.model, segment=math.inf).segments([log])
    errors = [np.abs(simulate(segment, segment.state) - segment.measured) for segment in segments]
    return float(np.concatenate(errors).mean())


def fitted_traces(part: str, fit: Fit[Model]) -> Iterator[Trace]:
    """Yield the trace of a fitted `winding` or `shaft` for each of its logs."""
    for index, log in enumerate(fit.logs):
        pairs = zip(fit.segments, fit.residuals, strict=True)
        simulated = [
            (segment, segment.measured + residuals * segment.deviation)
            for segment, residuals in pairs
            if segment.log == index
        ]
        if simulated:
            yield make_trace(log.name, part, fit.model.output, *zip(*simulated, strict=True))


@dataclasses.dataclass(frozen=True)
class Identified:
    """A motor that was identified from logs."""

    logs: tuple[str, ...]
    """Names of the logs."""
    rig: str
    """Load on the output: `pendulum`, `free` or `load`."""
    friction: str
    """Friction model of the fit: `coulomb`, `stribeck`, `load` or `both`."""
    driven_by: str | None
    """Input of the shaft in the fit; None if only the winding was fitted."""
    delays: Mapping[str, float]
    """Part (`winding` or `shaft`) -> delay [rows] of its input; 0.5: sampled at the rows."""
    estimates: tuple[Estimate, ...]
    fitted: tuple[Prediction, ...]
    """Errors on the fitted logs."""
    held_out: tuple[Prediction, ...]
    """Errors on the logs held out."""
    warnings: tuple[str, ...]
    base: Mapping[str, object] | None = None
    """Mapping of a drive that supplies the parameters that the logs do not determine, or None."""
    traces: tuple[Trace, ...] = ()
    """Traces of winding and shaft for the fitted logs; not written to files."""
    correlations: Mapping[str, Mapping[str, Mapping[str, float]]] = dataclasses.field(
        default_factory=dict
    )
    """Part (`winding` or `shaft`) -> correlations between its parameters."""
    supply: float | None = None
    """Largest logged voltage [V] of the supply or at the terminals; None: no logged voltage."""
    unexplained: float = 0.0
    """Largest unexplained share of a log's variation; 0 if it may be noise of the sensors."""
    friction_reason: str = ""
    """Reason for the choice of `friction`; empty if it was requested."""

    def __getitem__(self, name: str) -> Estimate:
        """Return a parameter by its name."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(name)

    def problem(self) -> str | None:
        """Return the reason why no actuator can be made, with a remedy; None if it can."""
        if self.unexplained > MAX_UNEXPLAINED:
            return (
                f"the fit leaves {self.unexplained:.0%} of a log's variation unexplained, so that"
                " its parameters are unreliable. Correct the columns, their units and signs, or the"
                " rig: codrl-mj identify check"
            )
        unusable = [
            estimate
            for estimate in self.estimates
            if estimate.name in MOTOR_PARAMETERS and estimate.status not in USABLE
        ]
        names_by_reason: dict[str, list[str]] = {}
        for estimate in unusable:
            names_by_reason.setdefault(f"{estimate.status}: {estimate.why}", []).append(
                estimate.name
            )
        reasons = "; ".join(
            f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} {reason}"
            for reason, names in names_by_reason.items()
        )
        if unusable:
            pronoun = "it" if len(unusable) == 1 else "them"
            return (
                f"{reasons}. Give {pronoun} with --known"
                f" {' '.join(f'{estimate.name}=VALUE' for estimate in unusable)}"
            )
        return missing_parameters([estimate.name for estimate in self.estimates], self.base)

    @property
    def supply_text(self) -> str | None:
        """Text on the actuator's supply and its source; None without an actuator."""
        if self.problem() is not None:
            return None
        volts = self.actuator().voltage_limit
        source = "assumed: set supply.voltage in actuator.yaml"
        if self.base is not None:
            source = "of the motor (--motor)"
        elif self.supply is not None:
            source = (
                "largest voltage of the logs; no current limit: set controller.max_current in"
                f" {ACTUATOR}"
            )
        return f"supply {volts:.4g} V: {source}"

    @property
    def base_text(self) -> str | None:
        """Text on the parameters that the base drive supplies; None if there are none."""
        motor = base_motor(self.base)
        if motor is None or self.problem() is not None:
            return None
        identified = {*DEFAULTS, *(estimate.name for estimate in self.estimates)}
        parameters = [
            f"{name} = {getattr(motor, name):.4g} {PARAMETERS[name].unit}"
            for name in MOTOR_PARAMETERS
            if name not in identified
        ]
        return (
            "not from these logs, but from the motor (--motor):"
            f" {', '.join(map(str.strip, parameters))}"
            if parameters
            else None
        )

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Return the intervals of the usable, not exactly known parameters, by field of a drive."""
        return {
            f"motor.{estimate.name}": (estimate.low, estimate.high)
            for estimate in self.estimates
            if estimate.name in MOTOR_PARAMETERS
            and estimate.status in USABLE
            and estimate.low < estimate.high
        }

    def actuator(self) -> Drive:
        """Return the drive with the identified and the known parameters.

        Raises:
            ValueError: a parameter is neither identified nor known; the message names it.
        """
        problem = self.problem()
        if problem is not None:
            raise ValueError(problem)
        supply = None if self.supply is None else Supply(self.supply)
        base = Drive(supply=supply) if self.base is None else actuator_from_mapping(self.base)
        return cast(Drive, base).replaced(
            {
                f"motor.{estimate.name}": estimate.value
                for estimate in self.estimates
                if estimate.name in MOTOR_PARAMETERS
            }
        )

    def joint_problem(self) -> str | None:
        """Return the reason why the logs give no joint, with a remedy; None if they do."""
        if self.driven_by != "torque":
            return "only logs of a torque determine a joint without its motor"
        if self.unexplained > MAX_UNEXPLAINED:
            return self.problem()
        by_name = {estimate.name: estimate for estimate in self.estimates}
        for name in ("coulomb_friction", "viscous_friction"):
            estimate = by_name.get(name)
            if estimate is None:
                return f"{name} is neither fitted nor known"
            if estimate.status not in USABLE:
                return f"{name} is {estimate.status}: {estimate.why}"
        if self.friction != "coulomb":
            return "a joint has Coulomb and viscous friction only: fit it with --friction coulomb"
        return None

    def joint(self) -> Joint:
        """Return damping, friction and armature of the joint that a torque drives.

        The armature is the rotor's inertia at the output if the logs and the known values determine
        it, and otherwise 0, because the inertia may belong to the model's bodies.

        Raises:
            ValueError: the logs do not determine a joint; see `joint_problem`.
        """
        problem = self.joint_problem()
        if problem is not None:
            raise ValueError(problem)
        by_name = {estimate.name: estimate for estimate in self.estimates}
        ratio = by_name["gear_ratio"].value if "gear_ratio" in by_name else 1.0
        rotor = by_name.get("rotor_inertia")
        return Joint(
            damping=by_name["viscous_friction"].value * ratio**2,
            friction=by_name["coulomb_friction"].value * ratio,
            armature=rotor.value * ratio**2 if rotor and rotor.status in USABLE else 0.0,
        )

    @property
    def joint_text(self) -> str | None:
        """Text on the joint and its use; None if there is none, or if there is an actuator."""
        if self.problem() is None or self.joint_problem() is not None:
            return None
        values = {
            field.name: f"{getattr(self.joint(), field.name):.6g}"
            for field in dataclasses.fields(Joint)
        }
        flags = " ".join(f"--env.joint.{name} {value}" for name, value in values.items())
        names = {"friction": "frictionloss"}
        attributes = " ".join(
            f'{names.get(name, name)}="{value}"' for name, value in values.items()
        )
        return (
            "torques determine a joint, but no motor: train with --actuator ideal"
            f" {flags}, or write <joint {attributes}/> into your model. For an actuator name the"
            " motor with --motor"
        )

    def as_mapping(self) -> dict[str, object]:
        """Return all results as values that JSON can store."""
        values = dataclasses.asdict(self) | {"problem": self.problem()}
        values |= {"supply_text": self.supply_text, "base_text": self.base_text}
        values["joint"] = None if self.joint_text is None else dataclasses.asdict(self.joint())
        # Arrays are plotted in reports, and would make the file large.
        del values["traces"]
        for prediction in (*values["fitted"], *values["held_out"]):
            del prediction["trace"]
        return values

    def write(self, folder: Path) -> list[Path]:
        """Write result.json, and actuator.yaml or joint.yaml into a folder, each atomically.

        The actuator's file has a drive's fields, and their intervals under `identified`. If there
        is no actuator, the file joint.yaml has the fields of `Joint`, provided that torques
        determine it. Files of an earlier fit that this fit does not write are removed, because they
        would be mistaken for its results.

        Returns:
            The paths of the files written.
        """
        result = folder / "result.json"
        write_json(result, self.as_mapping())
        contents: dict[str, dict[str, object]] = {}
        if self.problem() is None:
            intervals = {name: list(ends) for name, ends in self.intervals().items()}
            section: dict[str, object] = {"logs": list(self.logs), "intervals": intervals}
            contents[ACTUATOR] = {**self.actuator().as_mapping(), "identified": section}
        elif self.joint_text is not None:
            contents[JOINT] = dataclasses.asdict(self.joint())
        for name in (ACTUATOR, JOINT):
            if name in contents:
                _write_yaml(folder / name, contents[name])
            else:
                (folder / name).unlink(missing_ok=True)
        return [*(folder / name for name in contents), result]


def _write_yaml(path: Path, content: Mapping[str, object]) -> None:
    """Write a mapping as YAML, atomically."""
    import yaml

    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(dict(content), sort_keys=False))
