"""Simulation of a position servo at the time stamps of a log, from its commands alone.

The winding is quasi-static: the torque is proportional to the duty, and falls with the speed. The
shaft is that of `codrl_mj.identify.simulation`, so that friction stops and holds it.
"""

import math
from typing import NamedTuple

import numpy as np

from codrl_mj.compile_cache import njit
from codrl_mj.identify.parameters import ShaftParameters
from codrl_mj.identify.simulation import step_shaft

MAX_SUBSTEP = 2.5e-3
"""Longest substep [s]."""
MAX_PHASE = 0.1
"""Largest substep in radians of the servo's oscillation with its load."""
MIN_SUBSTEP = 1e-9
"""Duration [s] below which a substep is left out."""


class ServoParameters(NamedTuple):
    """Parameters of a servo's control law, at its output."""

    position_gain: float  # torque per angle error [N*m/rad]
    stall_torque: float  # largest torque at standstill [N*m]
    command_delay: float  # [s]
    zero: float  # position [rad] at which a pendulum hangs
    # 1: the limit applies to the torque after the damping, as for a current loop; 0: before it, as
    # for a duty.
    limits_torque: float


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
    targets: np.ndarray,
    volts: np.ndarray,
    gains: np.ndarray,
    position: float,
    speed: float,
    servo: ServoParameters,
    parameters: ShaftParameters,
    undamped: ShaftParameters,
) -> np.ndarray:
    """Return the positions [rad] of a servo at the times, shape (m,).

    Args:
        times: times of the result [s], shape (m,).
        log_times: times of the rows of the log until the last of `times` [s], shape (n,).
        targets: target positions at these rows [rad], each held until the next row, shape (n,).
        volts: supply voltage over its reference at `times`, shape (m,).
        gains: position gain over its reference at `times`, shape (m,).
        position: initial position [rad].
        speed: initial speed [rad/s].
        servo: parameters of the control law.
        parameters: parameters of the shaft, with a gain of 1.
        undamped: the same parameters without the damping of the servo.
    """
    positions = np.empty(len(times))
    positions[0] = position
    position -= servo.zero
    row, last, delay = 0, len(log_times) - 1, servo.command_delay
    while row < last and log_times[row + 1] + delay <= times[0]:
        row += 1
    # Leapfrog steps of a phase of 0.1 err by 0.04 % in frequency.
    frequency = math.sqrt(servo.position_gain / parameters.inertia)
    max_substep = min(MAX_SUBSTEP, MAX_PHASE / frequency)
    for index in range(len(times) - 1):
        time, end = times[index], times[index + 1]
        gain = servo.position_gain * volts[index] * gains[index]
        limit = servo.stall_torque * volts[index]
        while end - time > MIN_SUBSTEP:
            # A substep ends where the next command arrives. Otherwise the torque's limit would
            # begin up to a substep too early, and the positions would not be smooth in the delay.
            while row < last and log_times[row + 1] + delay <= time + MIN_SUBSTEP:
                row += 1
            arrival = log_times[row + 1] + delay if row < last else end
            until = min(end, arrival)
            step = (until - time) / max(math.ceil((until - time) / max_substep - 1e-6), 1)
            # The error in the middle of a substep makes the step accurate to second order.
            torque = gain * (targets[row] - servo.zero - position - 0.5 * step * speed)
            if servo.limits_torque == 0.0:
                torque = min(max(torque, -limit), limit)
                position, speed = step_shaft(step, torque, 0.0, position, speed, parameters)
            else:
                after = step_shaft(step, torque, 0.0, position, speed, parameters)
                torque -= 0.5 * parameters.braking * (speed + after[1])
                if abs(torque) > limit:
                    torque = math.copysign(limit, torque)
                    after = step_shaft(step, torque, 0.0, position, speed, undamped)
                position, speed = after
            time += step
        positions[index + 1] = position + servo.zero
    return positions
