"""Comparison of the motor as it runs inside MuJoCo, callbacks included, with independent oracles.

This module compares the motor without its loop, driven by a voltage, with MuJoCo's native
`<dcmotor>`, gym-electric-motor and a datasheet. `motor_loops` compares the current loop with linear
systems theory, `own_model` has the checks that apply to any family of actuators, and
`motor_catalogue` compares off-the-shelf motors. Torques are read where the engine applies them.

MuJoCo's motor integrates the winding differently. With the speed held over a step, the native motor
is exact, i' = i_inf + (i - i_inf) exp(-R dt/L), and our motor takes Euler steps. There are
therefore two comparisons: at an inductance of R dt/(1 - exp(-R dt/L)) one Euler step *is* the exact
one, so that the two motors must be equal to rounding; and at the true inductance our motor
converges to the native one at first order in the substeps.

Under `implicitfast` the engine adds the slope of the native motor's torque over speed, kT kE/R (1 -
exp(-R dt/L)), to the velocity's implicit matrix. Our motor has no such slope. The slope shrinks
with the step and acts for one step, so that the difference vanishes at second order. On a locked
rotor there is no difference.

Under RK4 the native motor is no oracle: the engine advances its current at every stage, so that the
current at the end of a step is not on the exponential. `rk4_check` reports its error beside that of
our motor, which holds the force over the step and stays exact.

gym-electric-motor (https://github.com/upb-lea/gym-electric-motor) is a third-party simulator of
electric drives. It is not a dependency of the package, because it installs pytest and coverage; its
check is skipped if it is not installed.

A datasheet promises, in steady state, u = R*i + kE*omega and torque = kT*i: a straight line of
torque over speed through the stall torque kT*u/R and the no-load speed u/kE, beyond which the
current changes sign and power flows back into the supply.
"""

import dataclasses
import importlib.util
import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Motor
from codrl_mj.plots import Curve, Plot
from codrl_mj.validation.motor_catalogue import drive_checks
from codrl_mj.validation.motor_loops import order_to_closed_form, sampled_checks
from codrl_mj.validation.own_model import compiled_checks
from codrl_mj.validation.rotors import (
    ECCENTRIC_ROTOR,
    FREE_ROTOR,
    LOCKED_ROTOR,
    Loop,
    Record,
    Rotor,
    build_rotors,
    simulate,
    standard_loops,
    voltage_actuator,
)
from codrl_mj.validation.table import (
    Case,
    Check,
    ConvergenceSeries,
    Skipped,
    check,
    order_case,
    order_check,
)

MOTORS: dict[str, Motor] = {
    "paper": Motor(),
    "small": Motor(resistance=2.0, inductance=0.02, torque_constant=0.5, back_emf_constant=0.5),
}
"""Motors that are compared: the paper's, most of whose parameters are 1, and a smaller one."""

_NATIVE_CASES: tuple[tuple[Rotor, str], ...] = (
    (LOCKED_ROTOR, "Euler"),
    (LOCKED_ROTOR, "implicitfast"),
    (FREE_ROTOR, "Euler"),
    (ECCENTRIC_ROTOR, "Euler"),
)


def exact_euler_actuator(motor: Motor, timestep: float) -> DCMotorActuator:
    """Return a voltage-driven motor whose Euler step equals the exact step of the given motor."""
    decay = 1.0 - math.exp(-timestep * motor.resistance / motor.inductance)
    return voltage_actuator(
        dataclasses.replace(motor, inductance=motor.resistance * timestep / decay)
    )


