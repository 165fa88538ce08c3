"""Simulation of a position servo at the time stamps of a log, from its commands alone.

The winding is quasi-static: the torque is proportional to the duty, and falls with the speed. The
shaft is that of `codrl_mj.identify.simulation`, so that friction stops and holds it.
"""

import math
from typing import NamedTuple

import numpy as np

from codrl_mj.compile_cache import njit
from codrl_mj.identify.parameters import ShaftParameters
from codrl_mj.identify.simulation import MAX_SUBSTEP, step_shaft


class ServoParameters(NamedTuple):
    """Parameters of a servo's control law, at its output."""

    position_gain: float  # torque per angle error [N*m/rad]
    stall_torque: float  # largest torque at standstill [N*m]
    command_delay: float  # [s]
    zero: float  # position [rad] at which a pendulum hangs


@njit(nogil=True, error_model="numpy")
def limit_rate(times: np.ndarray, targets: np.ndarray, max_velocity: float) -> np.ndarray:
    """Return targets [rad] that follow the given ones at a limited speed, shape (n,)."""
    limited = targets.copy()
    for row in range(1, len(times)):
        reach = max_velocity * (times[row] - times[row - 1])
        change = targets[row] - limited[row - 1]
        limited[row] = limited[row - 1] + min(max(change, -reach), reach)
    return limited


@njit(nogil=True, error_model="numpy")
def simulate_position_servo(
    times: np.ndarray,
    log_times: np.ndarray,
    integrals: np.ndarray,
    volts: np.ndarray,
    gains: np.ndarray,
    position: float,
    speed: float,
    servo: ServoParameters,
    parameters: ShaftParameters,
) -> np.ndarray:
    """Return the positions [rad] of a servo at the times, shape (m,).

    Args:
        times: times of the result [s], shape (m,).
        log_times: times of the rows of the log until the last of `times` [s], shape (n,), n > 1.
        integrals: integral of the target position over time, at these rows [rad*s], shape (n,). It
            is linear between rows, so that a command is held. Before the first row and after the
            last one it continues with the same slope.
        volts: supply voltage over its reference at `times`, shape (m,).
        gains: position gain over its reference at `times`, shape (m,).
        position: initial position [rad].
        speed: initial speed [rad/s].
        servo: parameters of the control law.
        parameters: parameters of the shaft, with a gain of 1.
    """
    positions = np.empty(len(times))
    positions[0] = position
    position -= servo.zero
    row, last = 0, len(log_times) - 2
    # The mean target of a substep is exact, so that the positions are smooth in the delay.
    edge = times[0] - servo.command_delay
    while row < last and log_times[row + 1] <= edge:
        row += 1
    slope = (integrals[row + 1] - integrals[row]) / (log_times[row + 1] - log_times[row])
    integral = integrals[row] + slope * (edge - log_times[row])
    for index in range(len(times) - 1):
        duration = times[index + 1] - times[index]
        substeps = max(math.ceil(duration / MAX_SUBSTEP - 1e-6), 1)
        step = duration / substeps
        gain = servo.position_gain * volts[index] * gains[index]
        limit = servo.stall_torque * volts[index]
        for _ in range(substeps):
            edge += step
            while row < last and log_times[row + 1] <= edge:
                row += 1
            slope = (integrals[row + 1] - integrals[row]) / (log_times[row + 1] - log_times[row])
            next_integral = integrals[row] + slope * (edge - log_times[row])
            target = (next_integral - integral) / step - servo.zero
            integral = next_integral
            # The error in the middle of a substep makes the step accurate to second order.
            torque = gain * (target - position - 0.5 * step * speed)
            torque = min(max(torque, -limit), limit)
            position, speed = step_shaft(step, torque, 0.0, position, speed, parameters)
        positions[index + 1] = position + servo.zero
    return positions
