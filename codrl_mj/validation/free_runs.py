"""Runs that stay away from bounds, walls and wrapped angles, where the equations of a task are smooth."""

import dataclasses
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import OURS, Task
from codrl_mj.validation.compare import forces_of


class FreeRun(NamedTuple):
    """A run, the same every time."""

    start: np.ndarray
    """Initial state."""
    forces: np.ndarray
    """Desired forces: full force either way, each held for one environment step."""
    balanced: np.ndarray
    """The first of these, over which energies are balanced."""


def free_run(task: Task) -> FreeRun:
    """The run of `Task.trials`; of a task that has none, a few steps from one of its starts."""
    trials = task.trials
    steps, balanced = (6, 2) if trials is None else (trials.steps, trials.balanced_steps)
    start = task.initial(np.random.default_rng(3), None) if trials is None else np.array(trials.start)
    forces = forces_of(task, np.random.default_rng(3).choice([-1.0, 1.0], steps * len(task.motors)))
    return FreeRun(start, forces, forces[:balanced])


def obstacle(task: Task) -> str:
    """Why the run of somebody's task is not smooth; empty if it is."""
    if task in OURS:  # whose runs are tested
        return ""
    start, forces, _ = free_run(task)
    free = dataclasses.replace(task, step_duration=task.step_duration / 16, constrain=None)
    physics = MujocoPhysics(free, (IDEAL,) * len(task.motors), 1, task.integrators[0])
    physics.reset(start)
    for force in forces.repeat(16, axis=0):
        try:
            physics.step(force)
        except SimulationDivergedError as error:
            return str(error)
        if physics.data.nefc:
            return "a contact, a limit, friction or another constraint acts in the run: name another in Task.trials"
        if task.constrain is not None:
            kept = np.array(task.constrain(physics.state, free.step_duration))
            if not np.array_equal(kept, physics.state):
                return "the run meets the task's bounds: name another in Task.trials"
    return ""
