"""Disturbances of commands and loads, compiled for one simulation and for many."""

from typing import NamedTuple

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
    limit_rate,
    pulse_load,
    quantize,
    whole_and_fraction,
)
from codrl_mj.engine.memory import internal, read_row

for _function in (interpolate_delayed, quantize, limit_rate, philox, uniform):
    register_jitable(_function)


class DisturberParameters(NamedTuple):
    """Parameters of a disturber for one actuator; zero disables an effect."""

    timestep: float
    """Integration step [s]."""
    delay_steps: float
    """Delay in whole integration steps."""
    delay_fraction: float
    """Remaining fraction of an integration step."""
    quantum: float
    """Quantization step of commands [N or N*m]."""
    max_command: float
    """Largest command [N or N*m]."""
    max_change: float
    """Largest change of the command in an integration step [N or N*m]."""
    pulse_force: float
    """Size of load pulses [N or N*m]."""
    pulse_duration: float
    """Duration of load pulses [s]."""
    pulse_interval: float
    """Mean time between pulses [s]."""
    force_per_position: float
    """Command [N or N*m] that corresponds to a position of 1 m or rad; 0 where commands are not
    positions.
    """


_AFTER_HISTORY = 1 + len(PULSE_NAMES)
"""Number of entries in a row of the memory after the delayed commands."""


class Disturber:
    """Disturbances of the commands and loads on the joints, applied once per integration step.

    Its whole state is the array `memory`, with a row for each actuator of each simulation: delayed
    commands (newest first), the last command that arrived, and the state of the pulses.
    `parameters` has a row as in `DisturberParameters` for each actuator of a simulation.
    """

    def __init__(
        self,
        disturbances: Disturbances,
        timestep: float,
        limits: np.ndarray,
        simulations: int,
        force_per_position: np.ndarray | None = None,
    ) -> None:
        """Create the memory of a number of simulations at a timestep [s].

        `limits`, shape (n,), are the largest forces [N or N*m] of the actuators of one simulation,
        and `force_per_position` is as in `DisturberParameters`. Without disturbances, commands
        arrive unchanged, there are no loads, and the rows have no entries.
        """
        self.enabled = disturbances != NO_DISTURBANCES
        whole_steps, fraction = whole_and_fraction(disturbances.command_delay, timestep)
        rows = [
            DisturberParameters(
                timestep,
                whole_steps,
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
        self.parameters = np.array(rows) if self.enabled else np.empty((len(rows), 0))
        length = whole_steps + 1 + (fraction > 0.0) + _AFTER_HISTORY if self.enabled else 0
        self.memory = np.zeros((simulations * len(rows), length))

    def reset(
        self, rows: np.ndarray, keys: np.ndarray | float, initial_commands: np.ndarray | float = 0.0
    ) -> None:
        """Start episodes of the m simulations `rows`, with random keys (m,).

        Until the first delayed command arrives, `initial_commands` (m, n) [N or N*m] apply.
        """
        count = len(self.parameters)
        initial_commands = np.broadcast_to(initial_commands, (len(rows), count))
        for actuator in range(count if self.enabled else 0):
            self.memory[rows * count + actuator] = 0.0
            self.memory[rows * count + actuator, :KEY_COLUMN] = initial_commands[
                :, actuator, np.newaxis
            ]
            self.memory[rows * count + actuator, KEY_COLUMN] = np.asarray(keys) + actuator

    def disturb_commands(self, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the next step's commands and mean joint loads [N or N*m], each of shape (N, n)."""
        arrived, loads = desired, np.zeros(desired.shape)
        if self.enabled:
            arrived, commands = np.empty(desired.shape), np.ascontiguousarray(desired)
            _disturb_each(
                self.parameters,
                self.memory,
                *(array.reshape(-1) for array in (commands, arrived, loads)),
            )
        return arrived, loads


KEY_COLUMN = KEY - len(PULSE_NAMES)
"""Index of the episode's random key in a row of a disturber's memory, counted from the end."""


_pulses = internal(pulse_load)


@internal
def disturb(
    parameters: DisturberParameters, memory: np.ndarray, force: float
) -> tuple[float, float]:
    """Return an actuator's next command and mean load in a step, and update its row `memory`."""
    length = len(memory) - _AFTER_HISTORY
    for entry in range(length - 1, 0, -1):
        memory[entry] = memory[entry - 1]
    memory[0] = force
    arrived = interpolate_delayed(
        memory[int(parameters.delay_steps)], memory[length - 1], parameters.delay_fraction
    )
    if parameters.quantum != 0.0:
        arrived = quantize(arrived, parameters.quantum, parameters.max_command)
    if parameters.max_change != 0.0:
        arrived = limit_rate(arrived, memory[length], parameters.max_change)
        memory[length] = arrived
    if parameters.pulse_force == 0.0:
        return arrived, 0.0
    pulse_memory = memory[len(memory) - len(PULSE_NAMES) :]
    load = _pulses(
        pulse_memory,
        parameters.timestep,
        parameters.pulse_force,
        parameters.pulse_duration,
        parameters.pulse_interval,
    )
    return arrived, load


@njit(nogil=True, error_model="numpy")
def _disturb_each(
    parameter_rows: np.ndarray,
    memory: np.ndarray,
    forces: np.ndarray,
    commands: np.ndarray,
    loads: np.ndarray,
) -> None:
    for row in range(len(memory)):
        parameters = read_row(parameter_rows[row % len(parameter_rows)], DisturberParameters)
        commands[row], loads[row] = disturb(parameters, memory[row], forces[row])
