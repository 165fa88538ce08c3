"""Measures of episodes as pure functions: means with intervals, rates, delays, energies."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MIN_CORRELATION = 0.5
"""Smallest correlation for which a delay is returned; it explains a quarter of the variance."""
EQUAL_CORRELATION = 0.99
"""Share of the highest peak above which peaks count as equally high.

A periodic signal has such a peak in each period; the first one is the delay.
"""


class Interval(NamedTuple):
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float


class Quartiles(NamedTuple):
    """The median and the quartiles around it."""

    median: float
    low: float
    """25th percentile."""
    high: float
    """75th percentile."""


def bootstrap_mean(values: np.ndarray) -> Interval:
    """Return the mean and its 95 % percentile-bootstrap interval, with a fixed seed.

    The result is identical to `scipy.stats.bootstrap` with 9999 resamples.

    Args:
        values: shape (n,), n >= 1.
    """
    mean, count = float(np.mean(values)), len(values)
    if np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    means = np.sort(
        values[np.random.default_rng(0).integers(0, count, (_RESAMPLES, count))].mean(axis=-1)
    )
    tail = (1 - 0.95) / 2
    # The percentiles are interpolated linearly between two sorted means.
    below, share = np.divmod(np.array([tail, 1 - tail]) * (_RESAMPLES - 1), 1.0)
    low, high = (1 - share) * means[below.astype(int)] + share * means[below.astype(int) + 1]
    return Interval(mean, float(low), float(high))


_RESAMPLES = 9999
_NORMAL = 1.959963984540054
"""Quantile of the normal distribution at 97.5 %."""


def wilson_rate(successes: int, trials: int) -> Interval:
    """Return the share of successes with Wilson's 95 % interval, which suits few trials."""
    share, square = successes / trials, _NORMAL**2
    scale = 2 * (trials + square)
    center = (2 * trials * share + square) / scale
    half = _NORMAL / scale * math.sqrt(4 * trials * share * (1 - share) + square)
    return Interval(
        share,
        0.0 if successes == 0 else center - half,
        1.0 if successes == trials else center + half,
    )


def interquartile_mean(values: np.ndarray) -> float:
    """Return the mean without the lowest and highest floor(n/4) of n >= 1 values.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021),
    recommend it for returns: it is less sensitive to outliers than the mean, and uses more of the
    values than the median.
    """
    quarter = len(values) // 4
    return float(
        np.mean(
            np.partition(values, (quarter, len(values) - quarter - 1))[
                quarter : len(values) - quarter
            ]
        )
    )


def quartiles(values: np.ndarray) -> Quartiles:
    """Return median and quartiles of n >= 1 values, with linear interpolation."""
    low, median, high = np.percentile(values, [25, 50, 75])
    return Quartiles(float(median), float(low), float(high))


def holds_since(condition: np.ndarray) -> int:
    """Return the index from which a condition (n,) holds until the end; n if there is none."""
    broken = np.flatnonzero(~condition)
    return int(broken[-1]) + 1 if len(broken) else 0


