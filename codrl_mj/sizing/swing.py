"""Energy that a motor can pump into a swinging pendulum, which a swing-up requires."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, Supply
from codrl_mj.sizing.limits import Number, highest_current

_ANGLES = np.linspace(-np.pi, np.pi, 1001)
_STEP = _ANGLES[1] - _ANGLES[0]
_LEVELS = np.linspace(0.02, 1.0, 50)
"""Energies of swings, relative to the energy at the top."""
_MAX_VOLTAGE = 1e4
"""Largest supply [V] in the search of `min_supply_voltage`."""


class Swing(NamedTuple):
    """Pendulum to be swung up; its angle theta is 0 when it hangs."""

    inertia: float
    """Inertia about its hinge [kg*m^2]."""
    gravity_torque: float
    """Largest torque of gravity [N*m]: m*g times the distance from hinge to center of mass."""
    max_torque: float
    """Largest torque [N*m] that a policy can command."""
    damping: float = 0.0
    """Damping of the hinge [N*m*s/rad]."""
    friction: float = 0.0
    """Coulomb friction of the hinge [N*m]."""

    def potential_energy(self, angle: Number) -> Number:
        """Return the potential energy [J] at an angle [rad]; 0 when the pendulum hangs."""
        energy: Number = self.gravity_torque * (1.0 - np.cos(angle))
        return energy

    def speed(self, kinetic: Number, drive: Drive) -> Number:
        """Return the speed [rad/s] at a kinetic energy [J] of pendulum and rotor; 0 if negative."""
        inertia = self.inertia + drive.additions.armature
        speed: Number = np.sqrt(2.0 * np.maximum(kinetic, 0.0) / inertia)
        return speed

    def max_net_torque(self, speed: Number, drive: Drive) -> Number:
        """Return the largest net torque [N*m] in the direction of motion.

        It is min(tau_max, N eta kT min((V - N kE omega)/R, i_max)) minus friction, where R is the
        resistance of winding and supply. Beyond the no-load speed it is negative: the motor brakes.
        """
        motor, ratio, added = drive.motor, 1.0 / drive.arm_radius, drive.additions
        back_emf = ratio * motor.back_emf_constant * np.asarray(speed)
        current = highest_current(
            motor.resistance, drive.voltage_limit, drive.supply_resistance, back_emf
        )
        current = np.minimum(current, drive.controller.max_current)
        torque = np.minimum(
            self.max_torque, ratio * motor.torque_constant * motor.gear_efficiency * current
        )
        damping = self.damping + added.damping
        net: Number = torque - self.friction - added.friction - damping * speed
        return net


def min_pumped_energy(swing: Swing, drive: Drive) -> float:
    """Return an estimate of the smallest energy [J] that full force adds in a swing.

    The net torque is integrated over the angle, with the speed of a constant energy E, and the
    smallest integral over E is returned: the energy is treated as constant during a swing. The
    result is infinite if the standstill torque lifts the pendulum without a swing.
    """
    if swing.max_net_torque(0.0, drive) >= swing.gravity_torque:
        return math.inf
    kinetic = 2.0 * swing.gravity_torque * _LEVELS[:, np.newaxis] - swing.potential_energy(_ANGLES)
    net = np.where(kinetic > 0.0, swing.max_net_torque(swing.speed(kinetic, drive), drive), 0.0)
    return float(net.sum(axis=1).min() * _STEP)


def min_energy_gain(swing: Swing, drive: Drive) -> float:
    """Return the smallest energy [J] gained between two turning points by the best controller.

    dE/dtheta = `max_net_torque` at the speed of the present energy is integrated from each turning
    point. Any other controller adds less energy at every angle, so if this gain is not positive at
    some amplitude, no controller exceeds that amplitude. Two effects are ignored:
    inductance, which only delays the torque, and that the actuator sees a constant speed in a step.
    The gain is infinite if the swing goes over the top or
    stops where the standstill torque lifts the pendulum further.
    """
    standstill_torque = swing.max_net_torque(0.0, drive)
    if standstill_torque >= swing.gravity_torque:
        return math.inf
    starts = np.arccos(1.0 - 2.0 * _LEVELS)
    # Beyond this angle the standstill torque exceeds gravity and lifts the pendulum without a
    # swing.
    lift_angle = np.pi - math.asin(max(standstill_torque, 0.0) / swing.gravity_torque)
    starts = starts[starts < lift_angle]
    energy, max_angle, moving = swing.potential_energy(starts), -starts, np.ones(len(starts), bool)
    # All swings are integrated at once; each one starts when the angle passes its turning point.
    for angle in _ANGLES[:-1]:
        started = moving & (angle >= -starts)
        new_energy = energy + _STEP * swing.max_net_torque(
            swing.speed(energy - swing.potential_energy(angle), drive), drive
        )
        energy = np.where(started, new_energy, energy)
        moving &= ~started | (energy > swing.potential_energy(angle + _STEP))
        max_angle = np.where(started & moving, angle + _STEP, max_angle)
    completed = max_angle >= lift_angle
    return float(
        np.where(
            completed, np.inf, swing.potential_energy(max_angle) - swing.potential_energy(starts)
        ).min()
    )


def min_supply_voltage(
    swing: Swing, drive: Drive, energy: Callable[[Swing, Drive], float]
) -> float:
    """Return the lowest supply [V] at which `energy` is positive; infinite if there is none.

    `energy` is `min_pumped_energy` or `min_energy_gain`.
    """

    def suffices(voltage: float) -> bool:
        return (
            energy(
                swing, dataclasses.replace(drive, supply=Supply(voltage, drive.supply_resistance))
            )
            > 0.0
        )

    low, high = 0.0, 1.0
    while not suffices(high):
        low, high = high, 2.0 * high
        if high > _MAX_VOLTAGE:
            return math.inf
    while high - low > 1e-3 * high:
        middle = (low + high) / 2.0
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return high
