"""From logs to a motor: which parts can be fitted, what is found, and how far it may be trusted."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.fields import check_names
from codrl_mj.identify import honesty
from codrl_mj.identify.log import Log
from codrl_mj.identify.parameters import DEFAULTS, ESTIMABLE, FRICTION, OF_RIG, PARAMETERS
from codrl_mj.identify.prediction import Prediction, fitted_traces, predict
from codrl_mj.identify.result import Estimate, Identified, Status, missing
from codrl_mj.identify.segments import BLOCK, SEGMENT, moves, shifted
from codrl_mj.identify.stages import PART, Fitted, Shaft, Winding, chosen_friction, fitted

WIDEST = 0.3
"""An interval of more than this share of the value to either side is too wide; of the whole friction, for friction."""
WIDEST_OF = {"resistance": 0.05, "back_emf_constant": 0.05, "inductance": 0.15}
"""For what a current sensor tells."""
NARROWEST = 0.002
"""No interval is narrower than this share of the value to either side: nobody's sensors are better calibrated."""
NARROWEST_OF = {"inductance": 0.02}
"""What comes of a fifth of a row's time: neither stamps nor a held back-EMF are better."""
NARROW = 0.1
"""Friction whose interval is a larger share of itself is a rough number: what is sure is how much of all it may be."""
BIASED = 0.5
"""The self-test fails where it is off by more than this share of the widest interval."""
CAUSES = {
    "curvature": "the logs hardly depend on it",
    "resampling": "parts of the logs disagree",
    "logs": "the logs disagree",
    "half_rate": "every second row tells another value",
    "self_test": "a fit to its own simulation does not find it again",
    "unexplained": "the current is not explained",
    "torque_constant": "the torque constant is not known better",
}
"""What widens an interval, in words."""
INPUTS = "torque", "current", "voltage"
"""What drives the shaft: the nearest to it that all logs that move have."""
OUTPUTS = "position", "velocity"
"""What a simulation is compared with."""
STEPS_OF_A_STAGE = 8 + 4
AT_BOUND = 1e-3
"""Nearer to a bound, in the parameter's scale, a value is at it."""
RAREST = 0.05
"""Rows that are farther apart [s] say too little within the time that is foretold."""
UNEXPLAINED = 8.0
"""Residuals of more standard deviations of the sensor in the mean are no noise,"""
UNLIKE = 0.02
"""and more than this share of what moves within a segment is not explained: the log is bad, or the model is."""


def identify(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    held_out: Sequence[Log] = (),
    estimated: Sequence[str] = (),
    segment: float = SEGMENT,
    base: Mapping[str, Any] | None = None,
    on_progress: Callable[[str, int, int], None] = lambda *_: None,
    seed: int = 0,
) -> Identified:
    """Identify a motor.

    Args:
        logs: to fit, at least one. Voltage and current tell the winding; torque or current, or else voltage, and
            position or velocity tell the shaft.
        rig: what the output moves: `pendulum`, `free` or `load`; None: a pendulum where `mgl` is known.
        known: parameters that are not to be fitted, by names of `PARAMETERS`.
        friction: `coulomb` (viscous and Coulomb), `stribeck`, `load`, `both`, or `auto`: whichever foretells logs that
            it was not fitted to, by more than those differ.
        held_out: logs that are only foretold.
        estimated: parameters to fit that are otherwise taken as known, such as `torque_gain`.
        segment: time [s] that the shaft is simulated for at once, >= 0.05: short where it tips over by itself, a second
            or two where it only sticks and slides.
        base: the mapping of a drive that gives what the logs do not tell, and the gear where `known` does not.
        on_progress: called with what is being done, steps done and steps in all.
        seed: of the resampling.

    Raises:
        ValueError: unknown names, values out of bounds, or logs that tell nothing; the message says what is missing.
    """
    given = checked(logs, rig, known or {}, friction, estimated, segment, base)
    rig = rig or ("pendulum" if "mgl" in given else "free")
    moving, electrical = [log for log in logs if moves(log)], _electrical(logs)
    folds = 4 * len(moving) if friction == "auto" else 0
    done, total = 0, STEPS_OF_A_STAGE * max(bool(electrical) + bool(moving), 1) + folds

    def step(what: str) -> Callable[[], None]:
        def one() -> None:
            nonlocal done
            done += 1
            on_progress(what, min(done, total), total)

        return one

    winding = fitted(Winding(given), electrical, step("winding")) if electrical else None
    shaft, driven_by = None, _common(moving, *INPUTS)
    if driven_by is not None:
        known = {**given, **_constant(given, winding, driven_by, estimated)}
        stage = Shaft(rig, "coulomb", driven_by, known, tuple(estimated), segment, _common(moving, *OUTPUTS) or "")
        stage = chosen_friction(stage, moving, friction, step("friction"))
        shaft = fitted(stage, moving, step("shaft"))
    estimates, warnings = [], []
    unlike: dict[str, float] = {}
    if winding is not None:
        if shaft is not None and driven_by != "voltage":
            winding = winding.refitted(Winding(given, shaft))
        estimates += _judged(winding, seed, step("winding"))
        warnings += _warnings(winding, unlike)
    if shaft is not None:
        constant = _constant(given, winding, shaft.stage.driven_by, estimated)
        shaft = shaft.refitted(dataclasses.replace(shaft.stage, known={**shaft.stage.known, **constant}))
        found = _judged(shaft, seed, step("shaft"))
        own = next((one for one in estimates if one.name == "back_emf_constant"), None) if constant else None
        estimates += _with_constant(found, own, shaft.stage)
        warnings += _warnings(shaft, unlike)
    estimates, parts = _completed(estimates, given), {"winding": winding, "shaft": shaft}
    return Identified(
        tuple(log.name for log in logs),
        rig,
        friction if shaft is None else shaft.stage.friction,
        driven_by,
        {name: part.delay for name, part in parts.items() if part is not None},
        tuple(estimates),
        _predictions(shaft, moving),
        _predictions(shaft, [log for log in held_out if moves(log)]),
        tuple(warnings),
        base,
        tuple(one for name, part in parts.items() for one in fitted_traces(name, part)),
        {name: {} if part is None else honesty.correlations(part.fit) for name, part in parts.items()},
        max(
            (float(np.abs(log.signals[name]).max()) for log in logs for name in {"voltage", "bus"} & {*log.signals}),
            default=None,
        ),
        max(unlike.values(), default=0.0),
    )


