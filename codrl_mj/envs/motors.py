"""The motors in one simulation of anybody's model: what is asked of them, what is drawn, and what is seen of them."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command, Family, Inputs, parameters_type
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.disturbances import NO_DISTURBANCES, Disturbances
from codrl_mj.engine.families import HEAD, signals_at
from codrl_mj.engine.reading import Readout, bring_to_rest, sharing, slots
from codrl_mj.engine.specs import matched_by, names_of
from codrl_mj.envs.commands import ControlCommands, command_of
from codrl_mj.envs.distributions import paths_of
from codrl_mj.envs.randomization import (
    Randomization,
    RandomizationState,
    apply_to_simulation,
    check_extremes,
)
from codrl_mj.physics.base import divergence_error, make_info_reader
from codrl_mj.physics.variation import without_motors, write_fields

_POSITION = int(
    mujoco.mjtWarning.mjWARN_BADQPOS
)  # followed by those of speeds, accelerations and controls


@dataclasses.dataclass(frozen=True)
class MotorSettings:
    """What motors an environment of others has, as `codrl_mj.make` takes it."""

    actuators: Mapping[str, ActuatorModel]
    """Pattern -> actuator."""
    action: str = "force"
    """What actions stand for."""
    observe_actuator: bool = False
    """Whether observations end with what the motors' sensors say."""
    randomize: Any = None
    """What is drawn at every reset."""
    disturbances: Disturbances = NO_DISTURBANCES
    """Of commands, and load pulses."""
    allow_unstable: bool = False
    """As for `codrl_mj.add_motors`."""
    joint_dynamics: str | None = None
    """Likewise."""

    @functools.cached_property
    def commands(self) -> dict[str, Command]:
        """Pattern -> what an action means to its motors."""
        return {
            pattern: command_of(one, self.action, pattern)
            for pattern, one in self.actuators.items()
        }

    @property
    def simulated(self) -> dict[str, ActuatorModel]:
        """Pattern -> what a command leaves of its actuator."""
        return {pattern: command.actuator for pattern, command in self.commands.items()}


