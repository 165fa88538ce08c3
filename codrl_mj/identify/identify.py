"""Identification of a motor from bench logs: fits, intervals, predictions and warnings."""

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from codrl_mj.actuators import GearMotor
from codrl_mj.fields import check_names
from codrl_mj.identify.estimate import Fit, Model, fit_model, refit_model
from codrl_mj.identify.friction import choose_friction, load_hint
from codrl_mj.identify.log import (
    SEGMENT_DURATION,
    Log,
    assign_log_roles,
    find_obstacle,
    has_motion,
    shift_signal,
)
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import (
    DEFAULTS,
    ESTIMABLE,
    LOSS_PARAMETERS,
    PARAMETERS,
    PER_INERTIA,
    RIG_PARAMETERS,
    SERVO_PARAMETERS,
    WINDING_SOURCES,
)
from codrl_mj.identify.result import (
    MAX_UNEXPLAINED,
    USABLE,
    Estimate,
    Identified,
    Prediction,
    base_motor,
    fitted_traces,
    missing_parameters,
    predict,
)
from codrl_mj.identify.uncertainty import assess_fits, correlations

STEPS_PER_PART = 8 + 5
"""Progress steps for each part: for its fit, and for the assessment of its uncertainty."""


def identify(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    held_out: Sequence[Log] = (),
    estimated: Sequence[str] = (),
    segment: float = SEGMENT_DURATION,
    base: Mapping[str, object] | None = None,
    on_progress: Callable[[str, int, int], None] = lambda *_: None,
    seed: int = 0,
) -> Identified:
    """Identify a motor from its logs.

    Args:
        logs: logs to fit, at least one; `check` finds their faults, and none is corrected here.
            Voltage and current determine the winding. Torque, current or voltage, together with
            position or velocity, determine the shaft.
        rig: kind of load at the output: `pendulum`, `free` or `load`. None is allowed if `mgl` is
            known, and then means a pendulum.
        known: values of parameters that are not fitted, by names of `PARAMETERS`.
        friction: `coulomb` (viscous and Coulomb), `stribeck`, `load`, `both`, or `auto`, which
            chooses a model by cross-validation; see `choose_friction`.
        held_out: logs that are predicted, but not fitted.
        estimated: parameters to fit that otherwise have a default, such as `torque_gain`.
        segment: duration [s] of the segments in which the shaft is simulated, >= 0.05. Unstable
            shafts need short segments; a shaft that only sticks and slides needs 1 or 2 s.
        base: mapping of a drive, which supplies the parameters that the logs do not determine, and
            the gear ratio if it is not in `known`.
        on_progress: called with the name of the task, the steps done and the number of steps.
        seed: seed of the resampling.

    Raises:
        ValueError: a name is unknown, a value is out of bounds, or the logs lack signals; the
            message names the missing signals.
    """
    logs, held_out, duplicate_notes = separate_logs(logs, held_out)
    fixed = check_arguments(logs, rig, known or {}, friction, estimated, segment, base)
    motor = base_motor(base)
    defaults = DEFAULTS | {
        name: getattr(motor, name) for name in LOSS_PARAMETERS if motor is not None
    }
    rig = rig or ("pendulum" if "mgl" in fixed else "free")
    electrical, moving, driven_by, output = assign_log_roles(logs)
    total = STEPS_PER_PART * max(bool(electrical) + bool(moving), 1) + 4 * len(moving) * (
        friction == "auto"
    )
    counter = itertools.count(1)

    def step(task: str) -> Callable[[], None]:
        return lambda: on_progress(task, min(next(counter), total), total)

    # The winding is fitted first, because the shaft needs its torque constant or resistance. Then
    # the winding is fitted again with the speed of the fitted shaft, and the shaft with the
    # constants of that winding.
    winding_fit: Fit[WindingModel] | None = None
    shaft_fit: Fit[ShaftModel] | None = None
    if electrical:
        winding_fit = fit_model(WindingModel(known=fixed), electrical, step("winding"))
    if driven_by:
        shaft = ShaftModel(
            rig=rig,
            friction="coulomb",
            driven_by=driven_by,
            output=output,
            known=fixed,
            defaults=defaults,
            estimated=tuple(estimated),
            segment=segment,
        )
        choice = choose_friction(
            _with_winding(shaft, winding_fit), moving, friction, step("friction")
        )
        shaft, friction = choice.model, choice.model.friction
        shaft_fit = fit_model(shaft, moving, step("shaft"))
        if winding_fit is not None and driven_by != "voltage":
            winding_fit = refit_model(winding_fit, WindingModel(known=fixed, shaft=shaft_fit))
        shaft = _with_winding(dataclasses.replace(shaft, known=fixed), winding_fit)
        shaft_fit = refit_model(shaft_fit, shaft)
    fits: dict[str, Fit[Model] | None] = {"winding": winding_fit, "shaft": shaft_fit}
    parts = {name: part for name, part in fits.items() if part is not None}
    estimates, warnings, unexplained = assess_fits(parts, fixed, defaults, seed, step)
    warnings = [*warnings, *_contradictions(estimates, motor)]
    if shaft_fit is not None and (hint := load_hint(shaft_fit)):
        warnings.append(hint)
    volts = [log.signals[name] for log in logs for name in ("voltage", "bus") if log.has(name)]
    identified = Identified(
        logs=tuple(log.name for log in logs),
        rig=rig,
        friction=friction,
        driven_by=driven_by,
        delays={name: part.delay for name, part in parts.items()},
        estimates=tuple(estimates),
        fitted=_predict_logs(shaft_fit, moving),
        held_out=_predict_logs(shaft_fit, held_out),
        warnings=tuple(warnings),
        base=base,
        traces=tuple(trace for name, part in parts.items() for trace in fitted_traces(name, part)),
        correlations={
            name: correlations(parts[name]) if name in parts else {}
            for name in ("winding", "shaft")
        },
        supply=max((float(np.abs(signal).max()) for signal in volts), default=None),
        unexplained=unexplained,
        friction_reason=choice.reason if driven_by else "",
    )
    if _may_need_voltage(identified, moving):
        # If only a few rows fall within the winding's time constant, the logged current may not
        # determine the back-EMF constant. A fit with the voltage as the input may still do so.
        without_current = [_without_current(log) for log in logs]
        arguments = rig, known, friction, held_out, estimated, segment, base, on_progress, seed
        identified = _better_identified(identified, identify(without_current, *arguments))
    return dataclasses.replace(identified, warnings=(*duplicate_notes, *identified.warnings))


