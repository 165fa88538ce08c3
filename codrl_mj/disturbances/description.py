"""The description of an environment's disturbances: one frozen dataclass, every field off by default."""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class Disturbances:
    """Imperfections of an actuator's drive, sensor, supply and joint; each is off at 0, its default.

    The command is the desired force [N] or torque [N*m] at the joint. On its way to the current loop it is first
    delayed, then quantised, then limited in its rate, once per integration step. Where an agent commands a current or a
    voltage, the command is the force of that current, or of as many amperes as volts.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value and bound.
    """

    command_delay: float = 0.0
    """Delay of the command [s], >= 0; where it is no whole number of integration steps, the two neighbouring commands
    are interpolated linearly. Before the first command there is zero."""
    command_quantum: float = 0.0
    """Quantisation step of the command [N or N*m], >= 0; rounds half to even, and ends at the largest force."""
    command_rate: float = 0.0
    """Largest change of the command per second [N/s or N*m/s], >= 0; 0: no limit. It starts from zero."""
    current_noise: float = 0.0
    """Standard deviation [A] of the current sensor's white noise, >= 0: a new value for each electrical step."""
    current_bias: float = 0.0
    """Offset of the current sensor [A]: the controller measures the current plus this."""
    supply_resistance: float = 0.0
    """Resistance of the supply [ohm], >= 0: the voltage is limited to max_voltage - supply_resistance*|current|."""
    pulse_force: float = 0.0
    """Size of random load pulses at the actuated joint [N or N*m], >= 0; either sign is as likely."""
    pulse_duration: float = 0.0
    """Duration of a load pulse [s], > 0 where there are pulses."""
    pulse_interval: float = 0.0
    """Mean time [s] from the start, and from the end of each pulse, to the next; exponentially distributed. > 0 where
    there are pulses."""
    joint_damping: float = 0.0
    """Viscous friction of the actuated joint [N*s/m or N*m*s/rad], >= 0. MuJoCo physics only."""
    joint_friction: float = 0.0
    """Coulomb friction of the actuated joint [N or N*m], >= 0. MuJoCo physics only."""

    def __post_init__(self) -> None:
        """Validate."""
        pulses = isinstance(self.pulse_force, numbers.Real) and self.pulse_force > 0
        for field in dataclasses.fields(self):
            value, name = getattr(self, field.name), f"Disturbances.{field.name}"
            any_sign = field.name == "current_bias"
            above = pulses and field.name in ("pulse_duration", "pulse_interval")
            bound = "a finite number" + ("" if any_sign else " > 0 where there are pulses" if above else " >= 0")
            if isinstance(value, bool) or not isinstance(value, numbers.Real):
                raise ValueError(f"{name} = {value!r}: must be {bound}")
            number = float(value)
            if not math.isfinite(number) or (not any_sign and number < 0) or (above and number == 0):
                raise ValueError(f"{name} = {number:g}: must be {bound}")
            object.__setattr__(self, field.name, number)
        if not pulses and (self.pulse_duration or self.pulse_interval):
            field_name = "pulse_duration" if self.pulse_duration else "pulse_interval"
            raise ValueError(
                f"Disturbances.{field_name} = {getattr(self, field_name):g}: there are no pulses: give pulse_force > 0"
            )

    @property
    def of_command(self) -> bool:
        """Whether the command is changed on its way."""
        return bool(self.command_delay or self.command_quantum or self.command_rate)

    @property
    def of_sensor(self) -> bool:
        """Whether the measured current is not the current."""
        return bool(self.current_noise or self.current_bias)

    @property
    def of_motor(self) -> bool:
        """Whether the current loop differs: its sensor or its supply."""
        return self.of_sensor or bool(self.supply_resistance)

    @property
    def of_joint(self) -> bool:
        """Whether the joint has friction or damping."""
        return bool(self.joint_damping or self.joint_friction)

    @property
    def random(self) -> bool:
        """Whether an episode needs a key for its random numbers."""
        return bool(self.current_noise or self.pulse_force)

    def as_mapping(self) -> dict[str, float]:
        """The fields by name, JSON-serialisable."""
        return dataclasses.asdict(self)


OFF = Disturbances()
"""No disturbances."""


def resolve_disturbances(disturbances: "Disturbances | Mapping[str, Any] | None") -> Disturbances:
    """Turn whatever a user may write for disturbances into `Disturbances`.

    Args:
        disturbances: the description, a mapping of its fields, or None for none.

    Raises:
        ValueError: an unknown field (the nearest known one is suggested) or a value out of bounds.
    """
    if disturbances is None:
        return OFF
    if isinstance(disturbances, Disturbances):
        return disturbances
    if not isinstance(disturbances, Mapping):
        raise ValueError(f"disturbances = {disturbances!r}: must be a Disturbances or a mapping of its fields")
    names = [field.name for field in dataclasses.fields(Disturbances)]
    for key in disturbances:
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known fields: {', '.join(names)}"
            raise ValueError(f"unknown field disturbances.{key}; {hint}")
    return Disturbances(**disturbances)
