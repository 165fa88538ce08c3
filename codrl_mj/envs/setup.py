"""A task made ready: all that follows from an environment's configuration, in one place. Shared by every face."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Ideal, check_same_family
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.disturbances import check_delay
from codrl_mj.engine.reading import check_shafts
from codrl_mj.envs.commands import TaskCommands
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.motors import longer, sensor_names
from codrl_mj.envs.randomization import Randomization, check_extremes
from codrl_mj.physics import PHYSICS, Physics, Signals, SimulationConfig, trace_names
from codrl_mj.physics.base import make_info_reader
from codrl_mj.physics.compiled_task import Outcomes, compiled_outcomes
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import Task, find_task
from codrl_mj.user_code import look_up

NEEDS_KEY, FIRST_OPTION = 0, 1
"""In `ResolvedEnv.options`: whether an episode needs a key, and the first of the task's options."""


@dataclasses.dataclass(frozen=True, eq=False)
class ResolvedEnv:
    """An environment of a task as its configuration says; made by `build`.

    It holds nothing twice: what follows from the fields is computed where it is first asked for.
    With another task, of which attributes were written, all of it is that task's.
    """

    config: EnvConfig
    """What was asked for."""
    task: Task
    """The task."""
    inner_steps: int
    """Integration steps per environment step."""

    @classmethod
    def build(cls, config: EnvConfig) -> "ResolvedEnv":
        """The set-up of a configuration, checked for what its fields do not show one by one."""
        task = find_task(config.task)
        made = cls(
            config,
            task,
            task.steps_within(config.actuators[0], config.inner_steps, config.timestep),
        )
        made._check()
        return made

    def _check(self) -> None:
        """Refuse what does not go together: with each other, with the step, with what the motors move."""
        plant, unstable = self.plant, self.config.allow_unstable
        check_delay(self.config.disturbances, self.task.step_duration, self.config.time_limit)
        _ = self.sensors  # which are refused where there is nothing to observe
        if not self.randomization.draws_actuator:  # else every draw is checked
            for one in plant.actuators:
                one.check_at(plant.timestep, unstable)
        if any(one.closes_loops for one in plant.actuators):
            model, held, explicit = (
                task_model(plant),
                self.config.physics == "analytic",
                plant.integrator == "euler",
            )
            motors = {
                model.actuator(name).id: one
                for name, one in zip(self.task.motors, plant.actuators, strict=True)
            }
            check_shafts(model, unstable, held, motors, explicit)
            if not unstable:
                check_extremes(self.randomization, motors, model, held, explicit)

    @functools.cached_property
    def commands(self) -> TaskCommands:
        """What actions stand for."""
        return TaskCommands(
            self.task, self.config.actuators, self.config.action, self.config.levels
        )

    @functools.cached_property
    def plant(self) -> SimulationConfig:
        """What is simulated."""
        integrator, commands = self.task.integrator(self.config.integrator), self.commands
        between = commands.max_forces, self.config.disturbances, self.config.joint, commands.holds
        return SimulationConfig(
            self.task, commands.simulated, self.inner_steps, integrator, *between
        )

    @functools.cached_property
    def randomization(self) -> Randomization:
        """What is drawn at every reset."""
        plant, config = self.plant, self.config
        bare = bare_model(self.task.name, config.joint)
        motors = {
            bare.actuator(name).id: one
            for name, one in zip(self.task.motors, plant.actuators, strict=True)
        }
        fixed = [self.commands.fixed] * len(motors)
        return Randomization(
            config.distributions,
            bare,
            motors,
            fixed,
            plant.timestep,
            config.allow_unstable,
            self.task.name,
        )

    # -- simulations -----------------------------------------------------------------------------------------

    def simulate(self) -> Physics:
        """A new simulation."""
        physics = self.config.physics
        made: Physics = look_up(physics, PHYSICS, "physics", anybodys=False)(self.plant)
        if made.scene is None and self.randomization.variation is not None:
            names = ", ".join(self.randomization.in_model)
            raise ValueError(
                f"physics = {physics!r}: cannot draw {names}: Gymnasium's environments share no"
                " names for masses, lengths and gravity, and have no damping, friction and rotors;"
                " use physics='mujoco'"
            )
        return made

    @functools.cached_property
    def initial_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`Task.bounds` without reset options."""
        return self.task.bounds(None)

    @functools.cached_property
    def options(self) -> np.ndarray:
        """What compiled code reads: whether episodes need keys, and the task's options."""
        return np.array([self.random, *self.config.options], dtype=np.float64)

    @functools.cached_property
    def random(self) -> bool:
        """Whether an episode's disturbances or sensors need a key."""
        drawn = self.config.disturbances.random or self.randomization.random
        return drawn or any(one.random for one in self.plant.actuators)

    def keys(self, random: Callable[[int], np.ndarray]) -> np.ndarray:
        """Keys of the random numbers of m episodes' disturbances and sensors, shape (m,); one 0 where none is needed.

        They come of `random`: (count) -> numbers uniform in [0, 1), shape (m, count).
        """
        if not self.random:
            return np.zeros(1)
        return (
            random(1)[:, 0] * MAX_KEY
        )  # a multiple of 2**-53 times 2**53: a whole number, exactly

    # -- what the agent gets of them -------------------------------------------------------------------------

    @functools.cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of what the actuators' sensors add to an observation; none if they are not observed."""
        names = self.task.motors if len(self.task.motors) > 1 else ("",)
        return (
            sensor_names(dict.fromkeys(names, self.plant.family))
            if self.config.observe_actuator
            else ()
        )

    @property
    def observation_space(self) -> spaces.Box:
        """The task's observation space, with unbounded entries for the sensors."""
        space = self.task.observation_space
        return longer(space, len(self.sensors)) if self.sensors else space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        return (*self.task.observation_names, *self.sensors)

    @functools.cached_property
    def _outcomes(self) -> tuple[Outcomes, np.ndarray]:
        """The task's compiled functions, and its options as a vector."""
        return compiled_outcomes(self.task), np.array(self.config.options, dtype=np.float64)

    def observation(self, physics: Physics, row: np.ndarray | None = None) -> np.ndarray:
        """What the agent sees of a simulation, shape (k,), float32, after the last `row` of its trace, if any."""
        size = len(self.task.observation_names)
        observation = np.empty(size + len(self.sensors), np.float32)
        self._outcomes[0].observe(np.ascontiguousarray(physics.state), observation)
        if self.sensors:
            row = np.zeros_like(physics.trace[-1]) if row is None else row
            observation[size:] = physics.read_sensors(row).reshape(-1)
        return observation

    def outcome(self, before: np.ndarray, force: Any, after: np.ndarray) -> tuple[float, bool]:
        """The reward of a step from one state to another under a force [N or N*m], or several; whether that ends it."""
        outcomes, options = self._outcomes
        before, after = np.ascontiguousarray(before), np.ascontiguousarray(after)
        forces = np.ascontiguousarray(force, dtype=np.float64).reshape(-1)
        reward = outcomes.reward(before, forces if len(forces) > 1 else forces[0], after, options)
        return float(reward), bool(outcomes.terminated(after))

    @functools.cached_property
    def _named(self) -> Callable[[Any], Signals]:
        return make_info_reader(trace_names(self.plant.family)[:-1])

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: value for name, value in self.__dict__.items() if name != "_named"
        }  # which nothing pickles

    def signals(self, columns: Sequence[Any] | np.ndarray, desired: Any) -> Signals:
        """A trace's columns, numbers or arrays, as signals: the force [N or N*m] that the agent `desired` is theirs.

        Where an actuator tracks no force, what was delivered counts as desired.
        """
        signals = self._named(columns)
        signals["desired_force"] = desired if self.commands.tracks else signals["actual_force"]
        return signals


