"""Friction of servos that depends on speed, motor torque and load: part `friction` of a drive.

The numbers are those of the output shaft. The largest possible friction torque, the *limit*, is

    base + viscous*|w| + |load_external*tau_load - load_motor*tau_motor|
    + s*(stribeck + |load_external_stribeck*tau_load - load_motor_stribeck*tau_motor| + q),

where s = exp(-|w/stribeck_speed|^stribeck_exponent) is 1 at standstill and decreases with the speed
w. The quadratic part q is not 0 if motor and load push against each other: it is
`load_external_quadratic`*tau_load^2 if the motor is stronger, and `load_motor_quadratic`*
tau_motor^2 if the load is. A family with this part calls `friction_torque` in its `advance`.

Source: Duclusaud, Passault, Padois, Ly, *Extended Friction Models for the Physics Simulation of
Servo Actuators* (2024), models M1 to M6, and the package `better-actuator-models`.
"""

import dataclasses
import math
from types import SimpleNamespace
from typing import cast

import numpy as np

from codrl_mj.actuators.parameters import Parameters
from codrl_mj.fields import Checked, real

_TOLERANCE, _MAX_ITERATIONS = 1e-13, 200


LOAD_TERMS = tuple(
    f"load_{side}{kind}"
    for kind in ("", "_stribeck", "_quadratic")
    for side in ("motor", "external")
)
"""Fields of `ServoFriction` that depend on torques."""


def has_servo_friction(parameters: Parameters) -> bool:
    """Return True if any term of the part `friction` is not 0."""
    constant = parameters.friction_base + parameters.friction_viscous + parameters.friction_stribeck
    loaded = (
        parameters.friction_load_motor
        + parameters.friction_load_external
        + parameters.friction_load_motor_stribeck
        + parameters.friction_load_external_stribeck
        + parameters.friction_load_motor_quadratic
        + parameters.friction_load_external_quadratic
    )
    return constant + loaded > 0.0


def friction_limit(
    parameters: Parameters, speed: float, motor_torque: float, load_torque: float
) -> float:
    """Return the largest friction torque [N*m], all quantities at the output shaft.

    Args:
        parameters: those of a family with the part `friction`.
        speed: speed [rad/s].
        motor_torque: torque [N*m] of the motor, before friction.
        load_torque: torque [N*m] of everything else that acts on the shaft.
    """
    ratio = abs(speed) / parameters.friction_stribeck_speed
    share = math.exp(-(ratio**parameters.friction_stribeck_exponent))
    steady = abs(
        load_torque * parameters.friction_load_external
        - motor_torque * parameters.friction_load_motor
    )
    fading = parameters.friction_stribeck + abs(
        load_torque * parameters.friction_load_external_stribeck
        - motor_torque * parameters.friction_load_motor_stribeck
    )
    if motor_torque * load_torque <= 0.0:
        motor, load = abs(motor_torque), abs(load_torque)
        if load < motor:
            fading += parameters.friction_load_external_quadratic * load * load
        elif load > motor:
            fading += parameters.friction_load_motor_quadratic * motor * motor
    constant = parameters.friction_base + parameters.friction_viscous * abs(speed)
    return constant + steady + share * fading


