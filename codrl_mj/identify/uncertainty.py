"""What may be trusted of a fit: every number's interval by its causes, its status, and what is wrong with the logs.

Intervals from the curvature at the optimum are a lie where the model is not exact, and it never is.
So whole stretches of the logs are resampled, and the interval is widened by what differs between
logs, by what is found when the fit is simulated and fitted again, and by what is found at half the
rate; directions that no data tell are named.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.identify.estimate import Fit, fit_warnings, optimize
from codrl_mj.identify.log import BLOCK_DURATION, Log, halve_rate, has_motion, replace_signal
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import DEFAULTS, FRICTION, OF_WINDING, PARAMETERS
from codrl_mj.identify.result import MAX_UNEXPLAINED, USABLE, Estimate, Status

MIN_LOGS = 5  # from so many logs on whole logs are resampled; below, blocks of them
DRAWS = 500
# of parameters in units in which each alone is known to 1, a direction counts as known to 1e6 at
# worst
FLAT = 1e-12
ATTENUATION = 6.0
"""How much larger than the share of variance that is not explained the bias by errors of the input may be."""
SLACK = 1e-3  # share of the cost that a fit may be better by luck: dry friction has many minima
# a direction in which the parameters may go by so much of themselves, unnoticed, is not identified
UNKNOWN = 0.5
PART = 0.1  # share of such a direction from which a parameter belongs to it
WIDEST = 0.3
"""An interval of more than this share of the value to either side is too wide; of the whole friction, for friction."""
NARROW_OF = {
    "resistance": 0.05,
    "back_emf_constant": 0.05,
    "torque_constant": 0.05,
    "inductance": 0.15,
}
"""A wider interval of these makes them rough, whichever logs they are from; all else up to `WIDEST` is identified."""
NARROWEST = 0.002
"""No interval is narrower than this share of the value to either side: nobody's sensors are better calibrated."""
NARROWEST_OF = {"inductance": 0.02}
"""What comes of a fifth of a row's time: neither stamps nor a held back-EMF are better."""
NARROW = 0.1
"""Friction whose interval is a larger share of itself is a rough number: what is sure is how much of all it may be."""
# an interval is too wide because of the self-test where that is off by more than this share of the
# widest
BIASED = 0.5
CAUSES = {
    "curvature": "the logs hardly depend on it",
    "resampling": "parts of the logs disagree",
    "logs": "the logs disagree",
    "half_rate": "every second row tells another value",
    "self_test": "a fit to its own simulation does not find it again",
    "unexplained": "the current is not explained",
    "torque_constant": "the winding's constant that it follows from is not known better",
}
"""What widens an interval, in words."""
AT_BOUND = 1e-3  # nearer to a bound, in the parameter's scale, a value is at it


def assess_fits(
    parts: Mapping[str, Fit],
    given: Mapping[str, float],
    defaults: Mapping[str, float],
    seed: int,
    step: Callable[[str], Any],
) -> tuple[list[Estimate], list[str], float]:
    """Every number that was found, given or follows, warnings, and the largest share of a log that is not explained.

    Where that share is over `MISUNDERSTOOD`, it is not single numbers that are amiss: all that were
    found are refused.
    """
    estimates: list[Estimate] = []
    warnings: list[str] = []
    unlike: dict[str, float] = {}
    for name, fit in parts.items():
        found, known = _of_part(fit, seed, step(name)), fit.model.known
        for taken, source in OF_WINDING.values():
            if taken in known and taken not in given:
                constant = [one for one in estimates if one.name == source]
                found = _with_constant(found, constant[0], known) if constant else found
        estimates += found
        warnings += fit_warnings(fit, unlike)
    completed, unexplained = (
        _completed(estimates, given, defaults),
        max(unlike.values(), default=0.0),
    )
    if unexplained > MAX_UNEXPLAINED:
        why = f"the fit leaves {unexplained:.0%} of what moves in a log unexplained"
        completed = [
            one if one.status == "given" else dataclasses.replace(one, status="refused", why=why)
            for one in completed
        ]
    return completed, warnings, unexplained


