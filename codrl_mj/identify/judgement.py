"""What may be trusted of a fit: every number's interval by its causes, its status, and what is wrong with the logs."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codrl_mj.identify import honesty
from codrl_mj.identify.estimate import Fit
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import DEFAULTS, FRICTION, PARAMETERS
from codrl_mj.identify.result import Estimate, Status
from codrl_mj.identify.segments import BLOCK

WIDEST = 0.3
"""An interval of more than this share of the value to either side is too wide; of the whole friction, for friction."""
WIDEST_OF = {"resistance": 0.05, "back_emf_constant": 0.05, "inductance": 0.15}  # for what a current sensor tells
NARROWEST = 0.002
"""No interval is narrower than this share of the value to either side: nobody's sensors are better calibrated."""
NARROWEST_OF = {"inductance": 0.02}
"""What comes of a fifth of a row's time: neither stamps nor a held back-EMF are better."""
NARROW = 0.1
"""Friction whose interval is a larger share of itself is a rough number: what is sure is how much of all it may be."""
BIASED = 0.5  # the self-test fails where it is off by more than this share of the widest interval
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
AT_BOUND = 1e-3  # nearer to a bound, in the parameter's scale, a value is at it
UNEXPLAINED = 8.0  # residuals of more standard deviations of the sensor in the mean are no noise,
UNLIKE = 0.02
"""and more than this share of what moves within a segment is not explained: the log is bad, or the model is."""


def judged(
    parts: Mapping[str, Fit], given: Mapping[str, float], seed: int, step: Callable[[str], Any]
) -> tuple[list[Estimate], list[str], float]:
    """Every number that was found, given or follows, warnings, and the largest share of a log that is not explained."""
    estimates: list[Estimate] = []
    warnings: list[str] = []
    unlike: dict[str, float] = {}
    for name, fit in parts.items():
        found, known = _of_part(fit, seed, step(name)), fit.model.known
        if "torque_constant" in known and "torque_constant" not in given:  # it is the back-EMF constant
            constant = [one for one in estimates if one.name == "back_emf_constant"]
            found = _with_constant(found, constant[0], known) if constant else found
        estimates += found
        warnings += _warnings(fit, unlike)
    return _completed(estimates, given), warnings, max(unlike.values(), default=0.0)


def _of_part(fit: Fit, seed: int, on_step: Callable[[], None]) -> list[Estimate]:
    """Every free parameter of a part with its interval and status, and their sum where they are friction."""
    model, names = fit.model, fit.model.names
    if not names:
        return []
    friction, slopes_of, all_of = _friction(fit)
    # what a change is measured by: the value itself or, of friction, what would be all of it
    own = [all_of[name] if name in FRICTION else abs(fit.values[place]) for place, name in enumerate(names)]
    scales = np.maximum(own, 1e-6 * model.scales)
    slopes, of = np.array([slopes_of.get(name, 0.0) for name in names]), np.eye(len(names))
    values, sizes, units = fit.values, scales, model.scales
    if any(slopes):
        names, of, values = (*names, "friction_torque"), np.vstack([of, slopes]), np.append(values, friction)
        sizes, units = (np.append(one, all_of["friction_torque"]) for one in (sizes, units))
    causes, tested = honesty.causes(fit, values, scales, of, seed, on_step)
    directions = honesty.unknown_directions(fit, scales)
    on_step()
    changes = [slopes * scales @ [one.get(name, 0.0) for name in model.names] / sizes[-1] for one in directions]
    summed = [
        {**one, "friction_torque": float(change)}
        for one, change in zip(directions, changes, strict=True)
        if abs(change) > honesty.PART
    ]
    halves = np.hypot(honesty.total(causes), [NARROWEST_OF.get(name, NARROWEST) for name in names] * values)
    widest = {name: WIDEST_OF.get(name, WIDEST) if isinstance(model, WindingModel) else WIDEST for name in names}
    if any(slopes) and halves[-1] <= NARROW * values[-1]:  # what one takes too little of, the other takes
        widest |= {name: 1.0 for name in names if name in FRICTION}
    made = []
    for place, (name, value, half) in enumerate(zip(names, map(float, values), map(float, halves), strict=True)):
        ends = max(value - half, PARAMETERS[name].least), min(value + half, PARAMETERS[name].most)
        by_cause = {cause: float(several[place]) for cause, several in causes.items()}
        estimate = Estimate(name, value, *ends, "identified", "", by_cause)
        together = summed if name == "friction_torque" else [one for one in directions if name in one]
        status: Status = "ratio"
        if together and len(together[0]) > 1:
            why = _text(together[0])
        elif together:
            status, why = "unidentifiable", "the logs are as likely whatever it is"
        else:
            status, why = _verdict(estimate, half, sizes[place], units[place], widest[name], tested[place])
        made.append(dataclasses.replace(estimate, status=status, why=why))
    return made


def _verdict(
    found: Estimate, half: float, size: float, unit: float, widest: float, tested: float
) -> tuple[Status, str]:
    """Status of a number and why; half its interval is held against `size`, its nearness to a bound against `unit`."""
    name, value, least, most = found.name, found.value, PARAMETERS[found.name].least, PARAMETERS[found.name].most
    none, share = most if name == "gear_efficiency" else least, 100.0 * half / size
    at_bound = min(value - least, most - value) <= AT_BOUND * unit
    if at_bound and not (name in FRICTION and abs(value - none) <= AT_BOUND * unit):
        return "refused", f"it ended at its bound, {value:g} {found.unit}".strip()
    if math.isinf(found.causes["resampling"]):
        return "refused", f"there are no two stretches of {BLOCK:g} s to resample: give a longer log"
    if not found.causes["self_test"] <= BIASED * widest * size:
        return "refused", f"the self-test finds {tested:.4g} where the fit that it simulates has {value:.4g}"
    if not half / size <= widest:
        whole, worst = "all friction" if name in FRICTION else "it", max(found.causes, key=found.causes.__getitem__)
        why = f"its interval is {share:.3g} % of {whole} to either side, mostly because {CAUSES[worst]}"
        return "refused", why
    if name in FRICTION and not half <= NARROW * abs(value - none):
        more = ", and more of itself" if name != "friction_torque" else ""
        return "rough", f"its interval is {share:.3g} % of all friction to either side{more}"
    return "identified", ""


