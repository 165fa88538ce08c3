"""From logs to a motor: which parts can be fitted, what is found, and how far it may be trusted."""

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.fields import check_names
from codrl_mj.identify.estimate import Fit, fit_model, refit_model
from codrl_mj.identify.friction import choose_friction, load_hint
from codrl_mj.identify.log import SEGMENT_DURATION, Log, has_motion, find_obstacle, shift_signal, assign_logs
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import (
    DEFAULTS,
    ESTIMABLE,
    OF_LOSS,
    OF_RIG,
    OF_WINDING,
    PARAMETERS,
)
from codrl_mj.identify.result import (
    MAX_UNEXPLAINED,
    USABLE,
    Estimate,
    Identified,
    Prediction,
    fitted_traces,
    missing_parameters,
    base_motor,
    predict,
)
from codrl_mj.identify.uncertainty import correlations, assess_fits

STEPS_OF_A_PART = 8 + 4


def identify(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    held_out: Sequence[Log] = (),
    estimated: Sequence[str] = (),
    segment: float = SEGMENT_DURATION,
    base: Mapping[str, Any] | None = None,
    on_progress: Callable[[str, int, int], None] = lambda *_: None,
    seed: int = 0,
) -> Identified:
    """Identify a motor.

    Args:
        logs: to fit, at least one, as they are: `check` says what is wrong with one. Voltage and
            current tell the winding; torque or current, or else voltage, and position or velocity
            tell the shaft.
        rig: what the output moves: `pendulum`, `free` or `load`; None: a pendulum where `mgl` is
            known.
        known: parameters that are not to be fitted, by names of `PARAMETERS`.
        friction: `coulomb` (viscous and Coulomb), `stribeck`, `load`, `both`, or `auto`: whichever
            foretells logs that it was not fitted to, by more than those differ.
        held_out: logs that are only foretold.
        estimated: parameters to fit that are otherwise taken as known, such as `torque_gain`.
        segment: time [s] that the shaft is simulated for at once, >= 0.05: short where it tips over
            by itself, a second or two where it only sticks and slides.
        base: the mapping of a drive that gives what the logs do not tell, and the gear where
            `known` does not.
        on_progress: called with what is being done, steps done and steps in all.
        seed: of the resampling.

    Raises:
        ValueError: unknown names, values out of bounds, or logs that tell nothing; the message says
            what is missing.
    """
    logs, held_out, repeated = separate_logs(logs, held_out)
    given, motor = (
        check_arguments(logs, rig, known or {}, friction, estimated, segment, base),
        base_motor(base),
    )
    defaults = DEFAULTS | {name: getattr(motor, name) for name in OF_LOSS if motor is not None}
    rig = rig or ("pendulum" if "mgl" in given else "free")
    electrical, moving, driven_by, output = assign_logs(logs)
    total = STEPS_OF_A_PART * max(bool(electrical) + bool(moving), 1) + 4 * len(moving) * (
        friction == "auto"
    )
    done = itertools.count(1)

    def step(what: str) -> Callable[[], None]:
        return lambda: on_progress(what, min(next(done), total), total)

    # the winding, and the shaft by the torque constant that the winding tells; then each again,
    # beside the other
    parts: dict[str, Fit] = {}
    if electrical:
        parts["winding"] = fit_model(WindingModel(known=given), electrical, step("winding"))
    if driven_by:
        shaft = ShaftModel(rig=rig, friction="coulomb", driven_by=driven_by, output=output, known=given,
                           defaults=defaults, estimated=tuple(estimated), segment=segment)  # fmt: skip
        choice = choose_friction(
            _told(shaft, parts.get("winding")), moving, friction, step("friction")
        )
        shaft, friction = choice.model, choice.model.friction
        parts["shaft"] = fit_model(shaft, moving, step("shaft"))
        if electrical and driven_by != "voltage":
            parts["winding"] = refit_model(
                parts["winding"], WindingModel(known=given, shaft=parts["shaft"])
            )
        shaft = _told(dataclasses.replace(shaft, known=given), parts.get("winding"))
        parts["shaft"] = refit_model(parts["shaft"], shaft)
    estimates, warnings, unexplained = assess_fits(parts, given, defaults, seed, step)
    warnings = [*warnings, *_contradictions(estimates, motor)]
    if "shaft" in parts and (hint := load_hint(parts["shaft"])):
        warnings.append(hint)
    volts = [log.signals[name] for log in logs for name in ("voltage", "bus") if log.has(name)]
    found = Identified(
        logs=tuple(log.name for log in logs),
        rig=rig,
        friction=friction,
        driven_by=driven_by,
        delays={name: part.delay for name, part in parts.items()},
        estimates=tuple(estimates),
        fitted=_foretold(parts.get("shaft"), moving),
        held_out=_foretold(parts.get("shaft"), held_out),
        warnings=tuple(warnings),
        base=base,
        traces=tuple(one for name, part in parts.items() for one in fitted_traces(name, part)),
        correlations={
            name: correlations(parts[name]) if name in parts else {}
            for name in ("winding", "shaft")
        },
        supply=max((float(np.abs(one).max()) for one in volts), default=None),
        unexplained=unexplained,
        friction_reason=choice.reason if driven_by else "",
    )
    if _is_better_blind(found, moving):
        # The current must not take away what the voltage alone tells, for example at few rows in a
        # time constant.
        fewer = [_without_current(log) for log in logs]
        arguments = rig, known, friction, held_out, estimated, segment, base, on_progress, seed
        found = _joined(found, identify(fewer, *arguments))
    return dataclasses.replace(found, warnings=(*repeated, *found.warnings))


