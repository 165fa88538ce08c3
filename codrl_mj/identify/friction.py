"""Choice of a shaft's friction model: the requested one, or the best one by cross-validation."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from codrl_mj.identify.estimate import Fit, fit_from_starts, optimize
from codrl_mj.identify.log import SIGNALS, Log
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.result import predict

ShaftT = TypeVar("ShaftT", bound=ShaftModel)
# With fewer logs, the standard error of the mean improvement would be meaningless.
MIN_LOGS = 3
"""Minimum number of moving logs for a cross-validation."""
_LOADED = {"coulomb": "load", "stribeck": "both"}
"""Friction model -> the same model with a gear efficiency."""
# A gear efficiency is suggested only if both conditions hold.
_MAX_COST_RATIO = 0.9
"""Largest ratio of the cost with an efficiency to that without, in sum and per median segment."""
_MIN_DIFFERENCE = 0.05
"""Smallest difference between the fitted efficiency and its default."""


class FrictionChoice(NamedTuple, Generic[ShaftT]):
    """A shaft with the chosen friction model."""

    model: ShaftT
    reason: str
    """Reason for the choice; empty if the friction model was requested."""


def choose_friction(
    model: ShaftT, logs: Sequence[Log], friction: str, on_step: Callable[[], None]
) -> FrictionChoice[ShaftT]:
    """Return a shaft with the requested friction model or, for `auto`, with the best one.

    `auto` leaves out one log at a time and predicts it from a fit to the others. It begins with
    `coulomb`, and tries `load`, `stribeck` and `both`. A model replaces the best one so far if it
    reduces the mean error by more than two standard errors. With fewer than three logs the model is
    `coulomb`.
    """
    if friction != "auto":
        return FrictionChoice(dataclasses.replace(model, friction=friction), "")
    if len(logs) < MIN_LOGS:
        return FrictionChoice(
            model,
            f"friction: coulomb, because auto needs {MIN_LOGS} logs that move, and there"
            f" {'is' if len(logs) == 1 else 'are'} {len(logs)}: it predicts each log by a fit to"
            " the others. Add logs, or choose --friction load, stribeck or both",
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
        f" [{SIGNALS[model.output]}]: {means}; a richer model is chosen only if it is better by two"
        " standard errors"
    )
    return FrictionChoice(best, reason)


def _left_out_errors(
    model: ShaftModel, logs: Sequence[Log], on_step: Callable[[], None]
) -> np.ndarray:
    """Return the mean absolute error on each log, predicted by a fit to the others, shape (n,)."""
    segments = model.segments(logs)
    model, starts = model.initial_guess(segments)
    # Each fit starts from the fit to all logs, and therefore needs few evaluations.
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


def load_hint(fit: Fit[ShaftModel]) -> str | None:
    """Return advice to fit a gear efficiency if it explains the logs clearly better; else None."""
    model = fit.model
    if model.friction not in _LOADED or "gear_efficiency" in (*model.known, *model.names):
        return None
    loaded = dataclasses.replace(
        model, names=(*model.names, "gear_efficiency"), scales=np.append(model.scales, 0.1)
    )
    default = model.defaults["gear_efficiency"]
    richer = optimize(loaded, fit.segments, np.append(fit.values, min(default, 0.9)), 20, fit.scale)
    costs, reference = richer.costs(fit.scale), fit.costs(fit.scale)
    ratio = max(costs.sum() / reference.sum(), float(np.median(costs / reference)))
    if abs(richer.values[-1] - default) <= _MIN_DIFFERENCE or ratio > _MAX_COST_RATIO:
        return None
    return (
        f"friction grows with the load: an efficiency of {richer.values[-1]:.2g} instead of"
        f" {default:.2g} would reduce the residual cost by {1.0 - ratio:.0%}; fit it with"
        f" --friction {_LOADED[model.friction]}"
    )
