"""The motor as it runs inside MuJoCo, callbacks and all, against oracles that are not ours.

`motor_loops` has the current loop against linear systems theory, `own_model` what can be asked of
any family of actuators, `drives` what bench motors are compared with. Here is the motor without its
loop, driven by a voltage: MuJoCo's native `<dcmotor>`, gym-electric-motor, and a datasheet. Torques
are read where the engine applies them.

MuJoCo's motor integrates the winding differently. With the speed held over a step, the native motor
is exact, i' = i_inf + (i - i_inf) exp(-R dt/L), and ours takes Euler steps. Hence two comparisons:
at an inductance of R dt/(1 - exp(-R dt/L)) one Euler step *is* the exact one, so that the two
motors must be equal to rounding; and at the true inductance ours converges to the native one at
first order in the substeps.

Under `implicitfast` the engine adds the slope of the native motor's torque over speed, kT kE/R (1 -
exp(-R dt/L)), to the velocity's implicit matrix. Ours has no such slope. It shrinks with the step
and acts over a step, so that the difference vanishes at second order; on a locked rotor there is
none.

Under RK4 the native motor is no oracle: the engine advances its current at every stage, and a step
ends with a current that no exponential has. `rk4_check` measures it beside ours, which holds the
force over the step and stays exact.

gym-electric-motor (https://github.com/upb-lea/gym-electric-motor) is a simulator of drives written
by others. It is no dependency of the package, because it installs pytest and coverage; where it is
absent its check is left out.

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
from codrl_mj.validation.motor_catalogue import drive_checks
from codrl_mj.validation.motor_loops import analogue, sampled_checks
from codrl_mj.validation.own_model import compiled_checks
from codrl_mj.validation.rotors import (
    FREE,
    HELD,
    SWINGING,
    Loop,
    Record,
    Rotor,
    drive,
    driven_by_voltage,
    motors_on,
    standard_loops,
)
from codrl_mj.validation.table import Case, Check, Family, Skipped, check, of_order, order
from codrl_mj.viz.pages.plots import Curve, Plot

MOTORS: dict[str, Motor] = {
    "paper": Motor(),
    "small": Motor(resistance=2.0, inductance=0.02, torque_constant=0.5, back_emf_constant=0.5),
}
"""The motors compared: the paper's, and one whose parameters all differ from each other."""

_ON: tuple[tuple[Rotor, str], ...] = (
    (HELD, "Euler"),
    (HELD, "implicitfast"),
    (FREE, "Euler"),
    (SWINGING, "Euler"),
)


def exact(motor: Motor, timestep: float) -> DCMotorActuator:
    """A motor of ours under a voltage, whose inductance makes its Euler step the exact one of the given motor."""
    decay = 1.0 - math.exp(-timestep * motor.resistance / motor.inductance)
    return driven_by_voltage(
        dataclasses.replace(motor, inductance=motor.resistance * timestep / decay)
    )


