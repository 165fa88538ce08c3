"""Regressions of the voltage and torque balances of a log, and time lags between its signals.

The regressions use modulating functions: both balances are multiplied by functions phi whose value
and slope vanish at both ends of a window, and integrated by parts, so that no signal has to be
differentiated. Source: Shinbrot, *On the Analysis of Linear and Nonlinear Systems* (1957). The
results are good enough for signs, orders of magnitude and initial guesses, but biased by noise in
the regressors.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.log import Log, gapless_stretches, sensor_deviation

_MIN_ROWS = 12
"""Minimum number of rows in a window."""
_MAX_LAG_ROWS = 20_000
"""Maximum number of rows that a lag is estimated from, counted from the start of the log."""
_MAX_LAG_WINDOWS = 400  # more windows do not make a lag more accurate
# With the fifth power, phi'' is smooth at both ends of a window, so that the trapezoidal rule
# integrates it accurately.
_BUMP = np.polynomial.Polynomial([0.0, 1.0, -1.0]) ** 5
_UNIT_BUMP = _BUMP / _BUMP.integ()(1.0)
_PHI = {-1: _UNIT_BUMP.integ(), 0: _UNIT_BUMP, 1: _UNIT_BUMP.deriv(), 2: _UNIT_BUMP.deriv(2)}
"""Order of phi's derivative with respect to the phase -> polynomial; -1: its integral."""
NONNEGATIVE_TERMS = ("inertia", "viscous", "coulomb")
"""Terms of a torque balance whose coefficients are physically never negative."""


class Balance(NamedTuple):
    """Result of a regression over the windows of a log."""

    values: Mapping[str, float]  # term -> its coefficient
    t_values: Mapping[str, float]  # term -> its coefficient over its standard error
    unexplained: float  # RMS of the residual over the RMS of the target
    residual: float  # root mean square of the residual, in the unit of the target


class Windows:
    """Overlapping windows of a log; within each, signals are weighted by phi ~ (s - s^2)^5.

    The phase s grows from 0 to 1 over a window.
    """

    def __init__(self, log: Log, duration: float = 0.0, max_windows: int = 20_000) -> None:
        """Cut a log into windows of a duration [s], each of at least `_MIN_ROWS` rows."""
        # At least ten windows have to fit into the log.
        duration = min(duration, float(log.time[-1] - log.time[0]) / 10.0)
        count = max(math.ceil(duration / log.step), _MIN_ROWS)
        first_rows = np.concatenate(
            [
                np.arange(rows.start, rows.stop - count, max(count // 4, 1))
                for rows in gapless_stretches(log)
            ]
        )
        self.rows = first_rows[:: math.ceil(len(first_rows) / max_windows) or 1, None] + np.arange(
            count + 1
        )
        self._log = log
        time = log.time[self.rows] if self.rows.size else np.zeros(self.rows.shape)
        self.begin, self.length = time[:, :1], time[:, -1:] - time[:, :1]
        self._phase = (time - self.begin) / np.where(self.length > 0.0, self.length, 1.0)
        self._steps = np.diff(time, axis=1)
        self._weights: dict[int, np.ndarray] = {}

    def mean(self, signal: str | np.ndarray, order: int = 0) -> np.ndarray:
        """Return the weighted mean of a signal's `order`-th derivative, shape (windows,)."""
        values = (self._log.signals[signal] if isinstance(signal, str) else signal)[self.rows]
        # A constant offset does not change the derivative. Without it, rounding errors are smaller.
        if order > 0:
            values = values - values.mean(axis=1, keepdims=True)
        if order not in self._weights:
            self._weights[order] = _PHI[order](self._phase) * (-1.0 / self.length) ** order
        weighted = values * self._weights[order]
        mean: np.ndarray = (
            np.sum(0.5 * self._steps * (weighted[:, 1:] + weighted[:, :-1]), axis=1)
            / self.length[:, 0]
        )
        return mean

    def mean_held(self, signal: str, lag: float = 0.0) -> np.ndarray:
        """Return the weighted mean of a signal with a zero-order hold, shape (windows,).

        The signal is delayed by `lag` [s].
        """
        values, time = self._log.signals[signal], self._log.time
        # With a lag, values from rows outside a window are still held within it.
        reach = 0 if lag == 0.0 else math.ceil(abs(lag) / self._log.step) + 1
        rows = np.arange(-reach, self.rows.shape[1] - 1 + reach) + self.rows[:, :1]
        rows = np.clip(rows, 0, len(time) - 2)
        # This is exact: each held value is multiplied by the integral of phi while it is held.
        edges = [
            np.clip((time[rows + k] + lag - self.begin) / self.length, 0.0, 1.0) for k in (0, 1)
        ]
        mean: np.ndarray = np.sum(values[rows] * (_PHI[-1](edges[1]) - _PHI[-1](edges[0])), axis=1)
        return mean


def regress(
    target: np.ndarray, terms: Mapping[str, np.ndarray], lower_bound: float = -np.inf
) -> Balance | None:
    """Fit terms to a target by robust least squares.

    The coefficients of inertia and friction (`NONNEGATIVE_TERMS`) are at least `lower_bound`; terms
    that are 0 in all windows are left out.

    Returns:
        None if there are too few windows, or if the terms are linearly dependent.
    """
    from scipy.optimize import lsq_linear

    terms = {name: values for name, values in terms.items() if np.any(values)}
    if len(target) < 3 * len(terms) or not terms or not np.any(target):
        return None
    matrix = np.column_stack(list(terms.values()))
    scales = np.sqrt(np.mean(matrix**2, axis=0))
    matrix = matrix / scales
    bounds = [lower_bound if name in NONNEGATIVE_TERMS else -np.inf for name in terms], np.inf
    weights = np.ones(len(target))
    # Eight iterations of reweighting by Huber's weights suffice; the bounded problem, which is
    # slower, is solved once without weights.
    for _ in range(8 if lower_bound == -np.inf else 1):
        solution, _, rank, _ = np.linalg.lstsq(
            matrix * weights[:, None], target * weights, rcond=1e-9
        )
        if lower_bound > -np.inf:
            solution = lsq_linear(matrix * weights[:, None], target * weights, bounds).x
        residual = target - matrix @ solution
        # 1.4826 times the median absolute deviation is the standard deviation of normal noise.
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-12 * float(np.abs(target).max())
        weights = np.sqrt(np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(residual), 1e-300)))
    if rank < len(terms):
        return None
    error = math.sqrt(float(np.mean((weights * residual) ** 2)))
    # phi is about half as wide as its window, so that neighboring windows share about half of their
    # rows. Only half of the windows count as independent.
    variance = 2.0 * error**2 * np.sum(np.linalg.pinv(matrix * weights[:, None]) ** 2, axis=1)
    t_values = solution / np.sqrt(np.maximum(variance, 1e-300))
    return Balance(
        dict(zip(terms, map(float, solution / scales), strict=True)),
        dict(zip(terms, map(float, t_values), strict=True)),
        error / math.sqrt(float(np.mean((weights * target) ** 2))),
        error,
    )


