"""The small interface behind which a task is simulated."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, Ideal, check_same_family
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint
from codrl_mj.physics.disturber import Disturber
from codrl_mj.tasks import Task

Signals = dict[str, Any]
"""What the actuators did during one environment step, by name: `desired_force` and `actual_force`
[N or N*m], the family's signals at the end of the last integration step, and `saturated`. Numbers
for a task with one actuator; arrays (n,) for one with several; in a batch one axis more, the first.
"""


def trace_names(family: Family) -> tuple[str, ...]:
    """Columns of `Physics.trace`.

    The force [N or N*m] asked of the actuator in an integration step (after whatever disturbs
    commands on their way) and delivered in it, the family's signals at its end, and the velocity of
    the actuated joint [m/s or rad/s] at its end.
    """
    return ("desired_force", "actual_force", *family.Signals._fields, "speed")


def signal_names(family: Family) -> tuple[str, ...]:
    """Keys of `Signals`, in order."""
    return (*(name for name in trace_names(family)[:-1] if name != "saturated"), "saturated")


@functools.cache
def make_info_reader(names: tuple[str, ...]) -> Callable[[Any], Signals]:
    """What names the first columns, numbers of one actuator or arrays of several; `saturated`, a flag, is the last.

    It is false, in the columns' shape, of a family that has none. Written out, as `namedtuple` is:
    with a loop it would take a tenth of an environment's step.
    """
    entries = [f"{name!r}: columns[{at}]" for at, name in enumerate(names) if name != "saturated"]
    flag = (
        f"columns[{names.index('saturated')}] > 0.0"
        if "saturated" in names
        else "columns[0] < columns[0]"
    )
    return eval(f"lambda columns: {{{', '.join(entries)}, 'saturated': {flag}}}")


MAX_STATE = 1e10
"""Largest magnitude of a state entry: MuJoCo's `mjMAXVAL`, beyond which it warns and discards
forces. A diverging motor need not reach infinity there.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class SimulationConfig:
    """What is simulated: a task and its actuators, and how finely; every physics is made of one.

    Raises:
        ValueError: the actuators are of several families.
    """

    task: Task
    """The task."""
    actuators: Sequence[ActuatorModel]
    """What stands between desired and delivered force, one for each of the task's motors, of one family."""
    inner_steps: int = 1
    """Integration steps per environment step."""
    integrator: str = ""
    """One of the task's integrators, the first of them unless told otherwise."""
    max_forces: np.ndarray = None  # type: ignore[assignment]
    """Limits of the desired forces [N] or torques [N*m], shape (n,); the task's unless told otherwise."""
    disturbances: Disturbances = NO_DISTURBANCES
    """Imperfections of the commands' way, and load pulses."""
    joint: Joint = UNMODIFIED_JOINT
    """What is added to the actuated joints."""
    force_per_position: np.ndarray = None  # type: ignore[assignment]
    """Desired force [N or N*m] that stands for a position of 1 m or rad, shape (n,); 0 where commands are none."""

    def __post_init__(self) -> None:
        """Fill in what is the task's."""
        check_same_family(self.actuators)
        if not self.integrator:
            object.__setattr__(self, "integrator", self.task.integrators[0])
        if self.max_forces is None:
            object.__setattr__(self, "max_forces", self.task.max_forces)
        if self.force_per_position is None:
            object.__setattr__(self, "force_per_position", np.zeros(len(self.max_forces)))

    @functools.cached_property
    def family(self) -> Family:
        """The actuators' family."""
        return type(self.actuators[0])

    @property
    def motors_added(self) -> bool:
        """Whether the actuators are any but the ideal one."""
        return not issubclass(self.family, Ideal)

    @property
    def timestep(self) -> float:
        """Integration step [s]."""
        return self.task.step_duration / self.inner_steps

    def holding_forces(self, states: np.ndarray) -> np.ndarray:
        """Return the desired forces that hold states (m, s) there, shape (m, n): 0 unless commands are positions."""
        task = self.task
        positions = states[:, [task.qpos[task.qvel.index(speed)] for speed in task.speeds]]
        return np.where(self.force_per_position != 0.0, self.force_per_position * positions, 0.0)


