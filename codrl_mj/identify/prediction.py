"""How well a shaft's model foretells a log, from where it was; what a fit made of its logs over time, to be seen."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit, refit, search, settled_state
from codrl_mj.identify.log import Log, usable
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.segments import Segment, initial_state

HORIZON = 0.5  # time [s] that is foretold at once,
KNOWN = 0.03  # from where and how fast the shaft was in its first so many [s], five rows at least


class Trace(NamedTuple):
    """A simulation beside what was measured, in pieces that each begin from a state of their own."""

    log: str
    part: str  # `winding` or `shaft`
    output: str  # what is compared: `current` [A], `position` [rad] or `velocity` [rad/s]
    time: np.ndarray  # [s], shape (n,)
    measured: np.ndarray  # shape (n,)
    simulated: np.ndarray  # shape (n,)
    starts: np.ndarray  # rows at which pieces begin


def traced(log: str, part: str, output: str, segments: Sequence[Segment], made: Sequence[np.ndarray]) -> Trace:
    """A trace of segments of a log, beside what a simulation made of each, of shape (m,)."""
    times, measured = (np.concatenate([getattr(one, name) for one in segments]) for name in ("times", "measured"))
    starts = np.cumsum([0, *(len(one.times) for one in segments)])[:-1]
    return Trace(log, part, output, times, measured, np.concatenate(made), starts)


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Mean absolute errors on a log, in the unit of what is foretold."""

    log: str
    output: str
    """`position` [rad] or `velocity` [rad/s]."""
    open_loop: float
    """Over `HORIZON`, under the logged input, each time from the state that its first `KNOWN` tell."""
    closed_loop: float | None
    """Over the whole log, under the law by which the servo makes a voltage of its error; None where there is none."""
    trace: Trace | None = dataclasses.field(default=None, compare=False, repr=False)
    """What `open_loop` is the error of; in no file."""


def predict(fit: Fit, log: Log) -> Prediction:
    """Errors of a fitted shaft's simulations of a log."""
    model, simulate, errors, made = fit.model, fit.model.at(fit.values), [], []
    segments = dataclasses.replace(model, segment=HORIZON).segments([log])
    for segment in segments:
        known = max(int(np.searchsorted(segment.times, segment.times[0] + KNOWN)), 5)
        made.append(simulate(segment, settled_state(model, fit.values, segment.first(known))))
        errors.append(np.abs(made[-1] - segment.measured)[known:])
    foretold, error = traced(log.name, "shaft", model.output, segments, made), float(np.concatenate(errors).mean())
    return Prediction(log.name, model.output, error, closed_loop_error(fit, log), foretold)


def closed_loop_error(fit: Fit, log: Log) -> float | None:
    """Mean absolute error [rad] of a whole log under its own command, by a proportional law found in the log.

    The law is the straight line through the origin from the command's error to the input, where the input is not at
    its limit: `bus`, or the largest that the log has. None where the log has no command that explains its input.
    """
    from codrl_mj.identify.simulation import served

    model = fit.model
    if model.output != "position" or not log.has("command", model.driven_by):
        return None
    wanted, given = log.signals["command"], log.signals[model.driven_by]
    error = wanted - log.signals["position"]
    limits = log.signals["bus"] if log.has("bus") else np.full(len(error), np.abs(given).max())
    free = np.abs(given) < 0.98 * limits
    if not np.any(error[free]):
        return None
    law = float(given[free] @ error[free] / (error[free] @ error[free]))
    lawful = np.clip(law * error, -limits, limits)
    if not np.mean((given - lawful) ** 2) < 0.25 * np.mean(given**2):
        return None
    moved, found = model.moved(fit.values), []
    for stretch in usable(log):
        position, speed = initial_state(log, stretch)
        simulated = served(log.time[stretch], wanted[stretch], limits[stretch], law, position, speed, moved)
        found.append(np.abs(simulated - log.signals["position"][stretch]))
    total = float(np.concatenate(found).mean())
    return total if math.isfinite(total) else None


def fitted_traces(part: str, fit: Fit) -> Iterator[Trace]:
    """The fit of `winding` or `shaft` to each of its logs."""
    for place, log in enumerate(fit.logs):
        pairs = zip(fit.segments, fit.residuals, strict=True)
        own = [(one, one.measured + residuals * one.deviation) for one, residuals in pairs if one.log == place]
        if own:
            yield traced(log.name, part, fit.model.output, *zip(*own, strict=True))


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
