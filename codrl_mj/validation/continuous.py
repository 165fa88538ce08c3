"""The continuous equations behind a task, taken from the installed Gymnasium, and solved by scipy to 12 digits."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import integrate

from codrl_mj.actuators import Actuator, ActuatorModel
from codrl_mj.tasks import Task
from codrl_mj.validation.compare import twin_of

Equations = Callable[[np.ndarray, float], np.ndarray]
"""(mechanical state, force [N or N*m]) -> its time derivative."""


def gymnasium_equations(task: Task) -> Equations:
    """The right-hand side of the task's equations of motion, read off the unmodified environment.

    No equation is written down here. Acrobot's environment has its right-hand side as a method. The others take Euler
    steps, whose new velocity is v + a*dt, linear in dt: one step of the environment gives a = (v_new - v)/dt, and the
    derivative of a position is its velocity. dt is a power of two and no longer than a quarter of an environment step.
    """
    if task.name == "acrobot":
        derivatives = twin_of(task)._env._dsdt
        return lambda state, force: np.array(derivatives([*state, force]))[: len(state)]
    driver = twin_of(task)
    dt = 2.0 ** math.floor(math.log2(task.step_duration / 4))
    qpos, qvel, integrator = list(task.qpos), list(task.qvel), task.integrators[0]

    def derivative(state: np.ndarray, force: float) -> np.ndarray:
        change = np.empty_like(state)
        change[qpos] = state[qvel]
        change[qvel] = (np.asarray(driver(state, force, dt, integrator))[qvel] - state[qvel]) / dt
        return change

    return derivative


class Solution(NamedTuple):
    """The solution at the ends of the environment steps."""

    states: np.ndarray
    """Mechanical states, shape (steps, n)."""
    currents: np.ndarray
    """Motor currents [A], shape (steps,); zeros without a motor."""


def solve(task: Task, start: np.ndarray, forces: np.ndarray, actuator: ActuatorModel) -> Solution:
    """Solve the continuous equations by scipy's DOP853 at a relative tolerance of 1e-12.

    With a motor they are joined by those of its circuit and its analogue PI loop,
    L di/dt = u - kE*omega - R*i, u = kP*e + kI*I + kFF*i_ref (+ kE*omega), dI/dt = e, torque = kT*i.

    Args:
        task: the task.
        start: initial mechanical state; the motor starts at rest.
        forces: desired force, held over each environment step.
        actuator: the ideal one, or a motor under a loop without derivative gain and filters, and never saturated.
    """
    equations = gymnasium_equations(task)
    size, speed = len(start), task.speeds[0]

    def derivative(_: float, state: np.ndarray, desired: float) -> np.ndarray:
        if not isinstance(actuator, Actuator):
            return equations(state, desired)
        motor, loop = actuator.motor, actuator.controller
        current, integral = state[size:]
        reference = desired * motor.arm_radius / motor.torque_constant
        back_emf = motor.back_emf_constant * state[speed] / motor.arm_radius
        error = reference - current
        voltage = loop.kp * error + loop.ki * integral + loop.kff * reference + loop.bemf_compensation * back_emf
        slope = (voltage - back_emf - motor.resistance * current) / motor.inductance
        mechanical = equations(state[:size], motor.torque_constant * current / motor.arm_radius)
        return np.concatenate([mechanical, [slope, error]])

    motorised = isinstance(actuator, Actuator)
    state, rows = np.concatenate([start, [0.0, 0.0] if motorised else []]), []
    span = (0.0, task.step_duration)
    for force in forces:
        found = integrate.solve_ivp(derivative, span, state, "DOP853", rtol=1e-12, atol=1e-15, args=(float(force),))
        state = found.y[:, -1]
        rows.append(state)
    solved = np.array(rows)
    return Solution(solved[:, :size], solved[:, size] if motorised else np.zeros(len(forces)))
