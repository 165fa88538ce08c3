"""The current loop inside MuJoCo against the analogue loop that it samples, in closed form.

The oracle is the matrix exponential of the RL circuit under an analogue PID, written from the equations; nothing of
`codrl_mj.actuators.current_loop` is in it.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from scipy import linalg

from codrl_mj.actuators import Actuator
from codrl_mj.validation.motor_loops import Loop, run, unlimited
from codrl_mj.validation.table import Case, Family, Oracle, check, of_order, order


def closed_form(actuator: Actuator, timestep: float, torques: np.ndarray, speed: float) -> np.ndarray:
    """Joint torque [N*m] of the analogue loop after each step [s], from rest: the matrix exponential.

    L di/dt = u - kE*omega - R*i,  u = kP*e + kI*I + kD*D + kFF*i_ref (+ kE*omega),  dI/dt = e - leak*I;
    with a filter D = (e - y)/Td and dy/dt = D; without one D = de/dt, which adds kD to L, and a step of i_ref makes the
    current jump by kD/(L + kD) of it. The voltage has no limit; desired torques [N*m] are held over each step, and the
    joint keeps its speed [rad/s].
    """
    motor, loop = actuator.motor, actuator.controller
    filtered = loop.derivative_time_constant > 0
    derivative = loop.kd / loop.derivative_time_constant if filtered else 0.0
    inertia = motor.inductance + (0.0 if filtered else loop.kd)
    relaxation = 1 / loop.derivative_time_constant if filtered else 0.0
    voltage = 0.0 if loop.bemf_compensation else -motor.back_emf_constant * speed / motor.arm_radius
    feedback = loop.kp + derivative
    # columns: current, integral, filtered error, reference, 1
    system = np.zeros((5, 5))
    system[0] = [-motor.resistance - feedback, loop.ki, -derivative, feedback + loop.kff, voltage]
    system[0] /= inertia
    system[1] = [-1.0, -loop.integral_leak, 0.0, 1.0, 0.0]
    system[2] = [-relaxation, 0.0, -relaxation, relaxation, 0.0]
    advance = linalg.expm(system * timestep)
    jump = 0.0 if filtered else loop.kd / (motor.inductance + loop.kd)
    state, rows = np.array([0.0, 0.0, 0.0, 0.0, 1.0]), []
    for reference in torques * motor.arm_radius / motor.torque_constant:
        state[0] += jump * (reference - state[3])
        state[3] = reference
        state = advance @ state
        rows.append(motor.torque_constant / motor.arm_radius * state[0])
    return np.array(rows)


_ORACLE = "matrix exponential of the RL circuit under the analogue PID (scipy.linalg.expm)"


@check(
    "motor",
    order("closed form, order in the substeps", _ORACLE),
    Oracle("closed form, limit of small substeps", _ORACLE, 1e-5, "N m"),
)
def analogue_checks(loops: Mapping[str, Loop], quick: bool) -> Iterator[tuple[Case, ...]]:
    """Convergence to the closed form at first order in the substeps, and the limit itself.

    The limit is Richardson's 2 x(2N) - x(N), whose error is of second order: below 1e-5 of the desired 1 N m at the
    finest substep, 1/100 or less of every time constant here. A parameter off by 0.1 % moves it by more.
    """
    families, limits, where = [], [], []
    for name, loop in loops.items():
        counts = loop.actuator.controller.substeps * 2 ** np.arange(5, 10 if quick else 12)
        steps = max(20, round(1.0 / loop.timestep))
        torques, speed = np.where(np.arange(steps) < steps // 2, 1.0, -0.5), 0.4
        exact = closed_form(loop.actuator, loop.timestep, torques, speed)
        runs = [run(unlimited(loop, int(count)), loop.timestep, torques, np.full(steps, speed)) for count in counts]
        errors = np.array([np.abs(run.torque[:, 0] - exact).max() for run in runs])
        families.append(Family(name, loop.timestep / counts, errors))
        limit = 2 * runs[-1].torque[:, 0] - runs[-2].torque[:, 0]
        where.append(f"{name}, extrapolated from {counts[-2]} and {counts[-1]} substeps")
        limits.append(np.abs(limit - exact).max())
    title = "Torque against the analogue loop's closed form"
    order = of_order(1.0, families, title, "electrical substep [s]", "largest error [N m]")
    yield order, Case(limits, lambda at: where[at])
