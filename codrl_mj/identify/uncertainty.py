"""Uncertainty of a fit: interval and status of each parameter, and warnings about the logs.

Intervals from the curvature at the optimum are valid only for an exact model, and no model is
exact. Therefore whole stretches of the logs are resampled. The intervals also include the
differences between logs, the error of a fit to data simulated with the fitted parameters
(self-test), and the change at half the sample rate. Directions in which the parameters cannot be
identified are reported.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import cast

import numpy as np

from codrl_mj.identify.estimate import Fit, Misfit, Model, fit_warnings, optimize
from codrl_mj.identify.invariances import invariant_directions
from codrl_mj.identify.log import BLOCK_DURATION, Log, has_motion, replace_signal
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import (
    DEFAULTS,
    FRICTION,
    MIN_SIZES,
    PARAMETERS,
    WINDING_SOURCES,
)
from codrl_mj.identify.result import MAX_UNEXPLAINED, USABLE, Estimate, Status

MIN_LOGS = 5
"""Minimum number of logs to resample whole logs; with fewer logs, blocks are resampled."""
DRAWS = 500
"""Number of resamplings."""
# The matrix is normalized to a standard error of 1 for each parameter with the others fixed. The
# limit keeps the standard error in every direction below 1e6.
MIN_EIGENVALUE = 1e-12
"""Smallest eigenvalue of a normalized Gauss-Newton matrix that is inverted."""
ATTENUATION = 6.0
"""Upper limit of the relative bias from errors of the input, per unexplained share of variance."""
# Dry friction gives the cost many minima.
SLACK = 1e-3
"""Relative difference of costs that may only come from reaching different minima."""
PROBE_CHANGE = 0.5
"""Relative change of a parameter that tests whether a direction is identifiable."""
MIN_SHARE = 0.1
"""Smallest share of a parameter in a direction that is reported."""
MAX_HALF_WIDTH = 0.3
"""Largest relative half-width of a usable interval; for friction, relative to all friction."""
MAX_IDENTIFIED = {
    "resistance": 0.05,
    "back_emf_constant": 0.05,
    "torque_constant": 0.05,
    "inductance": 0.15,
}
"""Parameter -> largest relative half-width of `identified`; `MAX_HALF_WIDTH` for others."""
# Sensors are not calibrated more accurately than this.
MIN_HALF_WIDTH = 0.002
"""Smallest relative half-width of an interval."""
# Time stamps, and the back-EMF that is held for a row, are uncertain by about a fifth of a row.
MIN_HALF_WIDTHS = {"inductance": 0.02}
"""Parameter -> its smallest relative half-width, if it is not `MIN_HALF_WIDTH`."""
MAX_FRICTION = 0.1
"""Largest relative half-width of a friction parameter with the status `identified`."""
MAX_BIAS = 0.5
"""Self-test error, over the largest usable half-width, above which it is a reason to refuse."""
# The worst log of a real pendulum has 12. Joints of a double pendulum that the other joint moves,
# real and simulated, have 54 to 1200.
MAX_USABLE_RESIDUAL = 30.0
"""Largest mean residual of a poorly explained log, in standard deviations of the sensor, at which
parameters are usable.
"""
CAUSES = {
    "curvature": "the logs hardly depend on it",
    "resampling": "parts of the logs disagree",
    "logs": "the logs disagree",
    "half_rate": "a fit of every second row gives another value",
    "segments": "a fit of segments of another duration gives another value",
    "self_test": "a fit to its own simulation gives another value",
    "unexplained": "the model does not explain the current",
    "torque_constant": "the constant of the winding that it depends on is not known better",
    "limit": "the logs do not tell if the duty is limited, or the torque",
    "loop": "the period of the firmware's loop is unknown",
    "load": "loads are not known more exactly",
    "row": "a row does not show when within it a command is sent",
}
"""Cause of an interval's width -> its description."""
MIN_SEGMENT_ROWS = 20
"""Minimum number of rows in the shorter segments that a fit is compared with."""
BOUND_MARGIN = 1e-3
"""Distance from a bound, in the parameter's scale, below which a value counts as at the bound."""


