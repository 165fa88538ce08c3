"""From logs to a motor: which parts can be fitted, what is found, and how far it may be trusted."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.fields import check_names
from codrl_mj.identify.estimate import Fit, fitted, refit, refitted, search
from codrl_mj.identify.log import SEGMENT, Log, moves, obstacle, shifted, usage
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import ESTIMABLE, OF_RIG, PARAMETERS
from codrl_mj.identify.result import Identified, Prediction, fitted_traces, missing, predict
from codrl_mj.identify.trust import correlations, judged

STEPS_OF_A_PART = 8 + 4


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
        logs: to fit, at least one, as they are: `check` says what is wrong with one. Voltage and current tell the
            winding; torque or current, or else voltage, and position or velocity tell the shaft.
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
    electrical, moving, driven_by, output = usage(logs)
    total = STEPS_OF_A_PART * max(bool(electrical) + bool(moving), 1) + 4 * len(moving) * (friction == "auto")
    done = itertools.count(1)

    def step(what: str) -> Callable[[], None]:
        return lambda: on_progress(what, min(next(done), total), total)

    # the winding, and the shaft by the torque constant that the winding tells; then each again, beside the other
    parts: dict[str, Fit] = {}
    if electrical:
        parts["winding"] = fitted(WindingModel(known=given), electrical, step("winding"))
    if driven_by:
        shaft = ShaftModel(rig=rig, friction="coulomb", driven_by=driven_by, output=output, known=given,
                           estimated=tuple(estimated), segment=segment)  # fmt: skip
        shaft = with_friction(_told(shaft, parts.get("winding")), moving, friction, step("friction"))
        friction = shaft.friction
        parts["shaft"] = fitted(shaft, moving, step("shaft"))
        if electrical and driven_by != "voltage":
            parts["winding"] = refitted(parts["winding"], WindingModel(known=given, shaft=parts["shaft"]))
        shaft = _told(dataclasses.replace(shaft, known=given), parts.get("winding"))
        parts["shaft"] = refitted(parts["shaft"], shaft)
    estimates, warnings, unexplained = judged(parts, given, seed, step)
    volts = [log.signals[name] for log in logs for name in ("voltage", "bus") if log.has(name)]
    return Identified(
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
        correlations={name: correlations(parts[name]) if name in parts else {} for name in ("winding", "shaft")},
        supply=max((float(np.abs(one).max()) for one in volts), default=None),
        unexplained=unexplained,
    )


def _told(shaft: ShaftModel, winding: Fit | None) -> ShaftModel:
    """The shaft, with the back-EMF constant for a torque constant that is not known: but for losses they are equal."""
    numbers = shaft.known if winding is None else winding.model.all_values(winding.values)
    constant = numbers.get("back_emf_constant", 0.0)
    if shaft.driven_by != "current" or "torque_constant" in (*shaft.known, *shaft.estimated) or not constant > 0.0:
        return shaft
    return dataclasses.replace(shaft, known={**shaft.known, "torque_constant": constant})


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
    _, moving, driven_by, output = usage(logs)
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
    if found := obstacle(logs):
        have = "; ".join(f"{log.name}: {', '.join(log.signals) or 'nothing'}" for log in logs)
        raise ValueError(f"{found.message}; {found.remedy} (logs and their signals: {have})")
    twice = sorted({*known} & {*estimated})
    if twice:
        raise ValueError(f"{', '.join(twice)}: both known and estimated, must be one of them; leave the other out")
    possible = [name for name, only in ESTIMABLE.items() if only is None or only == driven_by]
    if driven_by is not None or estimated:
        check_names(estimated, possible, f"parameter of a shaft under a {driven_by}", "estimated.")
    if moving and not output:
        have = "; ".join(f"{log.name}: {'position' if log.has('position') else 'velocity'}" for log in moving)
        raise ValueError(f"logs tell different things ({have}): give all that move a position, or all a velocity")
    if rig is None and "mgl" not in known and driven_by is not None:
        raise ValueError(
            "rig is not given (--rig on the command line, rig= in Python): what the output moves decides what is "
            "fitted, must be pendulum, free or load; a motor on its own is free, with load_inertia=0 known"
        )
    return {name: float(value) for name, value in known.items()}


def foreseen(logs: Sequence[Log], known: Mapping[str, float], base: Mapping[str, Any] | None) -> str | None:
    """What will be missing for an actuator however well logs are fitted, by their signals; None: nothing."""
    electrical, moving, driven_by, _ = usage(logs)
    names = {*known, *(("resistance", "inductance") if electrical else ())}
    names |= {"resistance"} if driven_by == "voltage" else set()
    constants = {"torque_constant", "back_emf_constant"}
    if names & constants or driven_by == "voltage" or (electrical and moving):
        names |= constants
    if "load_inertia" in known and driven_by is not None:
        names |= {"rotor_inertia"}
    return missing(names, base)


def _foretold(shaft: Fit | None, logs: Sequence[Log]) -> tuple[Prediction, ...]:
    """What the shaft makes of those of the logs that it is told by."""
    if shaft is None:
        return ()
    driven_by, output = shaft.model.driven_by, shaft.model.output
    told = [log for log in logs if moves(log) and log.has(driven_by, output)]
    return tuple(predict(shaft, shifted(log, driven_by, shaft.delay)) for log in told)


def foretold(model: ShaftModel, logs: Sequence[Log], on_step: Callable[[], None]) -> np.ndarray:
    """Mean absolute error on each log of the fit to all others, from that to all, shape (n,)."""
    segments = model.segments(logs)
    model, starts = model.begun(segments)
    whole, errors = search(model, segments, starts[:2])[0].values, []
    for place, log in enumerate(logs):
        found = predict(refit(model, model.segments([*logs[:place], *logs[place + 1 :]]), whole, 12), log)
        errors.append(found.open_loop if found.closed_loop is None else found.closed_loop)
        on_step()
    return np.array(errors)


def with_friction(model: ShaftModel, logs: Sequence[Log], wanted: str, on_step: Callable[[], None]) -> ShaftModel:
    """The model with the friction that is wanted or, for `auto`, with what leaving out one log at a time speaks for.

    More than viscous and Coulomb friction is kept where the errors on the logs left out fall by more, in the mean, than
    two standard deviations of that mean. With fewer than three logs none is.
    """
    if wanted != "auto":
        return dataclasses.replace(model, friction=wanted)
    if len(logs) < 3:
        return model
    best, least = model, foretold(model, logs, on_step)
    for friction in ("load", "stribeck", "both"):
        tried = dataclasses.replace(model, friction=friction)
        errors = foretold(tried, logs, on_step)
        gained = least - errors
        if gained.mean() > 2.0 * gained.std(ddof=1) / np.sqrt(len(gained)):
            best, least = tried, errors
    return best
