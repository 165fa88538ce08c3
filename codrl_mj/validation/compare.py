"""What is compared, and how: relative to its size, angles on the circle, a NaN worse than anything.

And with what: Gymnasium's equations of motion, read off its environments.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, spectral_radius
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.tasks import Task, resolve_actuators

NO_TWIN = (
    "it rebuilds no environment of Gymnasium's: there is no second implementation of its mechanics"
)
PHYSICS = (("MuJoCo", MujocoPhysics), ("analytic", AnalyticPhysics))
STAND_IN = "default current loop"
"""What stands in for the paper's actuator where a task has none."""


def differences(task: Task, ours: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """|ours - oracle| / max(1, |oracle|), entry by entry, of states of shape (..., n).

    Entries that the task wraps are compared on the circle while both lie within [-pi, pi].
    """
    gap = np.abs(ours - oracle)
    for entry in task.wrapped:
        inside = np.maximum(np.abs(ours[..., entry]), np.abs(oracle[..., entry])) <= np.pi
        turn = np.abs(2 * np.pi - gap[..., entry])
        gap[..., entry] = np.where(inside, np.minimum(gap[..., entry], turn), gap[..., entry])
    return gap / np.maximum(1.0, np.abs(oracle))


def is_ours(task: Task) -> bool:
    """Return True if the task comes with this package."""
    return task.reward.__module__.startswith("codrl_mj.")


def without_oracle(task: Task) -> str:
    """Why a task cannot be compared with Gymnasium step by step; empty if it can."""
    several = "it has several motors, and commands are made for one" if len(task.motors) > 1 else ""
    return NO_TWIN if task.reference_env is None else several


def both(
    task: Task, actuator: ActuatorModel, integrator: str, max_force: float | None = None
) -> tuple[MujocoPhysics, AnalyticPhysics]:
    """The task in MuJoCo, and on Gymnasium's equations; `max_force` changes MuJoCo's limit of the desired force."""
    steps = task.num_inner_steps(actuator, None, None)
    limits = task.max_forces if max_force is None else np.array([max_force])
    return (
        MujocoPhysics(SimulationConfig(task, [actuator], steps, integrator, limits)),
        AnalyticPhysics(SimulationConfig(task, [actuator], steps, integrator)),
    )


def physics_of(task: Task) -> tuple[tuple[str, type], ...]:
    """The physics that a task can be simulated by, MuJoCo first."""
    return PHYSICS if task.reference_env is not None else PHYSICS[:1]


def actuators_named(name: str, task: Task) -> tuple[Any, ...]:
    """One actuator for each motor of a task: a named one, or `STAND_IN`, sampled as often as it needs to be stable."""
    if name != STAND_IN:
        return resolve_actuators(name, task)
    timestep, actuator = task.step_duration / task.motor_inner_steps, DCMotorActuator()
    while not spectral_radius(actuator, timestep) < 1.0:
        actuator = DCMotorActuator(
            controller=CurrentLoop(substeps=2 * actuator.controller.substeps)
        )
    return (actuator,) * len(task.motors)


def actuators_of(task: Task) -> tuple[DCMotorActuator, ...]:
    """The paper's actuators of a task, one for each motor; of a task that has none, those that stand in for them."""
    return task.paper or actuators_named(STAND_IN, task)


def forces_of(task: Task, shares: np.ndarray) -> np.ndarray:
    """Desired forces, row by row what `Physics.step` takes, from shares of the largest, shape (steps * motors,)."""
    forces = task.max_forces * shares.reshape(-1, len(task.motors))
    return forces[:, 0] if len(task.motors) == 1 else forces


BOUNDS = {
    "max_speed": math.inf,
    "_max_speed": math.inf,
    "min_position": -math.inf,
    "max_position": math.inf,
}
"""Attributes of environments and their twins that bound a state, and what bounds none."""

Equations = Callable[[np.ndarray, Any], np.ndarray]
"""(mechanical state, force [N or N*m], of several motors an array) -> its time derivative."""


def gymnasium_equations(task: Task, dt: float | None = None) -> Equations:
    """The right-hand side of the task's equations of motion, read off the environment, which nothing bounds here.

    No equation is written down here. A twin may have its right-hand side as a method (Acrobot). The
    others take Euler steps, whose new velocity is v + a*dt, linear in dt: one step of the
    environment gives a = (v_new - v)/dt, and the derivative of a position is its velocity. dt [s]
    is a power of two, or None for one of at most a quarter of an environment step.
    """
    assert task.reference_env is not None
    driver: Any = task.reference_env()
    if hasattr(driver, "derivative"):
        return driver.derivative
    for owner, name in itertools.product((driver, getattr(driver, "env", None)), BOUNDS):
        if hasattr(owner, name):
            setattr(owner, name, BOUNDS[name])
    step = 2.0 ** math.floor(math.log2(task.step_duration / 4)) if dt is None else dt
    qpos, qvel, integrator = list(task.qpos), list(task.qvel), task.integrators[0]

    def derivative(state: np.ndarray, force: float) -> np.ndarray:
        change = np.empty_like(state)
        change[qpos] = state[qvel]
        change[qvel] = (
            np.asarray(driver(state, force, step, integrator))[qvel] - state[qvel]
        ) / step
        return change

    return derivative