def checked(
    logs: Sequence[Log],
    rig: str | None = None,
    known: Mapping[str, float] | None = None,
    friction: str = "coulomb",
    estimated: Sequence[str] = (),
    segment: float = SEGMENT,
    base: Mapping[str, Any] | None = None,
) -> dict[str, float]:
    """What is known, the gear of the base too, if the arguments of `identify` are such as it takes."""
    from codrl_mj.actuators import Drive, actuator_from_mapping

    drive = None if base is None else actuator_from_mapping(base)
    # of a motor with a gear that too: otherwise its numbers would be those of the output
    ratio = drive.motor.gear_ratio if isinstance(drive, Drive) else 1.0
    known = {**({} if ratio == 1.0 else {"gear_ratio": ratio}), **(known or {})}
    moving = [log for log in logs if moves(log)]
    driven_by = _common(moving, *INPUTS)
    if not segment >= 0.05:
        raise ValueError(f"segment = {segment!r}: must be >= 0.05 s; {SEGMENT:g} is the default")
    if not logs:
        raise ValueError("logs: none was given; give one or more")
    check_names(known, [name for name in PARAMETERS if name != "friction_torque"], "parameter", "known.")
    if rig is not None:
        check_names([rig], OF_RIG, "rig")
    check_names([friction], ("auto", "coulomb", "stribeck", "load", "both"), "friction")
    for name, value in known.items():
        parameter = PARAMETERS[name]
        if not (math.isfinite(value) and parameter.least <= value <= parameter.most):
            raise ValueError(
                f"known {name} = {value!r}: must be from {parameter.least:g} to {parameter.most:g} "
                f"{parameter.unit}; give {parameter.what}".strip()
            )
    if not _electrical(logs) and driven_by is None:
        have = "; ".join(f"{log.name}: {', '.join(log.signals) or 'nothing'}" for log in logs)
        raise ValueError(
            f"logs tell nothing ({have}): give voltage and current for the winding, or torque, current or voltage with "
            "a position or velocity that moves for the shaft"
        )
    twice = sorted({*known} & {*estimated})
    if twice:
        raise ValueError(f"{', '.join(twice)}: both known and estimated, must be one of them; leave the other out")
    possible = [name for name, only in ESTIMABLE.items() if only is None or only == driven_by]
    if driven_by is not None or estimated:
        check_names(estimated, possible, f"parameter of a shaft under a {driven_by}", "estimated.")
    if moving and _common(moving, *OUTPUTS) is None:
        have = "; ".join(f"{log.name}: {'position' if log.has('position') else 'velocity'}" for log in moving)
        raise ValueError(f"logs tell different things ({have}): give all that move a position, or all a velocity")
    rare = [log for log in moving if log.step > RAREST]
    if rare:
        raise ValueError(
            f"log {rare[0].name}: a row every {rare[0].step:.3g} s, must be at most {RAREST:g} s; log more often"
        )
    if rig is None and "mgl" not in known and driven_by is not None:
        raise ValueError(
            "rig is not given (--rig on the command line, rig= in Python): what the output moves decides what is "
            "fitted, must be pendulum, free or load; a motor on its own is free, with load_inertia=0 known"
        )
    return known