def _may_need_voltage(identified: Identified, moving: Sequence[Log]) -> bool:
    """Return True if the current gave no usable back-EMF constant, but the voltage may."""
    is_refused = any(
        estimate.name == "back_emf_constant" and estimate.status not in USABLE
        for estimate in identified.estimates
    )
    has_voltage = identified.driven_by == "current" and all(log.has("voltage") for log in moving)
    return is_refused and has_voltage and identified.unexplained <= MAX_UNEXPLAINED


def _without_current(log: Log) -> Log:
    """Return a log without its current if it moves; a locked log still determines the winding."""
    signals = {name: values for name, values in log.signals.items() if name != "current"}
    return dataclasses.replace(log, signals=signals) if has_motion(log) else log


def _better_identified(with_current: Identified, with_voltage: Identified) -> Identified:
    """Return the result with the current, or with the shaft that was fitted with the voltage.

    The shaft of the fit with the voltage is taken if fewer of its parameters are refused.
    """
    refused = [
        sum(
            estimate.status not in USABLE and estimate.name != "inductance"
            for estimate in result.estimates
        )
        for result in (with_current, with_voltage)
    ]
    if refused[1] >= refused[0]:
        return with_current
    estimates = {
        estimate.name: estimate for estimate in (*with_current.estimates, *with_voltage.estimates)
    }
    note = (
        "the shaft is fitted with the voltage as its input, because with the current its back-EMF"
        " constant was refused"
    )
    return dataclasses.replace(
        with_voltage,
        delays={**with_current.delays, **with_voltage.delays},
        estimates=tuple(estimates[name] for name in PARAMETERS if name in estimates),
        warnings=(note, *with_voltage.warnings),
        friction_reason=with_current.friction_reason,
        traces=(
            *(trace for trace in with_current.traces if trace.part == "winding"),
            *(trace for trace in with_voltage.traces if trace.part == "shaft"),
        ),
        correlations={
            "winding": with_current.correlations["winding"],
            "shaft": with_voltage.correlations["shaft"],
        },
    )


