"""Orders at which MuJoCo and Gymnasium's dynamics converge to one solution as the step shrinks.

The solution is computed by scipy from the equations of motion of Gymnasium's environment
(`gymnasium_equations`). For a task without a reference environment it is computed from MuJoCo's
accelerations, which still checks the integrator and the motors. With the ideal actuator and a force
that is held over the step, the Euler variants promise first order and RK4 fourth order. With a
motor all promise first order, because its winding takes Euler steps and its torque is held over the
mechanical step.

The runs stay away from bounds and walls (`free_run`): a clip is not smooth, and the step at which
it acts moves with the step size. What happens at the bounds is compared step by step elsewhere.

The last check makes the current loop faster instead. Its PI gains cancel the winding's pole, kI =
kP*R/L, which leaves a first-order lag of time constant tau = L/kP. A force that lags by tau moves
the mechanics as if it were switched tau too late, so the actuated task approaches Gymnasium's at
first order in tau.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from scipy import integrate

from codrl_mj.actuators import ActuatorModel, CurrentLoop, DCMotorActuator, Motor
from codrl_mj.physics import (
    MujocoPhysics,
    SimulationConfig,
    SimulationDivergedError,
    install_callbacks,
)
from codrl_mj.physics.base import Force
from codrl_mj.physics.mjcf import task_model
from codrl_mj.tasks import PAPER_TASKS, Task, find_task
from codrl_mj.validation.compare import (
    NO_REFERENCE_ENV,
    Equations,
    gymnasium_equations,
    is_built_in,
    named_actuators,
    paper_actuators,
    physics_classes,
    rk4,
    scaled_forces,
)
from codrl_mj.validation.table import (
    ORDER_TOLERANCE,
    REPORT,
    Case,
    Check,
    ConvergenceSeries,
    Skipped,
    check,
    order_case,
    order_check,
)


def free_run(task: Task) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return initial state and forces of the run of `Task.reference_states`.

    A task without them gets a short run. The run is the same on every call.

    Returns:
        Initial state; desired forces, the largest ones in random directions, each held for one
        environment step; and the first of these forces, over which the energies are balanced.
    """
    reference = task.reference_states
    steps, balanced = (6, 2) if reference is None else (reference.steps, reference.balanced_steps)
    start = (
        task.draw_initial_state(np.random.default_rng(3), None)
        if reference is None
        else np.array(reference.start)
    )
    forces = scaled_forces(
        task, np.random.default_rng(3).choice([-1.0, 1.0], steps * len(task.motors))
    )
    return start, forces, forces[:balanced]


def nonsmooth_reason(task: Task) -> str:
    """Return the reason why the run of a custom task is not smooth, or "" if it is smooth."""
    # The runs of built-in tasks are covered by the tests.
    if task in PAPER_TASKS:
        return ""
    start, forces, _ = free_run(task)
    free = dataclasses.replace(task, step_duration=task.step_duration / 16, constrain=None)
    physics = MujocoPhysics(SimulationConfig(free, named_actuators("ideal", task)))
    physics.reset(start)
    for force in forces.repeat(16, axis=0):
        try:
            physics.step(force)
        except SimulationDivergedError as error:
            return str(error)
        if physics.data.nefc:
            return (
                "a contact, a limit, friction or another constraint acts in the run: name another"
                " run in Task.reference_states"
            )
        if task.constrain is not None:
            constrained = np.array(task.constrain(physics.state, free.step_duration))
            if not np.array_equal(constrained, physics.state):
                return "the run meets the task's bounds: name another run in Task.reference_states"
    return ""


def _simulated_states(
    kind: type, task: Task, actuators: Sequence[ActuatorModel], inner_steps: int, integrator: str
) -> np.ndarray:
    """Return the mechanical states after each environment step of the task's free run."""
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
    """Return the largest difference of any entry, relative to the entry's maximum in the run."""
    return float((np.abs(states - solution).max(axis=0) / np.abs(solution).max(axis=0)).max())


