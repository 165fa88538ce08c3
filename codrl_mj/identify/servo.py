"""Identification of a position servo from logs of its commands and its encoder."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.fields import check_names
from codrl_mj.identify.duty_law import DutyLaw, fit_duty_law
from codrl_mj.identify.estimate import (
    MAX_COST_RATIO,
    Fit,
    fit_from_starts,
    optimize,
)
from codrl_mj.identify.friction import choose_friction
from codrl_mj.identify.identify import separate_logs
from codrl_mj.identify.log import MAX_STEP, MIN_ROWS, Log, gapless_stretches, has_motion
from codrl_mj.identify.parameters import FRICTION, MIN_SIZES, PARAMETERS, PER_INERTIA
from codrl_mj.identify.result import (
    USABLE,
    Estimate,
    Prediction,
    Status,
    fitted_traces,
    predict,
)
from codrl_mj.identify.servo_model import SERVO_SEGMENT, ServoModel, largest_torque
from codrl_mj.identify.servo_result import IdentifiedServo
from codrl_mj.identify.uncertainty import (
    CAUSES,
    MAX_FRICTION,
    MAX_HALF_WIDTH,
    assess_fits,
    correlations,
    log_disagreements,
)

GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
KNOWN = (
    *("mass", "length", "mgl", "load_inertia", "zero", "armature", "inertia", "position_gain"),
    *("stall_torque", "damping", "coulomb_friction", "command_delay", "max_velocity"),
    *("gear_efficiency", "stribeck_friction", "stribeck_speed", "resistance", "torque_constant"),
    "supply_voltage",
)
"""Values of a servo and its load that a user may know, in SI units at the output."""
ESTIMABLE = ("max_velocity", "load_inertia")
"""Parameters that are fitted only on request."""
_SCALES = ("inertia", "armature", "position_gain", "mgl")
"""Parameters each of which gives the scale of all torques, if it is known and above 0."""
_ROW_SHARE = 0.5
"""Uncertainty of the delay in rows, because a row does not show when within it a command is sent.
"""
_LOOP_PERIOD = 1e-3
"""Time [s] by which the firmware's loop may be late, besides the command."""
_MIN_SHARE = 0.005
"""Smallest relative half-width, because no load is weighed and measured more exactly."""
_LIMITED = 0.002
"""Share of the rows in which the torque must exceed its limit for the limit to be identified."""
_MAX_LIMITED_COST = 0.6
"""Largest cost of a fit with a limit of the torque, over that without, at which it is accepted."""
_DELAY_ROWS = 3.0
"""Delay in rows below which an error of the delay is judged by this delay."""
NUM_STEPS = 12
"""Progress steps of an identification."""


class _Arguments(NamedTuple):
    """Validated arguments of a fit."""

    known: dict[str, float]  # parameters that are not fitted
    is_scaled: bool  # True if the torques are known in N*m, False if only per inertia
    resistance: float  # [ohm]; not a number: unknown
    torque_constant: float  # [N*m/A]; not a number: unknown
    supply_voltage: float  # [V] that the torques refer to; not a number: unknown
    gain: float  # register that the position gain refers to; not a number: not logged


