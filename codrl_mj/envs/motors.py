"""Motors in a simulation of any model: their commands, randomization and signals."""

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Family, Inputs, parameters_type
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.engine.families import USER_HEADER_SIZE, signals_offset
from codrl_mj.engine.reading import Readout, actuators_sharing_motor, bring_to_rest, motor_slots
from codrl_mj.engine.specs import match_pattern, matchable_names
from codrl_mj.envs.commands import ControlCommands, commands_by_pattern
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.randomization import (
    Randomization,
    RandomizationState,
    apply_to_simulation,
    check_extremes,
)
from codrl_mj.physics.base import divergence_error, make_info_reader
from codrl_mj.physics.variation import without_additions, write_fields

# In MuJoCo's list of warnings, BADQPOS, BADQVEL, BADQACC and BADCTRL are neighbors in this order.
_POSITION = int(mujoco.mjtWarning.mjWARN_BADQPOS)


class ActuatorBank:
    """The motors of one simulation, whose model was built with `codrl_mj.add_motors`."""

    def __init__(
        self,
        data: mujoco.MjData,
        config: EnvConfig,
        actions: spaces.Space,
        step_duration: float | None,
    ) -> None:
        """Find the motors of a simulation.

        Args:
            data: the simulation.
            config: settings of its motors.
            actions: action space of the environment without motors.
            step_duration: duration of an environment step [s]; None if unknown.
        """
        self.data, model = data, data.model
        self.readout = Readout(model)
        self.motors = dict(self.readout.motors)
        """Actuator index in the model -> motor of the present episode."""
        names, is_force_command = matchable_names(model), config.action == "force"
        commands_by_index = {
            index: command
            for pattern, command in commands_by_pattern(config).items()
            for index in match_pattern(pattern, names)
        }
        nominal = {
            index: commands_by_index[index].actuator if index in commands_by_index else actuator
            for index, actuator in self.motors.items()
        }
        self._slots = list(motor_slots(data, self.motors).values())
        # A live view: MuJoCo counts its warnings in it.
        self._warnings = data.warning.number[_POSITION:]
        motor_commands = {
            index: None if is_force_command else commands_by_index.get(index)
            for index in self.motors
        }
        self._commands = ControlCommands(
            data, actions, motor_commands, config.disturbances, step_duration
        )
        self.action_space = self._commands.action_space
        self.controls = self._commands.controls
        """(element of `action_space`) -> action of the original environment, after disturbances."""
        fixed = [
            commands_by_index[index].fixed if index in commands_by_index else {}
            for index in nominal
        ]
        distributions, timestep = config.distributions, model.opt.timestep
        bare_model = without_additions(model, nominal) if distributions else model
        randomization = Randomization(
            distributions,
            bare_model,
            nominal,
            fixed,
            timestep,
            config.allow_unstable,
            "the model",
        )
        if not config.allow_unstable:
            check_extremes(randomization, nominal, model)
        self.randomization_state = RandomizationState(
            randomization, [list(nominal.values())], functools.partial(apply_to_simulation, self)
        )
        draws_numbers = config.disturbances.random or randomization.may_need_key
        self._needs_key = draws_numbers or any(actuator.random for actuator in nominal.values())
        self.names = motor_names(model, self.motors)
        """Names of the motors, in the model's order."""
        families: list[Family] = list(map(type, self.motors.values()))
        self.sensors = (
            sensor_names(dict(zip(self.names, families, strict=True)))
            if config.observe_actuator
            else ()
        )
        """Names of the entries of `sensor_values`; empty if they are not observed."""
        self._parameters = list(map(_parameters, self.motors.values()))

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the motors by others of the same families; a reset must follow."""
        for index, actuator in zip(self.motors, actuators, strict=True):
            values = (actuator.arm_radius, *actuator.parameter_values)
            self.data.model.actuator_user[
                index, USER_HEADER_SIZE : USER_HEADER_SIZE + len(values)
            ] = values
            self.motors[index] = actuator
        self._parameters = list(map(_parameters, actuators))

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Write model fields, as `Variation.fields` returns them; a reset must follow."""
        write_fields(self.data.model, fields)
        mujoco.mj_setConst(self.data.model, self.data)

    def begin(self, generator: np.random.Generator) -> None:
        """Bring motors and delayed commands to rest after a reset; draw new keys for noise."""
        # Not every environment clears the warnings at a reset.
        self.data.warning.number[:] = 0
        # The product is exactly an integer: numpy draws multiples of 2**-53, and the largest key
        # is 2**53.
        key = generator.random() * MAX_KEY if self._needs_key else 0.0
        for motor_index, (slot, motor) in enumerate(
            zip(self._slots, self.motors.values(), strict=True)
        ):
            bring_to_rest(slot, self.data.time, key + motor_index if motor.random else 0.0)
        self._commands.begin(key)

    def signals(self) -> dict[str, Any]:
        """Return the motors' signals after the last step, as in `info`; units as in `Readout`."""
        table, is_single = self.readout.table(self.data), len(self.motors) == 1
        return make_info_reader(self.readout.names)(table[:, 0].tolist() if is_single else table)

    def sensor_values(self) -> np.ndarray:
        """Return the present values of `sensors`, shape (k,), float64."""
        values: list[float] = []
        for motor, parameters, slot in zip(
            self.motors.values(), self._parameters, self._slots, strict=True
        ):
            if motor.OBSERVED:
                family: Family = type(motor)
                start, count = signals_offset(family), len(family.Signals._fields)
                signals = family.Signals(*slot[start : start + count].tolist())
                inputs = Inputs(0.0, 0.0, 0.0, self.data.time, float(slot[1]))
                values += motor.observe(parameters, self.data.model.opt.timestep, signals, inputs)
        return np.array(values)

    def check_finite(self, name: str, time: float) -> None:
        """Raise if MuJoCo has warned since the reset that a value is not finite, or too large.

        MuJoCo itself would reset the simulation and continue.
        """
        # `any()` takes six times as long on such a short array.
        if not np.count_nonzero(self._warnings):
            return
        kind, model = _POSITION + int(np.argmax(self._warnings)), self.data.model
        index = int(self.data.warning.lastinfo[kind])
        if kind == mujoco.mjtWarning.mjWARN_BADCTRL:
            subject = f"control {index}"
        else:
            joint = (
                np.searchsorted(model.jnt_qposadr, index, "right") - 1
                if kind == _POSITION
                else model.dof_jntid[index]
            )
            quantity = {_POSITION: "position", _POSITION + 1: "speed"}.get(kind, "acceleration")
            subject = f"the {quantity} of {model.joint(joint).name or f'joint {joint}'}"
        raise divergence_error(
            name,
            time,
            f"{subject} is not finite, or too large",
            f"the model's {model.opt.timestep:g} s",
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state that `MjData` does not hold: delayed commands and drawn values."""
        delayed_commands = {name: memory.copy() for name, memory in self._commands.memory.items()}
        return delayed_commands | self.randomization_state.snapshot()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Restore commands, motors and model; the simulation must be restored afterwards."""
        self.randomization_state.restore(snapshot)
        for name, memory in self._commands.memory.items():
            memory[:] = snapshot[name]


def motor_names(model: mujoco.MjModel, motors: Iterable[int]) -> tuple[str, ...]:
    """Return the motors' names: of the actuator, or else its target; its index if not unique."""
    actuator_names = [names[0] if names else "" for names in matchable_names(model)]
    unique_names = [
        name if name and actuator_names.count(name) == 1 else str(index)
        for index, name in enumerate(actuator_names)
    ]
    return tuple(
        " & ".join(unique_names[actuator] for actuator in actuators_sharing_motor(model, index))
        for index in motors
    )


def sensor_names(motors: Mapping[str, Family]) -> tuple[str, ...]:
    """Return the names of the motors' sensors, with the motor's name in front if it has one.

    Raises:
        ValueError: the motors have no sensors.
    """
    sensors = tuple(
        f"{motor}.{name}" if motor else name
        for motor, family in motors.items()
        for name in family.OBSERVED
    )
    if not sensors:
        kinds = ", ".join(sorted({family.family or family.__name__ for family in motors.values()}))
        raise ValueError(
            f"observe_actuator=True: the {kinds} actuator has no current and no other signal to"
            " observe; choose another actuator"
        )
    return sensors


def extend_space(space: spaces.Space, count: int) -> spaces.Box:
    """Return a vector observation space with `count` additional unbounded entries."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"observe_actuator=True: observations are {space}: must be vectors")
    low, high = (
        np.append(bound, np.full(count, value))
        for bound, value in ((space.low, -np.inf), (space.high, np.inf))
    )
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)


def _parameters(motor: ActuatorModel) -> Any:
    """Return a motor's parameters as the family's named tuple."""
    family: Family = type(motor)
    return parameters_type(family)(*motor.parameter_values)
