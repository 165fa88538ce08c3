"""What a task is: a model file, a few numbers, and pure functions of a state's entries."""

import functools
import math
import numbers
from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj import fields
from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Ideal
from codrl_mj.tasks.attributes import Attribute
from codrl_mj.tasks.checks import check_fields, check_functions, check_layout
from codrl_mj.tasks.twin import ReferenceEnv, ReferenceStates
from codrl_mj.user_code import asset_path


class NoOptions(NamedTuple):
    """The options of a task that has none."""


Options = Any
"""A task's options: a `NamedTuple` of floats and flags whose fields have defaults."""
Entries = Any
"""A sequence of numbers, or of arrays with one number for each of N states."""
INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "semi-implicit": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
"""Integrators by name, and what a model has to have for them; with `euler` positions are moved by the old velocity."""


@dataclass(frozen=True)
class Task(fields.Checked):
    """One task, defined once; every face (single, batched, analytic, dm_control) is built from it.

    A function of a state takes the state's entries, in Gymnasium's own order: `state[0]`,
    `state[1]` and so on, each a number, or an array with a number for each of N states (`states.T`
    of states (N, n)). What is the same for all states may be returned as a single number. These
    functions are plain Python that numba compiles as it stands (`codrl_mj.physics.compiled_task`);
    every face runs the compiled form.

    Raises:
        ValueError: a field is out of bounds, or a function, called once on plain numbers, does not
            return what others declare.
    """

    name: str
    """Name on the command line, such as `cartpole`."""
    env_id: str
    """Its id in Gymnasium's registry, such as `codrl_mj/CartPole-v0`."""
    max_episode_steps: int | None = field(metadata=fields.integer(None, minimum=1).metadata)
    """Time limit [environment steps]; None for none."""
    asset: str
    """MJCF file: a name among ours, or a path."""
    step_duration: float = field(metadata=fields.real(1.0, above=0.0, unit="s").metadata)
    """Duration of one environment step [s]."""
    motor_inner_steps: int = field(metadata=fields.integer(1, minimum=1).metadata)
    """Integration steps per environment step when a motor is in the loop."""
    max_force: Any
    """Largest desired force [N] or torque [N*m] of any action; where the action is the force, it
    saturates here. One for each motor, or one for all.
    """
    integrators: tuple[str, ...]
    """Names of the integrators that can be chosen, keys of `INTEGRATORS`; the first is Gymnasium's.
    The model's own has to be of that kind.
    """
    state_names: tuple[str, ...]
    """Names of the state's entries, with units."""
    observation_names: tuple[str, ...]
    """Names of the observation's entries."""
    initial_bounds: Callable[[dict[str, Any] | None], tuple[np.ndarray, np.ndarray]]
    """(reset options) -> lower and upper bounds, shape (k,) each, of the k numbers that Gymnasium draws at a reset."""
    initial_state: Callable[[Entries], tuple[Any, ...]]
    """(k numbers drawn uniformly within those bounds) -> entries of the initial state."""
    observation: Callable[[Entries], tuple[Any, ...]]
    """(state) -> entries of the observation, to be rounded to float32."""
    reward: Callable[[Entries, Any, Entries, Options], Any]
    """(state before, force delivered, state after, options) -> reward."""
    terminated: Callable[[Entries], Any]
    """(state) -> whether the episode ends there."""
    constrain: Callable[[Entries, float], tuple[Any, ...]] | None = None
    """(state as integrated, integration step [s]) -> entries of the state within the bounds that
    Gymnasium's `step` keeps: speed limits, walls, wrapped angles. Applied after every integration
    step; None where there are no bounds. Must let NaN through.
    """
    goal: Callable[[Entries], Any] | None = None
    """(state) -> whether the task's goal is reached there. An episode succeeds if it ends at the
    goal and has been there for `goal_hold`. None where the goal is to last: an episode then
    succeeds if it is not terminated before the time limit.
    """
    goal_hold: float = fields.real(0.0, minimum=0.0, unit="s")
    """How long an episode that succeeds has been at the goal when it ends [s]."""

    forces: tuple[Any, ...] | None = None
    """Desired forces [N] or torques [N*m] of the discrete actions, in order, each a number, or with
    several motors a tuple; None where the action is the force.
    """
    options: type[Any] = NoOptions
    """The task's options: a `NamedTuple` class whose fields all have defaults."""
    qpos: tuple[int, ...] = ()
    """Which state entries are MuJoCo's `qpos`, in order; an arithmetic progression, as is `qvel`.
    The state's first half unless told otherwise.
    """
    qvel: tuple[int, ...] = ()
    """Which state entries are MuJoCo's `qvel`, in order; the second half unless told otherwise."""
    action_space: spaces.Space[Any] = None  # type: ignore[assignment]
    """The action space, Gymnasium's; unless told otherwise up to `max_force`, or which of `forces`.
    A copy of another force keeps it, as Gymnasium's Pendulum does where `max_torque` is written;
    with None it gets its own.
    """
    observation_space: spaces.Box = None  # type: ignore[assignment]
    """The observation space, Gymnasium's; without bounds unless told otherwise."""
    render_fps: int = fields.integer(0, minimum=0)
    """Frames per second of a video with one frame a step: real time unless told otherwise, as Gymnasium does."""
    motors: tuple[str, ...] = ("motor",)
    """Names of the MJCF model's actuators that the task drives, in the order of actions and forces.
    With several of them, forces and signals are arrays (n,) wherever they are numbers otherwise.
    """
    reward_threshold: float | None = fields.real(None)
    """Mean return at which the task counts as solved."""
    agent: str = "ppo"
    """The agent that `codrl-mj train` takes unless told otherwise."""
    gymnasium_id: str | None = None
    """Id of the environment that this task rebuilds, with the same spaces, starts, rewards and
    ends; None if it is none of Gymnasium's.
    """
    twin: Callable[[], ReferenceEnv] | None = None
    """Makes that environment, or the equations of motion in closed form, to be driven by any force:
    the analytic physics, and the oracle of the certificate.
    """
    ideal_inner_steps: int = fields.integer(1, minimum=1)
    """Integration steps per environment step when the actuator is ideal: Gymnasium's."""
    paper: tuple[DCMotorActuator, ...] = ()
    """The paper's actuators, one for each motor, of which other named actuators are variations;
    none where there are none.
    """
    actuator: str = "ideal"
    """Name of its actuator where it has none of the paper's, such as a motor of the catalogue."""
    wrapped: tuple[int, ...] = ()
    """State entries that `constrain` wraps to [-pi, pi]: a rounding error at the cut is one, and not a whole turn."""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    """Numbers that environments of the task have as attributes, by their names, and where they live."""
    trials: ReferenceStates | None = None
    """What the certificate tries the task in; without it, the checks that need states of the task's are left out."""

    def __post_init__(self) -> None:
        """Validate, and fill in what follows from the rest."""
        super().__post_init__()
        check_fields(self)
        fields.check_names(self.integrators, INTEGRATORS, "integrator", list_all=True)
        asset_path(self.asset)
        half, size = len(self.state_names) // 2, (len(self.observation_names),)
        limits = self.max_forces.astype(np.float32)
        derived = {
            "qpos": tuple(range(half)),
            "qvel": tuple(range(half, 2 * half)),
            "action_space": (
                spaces.Box(-limits, limits)
                if self.forces is None
                else spaces.Discrete(len(self.forces))
            ),
            "observation_space": spaces.Box(-np.inf, np.inf, size, np.float32),
            "render_fps": max(round(1.0 / self.step_duration), 1),
        }
        for name, value in derived.items():
            if not getattr(self, name):
                object.__setattr__(self, name, value)
        check_functions(self)
        check_layout(self)

    @property
    def default_actuator(self) -> str:
        """The name of the actuator where none is asked for."""
        return "paper" if self.paper else self.actuator

    @property
    def oracle(self) -> str:
        """What its `twin` is, in words."""
        return f"Gymnasium {self.gymnasium_id}" if self.gymnasium_id else "the closed form"

    @property
    def max_forces(self) -> np.ndarray:
        """Largest desired forces [N] or torques [N*m], shape (n,)."""
        return np.broadcast_to(
            np.array(self.max_force, dtype=np.float64), (len(self.motors),)
        ).copy()

    def steps_within(
        self, actuator: ActuatorModel, inner_steps: int | None, timestep: float | None
    ) -> int:
        """Integration steps in an environment step: their number, by the step [s], or the default for an actuator.

        Raises:
            ValueError: both were given, the number is below 1, or the timestep does not divide the
                environment step.
        """
        if inner_steps is not None and timestep is not None:
            raise ValueError(
                f"inner_steps = {inner_steps} and timestep = {timestep}: give one of them, not both"
            )
        if timestep is not None:
            if not (
                isinstance(timestep, numbers.Real) and math.isfinite(timestep) and timestep > 0
            ):
                raise ValueError(f"timestep = {timestep!r}: must be a finite number > 0 [s]")
            count = round(self.step_duration / timestep)
            if count < 1 or not math.isclose(count * timestep, self.step_duration, rel_tol=1e-9):
                raise ValueError(
                    f"timestep = {timestep:g} s does not divide {self.name}'s environment step of"
                    f" {self.step_duration:g} s: the ratio is {self.step_duration / timestep:.6g},"
                    " must be an integer >= 1"
                )
            return count
        if inner_steps is None:
            return self.ideal_inner_steps if isinstance(actuator, Ideal) else self.motor_inner_steps
        if (
            isinstance(inner_steps, bool)
            or not isinstance(inner_steps, numbers.Integral)
            or inner_steps < 1
        ):
            raise ValueError(f"inner_steps = {inner_steps!r}: must be an integer >= 1")
        return int(inner_steps)

    def integrator(self, name: str | None) -> str:
        """An integrator's name; Gymnasium's if none is given.

        Raises:
            ValueError: the task has no such integrator.
        """
        if name is not None and name not in self.integrators:
            raise ValueError(
                f"integrator = {name!r}: {self.name} has {', '.join(self.integrators)}"
            )
        return name or self.integrators[0]

    @functools.cached_property
    def speeds(self) -> tuple[int, ...]:
        """Which state entries are the velocities of the joints that the motors drive, in their order: by the model."""
        model = mujoco.MjSpec.from_file(str(asset_path(self.asset))).compile()
        joints = [model.actuator_trnid[model.actuator(name).id, 0] for name in self.motors]
        return tuple(self.qvel[model.jnt_dofadr[joint]] for joint in joints)

    @property
    def observation_units(self) -> tuple[str | None, ...]:
        """Units of the observation's entries: the state's, where an entry is one of its; 1, within +-1; else None."""
        states = np.random.default_rng(0).uniform(0.1, 1.0, (len(self.state_names), 5))
        units: list[str | None] = []
        for entry, least, most in zip(
            self.observation(states),
            self.observation_space.low,
            self.observation_space.high,
            strict=True,
        ):
            same = [k for k, one in enumerate(states) if np.array_equal(entry, one)]
            plain = "1" if (least, most) == (-1.0, 1.0) else None
            units.append(
                self.state_names[same[0]].partition("[")[2].rstrip("]") or None if same else plain
            )
        return tuple(units)

    def bounds(self, options: dict[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
        """`initial_bounds` under a reset's options.

        Raises:
            ValueError: the task asks for no option of such a name, or bounds are not finite or not
                in order.
        """
        asked = None if options is None else _Asked(options)
        low, high = self.initial_bounds(asked)  # type: ignore[arg-type]
        if asked is not None:
            fields.check_names(
                asked.data, sorted(map(str, asked.names)), "reset option", list_all=True
            )
            if not (np.isfinite([low, high]).all() and np.less_equal(low, high).all()):
                raise ValueError(
                    f"reset options = {options}: ask for {low} to {high}; must be finite, in order"
                )
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)

    def initial(self, generator: np.random.Generator, options: dict[str, Any] | None) -> np.ndarray:
        """One initial state, shape (n,): the state that Gymnasium's environment draws from the same generator."""
        low, high = self.bounds(options)
        state = np.array(self.initial_state(low + (high - low) * generator.random(len(low))))
        return state.reshape(len(self.state_names))

    def initial_states(self, draws: np.ndarray) -> np.ndarray:
        """Initial states, shape (N, n), from numbers drawn within the bounds, (N, k)."""
        states = np.empty((len(draws), len(self.state_names)))
        for column, entry in zip(states.T, self.initial_state(draws.T), strict=True):
            column[:] = entry
        return states


class _Asked(UserDict[str, Any]):
    """Reset options that remember which names they were asked for."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.names: set[Any] = set()
        super().__init__(options)

    def __contains__(self, name: object) -> bool:
        self.names.add(name)
        return super().__contains__(name)

    def __getitem__(self, name: str) -> Any:
        return self.data[name] if name in self else super().__getitem__(name)