def _is_better_blind(found: Identified, moving: Sequence[Log]) -> bool:
    """Return True if a shaft under the current has no constant, and might have one under the voltage."""
    refused = any(
        one.name == "back_emf_constant" and one.status not in USABLE for one in found.estimates
    )
    has_voltage = found.driven_by == "current" and all(log.has("voltage") for log in moving)
    return refused and has_voltage and found.unexplained <= MAX_UNEXPLAINED


def _without_current(log: Log) -> Log:
    signals = {name: values for name, values in log.signals.items() if name != "current"}
    return dataclasses.replace(log, signals=signals) if has_motion(log) else log


def _joined(whole: Identified, blind: Identified) -> Identified:
    """Return the shaft without the current beside the winding with it, if fewer numbers are refused that way."""
    refused = [
        sum(one.status not in USABLE and one.name != "inductance" for one in result.estimates)
        for result in (whole, blind)
    ]
    if refused[1] >= refused[0]:
        return whole
    named = {one.name: one for one in (*whole.estimates, *blind.estimates)}
    note = (
        "the shaft is fitted under the voltage: under the current its back-EMF constant was refused"
    )
    return dataclasses.replace(
        blind,
        delays={**whole.delays, **blind.delays},
        estimates=tuple(named[name] for name in PARAMETERS if name in named),
        warnings=(note, *blind.warnings),
        friction_reason=whole.friction_reason,
        traces=(
            *(one for one in whole.traces if one.part == "winding"),
            *(one for one in blind.traces if one.part == "shaft"),
        ),
        correlations={
            "winding": whole.correlations["winding"],
            "shaft": blind.correlations["shaft"],
        },
    )


def _told(shaft: ShaftModel, winding: Fit | None) -> ShaftModel:
    """The shaft, with what it has of the winding where that is not known.

    Under a current the back-EMF constant for a torque constant: but for losses they are equal;
    under a voltage the resistance.
    """
    numbers = shaft.known if winding is None else winding.model.all_values(winding.values)
    name, source = OF_WINDING.get(shaft.driven_by, ("", ""))
    value = numbers.get(source, 0.0)
    if name in (*shaft.known, *shaft.estimated) or not value > 0.0:
        return shaft
    return dataclasses.replace(shaft, known={**shaft.known, name: value})


def separate_logs(
    logs: Sequence[Log], held_out: Sequence[Log]
) -> tuple[list[Log], list[Log], list[str]]:
    """Return the logs to fit and the logs held out, each measurement once, and a sentence for each one left out.

    A measurement is recognized by its content, because copies have other names. One that is fitted
    and held out is held out.
    """
    fitted: dict[bytes, Log] = {}
    predicted: dict[bytes, Log] = {}
    repeated = []
    for several, kept in ((held_out, predicted), (logs, fitted)):
        for log in several:
            key = _content(log)
            twin = predicted.get(key) or fitted.get(key)
            if twin is None:
                kept[key] = log
                continue
            copy = "" if twin.name == log.name else f", as {twin.name}"
            is_predicted = kept is fitted and key in predicted
            told = (
                f"held out{copy}: it is only predicted, not fitted"
                if is_predicted
                else f"there twice{copy}: it counts once"
            )
            repeated.append(f"log {log.name} is {told}")
    if logs and not fitted:
        raise ValueError(
            f"logs {', '.join(log.name for log in logs)}: all are held out, too, so none is left to"
            " fit; hold out others (--holdout on the command line, held_out= in Python)"
        )
    return [*fitted.values()], [*predicted.values()], repeated


def _content(log: Log) -> bytes:
    """Return a digest of a log's signals; its name and the start of its time do not count."""
    digest = hashlib.sha256()
    for name in sorted(log.signals):
        digest.update(name.encode() + log.signals[name].tobytes())
    return digest.digest()


