"""Pairs of our environments and Gymnasium's, for comparison."""

import gymnasium as gym
import numpy as np
import pytest

import codrl_mj  # noqa: F401 - registers the environments
from codrl_mj.tasks import PAPER_TASKS, TASKS

REBUILT = tuple(task.name for task in PAPER_TASKS)
"""Names of the tasks of Gymnasium and the paper."""
every_rebuilt = pytest.mark.parametrize("task", REBUILT)
NEW = ("pendulum", "acrobot", "mountain_car", "mountain_car_continuous")
WITH_HILL = ("mountain_car", "mountain_car_continuous")

# Task -> lowest and highest state to draw from, slightly beyond the bounds of a step.
SPEED_LIMITED = {
    "pendulum": ([-10.0, -8.5], [10.0, 8.5]),
    "cartpole": ([-2.5, -3.0, -0.3, -3.0], [2.5, 3.0, 0.3, 3.0]),
    "acrobot": ([-np.pi, -np.pi, -4 * np.pi, -9 * np.pi], [np.pi, np.pi, 4 * np.pi, 9 * np.pi]),
    "mountain_car": ([-1.25, -0.075], [0.65, 0.075]),
    "mountain_car_continuous": ([-1.25, -0.075], [0.65, 0.075]),
}


def ours(task, **arguments):
    """Create our environment of a task, with its time limit."""
    return gym.make(TASKS[task].env_id, disable_env_checker=True, **arguments)


def gymnasiums(task):
    """Create the Gymnasium environment that the task rebuilds, with its time limit."""
    return gym.make(TASKS[task].gymnasium_id, disable_env_checker=True)


def actions(task, seed, count, dtype=np.float64):
    """Return random actions of a task; continuous ones are float64 unless `dtype` is float32."""
    generator = np.random.default_rng(seed)
    space = TASKS[task].action_space
    if isinstance(space, gym.spaces.Discrete):
        return [int(action) for action in generator.integers(space.n, size=count)]
    return list(generator.uniform(space.low, space.high, size=(count, 1)).astype(dtype))


def desired_force(task, action):
    """Return the desired force of an action within the bounds."""
    forces = TASKS[task].forces
    return float(action[0] if forces is None else forces[action])


def random_states(task, seed, count):
    """Return states from the whole state space of a task, shape (count, n)."""
    low, high = SPEED_LIMITED[task]
    return np.random.default_rng(seed).uniform(low, high, size=(count, len(low)))
