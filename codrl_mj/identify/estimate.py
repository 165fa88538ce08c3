"""Robust output-error fits of all segments at once, with the initial states eliminated.

The initial state of each segment is solved for within each evaluation, and its share of the
Jacobian is projected out (Kaufman 1975, *A variable projection method for solving separable
nonlinear least squares problems*). The outer problem then has only the parameters as unknowns,
regardless of the number of segments.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np

from codrl_mj.identify.log import Log, Segment, halve_rate, shift_signal
from codrl_mj.identify.parameters import DEFAULTS, PARAMETERS

# Dry friction makes the cost rough: smaller steps give useless derivatives.
DIFFERENCE_STEP = 1e-4
"""Step of finite differences, in the parameters' scales."""
MAX_SQUARED_RESIDUALS = 1e30
"""Sum of squared residuals beyond which a simulation counts as diverged."""
SCREENING_EVALUATIONS = 12
"""Evaluations from each start, before the two best fits are optimized further."""
DELAYS = (-1, 1, 2, 3)
"""Delays of the input [rows] that are tried besides 0."""
MAX_DELAY = 20
"""Largest delay [rows]; delays beyond `DELAYS` are tried while the cost falls."""
NUM_STARTS = 4
"""Maximum number of initial guesses from which a fit is started."""
# A delay is accepted only if both conditions hold.
MAX_COST_RATIO = 0.8
"""Largest accepted ratio of the robust cost with a delay to the cost without it."""
MIN_STANDARD_ERRORS = 3.0
"""Smallest accepted mean reduction of the segments' costs, in standard errors of that mean."""
# If a log exceeds both limits, it is faulty, or the model does not describe it.
MAX_MEAN_RESIDUAL = 8.0
"""Largest mean residual attributed to noise, in standard deviations of the sensor."""
MAX_UNEXPLAINED_SHARE = 0.02
"""Largest unexplained share of the variation within a segment."""


class Misfit(NamedTuple):
    """Disagreement of a log with a fitted model that does not explain it."""

    share: float  # unexplained share of the output's variation
    mean_residual: float  # mean residual in standard deviations of the sensor


Simulate = Callable[[Segment, np.ndarray], np.ndarray]
"""Function of a segment and its initial state that returns the output, shape (m,)."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Model(abc.ABC):
    """Model of a winding or a shaft: its input, output, known parameters and free parameters."""

    driven_by: str  # name of the input signal
    output: str  # name of the signal that a simulation is compared with
    known: Mapping[str, float]  # values of parameters that are not fitted
    defaults: Mapping[str, float] = dataclasses.field(default_factory=lambda: DEFAULTS)
    """Values of parameters that are neither fitted nor known."""
    names: tuple[str, ...] = ()  # free parameters; none before `initial_guess`
    scales: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(0))
    """Typical size of each free parameter, > 0, shape (p,)."""
    steps: ClassVar[np.ndarray]  # steps of finite differences of the state, shape (s,)
    difference_step: ClassVar[float] = DIFFERENCE_STEP
    """Step of finite differences of the parameters, in their scales."""

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the free parameters, each of shape (p,)."""
        free = [PARAMETERS[name] for name in self.names]
        return np.array([parameter.lower for parameter in free]), np.array(
            [parameter.upper for parameter in free]
        )

    def all_values(self, values: np.ndarray) -> dict[str, float]:
        """Return all parameters by name; `values` are those of the free ones, shape (p,)."""
        return {
            **self.defaults,
            **self.known,
            **dict(zip(self.names, map(float, values), strict=True)),
        }

    @abc.abstractmethod
    def segments(self, logs: Sequence[Log]) -> list[Segment]:
        """Cut logs into segments."""

    def half_rate_segments(self, logs: Sequence[Log]) -> list[Segment]:
        """Cut logs with every second row into segments."""
        return self.segments([halve_rate(log) for log in logs])

    @abc.abstractmethod
    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """Return the model with free parameters set, and initial guesses, each of shape (p,)."""

    @abc.abstractmethod
    def simulator(self, values: np.ndarray) -> Simulate:
        """Return a function that simulates the output of a segment with parameters (p,)."""


FittedModel = TypeVar("FittedModel", bound=Model)
FittedModel_co = TypeVar("FittedModel_co", bound=Model, covariant=True)