def _contradictions(estimates: Sequence[Estimate], motor: Any) -> list[str]:
    """Return what the logs have against the datasheet's rotor, which is taken where no load's inertia was given."""
    named = {one.name: one for one in estimates}
    if motor is None or "rotor_inertia" in named or "inertia" not in named:
        return []
    reflected, whole = motor.rotor_inertia * motor.gear_ratio**2, named["inertia"]
    if reflected <= whole.high:
        return []
    return [
        f"the motor's rotor_inertia = {motor.rotor_inertia:.4g} kg*m^2 is {reflected:.4g} at the"
        f" output, but all that moves has {whole.value:.4g}: fit it by --known load_inertia=VALUE,"
        " or correct the --motor"
    ]


def check_arguments(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    estimated: Sequence[str] = (),
    segment: float = SEGMENT_DURATION,
    base: Mapping[str, Any] | None = None,
) -> dict[str, float]:
    """What is known, the gear of the base too, if the arguments of `identify` are such as it takes."""
    motor = base_motor(base)
    # of a motor with a gear that too: otherwise its numbers would be those of the output
    ratio = 1.0 if motor is None else motor.gear_ratio
    known = {**({} if ratio == 1.0 else {"gear_ratio": ratio}), **(known or {})}
    _, moving, driven_by, output = assign_logs(logs)
    if not segment >= 0.05:
        raise ValueError(f"segment = {segment!r}: must be >= 0.05 s; {SEGMENT_DURATION:g} is the default")
    if not logs:
        raise ValueError("logs: none was given; give one or more")
    check_names(
        known, [name for name in PARAMETERS if name != "friction_torque"], "parameter", "known."
    )
    if rig is not None:
        check_names([rig], OF_RIG, "rig")
    check_names([friction], ("auto", "coulomb", "stribeck", "load", "both"), "friction")
    for name, value in known.items():
        parameter = PARAMETERS[name]
        if not (math.isfinite(value) and parameter.lower <= value <= parameter.upper):
            raise ValueError(
                f"known {name} = {value!r}: must be from {parameter.lower:g} to {parameter.upper:g} "
                f"{parameter.unit}; give {parameter.description}".strip()
            )
    if found := find_obstacle(logs):
        have = "; ".join(f"{log.name}: {', '.join(log.signals) or 'nothing'}" for log in logs)
        raise ValueError(f"{found.message}; {found.remedy} (logs and their signals: {have})")
    twice = sorted({*known} & {*estimated})
    if twice:
        raise ValueError(
            f"{', '.join(twice)}: both known and estimated, must be one of them; leave the"
            " other out"
        )
    possible = [name for name, only in ESTIMABLE.items() if only is None or only == driven_by]
    if driven_by is not None or estimated:
        check_names(estimated, possible, f"parameter of a shaft under a {driven_by}", "estimated.")
    if moving and not output:
        have = "; ".join(
            f"{log.name}: {'position' if log.has('position') else 'velocity'}" for log in moving
        )
        raise ValueError(
            f"logs tell different things ({have}): give all that move a position, or all a velocity"
        )
    if rig is None and "mgl" not in known and driven_by is not None:
        raise ValueError(
            "rig is not given (--rig on the command line, rig= in Python): what the output moves"
            " decides what is fitted, must be pendulum, free or load; a motor on its own is free,"
            " with load_inertia=0 known"
        )
    return {name: float(value) for name, value in known.items()}


def predict_missing(
    logs: Sequence[Log], known: Mapping[str, float], base: Mapping[str, Any] | None
) -> str | None:
    """What will be missing for an actuator however well logs are fitted, by their signals; None: nothing."""
    electrical, moving, driven_by, _ = assign_logs(logs)
    names = {*known, *(("resistance", "inductance") if electrical else ())}
    names |= {"resistance"} if driven_by == "voltage" else set()
    constants = {"torque_constant", "back_emf_constant"}
    if names & constants or driven_by == "voltage" or (electrical and moving):
        names |= constants
    if "load_inertia" in known and driven_by is not None:
        names |= {"rotor_inertia"}
    names |= set() if driven_by is None else {"inertia"}
    return missing_parameters(names, base)


def _foretold(shaft: Fit | None, logs: Sequence[Log]) -> tuple[Prediction, ...]:
    """What the shaft makes of those of the logs that it is told by."""
    if shaft is None:
        return ()
    driven_by, output = shaft.model.driven_by, shaft.model.output
    told = [log for log in logs if has_motion(log) and log.has(driven_by, output)]
    return tuple(predict(shaft, shift_signal(log, driven_by, shaft.delay)) for log in told)
