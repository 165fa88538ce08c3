"""Disturbs the commands and loads of many simulations of one task, or of one: the same code, on arrays."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from codrl_mj.callbacks import kernels  # noqa: F401 - tells numba of the functions in codrl_mj.motor.noise
from codrl_mj.disturbances import Disturbances
from codrl_mj.disturbances.command import delayed, quantised, rate_limited, whole_and_fraction
from codrl_mj.disturbances.pulses import KEY, PULSE_NAMES, pulse_load
from codrl_mj.motor.noise import standard_normal


class Disturber:
    """What happens between the command and the physics, and the loads on the joint, once per integration step.

    All it remembers is the array `memory`, a row for each simulation: commands on their way (newest first), the last
    command that arrived, and the pulses'.
    """

    def __init__(self, disturbances: Disturbances, timestep: float, limit: float, simulations: int) -> None:
        """Start with nothing remembered.

        Args:
            disturbances: what to do.
            timestep: integration step [s].
            limit: the largest force [N or N*m].
            simulations: their number.
        """
        self.disturbances = disturbances
        self.timestep = timestep
        self.limit = limit
        whole, self._fraction = whole_and_fraction(disturbances.command_delay, timestep)
        self._length = whole + 1 + (self._fraction > 0.0)
        self.memory = np.zeros((simulations, self._length + 1 + len(PULSE_NAMES)))

    def reset(self, rows: Any, keys: Any) -> None:
        """Forget everything at the start of episodes.

        Args:
            rows: indices of simulations.
            keys: of their episodes' random numbers.
        """
        self.memory[rows] = 0.0
        self.memory[rows, self._length + 1 + KEY] = keys

    def command(self, desired: np.ndarray) -> np.ndarray:
        """The commands that arrive at the actuators in the next integration step.

        Args:
            desired: commands given [N or N*m], shape (N,).

        Returns:
            Shape (N,); a new array.
        """
        disturbances, history = self.disturbances, self.memory[:, : self._length]
        if self._length > 1:
            history[:, 1:] = history[:, :-1].copy()
        history[:, 0] = desired
        command = delayed(history, self._fraction)
        if disturbances.command_quantum:
            command = quantised(command, disturbances.command_quantum, self.limit)
        if disturbances.command_rate:
            last = self.memory[:, self._length]
            command = rate_limited(command, last, disturbances.command_rate * self.timestep)
            last[:] = command
        return command

    def load(self) -> np.ndarray:
        """The mean loads on the joints [N or N*m] over the next integration step, shape (N,); a new array."""
        loads = np.zeros(len(self.memory))
        disturbances = self.disturbances
        if disturbances.pulse_force:
            _compiled_pulses()(
                self.memory[:, self._length + 1 :],
                self.timestep,
                disturbances.pulse_force,
                disturbances.pulse_duration,
                disturbances.pulse_interval,
                loads,
            )
        return loads


def disturber(disturbances: Disturbances, timestep: float, limit: float, simulations: int) -> Disturber | None:
    """A disturber, or None where neither commands nor loads are disturbed.

    Args:
        disturbances: as for `Disturber`, and so are the others.
        timestep: see there.
        limit: see there.
        simulations: see there.
    """
    if not (disturbances.of_command or disturbances.pulse_force):
        return None
    return Disturber(disturbances, timestep, limit, simulations)


def sensed(disturbances: Disturbances, current: Any, keys: Any, times: Any, timestep: float) -> np.ndarray:
    """What the sensor says of a current, at the first electrical step after some time.

    Args:
        disturbances: bias and noise.
        current: [A], shape (N,).
        keys: of the episodes' random numbers, shape (N,).
        times: since the start of the episodes [s], shape (N,).
        timestep: integration step [s].

    Returns:
        Measured currents [A], shape (N,); a new array.
    """
    measured = np.array(current, dtype=np.float64) + disturbances.current_bias
    if disturbances.current_noise:
        keys, times = np.array(keys, dtype=np.float64), np.array(times, dtype=np.float64)
        _compiled_sensor()(measured, disturbances.current_noise, keys, times, timestep)
    return measured


@functools.cache
def _compiled_pulses() -> Callable[..., None]:
    return numba.njit(nogil=True, error_model="numpy")(pulse_load)


@functools.cache
def _compiled_sensor() -> Callable[..., None]:
    @numba.njit(nogil=True, error_model="numpy")
    def add_noise(measured: np.ndarray, deviation: float, keys: np.ndarray, times: np.ndarray, timestep: float) -> None:
        for row in range(len(measured)):
            step = math.floor(times[row] / timestep + 0.5)
            measured[row] += deviation * standard_normal(keys[row], step, 0)

    return add_noise
