"""The current loop as it runs inside MuJoCo, on a rotor at a held speed, against linear systems theory.

Each oracle is built from the loop's equations (the paper, Algorithm 1 and appendix) by another library and in another
form: the matrix exponential of the analogue circuit (scipy), a sampled state-space system (scipy), transfer functions
in z (python-control). None of them uses `codrl_mj.motor.advance`.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import control
import numpy as np
from scipy import linalg, signal

from codrl_mj.motor import Actuator, CurrentLoop, Motor
from codrl_mj.motor.catalog import PAPER
from codrl_mj.tasks import TASKS
from codrl_mj.validation.order import Family, order_check
from codrl_mj.validation.outcome import Check, Curve, Plot
from codrl_mj.validation.rotors import HELD, Record, drive, motors_on


class Loop(NamedTuple):
    """A motor under its current loop, and the step at which it is sampled."""

    actuator: Actuator
    """Motor and gains."""
    timestep: float
    """Mechanical step [s]."""


EVERY_FEATURE = Loop(
    Actuator(
        Motor(resistance=1.2, inductance=0.05, torque_constant=0.8, back_emf_constant=0.7, arm_radius=0.5),
        CurrentLoop(
            kp=2.0,
            ki=5.0,
            kd=1e-3,
            kff=0.4,
            bemf_compensation=False,
            substeps=2,
            integral_leak=0.3,
            derivative_time_constant=0.01,
        ),
    ),
    0.01,
)
"""A loop in which every parameter counts; nothing hides its back-EMF."""


def standard_loops() -> dict[str, Loop]:
    """The paper's loop of each task at the task's inner step, and one with every feature."""
    paper = {task.name: Loop(PAPER[task.name], task.step_duration / task.motor_inner_steps) for task in TASKS.values()}
    return {**paper, "every feature": EVERY_FEATURE}


def _unlimited(loop: Loop, substeps: int) -> Actuator:
    controller = dataclasses.replace(loop.actuator.controller, max_voltage=math.inf, substeps=substeps)
    return dataclasses.replace(loop.actuator, controller=controller)


def _run(actuator: Actuator, timestep: float, torques: np.ndarray, speeds: np.ndarray) -> Record:
    """Drive one motor in MuJoCo with desired joint torques at joint speeds."""
    return drive(motors_on(HELD, [actuator], timestep), torques * actuator.motor.arm_radius, speeds)


# -- The closed form of the analogue circuit -----------------------------------------------------------------


def closed_form(actuator: Actuator, timestep: float, torques: np.ndarray, speed: float) -> np.ndarray:
    """Joint torque [N*m] of the analogue loop after each step, from rest: the matrix exponential.

    L di/dt = u - kE*omega - R*i,  u = kP*e + kI*I + kD*D + kFF*i_ref (+ kE*omega),  dI/dt = e - leak*I;
    with a filter D = (e - y)/Td and dy/dt = D; without one D = de/dt, which adds kD to L, and a step of i_ref makes the
    current jump by kD/(L + kD) of it.

    Args:
        actuator: motor and gains; the voltage has no limit.
        timestep: mechanical step [s].
        torques: desired joint torque [N*m], held over each step.
        speed: of the joint [rad/s].
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


