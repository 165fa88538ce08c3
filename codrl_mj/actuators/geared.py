"""Properties of actuators that consist of a motor with a gear, a supply and something between."""

from collections.abc import Iterable
from typing import Self

from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.model import ActuatorModel, JointAdditions
from codrl_mj.actuators.parameters import parameters_type


class Geared(ActuatorModel):
    """Base class of the families with the fields `motor` and `supply`; it is no family itself."""

    motor: GearMotor
    supply: Supply | None

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
