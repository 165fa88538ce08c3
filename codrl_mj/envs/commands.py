"""Commands: conversion from agents' actions to forces, currents, voltages and motions of motors."""

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command, Drive, Ideal, Servo
from codrl_mj.boundary import Action
from codrl_mj.disturbances import NO_DISTURBANCES, Disturbances, check_delay
from codrl_mj.engine.matching import ON_JOINT
from codrl_mj.engine.reading import actuators_sharing_motor
from codrl_mj.engine.reading import motors as motors_of
from codrl_mj.envs.config import EnvConfig, Space
from codrl_mj.physics.base import Force
from codrl_mj.physics.disturber import Disturber
from codrl_mj.tasks import Task

POSITIONS = ("rad", "m")
"""Units of commands that are positions."""


def command_of(actuator: ActuatorModel, name: str, pattern: str = "") -> Command:
    """Return an actuator's `Command` of this name; `pattern` names its motors in messages."""
    if name == "force":
        return Command("N or N*m", actuator, actuator.arm_radius, None, {})
    known = actuator.commands()
    if name not in known:
        kind = (
            f"{actuator.family or type(actuator).__name__} actuator{pattern and f' of {pattern!r}'}"
        )
        if isinstance(actuator, Ideal) and name in ("current", "voltage"):
            raise ValueError(
                f"action = {name!r}: the {kind} has no {name} to command; choose another actuator"
            )
        names = ", ".join(["force", *known])
        remedy = _servo_remedy(actuator, name) or "or choose another actuator"
        raise ValueError(
            f"action = {name!r}: must be one of {names}, which the {kind} takes; {remedy}"
        )
    command = known[name]
    return command._replace(
        fixed={field: f"with action={name!r} {reason}" for field, reason in command.fixed.items()}
    )


def commands_by_pattern(config: EnvConfig) -> dict[str, Command]:
    """Return motor, or pattern of motors, -> command that an action represents for it."""
    return {
        pattern: command_of(actuator, config.action, pattern)
        for pattern, actuator in config.actuators_by_name.items()
    }


def _servo_remedy(actuator: ActuatorModel, name: str) -> str:
    """Return a remedy if a drive does not take a position or velocity command; otherwise empty."""
    if name not in ("position", "velocity") or not isinstance(actuator, Drive):
        return ""
    changes = {} if isinstance(actuator, Servo) else {"family": "servo"}
    changes |= {"loop.controls": name} if isinstance(actuator, Servo) or name == "velocity" else {}
    flags = " ".join(f"--actuator.{field} {value}" for field, value in changes.items())
    fields = " and ".join(f"{field} = {value!r}" for field, value in changes.items())
    text = f"to command the {name} of the same motor, set {fields} ({flags})"
    if name == "position" and not isinstance(actuator, Servo):
        text += "; a bus servo or hobby servo is a pwm_servo"
    return text


