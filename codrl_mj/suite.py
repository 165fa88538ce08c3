"""The tasks as dm_control environments: `suite.load("pendulum", "gym")`.

The same dynamics, rewards and ends as the Gymnasium environments, with observations by name. The simulation itself is
`codrl_mj.physics.MujocoPhysics`; this module gives it dm_control's interface. Needs the extra `dm-control`.
"""

import collections
import copy
import math
import operator
import threading
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_env import specs
from gymnasium import spaces

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.setup import Setup
from codrl_mj.envs.views import signals_of
from codrl_mj.physics import MujocoPhysics, Signals
from codrl_mj.tasks import TASKS

_FULL_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)

TASK_NAME = "gym"
_DEFAULT = object()
"""The actuator where none is given: `paper`, or a configuration's own."""


def __getattr__(name: str) -> Any:
    """`ALL_TASKS`: every (domain, task) that `load` knows by name at present, tasks of one's own included."""
    if name == "ALL_TASKS":
        return tuple((domain, TASK_NAME) for domain in TASKS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class Physics(dm_mujoco.Physics):
    """dm_control's physics around one of our simulations; a `step` is one whole environment step."""

    legacy_step: bool = False
    simulation: MujocoPhysics
    """Our simulation, which owns model and data."""
    desired_force: Any = 0.0
    """Force [N] or torque [N*m] that the next step asks the actuator for; with several motors an array (n,)."""
    signals: Signals | None = None
    """What the actuator did in the last step; None before the first."""

    @classmethod
    def of(cls, simulation: MujocoPhysics) -> "Physics":
        """The physics of a simulation, sharing its model and data."""
        physics = cls(wrapper.MjData(simulation.data))
        physics.simulation = simulation
        return physics

    def step(self, nstep: int = 1) -> None:
        """Advance by one environment step under `desired_force`.

        Args:
            nstep: must be the simulation's integration steps per environment step: bounds, explicit integration and the
                motor are part of each.

        Raises:
            ValueError: it is not.
            PhysicsError: the engine warned that the state is invalid.
            SimulationDivergedError: the state is no longer finite.
        """
        if nstep != self.simulation.inner_steps:
            raise ValueError(f"nstep = {nstep}: must be the task's {self.simulation.inner_steps} integration steps")
        with self.check_invalid_state():
            self.simulation.step(self.desired_force)

    def get_state(self, sig: int | None = None) -> np.ndarray:
        """The state to continue from: time, positions, velocities and motors, and commands and loads on their way.

        Without the time, which dm_control leaves out, a motor would not know whether its last tick has passed.

        Args:
            sig: which parts, as a sum of `mujoco.mjtState`.
        """
        if sig is not None:
            return super().get_state(sig)
        return np.concatenate([super().get_state(_FULL_STATE), self.simulation.memory])

    def set_state(self, physics_state: np.ndarray, sig: int | None = None) -> None:
        """Restore what `get_state` returned.

        Args:
            physics_state: the state.
            sig: which parts it holds, as a sum of `mujoco.mjtState`.

        Raises:
            ValueError: the state has not the size of these parts.
        """
        size = mujoco.mj_stateSize(self.model.ptr, _FULL_STATE if sig is None else sig)
        expected = (size + (len(self.simulation.memory) if sig is None else 0),)
        if np.shape(physics_state) != expected:
            raise ValueError(f"physics_state has shape {np.shape(physics_state)}, must be {expected}")
        super().set_state(physics_state[:size], _FULL_STATE if sig is None else sig)
        if sig is None:
            self.simulation.memory[:] = physics_state[size:]

    def state(self) -> np.ndarray:
        """The same as `get_state()`."""
        return self.get_state()

    def render(self, *arguments: Any, **options: Any) -> np.ndarray:
        """The present state as an image, as `dm_control.mujoco.Physics.render`.

        A step leaves the engine's body poses where its last integration step began; the image does not lag.
        """
        self.simulation.show(self.simulation.state)
        return super().render(*arguments, **options)

    def copy(self, share_model: bool = False) -> "Physics":
        """An independent copy, motor included; the model is always copied too."""
        del share_model
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("simulation", "desired_force", "signals")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._contexts_lock = threading.Lock()
        self._warnings_cause_exception = True
        self.__dict__.update(state)
        self._reload_from_data(wrapper.MjData(self.simulation.data))


class GymTask(control.Task):
    """One of our tasks under dm_control's task interface."""

    def __init__(self, setup: Setup, random: np.random.Generator) -> None:
        """Wrap a set-up task.

        Args:
            setup: task, actuator, options and spaces.
            random: draws the initial states.
        """
        self.setup = setup
        self.random = random
        self._before: np.ndarray = np.zeros(0)
        self.randomization: dict[str, Any] = {}  # what was drawn for the episode

    def initialize_episode(self, physics: Physics) -> None:
        """Draw the initial state; the motor is at rest."""
        _, info = self.setup.start(physics.simulation, self.random, None)
        self.randomization = info.get("randomization", {})
        physics.signals = None
        self._before = physics.simulation.state

    def before_step(self, action: Any, physics: Physics) -> None:
        """Turn the action into the desired force.

        Raises:
            ValueError: the action is not of the action spec.
        """
        if isinstance(self.setup.commands.action_space, spaces.Discrete):
            try:
                action = operator.index(action)
            except TypeError:
                raise ValueError(f"action = {action!r}: not in {self.setup.commands.action_space}") from None
        self._before = physics.simulation.state
        physics.desired_force = self.setup.commands.force(action)

    def after_step(self, physics: Physics) -> None:
        """Express what the actuator did as the command defines it."""
        trace, setup = physics.simulation.trace, self.setup
        physics.signals = signals_of(trace[-1], setup.family, physics.desired_force, setup.commands.tracks)

    def action_spec(self, physics: Physics) -> specs.Array:
        """The action space as a dm_env spec."""
        del physics
        space = self.setup.commands.action_space
        if isinstance(space, spaces.Discrete):
            return specs.DiscreteArray(int(space.n), name="action")
        assert isinstance(space, spaces.Box)
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name="action")

    def get_observation(self, physics: Physics) -> dict[str, np.ndarray]:
        """The observation's entries by name, each of shape (1,), float64."""
        simulation, seen = physics.simulation, None
        if self.setup.view.sensors:
            row = simulation.trace[-1]
            seen = simulation.observed(np.zeros_like(row) if physics.signals is None else row)
        values = self.setup.view.observation(simulation.state, seen)
        names = self.setup.view.observation_names
        return collections.OrderedDict(
            (name, np.array([value], dtype=np.float64)) for name, value in zip(names, values, strict=True)
        )

    def get_reward(self, physics: Physics) -> float:
        """The task's reward of the last step."""
        assert physics.signals is not None
        return self.setup.view.reward(self._before, physics.signals["actual_force"], physics.simulation.state)

    def get_termination(self, physics: Physics) -> float | None:
        """0 (no future) where the task ends the episode, else None."""
        return 0.0 if self.setup.view.terminated(physics.simulation.state) else None