def _both(
    rotor: Rotor,
    motor: Motor,
    actuator: DCMotorActuator,
    timestep: float,
    hold: int,
    count: int,
    integrator: str = "Euler",
) -> tuple[Record, Record, np.ndarray]:
    """Ours and the native motor, and their differences of angle, speed and current, relative to max(1, size).

    Both are under `count` random voltages in +-4 V, each held for `hold` steps.
    """
    volts = np.random.default_rng(0).uniform(-4.0, 4.0, count).repeat(hold)
    ours, native = (
        drive(motors_on(rotor, [one], timestep, integrator), volts) for one in (actuator, motor)
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
def same_map(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Tolerance 1e-10: rounding of some 100 steps of a coupled, stable system."""
    shares = (0.1, 1.0) if quick else (0.01, 0.1, 0.3, 1.0)
    for (name, motor), (rotor, integrator), share in itertools.product(motors.items(), _ON, shares):
        timestep = share * motor.electrical_time_constant
        count = 20 if quick else 100
        ours, native, difference = _both(
            rotor, motor, exact(motor, timestep), timestep, 5, count, integrator
        )
        at = (
            f"{name} motor, {rotor.name}, {integrator}, dt = {share:g} L/R, step"
            f" {difference.argmax() + 1}"
        )
        time = np.arange(1, len(difference) + 1) * timestep
        theirs = Curve("<dcmotor>", time, native.current[:, 0], reference=True)
        curves = (Curve("ours", time, ours.current[:, 0]), theirs)
        plot = Plot("Current on the swinging load, Euler", "time [s]", "current [A]", curves)
        yield Case(
            difference,
            at,
            plots=(plot,) if (name, rotor, share) == ("paper", SWINGING, 0.1) else (),
        )


@check(
    "motor",
    order(
        "native <dcmotor>, Euler, order in the substeps",
        "MuJoCo's <dcmotor> at the true inductance",
    ),
)
def substeps(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """First order in the substeps, at the true inductance."""
    counts, families = 2 ** np.arange(4, 8 if quick else 11), []
    for (name, motor), rotor in itertools.product(motors.items(), (HELD, FREE, SWINGING)):
        timestep = 0.2 * motor.electrical_time_constant
        actuators = [driven_by_voltage(motor, int(count)) for count in counts]
        errors = [_both(rotor, motor, one, timestep, 5, 20)[-1].max() for one in actuators]
        families.append(Family(f"{name}, {rotor.name}", timestep / counts, np.array(errors)))
    title = "Ours against <dcmotor>, Euler"
    yield of_order(1.0, families, title, "electrical substep [s]", "largest difference [relative]")


@check(
    "motor",
    order(
        "native <dcmotor>, implicitfast, order in the step", "MuJoCo's <dcmotor> at the same step"
    ),
)
def implicitfast(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Second order in the step."""
    divisors, families = 2 ** np.arange(5, 9 if quick else 11), []
    for (name, motor), rotor in itertools.product(motors.items(), (FREE, SWINGING)):
        steps, errors = motor.electrical_time_constant / divisors, []
        for divisor, timestep in zip(divisors, steps, strict=True):
            both = _both(
                rotor, motor, exact(motor, timestep), timestep, int(divisor), 10, "implicitfast"
            )
            errors.append(both[-1].max())
        families.append(Family(f"{name}, {rotor.name}", steps, np.array(errors)))
    title = "Ours against <dcmotor>, implicitfast"
    yield of_order(2.0, families, title, "step [s]", "largest difference [relative]")


@check("motor", Check("RK4, locked rotor", "exponential of the RL circuit", 1e-12))
def rk4_check(quick: bool) -> Iterator[Case]:
    """Our current under RK4 against the exponential, on a locked rotor at 1 V; tolerance 1e-12 of the current.

    The native motor's error at the same steps is shown beside it and is no part of the verdict.
    """
    motor = Motor()
    shares = np.array([0.1, 0.3, 1.0]) if quick else np.geomspace(0.1, 1.0, 9)
    ours, native = np.empty((2, len(shares)))
    for at, share in enumerate(shares):
        timestep = float(share) * motor.electrical_time_constant
        volts = np.ones(math.ceil(3.0 / share))
        currents = (1.0 / motor.resistance) * (1.0 - np.exp(-share * np.arange(1, len(volts) + 1)))
        ours[at], native[at] = (
            np.abs(
                drive(motors_on(HELD, [one], timestep, "RK4"), volts).current[:, 0] / currents - 1.0
            ).max()
            for one in (exact(motor, timestep), motor)
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
    yield Case(ours, lambda at: f"dt = {shares[at]:.3g} L/R{native_error}", plots=(plot,))


# -- gym-electric-motor ------------------------------------------------------------------------------------------

SUPPLY = 12.0
"""Supply voltage [V]."""
PERIOD = 0.05
"""How long each voltage is held [s]."""


def gem_run(motor: Motor, inertia: float, voltages: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [rad/s] and current [A] of gym-electric-motor's drive after each voltage's period.

    Its whole chain runs: ideal supply, continuous four-quadrant converter,
    `DcPermanentlyExcitedMotor`, whose one constant psi_e is both kT and kE, inertial load, and
    scipy's DOP853 at 1e-11. A voltage is held over its period.
    """
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
    order(
        "gym-electric-motor, order in the step", "gym-electric-motor's DcPermanentlyExcitedMotor"
    ),
)
def gem_check(motor: Motor, quick: bool) -> Iterator[Case]:
    """Convergence of speed and current to gym-electric-motor's at first order in the step, Euler on a free rotor."""
    voltages = np.random.default_rng(1).uniform(-SUPPLY, SUPPLY, 20 if quick else 40)
    speed, current = gem_run(motor, FREE.inertia, voltages)
    counts = 2 ** np.arange(4, 8 if quick else 11)
    errors = np.empty((2, len(counts)))
    for at, count in enumerate(counts.tolist()):
        found = drive(
            motors_on(FREE, [driven_by_voltage(motor)], PERIOD / count), voltages.repeat(count)
        )
        errors[:, at] = [
            np.abs(ours[count - 1 :: count, 0] - theirs).max()
            for ours, theirs in ((found.speed, speed), (found.current, current))
        ]
    steps = PERIOD / counts
    families = [
        Family(label, steps, one)
        for label, one in zip(("speed [rad/s]", "current [A]"), errors, strict=True)
    ]
    title = "Ours against gym-electric-motor, free rotor"
    yield of_order(1.0, families, title, "step [s]", "largest difference [rad/s, A]")


# -- a datasheet's numbers -----------------------------------------------------------------------------------------

VOLTAGE = 6.0
"""Supply of every measurement [V]."""
TOLERANCE = 1e-9
_LINE = "u = R i + kE omega, torque = kT i in steady state"


@check("motor", Check("torque-speed line and power, stall to regeneration", _LINE, TOLERANCE))
def torque_speed_line(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """The torque-speed line, stall to regeneration; without a back-EMF it is measured at rest alone.

    Tolerance 1e-9: the measurements wait for 40 electrical (no load: 40 mechanical) time constants,
    exp(-40) = 4e-18, and an Euler step has the circuit's own fixed point.
    """
    shares = np.array(
        [-0.5, 0.0, 0.5, 1.0, 1.5]
    )  # of the no-load speed: reversed, stall, driving, no load, dragged
    names = ("reversed", "stall", "driving", "no load", "regenerating")
    for name, motor in motors.items():
        timestep = 0.2 * motor.electrical_time_constant
        spins = motor.back_emf_constant > 0
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius if spins else 0.0  # of the joint
        model = motors_on(HELD, [driven_by_voltage(motor)] * len(shares), timestep)
        speeds = np.tile(shares * top, (200, 1))
        run = drive(model, np.full(len(speeds), VOLTAGE), speeds)
        line = (
            motor.torque_constant
            / motor.arm_radius
            * VOLTAGE
            / motor.resistance
            * (1.0 - shares * spins)
        )
        torque, stall = run.torque[-1], float(np.abs(line).max())
        power = VOLTAGE * run.current[-1]
        drawn = VOLTAGE**2 / motor.resistance * (1.0 - shares * spins)
        where = [f"{name}, {part}{at}" for part in ("", "power, ") for at in names]
        gaps = np.append(np.abs(torque - line) / stall, np.abs(power - drawn) / np.abs(drawn).max())
        curves = (
            Curve("MuJoCo", shares * top, torque),
            Curve("kT (u - kE omega)/R", shares * top, line, True),
        )
        plot = Plot(
            f"Torque over speed at {VOLTAGE:g} V, {name}", "speed [rad/s]", "torque [N m]", curves
        )
        yield Case(gaps, where.__getitem__, plots=(plot,) if name == next(iter(motors)) else ())


@check("motor", Check("no-load speed and current", "u/kE, and none", TOLERANCE))
def no_load(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """The free no-load speed of those that have one."""
    for name, motor in motors.items():
        if motor.back_emf_constant == 0:
            continue
        product = motor.torque_constant * motor.back_emf_constant / motor.arm_radius**2
        mechanical = FREE.inertia * motor.resistance / product
        timestep = 0.05 * min(motor.electrical_time_constant, mechanical)
        steps = int(40 * (2 * motor.electrical_time_constant + mechanical) / timestep)
        run = drive(
            motors_on(FREE, [driven_by_voltage(motor)], timestep),
            np.full(min(steps, 40_000), VOLTAGE),
        )
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius
        yield Case(abs(run.speed[-1, 0] / top - 1.0), f"{name}: {run.speed[-1, 0]:.6g} rad/s")
        yield Case(
            abs(run.current[-1, 0]) * motor.resistance / VOLTAGE, f"{name}: current without load"
        )


@check("motor", Check("stall torque at the voltage limit", "kT u_max/R", TOLERANCE))
def voltage_limit(loops: Mapping[str, Loop]) -> Iterator[Case]:
    """Stall torque at the voltage that controller and supply leave, in both directions, under a command far beyond it.

    A loop asked for 1000 times its stall current saturates whatever its gains, so that the torque
    must be kT*u_max/R. Loops without a limit, or without a gain, never do and are left out. The
    tolerance is that of the other constants.
    """
    for name, loop in loops.items():
        motor, gains, supply = loop.actuator.motor, loop.actuator.controller, loop.actuator.supply
        limit = gains.max_voltage
        if supply is not None:
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
            torque = drive(
                motors_on(HELD, [loop.actuator], loop.timestep), controls, np.zeros(steps)
            ).torque[-1, 0]
            error = abs(float(torque) * motor.arm_radius / (sign * stall) - 1.0)
            yield Case(error, f"{name}, {torque:.6g} N m at {sign * limit:g} V")


# -- the group -----------------------------------------------------------------------------------------------------


def checks(task_name: str | None = None, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of the motor, with the loop of one task alone, or with every task's and one with every feature."""
    loops = standard_loops()
    yield from checks_of(loops if task_name is None else {task_name: loops[task_name]}, quick)
    yield from compiled_checks(quick)
    yield from drive_checks(quick)
    for compared in (same_map, substeps, implicitfast):
        yield from compared(MOTORS, quick)
    yield from rk4_check(quick)
    if importlib.util.find_spec("gym_electric_motor"):
        yield from gem_check(Motor(), quick)
    else:
        subject = "the motor against gym-electric-motor's permanently excited DC motor"
        yield Skipped(subject, "gym-electric-motor is not installed")


def checks_of(loops: Mapping[str, Loop], quick: bool = False) -> Iterator[Check]:
    """Those checks that apply to any motors, such as a user's own: all but the comparisons with fixed motors."""
    motors = {name: loop.actuator.motor for name, loop in loops.items()}
    yield from analogue(loops, quick)
    yield from sampled_checks(loops, quick)
    yield from voltage_limit(loops)
    yield from torque_speed_line(motors)
    yield from no_load(motors)
