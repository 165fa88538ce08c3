"""Definition of a task: a model file, a few numbers, and pure functions of a state's entries."""

import functools
import math
import numbers
from collections import UserDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj import fields
from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Ideal
from codrl_mj.tasks.attributes import Attribute
from codrl_mj.tasks.checks import check_fields, check_functions, check_layout
from codrl_mj.tasks.reference_env import Force, ReferenceEnv, ReferenceStates
from codrl_mj.user_code import asset_path


class NoOptions(NamedTuple):
    """Options of a task without options."""


class OptionBounds(NamedTuple):
    """Unit and smallest value of an option, in its type: `Annotated[float, OptionBounds("kg")]`."""

    unit: str
    """Unit of the option."""
    minimum: float = 0.0
    """Smallest value, in the unit."""
    is_excluded: bool = False
    """True if the option must exceed `minimum`."""


# Each task declares its own options, and only its own functions read them.
Options = Any
"""Type of a task's options: a `NamedTuple` of floats and flags whose fields have defaults."""
Values = float | np.ndarray
"""A number, or an array with a number for each state."""
Flags = bool | np.ndarray
"""True or False, or an array of them with one for each state."""
Entries = np.ndarray | Sequence[Values]
"""Type of a state's entries: a sequence of numbers, or of arrays with a number for each state."""
# Gymnasium accepts any values, and each task converts and checks those that it reads.
ResetOption = Any
ResetOptions = dict[str, ResetOption]
"""Argument `options` of `reset`."""
INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "semi-implicit": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
"""Name of an integrator -> the setting that it needs in a model.

`euler` moves positions by the velocity before the step, `semi-implicit` by the velocity after it.
"""


