"""Voltage and torque balances of a log by linear regression, without differentiating anything; lags by them.

Both balances are multiplied by functions phi that vanish with their slope at both ends of a window,
and integrated: the derivatives go over to phi. Source: Shinbrot, *On the Analysis of Linear and
Nonlinear Systems* (1957), the method of modulating functions. Good for signs, orders of magnitude
and starts; noise in what is regressed on biases it.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.log import Log, sensor_deviation, gapless_stretches

_ROWS = 12  # rows of a window, at least
_LONGEST = 20_000  # rows of a log beyond which a lag is not looked for
_WINDOWS = 400  # more tell no more of a lag
_BUMP = np.polynomial.Polynomial([0.0, 1.0, -1.0]) ** 5
"""s - s^2 to a power so high that the trapezoidal rule is good for phi'' too."""
_UNIT = _BUMP / _BUMP.integ()(1.0)
_PHI = {-1: _UNIT.integ(), 0: _UNIT, 1: _UNIT.deriv(), 2: _UNIT.deriv(2)}
"""Order of the derivative by the phase -> polynomial; -1: its integral."""
NONNEGATIVE_TERMS = (
    "inertia",
    "viscous",
    "coulomb",
)  # terms of a torque balance that no body and no friction has negative


class Balance(NamedTuple):
    """A regression over the windows of a log."""

    values: Mapping[str, float]  # term -> its coefficient
    certainty: Mapping[str, float]  # term -> its coefficient over its standard error
    unexplained: float  # root mean square of the residual over that of what was to be explained
    residual: float  # root mean square of the residual, in the unit of what was to be explained


class Windows:
    """A log cut into overlapping windows, in each of which signals are weighted by phi ~ (s - s^2)^5, s in [0, 1]."""

    def __init__(self, log: Log, duration: float = 0.0, most: int = 20_000) -> None:
        """Cut it."""
        duration = min(duration, float(log.time[-1] - log.time[0]) / 10.0)
        count = max(math.ceil(duration / log.step), _ROWS)
        every = np.concatenate(
            [np.arange(one.start, one.stop - count, max(count // 4, 1)) for one in gapless_stretches(log)]
        )
        self.rows = every[:: math.ceil(len(every) / most) or 1, None] + np.arange(count + 1)
        self._log = log
        time = log.time[self.rows] if self.rows.size else np.zeros(self.rows.shape)
        self.begin, self.length = time[:, :1], time[:, -1:] - time[:, :1]
        self._phase = (time - self.begin) / np.where(self.length > 0.0, self.length, 1.0)
        self._steps = np.diff(time, axis=1)
        self._weights: dict[int, np.ndarray] = {}

    def mean(self, signal: str | np.ndarray, order: int = 0) -> np.ndarray:
        """The weighted mean of a signal's derivative of some order, shape (windows,)."""
        values = (self._log.signals[signal] if isinstance(signal, str) else signal)[self.rows]
        if order > 0:  # what is constant counts for nothing, and would only be rounded
            values = values - values.mean(axis=1, keepdims=True)
        if order not in self._weights:
            self._weights[order] = _PHI[order](self._phase) * (-1.0 / self.length) ** order
        weighted = values * self._weights[order]
        return (
            np.sum(0.5 * self._steps * (weighted[:, 1:] + weighted[:, :-1]), axis=1)
            / self.length[:, 0]
        )

    def mean_held(self, signal: str, lag: float = 0.0) -> np.ndarray:
        """The weighted mean of a signal that is held from a row to the next, shape (windows,)."""
        values, time = self._log.signals[signal], self._log.time
        reach = 0 if lag == 0.0 else math.ceil(abs(lag) / self._log.step) + 1
        rows = np.arange(-reach, self.rows.shape[1] - 1 + reach) + self.rows[:, :1]
        rows = np.clip(rows, 0, len(time) - 2)
        edges = [
            np.clip((time[rows + k] + lag - self.begin) / self.length, 0.0, 1.0) for k in (0, 1)
        ]
        return np.sum(values[rows] * (_PHI[-1](edges[1]) - _PHI[-1](edges[0])), axis=1)


