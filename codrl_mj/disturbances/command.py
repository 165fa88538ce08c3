"""The way of a command to the actuator, as pure functions of numbers. `codrl_mj.physics.disturber` compiles them."""

import math

import numpy as np

_NEAR = 1e-9  # of an integration step: nearer to a whole number of steps is that number


def whole_and_fraction(delay: float, timestep: float) -> tuple[int, float]:
    """A delay [s] in integration steps [s]: the whole number below it, and the rest in [0, 1)."""
    steps = delay / timestep
    nearest = round(steps)
    if abs(steps - nearest) <= _NEAR * max(1.0, steps):
        return nearest, 0.0
    return math.floor(steps), steps - math.floor(steps)


def delayed(newer: float, older: float, fraction: float) -> float:
    """The command a `fraction` in [0, 1] of the way from a newer to an older one, given an integration step before."""
    return newer + fraction * (older - newer)


def quantised(command: float, quantum: float, limit: float) -> float:
    """The nearest multiple of the quantum > 0, half to even, within the largest force +-limit, all in [N or N*m]."""
    return np.minimum(np.maximum(quantum * np.rint(command / quantum), -limit), limit)


def rate_limited(command: float, before: float, change: float) -> float:
    """The command, at most `change` away from the result one integration step earlier, all in [N or N*m]."""
    return np.minimum(np.maximum(command, before - change), before + change)
