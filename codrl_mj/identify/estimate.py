"""Output error: parameters of all segments at once, the initial states of each eliminated, a robust loss.

The states are solved for within each evaluation, and their share of the Jacobian is projected out
(Kaufman 1975, *A variable projection method for solving separable nonlinear least squares
problems*), so that the outer problem has a handful of unknowns however many segments there are.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from codrl_mj.identify.log import Log, Segment, shift_signal
from codrl_mj.identify.parameters import DEFAULTS, PARAMETERS

# step of finite differences, in the parameters' scales: dry friction makes smaller ones rough
DIFFERENCE_STEP = 1e-4
MAX_SQUARED_RESIDUALS = 1e30
SCREENING_EVALUATIONS = 12  # evaluations from each of several starts
DELAYS = (-1, 1, 2, 3)  # rows that the input is tried to be late by, besides 0;
MAX_DELAY = 20  # and on to so many, while that is better
NUM_STARTS = 4
MAX_COST_RATIO = 0.8  # a delay is believed where it takes the robust cost to less than this share, and
# lowers that of the segments by more, in the mean, than so many standard deviations of that mean
MIN_DEVIATIONS = 3.0
MAX_MEAN_RESIDUAL = 8.0  # residuals of more standard deviations of the sensor in the mean are no noise,
MAX_UNEXPLAINED_SHARE = 0.02
"""and more than this share of what moves within a segment is not explained: the log is bad, or the model is."""
Simulate = Callable[[Segment, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Model(abc.ABC):
    """A part of a motor: what drives it, what is known of it and what is fitted; how it does so is a subclass's."""

    driven_by: str  # signal of a log
    output: str  # signal that a simulation is compared with
    known: Mapping[str, float]  # values of parameters that are not fitted
    defaults: Mapping[str, float] = dataclasses.field(default_factory=lambda: DEFAULTS)
    """Values of parameters that are neither fitted nor known."""
    names: tuple[str, ...] = ()  # free parameters; none before `initial_guess`
    scales: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(0))
    """What a change of each is measured by, > 0, shape (p,)."""
    steps: ClassVar[np.ndarray]  # steps of finite differences of the state, shape (s,)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest values of the free parameters, each of shape (p,)."""
        free = [PARAMETERS[name] for name in self.names]
        return np.array([one.lower for one in free]), np.array([one.upper for one in free])

    def all_values(self, values: np.ndarray) -> dict[str, float]:
        """Free and known parameters by name."""
        return {
            **self.defaults,
            **self.known,
            **dict(zip(self.names, map(float, values), strict=True)),
        }

    @abc.abstractmethod
    def segments(self, logs: Sequence[Log]) -> list[Segment]:
        """The logs, cut."""

    @abc.abstractmethod
    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """With what is free in such segments, and starts for it, each of shape (p,)."""

    @abc.abstractmethod
    def simulator(self, values: np.ndarray) -> Simulate:
        """(segment, state at its beginning) -> what the sensor would have seen, shape (m,), for parameters (p,)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that fit, and what is needed to judge them."""

    model: Any  # a `Model`
    segments: Sequence[Segment]
    values: np.ndarray  # shape (p,)
    scale: float  # residuals beyond this, in standard deviations of the sensor, count less
    residuals: tuple[
        np.ndarray, ...
    ]  # of each segment, in standard deviations of the sensor, shape (m,)
    jacobians: tuple[
        np.ndarray, ...
    ]  # of each segment, what its states cannot do taken out, shape (m, p)
    states: tuple[np.ndarray, ...]  # at the beginning of each segment
    logs: tuple[Log, ...] = ()  # of the segments, with the input in time
    delay: float = 0  # rows by which it was late
    start_fits: tuple["Fit", ...] = ()  # what each start led to

    @property
    def cost(self) -> float:
        """Robust cost, in squares of the sensors' standard deviations."""
        return robust_cost(np.concatenate(self.residuals), self.scale)

    def costs(self, scale: float) -> np.ndarray:
        """Robust cost of each segment."""
        return np.array([robust_cost(residuals, scale) for residuals in self.residuals])

    def weights(self, segment: int) -> np.ndarray:
        """What each of a segment's residuals counts: 1 where it is small, shape (m,)."""
        return 1.0 / np.sqrt(1.0 + (self.residuals[segment] / self.scale) ** 2)


