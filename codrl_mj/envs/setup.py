"""A task made ready: its actuator, its options, and what the agent commands and sees. Shared by every face."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.disturbances import OFF, Disturbances, resolve_disturbances
from codrl_mj.envs.distributions import Distribution
from codrl_mj.envs.outcomes import Outcomes, compiled_outcomes
from codrl_mj.envs.randomization import Randomization, nominal_parameters
from codrl_mj.motor import Actuator, CurrentLoop, check_stable, resolve
from codrl_mj.motor.noise import LARGEST_KEY
from codrl_mj.physics import PHYSICS, AnalyticPhysics, MujocoPhysics, Physics, Signals
from codrl_mj.physics.base import check_integrator, ideal_signals, inner_step_count
from codrl_mj.tasks import Task, find_task

COMMANDS = ("force", "current", "voltage")
"""What an agent's action can stand for."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """A task, its actuator and its interface to the agent; made by `build`."""

    task: Task
    """The task."""
    actuator: Actuator | None
    """What stands between desired and delivered force; None is the ideal actuator."""
    options: Any
    """The task's options."""
    inner_steps: int
    """Integration steps per environment step."""
    integrator: str
    """One of the task's integrators."""
    command: str
    """What an action stands for: one of `COMMANDS`."""
    levels: np.ndarray | None
    """Commands [A or V] that a discrete task's actions choose from; None where the action is the command."""
    observe_actuator: bool
    """Whether the observation ends with measured and reference current."""
    randomization: Randomization | None = None
    """What is drawn at every reset; None if nothing is."""
    disturbances: Disturbances = OFF
    """Imperfections of drive, sensor, supply and joint, and load pulses."""

    @classmethod
    def build(
        cls,
        task: str,
        actuator: str | Actuator | Mapping[str, Any] | None = "paper",
        integrator: str | None = None,
        inner_steps: int | None = None,
        timestep: float | None = None,
        allow_unstable: bool = False,
        action: str = "force",
        levels: Sequence[float] | None = None,
        observe_actuator: bool = False,
        randomize: Mapping[str, Distribution] | None = None,
        disturbances: Disturbances | Mapping[str, Any] | None = None,
        **options: float,
    ) -> "Setup":
        """Resolve and check the arguments of an environment; `codrl_mj.envs.ActuatedEnv` says what they are.

        Raises:
            ValueError: an argument is unknown, out of bounds, or does not go with another; or the loop is unstable.
        """
        definition = find_task(task)
        resolved = resolve(actuator, definition.name)
        count = inner_step_count(definition, resolved, inner_steps, timestep)
        if resolved is None and observe_actuator:
            raise ValueError("observe_actuator=True: the ideal actuator has no current to observe; choose another")
        timestep = definition.step_duration / count
        described = _disturbances(disturbances, resolved, timestep, allow_unstable)
        randomization = None
        if randomize is not None:
            randomization = Randomization.build(
                randomize, definition.name, resolved, action, timestep, allow_unstable, described.supply_resistance
            )
        setup = cls(
            task=definition,
            actuator=resolved,
            options=_options(definition, options),
            inner_steps=count,
            integrator=check_integrator(definition, integrator),
            command=action,
            levels=_levels(definition, resolved, action, levels),
            observe_actuator=observe_actuator,
            randomization=randomization,
            disturbances=described,
        )
        if setup.disturbances.joint_damping and any("model.damping." in name for name in randomize or ()):
            raise ValueError(
                f"disturbances: joint_damping = {setup.disturbances.joint_damping:g}: give either it or a distribution "
                "of the joint's model.damping, not both"
            )
        drawn = randomization is not None and randomization.draws_actuator  # then every draw is checked
        if setup.physical_actuator is not None and not allow_unstable and not drawn:
            check_stable(setup.physical_actuator, timestep)
        return setup

    def simulate(self, physics: str) -> Physics:
        """A new simulation on the given physics.

        Raises:
            ValueError: unknown physics.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        arguments = self.task, self.physical_actuator, self.inner_steps, self.integrator
        if physics == "mujoco":
            return MujocoPhysics(*arguments, max_force=self.max_force, disturbances=self.disturbances)
        if physics == "analytic":
            if self.randomization is not None and self.randomization.variation is not None:
                names = ", ".join(self.randomization.variation.names)
                raise ValueError(
                    f"physics = 'analytic': cannot draw {names}: Gymnasium's environments share no names for masses, "
                    "lengths and gravity, and have no damping; use physics='mujoco'"
                )
            return AnalyticPhysics(*arguments, max_force=self.max_force, disturbances=self.disturbances)
        raise ValueError(f"physics = {physics!r}: must be one of {', '.join(PHYSICS)}")

    def start(
        self, physics: Physics, generator: np.random.Generator, options: dict[str, Any] | None
    ) -> tuple[Actuator | None, dict[str, Any]]:
        """Start an episode: draw the initial state and then, if anything is randomised, actuator and model.

        Disturbances that are random draw the key of their numbers last.

        Args:
            physics: what `simulate` returned.
            generator: draws both.
            options: reset options of the task.

        Returns:
            The episode's actuator, and what `info` says of the draw; empty if nothing is randomised.

        Raises:
            ValueError: no stable current loop was drawn.
        """
        initial = self.task.initial(generator, options)
        actuator, info = self.actuator, {}
        if self.randomization is not None:
            physical = self.physical_actuator
            nominal, arms = nominal_parameters([] if physical is None else [physical])
            values, rejected = self.randomization.draw(
                lambda rows, count: generator.random((len(rows), count)), nominal, arms
            )
            actuator = self.vary(physics, values[0])
            info = {"randomization": self.randomization.report(values[0], rejected[0])}
        physics.reset(initial, float(self.keys(lambda count: generator.random((1, count)))[0]))
        return actuator, info

    def vary(self, physics: Physics, values: np.ndarray) -> Actuator | None:
        """Give a simulation what was drawn; to be followed by a reset, or a restoring of its state.

        Args:
            physics: what `simulate` returned.
            values: of the fields that are randomised, shape (k,).

        Returns:
            The actuator with these values.
        """
        randomization, actuator, physical = self.randomization, self.actuator, self.physical_actuator
        assert randomization is not None
        if randomization.draws_actuator and actuator is not None and physical is not None:
            actuator = randomization.actuator(actuator, values)
            physics.set_actuator(randomization.actuator(physical, values))
        if isinstance(physics, MujocoPhysics) and randomization.variation is not None:
            physics.set_model(randomization.model_fields(values[np.newaxis], drawn=True))
        return actuator

    def keys(self, random: Callable[[int], np.ndarray]) -> np.ndarray:
        """Keys of the random numbers of episodes' disturbances, shape (m,), float64; 0 where none is needed.

        Args:
            random: (numbers for each of m episodes) -> numbers uniform in [0, 1), shape (m, count).
        """
        if not self.disturbances.random:
            return np.zeros(1)
        return random(1)[:, 0] * LARGEST_KEY  # a multiple of 2**-53 times 2**53: a whole number, exactly

    @property
    def senses(self) -> bool:
        """Whether the agent observes a current that is not the real one."""
        return self.observe_actuator and self.disturbances.of_sensor

    def seen(self, physics: Any, signals: Signals | None, rows: np.ndarray | None = None) -> Signals | None:
        """What the agent can see of the actuator's signals: its sensor's current instead of the current.

        Args:
            physics: of which the signals are.
            signals: of the step that ended, or None at the start of an episode.
            rows: at the start, simulations of a batch that are meant.
        """
        if not self.senses:
            return None if signals is None else self.signals(signals)
        if signals is None and rows is None:
            return self.signals(physics.sensed(ideal_signals(0.0)))
        if signals is None:
            return self.signals(physics.sensed(Signals(*[np.zeros(len(rows))] * 6), rows))  # type: ignore[arg-type]
        return self.signals(physics.sensed(signals))

    @property
    def physical_actuator(self) -> Actuator | None:
        """The actuator to simulate.

        For voltage commands the controller hands the command through: with no feedback, a feed-forward gain of 1 V/A
        and no back-EMF compensation, the terminal voltage in volts is the reference current in amperes.
        """
        if self.actuator is None or self.command != "voltage":
            return self.actuator
        loop = self.actuator.controller
        through = CurrentLoop(
            kp=0.0, kff=1.0, bemf_compensation=False, max_voltage=loop.max_voltage, substeps=loop.substeps
        )
        return dataclasses.replace(self.actuator, controller=through)

    @property
    def max_force(self) -> float:
        """Largest force [N] or torque [N*m] that the physics is asked for."""
        if self.command == "voltage":
            assert self.actuator is not None
            return self.actuator.controller.max_voltage * self._force_per_ampere
        return self.task.max_force

    @property
    def _force_per_ampere(self) -> float:
        if self.actuator is None:
            return 1.0
        return self.actuator.motor.torque_constant / self.actuator.motor.arm_radius

    @property
    def _command_limit(self) -> float:
        """Largest current [A] or voltage [V] that the agent can command, in float64: a float32 bound may lie beyond."""
        return self.max_force / self._force_per_ampere

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The agent's actions: the task's, or a table's indices, or a box of currents [A] or voltages [V]."""
        if self.levels is not None:
            return spaces.Discrete(len(self.levels))
        if self.command == "force":
            return self.task.action_space
        limit = np.float32(self._command_limit)
        return spaces.Box(-limit, limit, (1,), np.float32)

    @property
    def observation_space(self) -> spaces.Box:
        """The task's observation space; with `observe_actuator` two unbounded entries more."""
        space = self.task.observation_space
        if not self.observe_actuator:
            return space
        low, high = (np.append(bound, [inf, inf]) for bound, inf in ((space.low, -np.inf), (space.high, np.inf)))
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        extra = ("current", "reference_current") if self.observe_actuator else ()
        return (*self.task.observation_names, *extra)

    @functools.cached_property
    def action_forces(self) -> np.ndarray | None:
        """Forces [N or N*m] of the discrete actions, in order, as `force` has them; None where the space is a box."""
        if self.levels is not None:
            return self.levels * self._force_per_ampere
        return None if self.task.forces is None else np.array(self.task.forces)

    @functools.cached_property
    def _box_limit(self) -> tuple[float, float]:
        """The largest command of a box's action, and the force [N or N*m] of a command of one."""
        return (self.task.max_force, 1.0) if self.command == "force" else (self._command_limit, self._force_per_ampere)

    def force(self, action: Any) -> float:
        """The force [N] or torque [N*m] that the physics is to ask the actuator for.

        Args:
            action: an element of the action space; a box's saturates.

        Raises:
            ValueError: the action is no element, or not a number.
        """
        forces = self.action_forces
        if forces is not None:
            plain = type(action) is int or type(action) is np.int64  # spares them the slower test
            if not (0 <= action < len(forces) if plain else self.action_space.contains(action)):
                raise ValueError(f"action = {action!r}: not in {self.action_space}")
            return forces.item(int(action))
        array = np.asarray(action)
        if array.shape != (1,) or array.dtype.kind != "f" or (command := float(array[0])) != command:
            raise ValueError(f"action = {action!r}: not in {self.action_space}")
        limit, scale = self._box_limit
        return min(max(command, -limit), limit) * scale

    def forces(self, actions: Any) -> np.ndarray:
        """What `force` does, for a batch.

        Args:
            actions: a batch of elements of the action space, shape (N, ...).

        Returns:
            Shape (N,), float64.

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
        wrong = (array < 0) | (array >= space.n) if isinstance(space, spaces.Discrete) else np.isnan(array[:, 0])
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ValueError(f"actions[{row}] = {array[row]}: not in {space} (environment {row})")
        if self.action_forces is not None:
            return self.action_forces[array]
        limit, scale = self._box_limit
        return np.clip(array[:, 0].astype(np.float64), -limit, limit) * scale

    def signals(self, signals: Signals) -> Signals:
        """The signals as the agent's command defines them: a voltage asks for whatever force follows."""
        if self.command != "voltage":
            return signals
        return signals._replace(desired_force=signals.actual_force, reference_current=signals.current)

    def observation(self, state: np.ndarray, signals: Signals | None) -> np.ndarray:
        """What the agent sees.

        Args:
            state: the mechanical state, shape (n,); or a batch of them, (N, n).
            signals: of the step that led there; None at the start, where both currents are 0.

        Returns:
            Shape (k,), or (N, k), float32; the currents in A.
        """
        size = len(self.task.observation_names)
        rows = np.empty((*state.shape[:-1], size + 2 * self.observe_actuator), np.float32)
        self.outcomes.observe_all(_rows(state), _rows(rows))
        if self.observe_actuator:
            rows[..., size:] = 0.0
            if signals is not None:
                rows[..., size], rows[..., size + 1] = signals.current, signals.reference_current
        return rows

    def reward(self, before: np.ndarray, signals: Signals, after: np.ndarray) -> float:
        """The task's reward of a step that led from one state to another."""
        return float(self.rewards(before[np.newaxis], signals, after[np.newaxis])[0])

    def rewards(self, before: np.ndarray, signals: Signals, after: np.ndarray) -> np.ndarray:
        """The same for a batch: states (N, n), signals and rewards (N,)."""
        rewards = np.empty(len(after))
        forces = np.atleast_1d(np.asarray(signals.actual_force, dtype=np.float64))
        self.outcomes.reward_all(_rows(before), forces, _rows(after), self.option_values, rewards)
        return rewards

    def terminated(self, state: np.ndarray) -> bool:
        """Whether the task ends the episode in this state."""
        ended = np.empty(1, dtype=bool)
        self.outcomes.terminated_all(_rows(state), ended)
        return bool(ended[0])

    @functools.cached_property
    def outcomes(self) -> Outcomes:
        """The task's compiled functions."""
        return compiled_outcomes(self.task)

    @functools.cached_property
    def option_values(self) -> np.ndarray:
        """The task's options as a vector."""
        return np.array(self.options, dtype=np.float64)


