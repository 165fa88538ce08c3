"""The description of an environment's disturbances: one frozen dataclass, every field off by default."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from codrl_mj import fields
from codrl_mj.fields import real


@dataclasses.dataclass(frozen=True)
class Disturbances:
    """Imperfections between the agent and its actuator, and loads on the joint; each is off at 0, its default.

    The command is the desired force [N] or torque [N*m] at the joint. On its way to the actuator it is first
    delayed, then quantised, then limited in its rate, once per integration step. Where an agent commands a current or a
    voltage, the command is the force of that current, or of as many amperes as volts.

    What is the actuator's own (its sensor, its supply) is described there, and what is the joint's (damping, friction)
    by the environment's `joint`.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value and bound.
    """

    command_delay: float = real(0.0, least=0, unit="s")
    """Delay of the command [s], >= 0; where it is no whole number of integration steps, the two neighbouring commands
    are interpolated linearly. Before the first command there is zero."""
    command_quantum: float = real(0.0, least=0, unit="N")
    """Quantisation step of the command [N or N*m], >= 0; rounds half to even, and ends at the largest force."""
    command_rate: float = real(0.0, least=0, unit="N/s")
    """Largest change of the command per second [N/s or N*m/s], >= 0; 0: no limit. It starts from zero."""
    pulse_force: float = real(0.0, least=0, unit="N")
    """Size of random load pulses at the actuated joint [N or N*m], >= 0; either sign is as likely."""
    pulse_duration: float = real(0.0, least=0, unit="s")
    """Duration of a load pulse [s], > 0 where there are pulses."""
    pulse_interval: float = real(0.0, least=0, unit="s")
    """Mean time [s] from the start, and from the end of each pulse, to the next; exponentially distributed. > 0 where
    there are pulses."""

    def __post_init__(self) -> None:
        """Validate."""
        fields.check(self)
        for name in ("pulse_duration", "pulse_interval"):
            value = getattr(self, name)
            if self.pulse_force and not value:
                raise ValueError(f"Disturbances.{name} = {value:g}: must be a finite number > 0 where there are pulses")
            if value and not self.pulse_force:
                raise ValueError(f"Disturbances.{name} = {value:g}: there are no pulses: give pulse_force > 0")

    @property
    def of_command(self) -> bool:
        """Whether the command is changed on its way."""
        return bool(self.command_delay or self.command_quantum or self.command_rate)

    @property
    def random(self) -> bool:
        """Whether an episode needs a key for its random numbers."""
        return bool(self.pulse_force)

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
    return fields.build(Disturbances, disturbances, "field", "disturbances.")


@dataclasses.dataclass(frozen=True)
class Joint:
    """What is added to the actuated joints of the model; nothing by default. MuJoCo physics only.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value and bound.
    """

    damping: float = real(0.0, least=0, unit="N*s/m")
    """Viscous friction [N*s/m or N*m*s/rad], >= 0."""
    friction: float = real(0.0, least=0, unit="N")
    """Coulomb friction [N or N*m], >= 0."""
    armature: float = real(0.0, least=0, unit="kg")
    """Inertia [kg or kg*m^2], >= 0, such as a rotor's behind a gear."""

    def __post_init__(self) -> None:
        """Validate."""
        fields.check(self)


PLAIN = Joint()
"""Nothing added."""


def resolve_joint(joint: "Joint | Mapping[str, Any] | None") -> Joint:
    """Turn whatever a user may write for a joint into a `Joint`.

    Raises:
        ValueError: an unknown field (the nearest known one is suggested) or a value out of bounds.
    """
    if joint is None or isinstance(joint, Joint):
        return joint or PLAIN
    return fields.build(Joint, joint, "field", "joint.")
