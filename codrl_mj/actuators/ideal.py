"""The ideal actuator, family `ideal`: what is asked for is delivered."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

from codrl_mj.actuators.model import ActuatorModel, Inputs, Nothing


class Signals(NamedTuple):
    """The current loop's signals, all 0, so that an environment's `info` has the same keys with a motor and without."""

    current: float
    reference_current: float
    voltage: float
    saturated: float


def advance(
    parameters: Any,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    state: Nothing,  # noqa: ARG001
    inputs: Inputs,
) -> tuple[Nothing, float, Signals]:
    """Deliver the desired torque."""
    return Nothing(), inputs.desired_torque, Signals(0.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Ideal(ActuatorModel):
    """Force = desired force: no motor at all."""

    family: ClassVar[str] = "ideal"
    Signals: ClassVar[type] = Signals
    advance: ClassVar = staticmethod(advance)


IDEAL = Ideal()
"""The ideal actuator."""
