"""Tasks as env sources: their fields and options, and the construction of their environments."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from codrl_mj.actuators import ActuatorModel
from codrl_mj.envs.sources import (
    COMMON_FIELDS,
    EnvSource,
    describe_box,
    options_mapping,
    pattern_mapping,
    source_of,
)
from codrl_mj.fields import check_pattern, did_you_mean, field_docs
from codrl_mj.tasks import TASKS, Task, find_task, reference_of, register, resolve_actuators
from codrl_mj.user_code import asset_path


class UnknownOptionError(ValueError, TypeError):
    """Unknown option of an environment; also the TypeError that Python and TorchRL expect."""


class TaskEnvSource(EnvSource):
    """Env source of one task, built-in or custom."""

    fields = (*COMMON_FIELDS, "physics", "integrator", "inner_steps", "timestep", "levels", "joint")
    evaluation_overrides = ("max_episode_steps", "options")

    def __init__(self, task: Task) -> None:
        """Take the attributes of the task."""
        self.task, self.name, self.preset = task, task.name, task.name
        self.time_limit, self.paper = task.max_episode_steps, tuple(task.paper)
        self.default_actuator = task.default_actuator
        self.goal_hold, self.timed = task.goal_hold, task.goal is not None
        self.option_names, self.env_id = task.options._fields, task.env_id

    def make(self, config: Any, **view: Any) -> Any:
        """Make an environment with `gymnasium.make`; `view` as for `codrl_mj.envs.ActuatedEnv`."""
        return gymnasium.make(
            self.env_id, disable_env_checker=True, **config.as_arguments(), **view
        )

    def make_vec(self, config: Any, num_envs: int, **arguments: Any) -> Any:
        """Make a vector environment: a batch on MuJoCo, otherwise stepped one by one."""
        from codrl_mj.envs.serial import SerialVectorEnv
        from codrl_mj.envs.vector import ActuatedVectorEnv

        arguments = {"max_episode_steps": config.time_limit} | config.as_arguments() | arguments
        is_human = arguments.get("render_mode") == "human"
        if arguments["physics"] == "mujoco" and not is_human:
            return ActuatedVectorEnv(
                num_envs, config.task, **{"autoreset_mode": AutoresetMode.SAME_STEP, **arguments}
            )
        if arguments["physics"] == "mujoco":
            gymnasium.logger.warn(
                f"render_mode = 'human': {num_envs} environments of {self.name} are stepped one by"
                " one, which is slow; batches render with 'rgb_array'"
            )
        return SerialVectorEnv(num_envs, config.task, **arguments)

    @property
    def reference(self) -> str:
        """Name of a built-in task, `module:NAME` of a custom one."""
        return reference_of(self.task)

    def code(self, options: Any) -> set[str | Path]:  # noqa: ARG002 - options contain no files
        """Return the task's module and MJCF file."""
        return {self.task.reward.__module__, asset_path(self.task.asset).resolve()}

    def options(self, values: Any) -> Any:
        """Return the task's options as its `NamedTuple`."""
        option_type = self.task.options
        options = (
            self.non_default_options(values)
            if isinstance(values, tuple)
            else options_mapping(values)
        )
        for name, value in options.items():
            if name not in option_type._fields:
                names = ", ".join(option_type._fields) or "none"
                hint = did_you_mean(name, [*option_type._fields, *self.fields])
                raise UnknownOptionError(
                    f"unknown option {name!r} of {self.name}: {hint}it has {names} (unexpected"
                    f" keyword argument {name!r})"
                )
            options[name] = value = value.item() if isinstance(value, np.generic) else value
            default = option_type._field_defaults[name]
            is_flag, positive = isinstance(default, bool), default > 0
            is_allowed = isinstance(value, int | float) and (
                is_flag or (value > 0 if positive else math.isfinite(value))
            )
            if isinstance(value, bool) != is_flag or not is_allowed:
                expected = (
                    "True or False"
                    if is_flag
                    else "a number > 0"
                    if positive
                    else "a finite number"
                )
                raise ValueError(f"{name} = {value!r}: must be {expected}")
        return option_type(
            **{
                name: value if isinstance(value, bool) else float(value)
                for name, value in options.items()
            }
        )

    def non_default_options(self, options: Any) -> dict[str, Any]:
        """Return the options that differ from their defaults."""
        return {
            name: value
            for name, value in options._asdict().items()
            if value != options._field_defaults[name]
        }

    def option_flags(self, config: Any) -> list[tuple[str, Any, str, Any]]:
        """Return the flags of all tasks' options, so that messages can name another task's flag."""
        option_types: dict[str, Any] = {name: task.options for name, task in TASKS.items()}
        changed_options = self.non_default_options(config.options)
        return [
            (
                option,
                hint | None,
                f"{task}: {field_docs(option_type)[option]}",
                changed_options.get(option),
            )
            for task, option_type in option_types.items()
            for option, hint in typing.get_type_hints(option_type).items()
        ]

    def options_of(self, flags: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options whose flags were set."""
        return {name: value for name, value in flags.items() if value is not None}

    def actuators(self, actuator: Any) -> Any:
        """Return the actuator of a single motor, or a tuple with those of several, in order."""
        patterns = pattern_mapping(actuator)
        if patterns is not None:
            actuators_by_motor = self._by_pattern(patterns)
            actuator = [actuators_by_motor.get(motor, "default") for motor in self.task.motors]
        actuators = resolve_actuators(actuator, self.task)
        return actuators[0] if len(actuators) == 1 else actuators

    def _by_pattern(self, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Return motor -> actuator, from a mapping of patterns of motor names to actuators."""
        # A local import, because the module imports numba, which takes long.
        from codrl_mj.engine.specs import match_pattern, split_pattern

        names, actuators_by_motor = [[motor] for motor in self.task.motors], {}
        for pattern, actuator in patterns.items():
            check_pattern(pattern)
            if len(split_pattern(pattern)) > 1:
                raise ValueError(
                    f"{pattern!r}: {self.task.name} has a motor at each of its joints: give each"
                    " motor its own actuator"
                )
            for index in match_pattern(pattern, names):
                motor = names[index][0]
                if motor in actuators_by_motor:
                    raise ValueError(f"{motor}: {pattern!r} and another pattern match it")
                actuators_by_motor[motor] = actuator
        return actuators_by_motor

    def actuators_by_name(self, actuators: Any) -> dict[str, ActuatorModel]:
        """Return motor -> actuator."""
        return dict(
            zip(
                self.task.motors,
                actuators if isinstance(actuators, tuple) else (actuators,),
                strict=True,
            )
        )

    def override_actuators(self, config: Any, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Return motor -> actuator: those in `patterns`, else the configured ones."""
        return {**config.actuators_by_name, **self._by_pattern(patterns)}

    @property
    def scripted_task(self) -> Task:
        """The task, if it has a scripted controller, which needs a single motor."""
        if len(self.task.motors) > 1:
            raise ValueError(
                f"task {self.name!r} has {len(self.task.motors)} motors: there is no scripted"
                " controller; train it with --actuator ideal and name the run, or give time,"
                " torque and speed of each joint as .npz files"
            )
        return self.task

    def with_motor_steps(self, config: Any) -> Any:
        """Return a configuration on MuJoCo, with the integration steps that a motor would need."""
        inner_steps = (
            {}
            if config.inner_steps or config.timestep
            else {"inner_steps": self.task.motor_inner_steps}
        )
        return dataclasses.replace(config, physics="mujoco", **inner_steps)

    def action_space(self, config: Any) -> Any:  # noqa: ARG002 - the same with any actuator
        """Return the task's action space."""
        return self.task.action_space

    def default_agent(self, config: Any) -> str:  # noqa: ARG002
        """Return the task's default agent; for five of the built-in tasks the paper's."""
        return str(self.task.agent)

    def view(self, config: Any, width: int, height: int, camera: str | None) -> None:  # noqa: ARG002
        """Check size and camera; return None, because images are rendered from recorded states."""
        import mujoco

        from codrl_mj.physics.offscreen import check_view

        model = mujoco.MjModel.from_xml_path(str(asset_path(self.task.asset)))
        check_view(model, width, height, camera or "fixed")

    def scene(self, config: Any) -> tuple[Any, Any, str | None]:  # noqa: ARG002 - always the same
        """Return the task's model with bounds and hills, a function that poses it, and a camera."""
        from codrl_mj.envs.single import ActuatedEnv

        env = ActuatedEnv(self.reference, "ideal")

        def show(state: np.ndarray) -> Any:
            env.physics.show(state)
            return env.data

        return env.model, show, "fixed"

    def state_names(self, config: Any) -> tuple[str, ...]:  # noqa: ARG002
        """Return the task's state names."""
        return self.task.state_names

    def interface(self, config: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Describe observation and action, with names and units of task, sensors and commands."""
        from codrl_mj.envs.commands import command_of
        from codrl_mj.envs.setup import ResolvedEnv

        setup, motors = ResolvedEnv.build(config), config.actuators
        sensor_units = [
            motors[0].SIGNAL_UNITS.get(name.rpartition(".")[2]) for name in setup.sensors
        ]
        observations = describe_box(
            setup.observation_names,
            setup.observation_space,
            [*self.task.observation_units, *sensor_units],
        )
        coordinates = [
            self.task.state_names[self.task.qpos[self.task.qvel.index(speed_index)]]
            for speed_index in self.task.speed_indices
        ]
        joint_units = ["N*m" if name.endswith("[rad]") else "N" for name in coordinates]
        is_force_command = config.action == "force"
        units = (
            joint_units
            if is_force_command
            else [command_of(actuator, config.action).unit for actuator in motors]
        )
        commands = setup.commands
        if isinstance(commands.action_space, spaces.Box):
            return observations, describe_box(self.task.motors, commands.action_space, units)
        table: Any = commands.action_forces if is_force_command else config.levels
        names = [
            {"name": name, "unit": unit} for name, unit in zip(self.task.motors, units, strict=True)
        ]
        columns = np.reshape(table, (len(table), -1)).T.tolist()
        return observations, [
            {**entry, "levels": levels} for entry, levels in zip(names, columns, strict=True)
        ]

    def at_goal(self, episode: Any) -> np.ndarray | None:
        """Return True for states at the goal; without a goal, for all if it did not terminate."""
        if self.task.goal is None:
            return np.full(len(episode.state), not episode.terminated)
        return np.asarray(self.task.goal(episode.state.T), dtype=bool)


def claims(name: str) -> bool:
    """Return True if this is a task's name or Gymnasium id."""
    return name in TASKS or any(name == task.env_id for task in TASKS.values())


def find(name: Any) -> TaskEnvSource:
    """Return the env source of the task with this name."""
    tasks_by_id = {task.env_id: task for task in TASKS.values()}
    return TaskEnvSource(tasks_by_id[name] if name in tasks_by_id else find_task(name))


@source_of.register
def _(task: Task) -> TaskEnvSource:
    return TaskEnvSource(register(task))