def assess_fits(
    parts: Mapping[str, Fit[Model]],
    known: Mapping[str, float],
    defaults: Mapping[str, float],
    seed: int,
    step: Callable[[str], Callable[[], None]],
) -> tuple[list[Estimate], list[str], float]:
    """Assess the fits of a winding and a shaft.

    If a log's unexplained share exceeds `MAX_UNEXPLAINED`, all fitted parameters are refused.

    Returns:
        All parameters that are fitted, known or derived, the warnings, and the largest unexplained
        share of a log.
    """
    estimates: list[Estimate] = []
    warnings: list[str] = []
    unexplained_shares: dict[str, float] = {}
    for name, fit in parts.items():
        part_estimates, fixed = _assess_part(fit, seed, step(name)), fit.model.known
        # The shaft was fitted with a constant of the fitted winding, and inherits its uncertainty.
        for parameter, source in WINDING_SOURCES.values():
            if parameter in fixed and parameter not in known:
                constant = [estimate for estimate in estimates if estimate.name == source]
                part_estimates = (
                    _widen_by_constant(part_estimates, constant[0], fixed)
                    if constant
                    else part_estimates
                )
        misfits: dict[str, Misfit] = {}
        warnings += fit_warnings(fit, misfits)
        estimates += _limit_status(part_estimates, misfits)
        for log, misfit in misfits.items():
            unexplained_shares[log] = max(misfit.share, unexplained_shares.get(log, 0.0))
    completed = _complete(estimates, known, defaults)
    unexplained = max(unexplained_shares.values(), default=0.0)
    if unexplained > MAX_UNEXPLAINED:
        reason = f"the fit leaves {unexplained:.0%} of a log's variation unexplained"
        completed = [
            (
                estimate
                if estimate.status == "given"
                else dataclasses.replace(estimate, status="refused", why=reason)
            )
            for estimate in completed
        ]
    return completed, warnings, unexplained


def _limit_status(estimates: list[Estimate], misfits: Mapping[str, Misfit]) -> list[Estimate]:
    """Return estimates, none of them `identified` if the model does not explain a log.

    Parameters of a model that misses a log by far absorb the rest of the motion. They look precise,
    because they do so in all parts of the log.

    Args:
        estimates: estimates of a part.
        misfits: misfit of each log that the model explains poorly.
    """
    if not misfits:
        return estimates
    log = max(misfits, key=lambda name: misfits[name].mean_residual)
    misfit = misfits[log]
    reason = (
        f"the model does not explain log {log}: mean residuals are {misfit.mean_residual:.0f}"
        " standard deviations of the sensor"
    )
    status: Status = "refused" if misfit.mean_residual > MAX_USABLE_RESIDUAL else "rough"
    limited = ("identified", "rough") if status == "refused" else ("identified",)
    return [
        (
            dataclasses.replace(estimate, status=status, why=reason)
            if estimate.status in limited
            else estimate
        )
        for estimate in estimates
    ]


def _assess_part(fit: Fit[Model], seed: int, on_step: Callable[[], None]) -> list[Estimate]:
    """Return a part's free parameters and its total friction, with intervals and status."""
    model, names = fit.model, fit.model.names
    if not names:
        return []
    friction, slopes_by_name, full_friction = _total_friction(fit)
    # Relative errors refer to the value of a parameter. For a friction parameter they refer to the
    # value at which it alone would account for all friction.
    magnitudes = [
        (
            full_friction[name]
            if name in FRICTION
            else max(abs(fit.values[index]), MIN_SIZES.get(name, 0.0))
        )
        for index, name in enumerate(names)
    ]
    scales = np.maximum(magnitudes, 1e-6 * model.scales)
    slopes, matrix = np.array([slopes_by_name.get(name, 0.0) for name in names]), np.eye(len(names))
    values, sizes, units = fit.values, scales, model.scales
    # The total friction is often known better than its components.
    if any(slopes):
        names = (*names, "friction_torque")
        matrix = np.vstack([matrix, slopes])
        values = np.append(values, friction)
        sizes, units = (
            np.append(array, full_friction["friction_torque"]) for array in (sizes, units)
        )
    by_cause, self_test_values = interval_causes(fit, values, scales, matrix, seed, on_step)
    directions = unidentifiable_directions(fit, scales)
    on_step()
    changes = [
        slopes * scales @ [direction.get(name, 0.0) for name in model.names] / sizes[-1]
        for direction in directions
    ]
    friction_directions = [
        {**direction, "friction_torque": float(change)}
        for direction, change in zip(directions, changes, strict=True)
        if abs(change) > MIN_SHARE
    ]
    # The three statistical causes estimate the same errors, so that only the largest one counts.
    # The changes at half the rate and with other segments are independent of them, and are added in
    # squares. Biases are added.
    statistical = np.max([by_cause[cause] for cause in ("curvature", "resampling", "logs")], axis=0)
    total = (
        np.hypot(np.hypot(statistical, by_cause["half_rate"]), by_cause["segments"])
        + by_cause["self_test"]
        + by_cause["unexplained"]
    )
    half_widths = np.hypot(
        total, [MIN_HALF_WIDTHS.get(name, MIN_HALF_WIDTH) for name in names] * values
    )
    max_half_widths = dict.fromkeys(names, MAX_HALF_WIDTH)
    # If the total friction is known well, errors of its components compensate each other.
    if any(slopes) and half_widths[-1] <= MAX_FRICTION * values[-1]:
        max_half_widths |= {name: 1.0 for name in names if name in FRICTION}
    estimates = []
    for index, (name, value, half_width) in enumerate(
        zip(names, map(float, values), map(float, half_widths), strict=True)
    ):
        ends = (
            max(value - half_width, PARAMETERS[name].lower),
            min(value + half_width, PARAMETERS[name].upper),
        )
        causes = {cause: float(widths[index]) for cause, widths in by_cause.items()}
        estimate = Estimate(name, value, *ends, "identified", "", causes)
        ambiguities = (
            friction_directions
            if name == "friction_torque"
            else [direction for direction in directions if name in direction]
        )
        status: Status = "ratio"
        if ambiguities and len(ambiguities[0]) > 1:
            shares = ", ".join(
                f"{parameter} by {100.0 * share:+.2g}"
                f" %{' of all friction' if parameter in FRICTION else ''}"
                for parameter, share in ambiguities[0].items()
                if abs(share) > MIN_SHARE or parameter == name
            )
            reason = (
                "only a combination is known: the fit is equally good if these change together:"
                f" {shares}"
            )
        elif ambiguities:
            status, reason = "unidentifiable", "the fit is equally good with any value"
        else:
            status, reason = _verdict(
                estimate,
                half_width,
                sizes[index],
                units[index],
                max_half_widths[name],
                self_test_values[index],
            )
        estimates.append(dataclasses.replace(estimate, status=status, why=reason))
    return estimates