def engine_equations(task: Task) -> Equations:
    """Return equations of motion with the accelerations of `mj_forward`, without its integrator."""
    model = task_model(
        SimulationConfig(
            task, named_actuators("ideal", task), max_forces=np.full(len(task.motors), 1e9)
        )
    )
    install_callbacks(model)
    data, qpos, qvel = mujoco.MjData(model), list(task.qpos), list(task.qvel)
    controls = [model.actuator_ctrladr[model.actuator(name).id] for name in task.motors]

    def derivative(state: np.ndarray, force: Force) -> np.ndarray:
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
    """Return the mechanical states at the ends of the environment steps, shape (steps, n).

    Each force is held for one environment step. The solver is scipy's DOP853 at a relative
    tolerance of 1e-12. With `inner_steps` > 0 that number of textbook steps is taken in an
    environment step instead: Gymnasium's fourth-order Runge-Kutta if `fourth`, otherwise Euler.

    With motors the state includes each circuit and its continuous PI loop, L di/dt = u - kE*omega -
    R*i, u = kP*e + kI*I + kFF*i_ref (+ kE*omega), dI/dt = e, torque = kT*i. Such a loop has no
    derivative gain and no filter, is never saturated, and starts at rest.
    """
    size = len(start)
    motors = [actuator for actuator in actuators if isinstance(actuator, DCMotorActuator)]

    def derivative(_: float, state: np.ndarray, desired: np.ndarray) -> np.ndarray:
        delivered, electrical = [*desired], []
        for motor_index, actuator in enumerate(motors):
            motor, loop = actuator.motor, actuator.controller
            current, integral = state[size + 2 * motor_index : size + 2 * motor_index + 2]
            reference = desired[motor_index] * motor.arm_radius / motor.torque_constant
            back_emf = (
                motor.back_emf_constant * state[task.speed_indices[motor_index]] / motor.arm_radius
            )
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
            delivered[motor_index] = motor.torque_constant * current / motor.arm_radius
        force = delivered[0] if len(delivered) == 1 else np.array(delivered)
        return np.concatenate([equations(state[:size], force), electrical])

    state, rows = np.concatenate([start, np.zeros(2 * len(motors))]), []
    span, step = (0.0, task.step_duration), task.step_duration / max(inner_steps, 1)
    for force in forces:
        force_args = (np.atleast_1d(force),)
        # Each environment step is solved separately because the force jumps between two of them.
        if not inner_steps:
            solution = integrate.solve_ivp(
                derivative, span, state, "DOP853", rtol=1e-12, atol=1e-15, args=force_args
            )
            state = solution.y[:, -1]
        slope = functools.partial(derivative, 0.0, desired=force_args[0])
        for _ in range(inner_steps):
            state = rk4(slope, state, [0.0, step]) if fourth else state + step * slope(state)
        rows.append(state[:size])
    return np.array(rows)


def continuous_actuators(task: Task) -> tuple[DCMotorActuator, ...]:
    """Return the task's actuators with loops that have a smooth continuous limit.

    They have no derivative gain, voltage limit, integral leak and back-EMF compensation. The
    paper's kD is a difference of two samples, whose limit is an impulse wherever the command jumps;
    the compensation would hide the back-EMF.
    """
    smooth = {"kd": 0.0, "max_voltage": math.inf, "bemf_compensation": False, "integral_leak": 0.0}
    changes = {f"controller.{name}": value for name, value in smooth.items()}
    return tuple(actuator.replaced(changes) for actuator in paper_actuators(task))


def halving_range(task: Task, max_halvings: int = 4) -> range:
    """Return the numbers of extra halvings of the steps that are tried until the order shows."""
    # Without `Task.reference_states` the run is arbitrary and may be violent: it begins with finer
    # steps.
    first = 2 if task.reference_states is None else 0
    return range(first, first + (1 if is_built_in(task) else max_halvings + 1), 2)


def coarsest_passing(task: Task, evaluate: Callable[[int], Case], max_halvings: int = 4) -> Case:
    """Return the case of the coarsest steps with the promised order.

    If no steps have it, return the case of the finest ones.
    """
    for extra_halvings in halving_range(task, max_halvings):
        case = evaluate(extra_halvings)
        if np.max(case.gaps) <= ORDER_TOLERANCE:
            break
    return case


def attribute_failure(
    task: Task, outcome: Check, evaluate: Callable[[int], tuple[float, str]], promised: float
) -> Check | Skipped:
    """Add the cause to a failed check of a custom task; skip it if textbook steps fail as well."""
    if outcome.passed or is_built_in(task):
        return outcome
    distance, finding = min(map(evaluate, halving_range(task)))
    if distance <= ORDER_TOLERANCE:
        return dataclasses.replace(
            outcome, fault=f"textbook steps of the same size have this order: {REPORT}"
        )
    reason = (
        f"{finding}, where {promised:g} was promised: the run is too violent for these steps, or"
        " not smooth"
    )
    return Skipped(
        outcome.name,
        f"{reason}. Name a gentler run in Task.reference_states, or a smaller max_force",
    )


def _step_counts(
    task: Task, fourth: bool, motors: Sequence[Motor], extra_halvings: int, quick: bool
) -> np.ndarray:
    """Return the numbers of integration steps in an environment step that are compared."""
    if fourth:
        return 2 ** (np.arange(2, 6 if quick else 7) + extra_halvings)
    if not motors:
        return 2 ** ((np.arange(3, 7) if quick else np.arange(4, 9)) + extra_halvings)
    # Steps of a quarter of the winding's time constant, and shorter. Without
    # `Task.reference_states` they are also short for the motion (`halving_range`).
    steps_per_quarter = task.step_duration / (
        min(motor.electrical_time_constant for motor in motors) / 4
    )
    first_exponent = (
        math.ceil(math.log2(max(steps_per_quarter, 4))) + extra_halvings - halving_range(task)[0]
    )
    return 2 ** (first_exponent + (np.arange(0, 4) if quick else np.arange(1, 6)))


