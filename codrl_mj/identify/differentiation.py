"""Speeds from positions, by the time stamps."""

import numpy as np

WINDOW = 4e-3
"""Time [s] that positions are smoothed over: short beside what a shaft does, long beside an encoder's steps."""


def speeds(times: np.ndarray, positions: np.ndarray, at: np.ndarray, window: float = WINDOW) -> np.ndarray:
    """Slopes [rad/s] of straight lines through the positions within half a window of a time, at least three of them.

    In the middle of a window that is also the slope of the parabola. Near the ends the window is what there is.
    """
    count = len(times)
    first = np.searchsorted(times, at - 0.5 * window - 1e-9)
    last = np.searchsorted(times, at + 0.5 * window + 1e-9)
    near = np.clip(np.searchsorted(times, at), 1, count - 1)
    first = np.clip(np.minimum(first, near - 1), 0, max(count - 2, 0))
    last = np.clip(np.maximum(last, near + 1), first + 2, count)
    shifted, moved = times - times[0], positions - positions[0]
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (shifted, moved, shifted * moved, shifted**2)]
    t, q, tq, tt = (one[last] - one[first] for one in sums)
    number = last - first
    return (number * tq - t * q) / (number * tt - t * t)
