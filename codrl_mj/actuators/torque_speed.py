"""A torque source within a motor's torque-speed line, family `torque_speed`.

What Isaac Lab (`DCMotor`) and mjlab (`DcMotorActuator`) call a DC motor: no winding and no loop,
only the line that a supply draws through stall torque and no-load speed, and a limit of the torque.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from codrl_mj.actuators.model import ActuatorModel, Inputs, Nothing, UnstableError
from codrl_mj.fields import real


class Signals(NamedTuple):
    """Whether the torque was cut, and the torques [N*m] between which it had to stay."""

    lower_limit: float
    upper_limit: float
    saturated: float


def advance(
    parameters: Any,
    timestep: float,  # noqa: ARG001
    state: Nothing,  # noqa: ARG001
    inputs: Inputs,
) -> tuple[Nothing, float, Signals]:
    """Clip the desired torque to the torque-speed line, and both to `max_torque`.

    At speed w the voltage that drives forward leaves stall_torque*(1 - w/no_load_speed), the one
    that drives backward stall_torque*(-1 - w/no_load_speed). Beyond the speeds at which the line
    reaches +-max_torque it ends there: a controller's current limit holds in every quadrant.
    Without a `max_torque` the stall torque has its place.
    """
    ratio = inputs.speed / parameters.no_load_speed
    limit = parameters.max_torque if parameters.max_torque < math.inf else parameters.stall_torque
    upper = min(max(parameters.stall_torque * (1.0 - ratio), -limit), limit)
    lower = min(max(parameters.stall_torque * (-1.0 - ratio), -limit), limit)
    torque = min(max(inputs.desired_torque, lower), upper)
    saturated = 1.0 if torque != inputs.desired_torque else 0.0
    return Nothing(), torque, Signals(lower, upper, saturated)


@dataclasses.dataclass(frozen=True)
class TorqueSpeed(ActuatorModel):
    """A source of torque that a motor's torque-speed line limits.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "torque_speed"
    Signals: ClassVar[type] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {"lower_limit": "N*m", "upper_limit": "N*m"}
    advance: ClassVar = staticmethod(advance)

    stall_torque: float = real(1.0, above=0.0, unit="N*m")
    """Torque [N*m] at standstill under full voltage, > 0."""
    no_load_speed: float = real(10.0, above=0.0, unit="rad/s")
    """Speed [rad/s] at which full voltage makes no torque, > 0."""
    max_torque: float = real(math.inf, above=0.0, unit="N*m", infinite=True)
    """Largest torque [N*m] of the drive, > 0; often well below the stall torque. `inf`: the stall torque."""

    @property
    def back_emf_damping(self) -> float:
        """As `ActuatorModel.back_emf_damping`: the slope of the line."""
        return self.stall_torque / self.no_load_speed

    @property
    def closes_loops(self) -> bool:
        """True: on its line the torque follows the speed."""
        return True

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Refuse a line that overshoots the no-load speed within a step, from step to step and for ever.

        Raises:
            UnstableError: with the number and a remedy.
        """
        del held
        share = timestep * self.stall_torque / (self.no_load_speed * inertia)
        if share >= 2.0:
            raise UnstableError(
                f"stall_torque = {self.stall_torque:g} at no_load_speed = {self.no_load_speed:g}:"
                f" on the line between them a step of {timestep:g} s takes {share:.3g} of the way"
                f" to the no-load speed, must be < 2. It moves {inertia:.3g} kg*m^2. Shorten the"
                f" step to less than {2.0 * timestep / share:.3g} s, or pass allow_unstable=True to"
                " study it as it is"
            )
