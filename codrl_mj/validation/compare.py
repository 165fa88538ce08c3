"""Relative differences of states, and oracles read from Gymnasium's environments.

Differences are relative to the size of an entry; angles are compared on the circle.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.envs.classic_control import acrobot

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, spectral_radius
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.physics.base import Force
from codrl_mj.tasks import Task, resolve_actuators
from codrl_mj.tasks.base import Options

NO_REFERENCE_ENV = (
    "the task has no reference environment (Task.reference_env): there is no second"
    " implementation of its mechanics"
)
"""Reason for skipping checks that need a reference environment."""
PHYSICS = (("MuJoCo", MujocoPhysics), ("analytic", AnalyticPhysics))
FALLBACK_ACTUATOR = "default current loop"
"""Name of the actuator that replaces the paper's actuator in tasks without one."""


def differences(task: Task, ours: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """Return |ours - oracle| / max(1, |oracle|) for each entry of states of shape (..., n).

    Angles that the task wraps are compared on the circle while both lie within [-pi, pi].
    """
    gap = np.abs(ours - oracle)
    for entry in task.wrapped:
        # An angle outside of [-pi, pi] was not wrapped. Comparing it on the circle would hide that.
        inside = np.maximum(np.abs(ours[..., entry]), np.abs(oracle[..., entry])) <= np.pi
        other_way = np.abs(2 * np.pi - gap[..., entry])
        gap[..., entry] = np.where(inside, np.minimum(gap[..., entry], other_way), gap[..., entry])
    relative: np.ndarray = gap / np.maximum(1.0, np.abs(oracle))
    return relative


def is_built_in(task: Task) -> bool:
    """Return True if the task comes with this package."""
    return task.reward.__module__.startswith("codrl_mj.")


def missing_oracle_reason(task: Task) -> str:
    """Return the reason why a task cannot be compared with Gymnasium step by step, or ""."""
    reason = (
        "the task has several motors, and the commands of these checks are for one motor"
        if len(task.motors) > 1
        else ""
    )
    return NO_REFERENCE_ENV if task.reference_env is None else reason


def physics_pair(
    task: Task,
    actuator: ActuatorModel,
    integrator: str,
    max_force: float | None = None,
    options: Options = None,
) -> tuple[MujocoPhysics, AnalyticPhysics]:
    """Return a task's simulations in MuJoCo and with Gymnasium's equations.

    `max_force` replaces MuJoCo's limit of the desired force; `options` are the task's, None for
    their defaults.
    """
    steps = task.num_inner_steps(actuator, None, None)
    limits = task.max_forces if max_force is None else np.array([max_force])
    return (
        MujocoPhysics(
            SimulationConfig(task, [actuator], steps, integrator, limits, options=options)
        ),
        AnalyticPhysics(SimulationConfig(task, [actuator], steps, integrator, options=options)),
    )


def physics_classes(task: Task) -> tuple[tuple[str, type], ...]:
    """Return the names and classes of the physics that can simulate a task, MuJoCo first."""
    return PHYSICS if task.reference_env is not None else PHYSICS[:1]


def named_actuators(name: str, task: Task) -> tuple[ActuatorModel, ...]:
    """Return the named actuator for each motor of a task."""
    return _fallback_actuators(task) if name == FALLBACK_ACTUATOR else resolve_actuators(name, task)


def _fallback_actuators(task: Task) -> tuple[DCMotorActuator, ...]:
    """Return default current loops for all motors, sampled as often as they need to be stable."""
    timestep, actuator = task.step_duration / task.motor_inner_steps, DCMotorActuator()
    while not spectral_radius(actuator, timestep) < 1.0:
        actuator = DCMotorActuator(
            controller=CurrentLoop(substeps=2 * actuator.controller.substeps)
        )
    return (actuator,) * len(task.motors)


def paper_actuators(task: Task) -> tuple[DCMotorActuator, ...]:
    """Return the paper's actuators of a task, or `FALLBACK_ACTUATOR` for each motor."""
    return task.paper or _fallback_actuators(task)


def scaled_forces(task: Task, shares: np.ndarray) -> np.ndarray:
    """Return desired forces for `Physics.step`, one row per step, from shares of the largest force.

    `shares` has the shape (steps * motors,).
    """
    forces = task.max_forces * shares.reshape(-1, len(task.motors))
    scaled: np.ndarray = forces[:, 0] if len(task.motors) == 1 else forces
    return scaled


STATE_BOUNDS = {
    "max_speed": math.inf,
    "_max_speed": math.inf,
    "min_position": -math.inf,
    "max_position": math.inf,
}
"""Attribute that bounds the states of an environment -> value that removes the bound."""

Equations = Callable[[np.ndarray, Force], np.ndarray]
"""(mechanical state, force) -> derivative of the state."""
Slope = Callable[[np.ndarray], np.ndarray]
"""State -> its derivative."""
# Gymnasium's function has no types.
rk4: Callable[[Slope, np.ndarray, Sequence[float]], np.ndarray] = acrobot.rk4
"""(derivative, state, times) -> the state after steps of Gymnasium's Runge-Kutta method."""


def gymnasium_equations(task: Task, dt: float | None = None, options: Options = None) -> Equations:
    """Return the right-hand side of a task's equations of motion, read from its environment.

    No equation is copied. A reference environment may have its right-hand side as a method
    (Acrobot). The others take Euler steps, whose new velocity is v + a*dt. One step of the
    environment therefore gives the acceleration a = (v_new - v)/dt, and the derivative of a
    position is its velocity. The environment's bounds are removed. dt [s] is a power of two, or
    None for the largest one that is at most a quarter of an environment step. `options` are the
    task's, None for their defaults.
    """
    # A reference environment has few declared attributes; bounds are found by their names.
    env: Any = task.make_reference_env(options)
    if hasattr(env, "derivative"):
        equations: Equations = env.derivative
        return equations
    for owner, name in itertools.product((env, getattr(env, "env", None)), STATE_BOUNDS):
        if hasattr(owner, name):
            setattr(owner, name, STATE_BOUNDS[name])
    # A division by a power of two is exact, so that (v_new - v)/dt adds no rounding error.
    step = 2.0 ** math.floor(math.log2(task.step_duration / 4)) if dt is None else dt
    qpos, qvel, integrator = list(task.qpos), list(task.qvel), task.integrators[0]

    def derivative(state: np.ndarray, force: Force) -> np.ndarray:
        change = np.empty_like(state)
        change[qpos] = state[qvel]
        change[qvel] = (np.asarray(env(state, force, step, integrator))[qvel] - state[qvel]) / step
        return change

    return derivative