def foreseen(logs: Sequence[Log], known: Mapping[str, float], base: Mapping[str, Any] | None) -> str | None:
    """What will be missing for an actuator however well logs are fitted, by their signals; None: nothing."""
    moving = [log for log in logs if moves(log)]
    driven_by = _common(moving, *INPUTS)
    names = {*known, *(("resistance", "inductance") if _electrical(logs) else ())}
    names |= {"resistance"} if driven_by == "voltage" else set()
    constants = {"torque_constant", "back_emf_constant"}
    if names & constants or driven_by == "voltage" or (_electrical(logs) and moving):
        names |= constants
    if "load_inertia" in known and driven_by is not None:
        names |= {"rotor_inertia"}
    return missing(names, base)


def _electrical(logs: Sequence[Log]) -> list[Log]:
    return [log for log in logs if log.has("voltage", "current")]


def _common(logs: Sequence[Log], *names: str) -> str | None:
    """The first of these signals that all logs have."""
    return next((name for name in names if logs and all(log.has(name) for log in logs)), None)


def _constant(
    given: Mapping[str, float], winding: Fitted | None, driven_by: str, estimated: Sequence[str]
) -> dict[str, float]:
    """The back-EMF constant where it stands for the torque constant, which it is in SI units but for losses."""
    if driven_by != "current" or "torque_constant" in {*given, *estimated}:
        return {}
    if "back_emf_constant" in given:
        return {"torque_constant": given["back_emf_constant"]}
    found = {} if winding is None else winding.model.all_values(winding.fit.values)
    return {"torque_constant": found["back_emf_constant"]} if found.get("back_emf_constant", 0.0) > 0.0 else {}


def _with_constant(found: list[Estimate], constant: Estimate | None, stage: Shaft) -> list[Estimate]:
    """Estimates of a shaft under a current whose torque constant was itself found: they are no better than that."""
    if constant is None:
        return found
    made = [
        Estimate("torque_constant", constant.value, constant.low, constant.high, constant.status,
                 f"taken as the back-EMF constant{': ' + constant.why if constant.why else ''}", constant.causes)
    ]  # fmt: skip
    relative = max(constant.high - constant.value, constant.value - constant.low) / max(constant.value, 1e-12)
    anchored = "mgl" in stage.known or "inertia" in stage.known
    for one in found:
        own = one.value * relative if one.name not in ("gear_efficiency", "stribeck_speed") and not anchored else 0.0
        low, high = one.value - math.hypot(one.value - one.low, own), one.value + math.hypot(one.high - one.value, own)
        status, why = one.status, one.why
        if status in ("identified", "rough") and constant.status not in ("identified", "given"):
            status, why = "refused", f"the torque constant that it is in proportion to is {constant.status}"
        ends = max(low, PARAMETERS[one.name].least), min(high, PARAMETERS[one.name].most)
        made.append(Estimate(one.name, one.value, *ends, status, why, {**one.causes, "torque_constant": own}))
    return made