def _compare_with_native(
    rotor: Rotor,
    motor: Motor,
    actuator: DCMotorActuator,
    timestep: float,
    hold: int,
    count: int,
    integrator: str = "Euler",
) -> tuple[Record, Record, np.ndarray]:
    """Simulate our motor and the native one under the same voltages.

    Both get `count` random voltages in +-4 V, each held for `hold` steps.

    Returns:
        The records of our motor and of the native one, and the largest difference of angle, speed
        and current after each step, relative to max(1, size).
    """
    volts = np.random.default_rng(0).uniform(-4.0, 4.0, count).repeat(hold)
    ours, native = (
        simulate(build_rotors(rotor, [simulated], timestep, integrator), volts)
        for simulated in (actuator, motor)
    )
    pairs = zip(ours[:3], native[:3], strict=True)
    return (
        ours,
        native,
        np.max([np.abs(a - b) / np.maximum(1.0, np.abs(b)) for a, b in pairs], axis=(0, 2)),
    )


@check(
    "motor",
    Check(
        "native <dcmotor>, same map",
        "MuJoCo's <dcmotor>: angle, speed and current; locked, free and swinging",
        1e-10,
    ),
)
def equal_to_native(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Compare the two motors at the inductance at which one Euler step is exact.

    Tolerance 1e-10: rounding of some 100 steps of a coupled, stable system.
    """
    shares = (0.1, 1.0) if quick else (0.01, 0.1, 0.3, 1.0)
    for (name, motor), (rotor, integrator), share in itertools.product(
        motors.items(), _NATIVE_CASES, shares
    ):
        timestep = share * motor.electrical_time_constant
        count = 20 if quick else 100
        ours, native, difference = _compare_with_native(
            rotor, motor, exact_euler_actuator(motor, timestep), timestep, 5, count, integrator
        )
        description = (
            f"{name} motor, {rotor.name}, {integrator}, dt = {share:g} L/R, step"
            f" {difference.argmax() + 1}"
        )
        time = np.arange(1, len(difference) + 1) * timestep
        native_curve = Curve("<dcmotor>", time, native.current[:, 0], reference=True)
        curves = (Curve("ours", time, ours.current[:, 0]), native_curve)
        plot = Plot("Current on the swinging load, Euler", "time [s]", "current [A]", curves)
        yield Case(
            difference,
            description,
            plots=(plot,) if (name, rotor, share) == ("paper", ECCENTRIC_ROTOR, 0.1) else (),
        )


@check(
    "motor",
    order_check(
        "native <dcmotor>, Euler, order in the substeps",
        "MuJoCo's <dcmotor> at the true inductance",
    ),
)
def order_in_substeps(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Check that the difference is of first order in the substeps, at the true inductance."""
    counts, series = 2 ** np.arange(4, 8 if quick else 11), []
    for (name, motor), rotor in itertools.product(
        motors.items(), (LOCKED_ROTOR, FREE_ROTOR, ECCENTRIC_ROTOR)
    ):
        timestep = 0.2 * motor.electrical_time_constant
        actuators = [voltage_actuator(motor, int(count)) for count in counts]
        errors = [
            _compare_with_native(rotor, motor, actuator, timestep, 5, 20)[-1].max()
            for actuator in actuators
        ]
        series.append(
            ConvergenceSeries(f"{name}, {rotor.name}", timestep / counts, np.array(errors))
        )
    title = "Ours against <dcmotor>, Euler"
    yield order_case(1.0, series, title, "electrical substep [s]", "largest difference [relative]")


@check(
    "motor",
    order_check(
        "native <dcmotor>, implicitfast, order in the step", "MuJoCo's <dcmotor> at the same step"
    ),
)
def order_under_implicitfast(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Check that the difference under `implicitfast` is of second order in the step."""
    divisors, series = 2 ** np.arange(5, 9 if quick else 11), []
    for (name, motor), rotor in itertools.product(motors.items(), (FREE_ROTOR, ECCENTRIC_ROTOR)):
        steps, errors = motor.electrical_time_constant / divisors, []
        for divisor, timestep in zip(divisors, steps, strict=True):
            comparison = _compare_with_native(
                rotor,
                motor,
                exact_euler_actuator(motor, timestep),
                timestep,
                int(divisor),
                10,
                "implicitfast",
            )
            errors.append(comparison[-1].max())
        series.append(ConvergenceSeries(f"{name}, {rotor.name}", steps, np.array(errors)))
    title = "Ours against <dcmotor>, implicitfast"
    yield order_case(2.0, series, title, "step [s]", "largest difference [relative]")


@check("motor", Check("RK4, locked rotor", "exponential of the RL circuit", 1e-12))
def rk4_check(quick: bool) -> Iterator[Case]:
    """Compare our current under RK4 with the exponential, on a locked rotor at 1 V.

    Tolerance 1e-12 of the current. The native motor's error at the same steps is only reported.
    """
    motor = Motor()
    shares = np.array([0.1, 0.3, 1.0]) if quick else np.geomspace(0.1, 1.0, 9)
    ours, native = np.empty((2, len(shares)))
    for index, share in enumerate(shares):
        timestep = float(share) * motor.electrical_time_constant
        volts = np.ones(math.ceil(3.0 / share))
        currents = (1.0 / motor.resistance) * (1.0 - np.exp(-share * np.arange(1, len(volts) + 1)))
        ours[index], native[index] = (
            np.abs(
                simulate(build_rotors(LOCKED_ROTOR, [simulated], timestep, "RK4"), volts).current[
                    :, 0
                ]
                / currents
                - 1.0
            ).max()
            for simulated in (exact_euler_actuator(motor, timestep), motor)
        )
    native_error = (
        f"; <dcmotor> reads {native[0]:.1%} wrong at dt = {shares[0]:g} L/R, {native[-1]:.0%} at"
        f" {shares[-1]:g} L/R"
    )
    curves = (
        Curve("ours", shares, np.maximum(ours, 1e-17)),
        Curve("native <dcmotor>", shares, native),
    )
    plot = Plot(
        "Why <dcmotor> is no oracle under RK4: locked rotor, a step of voltage",
        "integration step over L/R [1]",
        "largest error of the current [relative]",
        curves,
        x_log=True,
        y_log=True,
    )
    yield Case(ours, lambda index: f"dt = {shares[index]:.3g} L/R{native_error}", plots=(plot,))


# -- gym-electric-motor ----------------------------------------------------------------------------

SUPPLY = 12.0
"""Supply voltage [V]."""
PERIOD = 0.05
"""Duration for which each voltage is held [s]."""


def gem_run(motor: Motor, inertia: float, voltages: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speed [rad/s] and current [A] of gym-electric-motor's drive after each voltage.

    The complete drive is simulated: ideal supply, continuous four-quadrant converter,
    `DcPermanentlyExcitedMotor`, whose one constant psi_e is both kT and kE, inertial load, and
    scipy's DOP853 at 1e-11. Each voltage is held for `PERIOD`.
    """
    # gym-electric-motor is optional.
    from gym_electric_motor.physical_systems import (
        converters,
        electric_motors,
        solvers,
        voltage_supplies,
    )
    from gym_electric_motor.physical_systems.mechanical_loads import PolynomialStaticLoad
    from gym_electric_motor.physical_systems.physical_systems import DcMotorSystem

    parameters = {
        "r_a": motor.resistance,
        "l_a": motor.inductance,
        "psi_e": motor.back_emf_constant,
        "j_rotor": 0.0,
    }
    system = DcMotorSystem(
        converter=converters.ContFourQuadrantConverter(tau=PERIOD),
        motor=electric_motors.DcPermanentlyExcitedMotor(motor_parameter=parameters),
        load=PolynomialStaticLoad(load_parameter={"a": 0.0, "b": 0.0, "c": 0.0, "j_load": inertia}),
        supply=voltage_supplies.IdealVoltageSupply(u_nominal=SUPPLY),
        ode_solver=solvers.ScipySolveIvpSolver(method="DOP853", rtol=1e-11, atol=1e-12),
        tau=PERIOD,
    )
    system.reset()
    rows = np.array([system.simulate([voltage / SUPPLY]) * system.limits for voltage in voltages])
    names = list(system.state_names)
    return rows[:, names.index("omega")], rows[:, names.index("i")]


@check(
    "motor",
    order_check(
        "gym-electric-motor, order in the step", "gym-electric-motor's DcPermanentlyExcitedMotor"
    ),
)
def gem_check(motor: Motor, quick: bool) -> Iterator[Case]:
    """Check that speed and current converge to gym-electric-motor's at first order in the step.

    The integrator is Euler, on a free rotor.
    """
    voltages = np.random.default_rng(1).uniform(-SUPPLY, SUPPLY, 20 if quick else 40)
    speed, current = gem_run(motor, FREE_ROTOR.inertia, voltages)
    counts = 2 ** np.arange(4, 8 if quick else 11)
    errors = np.empty((2, len(counts)))
    for index, count in enumerate(counts.tolist()):
        record = simulate(
            build_rotors(FREE_ROTOR, [voltage_actuator(motor)], PERIOD / count),
            voltages.repeat(count),
        )
        errors[:, index] = [
            np.abs(ours[count - 1 :: count, 0] - oracle).max()
            for ours, oracle in ((record.speed, speed), (record.current, current))
        ]
    steps = PERIOD / counts
    series = [
        ConvergenceSeries(label, steps, quantity_errors)
        for label, quantity_errors in zip(("speed [rad/s]", "current [A]"), errors, strict=True)
    ]
    title = "Ours against gym-electric-motor, free rotor"
    yield order_case(1.0, series, title, "step [s]", "largest difference [rad/s, A]")


# -- a datasheet's numbers -------------------------------------------------------------------------

VOLTAGE = 6.0
"""Supply voltage of every measurement [V]."""
TOLERANCE = 1e-9
"""Tolerance of steady-state values, relative."""
_LINE = "u = R i + kE omega, torque = kT i in steady state"


@check("motor", Check("torque-speed line and power, stall to regeneration", _LINE, TOLERANCE))
def torque_speed_line(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """Compare the torque-speed line and the power, from stall to regeneration.

    Without a back-EMF there is no no-load speed, and all measurements are at rest. Tolerance 1e-9:
    the measurements wait for 40 electrical (no load: 40 mechanical) time constants, exp(-40) =
    4e-18, and an Euler step has the same fixed point as the circuit.
    """
    # Shares of the no-load speed: reversed, stall, driving, no load, dragged.
    shares = np.array([-0.5, 0.0, 0.5, 1.0, 1.5])
    names = ("reversed", "stall", "driving", "no load", "regenerating")
    for name, motor in motors.items():
        timestep = 0.2 * motor.electrical_time_constant
        has_back_emf = motor.back_emf_constant > 0
        # The no-load speed of the joint.
        no_load_speed = (
            VOLTAGE / motor.back_emf_constant * motor.arm_radius if has_back_emf else 0.0
        )
        model = build_rotors(LOCKED_ROTOR, [voltage_actuator(motor)] * len(shares), timestep)
        speeds = np.tile(shares * no_load_speed, (200, 1))
        run = simulate(model, np.full(len(speeds), VOLTAGE), speeds)
        line = (
            motor.torque_constant
            / motor.arm_radius
            * VOLTAGE
            / motor.resistance
            * (1.0 - shares * has_back_emf)
        )
        torque, stall = run.torque[-1], float(np.abs(line).max())
        power = VOLTAGE * run.current[-1]
        expected_power = VOLTAGE**2 / motor.resistance * (1.0 - shares * has_back_emf)
        descriptions = [f"{name}, {part}{region}" for part in ("", "power, ") for region in names]
        gaps = np.append(
            np.abs(torque - line) / stall,
            np.abs(power - expected_power) / np.abs(expected_power).max(),
        )
        curves = (
            Curve("MuJoCo", shares * no_load_speed, torque),
            Curve("kT (u - kE omega)/R", shares * no_load_speed, line, True),
        )
        plot = Plot(
            f"Torque over speed at {VOLTAGE:g} V, {name}", "speed [rad/s]", "torque [N m]", curves
        )
        yield Case(
            gaps, descriptions.__getitem__, plots=(plot,) if name == next(iter(motors)) else ()
        )


@check("motor", Check("no-load speed and current", "u/kE, and none", TOLERANCE))
def no_load(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """Compare the no-load speed and current of the motors with a back-EMF."""
    for name, motor in motors.items():
        if motor.back_emf_constant == 0:
            continue
        product = motor.torque_constant * motor.back_emf_constant / motor.arm_radius**2
        mechanical = FREE_ROTOR.inertia * motor.resistance / product
        timestep = 0.05 * min(motor.electrical_time_constant, mechanical)
        steps = int(40 * (2 * motor.electrical_time_constant + mechanical) / timestep)
        run = simulate(
            build_rotors(FREE_ROTOR, [voltage_actuator(motor)], timestep),
            np.full(min(steps, 40_000), VOLTAGE),
        )
        no_load_speed = VOLTAGE / motor.back_emf_constant * motor.arm_radius
        yield Case(
            abs(run.speed[-1, 0] / no_load_speed - 1.0), f"{name}: {run.speed[-1, 0]:.6g} rad/s"
        )
        yield Case(
            abs(run.current[-1, 0]) * motor.resistance / VOLTAGE, f"{name}: current without load"
        )


@check("motor", Check("stall torque at the voltage limit", "kT u_max/R", TOLERANCE))
def voltage_limit(loops: Mapping[str, Loop]) -> Iterator[Case]:
    """Compare the stall torque at the voltage limit of controller and supply, in both directions.

    The command is 1000 times the stall torque, so that any loop saturates, and the torque
    must be kT*u_max/R. Loops without a limit, or without a gain, never saturate and are
    skipped. The tolerance is that of the other datasheet checks.
    """
    for name, loop in loops.items():
        motor, gains, supply = loop.actuator.motor, loop.actuator.controller, loop.actuator.supply
        limit = gains.max_voltage
        if supply is not None:
            # The supply's resistance and the winding divide the voltage.
            open_circuit = limit if math.isinf(supply.voltage) else supply.voltage
            limit = min(
                limit, open_circuit * motor.resistance / (motor.resistance + supply.resistance)
            )
        if not math.isfinite(limit) or not gains.kp + gains.ki + gains.kff > 0:
            continue
        steps = math.ceil(40 * motor.electrical_time_constant / loop.timestep) + 40
        stall = motor.torque_constant * limit / motor.resistance
        for sign in (1.0, -1.0):
            controls = np.full(steps, 1000.0 * sign * stall)
            torque = simulate(
                build_rotors(LOCKED_ROTOR, [loop.actuator], loop.timestep),
                controls,
                np.zeros(steps),
            ).torque[-1, 0]
            error = abs(float(torque) * motor.arm_radius / (sign * stall) - 1.0)
            yield Case(error, f"{name}, {torque:.6g} N m at {sign * limit:g} V")


# -- the group -------------------------------------------------------------------------------------


def checks(task_name: str | None = None, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the motor checks with the loop of one task, or with all `standard_loops`."""
    loops = standard_loops()
    yield from loop_checks(loops if task_name is None else {task_name: loops[task_name]}, quick)
    yield from compiled_checks(quick)
    yield from drive_checks(quick)
    for native_check in (equal_to_native, order_in_substeps, order_under_implicitfast):
        yield from native_check(MOTORS, quick)
    yield from rk4_check(quick)
    if importlib.util.find_spec("gym_electric_motor"):
        yield from gem_check(Motor(), quick)
    else:
        subject = "the motor against gym-electric-motor's permanently excited DC motor"
        yield Skipped(subject, "gym-electric-motor is not installed")


def loop_checks(loops: Mapping[str, Loop], quick: bool = False) -> Iterator[Check]:
    """Run the checks that apply to any motors: all but the comparisons of fixed motors."""
    motors = {name: loop.actuator.motor for name, loop in loops.items()}
    yield from order_to_closed_form(loops, quick)
    yield from sampled_checks(loops, quick)
    yield from voltage_limit(loops)
    yield from torque_speed_line(motors)
    yield from no_load(motors)