@dataclass(frozen=True)
class Task(fields.Checked):
    """Definition of a task, from which all its environments are built.

    These are single, batched, analytic and dm_control environments. A function of a state takes the
    state's entries in Gymnasium's order: `state[0]`, `state[1]` and so on, each a number, or an
    array with a number for each of N states (`states.T` of states (N, n)). A result that is the
    same for all states may be a single number. The functions are plain Python, which numba compiles
    (`codrl_mj.physics.compiled_task`); all environments run the compiled functions.

    Raises:
        ValueError: a field is out of bounds, or a function, called once on plain numbers, returns
            something other than the fields declare.
    """

    name: str
    """Name on the command line, such as `cartpole`."""
    env_id: str
    """Id in Gymnasium's registry, such as `codrl_mj/CartPole-v0`."""
    max_episode_steps: int | None = field(metadata=fields.integer(None, minimum=1).metadata)
    """Time limit [environment steps]; None for none."""
    asset: str
    """MJCF file: the name of one in the package, or a path."""
    step_duration: float = field(metadata=fields.real(1.0, above=0.0, unit="s").metadata)
    """Duration of one environment step [s]."""
    motor_inner_steps: int = field(metadata=fields.integer(1, minimum=1).metadata)
    """Integration steps per environment step when a motor is in the loop."""
    max_force: Force
    """Largest desired force [N] or torque [N*m] of any action. If the action is the force, it is
    clipped to this. A number for all motors, or one for each.
    """
    integrators: tuple[str, ...]
    """Names of the integrators that can be chosen, keys of `INTEGRATORS`; the first is Gymnasium's.
    The integrator of the model file must be of the same kind.
    """
    state_names: tuple[str, ...]
    """Names of the state's entries, with units."""
    observation_names: tuple[str, ...]
    """Names of the observation's entries."""
    initial_bounds: Callable[[ResetOptions | None], tuple[np.ndarray, np.ndarray]]
    """Function (reset options) -> lower and upper bounds of the k numbers drawn at a reset.

    Each has shape (k,). Tasks of Gymnasium draw the same numbers as Gymnasium.
    """
    initial_state: Callable[[Entries], tuple[Values, ...]]
    """Function (k numbers drawn uniformly within the bounds) -> entries of the initial state."""
    observation: Callable[[Entries], tuple[Values, ...]]
    """Function (state) -> entries of the observation, which are then rounded to float32."""
    reward: Callable[[Entries, Force, Entries, Options], Values]
    """Function (state before, force delivered, state after, options) -> reward."""
    terminated: Callable[[Entries], Flags]
    """Function (state) -> True if the episode terminates in it."""
    constrain: Callable[[Entries, float], tuple[Values, ...]] | None = None
    """Function (integrated state, integration step [s]) -> entries of the state within its bounds.

    The bounds are those of Gymnasium's `step`: speed limits, walls, wrapped angles. They are
    applied after every integration step. The function must propagate NaN. None if there are no
    bounds.
    """
    goal: Callable[[Entries], Flags] | None = None
    """Function (state) -> True if the state is at the task's goal.

    An episode succeeds if it ends at the goal and has been there for `goal_hold`. None if the goal
    is to survive: an episode then succeeds if it is not terminated before the time limit.
    """
    goal_hold: float = fields.real(0.0, minimum=0.0, unit="s")
    """Time [s] at the goal, up to the end of the episode, that success requires."""

    forces: tuple[Force, ...] | None = None
    """Desired forces [N] or torques [N*m] of the discrete actions, in order; None if the action is
    the force. Each is a number, or a tuple if there are several motors.
    """
    options: type[Options] = NoOptions
    """Class of the task's options: a `NamedTuple` whose fields all have defaults.

    Numbers whose default is > 0 must be > 0, others finite, unless the type of a field states
    `OptionBounds`.
    """
    apply_options: Callable[[mujoco.MjSpec, Options], None] | None = None
    """Function (model, options) -> None, which changes the model, before it is compiled, as the
    options require; None if options do not change the model.

    It must not change the model if the options have their defaults. It raises ValueError if options
    contradict each other. `reference_env` is then called with the options as its argument.
    """
    reference_options: tuple[Options, ...] = ()
    """Further options with which the certificate compares the model to the reference."""
    qpos: tuple[int, ...] = ()
    """Indices of the state entries that are MuJoCo's `qpos`, in order; by default the state's first
    half. They must be evenly spaced, as must those of `qvel`.
    """
    qvel: tuple[int, ...] = ()
    """Indices of the state entries that are MuJoCo's `qvel`; by default the second half."""
    action_space: spaces.Box | spaces.Discrete = None  # type: ignore[assignment]
    """Action space, as in Gymnasium; by default forces up to `max_force` or indices of `forces`.

    A copy of the task with another `max_force` keeps the space, as Gymnasium's Pendulum does when
    `max_torque` is written; a copy with `action_space=None` gets a new space.
    """
    observation_space: spaces.Box = None  # type: ignore[assignment]
    """Observation space, as in Gymnasium; by default without bounds."""
    render_fps: int = fields.integer(0, minimum=0)
    """Frames per second of a video with one frame a step; by default real time, as in Gymnasium."""
    motors: tuple[str, ...] = ("motor",)
    """Names of the MJCF model's actuators that the task uses, in the order of actions and forces.
    With several of them, forces and signals are arrays (n,) instead of numbers.
    """
    reward_threshold: float | None = fields.real(None)
    """Mean return at which the task counts as solved."""
    agent: str = "ppo"
    """Default agent of `codrl-mj train`."""
    gymnasium_id: str | None = None
    """Id of the Gymnasium environment that this task rebuilds, with the same spaces, initial
    states, rewards and terminations; None if there is none.
    """
    reference_env: Callable[..., ReferenceEnv] | None = None
    """Function that creates an independent reference for the task's dynamics.

    It is called without arguments, or with the task's options if there is an `apply_options`.

    The reference is the Gymnasium environment, or equations of motion in closed form, and accepts
    any force. The analytic physics and the certificate use it.
    """
    ideal_inner_steps: int = fields.integer(1, minimum=1)
    """Integration steps per environment step when the actuator is ideal, as in Gymnasium."""
    paper: tuple[DCMotorActuator, ...] = ()
    """The paper's actuators, one for each motor; empty if there are none.

    Other named actuators are variations of them.
    """
    actuator: str = "ideal"
    """Name of the default actuator of a task without `paper`, such as a motor of the catalog."""
    wrapped: tuple[int, ...] = ()
    """Indices of the state entries that `constrain` wraps to [-pi, pi].

    Comparisons use them, so that a rounding error at the cut does not count as a whole turn.
    """
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    """Numbers that the task's environments have as attributes, by name, with their sources."""
    reference_states: ReferenceStates | None = None
    """States in which the certificate compares the task with its reference.

    If it is None, the certificate omits the checks that need states.
    """

    def __post_init__(self) -> None:
        """Validate the fields, and compute defaults that depend on other fields."""
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

    def make_reference_env(self, options: Options = None) -> ReferenceEnv:
        """Create the reference for the task's dynamics with options; None for their defaults."""
        assert self.reference_env is not None
        if self.apply_options is None:
            return self.reference_env()
        return self.reference_env(self.options() if options is None else options)

    @property
    def default_actuator(self) -> str:
        """Name of the default actuator."""
        return "paper" if self.paper else self.actuator

    @property
    def oracle(self) -> str:
        """Description of `reference_env`."""
        return f"Gymnasium {self.gymnasium_id}" if self.gymnasium_id else "the closed form"

    @property
    def max_forces(self) -> np.ndarray:
        """Largest desired forces [N] or torques [N*m], shape (n,)."""
        return np.broadcast_to(
            np.array(self.max_force, dtype=np.float64), (len(self.motors),)
        ).copy()

    def num_inner_steps(
        self, actuator: ActuatorModel, inner_steps: int | None, timestep: float | None
    ) -> int:
        """Return the number of integration steps in an environment step.

        The number is `inner_steps`, or follows from the integration step `timestep` [s]. If both
        are None, it is the task's default for the actuator.

        Raises:
            ValueError: both are given, the number is below 1, or the timestep does not divide the
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
            num_steps = round(self.step_duration / timestep)
            if num_steps < 1 or not math.isclose(
                num_steps * timestep, self.step_duration, rel_tol=1e-9
            ):
                raise ValueError(
                    f"timestep = {timestep:g} s does not divide {self.name}'s environment step of"
                    f" {self.step_duration:g} s: the ratio is {self.step_duration / timestep:.6g},"
                    " must be an integer >= 1"
                )
            return num_steps
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
        """Return the name of an integrator that the task has; None selects Gymnasium's.

        Raises:
            ValueError: the task has no such integrator.
        """
        if name is not None and name not in self.integrators:
            raise ValueError(
                f"integrator = {name!r}: {self.name} has {', '.join(self.integrators)}"
            )
        return name or self.integrators[0]

    @functools.cached_property
    def speed_indices(self) -> tuple[int, ...]:
        """Indices of the state entries that are the velocities of the motors' joints, in order."""
        # The MJCF model knows which joints the motors drive.
        model = mujoco.MjSpec.from_file(str(asset_path(self.asset))).compile()
        joints = [model.actuator_trnid[model.actuator(name).id, 0] for name in self.motors]
        return tuple(self.qvel[model.jnt_dofadr[joint]] for joint in joints)

    @property
    def observation_units(self) -> tuple[str | None, ...]:
        """Units of the observation's entries.

        An entry that equals a state entry has the unit of that entry. Other entries have the unit 1
        if their bounds are +-1, and otherwise None, unknown.
        """
        # An entry that equals a state entry in several random states is taken to be a copy of it.
        states = np.random.default_rng(0).uniform(0.1, 1.0, (len(self.state_names), 5))
        units: list[str | None] = []
        for entry, low, high in zip(
            self.observation(states),
            self.observation_space.low,
            self.observation_space.high,
            strict=True,
        ):
            matches = [k for k, state in enumerate(states) if np.array_equal(entry, state)]
            default = "1" if (low, high) == (-1.0, 1.0) else None
            units.append(
                self.state_names[matches[0]].partition("[")[2].rstrip("]") or None
                if matches
                else default
            )
        return tuple(units)

    def bounds(self, options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
        """Return `initial_bounds` with a reset's options.

        Raises:
            ValueError: the task does not read an option of this name, or the bounds are not finite
                or not in order.
        """
        # A task does not declare its reset options, so the names that it looks up are recorded.
        recorded = None if options is None else _RecordingOptions(options)
        low, high = self.initial_bounds(recorded)  # type: ignore[arg-type]
        if recorded is not None:
            fields.check_names(
                recorded.data, sorted(map(str, recorded.names)), "reset option", list_all=True
            )
            if not (np.isfinite([low, high]).all() and np.less_equal(low, high).all()):
                raise ValueError(
                    f"reset options = {options}: the bounds are {low} to {high}, must be finite and"
                    " in order"
                )
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)

    def draw_initial_state(
        self, generator: np.random.Generator, options: ResetOptions | None
    ) -> np.ndarray:
        """Draw an initial state, shape (n,), the same as Gymnasium's with the same generator."""
        low, high = self.bounds(options)
        state = np.array(self.initial_state(low + (high - low) * generator.random(len(low))))
        return state.reshape(len(self.state_names))

    def initial_states(self, draws: np.ndarray) -> np.ndarray:
        """Return initial states, shape (N, n), for numbers drawn within the bounds, (N, k)."""
        states = np.empty((len(draws), len(self.state_names)))
        for column, entry in zip(states.T, self.initial_state(draws.T), strict=True):
            column[:] = entry
        return states


class _RecordingOptions(UserDict[str, ResetOption]):
    """Reset options that record the names that were looked up."""

    def __init__(self, options: Mapping[str, ResetOption]) -> None:
        self.names: set[object] = set()
        super().__init__(options)

    def __contains__(self, name: object) -> bool:
        self.names.add(name)
        return super().__contains__(name)

    def __getitem__(self, name: str) -> ResetOption:
        return self.data[name] if name in self else super().__getitem__(name)
