"""The way of a command to the actuator, as pure functions of arrays with a leading axis of environments."""

import math

import numpy as np

_NEAR = 1e-9  # of an integration step: nearer to a whole number of steps is that number


def whole_and_fraction(delay: float, timestep: float) -> tuple[int, float]:
    """A delay in integration steps: the whole number below it, and the rest in [0, 1).

    Args:
        delay: [s].
        timestep: integration step [s].
    """
    steps = delay / timestep
    nearest = round(steps)
    if abs(steps - nearest) <= _NEAR * max(1.0, steps):
        return nearest, 0.0
    return math.floor(steps), steps - math.floor(steps)


def delayed(history: np.ndarray, fraction: float) -> np.ndarray:
    """The command as it was `m - 1` integration steps ago, or `m - 2 + fraction` where that is no whole number.

    Args:
        history: the last m commands, newest first, shape (N, m).
        fraction: of a step, in [0, 1): how far the result lies from the last but one towards the last of them; 0 takes
            the last.

    Returns:
        Shape (N,).
    """
    if fraction == 0.0:
        return history[:, -1].copy()
    newer, older = history[:, -2], history[:, -1]
    return newer + fraction * (older - newer)


def quantised(command: np.ndarray, quantum: float, limit: float) -> np.ndarray:
    """The nearest multiple of the quantum, half to even, within +-limit.

    Args:
        command: [N or N*m], shape (N,).
        quantum: [N or N*m], > 0.
        limit: the largest force [N or N*m].
    """
    return np.minimum(np.maximum(quantum * np.rint(command / quantum), -limit), limit)  # np.clip takes longer


def rate_limited(command: np.ndarray, before: np.ndarray, change: float) -> np.ndarray:
    """The command, at most `change` away from the one before.

    Args:
        command: [N or N*m], shape (N,).
        before: the result one integration step earlier [N or N*m], shape (N,).
        change: largest change in one integration step [N or N*m].
    """
    return np.minimum(np.maximum(command, before - change), before + change)
