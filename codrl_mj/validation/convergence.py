"""As the step shrinks, MuJoCo and Gymnasium's dynamics become one solution, at the order their integrators promise.

The solution is scipy's, of equations taken from Gymnasium (`gymnasium_equations`), or, of a task
that has no twin there, of the accelerations that MuJoCo finds: that checks its integrator and the
motors. With the ideal actuator the Euler variants promise first order and RK4, under a force held
over the step, fourth. With a motor all promise first order: its winding takes Euler steps, and its
torque is held over the mechanical step.

The runs stay away from bounds and walls (`free_run`): a clip is not smooth, and the step at which
it acts moves with the step size. What happens at the bounds is compared step by step elsewhere.

The last check makes the current loop faster instead. Its PI gains cancel the winding's pole, kI =
kP*R/L, which leaves a first-order lag of time constant tau = L/kP. A force that lags by tau moves
the mechanics as if switched tau too late: the actuated task approaches Gymnasium's at first order
in tau.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.classic_control.acrobot import rk4
from scipy import integrate

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, Motor
from codrl_mj.physics import (
    MujocoPhysics,
    SimulationConfig,
    SimulationDivergedError,
    install_callbacks,
)
from codrl_mj.physics.mjcf import task_model
from codrl_mj.tasks import PAPER_TASKS, Task, find_task
from codrl_mj.validation.compare import (
    NO_TWIN,
    Equations,
    actuators_named,
    actuators_of,
    forces_of,
    gymnasium_equations,
    is_ours,
    physics_of,
)
from codrl_mj.validation.table import (
    ORDER_TOLERANCE,
    REPORT,
    Case,
    Check,
    Family,
    Skipped,
    check,
    of_order,
    order,
)


def free_run(task: Task) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The run of `Task.reference_states`, the same every time; of a task that has none, a few steps from one of its starts.

    Its initial state, the desired forces, full either way and each held for one environment step,
    and the first of these, over which energies are balanced.
    """
    trials = task.reference_states
    steps, balanced = (6, 2) if trials is None else (trials.steps, trials.balanced_steps)
    start = (
        task.draw_initial_state(np.random.default_rng(3), None)
        if trials is None
        else np.array(trials.start)
    )
    forces = forces_of(task, np.random.default_rng(3).choice([-1.0, 1.0], steps * len(task.motors)))
    return start, forces, forces[:balanced]


def obstacle(task: Task) -> str:
    """Why the run of somebody's task is not smooth; empty if it is."""
    if task in PAPER_TASKS:  # whose runs are tested
        return ""
    start, forces, _ = free_run(task)
    free = dataclasses.replace(task, step_duration=task.step_duration / 16, constrain=None)
    physics = MujocoPhysics(SimulationConfig(free, actuators_named("ideal", task)))
    physics.reset(start)
    for force in forces.repeat(16, axis=0):
        try:
            physics.step(force)
        except SimulationDivergedError as error:
            return str(error)
        if physics.data.nefc:
            return (
                "a contact, a limit, friction or another constraint acts in the run: name another"
                " in Task.reference_states"
            )
        if task.constrain is not None:
            kept = np.array(task.constrain(physics.state, free.step_duration))
            if not np.array_equal(kept, physics.state):
                return "the run meets the task's bounds: name another in Task.reference_states"
    return ""


def _states(
    kind: type, task: Task, actuators: Sequence[ActuatorModel], inner_steps: int, integrator: str
) -> np.ndarray:
    """Mechanical states after each environment step of the task's free run."""
    start, forces, _ = free_run(task)
    physics = kind(SimulationConfig(task, actuators, inner_steps, integrator))
    physics.reset(start)
    rows = []
    for force in forces:
        try:
            physics.step(force)
        except SimulationDivergedError:
            return np.full((len(forces), len(start)), np.nan)
        rows.append(physics.state)
    return np.array(rows)


def _error(states: np.ndarray, solution: np.ndarray) -> float:
    """Largest difference of any entry, relative to the entry's largest size in the run."""
    return float((np.abs(states - solution).max(axis=0) / np.abs(solution).max(axis=0)).max())


def engine_equations(task: Task) -> Equations:
    """The accelerations that MuJoCo's `mj_forward` finds, whatever its integrator makes of them."""
    model = task_model(
        SimulationConfig(
            task, actuators_named("ideal", task), max_forces=np.full(len(task.motors), 1e9)
        )
    )
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


