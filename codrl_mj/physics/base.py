"""The small interface behind which a task is simulated."""

import math
import numbers
from typing import Any, NamedTuple, Protocol

import numpy as np

from codrl_mj.motor import Actuator
from codrl_mj.tasks import Task


class Signals(NamedTuple):
    """What the actuator did during one environment step; values at the end of its last integration step."""

    desired_force: float
    """Force asked for [N], or torque [N*m]."""
    actual_force: float
    """Force delivered [N], or torque [N*m]."""
    current: float
    """Motor current [A]; 0 for the ideal actuator, which has none."""
    reference_current: float
    """Current asked of the loop [A], by the command as it arrived; 0 for the ideal actuator."""
    voltage: float
    """Terminal voltage [V]; 0 for the ideal actuator."""
    saturated: bool
    """Whether the voltage was at its limit."""


TRACE_NAMES = ("desired_force", "actual_force", "current", "voltage", "speed", "saturated")
"""Columns of `Physics.trace`: the force [N or N*m] asked of the actuator (after whatever disturbs commands on their
way) and delivered in an integration step, the current [A] at its end, the voltage [V] of its last electrical step (both
0 for the ideal actuator), the velocity of the actuated joint [m/s or rad/s] at its end, and 1 where that voltage was at
its limit, else 0."""
(
    TRACE_DESIRED_FORCE,
    TRACE_ACTUAL_FORCE,
    TRACE_CURRENT,
    TRACE_VOLTAGE,
    TRACE_SPEED,
    TRACE_SATURATED,
) = range(len(TRACE_NAMES))


def ideal_signals(desired_force: float, command: float | None = None) -> Signals:
    """The signals of an ideal actuator: it delivers the command, and has no current and no voltage."""
    return Signals(desired_force, desired_force if command is None else command, 0.0, 0.0, 0.0, False)


def delivered(
    desired_force: Any,
    command: Any,
    current: Any,
    voltage: Any,
    arm: Any,
    torque_constant: Any,
    available: Any,
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """The signals of motors in the order of `Signals`, from numbers or arrays; numba compiles it as it stands.

    Args:
        desired_force: [N or N*m].
        command: what has become of the desired force on its way to the motor.
        current: [A].
        voltage: [V].
        arm: [m].
        torque_constant: [N*m/A].
        available: largest voltage [V].
    """
    return (
        desired_force,
        torque_constant * current / arm,
        current,
        command * arm / torque_constant,
        voltage,
        abs(voltage) >= available,
    )


def motor_signals(
    actuator: Actuator,
    desired_force: float,
    current: float,
    voltage: float,
    command: float | None = None,
    available: float | None = None,
) -> Signals:
    """The signals of a motor that was asked for `desired_force` and has reached `current` under `voltage`.

    Args:
        actuator: motor and current loop.
        desired_force: [N or N*m].
        current: [A].
        voltage: [V].
        command: what has become of the desired force on its way to the motor; None: nothing.
        available: the voltage limit [V], where it is not the controller's.
    """
    motor = actuator.motor
    command = desired_force if command is None else command
    limit = actuator.controller.max_voltage if available is None else available
    return Signals(*delivered(desired_force, command, current, voltage, motor.arm_radius, motor.torque_constant, limit))


class Physics(Protocol):
    """One simulation of one task."""

    trace: np.ndarray
    """What the actuator did in each integration step of the last environment step, shape (inner_steps, 6), float64;
    columns as in `TRACE_NAMES`. A live array: the next step overwrites it."""

    @property
    def state(self) -> np.ndarray:
        """The mechanical state in the task's order, shape (n,), float64; not changed by later steps."""

    def set_actuator(self, actuator: Actuator) -> None:
        """Exchange the motor for another; to be followed by a reset. An ideal actuator cannot be exchanged."""

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode from `state`, with the motor at rest: no current, no integral, no past error.

        Args:
            state: the mechanical state.
            key: of the random numbers of the episode's disturbances.
        """

    def sensed(self, signals: Signals) -> Signals:
        """Signals of the present moment with the current [A] that the sensor measures."""

    def snapshot(self) -> np.ndarray:
        """Simulation and motor as a vector, shape (k,), float64; `memory` and exchanged parameters are not in it."""

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember beside, a live array; empty if nothing."""

    def step(self, desired_force: float) -> Signals:
        """Advance by one environment step, with the desired force (at most the task's `max_force`) held over it.

        Raises:
            SimulationDivergedError: the state is no longer finite.
        """


class SimulationDivergedError(ArithmeticError):
    """A simulation left the finite numbers, or the range in which MuJoCo trusts its own."""


LARGEST = 1e10
"""Largest magnitude of a state entry: MuJoCo's `mjMAXVAL`, beyond which it warns and discards forces. A diverging motor
need not reach infinity there."""


def check_finite(task: Task, state: np.ndarray, time: float) -> None:
    """Raise if `state` is not finite or beyond `LARGEST`, saying which entry of which task and when.

    Raises:
        SimulationDivergedError: as it says.
    """
    if state @ state <= LARGEST:  # the quick answer; false for NaN too
        return
    fine = np.abs(state) <= LARGEST
    if fine.all():
        return
    broken = ", ".join(f"{n} = {v:g}" for n, v, ok in zip(task.state_names, state, fine, strict=True) if not ok)
    raise SimulationDivergedError(
        f"{task.name}: the simulation diverged at t = {time:g} s: {broken}. Reset the environment; if this repeats, "
        "shorten the integration step (inner_steps) or lower the gains"
    )


def inner_step_count(task: Task, actuator: Actuator | None, inner_steps: int | None, timestep: float | None) -> int:
    """Integration steps in one environment step.

    Args:
        task: the task, whose `step_duration` they divide.
        actuator: with a motor the default is the paper's inner loop, without one Gymnasium's single step.
        inner_steps: their number, or None.
        timestep: the integration step [s], or None; give at most one of the two.

    Raises:
        ValueError: both were given, the number is below 1, or the timestep does not divide the environment step.
    """
    if inner_steps is not None and timestep is not None:
        raise ValueError(f"inner_steps = {inner_steps} and timestep = {timestep:g}: give one of them, not both")
    if timestep is not None:
        if not (math.isfinite(timestep) and timestep > 0):
            raise ValueError(f"timestep = {timestep}: must be a finite number > 0 [s]")
        count = round(task.step_duration / timestep)
        if count < 1 or not math.isclose(count * timestep, task.step_duration, rel_tol=1e-9):
            raise ValueError(
                f"timestep = {timestep:g} s does not divide {task.name}'s environment step of "
                f"{task.step_duration:g} s: the ratio is {task.step_duration / timestep:.6g}, must be an integer >= 1"
            )
        return count
    if inner_steps is None:
        return 1 if actuator is None else task.motor_inner_steps
    if isinstance(inner_steps, bool) or not isinstance(inner_steps, numbers.Integral) or inner_steps < 1:
        raise ValueError(f"inner_steps = {inner_steps!r}: must be an integer >= 1")
    return int(inner_steps)


def check_integrator(task: Task, integrator: str | None) -> str:
    """The integrator's name, defaulting to Gymnasium's.

    Raises:
        ValueError: the task has no such integrator.
    """
    if integrator is None:
        return task.integrators[0]
    if integrator not in task.integrators:
        raise ValueError(f"integrator = {integrator!r}: {task.name} has {', '.join(task.integrators)}")
    return integrator