@dataclasses.dataclass(frozen=True, eq=False)
class Fit(Generic[FittedModel_co]):
    """Fitted parameters, with the residuals and Jacobians from which their intervals follow."""

    model: FittedModel_co
    segments: Sequence[Segment]
    values: np.ndarray  # free parameters, shape (p,)
    # Residuals above this scale, in standard deviations of the sensor, count as outliers.
    scale: float
    # Residuals of each segment in standard deviations of the sensor, shape (m,).
    residuals: tuple[np.ndarray, ...]
    # Jacobian of each segment, without the part that its initial state compensates, shape (m, p).
    jacobians: tuple[np.ndarray, ...]
    states: tuple[np.ndarray, ...]  # initial state of each segment
    logs: tuple[Log, ...] = ()  # logs of the segments, with the delay of the input removed
    delay: float = 0  # delay of the input [rows]
    start_fits: tuple[
        "Fit[FittedModel_co]", ...
    ] = ()  # short fits, one from each start, the best first

    @property
    def cost(self) -> float:
        """Robust cost, in squares of the sensors' standard deviations."""
        return robust_cost(np.concatenate(self.residuals), self.scale)

    def costs(self, scale: float) -> np.ndarray:
        """Return the robust cost of each segment."""
        return np.array([robust_cost(residuals, scale) for residuals in self.residuals])

    def weights(self, segment: int) -> np.ndarray:
        """Return the weight of each residual of a segment, 1 for small ones, shape (m,)."""
        return 1.0 / np.sqrt(1.0 + (self.residuals[segment] / self.scale) ** 2)


def robust_cost(residuals: np.ndarray, scale: float) -> float:
    """Return the soft-L1 loss, which for small residuals is their sum of squares."""
    return float(2.0 * scale * scale * np.sum(np.sqrt(1.0 + (residuals / scale) ** 2) - 1.0))


def _residuals(simulate: Simulate, segment: Segment, state: np.ndarray) -> np.ndarray:
    """Return the residuals in standard deviations of the sensor, shape (m,)."""
    residuals: np.ndarray = (simulate(segment, state) - segment.measured) / segment.deviation
    # A diverged simulation gets large finite residuals, from which the optimizer can step back.
    if residuals @ residuals < MAX_SQUARED_RESIDUALS:
        return residuals
    clipped: np.ndarray = np.clip(np.nan_to_num(residuals, nan=1e9), -1e9, 1e9)
    return clipped


class _StateFit(NamedTuple):
    """A segment with its fitted initial state."""

    state: np.ndarray
    residuals: np.ndarray
    columns: np.ndarray  # derivative of the residuals with respect to the state, shape (m, s)


def _fit_state(
    simulate: Simulate,
    segment: Segment,
    state: np.ndarray,
    steps: np.ndarray,
    scale: float,
    max_iterations: int = 4,
) -> _StateFit:
    """Fit the initial state of a segment by damped Gauss-Newton steps from a guess."""
    residuals = _residuals(simulate, segment, state)
    for _ in range(max_iterations):
        columns = np.empty((len(residuals), len(steps)))
        for index, length in enumerate(steps):
            changed = state.copy()
            changed[index] += length
            columns[:, index] = (_residuals(simulate, segment, changed) - residuals) / length
        # Iteratively reweighted least squares: rows are scaled by the roots of the soft-L1 weights.
        row_scales = (1.0 + (residuals / scale) ** 2) ** -0.25
        cost = robust_cost(residuals, scale)
        step = np.linalg.lstsq(row_scales[:, None] * columns, -row_scales * residuals, rcond=1e-9)[
            0
        ]
        # Stop if the predicted reduction of the cost is negligible.
        if np.sum((row_scales * (columns @ step)) ** 2) < 1e-6 * cost:
            break
        for share in (1.0, 0.25):
            candidate = _residuals(simulate, segment, state + share * step)
            if robust_cost(candidate, scale) < cost:
                break
        else:
            break
        state, residuals = state + share * step, candidate
    return _StateFit(state, residuals, columns)


def best_initial_state(model: Model, values: np.ndarray, segment: Segment) -> np.ndarray:
    """Return the initial state with which a segment fits best, with parameters (p,)."""
    simulate = model.simulator(values)
    scale = robust_scale(_residuals(simulate, segment, segment.state))
    return _fit_state(simulate, segment, segment.state, model.steps, scale).state


