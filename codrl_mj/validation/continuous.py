"""The continuous equations behind a task, taken from its twin where it has one, and solved by scipy to 12 digits."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from scipy import integrate

from codrl_mj.actuators import IDEAL, Actuator, ActuatorModel
from codrl_mj.physics import Plant, install_callbacks
from codrl_mj.physics.mjcf import task_model
from codrl_mj.tasks import Task

BOUNDS = {"max_speed": math.inf, "_max_speed": math.inf, "min_position": -math.inf, "max_position": math.inf}
"""Attributes of environments and their twins that bound a state, and what bounds none."""

Equations = Callable[[np.ndarray, Any], np.ndarray]
"""(mechanical state, force [N or N*m], of several motors an array) -> its time derivative."""


def equations_of(task: Task) -> tuple[Equations, str]:
    """The right-hand side of a task's equations of motion, and whose it is."""
    if task.twin is None:
        return engine_equations(task), "MuJoCo's own accelerations"
    return gymnasium_equations(task), f"the equations of {task.oracle}"


def engine_equations(task: Task) -> Equations:
    """The accelerations that MuJoCo's `mj_forward` finds, whatever its integrator makes of them."""
    model = task_model(Plant(task, (IDEAL,) * len(task.motors), max_forces=np.full(len(task.motors), 1e9)))
    install_callbacks(model)
    data, qpos, qvel = mujoco.MjData(model), list(task.qpos), list(task.qvel)
    controls = [model.actuator_ctrladr[model.actuator(name).id] for name in task.motors]

    def derivative(state: np.ndarray, force: Any) -> np.ndarray:
        data.qpos[:], data.qvel[:], data.ctrl[controls] = state[qpos], state[qvel], force
        mujoco.mj_forward(model, data)
        change = np.empty_like(state)
        change[qpos], change[qvel] = state[qvel], data.qacc
        return change

    return derivative


def gymnasium_equations(task: Task, dt: float | None = None) -> Equations:
    """The right-hand side of the task's equations of motion, read off the environment, which nothing bounds here.

    No equation is written down here. A twin may have its right-hand side as a method (Acrobot). The others take Euler
    steps, whose new velocity is v + a*dt, linear in dt: one step of the environment gives a = (v_new - v)/dt, and the
    derivative of a position is its velocity. dt [s] is a power of two, or None for one of at most a quarter of an
    environment step.
    """
    assert task.twin is not None
    driver: Any = task.twin()
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
        change[qvel] = (np.asarray(driver(state, force, step, integrator))[qvel] - state[qvel]) / step
        return change

    return derivative


def solve(
    task: Task, equations: Equations, start: np.ndarray, forces: np.ndarray, actuators: Sequence[ActuatorModel]
) -> np.ndarray:
    """Mechanical states, shape (steps, n), at the ends of the environment steps, the forces held over each.

    They are found by scipy's DOP853 at a relative tolerance of 1e-12.

    With motors they are joined by those of each circuit and its analogue PI loop,
    L di/dt = u - kE*omega - R*i, u = kP*e + kI*I + kFF*i_ref (+ kE*omega), dI/dt = e, torque = kT*i;
    such a loop has no derivative gain and no filter, is never saturated, and starts at rest.
    """
    size, motors = len(start), [one for one in actuators if isinstance(one, Actuator)]

    def derivative(_: float, state: np.ndarray, desired: np.ndarray) -> np.ndarray:
        delivered, electrical = [*desired], []
        for at, actuator in enumerate(motors):
            motor, loop = actuator.motor, actuator.controller
            current, integral = state[size + 2 * at : size + 2 * at + 2]
            reference = desired[at] * motor.arm_radius / motor.torque_constant
            back_emf = motor.back_emf_constant * state[task.speeds[at]] / motor.arm_radius
            error = reference - current
            voltage = loop.kp * error + loop.ki * integral + loop.kff * reference + loop.bemf_compensation * back_emf
            electrical += [(voltage - back_emf - motor.resistance * current) / motor.inductance, error]
            delivered[at] = motor.torque_constant * current / motor.arm_radius
        force = delivered[0] if len(delivered) == 1 else np.array(delivered)
        return np.concatenate([equations(state[:size], force), electrical])

    state, rows = np.concatenate([start, np.zeros(2 * len(motors))]), []
    span = (0.0, task.step_duration)
    for force in forces:
        found = integrate.solve_ivp(
            derivative, span, state, "DOP853", rtol=1e-12, atol=1e-15, args=(np.atleast_1d(force),)
        )
        state = found.y[:, -1]
        rows.append(state[:size])
    return np.array(rows)