class TaskCommands:
    """Conversion from a task's actions to the forces that are requested from the physics."""

    def __init__(
        self,
        task: Task,
        actuators: tuple[ActuatorModel, ...],
        name: str,
        levels: Sequence[float] | None,
    ) -> None:
        """Resolve a command by its name.

        Args:
            task: the task.
            actuators: its actuators.
            name: `force`, or another command of the actuators.
            levels: levels that the actions of a discrete task select, for commands other than
                `force`.
        """
        if name == "force" and actuators[0].MOTION:
            raise ValueError(
                f"action = 'force': a {type(actuators[0]).__name__} does not take forces; must"
                f" be one of {', '.join(actuators[0].commands())}"
            )
        if name == "force" and levels is not None:
            raise ValueError(f"levels = {levels!r}: only for action='current' and action='voltage'")
        commands = [command_of(actuator, name) for actuator in actuators]
        wrapped = [
            task.state_names[index]
            for index in task.wrapped
            if actuators[0].MOTION and name == "position"
        ]
        if wrapped:
            raise ValueError(
                f"action = 'position': {task.name} wraps {', '.join(wrapped)}, and a position that"
                " jumps by one turn cannot be held; use a velocity servo, or another actuator"
            )
        self.simulated = tuple(command.actuator for command in commands)
        """Actuator to simulate for each motor; a command may bypass a part of it."""
        self.is_torque_controlled = self.simulated[0].is_torque_controlled
        """True if the command is a torque. If False, `desired_force` equals the delivered force."""
        self.fixed = commands[0].fixed
        """Fields of the actuator that cannot be randomized -> reason."""
        scales = np.array(
            [command.torque_per_unit / command.actuator.arm_radius for command in commands]
        )
        limits = [command.limit for command in commands]
        if not all(limit is None or np.isfinite(limit) for limit in limits):
            raise ValueError(f"action = {name!r}: needs a finite controller.max_voltage, it is inf")
        self.force_per_position = np.where(
            [command.unit in POSITIONS for command in commands], scales, 0.0
        )
        """Force per unit of a position command; see `codrl_mj.physics.SimulationConfig`."""
        motors = zip(limits, scales, task.max_forces, strict=True)
        self.max_forces = np.array(
            [max_force if limit is None else limit * scale for limit, scale, max_force in motors]
        )
        """Largest forces [N] or torques [N*m] that commands can request, shape (n,)."""
        # Actions are clipped in float64, because rounding may put float32 bounds beyond the limit.
        max_commands = self.max_forces / scales
        self._box = (
            (float(max_commands[0]), float(scales[0]), 1)
            if len(max_commands) == 1
            else (max_commands, scales, len(max_commands))
        )
        """Largest command of a box action, force [N or N*m] per unit command, number of motors."""
        self.action_space: Space = task.action_space
        """Action space of the agent: the task's, indices of a table, or a box of commands."""
        self.action_forces = (
            None if task.forces is None else np.array(task.forces, dtype=np.float64)
        )
        """Forces [N or N*m] of the discrete actions, shape (k,) or (k, n); None for a box."""
        if name != "force" and isinstance(self.action_space, spaces.Box):
            if levels is not None:
                raise ValueError(
                    f"levels = {levels!r}: only for tasks with discrete actions; {task.name}'s are"
                    " continuous"
                )
            bounds = max_commands.astype(np.float32)
            self.action_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        elif name != "force":
            table = _discrete_levels(task, name, levels, commands)
            self.action_space, self.action_forces = spaces.Discrete(len(table)), table * scales[0]

    def force(self, action: Action) -> Force:
        """Return the force [N] or torque [N*m] of an action; an array (n,) for several motors.

        Box actions beyond their bounds saturate.
        """
        forces = self.action_forces
        if forces is not None:
            # `contains` of a space takes longer than the whole conversion of a plain integer.
            is_integer = type(action) is int or type(action) is np.int64
            if not (
                0 <= action < len(forces) if is_integer else self.action_space.contains(action)
            ):
                raise ValueError(f"action = {action!r}: not in {self.action_space}")
            return forces.item(int(action)) if forces.ndim == 1 else forces[int(action)]
        max_command, scale, count = self._box
        # The common case, one motor and an action within its bounds, needs no array operation.
        is_single = count == 1 and type(action) is np.ndarray and action.shape == (1,)
        if (
            is_single
            and type(command := action.item()) is float
            and -max_command <= command <= max_command
        ):
            return command * scale
        array = np.asarray(action)
        if array.shape != (count,) or array.dtype.kind != "f" or np.isnan(array).any():
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        forces = np.clip(array.astype(np.float64), -max_command, max_command) * scale
        return float(forces[0]) if count == 1 else forces

    def forces(self, actions: Action) -> np.ndarray:
        """Return the forces of a batch of actions (N, ...), shape (N,), or (N, n) for n motors."""
        space, array = self.action_space, np.asarray(actions)
        discrete = isinstance(space, spaces.Discrete)
        kinds = "iu" if discrete else "f"
        if (
            array.ndim != 1 + len(space.shape or ())
            or array.shape[1:] != space.shape
            or array.dtype.kind not in kinds
        ):
            raise ValueError(
                f"actions of shape {array.shape} and type {array.dtype}: must be a batch of"
                f" elements of {space}, with one row per environment"
            )
        wrong = (
            (array < 0) | (array >= space.n)
            if isinstance(space, spaces.Discrete)
            else np.isnan(array)
        )
        if wrong.any():
            row = int(np.argmax(wrong.reshape(len(array), -1).any(axis=1)))
            raise ValueError(f"actions[{row}] = {array[row]}: not in {space} (environment {row})")
        if self.action_forces is not None:
            chosen: np.ndarray = self.action_forces[array]
            return chosen
        limit, scale, count = self._box
        commands = array[:, 0] if count == 1 else array
        return np.clip(commands.astype(np.float64), -limit, limit) * scale


def _discrete_levels(
    task: Task, name: str, levels: Sequence[float] | None, commands: Sequence[Command]
) -> np.ndarray:
    """Validate and return the levels that a task's discrete actions select, shape (k,)."""
    if len(commands) > 1:
        raise ValueError(
            f"action = {name!r}: {task.name} has several motors and discrete actions: use 'force'"
        )
    command = commands[0]
    limit = command.limit
    if limit is None:
        limit = float(task.max_forces[0]) * command.actuator.arm_radius / command.torque_per_unit
    try:
        table = np.array([] if levels is None else levels, dtype=np.float64)
    except (TypeError, ValueError):
        table = np.array([np.nan])
    if table.ndim != 1 or len(table) < 2 or not (np.abs(table) <= limit).all():
        raise ValueError(
            f"levels = {levels!r}: {task.name} has discrete actions, so action={name!r} needs two"
            f" or more levels within +-{limit!r} {command.unit}, such as levels=({-limit!r}, 0,"
            f" {limit!r})"
        )
    return table