def _verdict(
    estimate: Estimate,
    half_width: float,
    size: float,
    unit: float,
    max_half_width: float,
    self_test_value: float,
) -> tuple[Status, str]:
    """Return the status of a parameter, and the reason.

    Args:
        estimate: estimate that has no final status yet.
        half_width: half-width of the interval.
        size: value that relative half-widths refer to.
        unit: scale of the distance from a bound.
        max_half_width: largest usable half-width, relative to `size`.
        self_test_value: value from a fit to data that were simulated with the fitted parameters.
    """
    name = estimate.name
    value = estimate.value
    lower = PARAMETERS[estimate.name].lower
    upper = PARAMETERS[estimate.name].upper
    # A value at this bound means no friction, and is not a sign of a failed fit.
    frictionless, share = upper if name == "gear_efficiency" else lower, 100.0 * half_width / size
    is_at_bound = min(value - lower, upper - value) <= BOUND_MARGIN * unit
    if is_at_bound and not (name in FRICTION and abs(value - frictionless) <= BOUND_MARGIN * unit):
        return "refused", f"it ended at its bound, {value:g} {estimate.unit}".strip()
    if math.isinf(estimate.causes["resampling"]):
        return (
            "refused",
            f"there are no two stretches of {BLOCK_DURATION:g} s to resample: give a longer log",
        )
    if not half_width / size <= max_half_width:
        if not estimate.causes["self_test"] <= MAX_BIAS * max_half_width * size:
            return (
                "refused",
                f"a fit to its own simulation gives {self_test_value:.4g} instead of {value:.4g}",
            )
        reference = "all friction" if name in FRICTION else "it"
        main_cause = max(estimate.causes, key=estimate.causes.__getitem__)
        reason = (
            f"its interval is {share:.3g} % of {reference} to either side, mostly because"
            f" {CAUSES[main_cause]}"
        )
        return "refused", reason
    if name in FRICTION and not half_width <= MAX_FRICTION * abs(value - frictionless):
        addition = ", and a larger share of its value" if name != "friction_torque" else ""
        return "rough", f"its interval is {share:.3g} % of all friction to either side{addition}"
    if not half_width <= MAX_IDENTIFIED.get(name, MAX_HALF_WIDTH) * size:
        return (
            "rough",
            f"its interval is {share:.3g} % of it to either side: randomize it in training",
        )
    return "identified", ""


