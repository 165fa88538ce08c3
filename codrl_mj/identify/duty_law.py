"""The law of a servo's firmware, from its logged duty: duty per angle error."""

import dataclasses
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit
from codrl_mj.identify.log import Segment
from codrl_mj.identify.result import MAX_UNEXPLAINED, Estimate
from codrl_mj.identify.servo_model import ServoModel, delayed_commands
from codrl_mj.identify.uncertainty import DRAWS, MAX_HALF_WIDTH, MIN_HALF_WIDTH

_REGISTER_LAGS = np.arange(-4, 13) * 0.0025
"""Lags of the duty's register behind the error [s] that are tried."""
_UNLIMITED = 0.95
"""Duty, over the largest one of the logs, below which it is not limited."""


class DutyLaw(NamedTuple):
    """Duty per angle error."""

    estimate: Estimate
    warning: str
    """Reason why the duty cannot be used; empty if it can."""


def fit_duty_law(fit: Fit[ServoModel]) -> DutyLaw:
    """Fit the duty per angle error to the logs of a fitted servo, which all have a duty.

    Only rows in which the duty is not at its limit count. The register may lag behind the error.
    """
    delay = fit.model.servo_parameters(fit.values).command_delay
    duties = [fit.logs[segment.log].signals["duty"][segment.rows] for segment in fit.segments]
    largest = max(float(np.abs(np.concatenate(duties)).max()), 1e-9)
    best_share, best_slopes, best_weights = np.inf, np.zeros(1), np.ones(1)
    for lag in _REGISTER_LAGS:
        products, squares, residuals = [], [], []
        for segment, duty in zip(fit.segments, duties, strict=True):
            errors = _errors(segment, delay, float(lag))
            free = np.abs(duty) < _UNLIMITED * largest
            products.append(float(errors[free] @ duty[free]))
            squares.append(float(errors[free] @ errors[free]))
        slope = sum(products) / max(sum(squares), 1e-300)
        for segment, duty in zip(fit.segments, duties, strict=True):
            errors = _errors(segment, delay, float(lag))
            residuals.append(duty - np.clip(slope * errors, -largest, largest))
        share = float(np.std(np.concatenate(residuals)) / max(np.std(np.concatenate(duties)), 1e-9))
        if share < best_share:
            weights = np.maximum(np.array(squares), 1e-300)
            best_share, best_slopes, best_weights = share, np.array(products) / weights, weights
    slope = float(best_slopes @ best_weights / best_weights.sum())
    draws = np.random.default_rng(0).integers(0, len(best_slopes), (DRAWS, len(best_slopes)))
    means = np.sum((best_slopes * best_weights)[draws], axis=1) / np.sum(
        best_weights[draws], axis=1
    )
    half_width = 2.0 * float(np.std(means)) + MIN_HALF_WIDTH * abs(slope)
    estimate = Estimate("duty_gain", slope, slope - half_width, slope + half_width, "identified")
    if slope > 0.0 and best_share <= MAX_UNEXPLAINED and half_width <= MAX_HALF_WIDTH * slope:
        return DutyLaw(estimate, "")
    text = (
        f"the duty is not proportional to the angle error: {best_share:.0%} of it is unexplained"
        f" by {slope:.3g} per rad. Check its sign and unit; it is not used"
    )
    return DutyLaw(dataclasses.replace(estimate, status="refused", why=text), text)


def _errors(segment: Segment, delay: float, lag: float) -> np.ndarray:
    """Return the angle errors [rad] a time `lag` [s] before the rows, times the gain."""
    assert segment.servo is not None
    times = segment.times - lag
    position = np.interp(times, segment.times, segment.measured)
    errors: np.ndarray = (delayed_commands(segment, times, delay) - position) * segment.servo.gains
    return errors
