"""Disturbs the commands and loads of many simulations of one task, or of one: the same compiled code."""

import functools
import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from codrl_mj.callbacks import kernels  # noqa: F401 - tells numba of the functions in codrl_mj.motor.noise
from codrl_mj.disturbances import Disturbances
from codrl_mj.disturbances.command import delayed, quantised, rate_limited, whole_and_fraction
from codrl_mj.disturbances.pulses import KEY, PULSE_NAMES, pulse_load
from codrl_mj.motor.noise import standard_normal

for _function in (delayed, quantised, rate_limited):
    register_jitable(_function)

NUMBER_NAMES = (
    "timestep",
    "delay_steps",
    "delay_fraction",
    "quantum",
    "limit",
    "change",
    "pulse_force",
    "pulse_duration",
    "pulse_interval",
)
"""What a disturber's `numbers` hold: integration step [s], delay in whole integration steps and the rest of it, quantum
and limit of commands and their largest change in an integration step [N or N*m], and size [N or N*m], duration and mean
interval [s] of pulses. Zero is off."""
TIMESTEP, STEPS, FRACTION, QUANTUM, LIMIT, CHANGE, FORCE, DURATION, INTERVAL = range(len(NUMBER_NAMES))
_AFTER_HISTORY = 1 + len(PULSE_NAMES)


class Disturber:
    """What happens between the command and the physics, and the loads on the joint, once per integration step.

    All it remembers is the array `memory`, a row for each simulation: commands on their way (newest first), the last
    command that arrived, and the pulses'. What it does is the vector `numbers`, as in `NUMBER_NAMES`.
    """

    def __init__(self, disturbances: Disturbances, timestep: float, limit: float, simulations: int) -> None:
        """Start with nothing remembered.

        Args:
            disturbances: what to do.
            timestep: integration step [s].
            limit: the largest force [N or N*m].
            simulations: their number.
        """
        whole, fraction = whole_and_fraction(disturbances.command_delay, timestep)
        self.numbers = np.array(
            [
                timestep,
                whole,
                fraction,
                disturbances.command_quantum,
                limit,
                disturbances.command_rate * timestep,
                disturbances.pulse_force,
                disturbances.pulse_duration,
                disturbances.pulse_interval,
            ]
        )
        self.memory = np.zeros((simulations, whole + 1 + (fraction > 0.0) + _AFTER_HISTORY))

    def reset(self, rows: Any, keys: Any) -> None:
        """Forget everything at the start of episodes.

        Args:
            rows: indices of simulations.
            keys: of their episodes' random numbers.
        """
        self.memory[rows] = 0.0
        self.memory[rows, KEY_COLUMN] = keys

    def command(self, desired: np.ndarray) -> np.ndarray:
        """The commands that arrive at the actuators in the next integration step.

        Args:
            desired: commands given [N or N*m], shape (N,).

        Returns:
            Shape (N,); a new array.
        """
        commands = np.empty(len(self.memory))
        compiled_disturbance().commands(self.numbers, self.memory, desired, commands)
        return commands

    def load(self) -> np.ndarray:
        """The mean loads on the joints [N or N*m] over the next integration step, shape (N,); a new array."""
        loads = np.zeros(len(self.memory))
        if self.numbers[FORCE]:
            compiled_disturbance().loads(self.numbers, self.memory, loads)
        return loads


KEY_COLUMN = KEY - len(PULSE_NAMES)
"""Where a row of a disturber's memory holds the key of the episode's random numbers."""


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
    measured = np.array(current, dtype=np.float64)
    keys, times = np.array(keys, dtype=np.float64), np.array(times, dtype=np.float64)
    compiled_sensor()(measured, disturbances.current_bias, disturbances.current_noise, keys, times, timestep)
    return measured


class Disturbance(NamedTuple):
    """Compiled functions; `numbers` and `memory` are a `Disturber`'s."""

    command: Any
    """(numbers, row of memory, force) -> command that arrives in the next integration step."""
    load: Any
    """(numbers, row of memory) -> mean load over it."""
    commands: Any
    """(numbers, memory, forces (N,), commands (N,)) -> nothing: `command` for every row."""
    loads: Any
    """(numbers, memory, loads (N,)) -> nothing: `load` for every row."""


@functools.cache
def compiled_disturbance() -> Disturbance:
    """The functions, compiled as they are used."""
    pulses = numba.njit(nogil=True, error_model="numpy")(pulse_load)

    @numba.njit(nogil=True, error_model="numpy")
    def command(numbers: np.ndarray, memory: np.ndarray, force: float) -> float:
        length = len(memory) - _AFTER_HISTORY
        for entry in range(length - 1, 0, -1):
            memory[entry] = memory[entry - 1]
        memory[0] = force
        steps = int(numbers[STEPS])
        arrived = delayed(memory[steps], memory[length - 1], numbers[FRACTION])
        if numbers[QUANTUM] != 0.0:
            arrived = quantised(arrived, numbers[QUANTUM], numbers[LIMIT])
        if numbers[CHANGE] != 0.0:
            arrived = rate_limited(arrived, memory[length], numbers[CHANGE])
            memory[length] = arrived
        return arrived

    @numba.njit(nogil=True, error_model="numpy")
    def load(numbers: np.ndarray, memory: np.ndarray) -> float:
        if numbers[FORCE] == 0.0:
            return 0.0
        own = memory[len(memory) - len(PULSE_NAMES) :]
        return pulses(own, numbers[TIMESTEP], numbers[FORCE], numbers[DURATION], numbers[INTERVAL])

    @numba.njit(nogil=True, error_model="numpy")
    def commands(numbers: np.ndarray, memory: np.ndarray, forces: np.ndarray, commands: np.ndarray) -> None:
        for row in range(len(memory)):
            commands[row] = command(numbers, memory[row], forces[row])

    @numba.njit(nogil=True, error_model="numpy")
    def loads(numbers: np.ndarray, memory: np.ndarray, loads: np.ndarray) -> None:
        for row in range(len(memory)):
            loads[row] = load(numbers, memory[row])

    return Disturbance(command, load, commands, loads)


@numba.njit(nogil=True, error_model="numpy")
def sensor_error(bias: float, deviation: float, key: float, time: float, timestep: float) -> float:
    """What the current sensor adds [A] at the first electrical step after `time`.

    Args:
        bias: [A].
        deviation: of the noise [A].
        key: of the episode's random numbers.
        time: since the start of the episode [s].
        timestep: integration step [s].
    """
    if deviation == 0.0:
        return bias
    return bias + deviation * standard_normal(key, math.floor(time / timestep + 0.5), 0)


@functools.cache
def compiled_sensor() -> Any:
    """(currents (N,), bias, deviation, keys (N,), times (N,), integration step) -> nothing: adds the errors."""

    @numba.njit(nogil=True, error_model="numpy")
    def add_errors(
        measured: np.ndarray, bias: float, deviation: float, keys: np.ndarray, times: np.ndarray, timestep: float
    ) -> None:
        for row in range(len(measured)):
            measured[row] += sensor_error(bias, deviation, keys[row], times[row], timestep)

    return add_errors