class ControlCommands:
    """Conversion from actions to the controls of any model, with units, limits and disturbances.

    Actions for actuators without our motors pass unchanged. Disturbances are computed once per
    environment step, not per integration step. If the model's actuator is a plain motor (force =
    gain*control), they change its force [N or N*m] before the gear; otherwise its control.
    """

    def __init__(
        self,
        data: mujoco.MjData,
        actions: Space,
        motors: Mapping[int, Command | None],
        disturbances: Disturbances,
        step_duration: float | None,
    ) -> None:
        """Set `actuator_ctrlrange` of the motors to the limits of their commands.

        Args:
            data: the simulation; its model is changed.
            actions: the environment's original action space.
            motors: actuator index -> command; None if the action stays as it is.
            disturbances: disturbances of the commands and the joints.
            step_duration: duration of an environment step [s]; None if unknown.
        """
        self.action_space, model, indices = actions, data.model, list(motors)
        self._scales: np.ndarray | None = None
        self._disturber, self._dofs = Disturber(NO_DISTURBANCES, 1.0, np.zeros(0), 1), list[int]()
        commands_by_index = {
            index: command for index, command in motors.items() if command is not None
        }
        remedies = (
            {"action": "use action='force', the environment's own actions"}
            if commands_by_index
            else {}
        )
        remedies |= (
            {}
            if disturbances == NO_DISTURBANCES
            else {"disturbances": "only such controls can be disturbed"}
        )
        for name, remedy in remedies.items():
            if not isinstance(actions, spaces.Box) or actions.shape != (model.nu,):
                raise ValueError(
                    f"{name}: the environment's actions are {actions}, not the {model.nu} controls"
                    f" of its model; {remedy}"
                )
        if commands_by_index:
            self._command(model, commands_by_index)
        if disturbances == NO_DISTURBANCES:
            return
        if step_duration is None:
            raise ValueError(
                "disturbances: the environment has no `dt`, the duration of its steps [s]; give"
                " it one"
            )
        check_delay(disturbances, step_duration, None)
        self._data, self._pulses = data, disturbances.random
        actuator_indices = [
            actuator for index in indices for actuator in actuators_sharing_motor(model, index)
        ]
        self._controls = controls = model.actuator_ctrladr[actuator_indices]
        limited = model.actuator_ctrllimited[controls].astype(bool)
        max_controls = np.where(
            limited, np.abs(model.actuator_ctrlrange[controls]).max(axis=1), np.inf
        )
        self._gains = np.array([_plain_gain(model, index) or 1.0 for index in actuator_indices])
        self._disturber = Disturber(
            disturbances, step_duration, max_controls * np.abs(self._gains), 1
        )
        actuators = motors_of(model)
        holding_controls = [
            _holding_control(model, actuator, actuators[index])
            for index in indices
            for actuator in actuators_sharing_motor(model, index)
        ]
        self._holding_controls = np.array(holding_controls).reshape(-1, 2).T
        self._outputs = model.actuator_outadr[actuator_indices]
        # Loads act on joints, one per motor; commands exist for each actuator that shares a motor.
        self._dofs = [_dof(model, index) for index in indices] if self._pulses else []
        self._loaded = [actuator_indices.index(index) for index in indices]

    def _command(self, model: mujoco.MjModel, commands_by_index: Mapping[int, Command]) -> None:
        """Apply the units and limits of commands to the action space and to the model."""
        space = self.action_space
        assert isinstance(space, spaces.Box)
        self._scales = np.ones(model.nu)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        for index, command in commands_by_index.items():
            control, gain = model.actuator_ctrladr[index], _plain_gain(model, index)
            name, arm = (
                model.actuator(index).name or f"actuator {index}",
                command.actuator.arm_radius,
            )
            if gain is None:
                raise ValueError(
                    f"{name}: is not a plain motor, whose force is its control times a gain: use"
                    " action='force', the environment's own actions"
                )
            torque, limit = command.torque_per_unit, command.limit
            self._scales[control] = scale = (
                torque * arm if command.actuator.MOTION else torque / (arm * gain)
            )
            if limit is None and model.actuator_ctrllimited[control]:
                limit = np.abs(model.actuator_ctrlrange[control]).max() / abs(scale)
            if limit is None or not np.isfinite(limit):
                raise ValueError(
                    f"{name}: a command [{command.unit}] needs a limit, and neither the motor nor"
                    " the environment's control has one: give the motor's controller a limit"
                )
            max_control = limit * abs(scale * gain)
            if model.actuator_forcelimited[index] and not command.actuator.MOTION:
                min_force = np.abs(model.actuator_forcerange[index]).min()
                # The tolerance admits ranges that were rounded when they were written to XML.
                if max_control > min_force * (1.0 + 1e-6):
                    raise ValueError(
                        f"{name}: forcerange = {min_force:g}: would cut commands of up to {limit:g}"
                        f" {command.unit}, which are {max_control:g} in the model: remove the range"
                        " from the model, or use action='force'"
                    )
            low[control], high[control] = -limit, limit
            model.actuator_ctrllimited[control] = True
            model.actuator_ctrlrange[control] = -limit * abs(scale), limit * abs(scale)
        self.action_space = spaces.Box(
            low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type
        )

    @property
    def memory(self) -> np.ndarray:
        """Live array of delayed commands and scheduled pulses; empty without disturbances."""
        return self._disturber.memory

    def begin(self, key: float) -> None:
        """Reset the disturbances at the start of an episode, with its random key."""
        if self._disturber.enabled:
            self._disturber.reset(np.zeros(1, dtype=int), key, self._holding_commands())
            self._data.qfrc_applied[self._dofs] = 0.0

    def _holding_commands(self) -> np.ndarray | float:
        """Return the commands that hold the motors in place: 0 unless commands are positions."""
        slopes, offsets = self._holding_controls * self._gains
        if not slopes.any():
            return 0.0
        # Not every environment updates the actuators' lengths at a reset. The copy leaves the
        # environment's own data as it is.
        data = copy.copy(self._data)
        mujoco.mj_fwdPosition(data.model, data)
        commands: np.ndarray = slopes * data.actuator_length[self._outputs] + offsets
        return commands

    def controls(self, action: Action) -> Action:
        """Return the environment's action after scaling and disturbances; apply loads to joints."""
        if (self._scales is not None or self._disturber.enabled) and np.shape(
            action
        ) != self.action_space.shape:
            raise ValueError(
                f"action has shape {np.shape(action)}: must be {self.action_space.shape}"
            )
        if self._scales is not None:
            action = np.asarray(action, dtype=np.float64) * self._scales
        if not self._disturber.enabled:
            return action
        disturbed_action = np.array(action, dtype=np.float64)
        commanded_forces = disturbed_action[self._controls] * self._gains
        commands, loads = (
            array[0] for array in self._disturber.disturb_commands(commanded_forces[np.newaxis])
        )
        disturbed_action[self._controls] = commands / self._gains
        if self._pulses:
            self._data.qfrc_applied[self._dofs] = 0.0
            np.add.at(self._data.qfrc_applied, self._dofs, loads[self._loaded])
        return disturbed_action


