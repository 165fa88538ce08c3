"""How states are compared: relative to their size, angles on the circle, a NaN worse than anything."""

import math
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, trace_names
from codrl_mj.physics.base import inner_step_count
from codrl_mj.tasks import TASKS, Task

CERTIFIED: dict[str, Task] = {
    name: TASKS[name] for name in ("pendulum", "cartpole", "acrobot", "mountain_car", "mountain_car_continuous")
}
"""The tasks of the certificate: the package's own, for which it has states, runs and bounds."""

WRAPPED: dict[str, tuple[int, ...]] = {"acrobot": (0, 1)}
"""State entries that a task wraps to [-pi, pi]: a rounding error at the cut is one, and not a whole turn."""


class Worst:
    """The largest difference seen and where; a NaN is larger than anything, and stays."""

    def __init__(self) -> None:
        """Nothing was seen yet."""
        self.value = 0.0
        self.where = "everywhere: there is no difference"

    def see(self, difference: float, where: str) -> None:
        """Look at one more difference."""
        if not (difference <= self.value or math.isnan(self.value)):
            self.value, self.where = float(difference), where


def differences(task: Task, ours: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """|ours - oracle| / max(1, |oracle|), entry by entry.

    Args:
        task: the task whose states they are.
        ours: states, shape (..., n).
        oracle: states, shape (..., n).

    Returns:
        Shape (..., n). Entries that the task wraps are compared on the circle while both lie within [-pi, pi].
    """
    gap = np.abs(ours - oracle)
    for entry in WRAPPED.get(task.name, ()):
        inside = np.maximum(np.abs(ours[..., entry]), np.abs(oracle[..., entry])) <= np.pi
        turn = np.abs(2 * np.pi - gap[..., entry])
        gap[..., entry] = np.where(inside, np.minimum(gap[..., entry], turn), gap[..., entry])
    return gap / np.maximum(1.0, np.abs(oracle))


def largest(task: Task, ours: np.ndarray, oracle: np.ndarray) -> tuple[float, int, str]:
    """The largest of the `differences` of states of shape (N, n), its row and the name of its entry; a NaN first."""
    gaps = differences(task, ours, oracle)
    row, entry = divmod(int(np.argmax(np.where(np.isnan(gaps), np.inf, gaps))), gaps.shape[1])
    return float(gaps[row, entry]), row, task.state_names[entry]


def both(
    task: Task, actuator: ActuatorModel, integrator: str, max_force: float | None = None
) -> tuple[MujocoPhysics, AnalyticPhysics]:
    """The task in MuJoCo, and on Gymnasium's equations; `max_force` changes MuJoCo's limit of the desired force."""
    steps = inner_step_count(task, actuator, None, None)
    limits = None if max_force is None else np.array([max_force])
    return (
        MujocoPhysics(task, [actuator], steps, integrator, limits),
        AnalyticPhysics(task, [actuator], steps, integrator),
    )


def twin_of(task: Task) -> Any:
    """The Gymnasium environment that a task of the certificate rebuilds, driven by any force."""
    assert task.twin is not None
    return task.twin()


def last_signals(physics: MujocoPhysics | AnalyticPhysics) -> dict[str, float]:
    """What the actuator did in the last integration step, by the names of `trace_names`."""
    return dict(zip(trace_names(physics.family), physics.trace[-1, 0].tolist(), strict=True))
