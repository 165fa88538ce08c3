"""Ideal actuator, family `ideal`: it delivers the desired torque."""

import dataclasses
from typing import ClassVar, NamedTuple

from codrl_mj.actuators.model import ActuatorModel, Empty, Inputs
from codrl_mj.actuators.parameters import Parameters


class Signals(NamedTuple):
    """Signals of the current loop, all 0, so that `info` has the same keys without a motor."""

    current: float
    reference_current: float
    voltage: float
    saturated: float


def advance(
    parameters: Parameters,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    state: Empty,  # noqa: ARG001
    inputs: Inputs,
) -> tuple[Empty, float, Signals]:
    """Deliver the desired torque."""
    return Empty(), inputs.desired_torque, Signals(0.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Ideal(ActuatorModel):
    """Actuator without a motor: force = desired force."""

    family: ClassVar[str] = "ideal"
    Signals: ClassVar[type[NamedTuple]] = Signals
    advance: ClassVar = staticmethod(advance)


IDEAL = Ideal()
"""The shared ideal actuator."""
