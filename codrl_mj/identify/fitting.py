"""The winding or the shaft, fitted to logs: with the delay of its input, and the friction that it needs."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from codrl_mj.identify.estimate import Fit, Model, refit, search
from codrl_mj.identify.log import Log
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.prediction import predict
from codrl_mj.identify.segments import shifted

DELAYS = (-1, 1, 2, 3)  # rows that the input is tried to be late by, besides 0;
LONGEST = 20  # and on to so many, while that is better
STARTS = 4
BETTER = 0.8  # a delay is believed where it takes the robust cost to less than this share, and
SURE = 3.0  # lowers that of the segments by more, in the mean, than so many standard deviations of that mean


def refitted(fit: Fit, model: Model) -> Fit:
    """Another model of the same logs, from where a fit ended."""
    segments = model.segments(fit.logs)
    found = refit(model.begun(segments)[0], segments, fit.values)
    return dataclasses.replace(found, logs=fit.logs, delay=fit.delay, tried=fit.tried)


def fitted(model: Model, logs: Sequence[Log], on_step: Callable[[], None] = lambda: None) -> Fit:
    """Fit a model to logs: several starts, then the delays.

    A voltage whose mean between two rows fits worse than itself is shown to hold from row to row: then it is also the
    mean, which fewer rows can be given. One that fits better is that of the rows' times, and taken half a row later.
    """
    segments = model.segments(logs)
    model, starts = model.begun(segments)
    if not model.names:
        fit = refit(model, segments, starts[0])
        on_step()
        return dataclasses.replace(fit, logs=tuple(logs), tried=(fit,))
    fit, tried = search(model, segments, starts[:STARTS], on_step)
    costs: dict[float, np.ndarray] = {0: fit.costs(fit.scale)}

    def late(delay: float) -> list[Log]:
        return [shifted(log, model.driven_by, delay) for log in logs]

    def measure(*delays: float) -> float:
        """Their costs; returns the best delay that is believed."""
        for one in delays:
            costs[one] = refit(model, model.segments(late(one)), fit.values, 20, fit.scale).costs(fit.scale)
            on_step()
        best = min(costs, key=lambda one: costs[one].sum())
        return best if _better(costs[best], costs[0]) else 0

    delay = measure(*DELAYS)
    while delay != 0 and delay in (min(costs), max(costs)) and abs(delay) < LONGEST:
        delay = measure(delay + (1 if delay > 0 else -1))
    told = late(delay)
    if isinstance(model, WindingModel) and not all(log.mean_voltage for log in logs):
        whole = costs[delay]
        measure(delay - 0.5, delay + 0.5)
        half = min(delay - 0.5, delay + 0.5, key=lambda one: costs[one].sum())
        delay = half if _better(costs[half], whole) else delay
        if delay == half or _better(whole, costs[half]):
            told = [dataclasses.replace(log, mean_voltage=True) for log in late(delay)]
    if delay != 0:
        segments = model.segments(told)
        model, starts = model.begun(segments)
        fit, tried = search(model, segments, [fit.values, starts[0]])
    return dataclasses.replace(fit, logs=tuple(told), delay=delay, tried=tried)


def _better(these: np.ndarray, those: np.ndarray) -> bool:
    """Whether costs of segments are lower than others, by more than chance."""
    gained = those - these
    error = gained.std(ddof=1) / np.sqrt(len(gained)) if len(gained) > 1 else 0.0
    return bool(these.sum() < BETTER * those.sum() and gained.mean() > SURE * error)


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