class Physics(abc.ABC):
    """One simulation of a plant.

    Somebody's own is given to `codrl_mj.physics.register_physics`. What it cannot simulate it
    refuses when it is made.
    """

    stepping: Any = None
    """The compiled functions of a loop (see `codrl_mj.physics.stepping.Stepping`); None where a step is Python."""
    pointers: int = 0
    """Their last argument, an address; 0 where there are none."""
    bound_arrays: tuple[Any, ...] = ()
    """An environment's options and observation, which its compiled steps read and fill, where these were asked for."""
    scene: tuple[Any, Any] | None = None
    """The `mujoco.MjModel` and `mujoco.MjData` that it runs on; None where there are none."""

    state: np.ndarray
    """The mechanical state in the task's order, shape (n,), float64; not changed by later steps.
    Set, it moves the simulation there, the motor left as it is.
    """
    time: float
    """Since the start of the episode [s]."""

    def __init__(self, simulation: SimulationConfig) -> None:
        """Take what is simulated, and make what one of it needs on any physics."""
        self.simulation = simulation
        """What is simulated."""
        self.trace = np.zeros(
            (simulation.inner_steps, len(simulation.actuators), len(trace_names(simulation.family)))
        )
        """What each actuator did in each integration step of the last environment step, shape
        (inner_steps, actuators, columns), float64; columns as in `trace_names`. A live array: the
        next step overwrites it.
        """
        self._disturber = Disturber(
            simulation.disturbances, simulation.timestep, simulation.max_forces, 1, simulation.force_per_position
        )

    @abc.abstractmethod
    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Exchange the actuators for others of their family; to be followed by a reset.

        What they add to their joints is the model's: see `set_model`.
        """

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model, as `codrl_mj.physics.variation.Variation.fields` has them; then a reset follows.

        Raises:
            ValueError: it has no such fields, because it is not on a MuJoCo model; none at all is
                never refused.
        """
        if fields:
            own = next(
                (name for name, make in PHYSICS.items() if make is type(self)), type(self).__name__
            )
            raise ValueError(
                f"fields = {', '.join(fields)}: they are a MuJoCo model's, which {own!r} has not;"
                " use 'mujoco'"
            )

    @abc.abstractmethod
    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode from `state`, with the actuators at rest.

        Args:
            state: the mechanical state.
            key: of the random numbers of the episode's disturbances and sensors.
        """

    @abc.abstractmethod
    def read_sensors(self, row: np.ndarray) -> np.ndarray:
        """What the sensors say at present, shape (actuators, k), with k as the family's `OBSERVED`.

        Args:
            row: the last row of `trace`; zeros at the start of an episode.
        """

    @abc.abstractmethod
    def snapshot(self) -> np.ndarray:
        """Simulation and actuators as a vector, shape (k,), float64, without `memory` and exchanged parameters."""

    @abc.abstractmethod
    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember beside, a live array; empty if nothing."""
        return self._disturber.memory.reshape(-1)

    @abc.abstractmethod
    def step(self, desired_force: Any) -> None:
        """Advance by one environment step, with the desired force (at most the plant's `max_forces`) held over it.

        Args:
            desired_force: a number; for several actuators an array (n,).

        Raises:
            SimulationDivergedError: the state is no longer finite.
        """

    def check_finite(self) -> None:
        """Raise if the state left the finite numbers or is beyond `MAX_STATE`, saying which entry and when.

        Raises:
            SimulationDivergedError: it did.
        """
        state, task = self.state, self.simulation.task
        if state @ state <= MAX_STATE:  # the quick answer: all are below 1e5; false for NaN too
            return
        fine = np.abs(state) <= MAX_STATE
        if fine.all():
            return
        broken = ", ".join(
            f"{n} = {v:g}" for n, v, ok in zip(task.state_names, state, fine, strict=True) if not ok
        )
        raise divergence_error(task.name, self.time, broken)

    def show(self, state: np.ndarray) -> None:
        """Bring the bodies of `scene` to a state, for drawing; the simulation is left alone otherwise."""
        del state  # without a scene


PHYSICS: dict[str, Callable[[SimulationConfig], Any]] = {}
"""The physics that an environment can be built on, by name: what makes a simulation of a plant."""


class SimulationDivergedError(ArithmeticError):
    """A simulation left the finite numbers, or the range in which MuJoCo trusts its own."""


def divergence_error(
    who: str, time: float, broken: str, step: str = "inner_steps"
) -> SimulationDivergedError:
    """The error of an environment whose simulation broke down at a time [s], with what sets its integration step."""
    return SimulationDivergedError(
        f"{who}: the simulation diverged at t = {time:g} s: {broken}. Reset the environment; if"
        f" this repeats, shorten the integration step ({step}) or lower the gains"
    )
