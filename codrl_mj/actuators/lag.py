"""First-order lag, family `lag`: the simplest actuator with a delayed response."""

import dataclasses
import math
import warnings
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators.model import ActuatorModel, Empty, Inputs
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.fields import real

HISTORY = 8
"""Number of past commands in the state: the longest delay in mechanical steps."""


class State(NamedTuple):
    """Delivered torque [N*m] and the commands of the last steps, the newest first."""

    torque: float
    c1: float
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float
    c8: float


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Empty]:
    """Advance tau' = (gain*u(t - delay) - tau)/T exactly, with u held over a step.

    The update is tau -> g*u + (tau - g*u)*exp(-dt/T). The returned torque is that at the end of the
    step, as with the current loop. If the delay is not a whole number of steps, the two adjacent
    commands are weighted in proportion, which equals the average of the held commands over a step.
    """
    commands = (
        inputs.desired_torque,
        state.c1,
        state.c2,
        state.c3,
        state.c4,
        state.c5,
        state.c6,
        state.c7,
        state.c8,
    )
    # A delay that misses a whole number of steps by rounding only must not mix in the next command.
    steps = parameters.delay / timestep
    whole_steps = min(int(steps + 1e-9), 8)
    fraction = min(max(steps - whole_steps, 0.0), 1.0) if steps - whole_steps > 1e-9 else 0.0
    target = commands[whole_steps]
    if fraction > 0.0:
        target = target + fraction * (commands[min(whole_steps + 1, 8)] - target)
    target = parameters.gain * target
    decay = (
        math.exp(-timestep / parameters.time_constant) if parameters.time_constant > 0.0 else 0.0
    )
    torque = target + (state.torque - target) * decay
    after = State(
        torque,
        inputs.desired_torque,
        state.c1,
        state.c2,
        state.c3,
        state.c4,
        state.c5,
        state.c6,
        state.c7,
    )
    return after, torque, Empty()


@dataclasses.dataclass(frozen=True)
class Lag(ActuatorModel):
    """First-order lag with an optional delay: the torque follows the command with a time constant.

    It is the usual model of a servo drive of which only the step response is known.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "lag"
    State: ClassVar[type[NamedTuple]] = State
    advance: ClassVar = staticmethod(advance)

    time_constant: float = real(0.05, minimum=0.0, unit="s")
    """Time constant T [s], >= 0, after which 63 % of a step is delivered. 0: delay only."""
    delay: float = real(0.0, minimum=0.0, unit="s")
    """Delay of the command [s], >= 0, at most eight mechanical steps."""
    gain: float = real(1.0, above=0.0)
    """Steady-state ratio of delivered to desired torque, > 0: 0.9 for a torque constant that is 10
    % too small.
    """

    def check(self, timestep: float) -> None:
        """Raise if the delay exceeds the history; warn if the time constant seems to be in ms.

        Raises:
            ValueError: the delay is more than `HISTORY` steps.
        """
        # The limit is so high because Mountain Car decides once a second, and the studies use lags
        # of up to four of its steps.
        if self.time_constant > 4.0:
            warnings.warn(
                f"Lag.time_constant = {self.time_constant:g}: is in seconds, so 63 % of a step is"
                f" delivered after {self.time_constant:g} s; for {self.time_constant:g} ms write"
                f" {self.time_constant / 1e3:g}",
                stacklevel=2,
            )
        if self.delay > HISTORY * timestep * (1 + 1e-9):
            raise ValueError(
                f"Lag.delay = {self.delay:g}: must be <= {HISTORY * timestep:g} s, {HISTORY} steps"
                f" of {timestep:g} s. Longer delays belong to the environment:"
                " disturbances={'command_delay': ...}"
            )

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return infinity where `check` raises; a lag is always stable."""
        return np.where(parameter_values[:, 1] > HISTORY * timestep * (1 + 1e-9), np.inf, 0.0)