def load(
    domain_name: str | EnvConfig,
    task_name: str = TASK_NAME,
    actuator: Any = _DEFAULT,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> control.Environment:
    """A task as a dm_control environment.

    Args:
        domain_name: task name, such as `pendulum`; or an environment's whole configuration.
        task_name: `gym`.
        actuator: as for `codrl_mj.envs.ActuatedEnv`, `paper` unless given; over a configuration's.
        task_kwargs: `random`: a seed or a `numpy.random.Generator` for the initial states.
        environment_kwargs: arguments of `dm_control.rl.control.Environment`, such as `flat_observation`.
        **options: the other fields of `codrl_mj.envs.config.EnvConfig`, and the task's own options, over a
            configuration's. What was drawn for an episode is in the attribute `randomization` of the environment's
            task.

    Returns:
        The environment. An episode ends with discount 0 where the task says so and with discount 1 at the time limit,
        which is Gymnasium's number of steps; a last step that is both has discount 1, as everywhere in dm_control.

    Raises:
        ValueError: unknown domain or task, or arguments out of bounds.
    """
    if task_name != TASK_NAME:
        raise ValueError(f"task_name = {task_name!r}: every domain has one task, {TASK_NAME!r}")
    given = task_kwargs or {}
    if given.keys() - {"random"}:
        raise ValueError(f"task_kwargs = {dict(given)!r}: may only hold 'random'")
    if isinstance(domain_name, EnvConfig):
        over = options if actuator is _DEFAULT else {"actuator": actuator, **options}
        config = EnvConfig.from_mapping(over, domain_name)
    else:
        config = EnvConfig.of(domain_name, "default" if actuator is _DEFAULT else actuator, options)
    setup = Setup.build(config)
    simulation = setup.simulate(config.physics)
    if not isinstance(simulation, MujocoPhysics):
        raise ValueError(f"physics = {config.physics!r}: dm_control's face needs 'mujoco'")
    random = np.random.default_rng(given.get("random"))
    # half a step less: dm_control divides by the step, and a rounded-up quotient would allow one step more
    limit = math.inf if config.time_limit is None else config.time_limit - 0.5
    return control.Environment(
        Physics.of(simulation),
        GymTask(setup, random),
        time_limit=limit * setup.task.step_duration,
        n_sub_steps=setup.inner_steps,
        legacy_step=False,
        **(environment_kwargs or {}),
    )