def _judged(part: Fitted, seed: int, on_step: Callable[[], None]) -> list[Estimate]:
    """Every free parameter of a stage with its interval and status, and their sum where they are friction."""
    fit, model = part.fit, part.model
    if not fit.names:
        return []
    friction = _Friction.of(part)
    # what a change is measured by: the value itself or, of friction, what would be all of it
    scales = [
        friction.all_of(name) if name in FRICTION else abs(value)
        for name, value in zip(fit.names, fit.values, strict=True)
    ]
    scales = np.maximum(scales, 1e-6 * model.scales)
    slopes = np.array([friction.slopes.get(name, 0.0) for name in fit.names])
    names, of = fit.names, np.eye(len(fit.names))
    values, sizes, units = fit.values, scales, model.scales
    if any(slopes):
        names, of = (*names, "friction_torque"), np.vstack([of, slopes])
        values = np.append(values, friction.torque)
        sizes, units = (np.append(one, friction.all_of("friction_torque")) for one in (sizes, units))
    causes = honesty.half_widths(fit, part.segments, scales, of, seed)
    on_step()
    tested = values + of @ (part.self_test() - fit.values)
    on_step()
    # an error that goes with a row's time is half as large at the rate of the logs, one with its root more than that
    electrical = isinstance(part.stage, Winding)
    causes["half_rate"] = (2.0 if electrical else 1.0) * np.abs(of @ (part.half_rate() - fit.values))
    on_step()
    causes["self_test"] = np.abs(tested - values)
    causes["unexplained"] = np.abs(values) * (honesty.unexplained(fit, part.segments) if electrical else 0.0)
    directions = part.unknown_directions(scales)
    on_step()
    together = [
        {**one, "friction_torque": change}
        for one in directions
        if abs(change := float(slopes * scales @ [one.get(name, 0.0) for name in fit.names] / sizes[-1])) > PART
    ]
    made = []
    halves = np.hypot(honesty.total(causes), [NARROWEST_OF.get(name, NARROWEST) for name in names] * values)
    summed = any(slopes) and bool(halves[-1] <= NARROW * values[-1])
    for place, (name, value, half) in enumerate(zip(names, map(float, values), map(float, halves), strict=True)):
        widest = WIDEST_OF.get(name, WIDEST) if electrical else WIDEST
        if name in FRICTION and summed:  # what one takes too little of, the other takes
            widest = 1.0
        least, most = PARAMETERS[name].least, PARAMETERS[name].most
        by_cause = {cause: float(several[place]) for cause, several in causes.items()}
        share = half / sizes[place]
        own = together if name == "friction_torque" else [one for one in directions if name in one]
        none = most if name == "gear_efficiency" else least
        nothing = name in FRICTION and abs(value - none) <= AT_BOUND * units[place]
        at_bound = min(value - least, most - value) <= AT_BOUND * units[place]
        worst = CAUSES[max(by_cause, key=lambda cause: by_cause[cause])]
        status: Status = "identified"
        why = ""
        if own and (len(own[0]) > 1):
            status, why = "ratio", _text(own[0])
        elif own:
            status, why = "unidentifiable", "the logs are as likely whatever it is"
        elif at_bound and not nothing:
            status, why = "refused", f"it ended at its bound, {value:g} {PARAMETERS[name].unit}".strip()
        elif math.isinf(by_cause["resampling"]):
            status, why = "refused", f"there are no two stretches of {BLOCK:g} s to resample: give a longer log"
        elif not by_cause["self_test"] <= BIASED * widest * sizes[place]:
            status = "refused"
            why = f"the self-test finds {tested[place]:.4g} where the fit that it simulates has {value:.4g}"
        elif not share <= widest:
            status = "refused"
            whole = "all friction" if name in FRICTION else "it"
            why = f"its interval is {100.0 * share:.3g} % of {whole} to either side, mostly because {worst}"
        elif name in FRICTION and not half <= NARROW * abs(value - none):
            status = "rough"
            why = f"its interval is {100.0 * share:.3g} % of all friction to either side"
            why += ", and more of itself" if name != "friction_torque" else ""
        made.append(Estimate(name, value, max(value - half, least), min(value + half, most), status, why, by_cause))
    return made