def robust_cost(residuals: np.ndarray, scale: float) -> float:
    """Soft-L1 loss, the sum of squares where residuals are small."""
    return float(2.0 * scale * scale * np.sum(np.sqrt(1.0 + (residuals / scale) ** 2) - 1.0))


def _residuals(simulate: Simulate, segment: Segment, state: np.ndarray) -> np.ndarray:
    found = (simulate(segment, state) - segment.measured) / segment.deviation
    return found if found @ found < MAX_SQUARED_RESIDUALS else np.clip(np.nan_to_num(found, nan=1e9), -1e9, 1e9)


class _Settled(NamedTuple):
    """A segment from the state from which it fits best."""

    state: np.ndarray
    residuals: np.ndarray
    columns: np.ndarray  # how these change with the state, shape (m, s)


def _settle(
    simulate: Simulate,
    segment: Segment,
    state: np.ndarray,
    steps: np.ndarray,
    scale: float,
    most: int = 4,
) -> _Settled:
    """The segment from the best state near one, by Gauss-Newton steps that are cut where they are too long."""
    here = _residuals(simulate, segment, state)
    for _ in range(most):
        columns = np.empty((len(here), len(steps)))
        for place, length in enumerate(steps):
            moved = state.copy()
            moved[place] += length
            columns[:, place] = (_residuals(simulate, segment, moved) - here) / length
        root, cost = (1.0 + (here / scale) ** 2) ** -0.25, robust_cost(here, scale)
        step = np.linalg.lstsq(root[:, None] * columns, -root * here, rcond=1e-9)[0]
        if np.sum((root * (columns @ step)) ** 2) < 1e-6 * cost:  # all that it could gain
            break
        for share in (1.0, 0.25):
            tried = _residuals(simulate, segment, state + share * step)
            if robust_cost(tried, scale) < cost:
                break
        else:
            break
        state, here = state + share * step, tried
    return _Settled(state, here, columns)


def best_initial_state(model: Model, values: np.ndarray, segment: Segment) -> np.ndarray:
    """The state from which a segment fits best, by the parameters (p,)."""
    simulate = model.simulator(values)
    scale = robust_scale(_residuals(simulate, segment, segment.state))
    return _settle(simulate, segment, segment.state, model.steps, scale).state


class _Problem:
    """The outer problem, as scipy takes it; begins from the states at the last Jacobian, moved as that says."""

    def __init__(
        self, model: Model, segments: Sequence[Segment], states: Sequence[np.ndarray], scale: float
    ) -> None:
        self.model, self.segments, self.scale = model, segments, scale
        self.known = list(states)
        self.slopes = [
            np.zeros((len(one), len(model.names))) for one in states
        ]  # of the states by the parameters, at
        self.origin = np.zeros(len(model.names))
        self.at: tuple[bytes | None, list[_Settled]] = None, []

    def settle(self, values: np.ndarray, states: Sequence[np.ndarray]) -> list[_Settled]:
        simulate, steps = self.model.simulator(values), self.model.steps
        return [
            _settle(simulate, *pair, steps, self.scale)
            for pair in zip(self.segments, states, strict=True)
        ]

    def solve(self, values: np.ndarray) -> list[_Settled]:
        if self.at[0] != values.tobytes():
            moved = values - self.origin
            states = [
                one + slope @ moved for one, slope in zip(self.known, self.slopes, strict=True)
            ]
            self.at = values.tobytes(), self.settle(values, states)
        return self.at[1]

    def reconsider(self, values: np.ndarray) -> None:
        """Begin each segment from where it fits best: what is known, or its own guess."""
        both = zip(
            self.solve(values),
            self.settle(values, [one.state for one in self.segments]),
            strict=True,
        )
        best = [min(pair, key=lambda one: robust_cost(one.residuals, self.scale)) for pair in both]
        self.at = values.tobytes(), best

    def residuals(self, values: np.ndarray) -> np.ndarray:
        return np.concatenate([one.residuals for one in self.solve(values)])

    def jacobians(self, values: np.ndarray) -> list[np.ndarray]:
        found = self.solve(values)
        self.known, self.slopes, self.origin = [one.state for one in found], [], values.copy()
        model, made = self.model, []
        inward = np.where(values + DIFFERENCE_STEP * model.scales > model.bounds[1], -1.0, 1.0)
        moves = np.diag(inward * DIFFERENCE_STEP * model.scales)
        moved = [model.simulator(values + move) for move in moves]
        for segment, (state, residuals, own) in zip(self.segments, found, strict=True):
            columns = np.empty((len(residuals), len(values)))
            for place, (simulate, move) in enumerate(zip(moved, moves, strict=True)):
                columns[:, place] = (_residuals(simulate, segment, state) - residuals) / move.sum()
            root = ((1.0 + (residuals / self.scale) ** 2) ** -0.25)[:, None]
            self.slopes.append(-np.linalg.lstsq(root * own, root * columns, rcond=1e-9)[0])
            made.append(columns + own @ self.slopes[-1])
        return made


