"""The custom gearbox of docs/actuators.md, in a file, because the reader needs a source."""

import dataclasses
from typing import ClassVar, NamedTuple

from codrl_mj.actuators import ActuatorModel
from codrl_mj.fields import real


class State(NamedTuple):
    play: float


class Signals(NamedTuple):
    play: float
    saturated: float


def advance(parameters, timestep, state, inputs):
    """Move the teeth across the gap in `crossing_time`; transmit torque only while they touch."""
    side = 1.0 if inputs.desired_torque > 0.0 else -1.0
    play = min(max(state.play + side * 2.0 * timestep / parameters.crossing_time, -1.0), 1.0)
    touching = play == side
    torque = parameters.efficiency * inputs.desired_torque if touching else 0.0
    return State(play), torque, Signals(play, 0.0 if touching else 1.0)


@dataclasses.dataclass(frozen=True)
class Gearbox(ActuatorModel):
    """A gearbox with backlash."""

    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    advance: ClassVar = staticmethod(advance)

    crossing_time: float = real(0.1, above=0.0, unit="s")
    """Time that the teeth take to cross the gap [s]."""
    efficiency: float = real(0.8, above=0.0, maximum=1.0)
    """Share of the torque that is transmitted."""