def friction_torque(
    parameters: Parameters,
    duration: float,
    inertia: float,
    rotor_inertia: float,
    speed: float,
    motor_torque: float,
    load_torque: float,
) -> float:
    """Return the friction [N*m] by an implicit step, all quantities at the output shaft.

    Friction opposes the speed that the shaft would have without it. It is at most the torque that
    stops the shaft at the end of the step, so a smaller driving torque is balanced, and the shaft
    sticks.

    Args:
        parameters: those of a family with the part `friction`.
        duration: duration [s] of the step.
        inertia: total inertia [kg*m^2] that the shaft moves; `inf` if its speed is held. Then
            friction is at most the torque that stops the rotor.
        rotor_inertia: inertia [kg*m^2] of the rotor.
        speed: speed [rad/s] at the beginning of the step.
        motor_torque: torque [N*m] of the motor, before friction.
        load_torque: torque [N*m] of everything else that acts on the shaft.
    """
    if inertia < math.inf:
        free_speed = speed + duration * (motor_torque + load_torque) / inertia
        stopping_torque = inertia * abs(free_speed) / duration
    else:
        free_speed = speed
        stopping_torque = rotor_inertia * abs(speed) / duration if rotor_inertia > 0.0 else math.inf
    limit = friction_limit(parameters, speed, motor_torque, load_torque)
    return math.copysign(min(limit, stopping_torque), free_speed) if free_speed != 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class ServoFriction(Checked):
    """Friction of a servo and its gear, as seen at the output shaft; all 0 by default.

    It is part of the delivered torque, and replaces the friction and the efficiency of
    `GearMotor`, which must be 0 and 1.

    Raises:
        ValueError: a field is out of bounds.
    """

    base: float = real(0.0, minimum=0.0, unit="N*m")
    """Coulomb friction [N*m], >= 0: the same at every speed and load."""
    viscous: float = real(0.0, minimum=0.0, unit="N*m*s/rad")
    """Viscous friction [N*m*s/rad], >= 0."""
    stribeck: float = real(0.0, minimum=0.0, unit="N*m")
    """Additional friction [N*m] at standstill, >= 0, which decreases with the speed."""
    stribeck_speed: float = real(1.0, above=0.0, unit="rad/s")
    """Speed [rad/s] at which 1/e of the additional friction at standstill remains, > 0."""
    stribeck_exponent: float = real(2.0, above=0.0, maximum=10.0, unit="")
    """Exponent of this decrease, > 0 and <= 10."""
    load_motor: float = real(0.0, minimum=0.0, unit="")
    """Friction for a motor torque of 1 N*m, >= 0."""
    load_external: float = real(0.0, minimum=0.0, unit="")
    """Friction for a load of 1 N*m, >= 0. If motor and load push against each other, the two
    frictions add up; if they push in the same direction, they are subtracted.
    """
    load_motor_stribeck: float = real(0.0, minimum=0.0, unit="")
    """Additional friction at standstill for a motor torque of 1 N*m, >= 0."""
    load_external_stribeck: float = real(0.0, minimum=0.0, unit="")
    """Additional friction at standstill for a load of 1 N*m, >= 0."""
    load_motor_quadratic: float = real(0.0, minimum=0.0, unit="1/(N*m)")
    """Additional friction at standstill for a squared motor torque of 1 (N*m)^2, >= 0, while a
    greater load pushes against the motor.
    """
    load_external_quadratic: float = real(0.0, minimum=0.0, unit="1/(N*m)")
    """Additional friction at standstill for a squared load of 1 (N*m)^2, >= 0, while a stronger
    motor pushes against the load.
    """

    def at_arm(self, radius: float) -> "ServoFriction":
        """Return the friction as forces and speeds of a slide at a pinion of a radius [m]."""
        return ServoFriction(
            self.base / radius,
            self.viscous / (radius * radius),
            self.stribeck / radius,
            self.stribeck_speed * radius,
            self.stribeck_exponent,
            self.load_motor,
            self.load_external,
            self.load_motor_stribeck,
            self.load_external_stribeck,
            self.load_motor_quadratic * radius,
            self.load_external_quadratic * radius,
        )

    def limit(
        self, speed: np.ndarray, motor_torque: np.ndarray, load_torque: np.ndarray
    ) -> np.ndarray:
        """Return `friction_limit` for arrays of one shape."""
        named = {f"friction_{name}": value for name, value in vars(self).items()}
        parameters = cast(Parameters, SimpleNamespace(**named))
        limits = np.vectorize(
            lambda *point: friction_limit(parameters, *map(float, point)), otypes=[float]
        )(speed, motor_torque, load_torque)
        return np.asarray(limits)

    def net_torque(self, motor_torque: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the torque [N*m] that drives a load at a held speed, after friction.

        The load balances this torque, and the friction depends on the load, so the result is found
        by iteration. At standstill friction only cancels torque.

        Args:
            motor_torque: torques [N*m] of the motor at the output shaft, of any shape.
            speed: speeds [rad/s] of the output shaft, of the same shape.
        """
        motor_torque, speed = np.broadcast_arrays(motor_torque, speed)
        net = np.array(motor_torque, dtype=float)
        for _ in range(_MAX_ITERATIONS):
            limit = self.limit(speed, motor_torque, -net)
            static = np.sign(motor_torque) * np.maximum(np.abs(motor_torque) - limit, 0.0)
            balanced = np.where(speed == 0.0, static, motor_torque - limit * np.sign(speed))
            change = 0.5 * (balanced - net)
            net += change
            if np.all(np.abs(change) <= _TOLERANCE * (1.0 + np.abs(net))):
                break
        return net