def _rows(array: np.ndarray) -> np.ndarray:
    """An array (n,) or (N, n) as rows (N, n), in the one memory layout that the compiled functions are compiled for."""
    return np.ascontiguousarray(array.reshape(-1, array.shape[-1]))


def _disturbances(
    given: Disturbances | Mapping[str, Any] | None, actuator: Actuator | None, timestep: float, allow_unstable: bool
) -> Disturbances:
    """The disturbances, checked against the actuator.

    Raises:
        ValueError: a field is unknown or out of bounds, or needs a motor, or the supply makes a saturated motor's
            current oscillate from step to step.
    """
    disturbances = resolve_disturbances(given)
    if actuator is None and disturbances.of_motor:
        names = ("current_noise", "current_bias", "supply_resistance")
        on = ", ".join(f"{name} = {getattr(disturbances, name):g}" for name in names if getattr(disturbances, name))
        raise ValueError(f"disturbances: {on}: the ideal actuator has no current sensor and no supply; choose another")
    if actuator is not None and disturbances.supply_resistance and not allow_unstable:
        motor, substeps = actuator.motor, actuator.controller.substeps
        bound = 2.0 * motor.inductance * substeps / timestep - motor.resistance
        if not disturbances.supply_resistance < bound:
            raise ValueError(
                f"disturbances: supply_resistance = {disturbances.supply_resistance:g}: must be < 2*L/dt - R = "
                f"{bound:g} ohm at an electrical step of {timestep / substeps:g} s, or a saturated motor's current "
                "oscillates from step to step. Raise controller.substeps, or pass allow_unstable=True"
            )
    return disturbances