@check("convergence", order_check("order, {integrator}, {case}", "DOP853 at 1e-12 on {equations}"))
def order_in_the_step(
    task: Task,
    case: str,
    integrator: str,
    actuators: Sequence[ActuatorModel],
    solution: np.ndarray,
    counts: Callable[[int], np.ndarray],
    promised: float,
) -> Iterator[Case]:
    """Check that the errors relative to the solution vanish at the integrator's order."""

    def evaluate(extra_halvings: int) -> Case:
        series = []
        for label, kind in physics_classes(task):
            errors = [
                _error(_simulated_states(kind, task, actuators, int(count), integrator), solution)
                for count in counts(extra_halvings)
            ]
            steps = task.step_duration / counts(extra_halvings)
            # The reference solution itself has errors of 1e-12.
            series.append(ConvergenceSeries(label, steps, np.array(errors), 1e-12))
        title = f"{task.name}, {integrator}, {case}"
        y_label = "largest error of the state [relative]"
        return order_case(promised, series, title, "integration step [s]", y_label)

    yield coarsest_passing(task, evaluate)


@check(
    "convergence",
    order_check("rate in the loop's bandwidth", "{equations} with the desired force itself"),
)
def rate_in_the_bandwidth(task: Task, quick: bool) -> Iterator[Case]:
    """Check that the actuated task approaches the ideal one at first order in the loop's lag.

    At every bandwidth there are two integration steps per lag, the same in both runs.
    """
    integrator, physics = task.integrators[0], physics_classes(task)
    motors = [Motor(arm_radius=actuator.motor.arm_radius) for actuator in paper_actuators(task)]

    def evaluate(extra_halvings: int) -> Case:
        # Time constants tau of the current loop [s].
        lags = task.step_duration / 2 ** (
            (np.arange(3, 7) if quick else np.arange(4, 9)) + extra_halvings
        )
        errors: dict[str, list[float]] = {label: [] for label, _ in physics}
        for lag in lags:
            count = round(2 * task.step_duration / lag)
            kp = motors[0].inductance / lag
            loop = CurrentLoop(
                kp=kp, ki=kp * motors[0].resistance / motors[0].inductance, max_voltage=math.inf
            )
            actuators = [DCMotorActuator(motor, loop) for motor in motors]
            ideal = _simulated_states(
                physics[-1][1], task, named_actuators("ideal", task), count, integrator
            )
            for label, kind in physics:
                errors[label].append(
                    _error(_simulated_states(kind, task, actuators, count, integrator), ideal)
                )
        bandwidth = 1 / (2 * np.pi * lags)
        series = [
            ConvergenceSeries(label, bandwidth, np.array(values))
            for label, values in errors.items()
        ]
        title = f"{task.name}: the actuated task approaches the ideal one"
        x_label = "bandwidth of the current loop [Hz]"
        return order_case(
            -1.0, series, title, x_label, "largest difference of the state [relative]"
        )

    yield coarsest_passing(task, evaluate)


def _textbook_distance(
    task: Task,
    solve_with: Callable[[int], np.ndarray],
    solution: np.ndarray,
    counts: Callable[[int], np.ndarray],
    promised: float,
    extra_halvings: int,
) -> tuple[float, str]:
    """Return the distance of textbook steps from the promised order, and a description of it."""
    errors = [_error(solve_with(int(count)), solution) for count in counts(extra_halvings)]
    return ConvergenceSeries(
        "textbook steps", task.step_duration / counts(extra_halvings), np.array(errors), 1e-12
    ).distance_from(promised)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the convergence checks of a task."""
    task = find_task(task_name)
    reason = nonsmooth_reason(task)
    if reason:
        yield Skipped("all checks", reason)
        return
    if task.reference_env is None:
        yield Skipped("equations of motion that are not MuJoCo's", NO_REFERENCE_ENV)
        equations = engine_equations(task)
        description = "MuJoCo's own accelerations"
        implementation = "MuJoCo"
    else:
        equations = gymnasium_equations(task)
        description = f"the equations of {task.oracle}"
        implementation = task.oracle
    start, forces, _ = free_run(task)
    for case, actuators in (
        ("ideal actuator", named_actuators("ideal", task)),
        ("motor in the loop", continuous_actuators(task)),
    ):
        solve_task = functools.partial(solve, task, equations, start, forces, actuators)
        solution = solve_task()
        motors = [actuator.motor for actuator in actuators if isinstance(actuator, DCMotorActuator)]
        oracle = description if case == "ideal actuator" else f"{description} and of the motor"
        for integrator in task.integrators:
            fourth = integrator == "rk4" and not motors
            promised = 4.0 if fourth else 1.0
            counts = functools.partial(_step_counts, task, fourth, motors, quick=quick)
            solve_textbook = functools.partial(solve_task, fourth=fourth)
            textbook = functools.partial(
                _textbook_distance, task, solve_textbook, solution, counts, promised
            )
            for outcome in order_in_the_step(
                task, case, integrator, actuators, solution, counts, promised, equations=oracle
            ):
                yield attribute_failure(task, outcome, textbook, promised)
    yield from rate_in_the_bandwidth(task, quick, equations=implementation)
