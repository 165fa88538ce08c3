"""Properties of actuators that consist of a motor with a gear, a supply and something between."""

from collections.abc import Iterable
from typing import Self, cast

import numpy as np

from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.model import ActuatorModel, JointAdditions
from codrl_mj.actuators.parameters import FieldValue, Parameters, parameters_type
from codrl_mj.actuators.servo_friction import ServoFriction, has_servo_friction
from codrl_mj.actuators.stability import ParameterColumns

REPLACED_BY_FRICTION = {
    "coulomb_friction": 0.0,
    "viscous_friction": 0.0,
    "stribeck_friction": 0.0,
    "gear_efficiency": 1.0,
}
"""Fields of the motor that the part `friction` replaces, with their values without friction."""


def has_single_friction(columns: ParameterColumns) -> np.ndarray:
    """Return True for actuators that have the friction of the motor or of servos, but not both."""
    # The function is written for numbers, and computes with arrays here.
    has_friction = np.asarray(has_servo_friction(cast(Parameters, columns)))
    neutral = [getattr(columns, name) == value for name, value in REPLACED_BY_FRICTION.items()]
    single: np.ndarray = ~has_friction | np.logical_and.reduce(neutral)
    return single


def has_valid_temperatures(columns: ParameterColumns) -> np.ndarray:
    """Return True for actuators whose temperatures and resistance `GearMotor` accepts."""
    can_heat = columns.thermal_resistance_winding + columns.thermal_resistance_housing > 0.0
    valid: np.ndarray = columns.max_temperature > columns.ambient_temperature
    valid = valid & (np.isinf(columns.max_temperature) | can_heat)
    # The resistance at the ambient temperature must be positive.
    valid &= 1.0 + columns.resistance_coefficient * (columns.ambient_temperature - 25.0) > 0.0
    return valid


class Geared(ActuatorModel):
    """Base class of the families with the fields `motor`, `supply` and `friction`.

    It is no family itself.
    """

    motor: GearMotor
    supply: Supply | None
    friction: ServoFriction | None

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        # With both, the load on the gear would include the joint's own friction.
        if self.friction in (None, ServoFriction()):
            return
        for name, neutral in REPLACED_BY_FRICTION.items():
            if (value := getattr(self.motor, name)) != neutral:
                raise ValueError(
                    f"motor.{name} = {value:g}: must be {neutral:g} if friction is set, which"
                    " describes all friction at the output shaft: move the value to friction.base,"
                    " viscous, stribeck or load_motor, or remove friction"
                )

    def as_mapping(self) -> dict[str, FieldValue]:
        """Return the fields, without `friction` if that is None; see `ActuatorModel.as_mapping`."""
        mapping = super().as_mapping()
        # Runs are named by a hash of their mapping. Runs without this part keep their names.
        if self.friction is None:
            del mapping["friction"]
        return mapping

    @property
    def arm_radius(self) -> float:
        """Arm [m] between the rotor and the load, including the gear."""
        return self.motor.arm_radius / self.motor.gear_ratio

    @property
    def additions(self) -> JointAdditions:
        """Rotor inertia and friction, as seen from the load."""
        arm, motor = self.arm_radius, self.motor
        return JointAdditions(
            motor.rotor_inertia / (arm * arm),
            motor.viscous_friction / (arm * arm),
            motor.coulomb_friction / arm,
        )

    @property
    def delivered_friction(self) -> JointAdditions:
        """Constant parts of `friction`; see `ActuatorModel.delivered_friction`."""
        friction, arm = self.friction or ServoFriction(), self.motor.arm_radius
        return JointAdditions(0.0, friction.viscous / (arm * arm), friction.base / arm)

    @property
    def back_emf_damping(self) -> float:
        """Damping kT*kE/R at the load through the gear, as in `ActuatorModel.back_emf_damping`."""
        motor = self.motor
        braking = motor.torque_constant * motor.back_emf_constant / motor.resistance
        return motor.gear_efficiency * braking / self.arm_radius**2

    @property
    def winding(self) -> tuple[float, float]:
        """Resistance [ohm] and inductance [H]."""
        return self.motor.resistance, self.motor.inductance

    @property
    def voltage_limit(self) -> float:
        """Voltage [V] of the supply."""
        return 24.0 if self.supply is None else self.supply.voltage

    @property
    def supply_resistance(self) -> float:
        """Internal resistance [ohm] of the supply, by which its voltage drops under a current."""
        return 0.0 if self.supply is None else self.supply.resistance

    @classmethod
    def from_parameter_values(
        cls, parameter_values: Iterable[float], arm_radius: float = 1.0
    ) -> Self:
        """Return the actuator with these parameters.

        The arm is that between rotor and load; the gear ratio is one of the parameters.
        """
        gear_ratio = parameters_type(cls)(*parameter_values).gear_ratio
        return super().from_parameter_values(parameter_values, arm_radius * gear_ratio)
