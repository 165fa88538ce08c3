"""How far a fit may be trusted: resampling, other data of the same kind, and directions that no data tell.

Intervals from the curvature at the optimum are a lie where the model is not exact, and it never is. So whole stretches
of the logs are resampled, and the interval is widened by what differs between logs, by what is found when the fit is
simulated and fitted again, and by what is found at half the rate.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from codrl_mj.identify.estimate import Fit, refit
from codrl_mj.identify.log import Log
from codrl_mj.identify.models import WindingModel
from codrl_mj.identify.segments import halved, moves, replaced

LEAST_LOGS = 5  # from so many logs on whole logs are resampled; below, blocks of them
DRAWS = 500
FLAT = 1e-12  # of parameters in units in which each alone is known to 1, a direction counts as known to 1e6 at worst
ATTENUATION = 6.0
"""How much larger than the share of variance that is not explained the bias by errors of the input may be."""
SLACK = 1e-3  # share of the cost that a fit may be better by luck: dry friction has many minima
UNKNOWN = 0.5  # a direction in which the parameters may go by so much of themselves, unnoticed, is not identified
PART = 0.1  # share of such a direction from which a parameter belongs to it


def total(causes: Mapping[str, np.ndarray]) -> np.ndarray:
    """The largest of three half-widths, and what the rate does, as what is independent adds up; then the biases."""
    wide = np.max([causes["curvature"], causes["resampling"], causes["logs"]], axis=0)
    return np.asarray(np.hypot(wide, causes["half_rate"]) + causes["self_test"] + causes["unexplained"])


def _unexplained(fit: Fit) -> float:
    """Share by which a factor of the input may be off for what is not explained.

    Errors of the input, as of a voltage that changes between the rows, attenuate its factor by a multiple of their
    share of the variance: 2 to 4.6 of PRBS whose clock is 1 to 4 rows; no fit of fewer rows shows it.
    """
    rest = sum(one.deviation**2 * float(fit.weights(i) @ fit.residuals[i] ** 2) for i, one in enumerate(fit.segments))
    swing = sum(float(np.var(one.measured)) * len(one.measured) for one in fit.segments)
    return ATTENUATION * rest / max(swing, 1e-300)


def _sums(fit: Fit, groups: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (c, p) and Gauss-Newton matrix (c, p, p) of each group of segments."""
    count, size = len(set(groups)), len(fit.values)
    gradients, matrices = np.zeros((count, size)), np.zeros((count, size, size))
    place = {group: index for index, group in enumerate(dict.fromkeys(groups))}
    for index, group in enumerate(groups):
        weighted = fit.jacobians[index] * fit.weights(index)[:, None]
        gradients[place[group]] += weighted.T @ fit.residuals[index]
        matrices[place[group]] += weighted.T @ fit.jacobians[index]
    return gradients, matrices


def _noise(fit: Fit) -> float:
    """Mean square of the residuals, as much as they count."""
    return float(np.mean(np.concatenate([fit.weights(i) * r**2 for i, r in enumerate(fit.residuals)])))


