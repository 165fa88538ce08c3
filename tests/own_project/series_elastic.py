"""A family of actuators: a spring between rotor and load, with friction in the gear."""

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
    """What can be seen of it."""

    deflection: float
    friction: float
    saturated: float


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """A spring that is wound towards the desired torque, and a bristle that breaks away at the Coulomb torque."""
    wanted = inputs.desired_torque / parameters.stiffness
    change = (wanted - state.deflection) * (1.0 - math.exp(-timestep / parameters.winding_time))
    limit = parameters.max_speed * timestep
    saturated = 1.0 if abs(change) > limit else 0.0
    deflection = state.deflection + min(max(change, -limit), limit)
    most = parameters.coulomb / parameters.bristle_stiffness
    bristle = min(max(state.bristle + inputs.speed * timestep, -most), most)
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
    """Of the spring [N*m/rad], > 0."""
    winding_time: float = real(0.03, above=0.0, unit="s")
    """Time constant with which it is wound [s], > 0."""
    max_speed: float = real(4.0, above=0.0, unit="rad/s")
    """Fastest winding [rad/s], > 0."""
    coulomb: float = real(0.05, above=0.0, unit="N*m")
    """Coulomb friction [N*m], > 0."""
    bristle_stiffness: float = real(5.0, above=0.0, unit="N*m/rad")
    """Of the bristles [N*m/rad], > 0."""


SOFT = SeriesElastic(stiffness=5.0)
"""One with a soft spring."""
