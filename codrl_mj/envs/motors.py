"""The motors in one simulation of anybody's model: what is asked of them, what is drawn, and what is seen of them."""

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command, Family, Inputs, parameters_type
from codrl_mj.actuators.noise import LARGEST_KEY
from codrl_mj.disturbances import Disturbances
from codrl_mj.engine.families import signals_at
from codrl_mj.engine.plugin import PLUGIN_HEAD
from codrl_mj.engine.reading import Readout, bring_to_rest, slots
from codrl_mj.envs.commands import ControlCommands, fixed_by
from codrl_mj.envs.distributions import paths_of
from codrl_mj.envs.randomization import Draws, Randomization, put_into
from codrl_mj.envs.views import sensor_names
from codrl_mj.physics.base import diverged, named_signals
from codrl_mj.physics.variation import without_motors, write_fields
from codrl_mj.specs import matched_by, names_of

_POSITION = int(mujoco.mjtWarning.mjWARN_BADQPOS)  # followed by those of speeds, accelerations and controls


class Motors:
    """The motors in one simulation, of a model that was built with them; every face of others' environments has one."""

    def __init__(
        self,
        data: mujoco.MjData,
        commands: Mapping[str, Command],
        action: str,
        actions: spaces.Space,
        *,
        randomize: Any,
        disturbances: Disturbances,
        step_duration: float | None,
        allow_unstable: bool,
    ) -> None:
        """Find the motors of a simulation.

        `commands` say what an action of a name, `action`, means to the motors of a pattern, `actions` are the
        environment's own. An environment step takes `step_duration` [s], if that is known. What else is given is as for
        `codrl_mj.make`.
        """
        self.data, model = data, data.model
        self.readout = Readout(model)
        self.present = dict(self.readout.motors)
        """Those of the present episode, by the index of the actuator in the model."""
        names = names_of(model)
        meant = {index: one for pattern, one in commands.items() for index in matched_by(pattern, names)}
        nominal = {index: meant[index].actuator if index in meant else one for index, one in self.present.items()}
        self._slots = list(slots(data, self.present).values())
        asked = {index: meant.get(index) if action != "force" else None for index in self.present}
        self._commands = ControlCommands(data, actions, asked, disturbances, step_duration)
        self.action_space = self._commands.action_space
        self.controls = self._commands.controls
        """(one of `action_space`) -> the environment's own action, as it arrives."""
        fixed = [fixed_by(meant[index], action) if index in meant else {} for index in nominal]
        bare, timestep = without_motors(model, nominal) if randomize else model, model.opt.timestep
        randomization = Randomization.build(
            paths_of(randomize), bare, nominal, fixed, timestep, allow_unstable, "the model"
        )
        self.draws = Draws(randomization, [list(nominal.values())], functools.partial(put_into, self))
        self._random = disturbances.random or randomization.random or any(one.random for one in nominal.values())
        self.names = motor_names(model, self.present)
        """What the motors are called."""
        self.families = {name: _family(one) for name, one in zip(self.names, self.present.values(), strict=True)}
        """Theirs, by name."""
        self.sensors = sensor_names(self.families)
        """Names of what `seen` returns."""
        self._parameters = list(map(_parameters, self.present.values()))

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Exchange the motors for others of their families; to be followed by a reset."""
        for index, one in zip(self.present, actuators, strict=True):
            numbers = (one.arm_radius, *one.numbers)
            self.data.model.actuator_user[index, PLUGIN_HEAD - 1 : PLUGIN_HEAD - 1 + len(numbers)] = numbers
            self.present[index] = one
        self._parameters = list(map(_parameters, actuators))

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model, as `Variation.fields` returns them for one simulation, before a reset."""
        write_fields(self.data.model, fields)
        mujoco.mj_setConst(self.data.model, self.data)

    def draw(self, generator: np.random.Generator) -> None:
        """Draw motors and model of the next episode; to be followed by a reset."""
        self.draws.draw(lambda rows, count: generator.random((len(rows), count)), np.zeros(1, dtype=int))

    def begin(self, generator: np.random.Generator) -> None:
        """Bring all to rest after a reset: motors, with keys of their own for noise, and commands on their way."""
        self.data.warning.number[:] = 0  # not all environments reset all data
        key = generator.random() * LARGEST_KEY if self._random else 0.0  # a whole number, exactly
        for at, (slot, motor) in enumerate(zip(self._slots, self.present.values(), strict=True)):
            bring_to_rest(slot, self.data.time, key + at if motor.random else 0.0)
        self._commands.begin(key)

    def signals(self) -> dict[str, Any]:
        """The motors' signals after the last step, as `info` has them, units as `Readout` has them."""
        table, alone = self.readout.table(self.data), len(self.present) == 1
        return named_signals(self.readout.names, table[:, 0].tolist() if alone else table)

    def seen(self) -> np.ndarray:
        """What the sensors say now, shape (k,), float64, entries as in `sensors`."""
        values: list[float] = []
        for motor, parameters, slot in zip(self.present.values(), self._parameters, self._slots, strict=True):
            if motor.OBSERVED:
                start, count = signals_at(_family(motor)), len(_family(motor).Signals._fields)
                signals = _family(motor).Signals(*slot[start : start + count].tolist())
                inputs = Inputs(0.0, 0.0, 0.0, self.data.time, float(slot[1]))
                values += motor.observe(parameters, self.data.model.opt.timestep, signals, inputs)
        return np.array(values)

    def check_finite(self, who: str, time: float) -> None:
        """Raise if the engine met what is no number, or too large a one; it would start anew and go on."""
        counts, model = self.data.warning.number, self.data.model
        if not np.count_nonzero(counts[_POSITION:]):  # since the reset; any() takes six times as long
            return
        kind = _POSITION + int(np.argmax(counts[_POSITION:]))
        place = int(self.data.warning.lastinfo[kind])
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
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with, as `info` says; empty if nothing was."""
        return self.draws.report()

    def snapshot(self) -> dict[str, np.ndarray]:
        """What it remembers besides the simulation's state: commands on their way, and draws."""
        found = {name: memory.copy() for name, memory in self._commands.memory.items()}
        return found | self.draws.snapshot()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Bring that back, motors and model too; to be followed by a restoring of the simulation."""
        self.draws.restore(snapshot)
        for name, memory in self._commands.memory.items():
            memory[:] = snapshot[name]


def motor_names(model: mujoco.MjModel, motors: Iterable[int]) -> tuple[str, ...]:
    """What motors are called: as their actuators, or else as what these drive; or else by their indices."""
    every = [own[0] if own else "" for own in names_of(model)]
    return tuple(every[index] if every.count(every[index]) == 1 and every[index] else str(index) for index in motors)


def _family(motor: ActuatorModel) -> Family:
    return type(motor)


def _parameters(motor: ActuatorModel) -> Any:
    return parameters_type(_family(motor))(*motor.numbers)
