"""The two parts of a motor that are fitted one after the other: the winding, then the shaft under its current."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.identify import honesty
from codrl_mj.identify.differentiation import speeds
from codrl_mj.identify.estimate import Fit, estimate, settled
from codrl_mj.identify.log import Log
from codrl_mj.identify.models import ShaftModel, shaft_model, winding_model
from codrl_mj.identify.segments import (
    SEGMENT,
    Segment,
    halved,
    is_locked,
    output_of,
    shaft_segments,
    turning,
    usable,
    winding_segments,
)

DELAYS = (-1, 1, 2, 3)
"""Rows that the input is tried to be late by, besides 0."""
UNKNOWN = 0.5
"""A direction in which the parameters may go by so much of themselves, unnoticed, is not identified."""
PART = 0.1
"""Share of such a direction from which a parameter belongs to it."""
BETTER = 0.8
"""A delay is believed where it takes the robust cost to less than this share."""


@dataclasses.dataclass(frozen=True)
class Winding:
    """Voltage and speed drive the current."""

    known: Mapping[str, float]
    shaft: "Fitted | None" = None
    """The shaft under the current, where it is known: what an encoder does not see of the speed between its rows."""

    def build(self, logs: Sequence[Log], delay: int) -> tuple[list[Segment], Any, list[np.ndarray]]:
        """Segments, model, starts."""
        segments = winding_segments(logs, [self._turning(log) for log in logs], delay)
        return segments, *winding_model(segments, self.known)

    def _turning(self, log: Log) -> np.ndarray:
        """Mean speeds till the next row: of positions, smoothed; or what the shaft does, and what it leaves, smoothed.

        A smoothed speed lags behind a light rotor, and the back-EMF that it misses would be taken for inductance.
        """
        found = turning(log)
        if self.shaft is None or not moves(log) or not log.has("position", "current"):
            return found
        part = self.shaft
        segments = shaft_segments([log], "current", part.delay, part.stage.segment, 0.0)
        for segment, positions in zip(segments, settled(part.model, part.fit.values, segments), strict=True):
            left = log.signals["position"][segment.rows] - positions
            middles = 0.5 * (segment.times[1:] + segment.times[:-1])
            rest = speeds(segment.times, left, middles)
            found[segment.rows][:-1] = np.diff(positions) / np.diff(segment.times) + rest
        return found

    def pretended(
        self, logs: Sequence[Log], segments: Sequence[Segment], fit: Fit, model: Any, sign: float
    ) -> list[Log]:
        """The logs as the fit would have made them: the speeds as they were taken to be, positions rounded anew."""
        made = _replaced(logs, segments, fit, model, "current", sign)
        return [_turned(log, segments, place) for place, log in enumerate(made)]


@dataclasses.dataclass(frozen=True)
class Shaft:
    """A torque, a current or a voltage drives the shaft."""

    rig: str
    friction: str
    driven_by: str
    known: Mapping[str, float]
    estimated: tuple[str, ...] = ()
    segment: float = SEGMENT
    """Time [s] that is simulated at once."""

    def build(self, logs: Sequence[Log], delay: int) -> tuple[list[Segment], ShaftModel, list[np.ndarray]]:
        """Segments, model, starts."""
        segments, output = shaft_segments(logs, self.driven_by, delay, self.segment), output_of(logs[0])
        model, starts = shaft_model(
            segments, self.rig, self.friction, self.driven_by, output, self.known, self.estimated
        )
        return segments, model, starts

    def pretended(
        self, logs: Sequence[Log], segments: Sequence[Segment], fit: Fit, model: Any, sign: float
    ) -> list[Log]:
        """The logs as the fit would have made them, segment by segment."""
        return _replaced(logs, segments, fit, model, output_of(logs[0]), sign)


Stage = Winding | Shaft


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """A stage with its logs, and what came of it."""

    stage: Any
    """A `Winding` or a `Shaft`."""
    logs: tuple[Log, ...]
    delay: int
    segments: tuple[Segment, ...]
    model: Any
    fit: Fit
    tried: tuple[Fit, ...]
    """What each start led to."""

    def again(self, logs: Sequence[Log], delay: int | None = None) -> np.ndarray:
        """The parameters that other logs give, from where these ended."""
        segments, _, _ = self.stage.build(logs, self.delay if delay is None else delay)
        return estimate(self.model, segments, [self.fit.values], most=20)[0].values

    def refitted(self, stage: Stage) -> "Fitted":
        """Of the same logs with another stage, from where this ended."""
        segments, model, _ = stage.build(self.logs, self.delay)
        fit, _ = estimate(model, segments, [self.fit.values])
        return dataclasses.replace(self, stage=stage, segments=tuple(segments), model=model, fit=fit)

    def unknown_directions(self, scales: np.ndarray) -> list[dict[str, float]]:
        """Directions in which the parameters may go, and nobody would notice: parameter -> share, the largest 1.

        In the direction that the derivatives say is the weakest, the parameter that has most of it is moved by half its
        scale, and all others are fitted anew: if the logs are then explained as well, what the others did is the
        direction. (Derivatives alone do not tell: dry friction makes them rough, and what is flat looks known.)

        Args:
            scales: what a change of each is measured by, shape (p,).
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
            if _cost(other.fit, fit.scale) > fit.cost + honesty.noticed(fit, here.segments):
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
        fit, _ = estimate(model, self.segments, [np.delete(start, place)], most=20)
        return dataclasses.replace(self, model=model, fit=fit)

    def half_rate(self) -> np.ndarray:
        """The parameters at half the rate, an input being late by half as many rows, rounded."""
        return self.again([halved(log) for log in self.logs], round(self.delay / 2))

    def self_test(self) -> np.ndarray:
        """The parameters found in what the fit would have made of its logs: the mean of two such, of opposed residuals.

        Residuals keep their order and size, stretch by stretch with a random sign, so that they belong together as they
        do in the logs; in the mean of a draw and its opposite what they do at random cancels.
        """
        both = [
            self.again(self.stage.pretended(self.logs, self.segments, self.fit, self.model, sign))
            for sign in (1.0, -1.0)
        ]
        return np.asarray(0.5 * (both[0] + both[1]))