def _dof(model: mujoco.MjModel, index: int) -> int:
    """Return the degree of freedom that a motor drives; raise if it drives no joint."""
    if mujoco.mjtTrn(model.actuator_trntype[index]) not in ON_JOINT:
        raise ValueError(
            f"disturbances.pulse_force: {model.actuator(index).name or f'actuator {index}'} drives"
            " no joint on which a load could act; give only command_delay, command_quantum and"
            " command_rate"
        )
    return int(model.jnt_dofadr[model.actuator_trnid[index, 0]])


def _holding_control(
    model: mujoco.MjModel, index: int, actuator: ActuatorModel
) -> tuple[float, float]:
    """Return slope and offset of the control slope*length + offset that holds an actuator.

    Both are 0 if the control is a force.
    """
    if actuator.MOTION:
        command = next(iter(actuator.commands().values()))
        return float(command.unit in POSITIONS), 0.0
    gain, (offset, slope) = (
        float(model.actuator_gainprm[index, 0]),
        model.actuator_biasprm[index, :2].tolist(),
    )
    is_fixed_gain = model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED and gain != 0.0
    is_integrator = model.actuator_dyntype[index] == mujoco.mjtDyn.mjDYN_INTEGRATOR
    if (
        not is_fixed_gain
        or is_integrator
        or model.actuator_biastype[index] != mujoco.mjtBias.mjBIAS_AFFINE
        or slope == 0.0
    ):
        return 0.0, 0.0
    return -slope / gain, -offset / gain


def _plain_gain(model: mujoco.MjModel, index: int) -> float | None:
    """Return the gain of an actuator whose force is gain*control; None for all other actuators."""
    kinds = (
        model.actuator_gaintype[index],
        model.actuator_biastype[index],
        model.actuator_dyntype[index],
    )
    motor_kinds = (
        mujoco.mjtGain.mjGAIN_FIXED,
        mujoco.mjtBias.mjBIAS_NONE,
        mujoco.mjtDyn.mjDYN_NONE,
    )
    gain = float(model.actuator_gainprm[index, 0])
    return (
        gain
        if kinds == motor_kinds and gain != 0.0 and len(actuators_sharing_motor(model, index)) == 1
        else None
    )