def alone(several: Sequence[Any]) -> Any:
    """The only one of several, or all of them as a tuple."""
    return several[0] if len(several) == 1 else tuple(several)


def one_for_each(actuator: Any, task: str) -> bool:
    """Whether it is a sequence of what each environment gets, and not what all get: such as one for each motor."""
    listed = isinstance(actuator, Sequence) and not isinstance(actuator, str)
    return listed and (
        len(find_task(task).motors) == 1 or all(isinstance(one, list | tuple) for one in actuator)
    )


def set_up_many(
    num_envs: int, task: str, actuator: Any, arguments: Mapping[str, Any]
) -> tuple[ResolvedEnv, list[tuple[ActuatorModel, ...]]]:
    """The set-up that many environments share, and the actuators to simulate, a tuple for each environment."""
    if not one_for_each(actuator, task):
        setup = ResolvedEnv.build(EnvConfig.of(task, actuator, arguments))
        return setup, [setup.commands.simulated] * num_envs
    if len(actuator) != num_envs:
        raise ValueError(
            f"actuator: {len(actuator)} actuators for {num_envs} environments: there must be one"
            " for each"
        )
    if arguments.get("action", "force") != "force":
        raise ValueError(
            f"action = {arguments['action']!r}: with an actuator for each environment only 'force'"
        )
    setups: dict[Any, ResolvedEnv] = {}
    every: list[tuple[ActuatorModel, ...]] = []
    for index, one in enumerate(actuator):
        try:
            config = EnvConfig.of(task, one, arguments)
            every.append(config.actuators)
            if every[-1] not in setups:
                setups[every[-1]] = ResolvedEnv.build(config)
        except ValueError as error:
            raise ValueError(f"actuator[{index}]: {error}") from None
        if isinstance(every[-1][0], Ideal):
            raise ValueError(
                f"actuator[{index}] = {one!r}: must be an Actuator; the ideal one cannot be among"
                " others"
            )
    check_same_family([each[0] for each in setups])
    return setups[every[0]], every
