"""How late one signal of a log is against another."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.balances import Windows, regress, torque_terms, voltage_terms
from codrl_mj.identify.log import Log
from codrl_mj.identify.segments import sensor_deviation

_ROWS = 20_000
"""More are not looked at."""
_WINDOWS = 400
"""More tell no more."""


class Lag(NamedTuple):
    """The shift of time by which two signals agree best."""

    lag: float
    """[s]"""
    improvement: float
    """Residual at that shift over the one without."""
    gain: float = 1.0
    """Factor between the two."""
    unexplained: float = 0.0
    """Residual at that shift over what was to be explained, root mean squares."""
    noise: float = 0.0
    """Noise or step of the worse sensor over what it sees."""


def velocity_lag(log: Log) -> Lag | None:
    """How late, up to 0.1 s, the velocity is against the differentiated position, and its gain over that."""
    log = _beginning(log)
    windows = Windows(log, max(0.05, 4.0 * log.step), _WINDOWS)
    if not len(windows):
        return None
    rate = windows.mean("position", 1)
    velocity, time = log.signals["velocity"], log.time
    if not np.any(rate) or not np.any(velocity):
        return None

    def compare(lag: float) -> tuple[float, float]:
        seen = windows.mean(np.interp(time + lag, time, velocity))
        gain = float(seen @ rate / (rate @ rate))
        return float(np.linalg.norm(seen - gain * rate)) / max(float(np.linalg.norm(seen)), 1e-300), gain

    longest = min(0.1, 0.1 * float(time[-1]))
    lag = _least(compare, log.step, longest, longest)
    (best, gain), (now, _) = compare(lag), compare(0.0)
    size, seen = (float(np.sqrt(np.mean(one**2))) for one in (rate, windows.mean("velocity")))
    noisy = sensor_deviation(log, "velocity") * math.sqrt(2.0 / windows.rows.shape[1])
    blurred = 4.0 * sensor_deviation(log, "position") / float(windows.length.mean())
    noise = max(noisy / max(seen, 1e-300), blurred / size)
    return Lag(lag, best / max(now, 1e-300), gain, best, noise)


def current_lag(log: Log) -> Lag | None:
    """How late, up to 20 rows, the current is against the voltage, by the voltage balance."""
    log = _beginning(log)
    windows = Windows(log, most=_WINDOWS)
    if not len(windows) or not np.any(log.signals["voltage"]):
        return None
    return _by_balance(log, windows, "voltage", voltage_terms(log, windows), 3.0 * log.step, 20.0 * log.step)


def motion_lag(log: Log) -> Lag | None:
    """How late, up to 60 ms, the motion is against the torque that causes it, by the torque balance."""
    log = _beginning(log)
    windows = Windows(log, 0.3, _WINDOWS)
    terms = torque_terms(log, windows) if len(windows) else None
    return None if terms is None else _by_balance(log, windows, "torque", terms, 0.06, 0.06)


def _by_balance(
    log: Log, windows: Windows, signal: str, terms: Mapping[str, np.ndarray], ahead: float, behind: float
) -> Lag | None:
    """How late the terms of a balance are against what they explain."""

    def compare(lag: float) -> tuple[float, float]:
        balance = regress(windows.mean_held(signal, lag), terms)
        # of a nearly sinusoidal current a delay looks like more inductance, and too long a one like less than none
        if balance is None or (lag > 0.0 and balance.certainty.get("inductance", 0.0) < -3.0):
            return np.inf, 1.0
        return balance.residual, balance.unexplained

    now = compare(0.0)[0]
    if not np.isfinite(now):
        return None
    lag = _least(compare, log.step, ahead, behind)
    best, unexplained = compare(lag)
    return Lag(lag, best / max(now, 1e-300), 1.0, unexplained)


def _least(compare: Callable[[float], tuple[float, float]], step: float, ahead: float, behind: float) -> float:
    """The lag of the least residual, to a quarter of a step: by long steps, then by shorter ones beside the best."""
    shift = step
    while ahead + behind > 40.0 * shift:
        shift *= 2.0
    places = shift * np.arange(-max(round(ahead / shift), 4), max(round(behind / shift), 4) + 1)
    while True:
        best = min((compare(place)[0], abs(place), place) for place in places)[2]
        if shift <= 0.3 * step:
            return float(best)
        shift /= 2.0
        places = best + shift * np.arange(-2, 3)


def _beginning(log: Log) -> Log:
    return dataclasses.replace(log.part(slice(0, _ROWS)), findings=())
