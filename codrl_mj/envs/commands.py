"""What an agent's actions stand for: forces, or what its actuators take besides, such as currents and voltages."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command, Drive, Ideal, Servo
from codrl_mj.disturbances import NO_DISTURBANCES, Disturbances, check_delay
from codrl_mj.engine.reading import motors as motors_of
from codrl_mj.engine.reading import sharing
from codrl_mj.engine.specs import ON_JOINT
from codrl_mj.physics.disturber import Disturber
from codrl_mj.tasks import Task

POSITIONS = ("rad", "m")
"""Units of commands that are positions."""


def command_of(actuator: ActuatorModel, name: str, whose: str = "") -> Command:
    """What an action means to an actuator, that of a pattern `whose`; a force is one of the actuator as it is."""
    if name == "force":
        return Command("N or N*m", actuator, actuator.arm_radius, None, {})
    known = actuator.commands()
    if name not in known:
        kind = f"{actuator.family or type(actuator).__name__} actuator{whose and f' of {whose!r}'}"
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
        fixed={field: f"with action={name!r} {why}" for field, why in command.fixed.items()}
    )


def _servo_remedy(actuator: ActuatorModel, name: str) -> str:
    """Return how to ask a motor for a position or a velocity; empty if the actuator or the action is another."""
    if name not in ("position", "velocity") or not isinstance(actuator, Drive):
        return ""
    changes = {} if isinstance(actuator, Servo) else {"family": "servo"}
    changes |= {"loop.controls": name} if isinstance(actuator, Servo) or name == "velocity" else {}
    flags = " ".join(f"--actuator.{field} {value}" for field, value in changes.items())
    fields = " and ".join(f"{field} = {value!r}" for field, value in changes.items())
    return f"for a {name} of the same motor set {fields} over it ({flags})"


class TaskCommands:
    """The way from an action to the forces that the physics is asked for."""

    def __init__(
        self,
        task: Task,
        actuators: tuple[ActuatorModel, ...],
        name: str,
        levels: Sequence[float] | None,
    ) -> None:
        """Resolve a command by its name; `levels` are for discrete tasks and other commands than `force`."""
        if name == "force" and actuators[0].MOTION:
            raise ValueError(
                f"action = 'force': a {type(actuators[0]).__name__} is not asked for forces; must"
                f" be one of {', '.join(actuators[0].commands())}"
            )
        if name == "force" and levels is not None:
            raise ValueError(f"levels = {levels!r}: only for action='current' and action='voltage'")
        chosen = [command_of(actuator, name) for actuator in actuators]
        wrapped = [
            task.state_names[at]
            for at in task.wrapped
            if actuators[0].MOTION and name == "position"
        ]
        if wrapped:
            raise ValueError(
                f"action = 'position': {task.name} wraps {', '.join(wrapped)}, and a position that"
                " jumps by a turn cannot be held; use a velocity servo, or another actuator"
            )
        self.simulated = tuple(command.actuator for command in chosen)
        """What is simulated, one for each motor: the actuator, or what a command leaves of it."""
        self.tracks = self.simulated[0].is_torque_controlled
        """Whether a force is asked for; otherwise what is delivered counts as desired."""
        self.fixed = chosen[0].fixed
        """Fields of the actuator that cannot be drawn -> why."""
        scales = np.array(
            [command.torque_per_unit / command.actuator.arm_radius for command in chosen]
        )
        limits = [command.limit for command in chosen]
        if not all(limit is None or np.isfinite(limit) for limit in limits):
            raise ValueError(f"action = {name!r}: needs a finite controller.max_voltage, it is inf")
        self.holds = np.where([command.unit in POSITIONS for command in chosen], scales, 0.0)
        """As `codrl_mj.physics.SimulationConfig.force_per_position`."""
        each = zip(limits, scales, task.max_forces, strict=True)
        self.max_forces = np.array(
            [most if limit is None else limit * scale for limit, scale, most in each]
        )
        """Largest forces [N] or torques [N*m] that the physics is asked for, shape (n,)."""
        most = self.max_forces / scales  # in float64: a float32 bound of the space may lie beyond
        self._box = (
            (float(most[0]), float(scales[0]), 1) if len(most) == 1 else (most, scales, len(most))
        )
        """The largest command of a box's action, the force [N or N*m] of a command of one, and the number of motors."""
        self.action_space: spaces.Space[Any] = task.action_space
        """The agent's actions: the task's, or a table's indices, or a box of commands."""
        self.action_forces = (
            None if task.forces is None else np.array(task.forces, dtype=np.float64)
        )
        """Forces [N or N*m] of the discrete actions, in order, shape (k,) or (k, n); None where the space is a box."""
        if name != "force" and isinstance(self.action_space, spaces.Box):
            if levels is not None:
                raise ValueError(
                    f"levels = {levels!r}: only for tasks with discrete actions; {task.name}'s are"
                    " continuous"
                )
            bounds = most.astype(np.float32)
            self.action_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        elif name != "force":
            table = _table(task, name, levels, chosen)
            self.action_space, self.action_forces = spaces.Discrete(len(table)), table * scales[0]

    def force(self, action: Any) -> Any:
        """The force [N] or torque [N*m] that the physics is to ask the actuator for; with several motors an array (n,).

        An action of a box saturates.
        """
        forces = self.action_forces
        if forces is not None:
            plain = type(action) is int or type(action) is np.int64  # spares them the slower test
            if not (0 <= action < len(forces) if plain else self.action_space.contains(action)):
                raise ValueError(f"action = {action!r}: not in {self.action_space}")
            return forces.item(int(action)) if forces.ndim == 1 else forces[int(action)]
        limit, scale, count = self._box
        alone = count == 1 and type(action) is np.ndarray and action.shape == (1,)
        if (
            alone and type(command := action.item()) is float and -limit <= command <= limit
        ):  # quickly
            return command * scale
        array = np.asarray(action)
        if array.shape != (count,) or array.dtype.kind != "f" or np.isnan(array).any():
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        forces = np.clip(array.astype(np.float64), -limit, limit) * scale
        return float(forces[0]) if count == 1 else forces

    def forces(self, actions: Any) -> np.ndarray:
        """What `force` does, for a batch (N, ...): forces (N,), or with several motors (N, n), float64."""
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
                f" elements of {space}, with one row an environment"
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
            return self.action_forces[array]
        limit, scale, count = self._box
        commands = array[:, 0] if count == 1 else array
        return np.clip(commands.astype(np.float64), -limit, limit) * scale


