"""Interface of the simulation of a task."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, Ideal, check_same_family
from codrl_mj.boundary import Info
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint
from codrl_mj.physics.disturber import Disturber
from codrl_mj.tasks import Task
from codrl_mj.tasks.base import Options

Signals = Info
"""Signals of the actuators after one environment step, by name: `desired_force` and `actual_force`
[N or N*m], the family's signals at the end of the last integration step, and `saturated`. Values
are numbers for a task with one actuator and arrays (n,) for several; a batch adds a first axis.
"""


def trace_names(family: Family) -> tuple[str, ...]:
    """Return the columns of `Physics.trace`.

    For an integration step these are the force [N or N*m] that is commanded to the actuator, after
    disturbances; the force that it delivers; the family's signals at the end of the step; and the
    velocity of the actuated joint [m/s or rad/s] at its end.
    """
    return ("desired_force", "actual_force", *family.Signals._fields, "speed")


def signal_names(family: Family) -> tuple[str, ...]:
    """Return the keys of `Signals`, in order."""
    return (*(name for name in trace_names(family)[:-1] if name != "saturated"), "saturated")


@functools.cache
def make_info_reader(names: tuple[str, ...]) -> Callable[[Sequence[object] | np.ndarray], Signals]:
    """Return a function that turns a trace's columns, numbers or arrays, into `Signals`.

    The last entry is the flag `saturated`. For a family without this signal, it is False, with the
    shape of a column.
    """
    # The dictionary is generated as source text, as `namedtuple` does: a loop would take a tenth of
    # an environment's step.
    entries = [
        f"{name!r}: columns[{index}]" for index, name in enumerate(names) if name != "saturated"
    ]
    flag = (
        f"columns[{names.index('saturated')}] > 0.0"
        if "saturated" in names
        else "columns[0] < columns[0]"
    )
    reader: Callable[[Sequence[object] | np.ndarray], Signals] = eval(
        f"lambda columns: {{{', '.join(entries)}, 'saturated': {flag}}}"
    )
    return reader


Force = float | np.ndarray
"""Desired force [N] or torque [N*m]: a number, or an array (n,) for several actuators."""
Scene = tuple[mujoco.MjModel, mujoco.MjData]
"""Model and data of a simulation in MuJoCo."""
Compiled = Callable[..., Any]
"""Function that numba compiled; its docstring gives the arguments, which numba checks by itself."""
NumbaTuple = Any
"""Tuple of arrays, numbers and tuples, whose type numba infers when it compiles a function."""


class Stepping(NamedTuple):
    """Compiled functions of a simulation, which `codrl_mj.physics.stepping` defines.

    `pointers` is the address of its `codrl_mj.physics.stepping.PointerTable`.
    """

    step: Callable[[Force, int], bool]
    """(force, pointers) -> True if the state is valid, within `MAX_STATE`: takes one environment
    step under a desired force [N or N*m], or an array (n,) of several. The actuators' signals are
    in `trace`.
    """
    start: Callable[[np.ndarray, float, int], None]
    """(state (n,), key, pointers) -> None, which starts an episode like `Physics.reset`."""
    read: Callable[[np.ndarray, int], None]
    """(state (n,), pointers) -> None, which fills `state` with the present state."""
    read_sensors: Callable[[np.ndarray, np.ndarray, int], None]
    """(row of trace (n, c), readings (n, k), pointers) -> None, which fills the sensors'
    `readings`.
    """


MAX_STATE = 1e10
"""Largest magnitude of a state entry, MuJoCo's `mjMAXVAL`. Beyond it MuJoCo warns and discards
forces, so that a diverging simulation may stay finite.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class SimulationConfig:
    """Settings of a simulation: a task, its actuators and the integration, for any physics.

    Raises:
        ValueError: the actuators are of several families.
    """

    task: Task
    """The task."""
    actuators: Sequence[ActuatorModel]
    """Actuators, one for each of the task's motors, all of one family."""
    inner_steps: int = 1
    """Integration steps per environment step."""
    integrator: str = ""
    """One of the task's integrators; the first by default."""
    max_forces: np.ndarray = None  # type: ignore[assignment]
    """Limits of the desired forces [N] or torques [N*m], shape (n,); those of the task by default.
    """
    disturbances: Disturbances = NO_DISTURBANCES
    """Imperfections of the commands, and load pulses."""
    joint: Joint = UNMODIFIED_JOINT
    """Quantities added to the actuated joints."""
    force_per_position: np.ndarray = None  # type: ignore[assignment]
    """Desired force [N or N*m] that corresponds to a position of 1 m or rad, shape (n,); 0 where
    commands are not positions.
    """
    options: Options = None
    """Options of the task, which may change its model; their defaults by default."""

    def __post_init__(self) -> None:
        """Fill in the task's defaults."""
        check_same_family(self.actuators)
        if not self.integrator:
            object.__setattr__(self, "integrator", self.task.integrators[0])
        # The dataclass is frozen, so defaults that depend on other fields are written past its
        # `__setattr__`.
        if self.max_forces is None:
            object.__setattr__(self, "max_forces", self.task.max_forces)
        if self.force_per_position is None:
            object.__setattr__(self, "force_per_position", np.zeros(len(self.max_forces)))
        if self.options is None:
            object.__setattr__(self, "options", self.task.options())

    @functools.cached_property
    def family(self) -> Family:
        """Family of the actuators."""
        return type(self.actuators[0])

    @property
    def motors_added(self) -> bool:
        """True unless all actuators are ideal."""
        return not issubclass(self.family, Ideal)

    @property
    def timestep(self) -> float:
        """Integration step [s]."""
        return self.task.step_duration / self.inner_steps

    def holding_forces(self, states: np.ndarray) -> np.ndarray:
        """Return the desired forces (m, n) that hold the positions in states (m, s).

        They are 0 where commands are forces and not positions.
        """
        task = self.task
        positions = states[:, [task.qpos[task.qvel.index(speed)] for speed in task.speed_indices]]
        return np.where(self.force_per_position != 0.0, self.force_per_position * positions, 0.0)