def _speed(log: Log, windows: Windows, order: int = 0) -> np.ndarray:
    """Return the weighted mean of the speed or its derivative, from the position if logged."""
    return (
        windows.mean("position", order + 1)
        if log.has("position")
        else windows.mean("velocity", order)
    )


def _voltage_terms(log: Log, windows: Windows, sag: bool = False) -> dict[str, np.ndarray]:
    """Return the regressors of a voltage balance, each of shape (windows,)."""
    terms = {"resistance": windows.mean("current"), "inductance": windows.mean("current", 1)}
    if log.has("position") or log.has("velocity"):
        terms["back_emf_constant"] = _speed(log, windows)
    if sag:
        # At a duty d = u/V a bridge draws the current d*i from the supply, and applies the share d
        # of the voltage that is left: the voltage drop at the motor grows with d^2*i.
        share = log.signals["voltage"] / max(float(np.abs(log.signals["voltage"]).max()), 1e-300)
        terms["supply_resistance"] = windows.mean(share**2 * log.signals["current"])
    return terms


def voltage_balance(log: Log, duration: float = 0.0, sag: bool = False) -> Balance | None:
    """Fit `resistance`*i + `inductance`*di/dt + `back_emf_constant`*omega to the voltage.

    All values are in SI units, and the speed omega is that of the output. Without a logged motion
    the shaft counts as locked. `sag` adds the term `supply_resistance`*(u/max u)^2*i.
    """
    windows = Windows(log, duration)
    return regress(windows.mean_held("voltage"), _voltage_terms(log, windows, sag))


def _torque_terms(
    log: Log, windows: Windows, is_tilted: bool = False, rig: str | None = None
) -> dict[str, np.ndarray]:
    """Return the regressors of a torque balance, each of shape (windows,)."""
    from scipy.integrate import cumulative_trapezoid

    speed, constant = _speed(log, windows), windows.mean(np.ones(len(log.time)))
    terms = {
        "inertia": _speed(log, windows, 1),
        "viscous": speed,
        "coulomb": np.sign(speed) * constant,
        "constant": constant,
    }
    if rig in (None, "pendulum"):
        has_position = log.has("position")
        angle = (
            log.signals["position"]
            if has_position
            else cumulative_trapezoid(log.signals["velocity"], log.time, initial=0)
        )
        terms["gravity"] = windows.mean(np.sin(angle))
        if is_tilted:
            terms["gravity_aside"] = windows.mean(np.cos(angle))
    return terms