class _Problem:
    """The outer least-squares problem in the parameters, for scipy.

    Each evaluation fits the initial states. It starts from the states of the last Jacobian,
    extrapolated linearly to the new parameters.
    """

    def __init__(
        self, model: Model, segments: Sequence[Segment], states: Sequence[np.ndarray], scale: float
    ) -> None:
        """Start from guesses of the initial states of the segments."""
        self.model, self.segments, self.scale = model, segments, scale
        # States and their derivatives with respect to the parameters, at the parameters `origin`.
        self.states = list(states)
        self.slopes = [np.zeros((len(state), len(model.names))) for state in states]
        self.origin = np.zeros(len(model.names))
        # scipy asks for residuals and Jacobian at the same parameters: the last solution is reused.
        self.solution: tuple[bytes | None, list[_StateFit]] = None, []

    def fit_states(self, values: np.ndarray, states: Sequence[np.ndarray]) -> list[_StateFit]:
        """Fit the initial state of each segment from a guess."""
        simulate, steps = self.model.simulator(values), self.model.steps
        return [
            _fit_state(simulate, *pair, steps, self.scale)
            for pair in zip(self.segments, states, strict=True)
        ]

    def solve(self, values: np.ndarray) -> list[_StateFit]:
        """Return the segments with their fitted initial states."""
        if self.solution[0] != values.tobytes():
            change = values - self.origin
            states = [
                state + slope @ change
                for state, slope in zip(self.states, self.slopes, strict=True)
            ]
            self.solution = values.tobytes(), self.fit_states(values, states)
        return self.solution[1]

    def choose_best_states(self, values: np.ndarray) -> None:
        """Refit each initial state from its original guess, and keep the better of the two fits."""
        pairs = zip(
            self.solve(values),
            self.fit_states(values, [segment.state for segment in self.segments]),
            strict=True,
        )
        best = [min(pair, key=lambda fit: robust_cost(fit.residuals, self.scale)) for pair in pairs]
        self.solution = values.tobytes(), best

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Return the residuals of all segments, shape (sum of m,)."""
        return np.concatenate([fit.residuals for fit in self.solve(values)])

    def jacobians(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the Jacobian of each segment with its state eliminated, shape (m, p)."""
        fits = self.solve(values)
        self.states, self.slopes, self.origin = [fit.state for fit in fits], [], values.copy()
        model, jacobians = self.model, []
        # Steps must not leave the bounds.
        steps = model.difference_step * model.scales
        signs = np.where(values + steps > model.bounds[1], -1.0, 1.0)
        changes = np.diag(signs * steps)
        simulators = [model.simulator(values + change) for change in changes]
        for segment, (state, residuals, state_columns) in zip(self.segments, fits, strict=True):
            columns = np.empty((len(residuals), len(values)))
            for index, (simulate, change) in enumerate(zip(simulators, changes, strict=True)):
                columns[:, index] = (
                    _residuals(simulate, segment, state) - residuals
                ) / change.sum()
            # The state follows the parameters such that the residuals stay minimal.
            row_scales = ((1.0 + (residuals / self.scale) ** 2) ** -0.25)[:, None]
            self.slopes.append(
                -np.linalg.lstsq(row_scales * state_columns, row_scales * columns, rcond=1e-9)[0]
            )
            jacobians.append(columns + state_columns @ self.slopes[-1])
        return jacobians


def robust_scale(residuals: np.ndarray) -> float:
    """Return 1.5 robust standard deviations of the residuals, but at least 1.5."""
    return 1.5 * max(1.4826 * float(np.median(np.abs(residuals))), 1.0)


def fit_from_starts(
    model: FittedModel,
    segments: Sequence[Segment],
    starts: Sequence[np.ndarray],
    on_start: Callable[[], None] = lambda: None,
) -> tuple[Fit[FittedModel], tuple[Fit[FittedModel], ...]]:
    """Return the best fit from several starts, and the short fits from all starts, best first."""
    fits = []
    for start in starts:
        fits.append(
            optimize(
                model,
                segments,
                start,
                SCREENING_EVALUATIONS,
                states=[segment.state for segment in segments],
            )
        )
        on_start()
    # Costs are comparable only with the same scale.
    scale = min(start_fit.scale for start_fit in fits)

    def cost(fit: Fit[FittedModel]) -> float:
        return robust_cost(np.concatenate(fit.residuals), scale)

    fits.sort(key=cost)
    best_fits = [
        optimize(model, segments, start_fit.values, 40, start_fit.scale, start_fit.states)
        for start_fit in fits[:2]
    ]
    return min(best_fits, key=cost), tuple(fits)