def _widen_by_constant(
    estimates: list[Estimate], constant: Estimate, known: Mapping[str, float]
) -> list[Estimate]:
    """Widen the intervals of a shaft by the interval of a constant of the winding."""
    widened: list[Estimate] = []
    relative = max(constant.high - constant.value, constant.value - constant.low) / max(
        constant.value, 1e-12
    )
    # A known torque or inertia fixes the scale of all torques, independently of the constant.
    has_torque_scale = "mgl" in known or "inertia" in known
    for estimate in estimates:
        is_independent = estimate.name in ("gear_efficiency", "stribeck_speed") or (
            has_torque_scale and estimate.name != "torque_constant"
        )
        width = 0.0 if is_independent else estimate.value * relative
        low = max(
            estimate.value - math.hypot(estimate.value - estimate.low, width),
            PARAMETERS[estimate.name].lower,
        )
        high = min(
            estimate.value + math.hypot(estimate.high - estimate.value, width),
            PARAMETERS[estimate.name].upper,
        )
        estimate = dataclasses.replace(
            estimate, low=low, high=high, causes={**estimate.causes, "torque_constant": width}
        )
        if estimate.status in ("identified", "rough") and constant.status not in USABLE:
            reason = (
                f"the {constant.name.replace('_', ' ')} that it depends on is {constant.status}"
            )
            estimate = dataclasses.replace(estimate, status="refused", why=reason)
        widened.append(estimate)
    return _update_status(widened)


def _update_status(estimates: list[Estimate]) -> list[Estimate]:
    """Return the estimates with a status that fits their widened intervals.

    Friction parameters are judged by the interval of the total friction.
    """
    shares = {
        estimate.name: (estimate.high - estimate.value) / max(abs(estimate.value), 1e-300)
        for estimate in estimates
    }
    updated = []
    for estimate in estimates:
        share = (
            shares.get("friction_torque", 0.0)
            if estimate.name in FRICTION
            else shares[estimate.name]
        )
        reason = (
            f"its interval is {100.0 * share:.3g} % of it to either side, mostly because"
            f" {CAUSES['torque_constant']}"
        )
        if estimate.causes["torque_constant"] > 0.0 and estimate.status in ("identified", "rough"):
            if share > MAX_HALF_WIDTH:
                estimate = dataclasses.replace(estimate, status="refused", why=reason)
            elif (
                estimate.status == "identified"
                and estimate.name in FRICTION
                and share > MAX_FRICTION
            ):
                estimate = dataclasses.replace(estimate, status="rough", why=reason)
        updated.append(estimate)
    return updated


