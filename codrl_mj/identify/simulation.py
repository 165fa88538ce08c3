"""Simulation of a winding and a shaft at the time stamps of a log, for fits and synthetic logs.

Friction is that of `GearMotor`: `codrl_mj.actuators.shaft.friction` is subtracted from the motor's
torque, and then Coulomb friction stops and holds the shaft, as MuJoCo's friction constraint does.
Fitted parameters therefore have the same meaning in a simulation with MuJoCo.
"""

import math
from collections.abc import Callable

import numba
import numpy as np

from codrl_mj.actuators import shaft
from codrl_mj.compile_cache import njit
from codrl_mj.identify.parameters import ShaftParameters, WindingParameters

MAX_SUBSTEP = 1e-3
"""Longest substep [s]; longer intervals between rows are divided."""


@njit(nogil=True, error_model="numpy")
def simulate_winding(
    times: np.ndarray,
    volts: np.ndarray,
    speeds: np.ndarray,
    current: float,
    resistance: float,
    inductance: float,
    back_emf_constant: float,
) -> np.ndarray:
    """Return the currents [A] at the times, shape (n,).

    They are exact if voltages and speeds are constant between rows. `speeds` and
    `back_emf_constant` must refer to the same side of the gear.
    """
    currents = np.empty(len(times))
    currents[0] = current
    for row in range(len(times) - 1):
        # expm1 keeps its accuracy when the step is much shorter than the time constant L/R.
        share = -math.expm1(-resistance * (times[row + 1] - times[row]) / inductance)
        final = (volts[row] - back_emf_constant * speeds[row]) / resistance
        currents[row + 1] = currents[row] + (final - currents[row]) * share
    return currents


# Compiled code can call the friction function only through a global of this module.
_friction: Callable[[ShaftParameters, float, float, shaft.Shaft], float] = numba.njit(
    shaft.friction
)
_Shaft = shaft.Shaft


@njit(nogil=True, error_model="numpy")
def step_shaft(
    duration: float,
    drive: float,
    slope: float,
    position: float,
    speed: float,
    parameters: ShaftParameters,
) -> tuple[float, float]:
    """Return position [rad] and speed [rad/s] after a duration [s].

    The input begins at `drive` and grows by `slope` [1/s]. Gravity is evaluated in the middle of a
    substep, and viscous friction at its mean speed, so that both are accurate to second order. Dry
    friction is an implicit step, which never chatters.
    """
    substeps = max(math.ceil(duration / MAX_SUBSTEP - 1e-6), 1)
    step = duration / substeps
    damping = 0.5 * step * (parameters.viscous + parameters.braking) / parameters.inertia
    # The implicit damping acts like an additional inertia. With it, a shaft comes to rest exactly
    # where its torques balance.
    inertia = parameters.inertia * (1.0 + damping)
    for substep in range(substeps):
        position += 0.5 * step * speed
        driving = parameters.gain * (drive + slope * (substep + 0.5) * step)
        load = -parameters.constant_torque
        # The sine takes as long as the rest of a substep: it is skipped without gravity.
        if parameters.gravity != 0.0:
            load -= parameters.gravity * math.sin(position)
        free_speed = (speed * (1.0 - damping) + step * (driving + load) / parameters.inertia) / (
            1.0 + damping
        )
        if parameters.gear_efficiency < 1.0 or parameters.stribeck_friction > 0.0:
            # The gear transmits the motor's torque, which the back-EMF has already reduced.
            torque = driving - 0.5 * parameters.braking * (speed + free_speed)
            acceleration = (free_speed - speed) / step - torque / inertia
            free_speed -= (
                step
                * _friction(parameters, step, torque, _Shaft(inertia, acceleration, speed))
                / inertia
            )
        # Coulomb friction removes at most this speed in a substep, and stops a slower shaft.
        max_change = step * parameters.coulomb / inertia
        speed = (
            0.0
            if abs(free_speed) <= max_change
            else free_speed - math.copysign(max_change, free_speed)
        )
        position += 0.5 * step * speed
    return position, speed


@njit(nogil=True, error_model="numpy")
def simulate_shaft(
    times: np.ndarray,
    inputs: np.ndarray,
    slopes: np.ndarray,
    position: float,
    speed: float,
    parameters: ShaftParameters,
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and speeds at the times, each of shape (n,).

    The input between two rows is inputs[k] + slopes[k]*(t - times[k]).
    """
    positions, speeds = np.empty(len(times)), np.empty(len(times))
    positions[0], speeds[0] = position, speed
    for row in range(len(times) - 1):
        position, speed = step_shaft(
            times[row + 1] - times[row], inputs[row], slopes[row], position, speed, parameters
        )
        positions[row + 1], speeds[row + 1] = position, speed
    return positions, speeds


@njit(nogil=True, error_model="numpy")
def simulate_servo(
    times: np.ndarray,
    targets: np.ndarray,
    limits: np.ndarray,
    gain: float,
    position: float,
    speed: float,
    parameters: ShaftParameters,
) -> np.ndarray:
    """Return the positions of a servo at the times, shape (n,).

    The input is gain*(target - position), clipped to the limit, and is held until the next row.
    """
    positions = np.empty(len(times))
    positions[0] = position
    for row in range(len(times) - 1):
        drive = min(max(gain * (targets[row] - position), -limits[row]), limits[row])
        position, speed = step_shaft(
            times[row + 1] - times[row], drive, 0.0, position, speed, parameters
        )
        positions[row + 1] = position
    return positions


@njit(nogil=True, error_model="numpy")
def simulate_samples(
    period: float,
    duties: np.ndarray,
    supply_voltage: float,
    supply_resistance: float,
    parts: tuple[WindingParameters, ShaftParameters],
    locked: bool,
    position: float,
) -> np.ndarray:
    """Simulate a drive, and return its state at each sample, shape (n, 5).

    In each period the shaft moves for half a period, then the winding is solved exactly for a whole
    period at that speed, then the shaft moves for the other half (Strang splitting, second order).

    Args:
        period: period of the samples [s].
        duties: duty of the bridge at each sample, in [-1, 1].
        supply_voltage: voltage of the supply without load [V].
        supply_resistance: internal resistance of the supply [ohm].
        parts: parameters of the winding and of the shaft.
        locked: True if the shaft is held.
        position: initial position [rad].

    Returns:
        Columns: motor voltage [V], current [A], output speed [rad/s], output position [rad] and
        supply voltage under load [V].
    """
    states = np.empty((len(duties), 5))
    (resistance, inductance, back_emf_constant), parameters = parts
    current, speed, decay = 0.0, 0.0, math.exp(-resistance * period / inductance)
    for row in range(len(duties)):
        bus = supply_voltage - supply_resistance * duties[row] * current
        voltage = duties[row] * bus
        states[row] = voltage, current, speed, position, bus
        if not locked:
            position, speed = step_shaft(0.5 * period, current, 0.0, position, speed, parameters)
        final = (voltage - back_emf_constant * speed) / resistance
        current = final + (current - final) * decay
        if not locked:
            position, speed = step_shaft(0.5 * period, current, 0.0, position, speed, parameters)
    return states