def regress(
    target: np.ndarray, terms: Mapping[str, np.ndarray], least: float = -np.inf
) -> Balance | None:
    """Least squares that outliers do not move; None where there are too few windows, or terms say the same.

    Inertia and friction (`BODY`) get coefficients of at least `least`; terms that are 0 throughout
    are left out.
    """
    from scipy.optimize import lsq_linear

    terms = {name: values for name, values in terms.items() if np.any(values)}
    if len(target) < 3 * len(terms) or not terms or not np.any(target):
        return None
    matrix = np.column_stack(list(terms.values()))
    scales = np.sqrt(np.mean(matrix**2, axis=0))
    matrix = matrix / scales
    bounds = [least if name in NONNEGATIVE_TERMS else -np.inf for name in terms], np.inf
    weights = np.ones(len(target))
    for _ in range(8 if least == -np.inf else 1):  # Huber's weights, reweighted
        solution, _, rank, _ = np.linalg.lstsq(
            matrix * weights[:, None], target * weights, rcond=1e-9
        )
        if least > -np.inf:
            solution = lsq_linear(matrix * weights[:, None], target * weights, bounds).x
        residual = target - matrix @ solution
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-12 * float(np.abs(target).max())
        weights = np.sqrt(np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(residual), 1e-300)))
    if rank < len(terms):
        return None
    error = math.sqrt(float(np.mean((weights * residual) ** 2)))
    # phi is about half as wide as its window, and so overlaps by half with the next one: they count
    # for half
    variance = 2.0 * error**2 * np.sum(np.linalg.pinv(matrix * weights[:, None]) ** 2, axis=1)
    certain = solution / np.sqrt(np.maximum(variance, 1e-300))
    return Balance(
        dict(zip(terms, map(float, solution / scales), strict=True)),
        dict(zip(terms, map(float, certain), strict=True)),
        error / math.sqrt(float(np.mean((weights * target) ** 2))),
        error,
    )


def _speed(log: Log, windows: Windows, order: int = 0) -> np.ndarray:
    """The weighted mean of the speed, or of its derivative; by the position if there is one."""
    return (
        windows.mean("position", order + 1)
        if log.has("position")
        else windows.mean("velocity", order)
    )


def _voltage_terms(log: Log, windows: Windows, sag: bool = False) -> dict[str, np.ndarray]:
    terms = {"resistance": windows.mean("current"), "inductance": windows.mean("current", 1)}
    if log.has("position") or log.has("velocity"):
        terms["back_emf_constant"] = _speed(log, windows)
    if sag:
        share = log.signals["voltage"] / max(float(np.abs(log.signals["voltage"]).max()), 1e-300)
        terms["supply_resistance"] = windows.mean(share**2 * log.signals["current"])
    return terms


def voltage_balance(log: Log, duration: float = 0.0, sag: bool = False) -> Balance | None:
    """Fits `resistance`*i + `inductance`*di/dt + `back_emf_constant`*omega, of the output, to the voltage; all SI.

    Without a motion the shaft counts as locked. `sag`: on (u/max u)^2*i too, which a
    `supply_resistance` takes.
    """
    windows = Windows(log, duration)
    return regress(windows.mean_held("voltage"), _voltage_terms(log, windows, sag))


def _torque_terms(
    log: Log, windows: Windows, aside: bool = False, rig: str | None = None
) -> dict[str, np.ndarray]:
    from scipy.integrate import cumulative_trapezoid

    speed, one = _speed(log, windows), windows.mean(np.ones(len(log.time)))
    terms = {
        "inertia": _speed(log, windows, 1),
        "viscous": speed,
        "coulomb": np.sign(speed) * one,
        "constant": one,
    }
    if rig in (None, "pendulum"):
        known = log.has("position")
        angle = (
            log.signals["position"]
            if known
            else cumulative_trapezoid(log.signals["velocity"], log.time, initial=0)
        )
        terms["gravity"] = windows.mean(np.sin(angle))
        if aside:
            terms["gravity_aside"] = windows.mean(np.cos(angle))
    return terms