def _of_part(fit: Fit, seed: int, on_step: Callable[[], None]) -> list[Estimate]:
    """Every free parameter of a part with its interval and status, and their sum where they are friction."""
    model, names = fit.model, fit.model.names
    if not names:
        return []
    friction, slopes_of, all_of = _friction(fit)
    # what a change is measured by: the value itself or, of friction, what would be all of it
    own = [
        all_of[name] if name in FRICTION else abs(fit.values[place])
        for place, name in enumerate(names)
    ]
    scales = np.maximum(own, 1e-6 * model.scales)
    slopes, of = np.array([slopes_of.get(name, 0.0) for name in names]), np.eye(len(names))
    values, sizes, units = fit.values, scales, model.scales
    if any(slopes):
        names, of, values = (
            (*names, "friction_torque"),
            np.vstack([of, slopes]),
            np.append(values, friction),
        )
        sizes, units = (np.append(one, all_of["friction_torque"]) for one in (sizes, units))
    by_cause, tested = interval_causes(fit, values, scales, of, seed, on_step)
    directions = unidentifiable_directions(fit, scales)
    on_step()
    changes = [
        slopes * scales @ [one.get(name, 0.0) for name in model.names] / sizes[-1]
        for one in directions
    ]
    summed = [
        {**one, "friction_torque": float(change)}
        for one, change in zip(directions, changes, strict=True)
        if abs(change) > PART
    ]
    # the largest of three, and what the rate does, as what is independent adds up; then the biases
    wide = np.max([by_cause[one] for one in ("curvature", "resampling", "logs")], axis=0)
    total = np.hypot(wide, by_cause["half_rate"]) + by_cause["self_test"] + by_cause["unexplained"]
    halves = np.hypot(total, [NARROWEST_OF.get(name, NARROWEST) for name in names] * values)
    widest = dict.fromkeys(names, WIDEST)
    if (
        any(slopes) and halves[-1] <= NARROW * values[-1]
    ):  # what one takes too little of, the other takes
        widest |= {name: 1.0 for name in names if name in FRICTION}
    made = []
    for place, (name, value, half) in enumerate(
        zip(names, map(float, values), map(float, halves), strict=True)
    ):
        ends = max(value - half, PARAMETERS[name].lower), min(value + half, PARAMETERS[name].upper)
        own_causes = {cause: float(several[place]) for cause, several in by_cause.items()}
        estimate = Estimate(name, value, *ends, "identified", "", own_causes)
        together = (
            summed if name == "friction_torque" else [one for one in directions if name in one]
        )
        status: Status = "ratio"
        if together and len(together[0]) > 1:
            told = ", ".join(
                f"{other} by {100.0 * share:+.0f}"
                f" %{' of all friction' if other in FRICTION else ''}"
                for other, share in together[0].items()
            )
            why = (
                "only their relation is known: the fit stays as good if all change together,"
                f" {told}"
            )
        elif together:
            status, why = "unidentifiable", "the logs are as likely whatever it is"
        else:
            status, why = _verdict(
                estimate, half, sizes[place], units[place], widest[name], tested[place]
            )
        made.append(dataclasses.replace(estimate, status=status, why=why))
    return made


