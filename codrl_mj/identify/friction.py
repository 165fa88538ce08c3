"""Choice of a shaft's friction model: the requested one, or the best one by cross-validation."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit, fit_from_starts, optimize
from codrl_mj.identify.log import SIGNALS, Log
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.result import predict

# With fewer logs the improvement on the logs left out has no useful standard deviation.
MIN_LOGS = 3
"""Smallest number of moving logs for a cross-validation."""
_LOADED = {"coulomb": "load", "stribeck": "both"}
"""Friction model -> the same model with a gear efficiency."""
# A gear efficiency is suggested only if it passes both limits.
_MAX_COST_RATIO = 0.9
"""Largest ratio of costs with and without an efficiency, in total and in the median segment."""
_MIN_DIFFERENCE = 0.05
"""Smallest difference between the fitted efficiency and the known one."""


class FrictionChoice(NamedTuple):
    """A shaft with the chosen friction model."""

    model: ShaftModel
    reason: str
    """Reason of the choice; empty if the friction model was requested."""


def choose_friction(
    model: ShaftModel, logs: Sequence[Log], friction: str, on_step: Callable[[], None]
) -> FrictionChoice:
    """Return a shaft with the requested friction model or, for `auto`, with the best one.

    `auto` leaves out one log at a time and predicts it from a fit to the others. A richer model
    than viscous and Coulomb friction is chosen if it reduces the mean error by more than two
    standard deviations of that mean. With fewer than three logs the model is `coulomb`.
    """
    if friction != "auto":
        return FrictionChoice(dataclasses.replace(model, friction=friction), "")
    if len(logs) < MIN_LOGS:
        return FrictionChoice(
            model,
            f"friction: coulomb, because auto needs {MIN_LOGS} logs that move, and there"
            f" {'is' if len(logs) == 1 else 'are'} {len(logs)}: it compares the errors on logs left"
            " out. Add logs, or choose --friction load, stribeck or both",
        )
    errors = {"coulomb": _left_out_errors(model, logs, on_step)}
    best = model
    for kind in ("load", "stribeck", "both"):
        richer = dataclasses.replace(model, friction=kind)
        errors[kind] = _left_out_errors(richer, logs, on_step)
        reductions = errors[best.friction] - errors[kind]
        if reductions.mean() > 2.0 * reductions.std(ddof=1) / np.sqrt(len(reductions)):
            best = richer
    means = ", ".join(f"{name} {error.mean():.3g}" for name, error in errors.items())
    reason = (
        f"friction: {best.friction}, by the mean errors on the logs left out"
        f" [{SIGNALS[model.output]}]: {means}; a richer one is taken if it is better by two"
        " standard deviations"
    )
    return FrictionChoice(best, reason)


def _left_out_errors(
    model: ShaftModel, logs: Sequence[Log], on_step: Callable[[], None]
) -> np.ndarray:
    """Return the mean absolute error on each log of a fit to all other logs, shape (n,)."""
    segments = model.segments(logs)
    model, starts = model.initial_guess(segments)
    # The fit to all logs is the start of each other fit, which then needs few evaluations.
    values, errors = fit_from_starts(model, segments, starts[:2])[0].values, []
    for index, log in enumerate(logs):
        prediction = predict(
            optimize(model, model.segments([*logs[:index], *logs[index + 1 :]]), values, 12), log
        )
        errors.append(
            prediction.open_loop if prediction.closed_loop is None else prediction.closed_loop
        )
        on_step()
    return np.array(errors)


def load_hint(fit: Fit) -> str | None:
    """Return advice to fit a gear efficiency if it explains the logs clearly better; else None."""
    model = fit.model
    if model.friction not in _LOADED or "gear_efficiency" in (*model.known, *model.names):
        return None
    loaded = dataclasses.replace(
        model, names=(*model.names, "gear_efficiency"), scales=np.append(model.scales, 0.1)
    )
    known = model.defaults["gear_efficiency"]
    richer = optimize(loaded, fit.segments, np.append(fit.values, min(known, 0.9)), 20, fit.scale)
    costs, reference = richer.costs(fit.scale), fit.costs(fit.scale)
    ratio = max(costs.sum() / reference.sum(), float(np.median(costs / reference)))
    if abs(richer.values[-1] - known) <= _MIN_DIFFERENCE or ratio > _MAX_COST_RATIO:
        return None
    return (
        f"friction grows with the load: an efficiency of {richer.values[-1]:.2g} instead of"
        f" {known:.2g} would reduce the unexplained part by {1.0 - ratio:.0%}; fit it by --friction"
        f" {_LOADED[model.friction]}"
    )