class UnknownOptionError(ValueError, TypeError):
    """A keyword that the environment does not have; a TypeError too, as Python's own is, and as TorchRL expects."""


def _options(task: Task, given: Mapping[str, float]) -> Any:
    """The task's options, checked.

    Raises:
        UnknownOptionError: unknown option.
        ValueError: one that is not a number > 0.
    """
    known = task.options._fields
    for name, value in given.items():
        if name not in known:
            has = ", ".join(known) or "none"
            raise UnknownOptionError(
                f"unknown option {name!r} of {task.name}: it has {has} (unexpected keyword argument {name!r})"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ValueError(f"{name} = {value!r}: must be a number > 0")
    return task.options(**{name: float(value) for name, value in given.items()})


def _levels(task: Task, actuator: Actuator | None, action: str, levels: Sequence[float] | None) -> np.ndarray | None:
    """The table of levels, checked against the kind of command and the task's action space.

    Raises:
        ValueError: an unknown command, one that the actuator or the task cannot take, or a missing or invalid table.
    """
    if action not in COMMANDS:
        raise ValueError(f"action = {action!r}: must be one of {', '.join(COMMANDS)}")
    if action == "force":
        if levels is not None:
            raise ValueError(f"levels = {levels!r}: only for action='current' and action='voltage'")
        return None
    if actuator is None:
        raise ValueError(f"action = {action!r}: the ideal actuator has no {action} to command; choose another actuator")
    limit = actuator.controller.max_voltage
    if action == "voltage" and not np.isfinite(limit):
        raise ValueError("action = 'voltage': needs a finite controller.max_voltage, it is inf")
    if isinstance(task.action_space, spaces.Box):
        if levels is not None:
            raise ValueError(f"levels = {levels!r}: only for tasks with discrete actions; {task.name}'s are continuous")
        return None
    if action == "current":
        limit = task.max_force * actuator.motor.arm_radius / actuator.motor.torque_constant
    unit = "A" if action == "current" else "V"
    try:
        table = np.array([] if levels is None else levels, dtype=np.float64)  # a copy
    except (TypeError, ValueError):
        table = np.array([np.nan])
    if table.ndim != 1 or len(table) < 2 or not (np.abs(table) <= limit).all():
        raise ValueError(
            f"levels = {levels!r}: {task.name} has discrete actions, so action={action!r} needs two or more levels "
            f"within +-{limit!r} {unit}, such as levels=({-limit!r}, 0, {limit!r})"
        )
    return table
