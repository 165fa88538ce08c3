"""Disturbs the commands and loads of many actuators, of one simulation or of many: the same compiled code."""

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from codrl_mj.actuators.noise import philox, uniform
from codrl_mj.compile_cache import njit
from codrl_mj.disturbances import (
    KEY,
    NO_DISTURBANCES,
    PULSE_NAMES,
    Disturbances,
    interpolate_delayed,
    pulse_load,
    quantize,
    limit_rate,
    whole_and_fraction,
)
from codrl_mj.engine.memory import internal, row_as

for _function in (interpolate_delayed, quantize, limit_rate, philox, uniform):
    register_jitable(_function)


class DisturberParameters(NamedTuple):
    """What a disturber does; zero is off."""

    timestep: float
    """Integration step [s]."""
    delay_steps: float
    """Delay in whole integration steps."""
    delay_fraction: float
    """The rest of it."""
    quantum: float
    """Of commands [N or N*m]."""
    limit: float
    """Largest command [N or N*m]."""
    change: float
    """Their largest change in an integration step [N or N*m]."""
    pulse_force: float
    """Size of load pulses [N or N*m]."""
    pulse_duration: float
    """[s]."""
    pulse_interval: float
    """Mean time between them [s]."""
    force_per_position: float
    """Command [N or N*m] that holds the joint at a position of 1 m or rad; 0 where commands are no positions."""


_AFTER_HISTORY = 1 + len(PULSE_NAMES)


class Disturber:
    """What happens between the command and the physics, and the loads on the joint, once per integration step.

    All it remembers is the array `memory`, a row for each actuator of each simulation: commands on
    their way (newest first), the last command that arrived, and the pulses'. What it does is
    `numbers`, a row as in `DisturberParameters` for each actuator of a simulation.
    """

    def __init__(
        self,
        disturbances: Disturbances,
        timestep: float,
        limits: np.ndarray,
        simulations: int,
        force_per_position: np.ndarray | None = None,
    ) -> None:
        """Start with nothing remembered, for a number of simulations at a timestep [s].

        `limits`, shape (n,), are the largest forces [N or N*m] of the actuators of one, `holds`,
        likewise, as in `DisturberParameters`. Where all is off, commands arrive as they are, there are no
        loads, and rows are empty.
        """
        self.on = disturbances != NO_DISTURBANCES
        whole, fraction = whole_and_fraction(disturbances.command_delay, timestep)
        rows = [
            DisturberParameters(
                timestep,
                whole,
                fraction,
                disturbances.command_quantum,
                limit,
                disturbances.command_rate * timestep,
                disturbances.pulse_force,
                disturbances.pulse_duration,
                disturbances.pulse_interval,
                ratio,
            )
            for limit, ratio in zip(
                limits.tolist(),
                np.zeros(len(limits)) if force_per_position is None else force_per_position,
                strict=True,
            )
        ]
        self.numbers = np.array(rows) if self.on else np.empty((len(rows), 0))
        length = whole + 1 + (fraction > 0.0) + _AFTER_HISTORY if self.on else 0
        self.memory = np.zeros((simulations * len(rows), length))

    def reset(self, rows: np.ndarray, keys: Any, held: Any = 0.0) -> None:
        """Forget everything at the start of episodes of m simulations, with these keys of random numbers.

        Until the first command arrives, the commands `held` (m, n) [N or N*m] do.
        """
        count = len(self.numbers)
        held = np.broadcast_to(held, (len(rows), count))
        for actuator in range(count if self.on else 0):
            self.memory[rows * count + actuator] = 0.0
            self.memory[rows * count + actuator, :KEY_COLUMN] = held[:, actuator, np.newaxis]
            self.memory[rows * count + actuator, KEY_COLUMN] = np.asarray(keys) + actuator

    def disturb_commands(self, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The commands that arrive in the next step, and mean loads on the joints, [N or N*m], each of shape (N, n)."""
        arrived, loads = desired, np.zeros(desired.shape)
        if self.on:
            arrived, plain = np.empty(desired.shape), np.ascontiguousarray(desired)
            _disturb_each(
                self.numbers, self.memory, *(one.reshape(-1) for one in (plain, arrived, loads))
            )
        return arrived, loads


KEY_COLUMN = KEY - len(PULSE_NAMES)
"""Where a row of a disturber's memory holds the key of the episode's random numbers, counted from its end."""


_pulses = internal(pulse_load)


@internal
def disturb(numbers: DisturberParameters, memory: np.ndarray, force: float) -> tuple[float, float]:
    """The command that arrives in the next integration step, and the mean load over it; `memory` is an actuator's."""
    length = len(memory) - _AFTER_HISTORY
    for entry in range(length - 1, 0, -1):
        memory[entry] = memory[entry - 1]
    memory[0] = force
    arrived = interpolate_delayed(memory[int(numbers.delay_steps)], memory[length - 1], numbers.delay_fraction)
    if numbers.quantum != 0.0:
        arrived = quantize(arrived, numbers.quantum, numbers.limit)
    if numbers.change != 0.0:
        arrived = limit_rate(arrived, memory[length], numbers.change)
        memory[length] = arrived
    if numbers.pulse_force == 0.0:
        return arrived, 0.0
    own = memory[len(memory) - len(PULSE_NAMES) :]
    load = _pulses(
        own, numbers.timestep, numbers.pulse_force, numbers.pulse_duration, numbers.pulse_interval
    )
    return arrived, load


@njit(nogil=True, error_model="numpy")
def _disturb_each(
    numbers: np.ndarray,
    memory: np.ndarray,
    forces: np.ndarray,
    commands: np.ndarray,
    loads: np.ndarray,
) -> None:
    for row in range(len(memory)):
        own = row_as(numbers[row % len(numbers)], DisturberParameters)
        commands[row], loads[row] = disturb(own, memory[row], forces[row])