class _Friction(NamedTuple):
    """All friction at the root mean square of a shaft's speeds and torques, at the rotor."""

    torque: float
    """[N*m]"""
    slopes: Mapping[str, float]
    """How it changes with each kind of friction."""
    least: float
    """Torque [N*m] that is little beside what drives: less friction is as good as none."""

    def all_of(self, name: str) -> float:
        """How much of one kind would be all of it."""
        found = (self.torque + self.least) / abs(self.slopes.get(name, 1.0))
        return min(found, 1.0) if name == "gear_efficiency" else found

    @classmethod
    def of(cls, part: Fitted) -> "_Friction":
        """That of what was fitted; of a winding none."""
        if isinstance(part.stage, Winding):
            return cls(0.0, {}, 0.0)
        model, number = part.model, part.model.all_values(part.fit.values)
        every = [slice(None, None, max(len(one.times) // 20, 1)) for one in part.segments]
        speeds = np.concatenate(
            [
                one.measured if model.output == "velocity" else np.diff(one.measured[rows]) / np.diff(one.times[rows])
                for one, rows in zip(part.segments, every, strict=True)
            ]
        )
        speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-9) * number["gear_ratio"]
        inputs = np.concatenate([one.inputs for one in part.segments])
        torque = float(np.sqrt(np.mean(inputs**2))) * model.moved(part.fit.values).gain / number["gear_ratio"]
        slopes = {"coulomb_friction": 1.0, "viscous_friction": speed, "gear_efficiency": -torque}
        lost = slopes["gear_efficiency"] * (number["gear_efficiency"] - 1.0)
        return cls(number["coulomb_friction"] + number["viscous_friction"] * speed + lost, slopes, 1e-2 * torque)


def _text(direction: Mapping[str, float]) -> str:
    moves = ", ".join(
        f"{name} by {100.0 * share:+.0f} %{' of all friction' if name in FRICTION else ''}"
        for name, share in direction.items()
    )
    return f"only their relation is known: the fit stays as good if all change together, {moves}"


def _completed(estimates: list[Estimate], given: Mapping[str, float]) -> list[Estimate]:
    """With what was given, and what follows of both."""
    named = {one.name: one for one in estimates}
    for name, value in given.items():
        named[name] = Estimate(name, value, value, value, "given")
    constants = {"torque_constant": "torque constant", "back_emf_constant": "back-EMF constant"}
    for name, other in zip(constants, reversed(constants), strict=True):
        if name not in named and other in named:
            why = f"taken as the {constants[other]}{': ' + named[other].why if named[other].why else ''}"
            named[name] = dataclasses.replace(named[other], name=name, why=why)
    ratio = given.get("gear_ratio", DEFAULTS["gear_ratio"])
    if "inertia" in named and "load_inertia" in given and "rotor_inertia" not in given:
        named["rotor_inertia"] = _rotor_inertia(named["inertia"], given["load_inertia"], ratio)
    return [named[name] for name in PARAMETERS if name in named]


def _rotor_inertia(whole: Estimate, load: float, ratio: float) -> Estimate:
    value, low, high = ((one - load) / ratio**2 for one in (whole.value, whole.low, whole.high))
    status, why = whole.status, whole.why
    if status == "identified" and not high - value <= WIDEST * value:
        status = "refused"
        why = (
            f"of an inertia of {whole.value:.4g} kg*m^2 in all, {load:.4g} is said to be the load's: too little is left"
        )
    return Estimate("rotor_inertia", max(value, 0.0), max(low, 0.0), max(high, 0.0), status, why)


def _warnings(part: Fitted, shares: dict[str, float]) -> list[str]:
    """What is wrong with logs, or with the model of them; `shares` gets what is unexplained of each such log."""
    unlike = {}
    for place, log in enumerate(part.logs):
        own = [index for index, segment in enumerate(part.segments) if segment.log == place]
        sizes = np.concatenate([np.abs(part.fit.residuals[index]) for index in own])
        rest = np.concatenate([part.fit.residuals[i] * part.segments[i].deviation for i in own])
        swing = np.concatenate([part.segments[i].measured - part.segments[i].measured.mean() for i in own])
        share = float(np.std(rest) / max(np.std(swing), 1e-12))
        if sizes.mean() / 0.8 > UNEXPLAINED and share > UNLIKE:
            shares[log.name] = max(share, shares.get(log.name, 0.0))
            unlike[log.name] = (
                f"{sizes.mean() / 0.8:.1f} standard deviations of the sensor, {100.0 * share:.2g} % of what moves"
            )
    found = []
    if 1 < len(unlike) == len(part.logs):
        found.append(
            "the model does not explain any of the logs within what their sensors see: of the first, residuals are "
            f"{next(iter(unlike.values()))}. Fit more friction, or find out what else moved"
        )
    else:
        found += [
            f"log {name}: residuals are {text} in the mean: the model does not explain it. Leave it out, find out what "
            "else moved, or fit more friction"
            for name, text in unlike.items()
        ]
    values = np.array([one.values for one in part.tried])
    costs = np.array([np.mean(np.abs(np.concatenate(one.residuals))) for one in part.tried])
    near = costs < 1.1 * costs.min()
    apart = np.ptp(values[near], axis=0) / np.maximum(np.abs(part.fit.values), part.model.scales)
    if np.any(apart > 0.2):
        names = ", ".join(name for name, one in zip(part.fit.names, apart, strict=True) if one > 0.2)
        found.append(f"several minima: starts ended within 10 % of the best cost, but apart in {names}")
    return found


def _predictions(shaft: Fitted | None, logs: Sequence[Log]) -> tuple[Prediction, ...]:
    if shaft is None:
        return ()
    model, driven_by = shaft.model, shaft.model.driven_by
    return tuple(
        predict(model, shaft.fit.values, shifted(log, driven_by, shaft.delay))
        for log in logs
        if log.has(driven_by, model.output)
    )
