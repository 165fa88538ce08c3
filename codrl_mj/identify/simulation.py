"""A motor's winding and shaft, stepped by the time stamps of a log; compiled at the first use.

Friction is that of `GearMotor`: what `codrl_mj.actuators.shaft.friction` takes from the motor's torque, and then
Coulomb friction, which stops the shaft and holds it, as MuJoCo's constraint does. So fitted numbers mean there what
they mean here.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import shaft

LONGEST_SUBSTEP = 1e-3
"""Longer intervals between rows are cut into pieces of at most this [s]."""


class Moved(NamedTuple):
    """What is moved, and what brakes it, all at the motor's output."""

    inertia: float
    """[kg*m^2], > 0."""
    gravity: float
    """Largest torque of gravity [N*m], m*g*l, against sin(position)."""
    constant_torque: float
    """Held load [N*m], against positive speeds."""
    coulomb: float
    """[N*m]"""
    viscous: float
    """[N*m*s/rad]"""
    gear_efficiency: float
    """In (0, 1]."""
    stribeck_friction: float
    """[N*m]"""
    stribeck_speed: float
    """[rad/s]"""
    stribeck_exponent: float
    """What `GearMotor.stribeck_exponent` is."""
    rotor_inertia: float
    """Not used where the inertia is known; `shaft.friction` asks for it."""
    gain: float
    """Torque [N*m] for one of the input."""
    braking: float
    """Torque [N*m] that the motor loses for one [rad/s]: kT*kE/R where the input is a voltage, else 0."""


def moved(number: Mapping[str, float], gain: float, braking: float = 0.0) -> Moved:
    """By parameters as they are called in `PARAMETERS`, those of a motor at its rotor."""
    ratio = number["gear_ratio"]
    return Moved(
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


@functools.cache
def winding() -> Callable[..., np.ndarray]:
    """The compiled (times, volts, speeds, current, resistance, inductance, constant) -> currents at the times, (n,)."""
    from codrl_mj.kept import njit

    @njit(nogil=True, error_model="numpy")
    def simulate(
        times: np.ndarray,
        volts: np.ndarray,
        speeds: np.ndarray,
        current: float,
        resistance: float,
        inductance: float,
        constant: float,
    ) -> np.ndarray:
        currents = np.empty(len(times))
        currents[0] = current
        for row in range(len(times) - 1):
            lost = -math.expm1(-resistance * (times[row + 1] - times[row]) / inductance)
            final = (volts[row] - constant * speeds[row]) / resistance
            currents[row + 1] = currents[row] + (final - currents[row]) * lost
        return currents

    return simulate  # type: ignore[no-any-return]


@functools.cache
def turned() -> Any:
    """The compiled shaft over one interval: (duration, input, slope, position, speed, moved) -> position, speed."""
    import numba

    from codrl_mj.kept import njit

    taken: Any = numba.njit(shaft.friction)
    make: Any = shaft.Shaft

    @njit(nogil=True, error_model="numpy")
    def turn(
        duration: float, given: float, slope: float, position: float, speed: float, moved: Any
    ) -> tuple[float, float]:
        pieces = max(math.ceil(duration / LONGEST_SUBSTEP - 1e-6), 1)
        step = duration / pieces
        damped = 0.5 * step * (moved.viscous + moved.braking) / moved.inertia
        inertia = moved.inertia * (1.0 + damped)  # as dry friction finds it, so that it ends where torques balance
        for piece in range(pieces):
            position += 0.5 * step * speed
            driving = moved.gain * (given + slope * (piece + 0.5) * step)
            others = -moved.constant_torque
            if moved.gravity != 0.0:  # a sine takes as long as all the rest
                others -= moved.gravity * math.sin(position)
            free = (speed * (1.0 - damped) + step * (driving + others) / moved.inertia) / (1.0 + damped)
            if moved.gear_efficiency < 1.0 or moved.stribeck_friction > 0.0:  # of the torque after back-EMF
                torque = driving - 0.5 * moved.braking * (speed + free)
                rest = (free - speed) / step - torque / inertia
                free -= step * taken(moved, step, torque, make(inertia, rest, speed)) / inertia
            most = step * moved.coulomb / inertia
            speed = 0.0 if abs(free) <= most else free - math.copysign(most, free)
            position += 0.5 * step * speed
        return position, speed

    return turn


@functools.cache
def moving() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """The compiled (times, inputs, slopes, position, speed, moved) -> positions and speeds at the times, each (n,).

    Between two rows the input is inputs[k] + slopes[k]*(t - times[k]). Gravity acts in the middle of a substep, and
    viscous friction by its mean speed: both to second order; dry friction is an implicit step, and never chatters.
    """
    from codrl_mj.kept import njit

    turn = turned()

    @njit(nogil=True, error_model="numpy")
    def simulate(
        times: np.ndarray, inputs: np.ndarray, slopes: np.ndarray, position: float, speed: float, moved: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        positions, speeds = np.empty(len(times)), np.empty(len(times))
        positions[0], speeds[0] = position, speed
        for row in range(len(times) - 1):
            duration = times[row + 1] - times[row]
            position, speed = turn(duration, inputs[row], slopes[row], position, speed, moved)
            positions[row + 1], speeds[row + 1] = position, speed
        return positions, speeds

    return simulate  # type: ignore[no-any-return]


@functools.cache
def served() -> Callable[..., np.ndarray]:
    """The compiled (times, targets, limits, law, position, speed, moved) -> positions at the times under P control.

    The input at a row is law*(target - position), within the row's limit, and holds till the next.
    """
    from codrl_mj.kept import njit

    turn = turned()

    @njit(nogil=True, error_model="numpy")
    def simulate(
        times: np.ndarray,
        targets: np.ndarray,
        limits: np.ndarray,
        law: float,
        position: float,
        speed: float,
        moved: Any,
    ) -> np.ndarray:
        positions = np.empty(len(times))
        positions[0] = position
        for row in range(len(times) - 1):
            given = min(max(law * (targets[row] - position), -limits[row]), limits[row])
            position, speed = turn(times[row + 1] - times[row], given, 0.0, position, speed, moved)
            positions[row + 1] = position
        return positions

    return simulate  # type: ignore[no-any-return]
