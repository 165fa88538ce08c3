"""Runs that stay away from bounds, walls and wrapped angles, where the equations of a task are smooth."""

from typing import NamedTuple

import numpy as np

from codrl_mj.tasks import Task


class FreeRun(NamedTuple):
    """A start and the number of steps for which the task stays free."""

    start: tuple[float, ...]
    """Initial state."""
    steps: int
    """Environment steps."""
    balanced_steps: int
    """Of these, the first ones over which energies are balanced, with integration steps many times finer."""


RUNS: dict[str, FreeRun] = {
    # swings below 8 rad/s
    "pendulum": FreeRun((2.0, 0.5), 20, 8),
    # the pole falls to about a right angle
    "cartpole": FreeRun((0.1, -0.2, 0.1, 0.3), 30, 10),
    # a large swing, angles within half a turn, speeds below 4 pi
    "acrobot": FreeRun((2.0, 0.5, 0.0, 0.0), 7, 5),
    # between the walls, below 0.07 m/s
    "mountain_car": FreeRun((-0.5, 0.02), 12, 2),
    "mountain_car_continuous": FreeRun((-0.5, 0.02), 12, 2),
}
"""One run for each task."""


def commands(task: Task) -> np.ndarray:
    """The run's desired forces: full force either way, each held for one environment step, the same every time."""
    signs = np.random.default_rng(3).choice([-1.0, 1.0], RUNS[task.name].steps)
    return task.max_force * signs