def _inverse(matrix: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The inverse, large and never 0 along what is not known; none of it is lost beside what is known far better."""
    known = np.diag(matrix) * scales**2
    units = scales / np.sqrt(np.maximum(known, 1e-16 * known.max() + 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(units, units))
    return np.asarray((vectors / np.maximum(values, FLAT)) @ vectors.T * np.outer(units, units))


def causes(
    fit: Fit, values: np.ndarray, scales: np.ndarray, of: np.ndarray, seed: int, on_step: Callable[[], None]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Half-widths by cause of `values` (q,), which are `of` @ the parameters, and what the self-test finds for them."""
    electrical = isinstance(fit.model, WindingModel)
    found = half_widths(fit, scales, of, seed)
    on_step()
    # two fits to what the fit would have made of its logs, of opposed residuals: in their mean what is random cancels
    tested = values + of @ (
        np.asarray(0.5 * sum(_again(fit, _pretended(fit, sign)) for sign in (1.0, -1.0))) - fit.values
    )
    on_step()
    # an error that goes with a row's time is half as large at the rate of the logs, one with its root more than that
    halves = _again(fit, [halved(log) for log in fit.logs])
    found["half_rate"] = (2.0 if electrical else 1.0) * np.abs(of @ (halves - fit.values))
    on_step()
    found["self_test"] = np.abs(tested - values)
    found["unexplained"] = np.abs(values) * (_unexplained(fit) if electrical else 0.0)
    return found, tested


def half_widths(fit: Fit, scales: np.ndarray, of: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Half-widths of 95 % intervals by cause, each of shape (q,), of `of` @ the parameters with `of` of shape (q, p).

    `curvature`: were the model exact and each residual by itself: never less, however few the stretches. `resampling`:
    by refits of stretches drawn with replacement, each a Gauss-Newton step from the fit; few stretches tell little of
    how they differ, and percentiles are stretched to Student's. `logs`: two standard deviations of the mean of how logs
    pull; 0 for a single log.
    """
    from scipy.stats import t

    by_log, by_block = (_sums(fit, [getattr(one, part) for one in fit.segments]) for part in ("log", "block"))
    inverse = _inverse(by_block[1].sum(axis=0), scales)
    curvature = 1.96 * np.sqrt(_noise(fit) * np.diag(of @ inverse @ of.T))
    logs, count = np.zeros(len(of)), len(by_log[0])
    if count > 1:
        logs = 2.0 * (count * by_log[0] @ inverse @ of.T).std(axis=0, ddof=1) / np.sqrt(count)
    gradients, matrices = by_log if count >= LEAST_LOGS else by_block
    resampling, count = np.full(len(of), np.inf), len(gradients)
    if count > 1:
        drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), DRAWS)
        moved = [-_inverse(np.tensordot(times, matrices, 1), scales) @ (times @ gradients) for times in drawn]
        low, high = np.percentile(np.array(moved) @ of.T, [2.5, 97.5], axis=0)
        few = t.ppf(0.975, count - 1) / t.ppf(0.975, 1e6) * np.sqrt(count / (count - 1.0))
        resampling = np.maximum(-low, high) * few
    return {"curvature": curvature, "resampling": resampling, "logs": logs}


def correlations(fit: Fit) -> dict[str, dict[str, float]]:
    """Of the parameters, each with each, by the Jacobian: near 1 or -1, one may stand for the other."""
    names = fit.model.names
    if not names:
        return {}
    _, matrices = _sums(fit, [0] * len(fit.residuals))
    covariance = _inverse(matrices[0], np.ones(len(names)))
    spread = np.sqrt(np.diag(covariance))
    table = np.clip(covariance / np.outer(spread, spread), -1.0, 1.0).tolist()
    return {name: dict(zip(names, row, strict=True)) for name, row in zip(names, table, strict=True)}


def unknown_directions(fit: Fit, scales: np.ndarray) -> list[dict[str, float]]:
    """Directions in which the parameters may go, and nobody would notice: parameter -> share, the largest 1.

    In the direction that the derivatives say is the weakest, the parameter that has most of it is moved by half its
    scale, shape (p,), and all others are fitted anew: if the logs are then explained as well, what the others did is
    the direction. (Derivatives alone do not tell: dry friction makes them rough, and what is flat looks known.)
    """
    found: list[dict[str, float]] = []
    here, own = fit, scales
    while len(here.model.names) > 1 or not found:
        model, values = here.model, here.values
        matrix = _sums(here, [one.block for one in here.segments])[1].sum(axis=0)
        direction = np.linalg.eigh(matrix * np.outer(own, own))[1][:, 0]  # a unit vector, in the scales
        place = int(np.argmax(np.abs(direction)))
        step = UNKNOWN * own[place] * np.sign(direction[place])
        if not model.lower[place] <= values[place] + step <= model.upper[place]:
            step = -step
        start = np.clip(values + step / own[place] / direction[place] * direction * own, 0.2 * values, None)
        rest = dataclasses.replace(
            model,
            names=tuple(np.delete(model.names, place).tolist()),
            known={**model.known, model.names[place]: float(values[place] + step)},
            scales=np.delete(model.scales, place),
        )
        other = refit(rest, here.segments, np.delete(start, place), 20, here.scale)
        if other.costs(here.scale).sum() > here.cost + _noticed(here):
            break
        changes = (other.values - np.delete(values, place)) / np.delete(own, place)
        shares = np.insert(changes, place, step / own[place]) / step * own[place]
        found.append({name: float(s) for name, s in zip(model.names, shares, strict=True) if abs(s) > PART})
        if len(model.names) == 1:
            break
        here, own = other, np.delete(own, place)
    return found


def _noticed(fit: Fit) -> float:
    """By how much the robust cost must rise to be more than chance, at 95 %.

    Residuals of a block belong together: the ratio of both estimates of the covariance along the direction that is
    known best, by blocks and by rows, makes up for that.
    """
    gradients, matrices = _sums(fit, [segment.block for segment in fit.segments])
    whole = matrices.sum(axis=0)
    root = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    strengths, vectors = np.linalg.eigh(whole / root / root[:, None])
    pulls = gradients / root @ vectors[:, -1]
    noise = _noise(fit)
    together = max(float(pulls @ pulls) / max(strengths[-1] * noise, 1e-30), 1.0)
    return 3.84 * noise * together + SLACK * fit.cost


def _again(fit: Fit, logs: Sequence[Log]) -> np.ndarray:
    """The parameters that other logs give, from where a fit ended."""
    return refit(fit.model, fit.model.segments(logs), fit.values, 20).values


def _pretended(fit: Fit, sign: float) -> list[Log]:
    """The logs as the fit would have made them, rounded anew; of a winding also what it took for the motion.

    Residuals keep order and size, stretch by stretch with a random sign, so that they belong together as in the logs.
    """
    output, simulate = fit.model.output, fit.model.at(fit.values)
    signals = [log.signals[output].copy() for log in fit.logs]
    speeds = [np.zeros(len(log.time)) for log in fit.logs]
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(fit.segments)) * sign
    for place, segment in enumerate(fit.segments):
        # what is far off is an outlier of the logs, and no noise of the sensor
        noise = np.clip(fit.residuals[place], -3.0 * fit.scale, 3.0 * fit.scale) * segment.deviation
        signals[segment.log][segment.rows] = simulate(segment, fit.states[place]) + signs[place] * noise
        speeds[segment.log][segment.rows] = segment.speeds
    made = []
    for log, values, speed in zip(fit.logs, signals, speeds, strict=True):
        made.append(_rounded(log, output, values))
        if isinstance(fit.model, WindingModel) and log.has("position") and moves(log):
            turns = np.append(0.0, np.cumsum(speed[:-1] * np.diff(log.time)))
            made[-1] = _rounded(made[-1], "position", log.signals["position"][0] + turns)
    return made


def _rounded(log: Log, name: str, values: np.ndarray) -> Log:
    """A log with another signal, rounded as its sensor rounds."""
    step = log.resolution.get(name, 0.0)
    return replaced(log, name, np.round(values / step) * step if step > 0.0 else values)
