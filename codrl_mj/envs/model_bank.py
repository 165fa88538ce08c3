"""The actuators of one simulation of any model, which the plugin drives."""

import functools
from collections.abc import Iterable, Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, Inputs, parameters_type
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.boundary import Info
from codrl_mj.engine.families import USER_HEADER_SIZE, signals_offset
from codrl_mj.engine.matching import match_pattern, matchable_names
from codrl_mj.engine.reading import Readout, actuators_sharing_motor, bring_to_rest, motor_slots
from codrl_mj.envs.bank import ActuatorBank, needs_key, sensor_names
from codrl_mj.envs.commands import ControlCommands, commands_by_pattern
from codrl_mj.envs.config import EnvConfig, Space
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


class ModelBank(ActuatorBank):
    """The motors of one simulation, whose model was built with `codrl_mj.add_motors`."""

    def __init__(
        self,
        data: mujoco.MjData,
        config: EnvConfig,
        actions: Space,
        step_duration: float | None,
    ) -> None:
        """Find the motors of a simulation.

        Args:
            data: the simulation.
            config: settings of its motors.
            actions: action space of the environment without motors.
            step_duration: duration of an environment step [s]; None if unknown.
        """
        self.data: mujoco.MjData = data
        self._config, model = config, data.model
        self.readout = Readout(model)
        self._motors = dict(self.readout.motors)
        self._slots = list(motor_slots(data, self._motors).values())
        # A live view: MuJoCo counts its warnings in it.
        self._warnings = data.warning.number[_POSITION:]
        names = matchable_names(model)
        commands_by_index = {
            index: command
            for pattern, command in commands_by_pattern(config).items()
            for index in match_pattern(pattern, names)
        }
        is_force_command = config.action == "force"
        self._commands = ControlCommands(
            data,
            actions,
            {
                index: None if is_force_command else commands_by_index.get(index)
                for index in self._motors
            },
            config.disturbances,
            step_duration,
        )
        self.controls = self._commands.controls
        """(element of `action_space`) -> action of the original environment, after disturbances."""
        nominal = {
            index: commands_by_index[index].actuator if index in commands_by_index else actuator
            for index, actuator in self._motors.items()
        }
        fixed = [
            commands_by_index[index].fixed if index in commands_by_index else {}
            for index in nominal
        ]
        randomization = self._randomization(nominal, fixed)
        names_of_motors = motor_names(model, self._motors)
        families: list[Family] = list(map(type, self._motors.values()))
        super().__init__(
            names_of_motors,
            sensor_names(dict(zip(names_of_motors, families, strict=True)))
            if config.observe_actuator
            else (),
            self._commands.action_space,
            RandomizationState(
                randomization,
                [list(nominal.values())],
                functools.partial(apply_to_simulation, self),
            ),
            needs_key(nominal.values(), config.disturbances, randomization),
        )
        self._parameters = list(map(_parameters, self._motors.values()))

    def _randomization(
        self, nominal: Mapping[int, ActuatorModel], fixed: Sequence[Mapping[str, str]]
    ) -> Randomization:
        """Return the distributions of the fields of motors and model, checked."""
        config, model = self._config, self.data.model
        bare_model = without_additions(model, nominal) if config.distributions else model
        randomization = Randomization(
            config.distributions,
            bare_model,
            nominal,
            fixed,
            model.opt.timestep,
            config.allow_unstable,
            "the model",
        )
        if not config.allow_unstable:
            check_extremes(randomization, nominal, model)
        return randomization

    @property
    def motors(self) -> Mapping[int, ActuatorModel]:
        """Index of an actuator in the model -> motor of the present episode."""
        return self._motors

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the motors' signals in `info`."""
        return tuple(self.signals())

    @property
    def memory(self) -> np.ndarray:
        """Delayed commands and scheduled pulses, a live array with a row for each motor."""
        return self._commands.memory

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the motors by others of the same families; a reset must follow."""
        for index, actuator in zip(self._motors, actuators, strict=True):
            values = (actuator.arm_radius, *actuator.parameter_values)
            self.data.model.actuator_user[
                index, USER_HEADER_SIZE : USER_HEADER_SIZE + len(values)
            ] = values
            self._motors[index] = actuator
        self._parameters = list(map(_parameters, actuators))

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Write model fields, as `Variation.fields` returns them; a reset must follow."""
        write_fields(self.data.model, fields)
        mujoco.mj_setConst(self.data.model, self.data)

    def begin(self, generator: np.random.Generator) -> None:
        """Bring motors and delayed commands to rest after a reset; draw new keys for noise."""
        # Not every environment clears the warnings at a reset.
        self.data.warning.number[:] = 0
        key = self.key(generator)
        for motor_index, (slot, motor) in enumerate(
            zip(self._slots, self._motors.values(), strict=True)
        ):
            bring_to_rest(slot, self.data.time, key + motor_index if motor.random else 0.0)
        self._commands.begin(key)

    def signals(self) -> Info:
        """Return the motors' signals after the last step, as in `info`; units as in `Readout`."""
        table, is_single = self.readout.table(self.data), len(self._motors) == 1
        return make_info_reader(self.readout.names)(table[:, 0].tolist() if is_single else table)

    def sensor_values(self) -> np.ndarray:
        """Return the present values of `sensors`, shape (k,), float64."""
        values: list[float] = []
        for motor, parameters, slot in zip(
            self._motors.values(), self._parameters, self._slots, strict=True
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


def _parameters(motor: ActuatorModel) -> Parameters:
    """Return a motor's parameters as the family's named tuple."""
    family: Family = type(motor)
    return parameters_type(family)(*motor.parameter_values)