def identify_servo(
    logs: Sequence[Log],
    rig: str = "pendulum",
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    held_out: Sequence[Log] = (),
    estimated: Sequence[str] = (),
    segment: float = SERVO_SEGMENT,
    on_progress: Callable[[str, int, int], None] = lambda *_: None,
    seed: int = 0,
) -> IdentifiedServo:
    """Identify a position servo from its commands and its encoder.

    The torque of the servo is proportional to the error between the delayed command and the
    position, up to its limit; damping and friction oppose the motion.

    Args:
        logs: logs with `command` and `position`, at least one. `bus` (the supply voltage), `duty`
            and `gain` (the register of the position gain, if it differs between the logs) are used
            if all logs have them.
        rig: `pendulum`, which hangs at the position `zero`, or `free`.
        known: values of `KNOWN` that are not fitted. `mass` and `length` of a pendulum give `mgl`
            and `load_inertia`. Without `mgl` or another torque or inertia, the logs determine only
            ratios to the inertia.
        friction: `coulomb`, `stribeck`, `load`, `both` or `auto`; see `choose_friction`.
        held_out: logs that are predicted, but not fitted.
        estimated: parameters of `ESTIMABLE` that are fitted, too.
        segment: duration [s] of the segments that are simulated, >= 0.5.
        on_progress: called with the name of the task, the steps done and the number of steps.
        seed: seed of the resampling.

    Raises:
        ValueError: a name is unknown, a value is out of bounds, or the logs lack signals.
    """
    logs, held_out, notes = separate_logs(logs, held_out)
    arguments = _check(logs, rig, known or {}, friction, estimated, segment)
    counter = itertools.count(1)

    def step(task: str) -> Callable[[], None]:
        return lambda: on_progress(task, min(next(counter), NUM_STEPS), NUM_STEPS)

    model = ServoModel(
        rig=rig,
        friction="coulomb",
        known=arguments.known,
        estimated=("stall_torque", *estimated),
        segment=segment,
        supply_voltage=arguments.supply_voltage,
        gain=arguments.gain,
    )
    fit, friction_reason, other_stall = _fit(model, logs, friction, step("servo"))
    estimates, warnings, unexplained = assess_fits(
        {"shaft": fit}, arguments.known, fit.model.defaults, seed, step
    )
    law = fit_duty_law(fit) if all(log.has("duty") for log in logs) else None
    estimates = _finish(estimates, fit, arguments, law, other_stall)
    bus = arguments.supply_voltage
    return IdentifiedServo(
        logs=tuple(log.name for log in logs),
        rig=rig,
        friction=fit.model.friction,
        driven_by="command",
        delays={"shaft": 0.0},
        estimates=tuple(estimates),
        fitted=_predictions(fit, logs),
        held_out=_predictions(fit, held_out),
        warnings=(*notes, *warnings, *([law.warning] if law is not None and law.warning else [])),
        traces=tuple(fitted_traces("shaft", fit)),
        correlations={"winding": {}, "shaft": correlations(fit)},
        supply=None if math.isnan(bus) else bus,
        unexplained=unexplained,
        friction_reason=friction_reason,
        step=float(np.median([log.step for log in logs])),
        limits_torque=fit.model.limits_torque,
        is_scaled=arguments.is_scaled,
        gain=None if math.isnan(arguments.gain) else arguments.gain,
    )


def _check(
    logs: Sequence[Log],
    rig: str,
    known: Mapping[str, float],
    friction: str,
    estimated: Sequence[str],
    segment: float,
) -> _Arguments:
    """Validate the arguments of `identify_servo`, and complete the known parameters."""
    if not logs:
        raise ValueError("logs: none was given; give one or more")
    check_names([rig], ("pendulum", "free"), "rig")
    check_names([friction], ("auto", "coulomb", "stribeck", "load", "both"), "friction")
    check_names(known, KNOWN, "parameter", "known.")
    check_names(estimated, ESTIMABLE, "parameter", "estimated.")
    if not segment >= 0.5:
        raise ValueError(f"segment = {segment!r}: must be >= 0.5 s; {SERVO_SEGMENT:g} is usual")
    for name, value in known.items():
        lower = PARAMETERS[name].lower if name in PARAMETERS else 1e-9
        upper = PARAMETERS[name].upper if name in PARAMETERS else 1e6
        if not (math.isfinite(value) and lower <= value <= upper):
            raise ValueError(f"known {name} = {value!r}: must be from {lower:g} to {upper:g}")
    for log in logs:
        _check_log(log)
    volts, gains = (_common(logs, name) for name in ("bus", "gain"))
    values = dict(known)
    mass, length = (values.pop(name, math.nan) for name in ("mass", "length"))
    if math.isnan(mass) != math.isnan(length):
        raise ValueError(
            "known mass and length: both are needed; length is the distance from the shaft to the"
            " center of mass. Or give mgl and load_inertia"
        )
    if not math.isnan(mass):
        values = {
            "mgl": mass * GRAVITY * length,
            "load_inertia": mass * length**2,
            **values,
        }
    if rig == "free":
        values = {"mgl": 0.0, "zero": 0.0, **values}
    electrical = {
        name: values.pop(name, math.nan)
        for name in ("resistance", "torque_constant", "supply_voltage")
    }
    if {"armature", "load_inertia"} <= values.keys():
        values.setdefault("inertia", values["armature"] + values["load_inertia"])
    is_scaled = any(values.get(name, 0.0) > 0.0 for name in _SCALES) or "stall_torque" in values
    if not is_scaled:
        # All torques are then divided by the inertia.
        values |= {"inertia": 1.0}
        values.pop("load_inertia", None)
    supply = electrical["supply_voltage"]
    if math.isnan(supply) and volts is not None:
        supply = float(np.median(volts))
    gain = math.nan if gains is None else float(gains.max())
    return _Arguments(
        values,
        is_scaled,
        electrical["resistance"],
        electrical["torque_constant"],
        supply,
        gain,
    )


