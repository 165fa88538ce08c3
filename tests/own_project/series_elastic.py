"""A custom family of actuators: a spring between rotor and load, with friction in the gear."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from codrl_mj.actuators import ActuatorModel, Inputs
from codrl_mj.fields import real


class State(NamedTuple):
    """Deflection of the spring and of the friction's bristles."""

    deflection: float
    bristle: float


class Signals(NamedTuple):
    """Signals of the actuator."""

    deflection: float
    friction: float
    saturated: float


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Wind a spring towards the desired torque; a bristle models the Coulomb friction."""
    desired_deflection = inputs.desired_torque / parameters.stiffness
    change = (desired_deflection - state.deflection) * (
        1.0 - math.exp(-timestep / parameters.winding_time)
    )
    limit = parameters.max_speed * timestep
    saturated = 1.0 if abs(change) > limit else 0.0
    deflection = state.deflection + min(max(change, -limit), limit)
    max_deflection = parameters.coulomb / parameters.bristle_stiffness
    bristle = min(max(state.bristle + inputs.speed * timestep, -max_deflection), max_deflection)
    friction = parameters.bristle_stiffness * bristle
    torque = parameters.stiffness * deflection - friction
    return State(deflection, bristle), torque, Signals(deflection, friction, saturated)


@dataclasses.dataclass(frozen=True)
class SeriesElastic(ActuatorModel):
    """A series-elastic actuator with bristle friction."""

    family: ClassVar[str] = "series_elastic"
    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {"deflection": "rad", "friction": "N*m"}
    advance: ClassVar = staticmethod(advance)

    stiffness: float = real(20.0, above=0.0, unit="N*m/rad")
    """Stiffness of the spring [N*m/rad], > 0."""
    winding_time: float = real(0.03, above=0.0, unit="s")
    """Time constant of winding the spring [s], > 0."""
    max_speed: float = real(4.0, above=0.0, unit="rad/s")
    """Maximum speed of winding [rad/s], > 0."""
    coulomb: float = real(0.05, above=0.0, unit="N*m")
    """Coulomb friction [N*m], > 0."""
    bristle_stiffness: float = real(5.0, above=0.0, unit="N*m/rad")
    """Stiffness of the bristles [N*m/rad], > 0."""


SOFT = SeriesElastic(stiffness=5.0)
"""Actuator with a soft spring."""
