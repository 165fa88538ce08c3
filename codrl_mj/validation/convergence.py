"""As the step shrinks, MuJoCo and Gymnasium's dynamics become one solution, at the order their integrators promise.

The solution is scipy's, of equations taken from Gymnasium (`codrl_mj.validation.continuous`). With the ideal actuator
the Euler variants promise first order and RK4, under a force held over the step, fourth. With a motor all promise first
order: its winding takes Euler steps, and its torque is held over the mechanical step.

The runs stay away from bounds and walls (`codrl_mj.validation.free_runs`): a clip is not smooth, and the step at which
it acts moves with the step size. What happens at the bounds is compared step by step elsewhere.

The last check makes the current loop faster instead. Its PI gains cancel the winding's pole, kI = kP*R/L, which leaves
a first-order lag of time constant tau = L/kP. A force that lags by tau moves the mechanics as if switched tau too late:
the actuated task approaches Gymnasium's at first order in tau.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from codrl_mj.actuators import IDEAL, Actuator, ActuatorModel, CurrentLoop, Motor
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import Task
from codrl_mj.validation.compare import CERTIFIED
from codrl_mj.validation.continuous import solve
from codrl_mj.validation.free_runs import RUNS, commands
from codrl_mj.validation.order import Family, order_check
from codrl_mj.validation.outcome import Check, Plot

PHYSICS = (("MuJoCo", MujocoPhysics), ("analytic", AnalyticPhysics))


def _states(kind: type, task: Task, actuator: ActuatorModel, inner_steps: int, integrator: str) -> np.ndarray:
    """Mechanical states after each environment step of the task's free run."""
    physics = kind(task, [actuator], inner_steps, integrator)
    physics.reset(np.array(RUNS[task.name].start))
    rows = []
    for force in commands(task):
        try:
            physics.step(float(force))
        except SimulationDivergedError:
            return np.full((RUNS[task.name].steps, len(task.state_names)), np.nan)
        rows.append(physics.state)
    return np.array(rows)


def _error(states: np.ndarray, solution: np.ndarray) -> float:
    """Largest difference of any entry, relative to the entry's largest size in the run."""
    return float((np.abs(states - solution).max(axis=0) / np.abs(solution).max(axis=0)).max())


def analogue(actuator: Actuator) -> Actuator:
    """An actuator without derivative, limit and back-EMF compensation: its loop has a smooth limit of small steps.

    The paper's kD is a difference of two samples, whose limit is an impulse wherever the command jumps; the
    compensation would hide the back-EMF.
    """
    loop = dataclasses.replace(
        actuator.controller, kd=0.0, max_voltage=math.inf, bemf_compensation=False, integral_leak=0.0
    )
    return dataclasses.replace(actuator, controller=loop)


def _order_check(task: Task, integrator: str, actuator: ActuatorModel, solution: np.ndarray, quick: bool) -> Check:
    promised = 4.0 if integrator == "rk4" and actuator is IDEAL else 1.0
    if promised == 4.0:
        counts = 2 ** np.arange(2, 6 if quick else 7)
    elif not isinstance(actuator, Actuator):
        counts = 2 ** (np.arange(3, 7) if quick else np.arange(4, 9))
    else:  # a quarter of the winding's time constant, and shorter
        resolved = task.step_duration / (actuator.motor.electrical_time_constant / 4)
        counts = 2 ** (math.ceil(math.log2(max(resolved, 4))) + (np.arange(0, 4) if quick else np.arange(1, 6)))
    families = []
    for label, kind in PHYSICS:
        errors = [_error(_states(kind, task, actuator, int(count), integrator), solution) for count in counts]
        families.append(Family(label, task.step_duration / counts, np.array(errors)))
    oracle = f"DOP853 at 1e-12 on the equations of Gymnasium {task.gymnasium_id}"
    case = "ideal actuator" if actuator is IDEAL else "motor in the loop"
    oracle += "" if actuator is IDEAL else " and of the motor"
    plot = Plot(
        f"{task.name}, {integrator}, {case}", "integration step [s]", "largest error of the state [relative]", ()
    )
    return order_check(f"order, {integrator}, {case}", oracle, families, promised, plot, "convergence", task.name)


def _bandwidth_check(task: Task, quick: bool) -> Check:
    """The lag is resolved by two integration steps at every bandwidth; both runs take the same steps."""
    lags = task.step_duration / 2 ** (np.arange(3, 7) if quick else np.arange(4, 9))  # tau [s]
    integrator, motor = task.integrators[0], Motor(arm_radius=task.paper[0].motor.arm_radius)
    errors: tuple[list[float], ...] = ([], [])
    for lag in lags:
        count = round(2 * task.step_duration / lag)
        kp = motor.inductance / lag
        loop = CurrentLoop(kp=kp, ki=kp * motor.resistance / motor.inductance, max_voltage=math.inf)
        ideal = _states(AnalyticPhysics, task, IDEAL, count, integrator)
        for found, (_, kind) in zip(errors, PHYSICS, strict=True):
            found.append(_error(_states(kind, task, Actuator(motor, loop), count, integrator), ideal))
    bandwidth = 1 / (2 * np.pi * lags)
    families = [Family(label, bandwidth, np.array(found)) for found, (label, _) in zip(errors, PHYSICS, strict=True)]
    plot = Plot(
        f"{task.name}: the actuated task approaches the ideal one",
        "bandwidth of the current loop [Hz]",
        "largest difference of the state [relative]",
        (),
    )
    oracle = f"Gymnasium {task.gymnasium_id} with the desired force itself"
    return order_check("rate in the loop's bandwidth", oracle, families, -1.0, plot, "convergence", task.name)


def checks(task_name: str | None, quick: bool = False) -> Iterator[Check]:
    """The checks of convergence.

    Args:
        task_name: the task; None checks all tasks.
        quick: fewer and coarser steps.

    Raises:
        KeyError: no such task.
    """
    for task in CERTIFIED.values() if task_name is None else [CERTIFIED[task_name]]:
        for actuator in (IDEAL, analogue(task.paper[0])):
            solution = solve(task, np.array(RUNS[task.name].start), commands(task), actuator).states
            for integrator in task.integrators:
                yield _order_check(task, integrator, actuator, solution, quick)
        yield _bandwidth_check(task, quick)