def _closed_form_checks(loops: Mapping[str, Loop], quick: bool) -> Iterator[Check]:
    """Convergence to the closed form at first order in the substeps, and the limit itself.

    The limit is Richardson's 2 x(2N) - x(N), whose error is of second order: below 1e-5 of the amplitude at the finest
    substep, which is below 1/1000 of every electrical time constant here. A parameter off by 0.1 % moves it by more.
    """
    counts = 2 ** np.arange(5, 10 if quick else 12)
    families, limits = [], []
    for name, loop in loops.items():
        steps = max(20, round(1.0 / loop.timestep))
        torques = np.where(np.arange(steps) < steps // 2, 1.0, -0.5)
        exact = closed_form(loop.actuator, loop.timestep, torques, speed := 0.4)
        runs = [
            _run(_unlimited(loop, int(count)), loop.timestep, torques, np.full(steps, speed)).torque[:, 0]
            for count in counts
        ]
        errors = np.array([np.abs(run - exact).max() for run in runs])
        families.append(Family(name, loop.timestep / counts, errors))
        limits.append(float(np.abs(2 * runs[-1] - runs[-2] - exact).max()))
    oracle = "matrix exponential of the RL circuit under the analogue PID (scipy.linalg.expm)"
    plot = Plot("Torque against the closed form of the analogue loop", "electrical substep [s]", "largest error [N m]", ())
    yield order_check("closed form, order in the substeps", oracle, families, 1.0, plot, "motor")
    name = "closed form, limit of small substeps"
    worst = int(np.argmax(limits))
    where = f"{list(loops)[worst]}, extrapolated from {counts[-2]} and {counts[-1]} substeps"
    yield Check(name, oracle, len(limits), max(limits), 1e-5, where, group="motor", unit="N m")


# -- The sampled loop as a state-space system ----------------------------------------------------------------


def sampled_system(actuator: Actuator, timestep: float) -> Any:
    """The loop sampled at its electrical step: inputs (i_ref, shaft speed), output the next current (scipy's `dlti`)."""
    motor, loop = actuator.motor, actuator.controller
    dt = timestep / loop.substeps
    current, integral, past, reference, speed = np.eye(5)  # each signal as a row over (i, I, e_past, i_ref, omega)
    error = reference - current
    integral = (integral + dt * error) / (1 + loop.integral_leak * dt)
    derivative = (error - past) / (dt + loop.derivative_time_constant)
    back_emf = motor.back_emf_constant * speed
    voltage = loop.kp * error + loop.ki * integral + loop.kd * derivative + loop.kff * reference
    voltage = voltage + loop.bemf_compensation * back_emf
    current = current + dt / motor.inductance * (voltage - back_emf - motor.resistance * current)
    rows = np.array([current, integral, error - loop.derivative_time_constant * derivative])
    return signal.dlti(rows[:, :3], rows[:, 3:], current[:3], current[3:], dt=dt)


def _state_space_check(loops: Mapping[str, Loop], steps: int) -> Check:
    """Random desired torques and speeds: equal to rounding, which 1000 steps of a stable loop do not amplify."""
    worst, where, plots = 0.0, "", []
    for name, loop in loops.items():
        generator = np.random.default_rng(0)
        torques = np.repeat(generator.uniform(-1.0, 1.0, steps // 5), 5)
        speeds = generator.uniform(-3.0, 3.0, len(torques))
        actuator = _unlimited(loop, loop.actuator.controller.substeps)
        motor, substeps = actuator.motor, actuator.controller.substeps
        measured = _run(actuator, loop.timestep, torques, speeds).torque[:, 0]
        inputs = np.column_stack(
            [torques * motor.arm_radius / motor.torque_constant, speeds / motor.arm_radius]
        ).repeat(substeps, axis=0)
        _, currents, _ = signal.dlsim(sampled_system(actuator, loop.timestep), inputs)
        oracle = currents[substeps - 1 :: substeps, 0] * motor.torque_constant / motor.arm_radius
        errors = np.abs(measured - oracle)
        if not errors.max() <= worst:
            worst, where = float(errors.max()), f"{name}, step {int(errors.argmax()) + 1} of {len(torques)}"
        time = np.arange(60) * loop.timestep
        if name == "every feature":
            plots.append(
                Plot(
                    f"Torque under random commands and speeds, {name}",
                    "time [s]",
                    "torque [N m]",
                    (
                        Curve("desired", time, torques[:60]),
                        Curve("MuJoCo", time, measured[:60]),
                        Curve("scipy.signal.dlsim", time, oracle[:60], reference=True),
                    ),
                )
            )
    oracle_name = "the sampled loop as a state-space system (scipy.signal.dlsim)"
    name = "sampled loop, random torques and speeds"
    return Check(
        name, oracle_name, steps * len(loops), worst, 1e-10, where, group="motor", unit="N m", plots=tuple(plots)
    )


# -- The sampled loop as transfer functions ------------------------------------------------------------------


def transfer_function(actuator: Actuator, timestep: float) -> Any:
    """python-control's desired joint torque -> joint torque over the same step's *end*: kT*i_(k+1), as z^-1 of itself.

    The winding is python-control's forward-Euler sampling of 1/(L s + R), the integral its backward-difference
    sampling of 1/(s + leak), both as Algorithm 1 has them.
    """
    motor, loop = actuator.motor, actuator.controller
    dt = timestep
    winding = control.sample_system(control.tf([1.0], [motor.inductance, motor.resistance]), dt, method="euler")
    integral = control.sample_system(control.tf([1.0], [1.0, loop.integral_leak]), dt, method="backward_diff")
    filtering = loop.derivative_time_constant
    derivative = control.tf([1.0, -1.0], [dt + filtering, -filtering], dt)
    pid = loop.kp + loop.ki * integral + loop.kd * derivative
    return control.feedback(pid * winding, 1) + loop.kff * control.feedback(winding, pid)


def _step_response_check(loops: Mapping[str, Loop]) -> Check:
    worst, where, curves, samples = 0.0, "", [], 0
    for name, loop in loops.items():
        actuator = _unlimited(loop, 1)
        steps = max(40, round(2.0 / loop.timestep))
        time = np.arange(steps) * loop.timestep
        measured = _run(actuator, loop.timestep, np.ones(steps), np.zeros(steps)).torque[:, 0]
        system = transfer_function(actuator, loop.timestep)
        oracle = np.ravel(control.step_response(system, np.arange(steps + 1) * loop.timestep).outputs)[1:]
        errors = np.abs(measured - oracle)
        samples += steps
        if not errors.max() <= worst:
            worst, where = float(errors.max()), f"{name}, at t = {time[errors.argmax()]:.3g} s"
        curves += [Curve(f"{name}, MuJoCo", time, measured), Curve(f"{name}, control", time, oracle, reference=True)]
    plot = Plot("Step response, rotor locked", "time [s]", "torque for 1 N m desired [N m]", tuple(curves))
    oracle_name = "python-control, step_response of the discrete loop"
    return Check(
        "step response", oracle_name, samples, worst, 1e-9, where, group="motor", unit="N m", plots=(plot,)
    )


def _frequency_response_checks(loops: Mapping[str, Loop], frequencies: int) -> Iterator[Check]:
    """Magnitude and phase of desired -> actual torque, from sines driven through MuJoCo, one motor a frequency.

    A sampled loop has an exact frequency response, so what is left is the transient, waited out until it is below 1e-9
    of the amplitude, and the least-squares fit's rounding: 1e-6 dB and 1e-5 degrees. A gain off by 0.1 % shows some
    1e-3 dB, one step of delay up to 180 degrees.
    """
    worst, where = [0.0, 0.0], ["", ""]
    curves: list[list[Curve]] = [[], []]
    for name, loop in loops.items():
        actuator = _unlimited(loop, 1)
        nyquist = 0.5 / loop.timestep
        tested = np.geomspace(0.005 * nyquist, 0.97 * nyquist, frequencies)
        system = transfer_function(actuator, loop.timestep)
        settle = math.ceil(math.log(1e-10) / math.log(max(np.abs(control.poles(system)).max(), 0.5)))
        phase = 2 * np.pi * tested * loop.timestep * np.arange(settle + 1200)[:, np.newaxis]
        model = motors_on(HELD, [actuator] * frequencies, loop.timestep)
        torque = drive(model, np.cos(phase) * actuator.motor.arm_radius, np.zeros(len(phase))).torque[settle:]
        measured = np.array(
            [_phasor(angle, seen) for angle, seen in zip(phase[settle:].T, torque.T, strict=True)]
        )
        rotation = np.exp(2j * np.pi * tested * loop.timestep)  # the torque of a step is that of the current at its end
        oracle = system(rotation) * rotation
        ratio = measured / oracle
        errors = np.abs(20 * np.log10(np.abs(ratio))), np.abs(np.angle(ratio, deg=True))
        shown = (
            (20 * np.log10(np.abs(measured)), 20 * np.log10(np.abs(oracle))),
            (np.angle(measured, deg=True), np.angle(oracle, deg=True)),
        )
        for index in range(2):
            error = errors[index]
            if not error.max() <= worst[index]:
                at = tested[error.argmax()]
                worst[index] = float(error.max())
                where[index] = f"{name}, {at:.3g} Hz ({at / nyquist:.3g} of Nyquist)"
            curves[index] += [
                Curve(f"{name}, MuJoCo", tested, shown[index][0]),
                Curve(f"{name}, control", tested, shown[index][1], reference=True),
            ]
    samples = frequencies * len(loops)
    for index, (quantity, unit, tolerance) in enumerate((("magnitude", "dB", 1e-6), ("phase", "deg", 1e-5))):
        plot = Plot(
            f"Frequency response, desired to actual torque: {quantity}",
            "frequency [Hz]",
            f"{quantity} [{unit}]",
            tuple(curves[index]),
            x_log=True,
        )
        yield Check(
            f"frequency response, {quantity}",
            "python-control, the discrete loop's transfer function",
            samples,
            worst[index],
            tolerance,
            where[index],
            group="motor",
            unit=unit,
            plots=(plot,),
        )


def _phasor(phase: np.ndarray, values: np.ndarray) -> complex:
    """The complex amplitude of `values` as a cosine of `phase`, by least squares."""
    (cosine, sine), *_ = np.linalg.lstsq(np.column_stack([np.cos(phase), np.sin(phase)]), values, rcond=None)
    return complex(cosine, -sine)


def loop_checks(loops: Mapping[str, Loop], quick: bool) -> Iterator[Check]:
    """All checks of the loop, each over all the given loops.

    Args:
        loops: by name.
        quick: fewer frequencies, substeps and steps.
    """
    yield from _closed_form_checks(loops, quick)
    yield _state_space_check(loops, 200 if quick else 1000)
    yield _step_response_check(loops)
    yield from _frequency_response_checks(loops, 8 if quick else 24)
