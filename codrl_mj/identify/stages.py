"""The two parts of a motor that are fitted one after the other: the winding, then the shaft under its current."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from codrl_mj.identify import honesty
from codrl_mj.identify.estimate import Fit, estimate, robust_cost
from codrl_mj.identify.log import Log
from codrl_mj.identify.models import ShaftStage, WindingStage
from codrl_mj.identify.prediction import predict
from codrl_mj.identify.segments import Segment, halved, moves, replaced, shifted

DELAYS = (-1, 1, 2, 3)
"""Rows that the input is tried to be late by, besides 0;"""
LONGEST = 20
"""and on to so many, while that is better."""
UNKNOWN = 0.5
"""A direction in which the parameters may go by so much of themselves, unnoticed, is not identified."""
PART = 0.1
"""Share of such a direction from which a parameter belongs to it."""
BETTER = 0.8
"""A delay is believed where it takes the robust cost to less than this share, and"""
SURE = 3.0
"""lowers that of the segments by more, in the mean, than so many standard deviations of that mean."""


Stage = WindingStage | ShaftStage


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """A stage with its logs, and what came of it."""

    stage: Any
    """A `WindingStage` or a `ShaftStage`."""
    logs: tuple[Log, ...]
    """With the input in time."""
    delay: float
    """Rows by which it was late."""
    segments: tuple[Segment, ...]
    model: Any
    fit: Fit
    tried: tuple[Fit, ...]
    """What each start led to."""

    def again(self, logs: Sequence[Log]) -> np.ndarray:
        """The parameters that other logs give, from where these ended."""
        return estimate(self.model, self.stage.segments(logs), [self.fit.values], most=20)[0].values

    def refitted(self, stage: Stage) -> "Fitted":
        """Of the same logs with another stage, from where this ended."""
        segments = stage.segments(self.logs)
        model, _ = stage.model(segments)
        fit, _ = estimate(model, segments, [self.fit.values])
        return dataclasses.replace(self, stage=stage, segments=tuple(segments), model=model, fit=fit)

    def unknown_directions(self, scales: np.ndarray) -> list[dict[str, float]]:
        """Directions in which the parameters may go, and nobody would notice: parameter -> share, the largest 1.

        In the direction that the derivatives say is the weakest, the parameter that has most of it is moved by half its
        scale, and all others are fitted anew: if the logs are then explained as well, what the others did is the
        direction. (Derivatives alone do not tell: dry friction makes them rough, and what is flat looks known.)
        """
        found: list[dict[str, float]] = []
        here = self
        while len(here.fit.names) > 1 or not found:
            fit, names = here.fit, here.fit.names
            own = np.array([scales[self.fit.names.index(name)] for name in names])
            direction = honesty.weakest_direction(fit, here.segments, own)
            place = int(np.argmax(np.abs(direction)))
            step = UNKNOWN * own[place] * np.sign(direction[place])
            if not here.model.lower[place] <= fit.values[place] + step <= here.model.upper[place]:
                step = -step
            moved = np.clip(fit.values + step / own[place] / direction[place] * direction * own, 0.2 * fit.values, None)
            other = here.holding(place, float(fit.values[place] + step), moved)
            if _costs(other.fit, fit.scale).sum() > fit.cost + honesty.noticed(fit, here.segments):
                break
            changes = np.insert(
                (other.fit.values - np.delete(fit.values, place)) / np.delete(own, place), place, step / own[place]
            )
            shares = changes / step * own[place]
            found.append({name: float(s) for name, s in zip(names, shares, strict=True) if abs(s) > PART})
            here = other
            if len(names) == 1:
                break
        return found

    def holding(self, place: int, value: float, start: np.ndarray) -> "Fitted":
        """With one of the parameters, by its place, held at a value, and the others fitted from a start, shape (p,)."""
        model = dataclasses.replace(
            self.model,
            names=tuple(np.delete(self.fit.names, place).tolist()),
            known={**self.model.known, self.fit.names[place]: value},
            scales=np.delete(self.model.scales, place),
        )
        fit, _ = estimate(model, self.segments, [np.delete(start, place)], most=20, scale=self.fit.scale)
        return dataclasses.replace(self, model=model, fit=fit)

    def half_rate(self) -> np.ndarray:
        """The parameters at half the rate."""
        return self.again([halved(log) for log in self.logs])

    def self_test(self) -> np.ndarray:
        """The parameters found in what the fit would have made of its logs: the mean of two such, of opposed residuals.

        Residuals keep their order and size, stretch by stretch with a random sign, so that they belong together as they
        do in the logs; in the mean of a draw and its opposite what they do at random cancels.
        """
        return np.asarray(0.5 * (self.again(self._pretended(1.0)) + self.again(self._pretended(-1.0))))

    def _pretended(self, sign: float) -> list[Log]:
        """The logs as the fit would have made them, rounded anew; of a winding also what it took for the motion."""
        fit, simulate = self.fit, self.model.at(self.fit.values)
        signals = [log.signals[self.stage.output].copy() for log in self.logs]
        speeds = [np.zeros(len(log.time)) for log in self.logs]
        signs = np.random.default_rng(1).choice([-1.0, 1.0], len(self.segments)) * sign
        for place, segment in enumerate(self.segments):
            # what is far off is an outlier of the logs, and no noise of the sensor
            noise = np.clip(fit.residuals[place], -3.0 * fit.scale, 3.0 * fit.scale) * segment.deviation
            signals[segment.log][segment.rows] = simulate(segment, fit.states[place]) + signs[place] * noise
            speeds[segment.log][segment.rows] = segment.speeds
        made = []
        for log, values, speed in zip(self.logs, signals, speeds, strict=True):
            made.append(_with(log, self.stage.output, values))
            if isinstance(self.stage, WindingStage) and log.has("position") and moves(log):
                turns = np.append(0.0, np.cumsum(speed[:-1] * np.diff(log.time)))
                made[-1] = _with(made[-1], "position", log.signals["position"][0] + turns)
        return made


def _with(log: Log, name: str, values: np.ndarray) -> Log:
    """A log with another signal, rounded as its sensor rounds."""
    step = log.resolution.get(name, 0.0)
    return replaced(log, name, np.round(values / step) * step if step > 0.0 else values)


def fitted(stage: Stage, logs: Sequence[Log], on_step: Callable[[], None] = lambda: None, starts: int = 4) -> Fitted:
    """Fit a stage to logs: several starts, then the delays.

    A voltage whose mean between two rows fits worse than itself is shown to hold from row to row: then it is also the
    mean, which fewer rows can be given. One that fits better is that of the rows' times, and taken half a row later.
    """
    segments = stage.segments(logs)
    model, several = stage.model(segments)
    fit, tried = estimate(model, segments, several[: starts if model.names else 1], on_step)
    if not model.names:
        return Fitted(stage, tuple(logs), 0, tuple(segments), model, fit, tried)
    costs: dict[float, np.ndarray] = {0: _costs(fit, fit.scale)}

    def late(delay: float) -> list[Log]:
        return [shifted(log, stage.driven_by, delay) for log in logs]

    def measure(*delays: float) -> float:
        """Their costs; returns the best delay that is believed."""
        for one in delays:
            segments = stage.segments(late(one))
            costs[one] = _costs(estimate(model, segments, [fit.values], on_step, 20, fit.scale)[0], fit.scale)
        best = min(costs, key=lambda one: costs[one].sum())
        return best if _better(costs[best], costs[0]) else 0

    delay = measure(*DELAYS)
    while delay != 0 and delay in (min(costs), max(costs)) and abs(delay) < LONGEST:
        delay = measure(delay + (1 if delay > 0 else -1))
    told = late(delay)
    if isinstance(stage, WindingStage) and not all(log.mean_voltage for log in logs):
        whole = costs[delay]
        measure(delay - 0.5, delay + 0.5)
        half = min(delay - 0.5, delay + 0.5, key=lambda one: costs[one].sum())
        delay = half if _better(costs[half], whole) else delay
        if delay == half or _better(whole, costs[half]):
            told = [dataclasses.replace(log, mean_voltage=True) for log in late(delay)]
    if delay != 0:
        segments = stage.segments(told)
        model, several = stage.model(segments)
        fit, tried = estimate(model, segments, [fit.values, several[0]])
    return Fitted(stage, tuple(told), delay, tuple(segments), model, fit, tried)


def _costs(fit: Fit, scale: float) -> np.ndarray:
    """Robust cost of each segment."""
    return np.array([robust_cost(residuals, scale) for residuals in fit.residuals])


def _better(these: np.ndarray, those: np.ndarray) -> bool:
    gained = those - these
    error = gained.std(ddof=1) / np.sqrt(len(gained)) if len(gained) > 1 else 0.0
    return bool(these.sum() < BETTER * those.sum() and gained.mean() > SURE * error)


def foretold(stage: ShaftStage, logs: Sequence[Log], on_step: Callable[[], None]) -> np.ndarray:
    """Mean absolute error on each log of the fit to all others, from that to all, shape (n,)."""
    segments = stage.segments(logs)
    model, starts = stage.model(segments)
    whole, errors = estimate(model, segments, starts[:2])[0].values, []
    for place, log in enumerate(logs):
        others = [other for index, other in enumerate(logs) if index != place]
        best, _ = estimate(model, stage.segments(others), [whole], most=12)
        found = predict(model, best.values, log)
        errors.append(found.open_loop if found.closed_loop is None else found.closed_loop)
        on_step()
    return np.array(errors)


def chosen_friction(stage: ShaftStage, logs: Sequence[Log], wanted: str, on_step: Callable[[], None]) -> ShaftStage:
    """The stage with the friction that is wanted or, for `auto`, with what leaving out one log at a time speaks for.

    More than viscous and Coulomb friction is kept where the errors on the logs left out fall by more, in the mean, than
    two standard deviations of that mean. With fewer than three logs none is.
    """
    if wanted != "auto":
        return dataclasses.replace(stage, friction=wanted)
    if len(logs) < 3:
        return stage
    best, least = stage, foretold(stage, logs, on_step)
    for friction in ("load", "stribeck", "both"):
        tried = dataclasses.replace(stage, friction=friction)
        errors = foretold(tried, logs, on_step)
        gained = least - errors
        if gained.mean() > 2.0 * gained.std(ddof=1) / np.sqrt(len(gained)):
            best, least = tried, errors
    return best