def _verdict(
    found: Estimate, half: float, size: float, unit: float, widest: float, tested: float
) -> tuple[Status, str]:
    """Status of a number and why; half its interval is held against `size`, its nearness to a bound against `unit`."""
    name, value, least, most = (
        found.name,
        found.value,
        PARAMETERS[found.name].lower,
        PARAMETERS[found.name].upper,
    )
    none, share = most if name == "gear_efficiency" else least, 100.0 * half / size
    at_bound = min(value - least, most - value) <= AT_BOUND * unit
    if at_bound and not (name in FRICTION and abs(value - none) <= AT_BOUND * unit):
        return "refused", f"it ended at its bound, {value:g} {found.unit}".strip()
    if math.isinf(found.causes["resampling"]):
        return (
            "refused",
            f"there are no two stretches of {BLOCK_DURATION:g} s to resample: give a longer log",
        )
    if not half / size <= widest:
        if not found.causes["self_test"] <= BIASED * widest * size:
            return (
                "refused",
                f"the self-test finds {tested:.4g} where the fit that it simulates has {value:.4g}",
            )
        whole, worst = (
            "all friction" if name in FRICTION else "it",
            max(found.causes, key=found.causes.__getitem__),
        )
        why = (
            f"its interval is {share:.3g} % of {whole} to either side, mostly because"
            f" {CAUSES[worst]}"
        )
        return "refused", why
    if name in FRICTION and not half <= NARROW * abs(value - none):
        more = ", and more of itself" if name != "friction_torque" else ""
        return "rough", f"its interval is {share:.3g} % of all friction to either side{more}"
    if not half <= NARROW_OF.get(name, WIDEST) * size:
        return "rough", f"its interval is {share:.3g} % of it to either side: train across it"
    return "identified", ""


def _with_constant(
    found: list[Estimate], constant: Estimate, known: Mapping[str, float]
) -> list[Estimate]:
    """Estimates of a shaft with a constant of the winding that was itself found: they are no better than that."""
    made: list[Estimate] = []
    relative = max(constant.high - constant.value, constant.value - constant.low) / max(
        constant.value, 1e-12
    )
    anchored = "mgl" in known or "inertia" in known
    for one in found:
        fixed = one.name in ("gear_efficiency", "stribeck_speed") or (
            anchored and one.name != "torque_constant"
        )
        own = 0.0 if fixed else one.value * relative
        low = max(one.value - math.hypot(one.value - one.low, own), PARAMETERS[one.name].lower)
        high = min(one.value + math.hypot(one.high - one.value, own), PARAMETERS[one.name].upper)
        one = dataclasses.replace(
            one, low=low, high=high, causes={**one.causes, "torque_constant": own}
        )
        if one.status in ("identified", "rough") and constant.status not in USABLE:
            why = f"the {constant.name.replace('_', ' ')} that it follows from is {constant.status}"
            one = dataclasses.replace(one, status="refused", why=why)
        made.append(one)
    return _rejudged(made)


def _rejudged(found: list[Estimate]) -> list[Estimate]:
    """Return estimates with the status of their widened intervals; each kind of friction is as good as all of it."""
    shares = {one.name: (one.high - one.value) / max(abs(one.value), 1e-300) for one in found}
    made = []
    for one in found:
        share = shares.get("friction_torque", 0.0) if one.name in FRICTION else shares[one.name]
        why = (
            f"its interval is {100.0 * share:.3g} % of it to either side, mostly because"
            f" {CAUSES['torque_constant']}"
        )
        if one.causes["torque_constant"] > 0.0 and one.status in ("identified", "rough"):
            if share > WIDEST:
                one = dataclasses.replace(one, status="refused", why=why)
            elif one.status == "identified" and one.name in FRICTION and share > NARROW:
                one = dataclasses.replace(one, status="rough", why=why)
        made.append(one)
    return made


