"""Comparison of the current loop inside MuJoCo with linear systems theory.

The oracles are a closed form, scipy and python-control. Each is built from the loop's equations
(the paper, Algorithm 1 and appendix) by another library and in another form; none of them uses
`codrl_mj.actuators.current_loop`.
"""

import math
from collections.abc import Callable, Iterator, Mapping

import control
import numpy as np
from scipy import linalg, signal

from codrl_mj.actuators import DCMotorActuator
from codrl_mj.plots import Curve, Plot
from codrl_mj.validation.rotors import (
    LOCKED_ROTOR,
    Loop,
    build_rotors,
    linear_actuator,
    simulate,
    simulate_torques,
)
from codrl_mj.validation.table import Case, Check, ConvergenceSeries, check, order_case, order_check

# -- The continuous loop that is sampled -----------------------------------------------------------


def closed_form(
    actuator: DCMotorActuator, timestep: float, torques: np.ndarray, speed: float
) -> np.ndarray:
    """Return the joint torque [N*m] of the analog loop after each step [s], by matrix exponential.

    L di/dt = u - kE*omega - R*i,  u = kP*e + kI*I + kD*D + kFF*i_ref (+ kE*omega),  dI/dt = e -
    leak*I; with a filter D = (e - y)/Td and dy/dt = D. Without a filter D = de/dt, which adds kD to
    L, so that a step of i_ref makes the current jump by kD/(L + kD) of the step. The voltage has no
    limit; desired torques [N*m] are held over each step, the joint keeps its speed [rad/s], and the
    loop starts at rest.
    """
    motor, loop = actuator.motor, actuator.controller
    filtered = loop.derivative_time_constant > 0
    derivative = loop.kd / loop.derivative_time_constant if filtered else 0.0
    effective_inductance = motor.inductance + (0.0 if filtered else loop.kd)
    relaxation = 1 / loop.derivative_time_constant if filtered else 0.0
    voltage = 0.0 if loop.bemf_compensation else -motor.back_emf_constant * speed / motor.arm_radius
    feedback = loop.kp + derivative
    # The columns are current, integral, filtered error, reference and the constant 1.
    system = np.zeros((5, 5))
    system[0] = [-motor.resistance - feedback, loop.ki, -derivative, feedback + loop.kff, voltage]
    system[0] /= effective_inductance
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
    order_check("closed form, order in the substeps", _ORACLE),
    Check("closed form, limit of small substeps", _ORACLE, 1e-5, "N m"),
)
def order_to_closed_form(loops: Mapping[str, Loop], quick: bool) -> Iterator[tuple[Case, ...]]:
    """Check that the loop converges to the closed form at first order in the substeps.

    The second row of results is the extrapolated limit of small substeps.

    The limit is Richardson's 2 x(2N) - x(N), whose error is of second order: below 1e-5 of the
    desired 1 N m at the finest substep, 1/100 or less of every time constant here. A parameter off
    by 0.1 % moves it by more.
    """
    series, limits, descriptions = [], [], []
    for name, loop in loops.items():
        counts = loop.actuator.controller.substeps * 2 ** np.arange(5, 10 if quick else 12)
        steps = max(20, round(1.0 / loop.timestep))
        torques, speed = np.where(np.arange(steps) < steps // 2, 1.0, -0.5), 0.4
        exact = closed_form(loop.actuator, loop.timestep, torques, speed)
        runs = [
            simulate_torques(
                linear_actuator(loop, int(count)), loop.timestep, torques, np.full(steps, speed)
            )
            for count in counts
        ]
        errors = np.array([np.abs(record.torque[:, 0] - exact).max() for record in runs])
        series.append(ConvergenceSeries(name, loop.timestep / counts, errors))
        limit = 2 * runs[-1].torque[:, 0] - runs[-2].torque[:, 0]
        descriptions.append(f"{name}, extrapolated from {counts[-2]} and {counts[-1]} substeps")
        limits.append(np.abs(limit - exact).max())
    title = "Torque against the analogue loop's closed form"
    order_result = order_case(1.0, series, title, "electrical substep [s]", "largest error [N m]")
    yield order_result, Case(limits, lambda index: descriptions[index])


# -- The sampled loop as a state-space system ------------------------------------------------------


def sampled_system(actuator: DCMotorActuator, timestep: float) -> signal.dlti:
    """Return the loop sampled at its electrical step.

    Inputs are the reference current and the shaft speed, the output is the next current.
    """
    motor, loop = actuator.motor, actuator.controller
    dt = timestep / loop.substeps
    # Each signal is a row of coefficients of (i, I, e_past, i_ref, omega).
    current, integral, past, reference, speed = np.eye(5)
    error = reference - current
    integral = (integral + dt * error) / (1 + loop.integral_leak * dt)
    derivative = (error - past) / (dt + loop.derivative_time_constant)
    back_emf = motor.back_emf_constant * speed
    voltage = loop.kp * error + loop.ki * integral + loop.kd * derivative + loop.kff * reference
    voltage = voltage + loop.bemf_compensation * back_emf
    current = current + dt / motor.inductance * (voltage - back_emf - motor.resistance * current)
    rows = np.array([current, integral, error - loop.derivative_time_constant * derivative])
    return signal.dlti(rows[:, :3], rows[:, 3:], current[:3], current[3:], dt=dt)


@check(
    "motor",
    Check(
        "sampled loop, random torques and speeds",
        "the sampled loop as a state-space system (scipy.signal.dlsim)",
        1e-10,
        "N m",
    ),
)
def random_torques(loops: Mapping[str, Loop], steps: int) -> Iterator[Case]:
    """Compare the torque under random desired torques and speeds.

    Tolerance 1e-10: a stable loop does not amplify rounding errors.
    """
    for name, loop in loops.items():
        generator = np.random.default_rng(0)
        torques = np.repeat(generator.uniform(-1.0, 1.0, steps // 5), 5)
        speeds = generator.uniform(-3.0, 3.0, len(torques))
        substeps = loop.actuator.controller.substeps
        actuator = linear_actuator(loop, substeps)
        motor = actuator.motor
        measured = simulate_torques(actuator, loop.timestep, torques, speeds).torque[:, 0]
        references = torques * motor.arm_radius / motor.torque_constant
        inputs = np.column_stack([references, speeds / motor.arm_radius]).repeat(substeps, axis=0)
        _, currents, _ = signal.dlsim(sampled_system(actuator, loop.timestep), inputs)
        oracle = currents[substeps - 1 :: substeps, 0] * motor.torque_constant / motor.arm_radius
        errors = np.abs(measured - oracle)
        time = np.arange(1, 61) * loop.timestep
        lines = (
            ("desired", torques, False),
            ("MuJoCo", measured, False),
            ("scipy.signal.dlsim", oracle, True),
        )
        curves = tuple(Curve(label, time, line[:60], reference) for label, line, reference in lines)
        plot = Plot(
            f"Torque under random commands and speeds, {name}", "time [s]", "torque [N m]", curves
        )
        where = f"{name}, step {int(errors.argmax()) + 1} of {len(torques)}"
        yield Case(errors, where, steps, (plot,) if name == list(loops)[-1] else ())


# -- The sampled loop as blocks --------------------------------------------------------------------


def closed_loop(actuator: DCMotorActuator, timestep: float) -> control.StateSpace:
    """Return the discrete system from desired torque to torque at the step's start.

    The torque is kT times the current; the sampling period is `timestep`.
    As in Algorithm 1, the winding is 1/(L s + R) sampled by forward Euler, and the integral is
    1/(s + leak) sampled by backward differences. The blocks are
    joined as state-space systems: transfer functions of poles close to 1 lose digits when their
    polynomials are multiplied.
    """
    motor, loop = actuator.motor, actuator.controller
    # There is one electrical step in a mechanical step.
    dt, filtering = timestep, loop.derivative_time_constant
    circuit = control.tf([1.0], [motor.inductance, motor.resistance])
    winding = control.ss(control.sample_system(circuit, dt, method="euler"))
    pid = control.ss([], [], [], loop.kp, dt)
    # A block without a gain would add a pole that nothing excites.
    if loop.ki > 0:
        leaky = control.tf([1.0], [1.0, loop.integral_leak])
        pid = pid + loop.ki * control.ss(control.sample_system(leaky, dt, method="backward_diff"))
    if loop.kd > 0:
        pid = pid + loop.kd * control.ss(control.tf([1.0, -1.0], [dt + filtering, -filtering], dt))
    return control.feedback(pid * winding, 1) + loop.kff * control.feedback(winding, pid)


@check(
    "motor",
    Check("step response", "python-control, step_response of the discrete loop", 1e-10, "N m"),
)
def step_response(loops: Mapping[str, Loop]) -> Iterator[Case]:
    """Compare the step response of each loop; tolerance 1e-10 of the desired 1 N m."""
    for name, loop in loops.items():
        step, actuator = _electrical(loop)
        steps = max(40, round(2.0 / step))
        time = np.arange(1, steps + 1) * step
        measured = simulate_torques(actuator, step, np.ones(steps), np.zeros(steps)).torque[:, 0]
        response = control.step_response(closed_loop(actuator, step), np.arange(steps + 1) * step)
        # The engine's torque during a step is that of the current at the step's end.
        oracle = np.ravel(response.outputs)[1:]
        errors = np.abs(measured - oracle)
        curves = (
            Curve("MuJoCo", time, measured),
            Curve("python-control", time, oracle, reference=True),
        )
        plot = Plot(f"Step response, {name}", "time [s]", "torque for 1 N m desired [N m]", curves)
        yield Case(errors, f"{name}, at t = {time[errors.argmax()]:.3g} s", plots=(plot,))


_FREQUENCY = "python-control, the discrete loop's frequency response"


@check(
    "motor",
    Check("frequency response, magnitude", _FREQUENCY, 1e-6, "dB"),
    Check("frequency response, phase", _FREQUENCY, 1e-5, "deg"),
)
def frequency_response(loops: Mapping[str, Loop], frequencies: int) -> Iterator[tuple[Case, ...]]:
    """Compare magnitude and phase from desired to actual torque, measured with sines in MuJoCo.

    Each frequency has its own motor. A sampled loop has an exact frequency response, so the
    remaining errors are the transient, which has decayed to 1e-10 of the amplitude, and the
    rounding of the least-squares fit: 1e-6 dB and 1e-5 degrees, far within the 0.1 dB and 0.5
    degrees at which an engineer would call two Bode plots equal. A gain error of 0.1 % shows as
    some 1e-3 dB, a step of delay as up to 180 degrees.
    """
    quantities: tuple[tuple[str, str, Callable[[np.ndarray], np.ndarray]], ...] = (
        ("magnitude", "dB", lambda response: 20 * np.log10(np.abs(response))),
        ("phase", "deg", lambda response: np.angle(response, deg=True)),
    )
    curves: tuple[list[Curve], ...] = ([], [])
    for name, loop in loops.items():
        step, actuator = _electrical(loop)
        nyquist = 0.5 / step
        tested_frequencies = np.geomspace(0.005 * nyquist, 0.97 * nyquist, frequencies)
        system = closed_loop(actuator, step)
        rotation = np.exp(2j * np.pi * tested_frequencies * step)
        # The engine's torque during a step is that of the current at the step's end.
        oracle = system(rotation) * rotation
        ratio = (
            _measured_response(
                actuator, step, tested_frequencies, np.abs(control.poles(system)).max()
            )
            / oracle
        )
        cases = []
        for (quantity, unit, quantity_of), lines in zip(quantities, curves, strict=True):
            error = np.abs(quantity_of(ratio))
            worst_frequency = tested_frequencies[int(np.argmax(error))]
            lines.append(Curve(f"{name}, MuJoCo", tested_frequencies, quantity_of(ratio * oracle)))
            lines.append(
                Curve(
                    f"{name}, python-control",
                    tested_frequencies,
                    quantity_of(oracle),
                    reference=True,
                )
            )
            title = f"Frequency response, desired to actual torque: {quantity}"
            # The lines of all loops up to this one; the last plot has all of them.
            plot = Plot(title, "frequency [Hz]", f"{quantity} [{unit}]", tuple(lines), x_log=True)
            where = f"{name}, {worst_frequency:.3g} Hz ({worst_frequency / nyquist:.3g} of Nyquist)"
            cases.append(Case(error, where, plots=(plot,) if name == list(loops)[-1] else ()))
        yield tuple(cases)


def _electrical(loop: Loop) -> tuple[float, DCMotorActuator]:
    """Return the loop's electrical step [s] and its actuator with one substep."""
    return loop.timestep / loop.actuator.controller.substeps, linear_actuator(loop, 1)


def _measured_response(
    actuator: DCMotorActuator, step: float, frequencies: np.ndarray, slowest: float
) -> np.ndarray:
    """Return the complex amplitudes of the torques in MuJoCo under cosines of 1 N m.

    `slowest` is the magnitude of the slowest pole, which gives the duration of the transient.
    """
    settle = math.ceil(math.log(1e-10) / math.log(min(max(slowest, 0.5), 0.9999)))
    phases = 2 * np.pi * frequencies * step * np.arange(settle + 1200)[:, np.newaxis]
    model = build_rotors(LOCKED_ROTOR, [actuator] * len(frequencies), step)
    torque = simulate(
        model, np.cos(phases) * actuator.motor.arm_radius, np.zeros(len(phases))
    ).torque
    amplitudes = []
    for phase, values in zip(phases[settle:].T, torque[settle:].T, strict=True):
        (cosine, sine), *_ = np.linalg.lstsq(
            np.column_stack([np.cos(phase), np.sin(phase)]), values, rcond=None
        )
        amplitudes.append(cosine - 1j * sine)
    return np.array(amplitudes)


def sampled_checks(loops: Mapping[str, Loop], quick: bool) -> Iterator[Check]:
    """Run the checks that apply to any stable loop, each over all loops."""
    yield from random_torques(loops, 200 if quick else 1000)
    yield from step_response(loops)
    yield from frequency_response(loops, 8 if quick else 24)