def _with_constant(found: list[Estimate], constant: Estimate, known: Mapping[str, float]) -> list[Estimate]:
    """Estimates of a shaft under a current whose torque constant was itself found: they are no better than that."""
    made = []
    relative = max(constant.high - constant.value, constant.value - constant.low) / max(constant.value, 1e-12)
    anchored = "mgl" in known or "inertia" in known
    for one in found:
        own = one.value * relative if one.name not in ("gear_efficiency", "stribeck_speed") and not anchored else 0.0
        low = max(one.value - math.hypot(one.value - one.low, own), PARAMETERS[one.name].least)
        high = min(one.value + math.hypot(one.high - one.value, own), PARAMETERS[one.name].most)
        one = dataclasses.replace(one, low=low, high=high, causes={**one.causes, "torque_constant": own})
        if one.status in ("identified", "rough") and constant.status not in ("identified", "given"):
            why = f"the torque constant that it is in proportion to is {constant.status}"
            one = dataclasses.replace(one, status="refused", why=why)
        made.append(one)
    return made


def _friction(fit: Fit) -> tuple[float, dict[str, float], dict[str, float]]:
    """All friction [N*m] at the rotor, how it changes with each kind, and how much of a kind would be all of it.

    At the root mean square of a shaft's speeds and torques; a hundredth of what drives is as good as none.
    """
    if not isinstance(model := fit.model, ShaftModel):
        return 0.0, {}, {}
    number = model.all_values(fit.values)
    every = [slice(None, None, max(len(one.times) // 20, 1)) for one in fit.segments]
    speeds = np.concatenate(
        [
            one.measured if model.output == "velocity" else np.diff(one.measured[rows]) / np.diff(one.times[rows])
            for one, rows in zip(fit.segments, every, strict=True)
        ]
    )
    speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-9) * number["gear_ratio"]
    inputs = np.concatenate([one.inputs for one in fit.segments])
    torque = float(np.sqrt(np.mean(inputs**2))) * model.moved(fit.values).gain / number["gear_ratio"]
    slopes = {"coulomb_friction": 1.0, "viscous_friction": speed, "gear_efficiency": -torque}
    lost = slopes["gear_efficiency"] * (number["gear_efficiency"] - 1.0)
    friction = number["coulomb_friction"] + number["viscous_friction"] * speed + lost
    all_of = {name: (friction + 1e-2 * torque) / max(abs(slopes.get(name, 1.0)), 1e-300) for name in FRICTION}
    return friction, slopes, all_of | {"gear_efficiency": min(all_of["gear_efficiency"], 1.0)}


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
        whole, load = named["inertia"], given["load_inertia"]
        value, low, high = ((one - load) / ratio**2 for one in (whole.value, whole.low, whole.high))
        status, why = whole.status, whole.why
        if status == "identified" and not high - value <= WIDEST * value:
            status = "refused"
            why = f"of an inertia of {whole.value:.4g} kg*m^2 in all, {load:.4g} is said to be the load's"
            why += ": too little is left"
        ends = max(low, 0.0), max(high, 0.0)
        named["rotor_inertia"] = Estimate("rotor_inertia", max(value, 0.0), *ends, status, why)
    return [named[name] for name in PARAMETERS if name in named]


def _warnings(fit: Fit, shares: dict[str, float]) -> list[str]:
    """What is wrong with logs, or with the model of them; `shares` gets what is unexplained of each such log."""
    unlike: dict[str, str] = {}
    for place, log in enumerate(fit.logs):
        own = [pair for pair in zip(fit.segments, fit.residuals, strict=True) if pair[0].log == place]
        sizes = np.concatenate([np.abs(residuals) for _, residuals in own])
        rest = np.concatenate([residuals * segment.deviation for segment, residuals in own])
        swing = np.concatenate([segment.measured - segment.measured.mean() for segment, _ in own])
        share = float(np.std(rest) / max(np.std(swing), 1e-12))
        if sizes.mean() / 0.8 > UNEXPLAINED and share > UNLIKE:
            shares[log.name] = max(share, shares.get(log.name, 0.0))
            unlike[log.name] = (
                f"{sizes.mean() / 0.8:.1f} standard deviations of the sensor, {100.0 * share:.2g} % of what moves"
            )
    found = []
    if 1 < len(unlike) == len(fit.logs):
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
    values = np.array([one.values for one in fit.tried])
    costs = np.array([np.mean(np.abs(np.concatenate(one.residuals))) for one in fit.tried])
    near = costs < 1.1 * costs.min()
    apart = np.ptp(values[near], axis=0) / np.maximum(np.abs(fit.values), fit.model.scales)
    if np.any(apart > 0.2):
        names = ", ".join(name for name, one in zip(fit.model.names, apart, strict=True) if one > 0.2)
        found.append(f"several minima: starts ended within 10 % of the best cost, but apart in {names}")
    return found
