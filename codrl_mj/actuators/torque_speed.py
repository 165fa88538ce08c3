"""Torque source limited by a motor's torque-speed line, family `torque_speed`.

Isaac Lab (`DCMotor`) and mjlab (`DcMotorActuator`) call this a DC motor. It has no winding and no
loop, only the line through stall torque and no-load speed, and a torque limit.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

from codrl_mj.actuators.model import ActuatorModel, Empty, Inputs, UnstableError
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.fields import real


class Signals(NamedTuple):
    """Torque limits [N*m] of the last step, and 1 if the torque was clipped."""

    lower_limit: float
    upper_limit: float
    saturated: float


def advance(
    parameters: Parameters,
    timestep: float,  # noqa: ARG001
    state: Empty,  # noqa: ARG001
    inputs: Inputs,
) -> tuple[Empty, float, Signals]:
    """Clip the desired torque to the torque-speed line, and to `max_torque`.

    At speed w, full forward voltage gives stall_torque*(1 - w/no_load_speed), and full backward
    voltage stall_torque*(-1 - w/no_load_speed). Where the line exceeds +-max_torque it is cut off:
    a controller's current limit holds in every quadrant. Without a `max_torque` the limit is the
    stall torque.
    """
    ratio = inputs.speed / parameters.no_load_speed
    limit = parameters.max_torque if parameters.max_torque < math.inf else parameters.stall_torque
    upper = min(max(parameters.stall_torque * (1.0 - ratio), -limit), limit)
    lower = min(max(parameters.stall_torque * (-1.0 - ratio), -limit), limit)
    torque = min(max(inputs.desired_torque, lower), upper)
    saturated = 1.0 if torque != inputs.desired_torque else 0.0
    return Empty(), torque, Signals(lower, upper, saturated)


@dataclasses.dataclass(frozen=True)
class TorqueSpeed(ActuatorModel):
    """Torque source limited by a motor's torque-speed line.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "torque_speed"
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {"lower_limit": "N*m", "upper_limit": "N*m"}
    advance: ClassVar = staticmethod(advance)

    stall_torque: float = real(1.0, above=0.0, unit="N*m")
    """Torque [N*m] at standstill under full voltage, > 0."""
    no_load_speed: float = real(10.0, above=0.0, unit="rad/s")
    """Speed [rad/s] at which full voltage produces no torque, > 0."""
    max_torque: float = real(math.inf, above=0.0, unit="N*m", infinite=True)
    """Largest torque [N*m] of the drive, > 0; often well below the stall torque. `inf`: the stall
    torque.
    """

    @property
    def back_emf_damping(self) -> float:
        """Slope of the line, as in `ActuatorModel.back_emf_damping`."""
        return self.stall_torque / self.no_load_speed

    @property
    def assumed(self) -> str:
        """Reason for which a datasheet gives no winding; empty for an actuator made otherwise.

        It is not a field: equality, mappings and hashes of configurations ignore it.
        """
        return str(vars(self).get("_assumed", ""))

    @property
    def closes_loops(self) -> bool:
        """True: on the line, the torque depends on the speed."""
        return True

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Raise if the line is so steep that the speed overshoots more with every step.

        Raises:
            UnstableError: with the number and a remedy.
        """
        del held
        # A held torque changes the speed by this share of its distance to the no-load speed. Above
        # 1 it overshoots, and at 2 the overshoot no longer decays.
        share = timestep * self.stall_torque / (self.no_load_speed * inertia)
        if share >= 2.0:
            raise UnstableError(
                f"stall_torque = {self.stall_torque:g} at no_load_speed = {self.no_load_speed:g}:"
                f" a step of {timestep:g} s changes the speed by {share:.3g} times its distance to"
                f" the no-load speed, must be < 2. The inertia is {inertia:.3g} kg*m^2. Shorten the"
                f" step to less than {2.0 * timestep / share:.3g} s, or pass allow_unstable=True to"
                " study it as it is"
            )