def solve(
    task: Task,
    equations: Equations,
    start: np.ndarray,
    forces: np.ndarray,
    actuators: Sequence[ActuatorModel],
    inner_steps: int = 0,
    fourth: bool = False,
) -> np.ndarray:
    """Mechanical states, shape (steps, n), at the ends of the environment steps, the forces held over each.

    They are found by scipy's DOP853 at a relative tolerance of 1e-12; with `inner_steps` by as many
    textbook steps: Gymnasium's Runge-Kutta of fourth order, or Euler's.

    With motors they are joined by those of each circuit and its analogue PI loop, L di/dt = u -
    kE*omega - R*i, u = kP*e + kI*I + kFF*i_ref (+ kE*omega), dI/dt = e, torque = kT*i; such a loop
    has no derivative gain and no filter, is never saturated, and starts at rest.
    """
    size, motors = len(start), [one for one in actuators if isinstance(one, DCMotorActuator)]

    def derivative(_: float, state: np.ndarray, desired: np.ndarray) -> np.ndarray:
        delivered, electrical = [*desired], []
        for at, actuator in enumerate(motors):
            motor, loop = actuator.motor, actuator.controller
            current, integral = state[size + 2 * at : size + 2 * at + 2]
            reference = desired[at] * motor.arm_radius / motor.torque_constant
            back_emf = motor.back_emf_constant * state[task.speed_indices[at]] / motor.arm_radius
            error = reference - current
            voltage = (
                loop.kp * error
                + loop.ki * integral
                + loop.kff * reference
                + loop.bemf_compensation * back_emf
            )
            electrical += [
                (voltage - back_emf - motor.resistance * current) / motor.inductance,
                error,
            ]
            delivered[at] = motor.torque_constant * current / motor.arm_radius
        force = delivered[0] if len(delivered) == 1 else np.array(delivered)
        return np.concatenate([equations(state[:size], force), electrical])

    state, rows = np.concatenate([start, np.zeros(2 * len(motors))]), []
    span, step = (0.0, task.step_duration), task.step_duration / max(inner_steps, 1)
    for force in forces:
        given = (np.atleast_1d(force),)
        if not inner_steps:
            found = integrate.solve_ivp(
                derivative, span, state, "DOP853", rtol=1e-12, atol=1e-15, args=given
            )
            state = found.y[:, -1]
        slope = functools.partial(derivative, 0.0, desired=given[0])
        for _ in range(inner_steps):
            state = rk4(slope, state, [0.0, step]) if fourth else state + step * slope(state)
        rows.append(state[:size])
    return np.array(rows)


def analogues(task: Task) -> tuple[DCMotorActuator, ...]:
    """The task's actuators without derivative, limit and back-EMF compensation: their loops have a smooth limit.

    The paper's kD is a difference of two samples, whose limit is an impulse wherever the command
    jumps; the compensation would hide the back-EMF.
    """
    smooth = {"kd": 0.0, "max_voltage": math.inf, "bemf_compensation": False, "integral_leak": 0.0}
    changes = {f"controller.{name}": value for name, value in smooth.items()}
    return tuple(one.replaced(changes) for one in actuators_of(task))


def halvings(task: Task, most: int = 4) -> range:
    """Return how many times more the steps of a run are halved, in turn, until its errors show an order."""
    first = (
        2 if task.reference_states is None else 0
    )  # in a run that nobody chose the first steps are finer
    return range(first, first + (1 if is_ours(task) else most + 1), 2)


def refined(task: Task, judged: Callable[[int], Case], most: int = 4) -> Case:
    """Return what is found at the coarsest steps at which errors have the promised order, or at the finest."""
    for finer in halvings(task, most):
        case = judged(finer)
        if case.gaps <= ORDER_TOLERANCE:
            break
    return case


def blamed(
    task: Task, outcome: Check, judged: Callable[[int], tuple[float, str]], promised: float
) -> Check | Skipped:
    """Return a failed check of somebody's task with whose fault it is: the run's, if textbook steps fail it as well."""
    if outcome.passed or is_ours(task):
        return outcome
    distance, found = min(map(judged, halvings(task)))
    if distance <= ORDER_TOLERANCE:
        return dataclasses.replace(
            outcome, fault=f"textbook steps of such sizes have this order: {REPORT}"
        )
    why = (
        f"{found}, where {promised:g} was promised: the run is too violent for these steps, or not"
        " smooth"
    )
    return Skipped(
        outcome.name, f"{why}. Name a gentler one in Task.reference_states, or a smaller max_force"
    )


def _counts(
    task: Task, fourth: bool, motors: Sequence[Motor], finer: int, quick: bool
) -> np.ndarray:
    """Return the integration steps in an environment step, which are compared."""
    if fourth:
        return 2 ** (np.arange(2, 6 if quick else 7) + finer)
    if not motors:
        return 2 ** ((np.arange(3, 7) if quick else np.arange(4, 9)) + finer)
    # A quarter of the winding's time constant, and shorter; in a run that nobody chose also of the
    # motion's.
    resolved = task.step_duration / (min(motor.electrical_time_constant for motor in motors) / 4)
    first = math.ceil(math.log2(max(resolved, 4))) + finer - halvings(task)[0]
    return 2 ** (first + (np.arange(0, 4) if quick else np.arange(1, 6)))


