"""The actuators of simulations: what they are, take as commands, draw, sense and report.

A bank prepares and names what happens between two environment steps. What happens within a step is
compiled: the step of a task reads the sensors itself (`observe_row` in `envs/compiled.py`), and a
backend in `engine/` advances the actuators one after the other.

Environments hold one `ActuatorBank` each. `TaskBank` is that of our tasks, whose actuators MuJoCo's
control callback drives; `ModelBank` is that of third-party models, whose actuators the plugin
drives.
"""

import abc
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Family
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import Space
from codrl_mj.envs.randomization import Randomization, RandomizationState


class ActuatorBank(abc.ABC):
    """The actuators of N simulations; N = 1 except for a vector environment of a task."""

    def __init__(
        self,
        names: tuple[str, ...],
        sensors: tuple[str, ...],
        action_space: Space,
        randomization: RandomizationState,
        needs_key: bool,
    ) -> None:
        """Store what all kinds of simulations have."""
        self.names = names
        """Names of a simulation's motors, in the model's order."""
        self.sensors = sensors
        """Names of the values that sensors append to an observation; empty if none is observed."""
        self.action_space = action_space
        """Actions of one environment."""
        self.randomization = randomization
        """Distributions of the motors' and the model's fields, and the present values."""
        self.needs_key = needs_key
        """True if an episode's disturbances or sensors need a random key."""

    @property
    @abc.abstractmethod
    def motors(self) -> Mapping[int, ActuatorModel]:
        """Index of a motor -> motor of the present episode, in the first simulation."""

    @property
    @abc.abstractmethod
    def signal_names(self) -> tuple[str, ...]:
        """Names of the motors' signals in `info`."""

    @property
    @abc.abstractmethod
    def memory(self) -> np.ndarray:
        """Delayed commands and scheduled pulses, a live array (N, k); k = 0 without disturbances.

        The motors' own state is a part of the simulation's.
        """

    def keys(self, random: Callable[[int], np.ndarray]) -> np.ndarray:
        """Return the random keys of m episodes, shape (m,); a single 0 if none is needed.

        A key selects the counter-based random numbers of disturbances and sensors. `random` is a
        function (count) -> draws in [0, 1), shape (m, count).
        """
        if not self.needs_key:
            return np.zeros(1)
        # The product is exactly an integer: draws are multiples of 2**-53, the factor is 2**53.
        return random(1)[:, 0] * MAX_KEY

    def key(self, generator: np.random.Generator) -> float:
        """Return the random key of the only simulation's episode; see `keys`."""
        return float(self.keys(lambda count: generator.random((1, count)))[0])

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state that a simulation does not hold: delayed commands and drawn values."""
        delayed = {"disturbances": self.memory.copy()} if self.memory.size else {}
        return delayed | self.randomization.snapshot()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Restore commands, motors and models; the simulations must be restored afterwards."""
        self.randomization.restore(snapshot)
        if self.memory.size:
            self.memory[:] = snapshot["disturbances"]


def needs_key(
    actuators: Iterable[ActuatorModel], disturbances: Disturbances, randomization: Randomization
) -> bool:
    """Return True if disturbances or sensors, of present or drawn actuators, need a random key."""
    draws_numbers = disturbances.random or randomization.may_need_key
    return draws_numbers or any(actuator.random for actuator in actuators)


def sensor_names(motors: Mapping[str, Family]) -> tuple[str, ...]:
    """Return the names of the motors' sensors, with the motor's name in front if it has one.

    Raises:
        ValueError: the motors have no sensors.
    """
    sensors = tuple(
        f"{motor}.{name}" if motor else name
        for motor, family in motors.items()
        for name in family.OBSERVED
    )
    if not sensors:
        kinds = ", ".join(sorted({family.family or family.__name__ for family in motors.values()}))
        raise ValueError(
            f"observe_actuator=True: the {kinds} actuator has no current and no other signal to"
            " observe; choose another actuator"
        )
    return sensors


def extend_space(space: Space, count: int) -> spaces.Box:
    """Return a vector observation space with `count` additional unbounded entries."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"observe_actuator=True: observations are {space}: must be vectors")
    low, high = (
        np.append(bound, np.full(count, value))
        for bound, value in ((space.low, -np.inf), (space.high, np.inf))
    )
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