def delay(
    desired: Sequence[np.ndarray], actual: Sequence[np.ndarray], timestep: float, motors: int = 1
) -> float | None:
    """Return the delay [s] of one signal behind another that maximizes their cross-correlation.

    c(k) = sum of x(t)*y(t+k) / sqrt(sum of x(t)^2 * sum of y(t+k)^2), over all times t of all
    episodes at which both exist. x and y are the desired and the actual signal minus the mean of
    their motor over all episodes. Lags run from 0 to half the mean length of an episode. The first
    peak within `EQUAL_CORRELATION` of the highest is refined by the parabola through it and its two
    neighbors.

    Args:
        desired: desired signal of each episode; with several motors, of each motor in turn.
        actual: actual signals in the same order.
        timestep: time between samples [s].
        motors: number of motors.

    Returns:
        The delay, >= 0; None if either signal is constant, if there is no peak, or if the highest
        one is below `MIN_CORRELATION`.
    """
    # scipy.signal takes most of a second to import; scipy.fft does not.
    from scipy import fft

    max_lag = int(np.mean([len(desired_signal) for desired_signal in desired]) / 2)
    every_desired, every_actual = np.concatenate(desired), np.concatenate(actual)
    if max_lag < 1 or np.ptp(every_desired) == 0 or np.ptp(every_actual) == 0:
        return None
    lags = np.arange(-1, max_lag + 1)
    products, desired_squares, actual_squares = np.zeros((3, len(lags)))
    means = [
        [np.concatenate(signals[motor::motors]).mean() for signals in (desired, actual)]
        for motor in range(motors)
    ]
    for index, (desired_signal, actual_signal) in enumerate(zip(desired, actual, strict=True)):
        x, y = desired_signal - means[index % motors][0], actual_signal - means[index % motors][1]
        has_overlap = lags < len(x)
        shifts = lags[has_overlap]
        size = fft.next_fast_len(2 * len(x) - 1, real=True)
        correlated = fft.irfft(fft.rfft(y, size) * fft.rfft(x[::-1], size), size)
        products[has_overlap] += correlated[shifts + len(x) - 1]
        desired_squares[has_overlap] += _sums_between(
            x * x, np.maximum(-shifts, 0), len(x) - np.maximum(shifts, 0)
        )
        actual_squares[has_overlap] += _sums_between(
            y * y, np.maximum(shifts, 0), len(y) - np.maximum(-shifts, 0)
        )
    scale = np.sqrt(desired_squares * actual_squares)
    correlation = np.divide(products, scale, out=np.zeros(len(lags)), where=scale > 0)
    offsets, heights = _parabolas(correlation)
    if not len(heights) or heights.max() < max(MIN_CORRELATION, correlation[-1]):
        return None
    # argmax of a boolean array is the index of its first True.
    peak = int(np.argmax(heights >= EQUAL_CORRELATION * heights.max()))
    # Rounding to 9 digits removes the smaller numerical error of the Fourier transform.
    return max(round(peak + float(offsets[peak]), 9), 0.0) * timestep


def _parabolas(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets and heights of parabolic peaks at all inner samples.

    The parabola goes through a sample and its two neighbors. Offsets are in samples; the
    height is -inf if the sample is not a peak. Shape (n,) each, for samples (n+2,). The
    first inner sample (lag 0) counts as a peak even if its left neighbor is higher.
    """
    before, center, after = samples[:-2], samples[1:-1], samples[2:]
    rises, falls = center >= before, center >= after
    curvature, slope = before - 2 * center + after, (after - before) / 2
    offsets = np.divide(
        -slope, curvature, out=np.zeros(len(center)), where=rises & falls & (curvature < 0)
    )
    rises[:1] = True
    return offsets, np.where(rises & falls, center + slope * offsets / 2, -np.inf)


def _sums_between(values: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the sums of values[begin:end] for arrays of bounds."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    totals: np.ndarray = sums[ends] - sums[begins]
    return totals


def electrical_energy(
    voltage: np.ndarray, current: np.ndarray, timestep: float
) -> tuple[float, float]:
    """Return the energies [J] that a motor draws from its supply and returns to it, both >= 0.

    The voltage (n,) is constant within a step, as with a digital controller. The current (n+1,),
    before the first step and after each, is linear within it. The energy of a step is
    u*(i + i')/2*dt: drawn if positive, otherwise returned.
    """
    return drawn_and_returned(voltage * (current[1:] + current[:-1]) * (timestep / 2))


def drawn_and_returned(energies: np.ndarray) -> tuple[float, float]:
    """Return the sum of the positive energies (n,) and minus the sum of the negative ones."""
    return float(energies[energies > 0].sum()), float(-energies[energies < 0].sum())


def integral_of_square(samples: np.ndarray, timestep: float) -> float:
    """Return the integral of the square of a piecewise linear signal: (i^2 + i*i' + i'^2)/3*dt."""
    before, after = samples[:-1], samples[1:]
    return float(np.sum(before * before + before * after + after * after)) * timestep / 3


def mechanical_work(force: np.ndarray, speed: np.ndarray, timestep: float) -> float:
    """Return the work of a force or torque [J], F*(v + v')/2*dt in a step.

    The force (n,) is constant within a step; the speed (n+1,), before the first step and after
    each, is linear within it.
    """
    return float(np.sum(force * (speed[1:] + speed[:-1]))) * timestep / 2


def sign_changes(samples: np.ndarray) -> int:
    """Return the number of sign changes of a signal; zeros are skipped."""
    signs = np.sign(samples[samples != 0])
    return int(np.count_nonzero(signs[1:] != signs[:-1]))
