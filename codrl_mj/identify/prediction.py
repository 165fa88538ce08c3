"""How well a shaft's model foretells a log, from where it was; what a fit made of its logs over time, to be seen."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.identify.estimate import Fit, settled_state
from codrl_mj.identify.log import Log, usable
from codrl_mj.identify.segments import initial_state, shaft_segments

HORIZON = 0.5
"""Time [s] that is foretold at once,"""
KNOWN = 0.03
"""from where and how fast the shaft was in its first so many [s], five rows at least."""


class Trace(NamedTuple):
    """A simulation beside what was measured, in pieces that each begin from a state of their own."""

    log: str
    part: str
    """`winding` or `shaft`."""
    output: str
    """What is compared: `current` [A], `position` [rad] or `velocity` [rad/s]."""
    time: np.ndarray
    """[s], shape (n,)."""
    measured: np.ndarray
    """Shape (n,)."""
    simulated: np.ndarray
    """Shape (n,)."""
    starts: np.ndarray
    """Rows at which pieces begin."""


def trace(log: str, part: str, output: str, pieces: Any) -> Trace:
    """A trace of some (times, measured, simulated), each of shape (m,)."""
    times, measured, simulated = (np.concatenate(column) for column in zip(*pieces, strict=True))
    starts = np.cumsum([0, *(len(piece[0]) for piece in pieces)])[:-1]
    return Trace(log, part, output, times, measured, simulated, starts)


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
    model, simulate, found, pieces = fit.model, fit.model.at(fit.values), [], []
    for segment in shaft_segments([log], model.driven_by, model.output, HORIZON):
        known = max(int(np.searchsorted(segment.times, segment.times[0] + KNOWN)), 5)
        state = settled_state(model, fit.values, segment.first(known))
        simulated = simulate(segment, state)
        found.append(np.abs(simulated - segment.measured)[known:])
        pieces.append((segment.times, segment.measured, simulated))
    errors, foretold = np.concatenate(found), trace(log.name, "shaft", model.output, pieces)
    return Prediction(log.name, model.output, float(errors.mean()), closed_loop_error(fit, log), foretold)


def closed_loop_error(fit: Fit, log: Log) -> float | None:
    """Mean absolute error [rad] of a whole log under its own command, by a proportional law found in the log.

    The law is the straight line through the origin from the command's error to the input, where the input is not at
    its limit: `bus`, or the largest that the log has. None where the log has no command that explains its input.
    """
    from codrl_mj.identify.simulation import served

    model: Any = fit.model
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


def fitted_traces(part: str, fit: Fit, logs: Sequence[Log]) -> tuple[Trace, ...]:
    """The fit of `winding` or `shaft` to each of its logs."""
    pieces: dict[int, list[Any]] = {}
    for segment, residuals in zip(fit.segments, fit.residuals, strict=True):
        simulated = segment.measured + residuals * segment.deviation
        pieces.setdefault(segment.log, []).append((segment.times, segment.measured, simulated))
    return tuple(trace(logs[place].name, part, fit.model.output, several) for place, several in pieces.items())
