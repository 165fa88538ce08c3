"""Tasks as env sources: their fields and options, and the construction of their environments."""

import functools
import math
import typing
from collections.abc import Mapping
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import Argument, Info, Options
from codrl_mj.envs.config import (
    COMMON_FIELDS,
    SOURCE_KINDS,
    Env,
    EnvConfig,
    EnvSource,
    SourceKind,
    Space,
    StoredActuators,
    VecEnv,
    options_mapping,
)
from codrl_mj.envs.patterns import pattern_mapping
from codrl_mj.envs.registration import register
from codrl_mj.fields import check_pattern, did_you_mean
from codrl_mj.tasks import TASKS, Task, find_task, reference_of, resolve_actuators
from codrl_mj.tasks.base import OptionBounds
from codrl_mj.tasks.base import Options as TaskOptions
from codrl_mj.user_code import asset_path

_NOT_OPTIONS = ("render_mode", "width", "height", "camera", "pretty", "disable_env_checker")
"""Arguments of `gymnasium.make` and of an environment's rendering, which are no options."""


def _check_option(option_type: type[TaskOptions], name: str, value: Argument) -> None:
    """Raise if a value is out of an option's bounds; see `Task.options`."""
    default = option_type._field_defaults[name]
    hints = typing.get_type_hints(option_type, include_extras=True)
    bounds: OptionBounds | None = next(
        (
            entry
            for entry in getattr(hints[name], "__metadata__", ())
            if isinstance(entry, OptionBounds)
        ),
        None,
    )
    if isinstance(default, bool):
        is_allowed, expected = isinstance(value, bool), "True or False"
    else:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if bounds is not None:
            sign = ">" if bounds.is_excluded else ">="
            expected = f"a finite number {sign} {bounds.minimum:g} [{bounds.unit}]"
            is_allowed = (
                is_number
                and math.isfinite(value)
                and (value > bounds.minimum if bounds.is_excluded else value >= bounds.minimum)
            )
        elif default > 0:
            is_allowed, expected = is_number and value > 0, "a number > 0"
        else:
            is_allowed, expected = is_number and math.isfinite(value), "a finite number"
    if not is_allowed:
        raise ValueError(f"{name} = {value!r}: must be {expected}")


class UnknownOptionError(ValueError, TypeError):
    """Unknown option of an environment; also the TypeError that Python and TorchRL expect."""