def optimize(
    model: FittedModel,
    segments: Sequence[Segment],
    start: np.ndarray,
    max_evaluations: int = 40,
    scale: float | None = None,
    states: Sequence[np.ndarray] | None = None,
) -> Fit[FittedModel]:
    """Fit the free parameters of a model to segments.

    Args:
        model: model with its free parameters.
        segments: segments to fit.
        start: initial guess, shape (p,).
        max_evaluations: maximum number of evaluations; 0 leaves the parameters at the start.
        scale: size above which a residual counts as an outlier; None derives it from the
            residuals at the start.
        states: initial states of the segments; None fits them at the start.
    """
    from scipy.optimize import least_squares

    if states is None:
        states = [best_initial_state(model, start, segment) for segment in segments]
    lower, upper = model.bounds
    values = np.clip(start, lower, upper)
    if scale is None:
        simulate = model.simulator(values)
        residuals_at_start = [
            _residuals(simulate, segment, state)
            for segment, state in zip(segments, states, strict=True)
        ]
        scale = robust_scale(np.concatenate(residuals_at_start))
    problem = _Problem(model, segments, states, scale)
    if model.names and max_evaluations:
        values = least_squares(
            problem.residuals,
            np.clip(values, lower + 1e-9 * model.scales, upper - 1e-9 * model.scales),
            lambda values: np.concatenate(problem.jacobians(values)),
            bounds=model.bounds,
            x_scale=model.scales,
            loss="soft_l1",
            f_scale=scale,
            max_nfev=max_evaluations,
            xtol=1e-6,
            ftol=1e-6,
            gtol=1e-10,
        ).x
    problem.scale = robust_scale(problem.residuals(values))
    # With dry friction the cost of a segment has several minima over its initial state, and the
    # state that was tracked from the start may be in a worse one.
    problem.choose_best_states(values)
    jacobians = problem.jacobians(values)
    state_fits = problem.solve(values)
    residuals = tuple(fit.residuals for fit in state_fits)
    states = tuple(fit.state for fit in state_fits)
    return Fit(model, segments, values, problem.scale, residuals, tuple(jacobians), states)


def refit_model(fit: Fit[FittedModel], model: FittedModel) -> Fit[FittedModel]:
    """Fit another model to the logs of a fit, starting from the parameters of that fit."""
    segments = model.segments(fit.logs)
    refit = optimize(model.initial_guess(segments)[0], segments, fit.values)
    return dataclasses.replace(refit, logs=fit.logs, delay=fit.delay, start_fits=fit.start_fits)


def fit_model(
    model: FittedModel, logs: Sequence[Log], on_step: Callable[[], None] = lambda: None
) -> Fit[FittedModel]:
    """Fit a model to logs from several starts, and then the delay of its input.

    For a winding, a delay longer and one shorter by half a row are tried, too. If both fit clearly
    worse, the voltage was held between rows. If one fits clearly better, the voltage was sampled at
    the times of the rows, and that delay is used. In both cases the shifted voltage equals the mean
    until the next row, and the logs of the fit are marked with `mean_voltage`.
    """
    segments = model.segments(logs)
    model, starts = model.initial_guess(segments)
    if not model.names:
        fit = optimize(model, segments, starts[0])
        on_step()
        return dataclasses.replace(fit, logs=tuple(logs), start_fits=(fit,))
    fit, start_fits = fit_from_starts(model, segments, starts[:NUM_STARTS], on_step)
    costs: dict[float, np.ndarray] = {0: fit.costs(fit.scale)}

    def delayed_logs(delay: float) -> list[Log]:
        return [shift_signal(log, model.driven_by, delay) for log in logs]

    def try_delays(*delays: float) -> float:
        """Compute the costs of delays, and return the best one so far; 0 if not accepted."""
        for candidate in delays:
            costs[candidate] = optimize(
                model, model.segments(delayed_logs(candidate)), fit.values, 20, fit.scale
            ).costs(fit.scale)
            on_step()
        best = min(costs, key=lambda candidate: costs[candidate].sum())
        return best if _is_better(costs[best], costs[0]) else 0

    delay = try_delays(*DELAYS)
    # While the best delay is the first or the last of those tried, the next one may be better.
    while delay != 0 and delay in (min(costs), max(costs)) and abs(delay) < MAX_DELAY:
        delay = try_delays(delay + (1 if delay > 0 else -1))
    shifted_logs = delayed_logs(delay)
    if model.output == "current" and not all(log.mean_voltage for log in logs):
        whole_costs = costs[delay]
        try_delays(delay - 0.5, delay + 0.5)
        half = min(delay - 0.5, delay + 0.5, key=lambda candidate: costs[candidate].sum())
        delay = half if _is_better(costs[half], whole_costs) else delay
        if delay == half or _is_better(whole_costs, costs[half]):
            shifted_logs = [
                dataclasses.replace(log, mean_voltage=True) for log in delayed_logs(delay)
            ]
    if delay != 0:
        segments = model.segments(shifted_logs)
        model, starts = model.initial_guess(segments)
        fit, start_fits = fit_from_starts(model, segments, [fit.values, starts[0]])
    return dataclasses.replace(fit, logs=tuple(shifted_logs), delay=delay, start_fits=start_fits)


