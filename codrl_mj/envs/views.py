"""What an agent gets of a state: observation, reward and end, by the task's compiled functions."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import Family
from codrl_mj.envs.outcomes import Outcomes, compiled_outcomes
from codrl_mj.tasks import Task


@dataclasses.dataclass(frozen=True)
class View:
    """A task's observations and rewards."""

    task: Task
    """The task."""
    options: Any
    """The task's options."""
    sensors: tuple[str, ...]
    """Names of what the actuators' sensors add to an observation; none if they are not observed."""

    @classmethod
    def build(cls, task: Task, options: Any, family: Family, observe_actuator: bool) -> "View":
        """A view of a task with its options; if `observe_actuator`, of what the sensors of its actuators say, too."""
        motors = dict.fromkeys(task.motors if len(task.motors) > 1 else ("",), family)
        sensors = sensor_names(motors)
        if observe_actuator:
            check_observed(sensors, motors)
        return cls(task, options, sensors if observe_actuator else ())

    @functools.cached_property
    def outcomes(self) -> Outcomes:
        """The task's compiled functions."""
        return compiled_outcomes(self.task)

    @functools.cached_property
    def option_values(self) -> np.ndarray:
        """The task's options as a vector."""
        return np.array(self.options, dtype=np.float64)

    @property
    def observation_space(self) -> spaces.Box:
        """The task's observation space, with unbounded entries for the sensors."""
        space = self.task.observation_space
        return longer(space, len(self.sensors)) if self.sensors else space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        return (*self.task.observation_names, *self.sensors)

    def observation(self, state: np.ndarray, seen: np.ndarray | None) -> np.ndarray:
        """What the agent sees in a mechanical state (n,): shape (k,), float32.

        `seen` is what the sensors say, as many numbers as there are `sensors`; None if there are none.
        """
        size = len(self.task.observation_names)
        observation = np.empty(size + len(self.sensors), np.float32)
        self.outcomes.observe(np.ascontiguousarray(state), observation)
        if seen is not None:
            observation[size:] = seen.reshape(-1)
        return observation

    def reward(self, before: np.ndarray, force: Any, after: np.ndarray) -> float:
        """The task's reward of a step that led from one state to another under a force [N or N*m], or several."""
        before, after = np.ascontiguousarray(before), np.ascontiguousarray(after)
        forces = np.ascontiguousarray(force, dtype=np.float64).reshape(-1)
        return float(self.outcomes.reward(before, forces if len(forces) > 1 else forces[0], after, self.option_values))

    def terminated(self, state: np.ndarray) -> bool:
        """Whether the task ends the episode in this state."""
        return bool(self.outcomes.terminated(np.ascontiguousarray(state)))


def sensor_names(motors: Mapping[str, Family]) -> tuple[str, ...]:
    """Names of what the sensors of motors, by theirs, say; a motor without a name needs none."""
    return tuple(f"{motor}.{name}" if motor else name for motor, one in motors.items() for name in one.OBSERVED)


def check_observed(sensors: tuple[str, ...], motors: Mapping[str, Family]) -> None:
    """Refuse to observe motors that have no sensors."""
    if not sensors:
        kinds = ", ".join(sorted({one.family or one.__name__ for one in motors.values()}))
        raise ValueError(
            f"observe_actuator=True: the {kinds} actuator has no current to observe, and nothing else; choose another"
        )


def longer(space: spaces.Space, count: int) -> spaces.Box:
    """An observation space, which must be of vectors, with some unbounded entries more."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"observe_actuator=True: observations are {space}, and only to vectors can be appended")
    low, high = (
        np.append(bound, np.full(count, value)) for bound, value in ((space.low, -np.inf), (space.high, np.inf))
    )
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
