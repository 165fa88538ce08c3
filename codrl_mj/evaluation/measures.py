"""What episodes are reduced to, as pure functions: means with intervals, rates, delays, energies."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

LEAST_CORRELATION = 0.5
"""Below this correlation no delay is stated: under a quarter of the variance would be that of a delayed copy."""
EQUAL_CORRELATION = 0.99
"""Peaks of at least this share of the highest count as high: a periodic signal has one in every period."""


class Interval(NamedTuple):
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float


class Quartiles(NamedTuple):
    """The median and the quartiles around it."""

    median: float
    low: float
    high: float


def bootstrap_mean(values: np.ndarray) -> Interval:
    """Mean and 95 % percentile-bootstrap interval: 9999 resamples, fixed seed; to the bit `scipy.stats.bootstrap`'s.

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
    below, share = np.divmod(
        np.array([tail, 1 - tail]) * (_RESAMPLES - 1), 1.0
    )  # linear between two of them
    low, high = (1 - share) * means[below.astype(int)] + share * means[below.astype(int) + 1]
    return Interval(mean, float(low), float(high))


_RESAMPLES = 9999
_NORMAL = 1.959963984540054
"""Quantile of the normal distribution at 97.5 %."""


def wilson_rate(successes: int, trials: int) -> Interval:
    """Share of successes, and its 95 % interval by Wilson's score: good for few trials and shares of 0 or 1."""
    share, square = successes / trials, _NORMAL**2
    scale = 2 * (trials + square)
    centre = (2 * trials * share + square) / scale
    half = _NORMAL / scale * math.sqrt(4 * trials * share * (1 - share) + square)
    return Interval(
        share,
        0.0 if successes == 0 else centre - half,
        1.0 if successes == trials else centre + half,
    )


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of what is left without the lowest and the highest quarter of n >= 1 values, each of floor(n/4) values.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021),
    recommend it for returns: outliers move it less than the mean, and it uses more of the values
    than the median.
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
    """Median and quartiles of n >= 1 values, linear between these."""
    low, median, high = np.percentile(values, [25, 50, 75])
    return Quartiles(float(median), float(low), float(high))


def holds_since(condition: np.ndarray) -> int:
    """Index from which a condition, bool of shape (n,), holds until the end; n if it does not hold at the end."""
    broken = np.flatnonzero(~condition)
    return int(broken[-1]) + 1 if len(broken) else 0


def delay(
    desired: Sequence[np.ndarray], actual: Sequence[np.ndarray], timestep: float, motors: int = 1
) -> float | None:
    """Time by which a signal lags behind another [s]: the delay that maximises their normalised cross-correlation.

    c(k) = sum of x(t)*y(t+k) / sqrt(sum of x(t)^2 * sum of y(t+k)^2), over all times t of all
    episodes at which both exist, where x and y are the desired and the actual signal less the means
    of all signals of their motor. Lags run from 0 to half the mean length of an episode. Of peaks
    as high as the highest (`EQUAL_CORRELATION`) the first is taken, and refined by the parabola
    through it and its two neighbours.

    There is a desired signal and one that follows it for each episode, of several motors in turn.
    The delay is >= 0; None where either signal is constant, where even the highest peak is below
    `LEAST_CORRELATION`, or where there is none.
    """
    from scipy import fft  # scipy.signal takes most of a second to import

    reach = int(np.mean([len(signal) for signal in desired]) / 2)
    every_desired, every_actual = np.concatenate(desired), np.concatenate(actual)
    if reach < 1 or np.ptp(every_desired) == 0 or np.ptp(every_actual) == 0:
        return None
    lags = np.arange(-1, reach + 1)
    products, desired_squares, actual_squares = np.zeros((3, len(lags)))
    means = [
        [np.concatenate(of[motor::motors]).mean() for of in (desired, actual)]
        for motor in range(motors)
    ]
    for place, (signal, following) in enumerate(zip(desired, actual, strict=True)):
        x, y = signal - means[place % motors][0], following - means[place % motors][1]
        here = lags < len(x)
        shifts = lags[here]
        size = fft.next_fast_len(2 * len(x) - 1, real=True)
        correlated = fft.irfft(fft.rfft(y, size) * fft.rfft(x[::-1], size), size)
        products[here] += correlated[shifts + len(x) - 1]
        desired_squares[here] += _sums_between(
            x * x, np.maximum(-shifts, 0), len(x) - np.maximum(shifts, 0)
        )
        actual_squares[here] += _sums_between(
            y * y, np.maximum(shifts, 0), len(y) - np.maximum(-shifts, 0)
        )
    scale = np.sqrt(desired_squares * actual_squares)
    correlation = np.divide(products, scale, out=np.zeros(len(lags)), where=scale > 0)
    offsets, heights = _parabolas(correlation)
    if not len(heights) or heights.max() < max(LEAST_CORRELATION, correlation[-1]):
        return None
    peak = int(np.argmax(heights >= EQUAL_CORRELATION * heights.max()))  # the first
    return (
        max(round(peak + float(offsets[peak]), 9), 0.0) * timestep
    )  # the transform's own rounding is smaller


def _parabolas(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Peaks of the parabolas through every sample but the outer ones and its two neighbours, where it is a peak itself.

    Where they are, relative to the sample [samples], and how high; -inf where there is none. Shape
    (n,) each, of samples (n+2,), of which none before the second counts as higher than it.
    """
    before, at, after = samples[:-2], samples[1:-1], samples[2:]
    rises, falls = at >= before, at >= after
    curvature, slope = before - 2 * at + after, (after - before) / 2
    offsets = np.divide(
        -slope, curvature, out=np.zeros(len(at)), where=rises & falls & (curvature < 0)
    )
    rises[:1] = True
    return offsets, np.where(rises & falls, at + slope * offsets / 2, -np.inf)


def _sums_between(values: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Sums of values[begin:end]."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return sums[ends] - sums[begins]


def electrical_energy(
    voltage: np.ndarray, current: np.ndarray, timestep: float
) -> tuple[float, float]:
    """Energy that a motor draws from its supply, and energy that it returns [J]: two integrals of u*i, both >= 0.

    The voltage is held over a step, as a digital controller's is, and the current is taken as
    linear in it: a step's energy is u*(i + i')/2*dt, with voltages (n,) over the steps and currents
    (n+1,) before the first and after each. Steps where it is positive are drawn, the others
    returned.
    """
    return drawn_and_returned(voltage * (current[1:] + current[:-1]) * (timestep / 2))


def drawn_and_returned(energies: np.ndarray) -> tuple[float, float]:
    """The sum of what is positive among energies of steps, shape (n,), and that of the rest, both >= 0."""
    return float(energies[energies > 0].sum()), float(-energies[energies < 0].sum())


def integral_of_square(samples: np.ndarray, timestep: float) -> float:
    """Integral of the square of what is linear between samples: sum of (i^2 + i*i' + i'^2)/3*dt."""
    before, after = samples[:-1], samples[1:]
    return float(np.sum(before * before + before * after + after * after)) * timestep / 3


def mechanical_work(force: np.ndarray, speed: np.ndarray, timestep: float) -> float:
    """Work of a force or torque on what it moves [J], F*(v + v')/2*dt in a step.

    The force (n,) is held over a step; the speed (n+1,), before the first step and after each, is
    linear in it.
    """
    return float(np.sum(force * (speed[1:] + speed[:-1]))) * timestep / 2


def sign_changes(samples: np.ndarray) -> int:
    """How often a signal goes from one sign to the other; zeros in between are no sign."""
    signs = np.sign(samples[samples != 0])
    return int(np.count_nonzero(signs[1:] != signs[:-1]))