def torque_balance(
    log: Log,
    effort: str = "torque",
    duration: float = 0.3,
    aside: bool = False,
    rig: str | None = None,
    sign: float = 0.0,
) -> Balance | None:
    """Fits `inertia`*alpha + `gravity`*sin(q) + `viscous`*omega + `coulomb`*sign(omega) + `constant` to the effort.

    A velocity alone counts from where the pendulum hangs; a `rig` without gravity has no term of
    it. A `sign` is that of the effort, with which inertia and friction must not be negative; 0:
    they may be. Windows have a `duration` [s].
    """
    windows = Windows(log, duration)
    terms = _torque_terms(log, windows, aside, rig)
    given = windows.mean_held(effort) if effort == "voltage" else windows.mean(effort)
    return regress(sign * given, terms, 0.0) if sign else regress(given, terms)


class Shift(NamedTuple):
    """The shift of time by which two signals agree best."""

    lag: float  # [s]
    improvement: float  # residual at that shift over the one without
    gain: float  # factor between the two
    unexplained: float  # residual at that shift over what was to be explained, root mean squares
    noise: float = 0.0  # noise or step of the worse sensor over what it sees


def velocity_lag(log: Log) -> Shift | None:
    """How late, up to 0.1 s, the velocity is against the differentiated position, and its gain over that."""
    log = log.slice_rows(slice(0, _LONGEST))
    windows = Windows(log, max(0.05, 4.0 * log.step), _WINDOWS)
    rate = windows.mean("position", 1)
    velocity, time = log.signals["velocity"], log.time
    if not np.any(rate) or not np.any(velocity):
        return None

    def compare(lag: float) -> tuple[float, float, float]:
        seen = windows.mean(np.interp(time + lag, time, velocity))
        gain = float(seen @ rate / (rate @ rate))
        left = float(np.linalg.norm(seen - gain * rate)) / max(float(np.linalg.norm(seen)), 1e-300)
        return left, gain, left

    longest = min(0.1, 0.1 * float(time[-1]))
    size, seen = (float(np.sqrt(np.mean(one**2))) for one in (rate, windows.mean("velocity")))
    noisy = sensor_deviation(log, "velocity") * math.sqrt(2.0 / windows.rows.shape[1])
    blurred = 4.0 * sensor_deviation(log, "position") / float(windows.length.mean())
    noise = max(noisy / max(seen, 1e-300), blurred / size)
    return _least(compare, log.step, longest, longest)._replace(noise=noise)


def effort_lag(log: Log, effort: str) -> Shift | None:
    """How late what follows is against the effort, by their balance.

    That is the current, up to 20 rows, against a `voltage`; the motion, up to 60 ms, against a
    `torque`.
    """
    log = log.slice_rows(slice(0, _LONGEST))
    if effort == "voltage":
        windows, ahead, behind = Windows(log, most=_WINDOWS), 3.0 * log.step, 20.0 * log.step
        terms = _voltage_terms(log, windows)
    else:
        windows, ahead, behind = Windows(log, 0.3, _WINDOWS), 0.06, 0.06
        terms = _torque_terms(log, windows)

    def compare(lag: float) -> tuple[float, float, float]:
        balance = regress(windows.mean_held(effort, lag), terms)
        # of a nearly sinusoidal current a delay looks like more inductance, and too long a one like
        # less than none
        if balance is None or (lag > 0.0 and balance.certainty.get("inductance", 0.0) < -3.0):
            return np.inf, 1.0, 1.0
        return balance.residual, 1.0, balance.unexplained

    return _least(compare, log.step, ahead, behind) if np.isfinite(compare(0.0)[0]) else None


def _least(
    compare: Callable[[float], tuple[float, float, float]], step: float, ahead: float, behind: float
) -> Shift:
    """The shift of the least residual, to a quarter of a step: by long steps, then by shorter ones beside the best.

    Of a lag `compare` says residual, gain and what is left unexplained.
    """
    shift = step
    while ahead + behind > 40.0 * shift:
        shift *= 2.0
    places = shift * np.arange(-max(round(ahead / shift), 4), max(round(behind / shift), 4) + 1)
    while True:
        best = min((compare(place)[0], abs(place), place) for place in places)[2]
        if shift <= 0.3 * step:
            residual, gain, unexplained = compare(best)
            return Shift(float(best), residual / max(compare(0.0)[0], 1e-300), gain, unexplained)
        shift /= 2.0
        places = best + shift * np.arange(-2, 3)