class ActuatorBank:
    """The motors in one simulation, of a model that was built with them; every face of others' environments has one."""

    def __init__(
        self,
        data: mujoco.MjData,
        settings: MotorSettings,
        actions: spaces.Space,
        step_duration: float | None,
    ) -> None:
        """Find the motors of a simulation, of an environment with these `actions` of its own, and steps so long [s]."""
        self.data, model = data, data.model
        self.readout = Readout(model)
        self.present = dict(self.readout.motors)
        """Those of the present episode, by the index of the actuator in the model."""
        names, forced = names_of(model), settings.action == "force"
        meant = {
            index: one
            for pattern, one in settings.commands.items()
            for index in matched_by(pattern, names)
        }
        nominal = {
            index: meant[index].actuator if index in meant else one
            for index, one in self.present.items()
        }
        self._slots = list(slots(data, self.present).values())
        self._warnings = data.warning.number[_POSITION:]  # live
        asked = {index: None if forced else meant.get(index) for index in self.present}
        self._commands = ControlCommands(data, actions, asked, settings.disturbances, step_duration)
        self.action_space = self._commands.action_space
        self.controls = self._commands.controls
        """(one of `action_space`) -> the environment's own action, as it arrives."""
        fixed = [meant[index].fixed if index in meant else {} for index in nominal]
        distributions, timestep = paths_of(settings.randomize), model.opt.timestep
        bare = without_motors(model, nominal) if distributions else model
        randomization = Randomization(
            distributions, bare, nominal, fixed, timestep, settings.allow_unstable, "the model"
        )
        if not settings.allow_unstable:
            check_extremes(randomization, nominal, model)
        self.draws = RandomizationState(
            randomization, [list(nominal.values())], functools.partial(apply_to_simulation, self)
        )
        drawn = settings.disturbances.random or randomization.random
        self._random = drawn or any(one.random for one in nominal.values())
        self.names = motor_names(model, self.present)
        """What the motors are called."""
        families: list[Family] = list(map(type, self.present.values()))
        self.sensors = (
            sensor_names(dict(zip(self.names, families, strict=True)))
            if settings.observe_actuator
            else ()
        )
        """Names of what `seen` returns, which an observation ends with."""
        self._parameters = list(map(_parameters, self.present.values()))

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Exchange the motors for others of their families; to be followed by a reset."""
        for index, one in zip(self.present, actuators, strict=True):
            numbers = (one.arm_radius, *one.parameter_values)
            self.data.model.actuator_user[index, HEAD : HEAD + len(numbers)] = numbers
            self.present[index] = one
        self._parameters = list(map(_parameters, actuators))

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model, as `Variation.fields` returns them for one simulation, before a reset."""
        write_fields(self.data.model, fields)
        mujoco.mj_setConst(self.data.model, self.data)

    def begin(self, generator: np.random.Generator) -> None:
        """Bring all to rest after a reset: motors, with keys of their own for noise, and commands on their way."""
        self.data.warning.number[:] = 0  # not all environments reset all data
        key = generator.random() * MAX_KEY if self._random else 0.0  # a whole number, exactly
        for at, (slot, motor) in enumerate(zip(self._slots, self.present.values(), strict=True)):
            bring_to_rest(slot, self.data.time, key + at if motor.random else 0.0)
        self._commands.begin(key)

    def signals(self) -> dict[str, Any]:
        """The motors' signals after the last step, as `info` has them, units as `Readout` has them."""
        table, alone = self.readout.table(self.data), len(self.present) == 1
        return make_info_reader(self.readout.names)(table[:, 0].tolist() if alone else table)

    def seen(self) -> np.ndarray:
        """What the sensors say now, shape (k,), float64, entries as in `sensors`."""
        values: list[float] = []
        for motor, parameters, slot in zip(
            self.present.values(), self._parameters, self._slots, strict=True
        ):
            if motor.OBSERVED:
                family: Family = type(motor)
                start, count = signals_at(family), len(family.Signals._fields)
                signals = family.Signals(*slot[start : start + count].tolist())
                inputs = Inputs(0.0, 0.0, 0.0, self.data.time, float(slot[1]))
                values += motor.observe(parameters, self.data.model.opt.timestep, signals, inputs)
        return np.array(values)

    def check_finite(self, who: str, time: float) -> None:
        """Raise if the engine met what is no number, or too large a one; it would start anew and go on."""
        if not np.count_nonzero(self._warnings):  # since the reset; any() takes six times as long
            return
        kind, model = _POSITION + int(np.argmax(self._warnings)), self.data.model
        place = int(self.data.warning.lastinfo[kind])
        if kind == mujoco.mjtWarning.mjWARN_BADCTRL:
            what = f"control {place}"
        else:
            joint = (
                np.searchsorted(model.jnt_qposadr, place, "right") - 1
                if kind == _POSITION
                else model.dof_jntid[place]
            )
            of = {_POSITION: "position", _POSITION + 1: "speed"}.get(kind, "acceleration")
            what = f"the {of} of {model.joint(joint).name or f'joint {joint}'}"
        raise divergence_error(
            who, time, f"{what} is no number, or too large", f"the model's {model.opt.timestep:g} s"
        )

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
    own = [
        name if name and every.count(name) == 1 else str(index) for index, name in enumerate(every)
    ]
    return tuple(" & ".join(own[each] for each in sharing(model, index)) for index in motors)


def sensor_names(motors: Mapping[str, Family]) -> tuple[str, ...]:
    """Names of what the sensors of motors, by theirs, say; a motor without a name needs none. Refused if nothing."""
    sensors = tuple(
        f"{motor}.{name}" if motor else name
        for motor, one in motors.items()
        for name in one.OBSERVED
    )
    if not sensors:
        kinds = ", ".join(sorted({one.family or one.__name__ for one in motors.values()}))
        raise ValueError(
            f"observe_actuator=True: the {kinds} actuator has no current to observe, and nothing"
            " else; choose another"
        )
    return sensors


def longer(space: spaces.Space, count: int) -> spaces.Box:
    """An observation space, which must be of vectors, with some unbounded entries more."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"observe_actuator=True: observations are {space}, and only to vectors can be appended"
        )
    low, high = (
        np.append(bound, np.full(count, value))
        for bound, value in ((space.low, -np.inf), (space.high, np.inf))
    )
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)


def _parameters(motor: ActuatorModel) -> Any:
    family: Family = type(motor)
    return parameters_type(family)(*motor.parameter_values)