def _total_friction(fit: Fit[Model]) -> tuple[float, dict[str, float], dict[str, float]]:
    """Return the total friction of a shaft at the RMS of its speeds and torques.

    Returns:
        The total friction at the rotor [N*m]; its derivatives with respect to the friction
        parameters; and for each of them the value at which it alone would account for the total
        friction. The latter includes a hundredth of the driving torque, because less friction is
        negligible.
    """
    if not isinstance(model := fit.model, ShaftModel):
        return 0.0, {}, {}
    parameters = model.all_values(fit.values)
    # Differences over a twentieth of a segment are not affected by the resolution of an encoder.
    sparse_rows = [slice(None, None, max(len(segment.times) // 20, 1)) for segment in fit.segments]
    speeds = np.concatenate(
        [
            (
                segment.measured
                if model.output == "velocity"
                else np.diff(segment.measured[rows]) / np.diff(segment.times[rows])
            )
            for segment, rows in zip(fit.segments, sparse_rows, strict=True)
        ]
    )
    speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-9) * parameters["gear_ratio"]
    torque = model.driving_torque(fit.values, fit.segments) / parameters["gear_ratio"]
    slopes = {
        "coulomb_friction": 1.0,
        "viscous_friction": speed,
        "damping": speed,
        "gear_efficiency": -torque,
    }
    gear_loss = slopes["gear_efficiency"] * (parameters["gear_efficiency"] - 1.0)
    # The damping of a servo contains its viscous friction.
    viscous = parameters.get("damping", parameters.get("viscous_friction", 0.0))
    friction = parameters["coulomb_friction"] + viscous * speed + gear_loss
    full_friction = {
        name: (friction + 1e-2 * torque) / max(abs(slopes.get(name, 1.0)), 1e-300)
        for name in FRICTION
    }
    if "damping" in parameters:
        slopes["viscous_friction"] = 0.0
    return (
        friction,
        slopes,
        full_friction | {"gear_efficiency": min(full_friction["gear_efficiency"], 1.0)},
    )


def _complete(
    estimates: list[Estimate], known: Mapping[str, float], defaults: Mapping[str, float]
) -> list[Estimate]:
    """Add the known parameters, those of a base drive, and those that follow from others."""
    by_name = {estimate.name: estimate for estimate in estimates}
    for name, value in known.items():
        by_name[name] = Estimate(name, value, value, value, "given")
    for name, value in defaults.items():
        if name in PARAMETERS and name not in by_name and value != DEFAULTS[name]:
            by_name[name] = Estimate(
                name, value, value, value, "given", "value of the motor, taken as known"
            )
    # In SI units the torque constant and the back-EMF constant are equal, except for losses.
    constants = {"torque_constant": "torque constant", "back_emf_constant": "back-EMF constant"}
    for name, source in zip(constants, reversed(constants), strict=True):
        if name not in by_name and source in by_name:
            reason = (
                "taken as the"
                f" {constants[source]}{': ' + by_name[source].why if by_name[source].why else ''}"
            )
            by_name[name] = dataclasses.replace(by_name[source], name=name, why=reason)
    ratio = known.get("gear_ratio", DEFAULTS["gear_ratio"])
    if "inertia" in by_name and "load_inertia" in known and "rotor_inertia" not in known:
        total, load = by_name["inertia"], known["load_inertia"]
        value, low, high = (
            (inertia - load) / ratio**2 for inertia in (total.value, total.low, total.high)
        )
        status, reason = total.status, total.why
        if status in USABLE and not high - value <= MAX_HALF_WIDTH * value:
            status = "refused"
            share = 100.0 * (high - value) / max(value, 1e-300)
            reason = (
                f"the total inertia of {total.value:.4g} kg*m^2 without the load's {load:.4g}"
                f" kg*m^2 is known only to {share:.3g} %"
            )
        ends = max(low, 0.0), max(high, 0.0)
        by_name["rotor_inertia"] = Estimate("rotor_inertia", max(value, 0.0), *ends, status, reason)
    return [by_name[name] for name in PARAMETERS if name in by_name]


def _gauss_newton_sums(fit: Fit[Model], groups: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (c, p) and Gauss-Newton matrix (c, p, p) of each group of segments."""
    count, size = len(set(groups)), len(fit.values)
    gradients, matrices = np.zeros((count, size)), np.zeros((count, size, size))
    group_index = {group: index for index, group in enumerate(dict.fromkeys(groups))}
    for index, group in enumerate(groups):
        weighted = fit.jacobians[index] * fit.weights(index)[:, None]
        gradients[group_index[group]] += weighted.T @ fit.residuals[index]
        matrices[group_index[group]] += weighted.T @ fit.jacobians[index]
    return gradients, matrices


def _noise(fit: Fit[Model]) -> float:
    """Return the weighted mean square of the residuals."""
    return float(
        np.mean(np.concatenate([fit.weights(i) * r**2 for i, r in enumerate(fit.residuals)]))
    )


def _inverse(matrix: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return the inverse of a Gauss-Newton matrix, limited along unidentified directions.

    The matrix is normalized, because the parameters have very different standard errors.
    """
    information = np.diag(matrix) * scales**2
    units = scales / np.sqrt(np.maximum(information, 1e-16 * information.max() + 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(units, units))
    return np.asarray(
        (vectors / np.maximum(values, MIN_EIGENVALUE)) @ vectors.T * np.outer(units, units)
    )


def interval_causes(
    fit: Fit[Model],
    values: np.ndarray,
    scales: np.ndarray,
    matrix: np.ndarray,
    seed: int,
    on_step: Callable[[], None],
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the half-widths of intervals by cause, and the values from the self-test.

    Args:
        fit: fit to assess.
        values: values to assess, linear combinations of the parameters, shape (q,).
        scales: scales of the parameters, shape (p,).
        matrix: derivatives of the combinations with respect to the parameters, shape (q, p).
        seed: seed of the resampling.
        on_step: called after each step.
    """
    is_winding = isinstance(fit.model, WindingModel)
    causes = resampled_half_widths(fit, scales, matrix, seed)
    on_step()
    # The self-test fits two simulations of the logs with opposite residuals: random errors cancel
    # in the mean of both fits, and a bias remains.
    self_test_values = values + matrix @ (
        np.asarray(
            0.5 * sum(_refit_values(fit, _simulated_logs(fit, sign)) for sign in (1.0, -1.0))
        )
        - fit.values
    )
    on_step()
    # If an error is proportional to the time step, halving the rate changes the fit by as much as
    # the error at the full rate. If the error grows only with the root of the step, it is larger
    # than that change. For a winding the change is therefore doubled.
    half_rate = fit.model.half_rate_segments(fit.logs)
    half_rate_values = optimize(fit.model, half_rate, fit.values, 20).values
    causes["half_rate"] = (2.0 if is_winding else 1.0) * np.abs(
        matrix @ (half_rate_values - fit.values)
    )
    on_step()
    causes["segments"] = np.abs(matrix @ _change_by_segments(fit))
    on_step()
    causes["self_test"] = np.abs(self_test_values - values)
    # Errors of the input, for example of a voltage that changes between rows, bias the parameters.
    # For a PRBS with a clock of 1 to 4 rows, the relative bias is 2 to 4.6 times the unexplained
    # share of the variance. A fit at half the rate does not reveal this bias.
    residual_squares = sum(
        segment.deviation**2 * float(fit.weights(i) @ fit.residuals[i] ** 2)
        for i, segment in enumerate(fit.segments)
    )
    output_squares = sum(
        float(np.var(segment.measured)) * len(segment.measured) for segment in fit.segments
    )
    causes["unexplained"] = np.abs(values) * (
        ATTENUATION * residual_squares / max(output_squares, 1e-300) if is_winding else 0.0
    )
    return causes, self_test_values


def resampled_half_widths(
    fit: Fit[Model], scales: np.ndarray, matrix: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Return the half-widths of 95 % intervals by three statistical causes, each of shape (q,).

    - `curvature` assumes an exact model and independent residuals. It is a lower limit if there are
      few stretches.
    - `resampling` draws stretches with replacement, and refits each draw by a Gauss-Newton step.
    - `logs` is two standard errors of the mean of the Gauss-Newton steps of single logs; 0 for one
      log.

    Args:
        fit: fit to assess.
        scales: scales of the parameters, shape (p,).
        matrix: derivatives of the assessed values with respect to the parameters, shape (q, p).
        seed: seed of the resampling.
    """
    from scipy.stats import t

    by_log, by_block = (
        _gauss_newton_sums(fit, [getattr(segment, part) for segment in fit.segments])
        for part in ("log", "block")
    )
    inverse = _inverse(by_block[1].sum(axis=0), scales)
    curvature = 1.96 * np.sqrt(_noise(fit) * np.diag(matrix @ inverse @ matrix.T))
    logs, count = np.zeros(len(matrix)), len(by_log[0])
    if count > 1:
        logs = 2.0 * (count * by_log[0] @ inverse @ matrix.T).std(axis=0, ddof=1) / np.sqrt(count)
    gradients, matrices = by_log if count >= MIN_LOGS else by_block
    resampling, count = np.full(len(matrix), np.inf), len(gradients)
    if count > 1:
        draws = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), DRAWS)
        steps = [
            -_inverse(np.tensordot(counts, matrices, 1), scales) @ (counts @ gradients)
            for counts in draws
        ]
        low, high = np.percentile(np.array(steps) @ matrix.T, [2.5, 97.5], axis=0)
        # Few stretches underestimate their variation: Student's t corrects the percentiles.
        correction = t.ppf(0.975, count - 1) / t.ppf(0.975, 1e6) * np.sqrt(count / (count - 1.0))
        resampling = np.maximum(-low, high) * correction
    return {"curvature": curvature, "resampling": resampling, "logs": logs}


def log_disagreements(fit: Fit[Model]) -> dict[str, float]:
    """Return how far the logs' own values lie outside the 99 % intervals of single logs.

    A Gauss-Newton step from the common fit gives the value of a single log, and the differences
    between its blocks give the standard error of that value. The level of 99 % holds for all
    parameters together. Parameters that no log contradicts are left out.
    """
    from scipy.stats import norm

    names, blocks = fit.model.names, [segment.block for segment in fit.segments]
    logs = [segment.log for segment in fit.segments]
    if len(set(logs)) < 2 or not names:
        return {}
    scales = np.maximum(np.abs(fit.values), fit.model.scales)
    limit = norm.ppf(1.0 - 0.005 / len(names))
    gaps = np.zeros(len(names))
    for log in sorted(set(logs)):
        indices = [index for index, number in enumerate(logs) if number == log]
        part = dataclasses.replace(
            fit,
            segments=[fit.segments[index] for index in indices],
            residuals=tuple(fit.residuals[index] for index in indices),
            jacobians=tuple(fit.jacobians[index] for index in indices),
        )
        gradients, matrices = _gauss_newton_sums(part, [blocks[index] for index in indices])
        count = len(gradients)
        if count < 2:
            continue
        inverse = _inverse(matrices.sum(axis=0), scales)
        steps = gradients @ inverse
        errors = np.sqrt(count / (count - 1.0) * np.sum((steps - steps.mean(axis=0)) ** 2, axis=0))
        gaps = np.maximum(gaps, np.abs(steps.sum(axis=0)) - limit * errors)
    return {name: float(gap) for name, gap in zip(names, gaps, strict=True) if gap > 0.0}


def correlations(fit: Fit[Model]) -> dict[str, dict[str, float]]:
    """Return the correlations; parameters with one near 1 or -1 can hardly be distinguished."""
    names = fit.model.names
    if not names:
        return {}
    _, matrices = _gauss_newton_sums(fit, [0] * len(fit.residuals))
    covariance = _inverse(matrices[0], np.ones(len(names)))
    deviations = np.sqrt(np.diag(covariance))
    table = np.clip(covariance / np.outer(deviations, deviations), -1.0, 1.0).tolist()
    return {
        name: dict(zip(names, row, strict=True)) for name, row in zip(names, table, strict=True)
    }


def unidentifiable_directions(fit: Fit[Model], scales: np.ndarray) -> list[dict[str, float]]:
    """Return the directions in which the parameters can change without a worse fit.

    A shaft's exact directions come first; see `invariant_directions`. The derivatives give the
    weakest direction of the other parameters. Its largest parameter is changed by half its scale,
    and all others are fitted again. If that fit is as good, the changes of all parameters form an
    unidentifiable direction. Derivatives alone do not suffice: dry friction makes the cost rough,
    so that a flat direction looks identified.

    Args:
        fit: fit to assess.
        scales: scales of the parameters, shape (p,).

    Returns:
        Shares of the parameters in each direction by name, the largest being 1.
    """
    current, sizes, directions = _without_invariances(fit, scales)
    # The largest parameter of each direction stays fixed while the next direction is searched.
    while len(current.model.names) > (1 if directions else 0):
        matrix = _gauss_newton_sums(current, [segment.block for segment in current.segments])[
            1
        ].sum(axis=0)
        # The eigenvector of the smallest eigenvalue is a unit vector in the scales.
        direction = np.linalg.eigh(matrix * np.outer(sizes, sizes))[1][:, 0]
        index = int(np.argmax(np.abs(direction)))
        changed = _probe(current, sizes, direction, index)
        if changed is None:
            break
        step = (changed.model.known[current.model.names[index]] - current.values[index]) / sizes[
            index
        ]
        changes = (changed.values - np.delete(current.values, index)) / np.delete(sizes, index)
        shares = np.insert(changes, index, step) / step
        directions.append(
            {
                name: float(share)
                for name, share in zip(current.model.names, shares, strict=True)
                if abs(share) > MIN_SHARE
            }
        )
        if len(current.model.names) == 1:
            break
        current, sizes = changed, np.delete(sizes, index)
    return directions


def _without_invariances(
    fit: Fit[Model], scales: np.ndarray
) -> tuple[Fit[Model], np.ndarray, list[dict[str, float]]]:
    """Return a fit in which a parameter of each exact direction is fixed.

    Returns:
        The fit, the scales of its parameters, and the directions.
    """
    if not isinstance(fit.model, ShaftModel):
        return fit, scales, []
    names, fixed, directions = fit.model.names, [], []
    for direction in invariant_directions(cast("Fit[ShaftModel]", fit), scales):
        # Each direction is the only one that changes this parameter.
        fixed.append(int(np.flatnonzero(direction == 1.0)[0]))
        largest = float(np.abs(direction).max())
        directions.append(
            {
                name: float(share) / largest
                for name, share in zip(names, direction, strict=True)
                if share != 0.0
            }
        )
    model = dataclasses.replace(
        fit.model,
        names=tuple(np.delete(names, fixed).tolist()),
        known={**fit.model.known, **{names[index]: float(fit.values[index]) for index in fixed}},
        scales=np.delete(fit.model.scales, fixed),
    )
    reduced = dataclasses.replace(
        fit,
        model=model,
        values=np.delete(fit.values, fixed),
        jacobians=tuple(np.delete(jacobian, fixed, axis=1) for jacobian in fit.jacobians),
    )
    return reduced, np.delete(scales, fixed), directions


def _probe(
    fit: Fit[Model], sizes: np.ndarray, direction: np.ndarray, index: int
) -> Fit[Model] | None:
    """Return an equally good fit with another value of a parameter; None if there is none.

    The parameter is changed upwards and downwards, because the fit may be as good only on one side
    if another parameter is at its bound.
    """
    model, values = fit.model, fit.values
    name, bounds = model.names[index], PARAMETERS[model.names[index]]
    max_cost = fit.cost + _significant_increase(fit)
    for sign in (1.0, -1.0):
        step = sign * PROBE_CHANGE * sizes[index] * np.sign(direction[index])
        if not bounds.lower <= values[index] + step <= bounds.upper:
            continue
        start = np.clip(
            values + step / sizes[index] / direction[index] * direction * sizes, 0.2 * values, None
        )
        reduced_model = dataclasses.replace(
            model,
            names=tuple(np.delete(model.names, index).tolist()),
            known={**model.known, name: float(values[index] + step)},
            scales=np.delete(model.scales, index),
        )
        changed = optimize(reduced_model, fit.segments, np.delete(start, index), 20, fit.scale)
        if changed.costs(fit.scale).sum() <= max_cost:
            return changed
    return None


def _significant_increase(fit: Fit[Model]) -> float:
    """Return the increase of the robust cost that is significant at 95 %.

    Residuals within a block are correlated. To correct for this, the variance along the best
    identified direction is estimated from blocks and from rows, and the ratio of both is applied.
    """
    gradients, matrices = _gauss_newton_sums(fit, [segment.block for segment in fit.segments])
    total = matrices.sum(axis=0)
    root = np.sqrt(np.maximum(np.diag(total), 1e-300))
    strengths, vectors = np.linalg.eigh(total / root / root[:, None])
    projections = gradients / root @ vectors[:, -1]
    noise = _noise(fit)
    correlation = max(float(projections @ projections) / max(strengths[-1] * noise, 1e-30), 1.0)
    # 3.84 is the 95 % quantile of the chi-squared distribution with one degree of freedom.
    return float(3.84 * noise * correlation + SLACK * fit.cost)


def _change_by_segments(fit: Fit[Model]) -> np.ndarray:
    """Return the change of the parameters, shape (p,), in a fit of segments of half the duration.

    If something else moves the shaft, such as another joint, then the fit attributes that motion to
    the parameters, and to others in segments of another duration. For a model that describes the
    log, the duration hardly matters. Segments of few rows are doubled instead.
    """
    if not isinstance(fit.model, ShaftModel):
        return np.zeros(len(fit.values))
    rows = min(fit.model.segment / log.step for log in fit.logs)
    factor = 0.5 if rows >= 2 * MIN_SEGMENT_ROWS else 2.0
    model = dataclasses.replace(fit.model, segment=factor * fit.model.segment)
    changed = optimize(model, model.segments(fit.logs), fit.values, 20).values
    return np.asarray(changed - fit.values)


def _refit_values(fit: Fit[Model], logs: Sequence[Log]) -> np.ndarray:
    """Return the parameters from a fit of the same model to other logs."""
    return optimize(fit.model, fit.model.segments(logs), fit.values, 20).values


def _simulated_logs(fit: Fit[Model], sign: float) -> list[Log]:
    """Simulate the logs of a fit with its residuals as noise, at the resolution of their sensors.

    The residuals of each segment are added in their order, which preserves their correlation, but
    with a random sign per segment. For a winding, the position is replaced by the integral of the
    speed that the fit used.
    """
    output, simulate = fit.model.output, fit.model.simulator(fit.values)
    signals = [log.signals[output].copy() for log in fit.logs]
    speeds = [np.zeros(len(log.time)) for log in fit.logs]
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(fit.segments)) * sign
    for index, segment in enumerate(fit.segments):
        # Larger residuals are outliers, and not noise of the sensor.
        noise = np.clip(fit.residuals[index], -3.0 * fit.scale, 3.0 * fit.scale) * segment.deviation
        signals[segment.log][segment.rows] = (
            simulate(segment, fit.states[index]) + signs[index] * noise
        )
        speeds[segment.log][segment.rows] = segment.speeds
    simulated = []
    for log, values, speed in zip(fit.logs, signals, speeds, strict=True):
        simulated.append(_replace_rounded(log, output, values))
        if isinstance(fit.model, WindingModel) and log.has("position") and has_motion(log):
            turns = np.append(0.0, np.cumsum(speed[:-1] * np.diff(log.time)))
            simulated[-1] = _replace_rounded(
                simulated[-1], "position", log.signals["position"][0] + turns
            )
    return simulated


def _replace_rounded(log: Log, name: str, values: np.ndarray) -> Log:
    """Return a log with other values of a signal, rounded to the resolution of its sensor."""
    step = log.resolution.get(name, 0.0)
    return replace_signal(log, name, np.round(values / step) * step if step > 0.0 else values)