@check("convergence", order("order, {integrator}, {case}", "DOP853 at 1e-12 on {whose}"))
def order_in_the_step(
    task: Task,
    case: str,
    integrator: str,
    actuators: Sequence[ActuatorModel],
    solution: np.ndarray,
    counts: Callable[[int], np.ndarray],
    promised: float,
) -> Iterator[Case]:
    """The solution's errors vanish as the integrator promises."""

    def judged(finer: int) -> Case:
        families = []
        for label, kind in physics_of(task):
            errors = [
                _error(_states(kind, task, actuators, int(one), integrator), solution)
                for one in counts(finer)
            ]
            steps = task.step_duration / counts(finer)
            families.append(Family(label, steps, np.array(errors), 1e-12))  # the solution's
        title, y_label = (
            f"{task.name}, {integrator}, {case}",
            "largest error of the state [relative]",
        )
        return of_order(promised, families, title, "integration step [s]", y_label)

    yield refined(task, judged)


@check(
    "convergence", order("rate in the loop's bandwidth", "{whose} with the desired force itself")
)
def rate_in_the_bandwidth(task: Task, quick: bool) -> Iterator[Case]:
    """The lag is resolved by two integration steps at every bandwidth; both runs take the same steps."""
    integrator, physics = task.integrators[0], physics_of(task)
    motors = [Motor(arm_radius=actuator.motor.arm_radius) for actuator in actuators_of(task)]

    def judged(finer: int) -> Case:
        lags = task.step_duration / 2 ** (
            (np.arange(3, 7) if quick else np.arange(4, 9)) + finer
        )  # tau [s]
        errors: dict[str, list[float]] = {label: [] for label, _ in physics}
        for lag in lags:
            count = round(2 * task.step_duration / lag)
            kp = motors[0].inductance / lag
            loop = CurrentLoop(
                kp=kp, ki=kp * motors[0].resistance / motors[0].inductance, max_voltage=math.inf
            )
            actuators = [DCMotorActuator(motor, loop) for motor in motors]
            ideal = _states(physics[-1][1], task, actuators_named("ideal", task), count, integrator)
            for label, kind in physics:
                errors[label].append(
                    _error(_states(kind, task, actuators, count, integrator), ideal)
                )
        bandwidth = 1 / (2 * np.pi * lags)
        families = [Family(label, bandwidth, np.array(found)) for label, found in errors.items()]
        title = f"{task.name}: the actuated task approaches the ideal one"
        x_label = "bandwidth of the current loop [Hz]"
        return of_order(
            -1.0, families, title, x_label, "largest difference of the state [relative]"
        )

    yield refined(task, judged)


def _textbook(
    task: Task, solved: Any, solution: np.ndarray, counts: Any, promised: float, finer: int
) -> Any:
    """Return how far textbook steps of the same equations are from the promised order, and the finding in words."""
    errors = [_error(solved(int(count)), solution) for count in counts(finer)]
    return Family(
        "textbook steps", task.step_duration / counts(finer), np.array(errors), 1e-12
    ).judged(promised)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of convergence."""
    task = find_task(task_name)
    reason = obstacle(task)
    if reason:
        yield Skipped("all checks", reason)
        return
    if task.reference_env is None:
        yield Skipped("equations of motion that are not MuJoCo's", NO_TWIN)
        equations, whose, named = engine_equations(task), "MuJoCo's own accelerations", "MuJoCo"
    else:
        equations, whose, named = (
            gymnasium_equations(task),
            f"the equations of {task.oracle}",
            task.oracle,
        )
    start, forces, _ = free_run(task)
    for case, actuators in (
        ("ideal actuator", actuators_named("ideal", task)),
        ("motor in the loop", analogues(task)),
    ):
        solved = functools.partial(solve, task, equations, start, forces, actuators)
        solution, motors = (
            solved(),
            [one.motor for one in actuators if isinstance(one, DCMotorActuator)],
        )
        said = whose if case == "ideal actuator" else f"{whose} and of the motor"
        for integrator in task.integrators:
            fourth = integrator == "rk4" and not motors
            promised, counts = (
                4.0 if fourth else 1.0,
                functools.partial(_counts, task, fourth, motors, quick=quick),
            )
            steps = functools.partial(solved, fourth=fourth)
            textbook = functools.partial(_textbook, task, steps, solution, counts, promised)
            for outcome in order_in_the_step(
                task, case, integrator, actuators, solution, counts, promised, whose=said
            ):
                yield blamed(task, outcome, textbook, promised)
    yield from rate_in_the_bandwidth(task, quick, whose=named)