def _is_better(costs: np.ndarray, reference: np.ndarray) -> bool:
    """Return True if the costs of the segments are significantly below reference costs."""
    reductions = reference - costs
    error = reductions.std(ddof=1) / np.sqrt(len(reductions)) if len(reductions) > 1 else 0.0
    return bool(
        costs.sum() < MAX_COST_RATIO * reference.sum()
        and reductions.mean() > MIN_STANDARD_ERRORS * error
    )


def fit_warnings(fit: Fit[Model], misfits: dict[str, Misfit]) -> list[str]:
    """Return warnings about the logs or the model of a fit.

    Args:
        fit: fit of a model to logs.
        misfits: filled with the misfit of each log that the model explains poorly.
    """
    unexplained: dict[str, str] = {}
    for index, log in enumerate(fit.logs):
        pairs = [
            pair for pair in zip(fit.segments, fit.residuals, strict=True) if pair[0].log == index
        ]
        sizes = np.concatenate([np.abs(residuals) for _, residuals in pairs])
        errors = np.concatenate([residuals * segment.deviation for segment, residuals in pairs])
        variations = np.concatenate(
            [segment.measured - segment.measured.mean() for segment, _ in pairs]
        )
        share = float(np.std(errors) / max(np.std(variations), 1e-12))
        # The mean absolute value of normal noise is 0.8 standard deviations.
        mean_residual = float(sizes.mean()) / 0.8
        if mean_residual > MAX_MEAN_RESIDUAL and share > MAX_UNEXPLAINED_SHARE:
            misfits[log.name] = Misfit(share, mean_residual)
            unexplained[log.name] = (
                f"{mean_residual:.1f} standard deviations of the sensor, {100.0 * share:.2g} %"
                " of the output's variation"
            )
    warnings = []
    if 1 < len(unexplained) == len(fit.logs):
        warnings.append(
            "the model does not explain any of the logs within the noise of their sensors: the"
            f" mean residuals of the first log are {next(iter(unexplained.values()))}. Choose a"
            " richer friction model (--friction), or find out what else acted on the shaft"
        )
    else:
        warnings += [
            f"log {name}: mean residuals are {text}: the model does not explain the log. Leave it"
            " out, find out what else acted on the shaft, or choose a richer friction model"
            for name, text in unexplained.items()
        ]
    values = np.array([start_fit.values for start_fit in fit.start_fits])
    costs = np.array(
        [np.mean(np.abs(np.concatenate(start_fit.residuals))) for start_fit in fit.start_fits]
    )
    nearly_best = costs < 1.1 * costs.min()
    spreads = np.ptp(values[nearly_best], axis=0) / np.maximum(np.abs(fit.values), fit.model.scales)
    if np.any(spreads > 0.2):
        names = ", ".join(
            name for name, spread in zip(fit.model.names, spreads, strict=True) if spread > 0.2
        )
        warnings.append(
            "several minima: fits from different starts end within 10 % of the best cost, but"
            f" differ in {names}"
        )
    return warnings
