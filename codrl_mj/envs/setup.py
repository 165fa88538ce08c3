"""A task made ready: its actuators, its options, and what the agent commands and sees. Shared by every face."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, Ideal, check_same_family
from codrl_mj.actuators.noise import LARGEST_KEY
from codrl_mj.disturbances import Disturbances, Joint
from codrl_mj.engine.reading import check_shafts
from codrl_mj.envs.commands import TaskCommands
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.randomization import Draws, Randomization, put_into
from codrl_mj.envs.views import View
from codrl_mj.physics import Physics, Signals
from codrl_mj.physics.base import named_signals
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.registry import find_physics
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import Task, find_task, resolve_actuators


@dataclasses.dataclass(frozen=True)
class Setup:
    """A task, its actuators and its interface to the agent; made by `build`."""

    task: Task
    """The task."""
    actuators: tuple[ActuatorModel, ...]
    """What stands between desired and delivered force, one for each of the task's motors, of one family."""
    inner_steps: int
    """Integration steps per environment step."""
    integrator: str
    """One of the task's integrators."""
    commands: TaskCommands
    """What actions stand for."""
    view: View
    """What the agent gets of states."""
    randomization: Randomization
    """What is drawn at every reset."""
    disturbances: Disturbances
    """Imperfections of the commands' way, and load pulses."""
    joint: Joint
    """What is added to the actuated joints."""

    @classmethod
    def build(cls, config: EnvConfig) -> "Setup":
        """Make an environment's parts, and check what its configuration cannot."""
        task = find_task(config.task)
        steps = task.steps_within(config.actuators[0], config.inner_steps, config.timestep)
        timestep, integrator = task.step_duration / steps, task.integrator(config.integrator)
        commands = TaskCommands.build(task, config.actuators, config.action, config.levels)
        simulated = commands.simulated
        view = View.build(task, config.options, type(simulated[0]), config.observe_actuator)

        bare = bare_model(task.name, config.joint)
        motors = {bare.actuator(name).id: one for name, one in zip(task.motors, simulated, strict=True)}
        drawn, fixed = config.distributions, [commands.fixed] * len(motors)
        randomization = Randomization.build(drawn, bare, motors, fixed, timestep, config.allow_unstable, task.name)

        if not randomization.draws_actuator:  # else every draw is checked
            for one in simulated:
                one.check_at(timestep, config.allow_unstable)
        if any(one.INERTIA for one in simulated):
            model = task_model(task, simulated, timestep, commands.max_forces, joint=config.joint)
            check_shafts(model, config.allow_unstable, held=config.physics == "analytic")
        rest = config.disturbances, config.joint
        return cls(task, config.actuators, steps, integrator, commands, view, randomization, *rest)

    @property
    def arm_radii(self) -> np.ndarray:
        """Of the motors, shape (motors,)."""
        return np.array([one.arm_radius for one in self.actuators])

    @property
    def actuator(self) -> Any:
        """The actuator; with several motors a tuple of them."""
        return alone(self.actuators)

    @functools.cached_property
    def family(self) -> Family:
        """The family of what is simulated."""
        return type(self.commands.simulated[0])

    @functools.cached_property
    def _columns(self) -> tuple[str, ...]:
        return ("desired_force", "actual_force", *self.family.Signals._fields)

    def signals(self, columns: Sequence[Any], desired: Any) -> Signals:
        """A trace's columns, numbers or arrays, as signals: the force [N or N*m] that the agent `desired` is theirs.

        Where an actuator tracks no force, what was delivered counts as desired.
        """
        signals = named_signals(self._columns, columns)
        signals["desired_force"] = desired if self.commands.tracks else signals["actual_force"]
        return signals

    def simulate(self, physics: str) -> Physics:
        """A new simulation on the given physics."""
        made = find_physics(physics)(
            self.task,
            self.commands.simulated,
            self.inner_steps,
            self.integrator,
            max_forces=self.commands.max_forces,
            disturbances=self.disturbances,
            joint=self.joint,
        )
        if made.scene is None and self.randomization.variation is not None:
            names = ", ".join(self.randomization.in_model)
            raise ValueError(
                f"physics = {physics!r}: cannot draw {names}: Gymnasium's environments share no names for masses, "
                "lengths and gravity, and have no damping, friction and rotors; use physics='mujoco'"
            )
        return made

    def draws(self, physics: Physics) -> Draws:
        """What a simulation is drawn with."""
        return Draws(self.randomization, [self.commands.simulated], functools.partial(put_into, physics))

    def start(
        self, physics: Physics, generator: np.random.Generator, options: dict[str, Any] | None, draws: Draws
    ) -> None:
        """Start an episode: draw the initial state and then, if anything is randomised, actuator and model.

        Disturbances and sensors that are random draw the key of their numbers last.
        """
        initial = self.task.initial(generator, options)
        draws.draw(lambda rows, count: generator.random((len(rows), count)), np.zeros(1, dtype=int))
        physics.reset(initial, float(self.keys(lambda count: generator.random((1, count)))[0]))

    @functools.cached_property
    def initial_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`Task.bounds` without reset options."""
        return self.task.bounds(None)

    @functools.cached_property
    def random(self) -> bool:
        """Whether an episode's disturbances or sensors need a key."""
        drawn = self.randomization.random
        return self.disturbances.random or drawn or any(one.random for one in self.commands.simulated)

    def keys(self, random: Callable[[int], np.ndarray]) -> np.ndarray:
        """Keys of the random numbers of m episodes' disturbances and sensors, shape (m,); 0 where none is needed.

        They come of `random`: (count) -> numbers uniform in [0, 1), shape (m, count).
        """
        if not self.random:
            return np.zeros(1)
        return random(1)[:, 0] * LARGEST_KEY  # a multiple of 2**-53 times 2**53: a whole number, exactly


