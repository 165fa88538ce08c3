"""Custom actuator of the study: a lag that stores and can show commands of four policy steps.

The package's `Lag` stores eight integration steps, which is less than the delays of the study.
Otherwise both do the same, and a test compares them.
"""

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple

from codrl_mj.actuators import ActuatorModel, Inputs
from codrl_mj.fields import real

LONGEST = 4
"""Maximum delay, and number of shown commands, in steps of the policy."""


class State(NamedTuple):
    """Torque [N*m], integration steps since the last command, and commands, newest first."""

    torque: float
    since: float
    c0: float
    c1: float
    c2: float
    c3: float
    c4: float


class Signals(NamedTuple):
    """The last commands, newest first, as shares of the largest."""

    command_1: float
    command_2: float
    command_3: float
    command_4: float


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Do the same as `codrl_mj.actuators.lag.advance`, with commands that last `held` steps."""
    newest, since = inputs.desired_torque, state.since
    commands = (newest, state.c1, state.c2, state.c3, state.c4)
    if since == 0.0:
        commands = (newest, state.c0, state.c1, state.c2, state.c3)
    steps = parameters.delay / timestep
    # 1e-9 absorbs the rounding of delay / timestep.
    whole = math.floor(steps + 1e-9)
    fraction = steps - whole if steps - whole > 1e-9 else 0.0
    near = min(max(math.ceil((whole - since) / parameters.held - 1e-9), 0), 4)
    far = min(max(math.ceil((whole + 1.0 - since) / parameters.held - 1e-9), 0), 4)
    arrived = parameters.gain * (commands[near] + fraction * (commands[far] - commands[near]))
    decay = (
        math.exp(-timestep / parameters.time_constant) if parameters.time_constant > 0.0 else 0.0
    )
    torque = arrived + (state.torque - arrived) * decay
    # The state stores floats, so the counter is compared halfway between two steps.
    later = since + 1.0 if since + 1.5 < parameters.held else 0.0
    largest = parameters.largest
    shown = Signals(
        commands[0] / largest, commands[1] / largest, commands[2] / largest, commands[3] / largest
    )
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
    """Return the last commands, which a policy could also have stored itself."""
    return signals.command_1, signals.command_2, signals.command_3, signals.command_4


@dataclasses.dataclass(frozen=True)
class Late(ActuatorModel):
    """Gain, lag and delay, whose last four commands are shown with `observe_actuator`.

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
    """Share of the desired torque that is delivered in steady state, > 0."""
    held: float = real(10.0, minimum=1.0)
    """Number of integration steps per policy step, >= 1."""
    largest: float = real(1.0, above=0.0, unit="N*m")
    """Torque [N*m] at which a shown command is 1, > 0."""

    def check(self, timestep: float) -> None:
        """Raise an error if the delay is longer than the stored commands.

        Raises:
            ValueError: the delay is more than `LONGEST` steps of the policy.
        """
        if self.delay > LONGEST * self.held * timestep * (1 + 1e-9):
            raise ValueError(
                f"Late.delay = {self.delay:g}: must be <= {LONGEST * self.held * timestep:g} s"
            )