def _table(
    task: Task, name: str, levels: Sequence[float] | None, commands: Sequence[Command]
) -> np.ndarray:
    """The levels of a command that a task's discrete actions choose from, shape (k,), checked."""
    if len(commands) > 1:
        raise ValueError(
            f"action = {name!r}: {task.name} has several motors and discrete actions: use 'force'"
        )
    command = commands[0]
    limit = command.limit
    if limit is None:
        limit = float(task.max_forces[0]) * command.actuator.arm_radius / command.torque_per_unit
    try:
        table = np.array([] if levels is None else levels, dtype=np.float64)  # a copy
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
    """From actions to the controls of anybody's model: units and limits of commands, and disturbances on their way.

    Actions that are not of our motors are as they were. Disturbances act once an environment step,
    which has the place of the integration step; of a plain motor on its force [N or N*m] before the
    gear, of others on the control itself.
    """

    def __init__(
        self,
        data: mujoco.MjData,
        actions: spaces.Space,
        motors: Mapping[int, Command | None],
        disturbances: Disturbances,
        step_duration: float | None,
    ) -> None:
        """Let the motors' controls, the model's `actuator_ctrlrange`, reach as far as their commands do.

        `actions` has the environment's own, `motors` what one means to an actuator, by its index:
        None where it is the environment's own. An environment step takes `step_duration` [s], if
        that is known.
        """
        self.action_space, model, indices = actions, data.model, list(motors)
        self._scales: np.ndarray | None = None
        self._disturber, self._dofs = Disturber(NO_DISTURBANCES, 1.0, np.zeros(0), 1), list[int]()
        meant = {index: command for index, command in motors.items() if command is not None}
        remedies = {"action": "use action='force', its own"} if meant else {}
        remedies |= (
            {} if disturbances == NO_DISTURBANCES else {"disturbances": "they are what can be disturbed"}
        )
        for name, remedy in remedies.items():
            if not isinstance(actions, spaces.Box) or actions.shape != (model.nu,):
                raise ValueError(
                    f"{name}: the environment's actions are {actions}, not the {model.nu} controls"
                    f" of its model; {remedy}"
                )
        if meant:
            self._command(model, meant)
        if disturbances == NO_DISTURBANCES:
            return
        if step_duration is None:
            raise ValueError(
                "disturbances: the environment has no dt, the duration of its steps [s]; give"
                " it one"
            )
        check_delay(disturbances, step_duration, None)
        self._data, self._pulses = data, disturbances.random
        every = [one for index in indices for one in sharing(model, index)]
        self._controls = places = model.actuator_ctrladr[every]
        limited = model.actuator_ctrllimited[places].astype(bool)
        largest = np.where(limited, np.abs(model.actuator_ctrlrange[places]).max(axis=1), np.inf)
        self._gains = np.array([_plain_gain(model, index) or 1.0 for index in every])
        self._disturber = Disturber(disturbances, step_duration, largest * np.abs(self._gains), 1)
        present = motors_of(model)
        holds = [
            _hold(model, one, present[index]) for index in indices for one in sharing(model, index)
        ]
        self._holds = np.array(holds).reshape(-1, 2).T
        self._outputs = model.actuator_outadr[every]
        # loads are on joints, one for each motor; commands, one for each of its actuators
        self._dofs = [_dof(model, index) for index in indices] if self._pulses else []
        self._loaded = [every.index(index) for index in indices]

    def _command(self, model: mujoco.MjModel, meant: Mapping[int, Command]) -> None:
        """Take units and limits of commands."""
        space: Any = self.action_space
        self._scales = np.ones(model.nu)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        for index, command in meant.items():
            control, gain = model.actuator_ctrladr[index], _plain_gain(model, index)
            name, arm = (
                model.actuator(index).name or f"actuator {index}",
                command.actuator.arm_radius,
            )
            if gain is None:
                raise ValueError(
                    f"{name}: is no plain motor of its own, whose force is its control times a"
                    " gain: use action='force', the environment's own"
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
                    " the environment's control has one: give the motor's controller one"
                )
            reach = limit * abs(scale * gain)
            if model.actuator_forcelimited[index] and not command.actuator.MOTION:
                least = np.abs(model.actuator_forcerange[index]).min()
                if reach > least * (1.0 + 1e-6):
                    raise ValueError(
                        f"{name}: forcerange = {least:g}: would cut commands of up to {limit:g}"
                        f" {command.unit}, which stand for {reach:g} there: take the range out of"
                        " the model, or use action='force'"
                    )
            low[control], high[control] = -limit, limit
            model.actuator_ctrllimited[control] = True
            model.actuator_ctrlrange[control] = -limit * abs(scale), limit * abs(scale)
        self.action_space = spaces.Box(
            low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type
        )

    @property
    def memory(self) -> dict[str, np.ndarray]:
        """The commands on their way and the pulses to come, a live array, if there are disturbances."""
        return {"disturbances": self._disturber.memory} if self._disturber.enabled else {}

    def begin(self, key: float) -> None:
        """Forget everything at the start of an episode with this key of random numbers."""
        if self._disturber.enabled:
            self._disturber.reset(np.zeros(1, dtype=int), key, self._held())
            self._data.qfrc_applied[self._dofs] = 0.0

    def _held(self) -> Any:
        """Return the commands on their way that hold the motors where they are: 0 unless they are positions."""
        slopes, offsets = self._holds * self._gains
        if not slopes.any():
            return 0.0
        present = copy.copy(
            self._data
        )  # not every environment has brought its lengths up to date at a reset
        mujoco.mj_fwdPosition(present.model, present)
        return slopes * present.actuator_length[self._outputs] + offsets

    def controls(self, action: Any) -> Any:
        """The environment's own action for one of `action_space`, as it arrives in a step; loads go to the joints."""
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
        arrived = np.array(action, dtype=np.float64)
        wanted = arrived[self._controls] * self._gains
        commands, loads = (each[0] for each in self._disturber.disturb_commands(wanted[np.newaxis]))
        arrived[self._controls] = commands / self._gains
        if self._pulses:
            self._data.qfrc_applied[self._dofs] = 0.0
            np.add.at(self._data.qfrc_applied, self._dofs, loads[self._loaded])
        return arrived


