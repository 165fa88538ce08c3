"""The motors in a simulation of somebody else's environment: their commands, disturbances and draws."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command
from codrl_mj.actuators.noise import LARGEST_KEY
from codrl_mj.disturbances import OFF, Disturbances
from codrl_mj.engine.reading import Readout, bring_to_rest, check_shafts, slots
from codrl_mj.foreign.commands import Commands, CommandsWay
from codrl_mj.foreign.draws import Draws, Exchange
from codrl_mj.physics.base import diverged
from codrl_mj.specs import matched_by, names_of

_POSITION = int(mujoco.mjtWarning.mjWARN_BADQPOS)  # followed by those of speeds, accelerations and controls


class Simulated:
    """The motors in one simulation; every face of somebody else's environments has one."""

    def __init__(
        self,
        data: mujoco.MjData,
        actuators: Mapping[str, ActuatorModel],
        commands: Mapping[str, Command | None],
        actions: spaces.Space,
        *,
        randomize: Mapping[str, Any] | None,
        disturbances: Disturbances,
        step_duration: float | None,
        allow_unstable: bool,
    ) -> None:
        """Find the motors.

        Args:
            data: the simulation, of a model that was built with motors.
            actuators: pattern -> what is simulated.
            commands: pattern -> what an action means to its motors; None where it is the environment's own.
            actions: the environment's own action space.
            randomize: as for `codrl_mj.make`.
            disturbances: what happens to commands, once an environment step, and loads on the joints.
            step_duration: of an environment step [s]; None where that is not known.
            allow_unstable: as for `codrl_mj.motorise`.

        Raises:
            ValueError: an argument does not go with the actuators or the environment.
        """
        self._data, self._nominal, self._allow_unstable = data, dict(actuators), allow_unstable
        self.readout = Readout(data.model)
        self.motors = dict(self.readout.motors)
        """Those of the present episode, by the index of the actuator in the model."""
        self._slots = list(slots(data, self.motors).values())
        names = names_of(data.model)
        self._places = {pattern: matched_by(pattern, names) for pattern in actuators}
        meant = {index: one for pattern, one in commands.items() if one for index in self._places[pattern]}
        self._commands = Commands(data.model, actions, meant) if meant else None
        self.action_space = self._commands.action_space if self._commands else actions
        self._way: CommandsWay | None = None
        if disturbances != OFF:
            if step_duration is None:
                raise ValueError("disturbances: the environment has no dt, the duration of its steps [s]; give it one")
            self._way = CommandsWay(data, list(self.motors), actions, disturbances, step_duration)
        self.draws: Draws | None = None
        if randomize is not None:
            fixed = {pattern: command.fixed for pattern, command in commands.items() if command is not None}
            self.draws = Draws(randomize, actuators, fixed, data)
        self.values: np.ndarray | None = None
        """What the present episode was drawn with."""
        self._exchange = Exchange(data, self.motors, self._places)

    def draw(self, generator: np.random.Generator) -> None:
        """Draw motors and model of the next episode; to be followed by a reset.

        Raises:
            ValueError: what is drawn is refused again and again.
        """
        if self.draws is not None:
            self.values = self.draws.draw(generator, self._put)

    def restore(self, values: np.ndarray) -> None:
        """Bring back the motors and the model of a draw, or the nominal ones for values that are NaN."""
        if self.draws is not None:
            self.values = None if np.isnan(values).any() else values
            self._put(self.values)

    def _put(self, values: np.ndarray | None) -> None:
        """Give the model what was drawn.

        Raises:
            ValueError: it is not stable there.
        """
        assert self.draws is not None
        actuators = self._nominal if values is None else self.draws.actuators(values)
        self.motors |= {index: one for pattern, one in actuators.items() for index in self._places[pattern]}
        self._exchange.put(actuators)
        self.draws.put_fields(values)
        for actuator in actuators.values():
            actuator.check_at(self._data.model.opt.timestep, self._allow_unstable)
        check_shafts(self._data.model, self._allow_unstable, actuators=self.motors)

    def begin(self, generator: np.random.Generator) -> None:
        """Bring all to rest after a reset: motors, with keys of their own for noise, and commands on their way."""
        self._data.warning.number[:] = 0  # not all environments reset all data
        for slot, motor in zip(self._slots, self.motors.values(), strict=True):
            key = np.floor(generator.random() * LARGEST_KEY) if motor.random else 0.0
            bring_to_rest(slot, self._data.time, key)
        if self._way is not None:
            self._way.begin(generator)

    def controls(self, action: Any) -> Any:
        """The environment's own action for one of `action_space`, as it arrives.

        Raises:
            ValueError: the action has not the shape of the action space.
        """
        if self._commands is not None:
            action = self._commands.controls(action)
        return action if self._way is None else self._way.controls(action)

    def check_finite(self, who: str, time: float) -> None:
        """Raise if the engine met what is no number, or too large a one; it starts anew then, and the episode goes on.

        Args:
            who: the environment.
            time: before the step [s].

        Raises:
            SimulationDivergedError: as it says.
        """
        counts, model = self._data.warning.number, self._data.model
        if not counts[_POSITION:].any():  # since the reset
            return
        kind = _POSITION + int(np.argmax(counts[_POSITION:]))
        place = int(self._data.warning.lastinfo[kind])
        if kind == mujoco.mjtWarning.mjWARN_BADCTRL:
            what = f"control {place}"
        else:
            joint = (
                np.searchsorted(model.jnt_qposadr, place, "right") - 1 if kind == _POSITION else model.dof_jntid[place]
            )
            of = {_POSITION: "position", _POSITION + 1: "speed"}.get(kind, "acceleration")
            what = f"the {of} of {model.joint(joint).name or f'joint {joint}'}"
        raise diverged(who, time, f"{what} is no number, or too large", f"the model's {model.opt.timestep:g} s")

    @property
    def report(self) -> dict[str, Any]:
        """What the reset's info says of the draw; empty if nothing was drawn."""
        return {} if self.draws is None or self.values is None else self.draws.report(self.values)

    @property
    def memory(self) -> dict[str, np.ndarray]:
        """What it remembers besides the simulation's state, live or as it was drawn: commands on their way, draws."""
        found = {} if self._way is None else {"disturbances": self._way.memory}
        if self.draws is not None:
            found["drawn"] = np.full(self.draws.size, np.nan) if self.values is None else self.values
        return found
