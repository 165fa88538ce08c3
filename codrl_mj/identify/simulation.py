"""A motor's winding and shaft, stepped by the time stamps of a log, for fits and for logs that are made alike.

Friction is that of `GearMotor`: what `codrl_mj.actuators.shaft.friction` takes from the motor's
torque, and then Coulomb friction, which stops the shaft and holds it, as MuJoCo's constraint does.
So fitted numbers mean there what they mean here.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numba
import numpy as np

from codrl_mj.actuators import shaft
from codrl_mj.compile_cache import njit

MAX_SUBSTEP = 1e-3  # longer intervals between rows are cut into pieces of at most this [s]


class ShaftParameters(NamedTuple):
    """What is moved, and what brakes it, all at the motor's output."""

    inertia: float  # [kg*m^2], > 0
    gravity: float  # largest torque of gravity [N*m], m*g*l, against sin(position)
    constant_torque: float  # held load [N*m], against positive speeds
    coulomb: float  # [N*m]
    viscous: float  # [N*m*s/rad]
    gear_efficiency: float  # in (0, 1]
    stribeck_friction: float  # [N*m]
    stribeck_speed: float  # [rad/s]
    stribeck_exponent: float  # what `GearMotor.stribeck_exponent` is
    rotor_inertia: float  # not used where the inertia is known; `shaft.friction` asks for it
    gain: float  # torque [N*m] for one of the input
    # torque [N*m] that the motor loses for one [rad/s]: kT*kE/R where the input is a voltage, else
    # 0
    braking: float


def shaft_parameters(number: Mapping[str, float], gain: float, braking: float = 0.0) -> ShaftParameters:
    """By parameters as they are called in `PARAMETERS`, those of a motor at its rotor."""
    ratio = number["gear_ratio"]
    return ShaftParameters(
        number["inertia"],
        number["mgl"],
        number["constant_torque"],
        number["coulomb_friction"] * ratio,
        number["viscous_friction"] * ratio**2,
        number["gear_efficiency"],
        number["stribeck_friction"] * ratio,
        number["stribeck_speed"] / ratio,
        number.get("stribeck_exponent", 2.0),
        0.0,
        gain,
        braking,
    )


@njit(nogil=True, error_model="numpy")
def simulate_winding(
    times: np.ndarray,
    volts: np.ndarray,
    speeds: np.ndarray,
    current: float,
    resistance: float,
    inductance: float,
    constant: float,
) -> np.ndarray:
    """Currents [A] at the times, (n,), exactly: voltages and speeds hold till the next row."""
    currents = np.empty(len(times))
    currents[0] = current
    for row in range(len(times) - 1):
        lost = -math.expm1(-resistance * (times[row + 1] - times[row]) / inductance)
        final = (volts[row] - constant * speeds[row]) / resistance
        currents[row + 1] = currents[row] + (final - currents[row]) * lost
    return currents


_friction: Any = numba.njit(shaft.friction)
_Shaft: Any = shaft.Shaft


@njit(nogil=True, error_model="numpy")
def step_shaft(
    duration: float, given: float, slope: float, position: float, speed: float, moved: Any
) -> tuple[float, float]:
    """Position [rad] and speed [rad/s] after a duration [s] under an input that grows by `slope` [1/s].

    Gravity acts in the middle of a substep, and viscous friction by its mean speed: both to second
    order; dry friction is an implicit step, and never chatters.
    """
    pieces = max(math.ceil(duration / MAX_SUBSTEP - 1e-6), 1)
    step = duration / pieces
    damped = 0.5 * step * (moved.viscous + moved.braking) / moved.inertia
    inertia = moved.inertia * (
        1.0 + damped
    )  # as dry friction finds it, so that it ends where torques balance
    for piece in range(pieces):
        position += 0.5 * step * speed
        driving = moved.gain * (given + slope * (piece + 0.5) * step)
        others = -moved.constant_torque
        if moved.gravity != 0.0:  # a sine takes as long as all the rest
            others -= moved.gravity * math.sin(position)
        free = (speed * (1.0 - damped) + step * (driving + others) / moved.inertia) / (1.0 + damped)
        if (
            moved.gear_efficiency < 1.0 or moved.stribeck_friction > 0.0
        ):  # of the torque after back-EMF
            torque = driving - 0.5 * moved.braking * (speed + free)
            rest = (free - speed) / step - torque / inertia
            free -= step * _friction(moved, step, torque, _Shaft(inertia, rest, speed)) / inertia
        most = step * moved.coulomb / inertia
        speed = 0.0 if abs(free) <= most else free - math.copysign(most, free)
        position += 0.5 * step * speed
    return position, speed


@njit(nogil=True, error_model="numpy")
def simulate_shaft(
    times: np.ndarray,
    inputs: np.ndarray,
    slopes: np.ndarray,
    position: float,
    speed: float,
    moved: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds at the times, each (n,), under inputs[k] + slopes[k]*(t - times[k]) between two rows."""
    positions, speeds = np.empty(len(times)), np.empty(len(times))
    positions[0], speeds[0] = position, speed
    for row in range(len(times) - 1):
        position, speed = step_shaft(
            times[row + 1] - times[row], inputs[row], slopes[row], position, speed, moved
        )
        positions[row + 1], speeds[row + 1] = position, speed
    return positions, speeds


@njit(nogil=True, error_model="numpy")
def simulate_servo(
    times: np.ndarray,
    targets: np.ndarray,
    limits: np.ndarray,
    law: float,
    position: float,
    speed: float,
    moved: Any,
) -> np.ndarray:
    """Positions at the times, (n,), where an input of law*(target - position), within its limit, holds for a row."""
    positions = np.empty(len(times))
    positions[0] = position
    for row in range(len(times) - 1):
        given = min(max(law * (targets[row] - position), -limits[row]), limits[row])
        position, speed = step_shaft(times[row + 1] - times[row], given, 0.0, position, speed, moved)
        positions[row + 1] = position
    return positions


@njit(nogil=True, error_model="numpy")
def simulate_samples(
    period: float,
    shares: np.ndarray,
    limit: float,
    sag: float,
    parts: Any,
    locked: bool,
    position: float,
) -> np.ndarray:
    """Voltage, current, speed and position of the output, and bus voltage of a drive at each sample, shape (n, 5).

    The winding is exact between the samples, at the speed in their middle; the shaft moves half a
    sample before and half a sample after it (Strang's splitting, of second order). `parts` are (R,
    L, kE at the output), and a `Moved`.
    """
    states = np.empty((len(shares), 5))
    (resistance, inductance, constant), moved = parts
    current, speed, decay = 0.0, 0.0, math.exp(-resistance * period / inductance)
    for row in range(len(shares)):
        bus = limit - sag * shares[row] * current
        voltage = shares[row] * bus
        states[row] = voltage, current, speed, position, bus
        if not locked:
            position, speed = step_shaft(0.5 * period, current, 0.0, position, speed, moved)
        reached = (voltage - constant * speed) / resistance
        current = reached + (current - reached) * decay
        if not locked:
            position, speed = step_shaft(0.5 * period, current, 0.0, position, speed, moved)
    return states
