"""What an agent gets of a state: observation, reward and end, by the task's compiled functions."""

import dataclasses
import functools
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import Family
from codrl_mj.envs.outcomes import Outcomes, compiled_outcomes
from codrl_mj.physics import Signals
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
        """A view of a task with its options; if `observe_actuator`, of what the sensors of its actuators say, too.

        Raises:
            ValueError: they have none.
        """
        if observe_actuator and not family.OBSERVED:
            raise ValueError(
                f"observe_actuator=True: the {family.family or family.__name__} actuator has no current to observe, "
                "and nothing else; choose another"
            )
        motors = task.motors if observe_actuator else ()
        single = len(task.motors) == 1
        names = tuple(name if single else f"{motor}.{name}" for motor in motors for name in family.OBSERVED)
        return cls(task, options, names)

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
        if not self.sensors:
            return space
        inf = np.full(len(self.sensors), np.inf)
        low, high = np.append(space.low, -inf), np.append(space.high, inf)
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

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


def signals_of(row: np.ndarray, family: Family, desired: Any, tracks: bool) -> Signals:
    """The last row of a simulation's trace, shape (motors, columns), as signals.

    The force [N or N*m] that was asked for counts as `desired` if the actuator `tracks` it; else what was delivered.
    """
    names = ("desired_force", "actual_force", *family.Signals._fields)
    several = len(row) > 1
    values = row.T.copy() if several else row[0].tolist()
    signals = dict(zip(names, values, strict=False))
    signals["desired_force"] = desired if tracks else signals["actual_force"]
    saturated = signals.pop("saturated", np.zeros(len(row)) if several else 0.0)
    signals["saturated"] = saturated != 0.0
    return signals


def signals_of_rows(rows: np.ndarray, family: Family, desired: np.ndarray, tracks: bool) -> Signals:
    """The same of N simulations, (columns, N, motors), without their desired forces (N,) or (N, motors)."""
    shape = desired.shape
    signals = dict(zip(("actual_force", *family.Signals._fields), rows.reshape(-1, *shape), strict=True))
    saturated = signals.pop("saturated", np.zeros(shape))
    return {"desired_force": desired if tracks else signals["actual_force"], **signals, "saturated": saturated != 0.0}