def _dof(model: mujoco.MjModel, index: int) -> int:
    """The degree of freedom that a motor drives; refused where it drives no joint."""
    if mujoco.mjtTrn(model.actuator_trntype[index]) not in ON_JOINT:
        raise ValueError(
            f"disturbances.pulse_force: {model.actuator(index).name or f'actuator {index}'} drives"
            " no joint on which a load could act; give only command_delay, command_quantum and"
            " command_rate"
        )
    return int(model.jnt_dofadr[model.actuator_trnid[index, 0]])


def _hold(model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> tuple[float, float]:
    """Return the slope over its length, and the offset, of a control that holds an actuator; zeros if it is a force."""
    if actuator.MOTION:
        asked = next(iter(actuator.commands().values()))
        return float(asked.unit in POSITIONS), 0.0
    gain, (offset, slope) = (
        float(model.actuator_gainprm[index, 0]),
        model.actuator_biasprm[index, :2].tolist(),
    )
    fixed = model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED and gain != 0.0
    integrates = model.actuator_dyntype[index] == mujoco.mjtDyn.mjDYN_INTEGRATOR
    if (
        not fixed
        or integrates
        or model.actuator_biastype[index] != mujoco.mjtBias.mjBIAS_AFFINE
        or slope == 0.0
    ):
        return 0.0, 0.0
    return -slope / gain, -offset / gain


def _plain_gain(model: mujoco.MjModel, index: int) -> float | None:
    """The gain of an actuator whose force is gain*control; None where it is more than that."""
    kinds = (
        model.actuator_gaintype[index],
        model.actuator_biastype[index],
        model.actuator_dyntype[index],
    )
    plain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE)
    gain = float(model.actuator_gainprm[index, 0])
    return gain if kinds == plain and gain != 0.0 and len(sharing(model, index)) == 1 else None