def _check_log(log: Log) -> None:
    """Raise if a log cannot be fitted."""
    lacking = [name for name in ("command", "position") if not log.has(name)]
    if lacking:
        raise ValueError(
            f"log {log.name} has no {' and no '.join(lacking)} (only {', '.join(log.signals)}):"
            " map it, as in command=goal:rad,position=present:rad"
        )
    if not has_motion(log):
        raise ValueError(f"log {log.name}: the servo does not move; log a motion")
    if log.step > MAX_STEP:
        raise ValueError(
            f"log {log.name}: a row every {log.step:.3g} s, must be at most {MAX_STEP:g} s; log"
            " more often, or correct the unit of time"
        )
    longest = max(part.stop - part.start for part in gapless_stretches(log))
    if longest < MIN_ROWS:
        raise ValueError(f"log {log.name}: {longest} rows without a gap, must be {MIN_ROWS}")
    command, position = log.signals["command"], log.signals["position"]
    if np.ptp(command) == 0.0:
        raise ValueError(f"log {log.name}: the command does not change; log a motion")
    if np.corrcoef(command, position)[0, 1] < 0.0:
        raise ValueError(
            f"log {log.name}: the position moves against the command; give one of them a minus,"
            " as in command=-column:rad"
        )


def _common(logs: Sequence[Log], name: str) -> np.ndarray | None:
    """Return the values of a signal of all logs; None if no log has it."""
    having = [log for log in logs if log.has(name)]
    if not having:
        return None
    if len(having) < len(logs):
        lacking = next(log.name for log in logs if not log.has(name))
        raise ValueError(f"log {lacking} has no {name}, but others have: map it in all of them")
    values = np.concatenate([log.signals[name] for log in having])
    if not values.min() > 0.0:
        raise ValueError(f"{name}: the smallest value is {values.min():g}, must be above 0")
    return values


class _Servo(NamedTuple):
    """A fitted servo."""

    fit: Fit[ServoModel]
    friction_reason: str
    # Stall torque [N*m] by the other law of its limit, if it explains the logs as well; else not a
    # number.
    other_stall: float


def _fit(
    model: ServoModel, logs: Sequence[Log], friction: str, on_step: Callable[[], None]
) -> _Servo:
    """Fit a servo with the friction and the limit of the torque that explain the logs.

    The limit applies to the duty, before the damping by the back-EMF, or to the torque after it. A
    limit that is not reached is left out.
    """
    choice = choose_friction(model, logs, friction, on_step)
    segments = choice.model.segments(logs)
    guessed, starts = choice.model.initial_guess(segments)
    fit, start_fits = fit_from_starts(guessed, segments, starts, on_step)
    other_stall = math.nan
    if "stall_torque" in fit.model.names:
        # A servo with a register of its gain sets a duty. The other law has one more parameter,
        # which would only imitate what the model of friction lacks.
        if math.isnan(model.gain):
            alternative = _with_limited_torque(fit)
            costs = [float(candidate.costs(fit.scale).sum()) for candidate in (fit, alternative)]
            # The law with one more parameter has to be clearly better.
            if costs[1] < MAX_COST_RATIO * costs[0]:
                fit, start_fits = alternative, (alternative,)
            elif costs[0] > MAX_COST_RATIO * costs[1]:
                other_stall = alternative.model.all_values(alternative.values)["stall_torque"]
        unlimited = _without_limit(fit)
        # Friction that the model lacks looks like a limit, but explains little of the residuals.
        costs = [float(candidate.costs(fit.scale).sum()) for candidate in (fit, unlimited)]
        stall = fit.values[fit.model.names.index("stall_torque")]
        is_reached = largest_torque(fit.model, fit.values, segments, 1.0 - _LIMITED) > stall
        if not (is_reached and costs[0] < _MAX_LIMITED_COST * costs[1]):
            fit, start_fits, other_stall = unlimited, (unlimited,), math.nan
    fit = dataclasses.replace(fit, logs=tuple(logs), start_fits=start_fits)
    return _Servo(fit, choice.reason, other_stall)


