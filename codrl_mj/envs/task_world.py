"""Tasks as worlds: what an `EnvConfig` of one can have besides, and how its environments are made."""

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
from codrl_mj.envs.worlds import (
    COMMON,
    EnvSource,
    described,
    options_mapping,
    patterns_of,
    world_of,
)
from codrl_mj.fields import check_pattern, did_you_mean, field_docs
from codrl_mj.tasks import TASKS, Task, find_task, reference_of, register, resolve_actuators
from codrl_mj.user_code import asset_path


class UnknownOptionError(ValueError, TypeError):
    """A keyword that the environment does not have; a TypeError too, as Python's own is, and as TorchRL expects."""


class TaskEnvSource(EnvSource):
    """The world of one task, ours or anybody's."""

    fields = (*COMMON, "physics", "integrator", "inner_steps", "timestep", "levels", "joint")
    posed = ("max_episode_steps", "options")

    def __init__(self, task: Task) -> None:
        """Take what the task says."""
        self.task, self.name, self.preset = task, task.name, task.name
        self.time_limit, self.paper = task.max_episode_steps, tuple(task.paper)
        self.default_actuator = task.default_actuator
        self.goal_hold, self.timed = task.goal_hold, task.goal is not None
        self.option_names, self.env_id = task.options._fields, task.env_id

    def make(self, config: Any, **view: Any) -> Any:
        """An environment, made by Gymnasium; `view` as for `codrl_mj.envs.ActuatedEnv`."""
        return gymnasium.make(
            self.env_id, disable_env_checker=True, **config.as_arguments(), **view
        )

    def vector(self, config: Any, num_envs: int, **arguments: Any) -> Any:
        """Some environments as one: stepped together by the engine, or one by one where another physics steps them."""
        from codrl_mj.envs.serial import SerialVectorEnv
        from codrl_mj.envs.vector import ActuatedVectorEnv

        arguments = {"max_episode_steps": config.time_limit} | config.as_arguments() | arguments
        human = arguments.get("render_mode") == "human"
        if arguments["physics"] == "mujoco" and not human:
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
        """The name of one of ours, `module:NAME` of somebody's."""
        return reference_of(self.task)

    def code(self, options: Any) -> set[str | Path]:  # noqa: ARG002 - no file is among them
        """The task's module and MJCF file."""
        return {self.task.reward.__module__, asset_path(self.task.asset).resolve()}

    def options(self, given: Any) -> Any:
        """The task's options as its `NamedTuple`."""
        known = self.task.options
        plain = self.changed(given) if isinstance(given, tuple) else options_mapping(given)
        for name, value in plain.items():
            if name not in known._fields:
                has = ", ".join(known._fields) or "none"
                hint = did_you_mean(name, [*known._fields, *self.fields])
                raise UnknownOptionError(
                    f"unknown option {name!r} of {self.name}: {hint}it has {has} (unexpected"
                    f" keyword argument {name!r})"
                )
            plain[name] = value = value.item() if isinstance(value, np.generic) else value
            default = known._field_defaults[name]
            flag, positive = isinstance(default, bool), default > 0
            allowed = isinstance(value, int | float) and (
                flag or (value > 0 if positive else math.isfinite(value))
            )
            if isinstance(value, bool) != flag or not allowed:
                kind = (
                    "True or False" if flag else "a number > 0" if positive else "a finite number"
                )
                raise ValueError(f"{name} = {value!r}: must be {kind}")
        return known(
            **{
                name: value if isinstance(value, bool) else float(value)
                for name, value in plain.items()
            }
        )

    def changed(self, options: Any) -> dict[str, Any]:
        """Those of the options that are not at their defaults."""
        return {
            name: value
            for name, value in options._asdict().items()
            if value != options._field_defaults[name]
        }

    def option_flags(self, config: Any) -> list[tuple[str, Any, str, Any]]:
        """Those of all tasks: another's is refused by its name."""
        kinds: dict[str, Any] = {name: task.options for name, task in TASKS.items()}
        kept = self.changed(config.options)
        return [
            (option, hint | None, f"{task}: {field_docs(kind)[option]}", kept.get(option))
            for task, kind in kinds.items()
            for option, hint in typing.get_type_hints(kind).items()
        ]

    def options_of(self, flags: Mapping[str, Any]) -> dict[str, Any]:
        """Those that were set."""
        return {name: value for name, value in flags.items() if value is not None}

    def actuators(self, given: Any) -> Any:
        """One for each motor, in their order: of a single motor itself, of several a tuple."""
        patterns = patterns_of(given)
        if patterns is not None:
            each = self._by_pattern(patterns)
            given = [each.get(motor, "default") for motor in self.task.motors]
        made = resolve_actuators(given, self.task)
        return made[0] if len(made) == 1 else made

    def _by_pattern(self, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Motor -> what a pattern of the motors' names gives it, as a motor with several."""
        from codrl_mj.engine.specs import match_pattern, split_pattern  # which imports numba

        names, found = [[motor] for motor in self.task.motors], {}
        for pattern, given in patterns.items():
            check_pattern(pattern)
            if len(split_pattern(pattern)) > 1:
                raise ValueError(
                    f"{pattern!r}: {self.task.name} has a motor at each of its joints: give each"
                    " its own"
                )
            for index in match_pattern(pattern, names):
                motor = names[index][0]
                if motor in found:
                    raise ValueError(f"{motor}: {pattern!r} and another pattern match it")
                found[motor] = given
        return found

    def driven(self, kept: Any) -> dict[str, ActuatorModel]:
        """Motor -> actuator."""
        return dict(
            zip(self.task.motors, kept if isinstance(kept, tuple) else (kept,), strict=True)
        )

    def overlaid(self, config: Any, patterns: Mapping[str, Any]) -> dict[str, Any]:
        """Motor -> what drives it: `patterns`, and what a configuration has for others."""
        return {**config.driven, **self._by_pattern(patterns)}

    @property
    def scripted(self) -> Task:
        """The task, if it has one motor."""
        if len(self.task.motors) > 1:
            raise ValueError(
                f"task {self.name!r} has {len(self.task.motors)} motors: there is no scripted"
                " controller; train it with --actuator ideal and name the run, or give time,"
                " torque and speed of each joint as .npz files"
            )
        return self.task

    def as_with_motors(self, config: Any) -> Any:
        """In the engine, with the integration steps that a motor would have."""
        steps = (
            {}
            if config.inner_steps or config.timestep
            else {"inner_steps": self.task.motor_inner_steps}
        )
        return dataclasses.replace(config, physics="mujoco", **steps)

    def action_space(self, config: Any) -> Any:  # noqa: ARG002 - the task's own, whatever it goes through
        """The task's."""
        return self.task.action_space

    def default_agent(self, config: Any) -> str:  # noqa: ARG002
        """The task's; of five of ours the paper's."""
        return str(self.task.agent)

    def view(self, config: Any, width: int, height: int, camera: str | None) -> None:  # noqa: ARG002
        """None: images are drawn from an episode's states."""
        import mujoco

        from codrl_mj.physics.offscreen import check_view

        model = mujoco.MjModel.from_xml_path(str(asset_path(self.task.asset)))
        check_view(model, width, height, camera or "fixed")

    def scene(self, config: Any) -> tuple[Any, Any, str | None]:  # noqa: ARG002 - its look depends on nothing
        """The task's model, with bounds and hills."""
        from codrl_mj.envs.single import ActuatedEnv

        env = ActuatedEnv(self.reference, "ideal")

        def show(state: np.ndarray) -> Any:
            env.physics.show(state)
            return env.data

        return env.model, show, "fixed"

    def state_names(self, config: Any) -> tuple[str, ...]:  # noqa: ARG002
        """The task's."""
        return self.task.state_names

    def interface(self, config: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """By the task's names, and the units of its state and of the actuators' signals and commands."""
        from codrl_mj.envs.commands import command_of
        from codrl_mj.envs.setup import ResolvedEnv

        setup, motors = ResolvedEnv.build(config), config.actuators
        of_sensors = [motors[0].SIGNAL_UNITS.get(name.rpartition(".")[2]) for name in setup.sensors]
        seen = described(
            setup.observation_names,
            setup.observation_space,
            [*self.task.observation_units, *of_sensors],
        )
        driven = [
            self.task.state_names[self.task.qpos[self.task.qvel.index(at)]]
            for at in self.task.speed_indices
        ]
        at_joint = ["N*m" if name.endswith("[rad]") else "N" for name in driven]
        forced = config.action == "force"
        units = at_joint if forced else [command_of(one, config.action).unit for one in motors]
        commands = setup.commands
        if isinstance(commands.action_space, spaces.Box):
            return seen, described(self.task.motors, commands.action_space, units)
        table: Any = commands.action_forces if forced else config.levels
        names = [
            {"name": name, "unit": unit} for name, unit in zip(self.task.motors, units, strict=True)
        ]
        columns = np.reshape(table, (len(table), -1)).T.tolist()
        return seen, [{**one, "levels": levels} for one, levels in zip(names, columns, strict=True)]

    def at_goal(self, episode: Any) -> np.ndarray | None:
        """By the task's goal; where that is to last, the whole of an episode that is not terminated."""
        if self.task.goal is None:
            return np.full(len(episode.state), not episode.terminated)
        return np.asarray(self.task.goal(episode.state.T), dtype=bool)


def claims(name: str) -> bool:
    """Whether a name is that of a task, as on the command line or as Gymnasium has it."""
    return name in TASKS or any(name == task.env_id for task in TASKS.values())


def find(name: Any) -> TaskEnvSource:
    """The world of the task of that name."""
    ours = {task.env_id: task for task in TASKS.values()}
    return TaskEnvSource(ours[name] if name in ours else find_task(name))


@world_of.register
def _(task: Task) -> TaskEnvSource:
    return TaskEnvSource(register(task))
