"""What an agent's actions stand for: forces, or what its actuator takes besides, such as currents and voltages."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command, Ideal
from codrl_mj.tasks import Task


@dataclasses.dataclass(frozen=True)
class Commands:
    """The way from an action to the forces that the physics is asked for; made by `build`."""

    task: Task
    """The task."""
    name: str
    """`force`, or one of the actuator's commands."""
    simulated: tuple[ActuatorModel, ...]
    """What is simulated, one for each motor: the actuator, or what a command leaves of it."""
    scales: np.ndarray
    """Forces [N] or torques [N*m] that stand for commands of one, shape (n,)."""
    max_forces: np.ndarray
    """Largest forces [N] or torques [N*m] that the physics is asked for, shape (n,)."""
    fixed: Mapping[str, str]
    """Fields of the actuator that cannot be drawn -> why."""
    levels: np.ndarray | None
    """Commands that a discrete task's actions choose from; None where the action is the command, or a force."""

    @classmethod
    def build(
        cls, task: Task, actuators: tuple[ActuatorModel, ...], name: str, levels: Sequence[float] | None
    ) -> "Commands":
        """Resolve a command by its name; `levels` are for discrete tasks and other commands than `force`.

        Raises:
            ValueError: an unknown command, one that the actuator or the task cannot take, or a missing or invalid
            table.
        """
        count = len(actuators)
        if name == "force":
            if actuators[0].MOTION:
                raise ValueError(
                    f"action = 'force': a {type(actuators[0]).__name__} is not asked for forces; must be one of "
                    f"{', '.join(actuators[0].commands())}"
                )
            if levels is not None:
                raise ValueError(f"levels = {levels!r}: only for action='current' and action='voltage'")
            return cls(task, name, actuators, np.ones(count), task.max_forces, {}, None)
        possible = [actuator.commands() for actuator in actuators]
        if name not in possible[0]:
            if isinstance(actuators[0], Ideal) and name in ("current", "voltage"):
                raise ValueError(
                    f"action = {name!r}: the ideal actuator has no {name} to command; choose another actuator"
                )
            raise ValueError(f"action = {name!r}: must be one of {', '.join(['force', *possible[0]])}")
        wrapped = [task.state_names[at] for at in task.wrapped if actuators[0].MOTION and name == "position"]
        if wrapped:
            raise ValueError(
                f"action = 'position': {task.name} wraps {', '.join(wrapped)}, and a position that jumps by a turn "
                "cannot be held; use a velocity servo, or another actuator"
            )
        chosen = [commands[name] for commands in possible]
        scales = np.array([command.torque_per_unit / command.actuator.arm_radius for command in chosen])
        limits = [command.limit for command in chosen]
        if not all(limit is None or np.isfinite(limit) for limit in limits):
            raise ValueError(f"action = {name!r}: needs a finite controller.max_voltage, it is inf")
        forces = [
            most if limit is None else limit * scale
            for limit, scale, most in zip(limits, scales, task.max_forces, strict=True)
        ]
        simulated = tuple(command.actuator for command in chosen)
        made = cls(task, name, simulated, scales, np.array(forces), chosen[0].fixed, None)
        return dataclasses.replace(made, levels=made._table(levels, chosen[0]))

    def _table(self, levels: Sequence[float] | None, command: Command) -> np.ndarray | None:
        """The table of levels, checked against the task's action space."""
        task = self.task
        if isinstance(task.action_space, spaces.Box):
            if levels is not None:
                raise ValueError(
                    f"levels = {levels!r}: only for tasks with discrete actions; {task.name}'s are continuous"
                )
            return None
        if len(self.scales) > 1:
            raise ValueError(
                f"action = {self.name!r}: {task.name} has several motors and discrete actions: use 'force'"
            )
        limit = command.limit
        if limit is None:
            limit = float(task.max_forces[0]) * command.actuator.arm_radius / command.torque_per_unit
        try:
            table = np.array([] if levels is None else levels, dtype=np.float64)  # a copy
        except (TypeError, ValueError):
            table = np.array([np.nan])
        if table.ndim != 1 or len(table) < 2 or not (np.abs(table) <= limit).all():
            raise ValueError(
                f"levels = {levels!r}: {task.name} has discrete actions, so action={self.name!r} needs two or more "
                f"levels within +-{limit!r} {command.unit}, such as levels=({-limit!r}, 0, {limit!r})"
            )
        return table

    @property
    def tracks(self) -> bool:
        """Whether a force is asked for; otherwise what is delivered counts as desired."""
        return self.simulated[0].tracks

    @property
    def limits(self) -> np.ndarray:
        """Largest commands, shape (n,), in float64: a float32 bound may lie beyond."""
        return self.max_forces / self.scales

    @functools.cached_property
    def action_space(self) -> spaces.Space[Any]:
        """The agent's actions: the task's, or a table's indices, or a box of commands."""
        if self.levels is not None:
            return spaces.Discrete(len(self.levels))
        if self.name == "force":
            return self.task.action_space
        bounds = self.limits.astype(np.float32)
        return spaces.Box(-bounds, bounds, dtype=np.float32)

    @functools.cached_property
    def action_forces(self) -> np.ndarray | None:
        """Forces [N or N*m] of the discrete actions, in order, shape (k,) or (k, n); None where the space is a box."""
        if self.levels is not None:
            return self.levels * self.scales[0]
        return None if self.task.forces is None else np.array(self.task.forces, dtype=np.float64)

    @functools.cached_property
    def _box(self) -> tuple[Any, Any, int]:
        """The largest command of a box's action, the force [N or N*m] of a command of one, and the number of motors."""
        limits = self.task.max_forces if self.name == "force" else self.limits
        if len(limits) == 1:
            return float(limits[0]), float(self.scales[0]), 1
        return limits, self.scales, len(limits)

    def force(self, action: Any) -> Any:
        """The force [N] or torque [N*m] that the physics is to ask the actuator for; with several motors an array (n,).

        An action of a box saturates.

        Raises:
            ValueError: the action is no element, or not a number.
        """
        forces = self.action_forces
        if forces is not None:
            plain = type(action) is int or type(action) is np.int64  # spares them the slower test
            if not (0 <= action < len(forces) if plain else self.action_space.contains(action)):
                raise ValueError(f"action = {action!r}: not in {self.action_space}")
            return forces.item(int(action)) if forces.ndim == 1 else forces[int(action)]
        array, (limit, scale, count) = np.asarray(action), self._box
        if array.shape != (count,) or array.dtype.kind != "f":
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        if count == 1:
            command = float(array[0])
            if command != command:
                raise ValueError(f"action = {action!r}: not in {self.action_space}")
            return min(max(command, -limit), limit) * scale
        if np.isnan(array).any():
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        return np.clip(array.astype(np.float64), -limit, limit) * scale

    def forces(self, actions: Any) -> np.ndarray:
        """What `force` does, for a batch (N, ...): forces (N,), or with several motors (N, n), float64.

        Raises:
            ValueError: wrong shape or type, or a row that is no element; the message has its index.
        """
        space, array = self.action_space, np.asarray(actions)
        discrete = isinstance(space, spaces.Discrete)
        kinds = "iu" if discrete else "f"
        if array.ndim != 1 + len(space.shape or ()) or array.shape[1:] != space.shape or array.dtype.kind not in kinds:
            raise ValueError(
                f"actions of shape {array.shape} and type {array.dtype}: must be a batch of elements of {space}, with "
                f"one row an environment"
            )
        wrong = (array < 0) | (array >= space.n) if isinstance(space, spaces.Discrete) else np.isnan(array)
        if wrong.any():
            row = int(np.argmax(wrong.reshape(len(array), -1).any(axis=1)))
            raise ValueError(f"actions[{row}] = {array[row]}: not in {space} (environment {row})")
        if self.action_forces is not None:
            return self.action_forces[array]
        limit, scale, count = self._box
        commands = array[:, 0] if count == 1 else array
        return np.clip(commands.astype(np.float64), -limit, limit) * scale
