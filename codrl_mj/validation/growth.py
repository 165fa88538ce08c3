"""How fast errors grow along a run: what rounding must become in a chaotic system, whoever computes it.

The oracle's step is linearised along the run by finite differences: the state of mechanics and motor is displaced by a
small amount along each of its entries, the rest being as in the run. The product of these matrices carries

- one displacement, scaled back after every step: the mean rate of its growth is Benettin's estimate of the largest
  Lyapunov exponent, of the driven system along this run;
- the covariance of independent rounding errors, one in every entry at every step: P <- M P M' + Q.
"""

import copy
import math

import numpy as np

from codrl_mj.physics import AnalyticPhysics
from codrl_mj.tasks import Task

APART = 1e-7
"""A displacement, relative to max(1, size): far above rounding, far below anything that bends."""
ROUNDING = float(np.finfo(float).eps)
CLOCK = 2
"""A snapshot of `AnalyticPhysics` ends with time and key; before them are the states of mechanics and motor."""


class Growth:
    """Follows an analytic physics and records how errors grow along its run."""

    def __init__(self, task: Task, run: AnalyticPhysics, seed: int) -> None:
        """Make the simulation that is displaced.

        Args:
            task: the task.
            run: the run to follow, at its beginning.
            seed: of the direction of the first displacement.
        """
        self._run = run
        self._twin = copy.deepcopy(run)
        self._size = len(task.state_names)
        self._start = run.snapshot()
        entries = len(self._start) - CLOCK
        direction = np.random.default_rng(seed).standard_normal(entries)
        self._direction = direction / np.linalg.norm(direction)
        self._covariance = np.zeros((entries, entries))
        self.logarithms = [0.0]
        """Logarithm of the displacement's growth since the beginning, after each step."""
        self.rounding: list[float] = []
        """Standard deviation of the accumulated rounding errors after each step, relative to max(1, size)."""

    def follow(self, desired_force: float) -> None:
        """The run has just taken a step: linearise it."""
        twin, size, entries = self._twin, self._size, len(self._direction)
        end = self._run.snapshot()
        matrix = np.empty((entries, entries))
        for entry in range(entries):
            apart = APART * max(1.0, abs(self._start[entry]))
            displaced = self._start.copy()
            displaced[entry] += apart
            twin.restore(displaced)
            twin.step(desired_force)
            gap = (twin.snapshot() - end)[:entries]
            gap[:size] -= 2 * math.pi * np.round(gap[:size] / (2 * math.pi))  # one of them was wrapped
            matrix[:, entry] = gap / apart
        moved = matrix @ self._direction
        length = float(np.linalg.norm(moved))
        self.logarithms.append(self.logarithms[-1] + math.log(max(length, ROUNDING)))
        self._direction = moved / length if length > ROUNDING else self._direction  # a wall stopped both
        scale = np.maximum(1.0, np.abs(end[:entries]))
        self._covariance = matrix @ self._covariance @ matrix.T + np.diag((ROUNDING * scale) ** 2)
        self.rounding.append(float((np.sqrt(np.diag(self._covariance)) / scale)[:size].max()))
        self._start = end


def lyapunov_exponent(logarithms: np.ndarray, step_duration: float) -> float:
    """The mean rate of growth [1/s], by least squares through the logarithms."""
    times = step_duration * np.arange(len(logarithms))
    return float(np.polyfit(times, logarithms, 1)[0])