def _with_winding(shaft: ShaftModel, winding: Fit[WindingModel] | None) -> ShaftModel:
    """Return a shaft with the parameter of the fitted winding that it needs, unless it is known.

    A shaft that is driven by a current needs the torque constant, which equals the winding's
    back-EMF constant except for losses. A shaft that is driven by a voltage needs the resistance.
    """
    parameters = shaft.known if winding is None else winding.model.all_values(winding.values)
    name, source = WINDING_SOURCES.get(shaft.driven_by, ("", ""))
    value = parameters.get(source, 0.0)
    if name in (*shaft.known, *shaft.estimated) or not value > 0.0:
        return shaft
    return dataclasses.replace(shaft, known={**shaft.known, name: value})


def separate_logs(
    logs: Sequence[Log], held_out: Sequence[Log]
) -> tuple[list[Log], list[Log], list[str]]:
    """Return the fitted and the held-out logs without duplicates, and a note on each duplicate.

    Duplicates are recognized by their content, because copies may have other names. A log that is
    both fitted and held out is only held out.
    """
    fitted: dict[bytes, Log] = {}
    predicted: dict[bytes, Log] = {}
    notes = []
    for candidates, unique in ((held_out, predicted), (logs, fitted)):
        for log in candidates:
            key = _digest(log)
            original = predicted.get(key) or fitted.get(key)
            if original is None:
                unique[key] = log
                continue
            copy = "" if original.name == log.name else f", as {original.name}"
            is_predicted = unique is fitted and key in predicted
            note = (
                f"held out{copy}: it is only predicted, not fitted"
                if is_predicted
                else f"there twice{copy}: it counts once"
            )
            notes.append(f"log {log.name} is {note}")
    if logs and not fitted:
        raise ValueError(
            f"logs {', '.join(log.name for log in logs)}: all of them are also held out, which"
            " leaves none to fit; hold out other logs (--holdout on the command line, held_out= in"
            " Python)"
        )
    return [*fitted.values()], [*predicted.values()], notes


def _digest(log: Log) -> bytes:
    """Return a digest of the signals of a log; its name and its times are ignored."""
    digest = hashlib.sha256()
    for name in sorted(log.signals):
        digest.update(name.encode() + log.signals[name].tobytes())
    return digest.digest()


def _contradictions(estimates: Sequence[Estimate], motor: GearMotor | None) -> list[str]:
    """Return a warning if the rotor inertia of the datasheet exceeds the total identified inertia.

    The datasheet's rotor inertia is used only if the logs and known values do not determine it.
    """
    by_name = {estimate.name: estimate for estimate in estimates}
    if motor is None or "rotor_inertia" in by_name or "inertia" not in by_name:
        return []
    reflected, total = motor.rotor_inertia * motor.gear_ratio**2, by_name["inertia"]
    if reflected <= total.high:
        return []
    return [
        f"the motor's rotor_inertia = {motor.rotor_inertia:.4g} kg*m^2 is {reflected:.4g} kg*m^2 at"
        f" the output, more than the total of {total.value:.4g} kg*m^2 in the logs: fit it with"
        " --known load_inertia=VALUE, or correct --motor"
    ]