def _friction(fit: Fit) -> tuple[float, dict[str, float], dict[str, float]]:
    """All friction [N*m] at the rotor, how it changes with each kind, and how much of a kind would be all of it.

    At the root mean square of a shaft's speeds and torques; a hundredth of what drives is as good
    as none.
    """
    if not isinstance(model := fit.model, ShaftModel):
        return 0.0, {}, {}
    number = model.all_values(fit.values)
    every = [slice(None, None, max(len(one.times) // 20, 1)) for one in fit.segments]
    speeds = np.concatenate(
        [
            (
                one.measured
                if model.output == "velocity"
                else np.diff(one.measured[rows]) / np.diff(one.times[rows])
            )
            for one, rows in zip(fit.segments, every, strict=True)
        ]
    )
    speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-9) * number["gear_ratio"]
    inputs = np.concatenate([one.inputs for one in fit.segments])
    torque = (
        float(np.sqrt(np.mean(inputs**2))) * model.shaft_parameters(fit.values).gain / number["gear_ratio"]
    )
    slopes = {"coulomb_friction": 1.0, "viscous_friction": speed, "gear_efficiency": -torque}
    lost = slopes["gear_efficiency"] * (number["gear_efficiency"] - 1.0)
    friction = number["coulomb_friction"] + number["viscous_friction"] * speed + lost
    all_of = {
        name: (friction + 1e-2 * torque) / max(abs(slopes.get(name, 1.0)), 1e-300)
        for name in FRICTION
    }
    return friction, slopes, all_of | {"gear_efficiency": min(all_of["gear_efficiency"], 1.0)}


def _completed(
    estimates: list[Estimate], given: Mapping[str, float], defaults: Mapping[str, float]
) -> list[Estimate]:
    """With what was given, by a base too, and what follows of both."""
    named = {one.name: one for one in estimates}
    for name, value in given.items():
        named[name] = Estimate(name, value, value, value, "given")
    for name, value in defaults.items():
        if name in PARAMETERS and name not in named and value != DEFAULTS[name]:
            named[name] = Estimate(
                name, value, value, value, "given", "the motor's, which the fit took as known"
            )
    constants = {"torque_constant": "torque constant", "back_emf_constant": "back-EMF constant"}
    for name, other in zip(constants, reversed(constants), strict=True):
        if name not in named and other in named:
            why = (
                "taken as the"
                f" {constants[other]}{': ' + named[other].why if named[other].why else ''}"
            )
            named[name] = dataclasses.replace(named[other], name=name, why=why)
    ratio = given.get("gear_ratio", DEFAULTS["gear_ratio"])
    if "inertia" in named and "load_inertia" in given and "rotor_inertia" not in given:
        whole, load = named["inertia"], given["load_inertia"]
        value, low, high = ((one - load) / ratio**2 for one in (whole.value, whole.low, whole.high))
        status, why = whole.status, whole.why
        if status in USABLE and not high - value <= WIDEST * value:
            status = "refused"
            share = 100.0 * (high - value) / max(value, 1e-300)
            why = (
                f"less the load's {load:.4g}, the inertia of {whole.value:.4g} kg*m^2 is known to"
                f" {share:.3g} % only"
            )
        ends = max(low, 0.0), max(high, 0.0)
        named["rotor_inertia"] = Estimate("rotor_inertia", max(value, 0.0), *ends, status, why)
    return [named[name] for name in PARAMETERS if name in named]


def _sums(fit: Fit, groups: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (c, p) and Gauss-Newton matrix (c, p, p) of each group of segments."""
    count, size = len(set(groups)), len(fit.values)
    gradients, matrices = np.zeros((count, size)), np.zeros((count, size, size))
    place = {group: index for index, group in enumerate(dict.fromkeys(groups))}
    for index, group in enumerate(groups):
        weighted = fit.jacobians[index] * fit.weights(index)[:, None]
        gradients[place[group]] += weighted.T @ fit.residuals[index]
        matrices[place[group]] += weighted.T @ fit.jacobians[index]
    return gradients, matrices


def _noise(fit: Fit) -> float:
    """Mean square of the residuals, as much as they count."""
    return float(
        np.mean(np.concatenate([fit.weights(i) * r**2 for i, r in enumerate(fit.residuals)]))
    )


def _inverse(matrix: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The inverse, large and never 0 along what is not known; none of it is lost beside what is known far better."""
    known = np.diag(matrix) * scales**2
    units = scales / np.sqrt(np.maximum(known, 1e-16 * known.max() + 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(units, units))
    return np.asarray((vectors / np.maximum(values, FLAT)) @ vectors.T * np.outer(units, units))


def interval_causes(
    fit: Fit,
    values: np.ndarray,
    scales: np.ndarray,
    of: np.ndarray,
    seed: int,
    on_step: Callable[[], None],
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Half-widths by cause of `values` (q,), which are `of` @ the parameters, and what the self-test finds for them."""
    electrical = isinstance(fit.model, WindingModel)
    found = resampled_half_widths(fit, scales, of, seed)
    on_step()
    # two fits to what the fit would have made of its logs, of opposed residuals: in their mean what
    # is random cancels
    tested = values + of @ (
        np.asarray(0.5 * sum(_again(fit, _pretended(fit, sign)) for sign in (1.0, -1.0)))
        - fit.values
    )
    on_step()
    # an error that goes with a row's time is half as large at the rate of the logs, one with its
    # root more than that
    halves = _again(fit, [halve_rate(log) for log in fit.logs])
    found["half_rate"] = (2.0 if electrical else 1.0) * np.abs(of @ (halves - fit.values))
    on_step()
    found["self_test"] = np.abs(tested - values)
    # errors of the input, as of a voltage that changes between the rows, attenuate its factor by a
    # multiple of their share of the variance: 2 to 4.6 of PRBS whose clock is 1 to 4 rows; no fit
    # of fewer rows shows it
    rest = sum(
        one.deviation**2 * float(fit.weights(i) @ fit.residuals[i] ** 2)
        for i, one in enumerate(fit.segments)
    )
    swing = sum(float(np.var(one.measured)) * len(one.measured) for one in fit.segments)
    found["unexplained"] = np.abs(values) * (
        ATTENUATION * rest / max(swing, 1e-300) if electrical else 0.0
    )
    return found, tested


def resampled_half_widths(fit: Fit, scales: np.ndarray, of: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Half-widths of 95 % intervals by cause, each of shape (q,), of `of` @ the parameters with `of` of shape (q, p).

    `curvature`: were the model exact and each residual by itself: never less, however few the
    stretches. `resampling`: by refits of stretches drawn with replacement, each a Gauss-Newton step
    from the fit; few stretches tell little of how they differ, and percentiles are stretched to
    Student's. `logs`: two standard deviations of the mean of how logs pull; 0 for a single log.
    """
    from scipy.stats import t

    by_log, by_block = (
        _sums(fit, [getattr(one, part) for one in fit.segments]) for part in ("log", "block")
    )
    inverse = _inverse(by_block[1].sum(axis=0), scales)
    curvature = 1.96 * np.sqrt(_noise(fit) * np.diag(of @ inverse @ of.T))
    logs, count = np.zeros(len(of)), len(by_log[0])
    if count > 1:
        logs = 2.0 * (count * by_log[0] @ inverse @ of.T).std(axis=0, ddof=1) / np.sqrt(count)
    gradients, matrices = by_log if count >= MIN_LOGS else by_block
    resampling, count = np.full(len(of), np.inf), len(gradients)
    if count > 1:
        drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), DRAWS)
        moved = [
            -_inverse(np.tensordot(times, matrices, 1), scales) @ (times @ gradients)
            for times in drawn
        ]
        low, high = np.percentile(np.array(moved) @ of.T, [2.5, 97.5], axis=0)
        few = t.ppf(0.975, count - 1) / t.ppf(0.975, 1e6) * np.sqrt(count / (count - 1.0))
        resampling = np.maximum(-low, high) * few
    return {"curvature": curvature, "resampling": resampling, "logs": logs}


def correlations(fit: Fit) -> dict[str, dict[str, float]]:
    """Of the parameters, each with each, by the Jacobian: near 1 or -1, one may stand for the other."""
    names = fit.model.names
    if not names:
        return {}
    _, matrices = _sums(fit, [0] * len(fit.residuals))
    covariance = _inverse(matrices[0], np.ones(len(names)))
    spread = np.sqrt(np.diag(covariance))
    table = np.clip(covariance / np.outer(spread, spread), -1.0, 1.0).tolist()
    return {
        name: dict(zip(names, row, strict=True)) for name, row in zip(names, table, strict=True)
    }


def unidentifiable_directions(fit: Fit, scales: np.ndarray) -> list[dict[str, float]]:
    """Directions in which the parameters may go, and nobody would notice: parameter -> share, the largest 1.

    In the direction that the derivatives say is the weakest, the parameter that has most of it is
    moved by half its scale, shape (p,), and all others are fitted anew: if the logs are then
    explained as well, what the others did is the direction. (Derivatives alone do not tell: dry
    friction makes them rough, and what is flat looks known.)
    """
    found: list[dict[str, float]] = []
    here, own = fit, scales
    while len(here.model.names) > 1 or not found:
        model, values = here.model, here.values
        matrix = _sums(here, [one.block for one in here.segments])[1].sum(axis=0)
        direction = np.linalg.eigh(matrix * np.outer(own, own))[1][
            :, 0
        ]  # a unit vector, in the scales
        place = int(np.argmax(np.abs(direction)))
        step = UNKNOWN * own[place] * np.sign(direction[place])
        bounds = PARAMETERS[model.names[place]]
        if not bounds.lower <= values[place] + step <= bounds.upper:
            step = -step
        start = np.clip(
            values + step / own[place] / direction[place] * direction * own, 0.2 * values, None
        )
        rest = dataclasses.replace(
            model,
            names=tuple(np.delete(model.names, place).tolist()),
            known={**model.known, model.names[place]: float(values[place] + step)},
            scales=np.delete(model.scales, place),
        )
        other = optimize(rest, here.segments, np.delete(start, place), 20, here.scale)
        if other.costs(here.scale).sum() > here.cost + _noticed(here):
            break
        changes = (other.values - np.delete(values, place)) / np.delete(own, place)
        shares = np.insert(changes, place, step / own[place]) / step * own[place]
        found.append(
            {name: float(s) for name, s in zip(model.names, shares, strict=True) if abs(s) > PART}
        )
        if len(model.names) == 1:
            break
        here, own = other, np.delete(own, place)
    return found


def _noticed(fit: Fit) -> float:
    """By how much the robust cost must rise to be more than chance, at 95 %.

    Residuals of a block belong together: the ratio of both estimates of the covariance along the
    direction that is known best, by blocks and by rows, makes up for that.
    """
    gradients, matrices = _sums(fit, [segment.block for segment in fit.segments])
    whole = matrices.sum(axis=0)
    root = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    strengths, vectors = np.linalg.eigh(whole / root / root[:, None])
    pulls = gradients / root @ vectors[:, -1]
    noise = _noise(fit)
    together = max(float(pulls @ pulls) / max(strengths[-1] * noise, 1e-30), 1.0)
    return 3.84 * noise * together + SLACK * fit.cost


def _again(fit: Fit, logs: Sequence[Log]) -> np.ndarray:
    """The parameters that other logs give, from where a fit ended."""
    return optimize(fit.model, fit.model.segments(logs), fit.values, 20).values


def _pretended(fit: Fit, sign: float) -> list[Log]:
    """The logs as the fit would have made them, rounded anew; of a winding also what it took for the motion.

    Residuals keep order and size, stretch by stretch with a random sign, so that they belong
    together as in the logs.
    """
    output, simulate = fit.model.output, fit.model.simulator(fit.values)
    signals = [log.signals[output].copy() for log in fit.logs]
    speeds = [np.zeros(len(log.time)) for log in fit.logs]
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(fit.segments)) * sign
    for place, segment in enumerate(fit.segments):
        # what is far off is an outlier of the logs, and no noise of the sensor
        noise = np.clip(fit.residuals[place], -3.0 * fit.scale, 3.0 * fit.scale) * segment.deviation
        signals[segment.log][segment.rows] = (
            simulate(segment, fit.states[place]) + signs[place] * noise
        )
        speeds[segment.log][segment.rows] = segment.speeds
    made = []
    for log, values, speed in zip(fit.logs, signals, speeds, strict=True):
        made.append(_rounded(log, output, values))
        if isinstance(fit.model, WindingModel) and log.has("position") and has_motion(log):
            turns = np.append(0.0, np.cumsum(speed[:-1] * np.diff(log.time)))
            made[-1] = _rounded(made[-1], "position", log.signals["position"][0] + turns)
    return made


def _rounded(log: Log, name: str, values: np.ndarray) -> Log:
    """A log with another signal, rounded as its sensor rounds."""
    step = log.resolution.get(name, 0.0)
    return replace_signal(log, name, np.round(values / step) * step if step > 0.0 else values)