def robust_scale(residuals: np.ndarray) -> float:
    """One and a half standard deviations of what is no outlier, and at least those of the sensor."""
    return 1.5 * max(1.4826 * float(np.median(np.abs(residuals))), 1.0)


def fit_from_starts(
    model: Model,
    segments: Sequence[Segment],
    starts: Sequence[np.ndarray],
    on_start: Callable[[], None] = lambda: None,
) -> tuple[Fit, tuple[Fit, ...]]:
    """The best fit from any of several starts, and what each of them led to, the best first."""
    found = []
    for start in starts:
        found.append(
            optimize(model, segments, start, SCREENING_EVALUATIONS, states=[segment.state for segment in segments])
        )
        on_start()
    least = min(one.scale for one in found)

    def cost(fit: Fit) -> float:
        return robust_cost(np.concatenate(fit.residuals), least)

    found.sort(key=cost)
    polished = [optimize(model, segments, one.values, 40, one.scale, one.states) for one in found[:2]]
    return min(polished, key=cost), tuple(found)


def optimize(
    model: Model,
    segments: Sequence[Segment],
    start: np.ndarray,
    most: int = 40,
    scale: float | None = None,
    states: Sequence[np.ndarray] | None = None,
) -> Fit:
    """A fit from a start, and from states or those that fit it best; without a scale that of what they leave."""
    from scipy.optimize import least_squares

    if states is None:
        states = [best_initial_state(model, start, one) for one in segments]
    lower, upper = model.bounds
    values = np.clip(start, lower, upper)
    if scale is None:
        simulate = model.simulator(values)
        left = [
            _residuals(simulate, one, state) for one, state in zip(segments, states, strict=True)
        ]
        scale = robust_scale(np.concatenate(left))
    problem = _Problem(model, segments, states, scale)
    if model.names and most:
        values = least_squares(
            problem.residuals,
            np.clip(values, lower + 1e-9 * model.scales, upper - 1e-9 * model.scales),
            lambda values: np.concatenate(problem.jacobians(values)),
            bounds=model.bounds,
            x_scale=model.scales,
            loss="soft_l1",
            f_scale=scale,
            max_nfev=most,
            xtol=1e-6,
            ftol=1e-6,
            gtol=1e-10,
        ).x
    problem.scale = robust_scale(problem.residuals(values))
    problem.reconsider(
        values
    )  # dry friction gives a segment several minima: that under other parameters may be worse
    jacobians = problem.jacobians(values)
    found = problem.solve(values)
    residuals = tuple(one.residuals for one in found)
    states = tuple(one.state for one in found)
    return Fit(model, segments, values, problem.scale, residuals, tuple(jacobians), states)


def refit_model(fit: Fit, model: Model) -> Fit:
    """Another model of the same logs, from where a fit ended."""
    segments = model.segments(fit.logs)
    found = optimize(model.initial_guess(segments)[0], segments, fit.values)
    return dataclasses.replace(found, logs=fit.logs, delay=fit.delay, start_fits=fit.start_fits)