def check_arguments(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    estimated: Sequence[str] = (),
    segment: float = SEGMENT_DURATION,
    base: Mapping[str, object] | None = None,
) -> dict[str, float]:
    """Validate the arguments of `identify`, and return the known parameters and gear ratio."""
    motor = base_motor(base)
    # Without the gear ratio of the base, fitted motor parameters would be values at the output.
    ratio = 1.0 if motor is None else motor.gear_ratio
    known = {**({} if ratio == 1.0 else {"gear_ratio": ratio}), **(known or {})}
    _, moving, driven_by, output = assign_log_roles(logs)
    if not segment >= 0.05:
        raise ValueError(
            f"segment = {segment!r}: must be >= 0.05 s; {SEGMENT_DURATION:g} is the default"
        )
    if not logs:
        raise ValueError("logs: none was given; give one or more")
    unknown = {"friction_torque", *SERVO_PARAMETERS, *PER_INERTIA}
    check_names(known, [name for name in PARAMETERS if name not in unknown], "parameter", "known.")
    if rig is not None:
        check_names([rig], RIG_PARAMETERS, "rig")
    check_names([friction], ("auto", "coulomb", "stribeck", "load", "both"), "friction")
    for name, value in known.items():
        parameter = PARAMETERS[name]
        if not (math.isfinite(value) and parameter.lower <= value <= parameter.upper):
            raise ValueError(
                f"known {name} = {value!r}: must be from {parameter.lower:g} to {parameter.upper:g}"
                f" {parameter.unit}; give {parameter.description}".strip()
            )
    if obstacle := find_obstacle(logs):
        signals = "; ".join(f"{log.name}: {', '.join(log.signals) or 'nothing'}" for log in logs)
        raise ValueError(
            f"{obstacle.message}; {obstacle.remedy} (logs and their signals: {signals})"
        )
    contradictory = sorted({*known} & {*estimated})
    if contradictory:
        raise ValueError(
            f"{', '.join(contradictory)}: must not be both known and estimated; remove one of"
            " the two"
        )
    possible = [name for name, only in ESTIMABLE.items() if only is None or only == driven_by]
    if driven_by is not None or estimated:
        check_names(
            estimated, possible, f"parameter of a shaft driven by a {driven_by}", "estimated."
        )
    if moving and not output:
        motions = "; ".join(
            f"{log.name}: {'position' if log.has('position') else 'velocity'}" for log in moving
        )
        raise ValueError(
            f"logs have different motions ({motions}): all logs that move must have a position, or"
            " all a velocity; map the same column in all of them"
        )
    if rig is None and "mgl" not in known and driven_by is not None:
        raise ValueError(
            "rig is not given (--rig on the command line, rig= in Python): it decides which"
            " parameters are fitted, and must be pendulum, free or load; a motor without a load is"
            " free, with load_inertia=0 known"
        )
    return {name: float(value) for name, value in known.items()}


def predict_missing(
    logs: Sequence[Log], known: Mapping[str, float], base: Mapping[str, object] | None
) -> str | None:
    """Return a message on actuator parameters that these logs cannot determine, or None.

    Only the presence of signals and of a motion is considered, so that no fit is needed.
    """
    electrical, moving, driven_by, _ = assign_log_roles(logs)
    names = {*known, *(("resistance", "inductance") if electrical else ())}
    names |= {"resistance"} if driven_by == "voltage" else set()
    constants = {"torque_constant", "back_emf_constant"}
    if names & constants or driven_by == "voltage" or (electrical and moving):
        names |= constants
    if "load_inertia" in known and driven_by is not None:
        names |= {"rotor_inertia"}
    names |= set() if driven_by is None else {"inertia"}
    return missing_parameters(names, base)


def _predict_logs(shaft: Fit[ShaftModel] | None, logs: Sequence[Log]) -> tuple[Prediction, ...]:
    """Predict the moving logs that have the input and the output of a fitted shaft."""
    if shaft is None:
        return ()
    driven_by, output = shaft.model.driven_by, shaft.model.output
    suitable = [log for log in logs if has_motion(log) and log.has(driven_by, output)]
    return tuple(predict(shaft, shift_signal(log, driven_by, shaft.delay)) for log in suitable)
