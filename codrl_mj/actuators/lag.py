"""A first-order lag, family `lag`: the simplest actuator that is late."""

import dataclasses
import math
import warnings
from typing import Any, ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators.model import ActuatorModel, Inputs, Nothing
from codrl_mj.fields import real

HISTORY = 8
"""Commands that are remembered: the longest delay in mechanical steps."""


class State(NamedTuple):
    """The delivered torque [N*m], and the commands on their way, the newest first."""

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
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Nothing]:
    """Tau' = (gain*u(t - delay) - tau)/T, exactly, with u held over a step: tau -> g*u + (tau - g*u)*exp(-dt/T).

    The torque is that at the end of the step, as the current loop's is. A delay that is no whole
    number of steps mixes the two neighbouring commands in proportion, which is what held commands
    come to on average over a step.
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
    steps = parameters.delay / timestep
    whole = min(int(steps + 1e-9), 8)
    fraction = min(max(steps - whole, 0.0), 1.0) if steps - whole > 1e-9 else 0.0
    arrived = commands[whole]
    if fraction > 0.0:
        arrived = arrived + fraction * (commands[min(whole + 1, 8)] - arrived)
    arrived = parameters.gain * arrived
    decay = (
        math.exp(-timestep / parameters.time_constant) if parameters.time_constant > 0.0 else 0.0
    )
    torque = arrived + (state.torque - arrived) * decay
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
    return after, torque, Nothing()


@dataclasses.dataclass(frozen=True)
class Lag(ActuatorModel):
    """The delivered torque follows the desired one with a time constant, and, if there is one, a delay.

    What servo drives are modelled by where nothing is known of them but their step response.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "lag"
    State: ClassVar[type] = State
    advance: ClassVar = staticmethod(advance)

    time_constant: float = real(0.05, minimum=0.0, unit="s")
    """Time constant T [s], >= 0: 63 % of a step is delivered after it. 0: nothing but the delay."""
    delay: float = real(0.0, minimum=0.0, unit="s")
    """Delay of the command [s], >= 0, at most eight mechanical steps."""
    gain: float = real(1.0, above=0.0)
    """What of the desired torque is delivered in the end, > 0: 0.9 for a torque constant that is 10 % too small."""

    def check(self, timestep: float) -> None:
        """Refuse a delay longer than what is remembered, and warn of a time constant that looks like one in ms.

        Raises:
            ValueError: the delay is more than `HISTORY` steps.
        """
        # Mountain Car decides once a second, and the studies let it lag by up to four of its steps.
        if self.time_constant > 4.0:
            warnings.warn(
                f"Lag.time_constant = {self.time_constant:g}: 63 % of a step is delivered after"
                f" {self.time_constant:g} s; it is in seconds: for {self.time_constant:g} ms write"
                f" {self.time_constant / 1e3:g}",
                stacklevel=2,
            )
        if self.delay > HISTORY * timestep * (1 + 1e-9):
            raise ValueError(
                f"Lag.delay = {self.delay:g}: must be <= {HISTORY * timestep:g} s, {HISTORY} steps"
                f" of {timestep:g} s. Longer delays are the environment's:"
                " disturbances={'command_delay': ...}"
            )

    @classmethod
    def instability(cls, numbers: np.ndarray, timestep: float) -> np.ndarray:
        """Infinite where `check` refuses; a lag itself is always stable."""
        return np.where(numbers[:, 1] > HISTORY * timestep * (1 + 1e-9), np.inf, 0.0)
