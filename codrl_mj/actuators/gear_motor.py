"""A motor with its gear: what a datasheet says of it, and what a bench adds."""

import dataclasses
import math
from typing import Any

import numpy as np

from codrl_mj.fields import Checked, real


@dataclasses.dataclass(frozen=True)
class GearMotor(Checked):
    """A DC motor, or a brushless one seen from its drive, with its gear: what a datasheet says.

    Brushless motors: terminal quantities, line to line, of the equivalent DC motor.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    resistance: float = real(8.4, above=0.0, unit="ohm")
    """Terminal resistance R [ohm], > 0. The defaults are the Quanser QUBE-Servo 2's motor."""
    inductance: float = real(1.16e-3, above=0.0, unit="H")
    """Terminal inductance L [H], > 0."""
    torque_constant: float = real(0.042, above=0.0, unit="N*m/A")
    """Torque constant kT [N*m/A] at the rotor, > 0."""
    back_emf_constant: float = real(0.042, minimum=0.0, unit="V*s/rad")
    """Back-EMF constant kE [V*s/rad] at the rotor, >= 0; equal to kT in SI units but for losses."""
    rotor_inertia: float = real(4.0e-6, minimum=0.0, unit="kg*m^2")
    """Inertia J [kg*m^2] of the rotor, >= 0: the joint gets J*n^2."""
    gear_ratio: float = real(1.0, above=0.0, unit="")
    """Turns n of the rotor for a turn of the output shaft, > 0."""
    gear_efficiency: float = real(1.0, above=0.0, maximum=1.0)
    """Share of the torque that the gear passes on when it drives, in (0, 1]; driven, it brakes with
    1/efficiency - 1 of the torque: friction that depends on the load, part of what is delivered
    (`codrl_mj.actuators.shaft.friction`).
    """
    coulomb_friction: float = real(0.0, minimum=0.0, unit="N*m")
    """Coulomb friction [N*m] at the rotor, >= 0: the joint's `frictionloss`."""
    viscous_friction: float = real(0.0, minimum=0.0, unit="N*m*s/rad")
    """Viscous friction [N*m*s/rad] at the rotor, >= 0: the joint's `damping`."""
    stribeck_friction: float = real(0.0, minimum=0.0, unit="N*m")
    """What friction has at standstill [N*m] at the rotor over the Coulomb friction, >= 0; with the
    speed w it falls as exp(-|w/`stribeck_speed`|^`stribeck_exponent`). Part of what is delivered
    (`codrl_mj.actuators.shaft.friction`).
    """
    stribeck_speed: float = real(1.0, above=0.0, unit="rad/s")
    """Speed [rad/s] of the rotor at which 1/e of it is left, > 0."""
    stribeck_exponent: float = real(2.0, above=0.0, maximum=10.0, unit="")
    """How abruptly it falls, > 0 and <= 10: 2 is the usual, fits to servos give 1.3 and more."""
    load_inertia: float = real(0.0, minimum=0.0, unit="kg*m^2", infinite=True)
    """Inertia [kg*m^2] of what the output shaft moves, >= 0, by which its speed changes within a
    step; 0: what it is in the model at each moment; `inf`: the speed is held over a step. Nothing
    is added to the model by it.
    """
    thermal_resistance_winding: float = real(0.0, minimum=0.0, unit="K/W")
    """Thermal resistance [K/W] from the winding to the housing, >= 0; 0: the winding is as warm as the housing."""
    thermal_time_constant_winding: float = real(10.0, above=0.0, unit="s")
    """Time constant [s] of the winding's temperature, > 0."""
    thermal_resistance_housing: float = real(0.0, minimum=0.0, unit="K/W")
    """Thermal resistance [K/W] from the housing to the surroundings, >= 0; 0: it stays as cold as they are."""
    thermal_time_constant_housing: float = real(100.0, above=0.0, unit="s")
    """Time constant [s] of the housing's temperature, > 0."""
    ambient_temperature: float = real(25.0, above=-273.15, unit="degC")
    """Temperature [degC] of the surroundings, and of the winding at the start of an episode."""
    max_temperature: float = real(math.inf, above=-273.15, unit="degC", infinite=True)
    """Temperature [degC] of the winding that the drive keeps by asking for less current, above ambient; `inf`: none."""
    resistance_coefficient: float = real(0.00393, minimum=0.0, unit="1/K")
    """Growth [1/K] of the resistance with the winding's temperature, from 25 degC on, >= 0. The default is copper's."""
    arm_radius: float = real(1.0, above=0.0, unit="m")
    """Radius [m] of the wheel, drum or pinion on the output shaft that moves a slide, > 0; on a hinge 1."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if not self.max_temperature > self.ambient_temperature:
            raise ValueError(
                f"GearMotor.max_temperature = {self.max_temperature:g}: must be above"
                f" ambient_temperature = {self.ambient_temperature:g} degC, or no current at all"
                " would be asked for"
            )
        if (
            self.max_temperature < math.inf
            and not self.thermal_resistance_winding + self.thermal_resistance_housing
        ):
            raise ValueError(
                f"GearMotor.max_temperature = {self.max_temperature:g}: needs"
                " thermal_resistance_winding or thermal_resistance_housing, without which nothing"
                " warms"
            )
        if not 1.0 + self.resistance_coefficient * (self.ambient_temperature - 25.0) > 0.0:
            raise ValueError(
                f"GearMotor.ambient_temperature = {self.ambient_temperature:g}: with"
                f" resistance_coefficient = {self.resistance_coefficient:g} the winding would have"
                f" no resistance; must be above {25.0 - 1.0 / self.resistance_coefficient:g} degC"
            )

    @classmethod
    def from_datasheet(cls, **printed: Any) -> "GearMotor":
        """A motor from what its datasheet prints, each value as text with its unit.

            >>> GearMotor.from_datasheet(resistance="0.464 ohm", inductance="0.322 mH", torque_constant="25.1 mN*m/A",
            ...                          rotor_inertia="135 g*cm^2").torque_constant
            0.0251

        Args:
            printed: as for `codrl_mj.catalogue.from_datasheet`, which also says how each number
                came about.

        Raises:
            ValueError: the datasheet does not suffice, or contradicts itself; the message has
                values and remedy.
        """
        from codrl_mj.catalogue import from_datasheet

        return cls.from_motor_parameters(from_datasheet(**printed))

    @classmethod
    def from_motor_parameters(cls, numbers: Any) -> "GearMotor":
        """A motor of `codrl_mj.catalogue.MotorParameters`; what they do not know is left at 0, an efficiency at 1."""
        known = {
            field.name: getattr(numbers, field.name, None) for field in dataclasses.fields(cls)
        }
        known |= {name: 0.0 for name in _UNKNOWN if known[name] is None}
        whole = getattr(numbers, "thermal_resistance", None)
        if known["thermal_resistance_winding"] is None and whole is not None:
            known["thermal_resistance_winding"] = whole - (
                known["thermal_resistance_housing"] or 0.0
            )
        if known["thermal_resistance_winding"] is None:
            known["max_temperature"] = None
        return cls(**{name: value for name, value in known.items() if value is not None})

    def stribeck(self, speed: Any) -> Any:
        """Stribeck friction [N*m] at the rotor at its speed [rad/s], any shape."""
        return self.stribeck_friction * np.exp(
            -(np.abs(speed / self.stribeck_speed) ** self.stribeck_exponent)
        )

    @property
    def electrical_time_constant(self) -> float:
        """L/R [s]."""
        return self.inductance / self.resistance

    @property
    def mechanical_time_constant(self) -> float:
        """R*J/(kT*kE) [s] of the motor alone, without its gear and load; infinite without a back-EMF."""
        product = self.torque_constant * self.back_emf_constant
        return self.resistance * self.rotor_inertia / product if product > 0.0 else math.inf


_UNKNOWN = ("rotor_inertia", "coulomb_friction", "viscous_friction")
"""What a datasheet may leave open, and is 0 then."""