def fitted(stage: Stage, logs: Sequence[Log], on_step: Callable[[], None] = lambda: None, starts: int = 4) -> Fitted:
    """Fit a stage to logs: several starts, then the delays.

    Args:
        stage: what is fitted.
        logs: at least one.
        on_step: called after each start and delay.
        starts: how many at most.
    """
    segments, model, several = stage.build(logs, 0)
    if not model.names:
        fit, tried = estimate(model, segments, several[:1], on_step)
        return Fitted(stage, tuple(logs), 0, tuple(segments), model, fit, tried)
    fit, tried = estimate(model, segments, several[:starts], on_step)
    cost, costs = _cost(fit, fit.scale), {}
    for late in DELAYS:
        other, _, _ = stage.build(logs, late)
        costs[late] = _cost(estimate(model, other, [fit.values], on_step, 6)[0], fit.scale)
    delay = min(costs, key=lambda late: costs[late])
    if not costs[delay] < BETTER * cost:
        return Fitted(stage, tuple(logs), 0, tuple(segments), model, fit, tried)
    segments, model, several = stage.build(logs, delay)
    fit, tried = estimate(model, segments, [fit.values, several[0]])
    return Fitted(stage, tuple(logs), delay, tuple(segments), model, fit, tried)


def _cost(fit: Fit, scale: float) -> float:
    from codrl_mj.identify.estimate import robust_cost

    return robust_cost(np.concatenate(fit.residuals), scale)


def _replaced(
    logs: Sequence[Log], segments: Sequence[Segment], fit: Fit, model: Any, name: str, sign: float
) -> list[Log]:
    signals = [log.signals[name].copy() for log in logs]
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(segments)) * sign
    simulate = model.at(fit.values)
    for place, segment in enumerate(segments):
        clean = simulate(segment, fit.states[place])
        # what is far off is an outlier of the logs, and no noise of the sensor
        noise = np.clip(fit.residuals[place], -3.0 * fit.scale, 3.0 * fit.scale) * segment.deviation
        signals[segment.log][segment.rows] = clean + signs[place] * noise
    return [
        dataclasses.replace(log, signals={**log.signals, name: _rounded(log, name, values)})
        for log, values in zip(logs, signals, strict=True)
    ]


def _rounded(log: Log, name: str, values: np.ndarray) -> np.ndarray:
    step = log.resolution.get(name, 0.0)
    return np.round(values / step) * step if step > 0.0 else values


def _turned(log: Log, segments: Sequence[Segment], place: int) -> Log:
    """A log whose positions are the integral of its segments' speeds, rounded as its sensor rounds."""
    if not log.has("position") or is_locked(log):
        return log
    speed = np.zeros(len(log.time))
    for segment in segments:
        if segment.log == place:
            speed[segment.rows] = segment.speeds
    turns = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(log.time))])
    moved = _rounded(log, "position", log.signals["position"][0] + turns)
    return dataclasses.replace(log, signals={**log.signals, "position": moved})


def moves(log: Log) -> bool:
    """Whether it says anything of the shaft."""
    return (log.has("position") or log.has("velocity")) and not is_locked(log) and bool(usable(log))
