"""Which friction a shaft is fitted with: the one asked for, or the one that predicts left-out logs best."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit, optimize, fit_from_starts
from codrl_mj.identify.log import SIGNALS, Log
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.result import predict

MIN_LOGS = (
    3  # Fewer logs give no standard deviation of what a richer friction gains on the one left out.
)
_LOADED = {"coulomb": "load", "stribeck": "both"}
# An efficiency is hinted at where it takes all cost, and half of the segments', to less than this
# share,
_HINTED = 0.9
_APART = 0.05  # and differs by more than this from the one that the fit took as known.


class FrictionChoice(NamedTuple):
    """A shaft with its kind of friction."""

    model: ShaftModel
    reason: str
    """Why this kind; empty if it was asked for."""


def choose_friction(
    model: ShaftModel, logs: Sequence[Log], wanted: str, on_step: Callable[[], None]
) -> FrictionChoice:
    """Return the model with the friction that is wanted or, for `auto`, with what leaving out one log at a time favors.

    More than viscous and Coulomb friction is kept where the errors on the logs left out fall by
    more, in the mean, than two standard deviations of that mean. With fewer than three logs none
    is.
    """
    if wanted != "auto":
        return FrictionChoice(dataclasses.replace(model, friction=wanted), "")
    if len(logs) < MIN_LOGS:
        return FrictionChoice(
            model,
            "friction: coulomb, because auto compares the errors on logs left out: it needs"
            f" {MIN_LOGS} logs that move, and there {'is' if len(logs) == 1 else 'are'}"
            f" {len(logs)}. Name more, or choose --friction load, stribeck or both",
        )
    errors = {"coulomb": _left_out_errors(model, logs, on_step)}
    best = model
    for friction in ("load", "stribeck", "both"):
        richer = dataclasses.replace(model, friction=friction)
        errors[friction] = _left_out_errors(richer, logs, on_step)
        gained = errors[best.friction] - errors[friction]
        if gained.mean() > 2.0 * gained.std(ddof=1) / np.sqrt(len(gained)):
            best = richer
    means = ", ".join(f"{friction} {error.mean():.3g}" for friction, error in errors.items())
    reason = (
        f"friction: {best.friction}, by the mean errors on the logs left out"
        f" [{SIGNALS[model.output]}]: {means}; a richer one is taken if it is better by two"
        " standard deviations"
    )
    return FrictionChoice(best, reason)


def _left_out_errors(
    model: ShaftModel, logs: Sequence[Log], on_step: Callable[[], None]
) -> np.ndarray:
    """Return the mean absolute error on each log of the fit to all others, from that to all, shape (n,)."""
    segments = model.segments(logs)
    model, starts = model.initial_guess(segments)
    whole, errors = fit_from_starts(model, segments, starts[:2])[0].values, []
    for place, log in enumerate(logs):
        found = predict(
            optimize(model, model.segments([*logs[:place], *logs[place + 1 :]]), whole, 12), log
        )
        errors.append(found.open_loop if found.closed_loop is None else found.closed_loop)
        on_step()
    return np.array(errors)


def load_hint(fit: Fit) -> str | None:
    """Return advice to fit an efficiency if that explains the same logs clearly better; None: it does not."""
    model = fit.model
    if model.friction not in _LOADED or "gear_efficiency" in (*model.known, *model.names):
        return None
    loaded = dataclasses.replace(
        model, names=(*model.names, "gear_efficiency"), scales=np.append(model.scales, 0.1)
    )
    known = model.defaults["gear_efficiency"]
    richer = optimize(loaded, fit.segments, np.append(fit.values, min(known, 0.9)), 20, fit.scale)
    costs, before = richer.costs(fit.scale), fit.costs(fit.scale)
    left = max(costs.sum() / before.sum(), float(np.median(costs / before)))
    if abs(richer.values[-1] - known) <= _APART or left > _HINTED:
        return None
    return (
        f"friction grows with the load: an efficiency of {richer.values[-1]:.2g} instead of"
        f" {known:.2g} would take {1.0 - left:.0%} off what is not explained; fit it by --friction"
        f" {_LOADED[model.friction]}"
    )