def torque_balance(
    log: Log,
    effort: str = "torque",
    duration: float = 0.3,
    is_tilted: bool = False,
    rig: str | None = None,
    sign: float = 0.0,
) -> Balance | None:
    """Fit inertia, gravity, friction and a constant load to the effort.

    The terms are `inertia`*alpha + `gravity`*sin(q) + `viscous`*omega + `coulomb`*sign(omega) +
    `constant`.

    Args:
        log: log with the effort, and a position or a velocity. Without a position, the velocity is
            integrated, beginning at the angle 0, at which the pendulum hangs.
        effort: signal that drives the shaft: `torque`, `current` or `voltage`.
        duration: duration of the windows [s].
        is_tilted: True to add `gravity_aside`*cos(q), for a pendulum that does not hang at 0.
        rig: `pendulum` or None to include gravity; `free` or `load` to leave it out.
        sign: factor of the effort, 1 or -1, with inertia and friction constrained to be >= 0; with
            0 the effort is unchanged, and nothing is constrained.
    """
    windows = Windows(log, duration)
    terms = _torque_terms(log, windows, is_tilted, rig)
    target = windows.mean_held(effort) if effort == "voltage" else windows.mean(effort)
    return regress(sign * target, terms, 0.0) if sign else regress(target, terms)


class Shift(NamedTuple):
    """The time shift at which two signals agree best."""

    lag: float  # [s]
    residual_ratio: float  # residual at that shift over the residual without a shift
    gain: float  # the shifted signal over the other one
    unexplained: float  # RMS of the residual at that shift over the RMS of the target
    noise: float = 0.0  # noise-to-signal ratio of the worse sensor, quantization included


def velocity_lag(log: Log) -> Shift | None:
    """Estimate the lag (up to 0.1 s) and gain of the velocity against the position's derivative."""
    log = log.slice_rows(slice(0, _MAX_LAG_ROWS))
    windows = Windows(log, max(0.05, 4.0 * log.step), _MAX_LAG_WINDOWS)
    rate = windows.mean("position", 1)
    velocity, time = log.signals["velocity"], log.time
    if not np.any(rate) or not np.any(velocity):
        return None

    def compare(lag: float) -> tuple[float, float, float]:
        shifted = windows.mean(np.interp(time + lag, time, velocity))
        gain = float(shifted @ rate / (rate @ rate))
        unexplained = float(np.linalg.norm(shifted - gain * rate)) / max(
            float(np.linalg.norm(shifted)), 1e-300
        )
        return unexplained, gain, unexplained

    max_lag = min(0.1, 0.1 * float(time[-1]))
    rate_rms, velocity_rms = (
        float(np.sqrt(np.mean(values**2))) for values in (rate, windows.mean("velocity"))
    )
    # Noise is averaged over the rows of a window, of which phi weights about half. The position is
    # differentiated over about a quarter of a window.
    velocity_noise = sensor_deviation(log, "velocity") * math.sqrt(2.0 / windows.rows.shape[1])
    rate_noise = 4.0 * sensor_deviation(log, "position") / float(windows.length.mean())
    noise = max(velocity_noise / max(velocity_rms, 1e-300), rate_noise / rate_rms)
    return _search_lag(compare, log.step, max_lag, max_lag)._replace(noise=noise)


def effort_lag(log: Log, effort: str) -> Shift | None:
    """Estimate the lag between an effort and its response, by the residual of their balance.

    The response to a `voltage` is the current, whose lag is searched up to 20 rows. The response to
    a `torque` is the motion, whose lag is searched up to 60 ms.
    """
    log = log.slice_rows(slice(0, _MAX_LAG_ROWS))
    if effort == "voltage":
        windows = Windows(log, max_windows=_MAX_LAG_WINDOWS)
        max_lead = 3.0 * log.step
        max_lag = 20.0 * log.step
        terms = _voltage_terms(log, windows)
    else:
        windows, max_lead, max_lag = Windows(log, 0.3, _MAX_LAG_WINDOWS), 0.06, 0.06
        terms = _torque_terms(log, windows)

    def compare(lag: float) -> tuple[float, float, float]:
        balance = regress(windows.mean_held(effort, lag), terms)
        # With a nearly sinusoidal current, a delay looks the same as a larger inductance. A delay
        # that is too long makes the inductance negative, and is rejected.
        if balance is None or (lag > 0.0 and balance.t_values.get("inductance", 0.0) < -3.0):
            return np.inf, 1.0, 1.0
        return balance.residual, 1.0, balance.unexplained

    return (
        _search_lag(compare, log.step, max_lead, max_lag) if np.isfinite(compare(0.0)[0]) else None
    )


def _search_lag(
    compare: Callable[[float], tuple[float, float, float]],
    step: float,
    max_lead: float,
    max_lag: float,
) -> Shift:
    """Search for the lag with the smallest residual, to about a quarter of a time step.

    A coarse grid is refined around its best point. `compare` returns the residual, the gain and the
    unexplained share at a lag.
    """
    # The coarse grid has at most about 40 points.
    shift = step
    while max_lead + max_lag > 40.0 * shift:
        shift *= 2.0
    lags = shift * np.arange(-max(round(max_lead / shift), 4), max(round(max_lag / shift), 4) + 1)
    while True:
        # If residuals are equal, the shorter lag wins.
        best = min((compare(lag)[0], abs(lag), lag) for lag in lags)[2]
        if shift <= 0.3 * step:
            residual, gain, unexplained = compare(best)
            return Shift(float(best), residual / max(compare(0.0)[0], 1e-300), gain, unexplained)
        shift /= 2.0
        lags = best + shift * np.arange(-2, 3)
