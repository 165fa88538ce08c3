"""An actuator of the study's own: a lag that remembers commands for four steps of the policy, and can show them.

The package's `Lag` remembers eight integration steps, which is less than the delays that are drawn
here. What it does is the same: a test holds one against the other.
"""

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple

from codrl_mj.actuators import ActuatorModel, Inputs
from codrl_mj.fields import real

LONGEST = 4
"""The longest delay, and the commands that are shown, in steps of the policy."""


class State(NamedTuple):
    """The delivered torque [N*m], integration steps since the policy chose, and its commands, the newest first."""

    torque: float
    since: float
    c0: float
    c1: float
    c2: float
    c3: float
    c4: float


class Signals(NamedTuple):
    """The last commands, the newest first, in shares of the largest."""

    command_1: float
    command_2: float
    command_3: float
    command_4: float


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """As `codrl_mj.actuators.lag.advance`, of commands that are held for `held` steps."""
    newest, since = inputs.desired_torque, state.since
    commands = (newest, state.c1, state.c2, state.c3, state.c4)
    if since == 0.0:
        commands = (newest, state.c0, state.c1, state.c2, state.c3)
    steps = parameters.delay / timestep
    whole = math.floor(steps + 1e-9)
    fraction = steps - whole if steps - whole > 1e-9 else 0.0
    near = min(max(math.ceil((whole - since) / parameters.held - 1e-9), 0), 4)
    far = min(max(math.ceil((whole + 1.0 - since) / parameters.held - 1e-9), 0), 4)
    arrived = parameters.gain * (commands[near] + fraction * (commands[far] - commands[near]))
    decay = (
        math.exp(-timestep / parameters.time_constant) if parameters.time_constant > 0.0 else 0.0
    )
    torque = arrived + (state.torque - arrived) * decay
    later = since + 1.0 if since + 1.5 < parameters.held else 0.0
    one = parameters.largest
    shown = Signals(commands[0] / one, commands[1] / one, commands[2] / one, commands[3] / one)
    return (
        State(torque, later, commands[0], commands[1], commands[2], commands[3], commands[4]),
        torque,
        shown,
    )


def observe(
    parameters: Any,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    signals: Signals,
    inputs: Inputs,  # noqa: ARG001
) -> tuple[float, float, float, float]:
    """The last commands: what a policy could have kept for itself."""
    return signals.command_1, signals.command_2, signals.command_3, signals.command_4


@dataclasses.dataclass(frozen=True)
class Late(ActuatorModel):
    """Strength, lag and delay, with `observe_actuator` showing the last four commands.

    Raises:
        ValueError: a field is out of bounds.
    """

    State: ClassVar[Any] = State
    Signals: ClassVar[type] = Signals
    OBSERVED: ClassVar[tuple[str, ...]] = ("command_1", "command_2", "command_3", "command_4")
    advance: ClassVar = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    time_constant: float = real(0.0, minimum=0.0, unit="s")
    """Time constant [s], >= 0."""
    delay: float = real(0.0, minimum=0.0, unit="s")
    """Delay of the command [s], >= 0, at most `LONGEST` steps of the policy."""
    gain: float = real(1.0, above=0.0)
    """What of the torque is delivered in the end, > 0."""
    held: float = real(10.0, minimum=1.0)
    """Integration steps to a step of the policy, >= 1."""
    largest: float = real(1.0, above=0.0, unit="N*m")
    """The torque [N*m] that a shown command of one stands for, > 0."""

    def check(self, timestep: float) -> None:
        """Refuse a delay longer than what is remembered.

        Raises:
            ValueError: the delay is more than `LONGEST` steps of the policy.
        """
        if self.delay > LONGEST * self.held * timestep * (1 + 1e-9):
            raise ValueError(
                f"Late.delay = {self.delay:g}: must be <= {LONGEST * self.held * timestep:g} s"
            )