def _with_limited_torque(fit: Fit[ServoModel]) -> Fit[ServoModel]:
    """Return the fit of a servo whose limit applies after the damping."""
    names, damping = fit.model.names, fit.model.all_values(fit.values)["damping"]
    model = dataclasses.replace(
        fit.model,
        limits_torque=True,
        names=(*names, "viscous_friction"),
        scales=np.append(fit.model.scales, max(damping, 1e-9)),
    )
    largest = largest_torque(model, np.append(fit.values, 0.0), fit.segments, 1.0)
    # With all of the damping as viscous friction, this law is that of a limited duty.
    starts = [np.append(fit.values, 0.95 * damping)]
    for share in (0.3, 0.5, 0.8):
        start = np.append(fit.values, 0.1 * damping)
        start[names.index("stall_torque")] = share * largest
        starts.append(start)
    fits = [optimize(model, fit.segments, start, 8, fit.scale) for start in starts]
    best = min(fits, key=lambda candidate: candidate.costs(fit.scale).sum())
    return optimize(model, fit.segments, best.values, 40, fit.scale, best.states)


def _without_limit(fit: Fit[ServoModel]) -> Fit[ServoModel]:
    """Return the fit of a servo whose torque is not limited."""
    limited = ("stall_torque", "viscous_friction")
    rows = [index for index, name in enumerate(fit.model.names) if name not in limited]
    unlimited = dataclasses.replace(
        fit.model,
        names=tuple(fit.model.names[row] for row in rows),
        scales=fit.model.scales[rows],
        estimated=tuple(name for name in fit.model.estimated if name != "stall_torque"),
        limits_torque=False,
    )
    return optimize(unlimited, fit.segments, fit.values[rows])


def _predictions(fit: Fit[ServoModel], logs: Iterable[Log]) -> tuple[Prediction, ...]:
    """Predict the logs that have a command and a position."""
    return tuple(
        predict(fit, log) for log in logs if has_motion(log) and log.has("command", "position")
    )


def _finish(
    estimates: Sequence[Estimate],
    fit: Fit[ServoModel],
    arguments: _Arguments,
    law: DutyLaw | None,
    other_stall: float,
) -> list[Estimate]:
    """Widen intervals by what a fit cannot see, and add what follows from the parameters."""
    by_name = {estimate.name: estimate for estimate in estimates if estimate.name in _NAMES}
    gaps = log_disagreements(fit)
    row = max(log.step for log in fit.logs)
    gain = by_name["position_gain"].value
    total = fit.model.shaft_parameters(fit.values).inertia
    for name, estimate in by_name.items():
        if estimate.status == "given":
            continue
        if gaps.get(name, 0.0) > 0.0:
            estimate = _widened(estimate, gaps[name], "logs", by_name)
        # A loop that is late by T takes gain*T from the damping. The stall torque follows, because
        # the logs show the speed at which both are equal.
        if name in ("damping", "friction_torque", "stall_torque"):
            extra = gain * _LOOP_PERIOD
            if name == "friction_torque":
                extra *= _rms_speed(fit)
            elif name == "stall_torque" and not fit.model.limits_torque:
                extra *= estimate.value / max(by_name["damping"].value, extra)
            estimate = _widened(estimate, extra, "loop", by_name)
        if name == "stall_torque" and not math.isnan(other_stall):
            estimate = _with_other_law(estimate, other_stall, by_name)
        if name == "command_delay":
            estimate = _widened(estimate, _ROW_SHARE * row, "row", by_name, row)
        else:
            size = total if name == "armature" else abs(estimate.value)
            estimate = _widened(estimate, _MIN_SHARE * size, "load", by_name)
        by_name[name] = estimate
    derived = _derived(by_name, fit, arguments, law)
    by_name |= derived
    if not arguments.is_scaled:
        by_name = _per_inertia(by_name)
    return [by_name[name] for name in PARAMETERS if name in by_name]


