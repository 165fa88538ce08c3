"""Motor with its gear: the values of a datasheet, and those measured on a bench."""

import dataclasses
import math
from typing import Any, TypeVar

import numpy as np

from codrl_mj.catalogue import MotorParameters, from_datasheet
from codrl_mj.fields import Checked, real

Numbers = TypeVar("Numbers", float, np.ndarray)
"""A number, or an array of numbers."""


@dataclasses.dataclass(frozen=True)
class GearMotor(Checked):
    """DC motor with a gear, or a brushless motor as seen by its drive, described by its datasheet.

    For a brushless motor, the values are the line-to-line quantities of the equivalent DC motor.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    resistance: float = real(8.4, above=0.0, unit="ohm")
    """Terminal resistance R [ohm], > 0. The defaults are those of the Quanser QUBE-Servo 2's motor.
    """
    inductance: float = real(1.16e-3, above=0.0, unit="H")
    """Terminal inductance L [H], > 0."""
    torque_constant: float = real(0.042, above=0.0, unit="N*m/A")
    """Torque constant kT [N*m/A] at the rotor, > 0."""
    back_emf_constant: float = real(0.042, minimum=0.0, unit="V*s/rad")
    """Back-EMF constant kE [V*s/rad] at the rotor, >= 0; equal to kT in SI units except for losses.
    """
    rotor_inertia: float = real(4.0e-6, minimum=0.0, unit="kg*m^2")
    """Inertia J [kg*m^2] of the rotor, >= 0: it adds J*n^2 to the joint."""
    gear_ratio: float = real(1.0, above=0.0, unit="")
    """Gear ratio n, > 0: turns of the rotor per turn of the output shaft."""
    gear_efficiency: float = real(1.0, above=0.0, maximum=1.0)
    """Efficiency of the gear when the motor drives the load, in (0, 1]. When the load drives the
    motor, the gear brakes with 1/efficiency - 1 of the torque. This load-dependent friction is part
    of the delivered torque (`codrl_mj.actuators.shaft.friction`).
    """
    coulomb_friction: float = real(0.0, minimum=0.0, unit="N*m")
    """Coulomb friction [N*m] at the rotor, >= 0: `frictionloss` of the joint."""
    viscous_friction: float = real(0.0, minimum=0.0, unit="N*m*s/rad")
    """Viscous friction [N*m*s/rad] at the rotor, >= 0: `damping` of the joint."""
    stribeck_friction: float = real(0.0, minimum=0.0, unit="N*m")
    """Additional friction [N*m] at the rotor at standstill, on top of the Coulomb friction, >= 0.
    It decreases with the speed w as exp(-|w/`stribeck_speed`|^`stribeck_exponent`), and is part of
    the delivered torque (`codrl_mj.actuators.shaft.friction`).
    """
    stribeck_speed: float = real(1.0, above=0.0, unit="rad/s")
    """Speed [rad/s] of the rotor at which 1/e of the Stribeck friction remains, > 0."""
    stribeck_exponent: float = real(2.0, above=0.0, maximum=10.0, unit="")
    """Exponent of the decrease, > 0 and <= 10: usually 2; fits to servos give 1.3 and more."""
    load_inertia: float = real(0.0, minimum=0.0, unit="kg*m^2", infinite=True)
    """Inertia [kg*m^2] that the output shaft moves, >= 0, from which the speed within a step is
    predicted. 0: the inertia in the model at each moment; `inf`: the speed is held over a step. It
    is not added to the model.
    """
    thermal_resistance_winding: float = real(0.0, minimum=0.0, unit="K/W")
    """Thermal resistance [K/W] from winding to housing, >= 0; 0: both have the same temperature."""
    thermal_time_constant_winding: float = real(10.0, above=0.0, unit="s")
    """Time constant [s] of the winding's temperature, > 0."""
    thermal_resistance_housing: float = real(0.0, minimum=0.0, unit="K/W")
    """Thermal resistance [K/W] from the housing to the surroundings, >= 0; 0: the housing stays at
    ambient temperature.
    """
    thermal_time_constant_housing: float = real(100.0, above=0.0, unit="s")
    """Time constant [s] of the housing's temperature, > 0."""
    ambient_temperature: float = real(25.0, above=-273.15, unit="degC")
    """Ambient temperature [degC], and temperature of the winding at the start of an episode."""
    max_temperature: float = real(math.inf, above=-273.15, unit="degC", infinite=True)
    """Largest temperature [degC] of the winding, above ambient; the drive limits its current to
    keep it. `inf`: no limit.
    """
    resistance_coefficient: float = real(0.00393, minimum=0.0, unit="1/K")
    """Temperature coefficient [1/K] of the resistance, relative to 25 degC, >= 0. The default is
    that of copper.
    """
    arm_radius: float = real(1.0, above=0.0, unit="m")
    """Radius [m] of the wheel, drum or pinion on the output shaft that moves a slide, > 0; 1 on a
    hinge.
    """

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if not self.max_temperature > self.ambient_temperature:
            raise ValueError(
                f"GearMotor.max_temperature = {self.max_temperature:g}: must be above"
                f" ambient_temperature = {self.ambient_temperature:g} degC, or the drive would"
                " never request a current"
            )
        if (
            self.max_temperature < math.inf
            and not self.thermal_resistance_winding + self.thermal_resistance_housing
        ):
            raise ValueError(
                f"GearMotor.max_temperature = {self.max_temperature:g}: needs"
                " thermal_resistance_winding or thermal_resistance_housing; without both the motor"
                " does not warm up"
            )
        if not 1.0 + self.resistance_coefficient * (self.ambient_temperature - 25.0) > 0.0:
            raise ValueError(
                f"GearMotor.ambient_temperature = {self.ambient_temperature:g}: with"
                f" resistance_coefficient = {self.resistance_coefficient:g} the winding would have"
                f" no resistance; must be above {25.0 - 1.0 / self.resistance_coefficient:g} degC"
            )

    # The values are texts, except for the settings of the function that takes them.
    @classmethod
    def from_datasheet(cls, **printed: Any) -> "GearMotor":
        """Return a motor from the values of its datasheet, each a text with its unit.

            >>> GearMotor.from_datasheet(resistance="0.464 ohm", inductance="0.322 mH",
            ...                          torque_constant="25.1 mN*m/A",
            ...                          rotor_inertia="135 g*cm^2").torque_constant
            0.0251

        Args:
            printed: as for `codrl_mj.catalogue.from_datasheet`, whose documentation explains each
                value.

        Raises:
            ValueError: the datasheet is not sufficient or contradicts itself; the message has
                values and remedy.
        """
        return cls.from_motor_parameters(from_datasheet(**printed))

    @classmethod
    def from_motor_parameters(cls, parameters: MotorParameters) -> "GearMotor":
        """Return a motor with `codrl_mj.catalogue.MotorParameters`.

        An unknown inertia or friction becomes 0; other unknown values become the fields' defaults.
        """
        values = {
            field.name: getattr(parameters, field.name, None) for field in dataclasses.fields(cls)
        }
        values |= {name: 0.0 for name in _ZERO_IF_UNKNOWN if values[name] is None}
        total_resistance = getattr(parameters, "thermal_resistance", None)
        if values["thermal_resistance_winding"] is None and total_resistance is not None:
            values["thermal_resistance_winding"] = total_resistance - (
                values["thermal_resistance_housing"] or 0.0
            )
        # Without any thermal resistance the winding never warms, and the constructor would reject a
        # temperature limit.
        if values["thermal_resistance_winding"] is None:
            values["max_temperature"] = None
        return cls(**{name: value for name, value in values.items() if value is not None})

    def stribeck(self, speed: Numbers) -> Numbers:
        """Return the Stribeck friction [N*m] at the rotor for a speed [rad/s] of any shape."""
        friction: Numbers = self.stribeck_friction * np.exp(
            -(np.abs(speed / self.stribeck_speed) ** self.stribeck_exponent)
        )
        return friction

    @property
    def electrical_time_constant(self) -> float:
        """Electrical time constant L/R [s]."""
        return self.inductance / self.resistance

    @property
    def mechanical_time_constant(self) -> float:
        """Time constant R*J/(kT*kE) [s] of the motor alone; infinite without a back-EMF."""
        product = self.torque_constant * self.back_emf_constant
        return self.resistance * self.rotor_inertia / product if product > 0.0 else math.inf


_ZERO_IF_UNKNOWN = ("rotor_inertia", "coulomb_friction", "viscous_friction")
"""Fields that a datasheet may omit and that then are 0."""
