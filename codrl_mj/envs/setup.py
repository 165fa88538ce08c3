"""Everything derived from an `EnvConfig`; shared by all environment classes."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Ideal, check_same_family
from codrl_mj.boundary import Argument
from codrl_mj.disturbances import check_delay
from codrl_mj.engine.reading import check_shafts
from codrl_mj.envs.bank import extend_space, needs_key, sensor_names
from codrl_mj.envs.commands import TaskCommands
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.randomization import Randomization, check_extremes
from codrl_mj.physics import PHYSICS, Physics, SimulationConfig
from codrl_mj.physics.base import Force
from codrl_mj.physics.compiled_task import Outcomes, compiled_outcomes
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import Task, find_task
from codrl_mj.user_code import look_up

NEEDS_KEY, FIRST_OPTION = 0, 1
"""Indices in `ResolvedEnv.options` of the flag `needs_key` and of the task's first option."""


@dataclasses.dataclass(frozen=True, eq=False)
class ResolvedEnv:
    """Resolved configuration of a task's environment; `build` creates it.

    Derived quantities are computed from the fields on first use. `dataclasses.replace` with a
    changed task, for example after an attribute was written, therefore updates all of them.
    """

    config: EnvConfig
    """Configuration that the user gave."""
    task: Task
    """The task, with the current values of its attributes."""
    inner_steps: int
    """Integration steps per environment step."""

    @classmethod
    def build(cls, config: EnvConfig) -> "ResolvedEnv":
        """Resolve a configuration; raise if its fields contradict each other."""
        task = find_task(config.task)
        setup = cls(
            config,
            task,
            task.num_inner_steps(config.actuators[0], config.inner_steps, config.timestep),
        )
        setup._check()
        return setup

    def _check(self) -> None:
        """Raise if fields contradict each other, or if motors are unstable with their joints."""
        simulation, allow_unstable = self.simulation, self.config.allow_unstable
        check_delay(self.config.disturbances, self.task.step_duration, self.config.time_limit)
        # The property raises if there is nothing to observe.
        _ = self.sensors
        # A randomized actuator is checked at every draw instead.
        if not self.randomization.draws_actuator:
            for actuator in simulation.actuators:
                actuator.check_at(simulation.timestep, allow_unstable)
        if any(actuator.closes_loops for actuator in simulation.actuators):
            model, is_analytic, is_explicit = (
                task_model(simulation),
                self.config.physics == "analytic",
                simulation.integrator == "euler",
            )
            motors = {
                model.actuator(name).id: actuator
                for name, actuator in zip(self.task.motors, simulation.actuators, strict=True)
            }
            check_shafts(model, allow_unstable, is_analytic, motors, is_explicit)
            if not allow_unstable:
                check_extremes(self.randomization, motors, model, is_analytic, is_explicit)

    @functools.cached_property
    def commands(self) -> TaskCommands:
        """Conversion from actions to forces."""
        return TaskCommands(
            self.task, self.config.actuators, self.config.action, self.config.levels
        )

    @functools.cached_property
    def simulation(self) -> SimulationConfig:
        """Settings of the simulation."""
        integrator, commands = self.task.integrator(self.config.integrator), self.commands
        further_settings = (
            commands.max_forces,
            self.config.disturbances,
            self.config.joint,
            commands.force_per_position,
            self.config.options,
        )
        return SimulationConfig(
            self.task, commands.simulated, self.inner_steps, integrator, *further_settings
        )

    @functools.cached_property
    def randomization(self) -> Randomization:
        """Distributions of the fields that are drawn at every reset."""
        simulation, config = self.simulation, self.config
        # The task's model with ideal actuators; `simulate` compiles the one with the motors.
        model = bare_model(self.task.name, config.joint, config.options)
        motors = {
            model.actuator(name).id: actuator
            for name, actuator in zip(self.task.motors, simulation.actuators, strict=True)
        }
        fixed = [self.commands.fixed] * len(motors)
        return Randomization(
            config.distributions,
            model,
            motors,
            fixed,
            simulation.timestep,
            config.allow_unstable,
            self.task.name,
        )

    # -- simulations ---------------------------------------------------------------------

    def simulate(self) -> Physics:
        """Create a simulation."""
        physics_name = self.config.physics
        physics: Physics = look_up(physics_name, PHYSICS, "physics", allow_user_code=False)(
            self.simulation
        )
        if physics.scene is None and self.randomization.variation is not None:
            names = ", ".join(self.randomization.model_paths)
            raise ValueError(
                f"physics = {physics_name!r}: cannot draw {names}: Gymnasium's environments have no"
                " common names for masses, lengths and gravity, and no damping, friction and"
                " rotors; use physics='mujoco'"
            )
        return physics

    @functools.cached_property
    def initial_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`Task.bounds` without reset options."""
        return self.task.bounds(None)

    @functools.cached_property
    def options(self) -> np.ndarray:
        """Vector that compiled code reads: 1 or 0 for `needs_key`, then the task's options."""
        return np.array([self.needs_key, *self.config.options], dtype=np.float64)

    @functools.cached_property
    def needs_key(self) -> bool:
        """True if an episode's disturbances or sensors need a random key."""
        return needs_key(self.simulation.actuators, self.config.disturbances, self.randomization)

    # -- observations and rewards of the agent --------------------------------------------

    @functools.cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors at the end of observations; empty without `observe_actuator`."""
        names = self.task.motors if len(self.task.motors) > 1 else ("",)
        return (
            sensor_names(dict.fromkeys(names, self.simulation.family))
            if self.config.observe_actuator
            else ()
        )

    @property
    def observation_space(self) -> spaces.Box:
        """Observation space of the task, with unbounded entries for the sensors."""
        space = self.task.observation_space
        return extend_space(space, len(self.sensors)) if self.sensors else space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's entries, in order."""
        return (*self.task.observation_names, *self.sensors)

    @functools.cached_property
    def _outcomes(self) -> tuple[Outcomes, np.ndarray]:
        """The task's compiled functions, and its options as a vector."""
        return compiled_outcomes(self.task), np.array(self.config.options, dtype=np.float64)

    def observation(self, state: np.ndarray) -> np.ndarray:
        """Return the task's observation of a mechanical state, (k,), float32, without sensors."""
        observation = np.empty(len(self.task.observation_names), np.float32)
        self._outcomes[0].observe(np.ascontiguousarray(state), observation)
        return observation

    def outcome(self, before: np.ndarray, force: Force, after: np.ndarray) -> tuple[float, bool]:
        """Return reward and termination of a step between two states under forces [N or N*m]."""
        outcomes, options = self._outcomes
        before, after = np.ascontiguousarray(before), np.ascontiguousarray(after)
        forces = np.ascontiguousarray(force, dtype=np.float64).reshape(-1)
        reward = outcomes.reward(before, forces if len(forces) > 1 else forces[0], after, options)
        return float(reward), bool(outcomes.terminated(after))