class Physics(abc.ABC):
    """One simulation of a task.

    A custom class is registered with `codrl_mj.physics.register_physics`. Its constructor must
    raise for everything that it cannot simulate.
    """

    stepping: Stepping | None = None
    """Compiled functions (see `codrl_mj.physics.stepping.Stepping`); None if a step is Python code.
    """
    pointers: int = 0
    """Address of the `PointerTable`, the last argument of the compiled functions; 0 if there are
    none.
    """
    pointer_table: np.ndarray
    """The table itself, int64; only with compiled functions."""
    bound_arrays: tuple[np.ndarray, ...] = ()
    """Arrays of the environment's options and observation that its compiled steps read and fill;
    empty until they are needed.
    """
    scene: Scene | None = None
    """`mujoco.MjModel` and `mujoco.MjData` of the simulation; None without MuJoCo."""

    state: np.ndarray
    """Mechanical state in the task's order, shape (n,), float64; later steps do not change the
    array. Setting it moves the simulation to a state and leaves the motor unchanged.
    """
    time: float
    """Time since the start of the episode [s]."""

    def __init__(self, simulation: SimulationConfig) -> None:
        """Store the configuration, and create the trace and the disturber."""
        self.simulation = simulation
        """Settings of the simulation."""
        self.trace = np.zeros(
            (simulation.inner_steps, len(simulation.actuators), len(trace_names(simulation.family)))
        )
        """Values of each actuator in each integration step of the last environment step, shape
        (inner_steps, actuators, columns), float64; columns as in `trace_names`. The next step
        overwrites the array.
        """
        self._disturber = Disturber(
            simulation.disturbances,
            simulation.timestep,
            simulation.max_forces,
            1,
            simulation.force_per_position,
        )

    @abc.abstractmethod
    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the actuators by others of their family; a reset must follow.

        The inertia and friction that they add to their joints are fields of the model, which this
        does not change: see `set_model`.
        """

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model, named as in `Variation.fields`; a reset must follow.

        Raises:
            ValueError: there are fields, but the simulation has no MuJoCo model.
        """
        if fields:
            physics_name = next(
                (name for name, make in PHYSICS.items() if make is type(self)), type(self).__name__
            )
            raise ValueError(
                f"fields = {', '.join(fields)}: only a MuJoCo model has such fields, not"
                f" {physics_name!r}; use 'mujoco'"
            )

    @abc.abstractmethod
    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode from `state`, with the actuators at rest.

        Args:
            state: the mechanical state.
            key: random key of the episode's disturbances and sensors.
        """

    @abc.abstractmethod
    def read_sensors(self, row: np.ndarray) -> np.ndarray:
        """Return the sensors' readings, shape (actuators, k), k as in the family's `OBSERVED`.

        Args:
            row: the last row of `trace`; zeros at the start of an episode.
        """

    @abc.abstractmethod
    def snapshot(self) -> np.ndarray:
        """Return the state of simulation and actuators as a vector, shape (k,), float64.

        It includes neither `memory` nor changes by `set_actuators` and `set_model`.
        """

    @abc.abstractmethod
    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from the result of `snapshot`."""

    @property
    def memory(self) -> np.ndarray:
        """State of the disturbances, a live array; empty without disturbances."""
        return self._disturber.memory.reshape(-1)

    @abc.abstractmethod
    def step(self, desired_force: Force) -> None:
        """Advance by one environment step at a constant desired force of at most `max_forces`.

        Args:
            desired_force: a number; for several actuators an array (n,).

        Raises:
            SimulationDivergedError: the state is no longer finite.
        """

    def check_finite(self) -> None:
        """Raise if a state entry is not finite or exceeds `MAX_STATE`.

        Raises:
            SimulationDivergedError: the simulation diverged.
        """
        state, task = self.state, self.simulation.task
        # This fast test, true if all entries are below about 1e5, suffices in nearly all steps. It
        # is false for NaN, too.
        if state @ state <= MAX_STATE:
            return
        is_valid = np.abs(state) <= MAX_STATE
        if is_valid.all():
            return
        invalid_entries = ", ".join(
            f"{n} = {v:g}"
            for n, v, valid in zip(task.state_names, state, is_valid, strict=True)
            if not valid
        )
        raise divergence_error(task.name, self.time, invalid_entries)

    def show(self, state: np.ndarray) -> None:
        """Move the bodies of `scene` to a state, for rendering; nothing else changes."""
        # Without a scene there is nothing to move.
        del state


PHYSICS: dict[str, Callable[[SimulationConfig], Physics]] = {}
"""Available physics by name: functions from a `SimulationConfig` to a simulation."""


class SimulationDivergedError(ArithmeticError):
    """The simulation is not finite, or exceeds the range that MuJoCo accepts."""


def divergence_error(
    name: str, time: float, invalid_entries: str, step_setting: str = "inner_steps"
) -> SimulationDivergedError:
    """Return the error of a simulation that diverged at a time [s].

    `step_setting` names the setting that determines its integration step.
    """
    return SimulationDivergedError(
        f"{name}: the simulation diverged at t = {time:g} s: {invalid_entries}. Reset the"
        f" environment; if this repeats, shorten the integration step ({step_setting})"
        " or lower the gains"
    )