class TaskEnvSource(EnvSource):
    """Env source of one task, built-in or custom."""

    fields = (*COMMON_FIELDS, "physics", "integrator", "inner_steps", "timestep", "levels", "joint")
    task: Task

    def __init__(self, task: Task) -> None:
        """Take the attributes of the task."""
        self.task, self.name, self.option_names = task, task.name, task.options._fields
        self.time_limit, self.paper = task.max_episode_steps, tuple(task.paper)
        self.default_actuator = task.default_actuator

    @property
    def reference(self) -> str:
        """Name of a built-in task, `module:NAME` of a custom one."""
        return reference_of(self.task)

    def make(self, config: EnvConfig, **arguments: Argument) -> Env:
        """Make an environment with `gymnasium.make`.

        The arguments are those of `gymnasium.make` and of `codrl_mj.envs.ActuatedEnv`.
        """
        if unknown := {name: arguments[name] for name in arguments if name not in _NOT_OPTIONS}:
            # Gymnasium would append all arguments to the error of the class.
            self.options(unknown)
        limit: dict[str, Argument] = {
            "max_episode_steps": config.time_limit,
            "disable_env_checker": True,
        }
        env: Env = gymnasium.make(self.task.env_id, task=config, **(limit | arguments))
        return env

    def make_vec(self, config: EnvConfig, num_envs: int, **arguments: Argument) -> VecEnv:
        """Make a vector environment: a batch on MuJoCo, otherwise stepped one by one."""
        from codrl_mj.envs.serial import SerialVectorEnv
        from codrl_mj.envs.setup import configs_per_environment
        from codrl_mj.envs.single import ActuatedEnv
        from codrl_mj.envs.vector import ActuatedVectorEnv, check_counts

        limit, is_human = config.time_limit, arguments.get("render_mode") == "human"
        if config.physics == "mujoco" and not is_human:
            settings: dict[str, Argument] = {
                "autoreset_mode": AutoresetMode.SAME_STEP,
                "max_episode_steps": limit,
            }
            return ActuatedVectorEnv(num_envs, config, **(settings | arguments))
        if config.physics == "mujoco":
            gymnasium.logger.warn(
                f"render_mode = 'human': {num_envs} environments of {self.name} are stepped one by"
                " one, which is slow; batches render with 'rgb_array'"
            )
        check_counts(num_envs, limit)
        configs = configs_per_environment(config, num_envs, arguments.pop("actuator", None))
        env_functions = [functools.partial(ActuatedEnv, config) for config in configs]
        return SerialVectorEnv(num_envs, env_functions, limit, **arguments)

    def action_space(self, config: EnvConfig) -> Space:  # noqa: ARG002
        """Return the task's action space, which is the same with any actuator."""
        return self.task.action_space

    def code(self, options: Options) -> set[str | Path]:  # noqa: ARG002 - options contain no files
        """Return the task's module and MJCF file."""
        return {self.task.reward.__module__, asset_path(self.task.asset).resolve()}

    def options(self, values: Options) -> Options:
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
            _check_option(option_type, name, value)
        return option_type(
            **{
                name: value if isinstance(value, bool) else float(value)
                for name, value in options.items()
            }
        )

    def non_default_options(self, options: Options) -> Info:
        """Return the options that differ from their defaults."""
        return {
            name: value
            for name, value in options._asdict().items()
            if value != options._field_defaults[name]
        }

    def actuators(self, actuator: Argument) -> ActuatorModel | tuple[ActuatorModel, ...]:
        """Return the actuator of a single motor, or a tuple with those of several, in order."""
        patterns = pattern_mapping(actuator)
        if patterns is not None:
            actuators_by_motor = self._by_pattern(patterns)
            actuator = [actuators_by_motor.get(motor, "default") for motor in self.task.motors]
        actuators = resolve_actuators(actuator, self.task)
        return actuators[0] if len(actuators) == 1 else actuators

    def _by_pattern(self, patterns: Mapping[str, object]) -> Info:
        """Return motor -> actuator, from a mapping of patterns of motor names to actuators."""
        # A local import, because the module imports numba, which takes long.
        from codrl_mj.engine.matching import match_pattern, split_pattern

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

    def override_actuators(self, config: EnvConfig, patterns: Mapping[str, object]) -> Info:
        """Return motor -> actuator: those of `patterns`, and the configuration's for the rest."""
        return {**config.actuators_by_name, **self._by_pattern(patterns)}

    def actuators_by_name(self, actuators: StoredActuators) -> dict[str, ActuatorModel]:
        """Return motor -> actuator."""
        assert not isinstance(actuators, Mapping)
        motors = actuators if isinstance(actuators, tuple) else (actuators,)
        return dict(zip(self.task.motors, motors, strict=True))


def _wrap(target: object, name: str | None) -> TaskEnvSource | None:  # noqa: ARG001 - see SourceKind
    """Return the source of a task, which is registered; None for other objects."""
    return TaskEnvSource(register(target)) if isinstance(target, Task) else None


def _find(name: str) -> TaskEnvSource:
    """Return the source of the task with a name or Gymnasium id."""
    tasks_by_id = {task.env_id: task for task in TASKS.values()}
    return TaskEnvSource(tasks_by_id[name] if name in tasks_by_id else find_task(name))


def _claims(name: str) -> bool:
    """Return True if this is a task's name or Gymnasium id."""
    return name in TASKS or any(name == task.env_id for task in TASKS.values())


SOURCE_KINDS.append(SourceKind(_claims, _find, _wrap))