def fit_model(model: Model, logs: Sequence[Log], on_step: Callable[[], None] = lambda: None) -> Fit:
    """Fit a model to logs: several starts, then the delays.

    A voltage whose mean between two rows fits worse than itself is shown to hold from row to row:
    then it is also the mean, which fewer rows can be given. One that fits better is that of the
    rows' times, and taken half a row later.
    """
    segments = model.segments(logs)
    model, starts = model.initial_guess(segments)
    if not model.names:
        fit = optimize(model, segments, starts[0])
        on_step()
        return dataclasses.replace(fit, logs=tuple(logs), start_fits=(fit,))
    fit, start_fits = fit_from_starts(model, segments, starts[:NUM_STARTS], on_step)
    costs: dict[float, np.ndarray] = {0: fit.costs(fit.scale)}

    def late(delay: float) -> list[Log]:
        return [shift_signal(log, model.driven_by, delay) for log in logs]

    def measure(*delays: float) -> float:
        """Their costs; returns the best delay that is believed."""
        for one in delays:
            costs[one] = optimize(model, model.segments(late(one)), fit.values, 20, fit.scale).costs(
                fit.scale
            )
            on_step()
        best = min(costs, key=lambda one: costs[one].sum())
        return best if _better(costs[best], costs[0]) else 0

    delay = measure(*DELAYS)
    while delay != 0 and delay in (min(costs), max(costs)) and abs(delay) < MAX_DELAY:
        delay = measure(delay + (1 if delay > 0 else -1))
    told = late(delay)
    if model.output == "current" and not all(log.mean_voltage for log in logs):
        whole = costs[delay]
        measure(delay - 0.5, delay + 0.5)
        half = min(delay - 0.5, delay + 0.5, key=lambda one: costs[one].sum())
        delay = half if _better(costs[half], whole) else delay
        if delay == half or _better(whole, costs[half]):
            told = [dataclasses.replace(log, mean_voltage=True) for log in late(delay)]
    if delay != 0:
        segments = model.segments(told)
        model, starts = model.initial_guess(segments)
        fit, start_fits = fit_from_starts(model, segments, [fit.values, starts[0]])
    return dataclasses.replace(fit, logs=tuple(told), delay=delay, start_fits=start_fits)


def _better(these: np.ndarray, those: np.ndarray) -> bool:
    """Whether costs of segments are lower than others, by more than chance."""
    gained = those - these
    error = gained.std(ddof=1) / np.sqrt(len(gained)) if len(gained) > 1 else 0.0
    return bool(these.sum() < MAX_COST_RATIO * those.sum() and gained.mean() > MIN_DEVIATIONS * error)


def fit_warnings(fit: Fit, shares: dict[str, float]) -> list[str]:
    """Return what a fit says is wrong with its logs or its model; `shares` gets the unexplained share of each log."""
    unlike: dict[str, str] = {}
    for place, log in enumerate(fit.logs):
        own = [
            pair for pair in zip(fit.segments, fit.residuals, strict=True) if pair[0].log == place
        ]
        sizes = np.concatenate([np.abs(residuals) for _, residuals in own])
        rest = np.concatenate([residuals * segment.deviation for segment, residuals in own])
        swing = np.concatenate([segment.measured - segment.measured.mean() for segment, _ in own])
        share = float(np.std(rest) / max(np.std(swing), 1e-12))
        if sizes.mean() / 0.8 > MAX_MEAN_RESIDUAL and share > MAX_UNEXPLAINED_SHARE:
            shares[log.name] = max(share, shares.get(log.name, 0.0))
            unlike[log.name] = (
                f"{sizes.mean() / 0.8:.1f} standard deviations of the sensor, {100.0 * share:.2g} %"
                " of what moves"
            )
    found = []
    if 1 < len(unlike) == len(fit.logs):
        found.append(
            "the model does not explain any of the logs within what their sensors see: of the"
            f" first, residuals are {next(iter(unlike.values()))}. Fit more friction, or find out"
            " what else moved"
        )
    else:
        found += [
            f"log {name}: residuals are {text} in the mean: the model does not explain it. Leave it"
            " out, find out what else moved, or fit more friction"
            for name, text in unlike.items()
        ]
    values = np.array([one.values for one in fit.start_fits])
    costs = np.array([np.mean(np.abs(np.concatenate(one.residuals))) for one in fit.start_fits])
    near = costs < 1.1 * costs.min()
    apart = np.ptp(values[near], axis=0) / np.maximum(np.abs(fit.values), fit.model.scales)
    if np.any(apart > 0.2):
        names = ", ".join(
            name for name, one in zip(fit.model.names, apart, strict=True) if one > 0.2
        )
        found.append(
            f"several minima: starts ended within 10 % of the best cost, but apart in {names}"
        )
    return found
