"""The energy that a motor can pump into a swinging pendulum: what a swing-up needs before anything else."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, Supply
from codrl_mj.sizing.abilities import highest_current

_ANGLES = np.linspace(-np.pi, np.pi, 1001)
_STEP = _ANGLES[1] - _ANGLES[0]
_LEVELS = np.linspace(0.02, 1.0, 50)
"""Energies of swings over that of the top."""
_MOST_VOLTS = 1e4


class Swing(NamedTuple):
    """A pendulum to be swung up; its angle theta is 0 hanging."""

    inertia: float
    """About its hinge [kg*m^2]."""
    gravity: float
    """Gravity's largest torque G, m*g times the distance of hinge and centre of mass [N*m]."""
    largest: float
    """Largest torque that may be asked for [N*m]."""
    damping: float = 0.0
    """Of the hinge [N*m*s/rad]."""
    friction: float = 0.0
    """Coulomb friction of the hinge [N*m]."""

    def potential(self, angle: Any) -> Any:
        """Energy [J] at rest."""
        return self.gravity * (1.0 - np.cos(angle))

    def speed(self, kinetic: Any, drive: Drive) -> Any:
        """Speed [rad/s] at a kinetic energy [J] of pendulum and rotor; 0 where that is negative."""
        return np.sqrt(2.0 * np.maximum(kinetic, 0.0) / (self.inertia + drive.additions.armature))

    def push(self, speed: Any, drive: Drive) -> Any:
        """The most torque [N*m] in the direction of motion, friction taken off.

        min(tau_max, N eta kT min((V - N kE omega)/R, i_max)): negative beyond the no-load speed,
        where nothing but a higher voltage keeps the current from braking. R: with the supply's.
        """
        motor, ratio, added = drive.motor, 1.0 / drive.arm_radius, drive.additions
        back_emf = ratio * motor.back_emf_constant * np.asarray(speed)
        current = highest_current(motor.resistance, drive.voltage_limit, drive.sag, back_emf)
        current = np.minimum(current, drive.controller.max_current)
        torque = np.minimum(
            self.largest, ratio * motor.torque_constant * motor.gear_efficiency * current
        )
        return torque - self.friction - added.friction - (self.damping + added.damping) * speed


def min_pumped_energy(swing: Swing, drive: Drive) -> float:
    """The energy [J] that full force brings in during a swing, where that is least on the way up: an estimate.

    min over E of the integral of push(omega) over theta, with omega = sqrt(2 (E - potential(theta))
    / I): the energy of the swing is taken as constant. Infinite where the torque lifts the pendulum
    without a swing.
    """
    if swing.push(0.0, drive) >= swing.gravity:
        return math.inf
    kinetic = 2.0 * swing.gravity * _LEVELS[:, np.newaxis] - swing.potential(_ANGLES)
    net = np.where(kinetic > 0.0, swing.push(swing.speed(kinetic, drive), drive), 0.0)
    return float(net.sum(axis=1).min() * _STEP)


def min_energy_gain(swing: Swing, drive: Drive) -> float:
    """The energy [J] that a pendulum gains from rest to rest in a swing, where that is least: the most that there is.

    dE/dtheta = push(omega(E - potential(theta))) from each turning point. Whatever else a
    controller does, E grows less everywhere, and so ends lower: where this is not positive, no
    controller passes that amplitude. That leaves out inductance, which only delays, and the hold of
    the speed over a step. A swing that goes over the top, or comes to rest where the torque at
    standstill lifts it on, is through: infinite.
    """
    still = swing.push(0.0, drive)
    if still >= swing.gravity:
        return math.inf
    starts = np.arccos(1.0 - 2.0 * _LEVELS)
    carried = np.pi - math.asin(
        max(still, 0.0) / swing.gravity
    )  # from there on the torque lifts without a swing
    starts = starts[starts < carried]
    energy, furthest, moving = swing.potential(starts), -starts, np.ones(len(starts), bool)
    for angle in _ANGLES[:-1]:
        begun = moving & (angle >= -starts)
        gained = energy + _STEP * swing.push(
            swing.speed(energy - swing.potential(angle), drive), drive
        )
        energy = np.where(begun, gained, energy)
        moving &= ~begun | (energy > swing.potential(angle + _STEP))
        furthest = np.where(begun & moving, angle + _STEP, furthest)
    through = furthest >= carried
    return float(
        np.where(through, np.inf, swing.potential(furthest) - swing.potential(starts)).min()
    )


def min_supply_voltage(swing: Swing, drive: Drive, energy: Callable[[Swing, Drive], float]) -> float:
    """The supply [V] from which `min_pumped_energy` or `min_energy_gain` is positive; infinite where no supply makes it so."""

    def enough(voltage: float) -> bool:
        return energy(swing, dataclasses.replace(drive, supply=Supply(voltage, drive.sag))) > 0.0

    low, high = 0.0, 1.0
    while not enough(high):
        low, high = high, 2.0 * high
        if high > _MOST_VOLTS:
            return math.inf
    while high - low > 1e-3 * high:
        middle = (low + high) / 2.0
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