def alone(several: Sequence[Any]) -> Any:
    """The only one of several, or all of them as a tuple."""
    return several[0] if len(several) == 1 else tuple(several)


def one_for_each(actuator: Any, task: str) -> bool:
    """Whether it is a sequence of what each environment gets, and not what all get: such as one for each motor."""
    listed = isinstance(actuator, Sequence) and not isinstance(actuator, str)
    return listed and (len(find_task(task).motors) == 1 or all(isinstance(one, list | tuple) for one in actuator))


def set_up_many(
    num_envs: int, task: str, actuator: Any, arguments: Mapping[str, Any]
) -> tuple[Setup, list[tuple[ActuatorModel, ...]]]:
    """The set-up that many environments share, and the actuators to simulate, a tuple for each environment."""
    if not one_for_each(actuator, task):
        setup = Setup.build(EnvConfig.of(task, actuator, arguments))
        return setup, [setup.commands.simulated] * num_envs
    if len(actuator) != num_envs:
        raise ValueError(f"actuator: {len(actuator)} actuators for {num_envs} environments: there must be one for each")
    if arguments.get("action", "force") != "force":
        raise ValueError(f"action = {arguments['action']!r}: with an actuator for each environment only 'force'")
    setups: dict[Any, Setup] = {}
    every: list[tuple[ActuatorModel, ...]] = []
    for index, one in enumerate(actuator):
        try:
            every.append(resolve_actuators(one, find_task(task)))
            if every[-1] not in setups:
                setups[every[-1]] = Setup.build(EnvConfig.of(task, every[-1], arguments))
        except ValueError as error:
            raise ValueError(f"actuator[{index}]: {error}") from None
        if isinstance(every[-1][0], Ideal):
            raise ValueError(f"actuator[{index}] = {one!r}: must be an Actuator; the ideal one cannot be among others")
    check_same_family([setup.actuators[0] for setup in setups.values()])
    return dataclasses.replace(setups[every[0]]), every