def _with_other_law(
    estimate: Estimate, other_stall: float, by_name: Mapping[str, Estimate]
) -> Estimate:
    """Return a stall torque that covers the value by the other law, if that lies outside."""
    if estimate.low <= other_stall <= estimate.high:
        return estimate
    widened = _widened(estimate, 1.25 * abs(other_stall - estimate.value), "limit", by_name)
    if widened.status == "identified":
        return dataclasses.replace(widened, status="rough", why=CAUSES["limit"])
    return widened


def _rms_speed(fit: Fit[ServoModel]) -> float:
    """Return the RMS of the speeds [rad/s] over the segments."""
    speeds = [
        np.diff(segment.measured[::20]) / np.diff(segment.times[::20]) for segment in fit.segments
    ]
    return float(np.sqrt(np.mean(np.concatenate(speeds) ** 2)))


_NAMES = (
    *("position_gain", "stall_torque", "damping", "viscous_friction", "armature", "inertia"),
    *("load_inertia", "mgl"),
    *("coulomb_friction", "stribeck_friction", "stribeck_speed", "gear_efficiency"),
    *("friction_torque", "command_delay", "zero", "max_velocity"),
)
"""Parameters of a servo that a fit or a user gives."""


def _widened(
    estimate: Estimate,
    extra: float,
    cause: str,
    by_name: Mapping[str, Estimate],
    row: float = 0.0,
) -> Estimate:
    """Return an estimate with a wider interval, and with a status that fits it."""
    name, value = estimate.name, estimate.value
    bounds = PARAMETERS[name]
    low, high = max(estimate.low - extra, bounds.lower), min(estimate.high + extra, bounds.upper)
    estimate = dataclasses.replace(
        estimate, low=low, high=high, causes={**estimate.causes, cause: extra}
    )
    if estimate.status not in ("identified", "rough"):
        return estimate
    half_width = max(high - value, value - low)
    size = max(abs(value), MIN_SIZES.get(name, 0.0), _DELAY_ROWS * row)
    if name in FRICTION and "friction_torque" in by_name:
        size = max(abs(value), abs(by_name["friction_torque"].value) * (name == "coulomb_friction"))
    return _judged(estimate, half_width / max(size, 1e-300), CAUSES[cause])


def _judged(estimate: Estimate, share: float, cause: str) -> Estimate:
    """Return an estimate with the status of a relative half-width, if it was usable."""
    limit = MAX_FRICTION if estimate.name in FRICTION else MAX_HALF_WIDTH
    if estimate.status not in ("identified", "rough") or share <= limit:
        return estimate
    status: Status = "rough" if share <= MAX_HALF_WIDTH else "refused"
    why = f"its interval is {100.0 * share:.3g} % of it to either side, mostly because {cause}"
    return dataclasses.replace(estimate, status=status, why=why)


def _ratio(name: str, numerator: Estimate, denominator: Estimate, factor: float = 1.0) -> Estimate:
    """Return the ratio of two estimates, as uncertain as if their errors were independent."""
    value = factor * numerator.value / denominator.value
    share = math.hypot(
        *(
            (estimate.high - estimate.low) / 2.0 / max(abs(estimate.value), 1e-300)
            for estimate in (numerator, denominator)
        )
    )
    worst = max((numerator, denominator), key=lambda estimate: _RANK[estimate.status])
    status: Status = "identified" if worst.status == "given" else worst.status
    why = "" if status == "identified" else f"{worst.name} is {worst.status}: {worst.why}"
    estimate = Estimate(name, value, value * (1.0 - share), value * (1.0 + share), status, why)
    return _judged(estimate, share, "the values that it follows from are not known better")