_Item = TypeVar("_Item")


def unwrap_single(values: Sequence[_Item]) -> _Item | tuple[_Item, ...]:
    """Return the only element of a sequence, or the whole sequence as a tuple."""
    return values[0] if len(values) == 1 else tuple(values)


def task_config(
    task: str | EnvConfig, actuator: object, arguments: Mapping[str, Argument]
) -> EnvConfig:
    """Return the configuration that keyword arguments of a task's environment describe.

    Raises:
        UnknownOptionError: an argument is neither a field nor an option.
        ValueError: as for `EnvConfig`; or the environment is no task.
    """
    if "max_episode_steps" in arguments:
        raise ValueError(
            f"max_episode_steps = {arguments['max_episode_steps']!r}: the environment itself has no"
            " time limit: use codrl_mj.make or gymnasium.make, which add one"
        )
    config, remaining = EnvConfig.of(task, actuator, arguments)
    if config.source.task is None:
        raise ValueError(f"task = {config.task!r}: must be a task; use codrl_mj.make for others")
    if remaining:
        # The source's check of options names the unknown one, and those that exist.
        config.source.options(remaining)
    return config


def is_per_environment(actuator: Argument, task: Task) -> bool:
    """Return True if `actuator` is a list with one actuator per environment, not per motor."""
    is_listed = isinstance(actuator, Sequence) and not isinstance(actuator, str)
    return is_listed and (
        len(task.motors) == 1
        or all(isinstance(env_actuator, list | tuple) for env_actuator in actuator)
    )


def configs_per_environment(
    config: EnvConfig, num_envs: int, actuator: Argument
) -> list[EnvConfig]:
    """Return the configuration of each of many environments.

    Args:
        config: configuration of all of them.
        num_envs: number of environments.
        actuator: one actuator for all of them, a list with one for each, or None for the
            configuration's.

    Raises:
        ValueError: the list has another length, or an actuator is unknown or out of bounds.
    """
    task = find_task(config.task)
    if not is_per_environment(actuator, task):
        return [
            config if actuator is None else config.override({"actuator": actuator})[0]
        ] * num_envs
    if len(actuator) != num_envs:
        raise ValueError(
            f"actuator: got {len(actuator)} actuators for {num_envs} environments; give one for"
            " each environment"
        )
    configs = []
    for index, env_actuator in enumerate(actuator):
        try:
            configs.append(dataclasses.replace(config, actuator=env_actuator))
        except ValueError as error:
            raise ValueError(f"actuator[{index}]: {error}") from None
    return configs


def set_up_many(
    config: EnvConfig, num_envs: int, actuator: Argument
) -> tuple[ResolvedEnv, list[tuple[ActuatorModel, ...]]]:
    """Return the setup that many environments share, and the actuators of each of them.

    The arguments are those of `configs_per_environment`.
    """
    configs = configs_per_environment(config, num_envs, actuator)
    if not is_per_environment(actuator, find_task(config.task)):
        setup = ResolvedEnv.build(configs[0])
        return setup, [setup.commands.simulated] * num_envs
    if config.action != "force":
        raise ValueError(
            f"action = {config.action!r}: must be 'force' with one actuator per environment"
        )
    setups: dict[tuple[ActuatorModel, ...], ResolvedEnv] = {}
    for index, env_config in enumerate(configs):
        try:
            if env_config.actuators not in setups:
                setups[env_config.actuators] = ResolvedEnv.build(env_config)
        except ValueError as error:
            raise ValueError(f"actuator[{index}]: {error}") from None
        if isinstance(env_config.actuators[0], Ideal):
            raise ValueError(
                f"actuator[{index}] = {actuator[index]!r}: must not be ideal: environments with and"
                " without motors cannot be combined"
            )
    check_same_family([motor_actuators[0] for motor_actuators in setups])
    return setups[configs[0].actuators], [env_config.actuators for env_config in configs]
