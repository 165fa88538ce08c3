"""What a demand asks of a motor at its shaft: torque, current, voltage, heat."""

import math
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, GearMotor
from codrl_mj.sizing.demand import Demand

_LITTLE = 1e-300
"""Instead of a division by 0."""


class Operation(NamedTuple):
    """A demand as the rotor sees it, over T steps."""

    torque: np.ndarray
    """The rotor's [N*m], shape (T,)."""
    speed: np.ndarray
    """The rotor's [rad/s], shape (T,)."""
    current: np.ndarray
    """[A], shape (T,)."""
    voltage: np.ndarray
    """That the supply has to have [V], shape (T,), >= 0."""
    rms_current: float
    """Over the whole demand [A]."""
    copper_loss: float
    """Heat in the winding in an episode [J]."""
    energy_drawn: float
    """Electrical energy drawn from the supply in an episode [J], what comes back not taken off."""
    own_share: float
    """Largest torque that rotor and friction take, over the largest that the joint is asked for; at least that, where
    the rotor's inertia is unknown and thus 0."""


def operation(demand: Demand, drive: Drive) -> Operation:
    """What a demand asks of a motor.

    With N turns of the rotor for one of the joint (1/arm on a slide),

        tau_rotor = (tau + N^2 (J alpha + b omega) + N tau_c sign(omega)) / (N eta),   i = tau_rotor / kT,
        V >= |R i + N kE omega| + R_supply |i|, and with L di/dt while i comes from its value in the step before.

    with Stribeck friction in tau_c. A change of the torque is to be made within a step of the demand; so is that from
    one episode to the next. Where the motor brakes or holds, eta is 1: the gear helps then. Energies
    are of the mean speed in a step, all else of that at its start.
    """
    motor, added, arm = drive.motor, drive.additions, drive.arm_radius
    sticking = motor.stribeck(demand.speed / arm) / arm
    own = added.armature * demand.acceleration + added.damping * demand.speed
    own = own + (added.friction + sticking) * np.sign(demand.speed)
    joint = demand.torque + own
    torque = arm * joint / np.where(joint * demand.speed > 0.0, motor.gear_efficiency, 1.0)
    speed, current = demand.speed / arm, torque / motor.torque_constant
    terminal = motor.resistance * current + motor.back_emf_constant * speed
    changing = terminal + motor.inductance * np.diff(current, prepend=current[:1]) / demand.duration
    supply = 0.0 if drive.supply is None else drive.supply.resistance
    mean_speed = speed + demand.acceleration * demand.duration / (2.0 * arm)
    power = (motor.resistance * current + motor.back_emf_constant * mean_speed) * current
    square = float(current**2 @ demand.duration)
    return Operation(
        torque=torque,
        speed=speed,
        current=current,
        voltage=np.maximum(np.abs(terminal), np.abs(changing)) + supply * np.abs(current),
        rms_current=math.sqrt(square / float(demand.duration.sum())),
        copper_loss=motor.resistance * square / demand.episodes,
        energy_drawn=float(np.maximum(power, 0.0) @ demand.duration) / demand.episodes,
        own_share=float(np.abs(own).max() / max(np.abs(demand.torque).max(), _LITTLE)),
    )


def best_ratio(torque: Any, speed: Any, motor: GearMotor) -> Any:
    """The gear N at which a torque [N*m] at a speed [rad/s] takes the least voltage, 2 N kE omega.

    The minimum of R tau/(N kT) + N kE omega over N; rotor and friction are not in it.
    """
    return np.sqrt(motor.resistance * torque / (motor.torque_constant * motor.back_emf_constant * speed))