_RANK = {
    status: rank
    for rank, status in enumerate(
        ("given", "identified", "rough", "ratio", "unidentifiable", "refused")
    )
}
"""Status -> how little it says."""


def _derived(
    by_name: Mapping[str, Estimate],
    fit: Fit[ServoModel],
    arguments: _Arguments,
    law: DutyLaw | None,
) -> dict[str, Estimate]:
    """Return the firmware's law, the torque at full duty, and what R and kT make of it."""
    derived: dict[str, Estimate] = {}
    stall, gain = by_name.get("stall_torque"), by_name["position_gain"]
    if law is not None and law.estimate.status in USABLE:
        derived["duty_gain"] = law.estimate
        # The torque at full duty follows from the gain even if the logs never reach it.
        stall = _ratio("stall_torque", gain, law.estimate)
        derived["stall_torque"] = stall
    elif stall is not None and not fit.model.limits_torque:
        derived["duty_gain"] = dataclasses.replace(
            _ratio("duty_gain", gain, stall), why="if the duty at the limit is 1"
        )
    if stall is None:
        reached = largest_torque(fit.model, fit.values, fit.segments, 1.0)
        derived["stall_torque"] = Estimate(
            "stall_torque",
            reached,
            reached,
            math.inf,
            "unidentifiable",
            "the torque reaches no limit, or too rarely: move faster or further, or log the duty",
        )
        return derived
    damping = by_name["damping"]
    if damping.value > 0.0 and damping.status in USABLE and not fit.model.limits_torque:
        speed = _ratio("no_load_speed", stall, damping)
        friction = by_name["coulomb_friction"].value / damping.value
        derived["no_load_speed"] = dataclasses.replace(
            speed,
            value=max(speed.value - friction, 0.0),
            low=max(speed.low - friction, 0.0),
            high=speed.high - friction,
        )
    if fit.model.limits_torque:
        return derived
    return derived | _electrical(stall, damping, arguments)


def _electrical(stall: Estimate, damping: Estimate, arguments: _Arguments) -> dict[str, Estimate]:
    """Return R, kT and viscous friction, if R or kT and the supply voltage are known.

    Commands and positions show only kT/R, in the stall torque, and the sum of kT*kE/R and the
    viscous friction, in the damping.
    """
    volts = arguments.supply_voltage
    if math.isnan(volts) or not arguments.is_scaled:
        return {}
    resistance, constant = arguments.resistance, arguments.torque_constant
    if math.isnan(resistance) and math.isnan(constant):
        return {}
    if math.isnan(constant):
        known = Estimate("resistance", resistance, resistance, resistance, "given")
        unit = Estimate("resistance", 1.0, 1.0, 1.0, "given")
        computed = _ratio("torque_constant", stall, unit, resistance / volts)
        constant = computed.value
    else:
        known = Estimate("torque_constant", constant, constant, constant, "given")
        computed = _ratio("resistance", known, stall, volts)
        resistance = computed.value
    braking = constant * constant / resistance
    viscous = Estimate(
        "viscous_friction",
        max(damping.value - braking, 0.0),
        max(damping.low - braking, 0.0),
        max(damping.high - braking, 0.0),
        damping.status,
        "damping without kT*kE/R, if kE = kT and the firmware has no derivative gain",
    )
    return {known.name: known, computed.name: computed, viscous.name: viscous}


def _per_inertia(by_name: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the estimates, with all torques over the inertia, which was fitted as 1."""
    renamed = {}
    for name, estimate in by_name.items():
        ratio = f"{name}_per_inertia"
        if name in ("inertia", "armature", "load_inertia"):
            continue
        if ratio in PER_INERTIA:
            if estimate.status == "given":
                continue
            renamed[ratio] = dataclasses.replace(estimate, name=ratio)
        else:
            renamed[name] = estimate
    return renamed
