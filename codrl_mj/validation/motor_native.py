"""The motor without its loop, driven by a voltage, against MuJoCo's native `<dcmotor>` of the same parameters.

The two integrate the winding differently. With the speed held over a step, the native motor is exact,
i' = i_inf + (i - i_inf) exp(-R dt/L), and ours takes Euler steps. Hence two comparisons: at an inductance of
R dt/(1 - exp(-R dt/L)) one Euler step *is* the exact one, so that the two motors must be equal to rounding; and at the
true inductance ours converges to the native one at first order in the substeps.

Under `implicitfast` the engine adds the slope of the native motor's torque over speed, kT kE/R (1 - exp(-R dt/L)), to
the velocity's implicit matrix. Ours has no such slope. It shrinks with the step and acts over a step, so that the
difference vanishes at second order; on a locked rotor there is none.

Under RK4 the native motor is no oracle: the engine advances its current at every stage, and a step ends with a current
that no exponential has. `rk4_check` measures it beside ours, which holds the force over the step and stays exact.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np

from codrl_mj.actuators import Actuator, Motor
from codrl_mj.pages.plots import Curve, Plot
from codrl_mj.validation.rotors import (
    FREE,
    HELD,
    SWINGING,
    Load,
    Record,
    drive,
    driven_by_voltage,
    motors_on,
    native_motor_on,
)
from codrl_mj.validation.table import Case, Check, Family, Oracle, check, of_order, order

MOTORS: dict[str, Motor] = {
    "paper": Motor(),
    "small": Motor(resistance=2.0, inductance=0.02, torque_constant=0.5, back_emf_constant=0.5),
}
"""The motors compared: the paper's, and one whose parameters all differ from each other."""

_CASES: tuple[tuple[Load, str], ...] = ((HELD, "Euler"), (HELD, "implicitfast"), (FREE, "Euler"), (SWINGING, "Euler"))


def exact_inductance(motor: Motor, timestep: float) -> Motor:
    """The motor at the inductance for which one Euler step is the exact step of the given one."""
    decay = 1.0 - math.exp(-timestep * motor.resistance / motor.inductance)
    return dataclasses.replace(motor, inductance=motor.resistance * timestep / decay)


def _voltages(hold: int, count: int) -> np.ndarray:
    """Random voltages in +-4 V, each held for `hold` steps."""
    return np.random.default_rng(0).uniform(-4.0, 4.0, count).repeat(hold)


def _both(
    load: Load, motor: Motor, actuator: Actuator, timestep: float, volts: np.ndarray, integrator: str = "Euler"
) -> tuple[Record, Record, np.ndarray]:
    """Ours and the native motor, and their differences of angle, speed and current, relative to max(1, size)."""
    ours = drive(motors_on(load, [actuator], timestep, integrator), volts)
    native = drive(native_motor_on(load, motor, timestep, integrator), volts)
    pairs = zip(ours[:3], native[:3], strict=True)
    return ours, native, np.max([np.abs(a - b) / np.maximum(1.0, np.abs(b)) for a, b in pairs], axis=(0, 2))


@check(
    "motor",
    Oracle(
        "native <dcmotor>, same map", "MuJoCo's <dcmotor>: angle, speed and current; locked, free and swinging", 1e-10
    ),
)
def same_map(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Tolerance 1e-10: rounding of some 100 steps of a coupled, stable system."""
    for name, motor in motors.items():
        for load, integrator in _CASES:
            for share in (0.1, 1.0) if quick else (0.01, 0.1, 0.3, 1.0):
                timestep = share * motor.electrical_time_constant
                volts = _voltages(5, 20 if quick else 100)
                actuator = driven_by_voltage(exact_inductance(motor, timestep))
                ours, native, difference = _both(load, motor, actuator, timestep, volts, integrator)
                at = f"{name} motor, {load.name}, {integrator}, dt = {share:g} L/R, step {difference.argmax() + 1}"
                plots: tuple[Plot, ...] = ()
                if (name, load, share) == ("paper", SWINGING, 0.1):
                    time = np.arange(1, len(volts) + 1) * timestep
                    theirs = Curve("<dcmotor>", time, native.current[:, 0], reference=True)
                    curves = (Curve("ours", time, ours.current[:, 0]), theirs)
                    plots = (Plot("Current on the swinging load, Euler", "time [s]", "current [A]", curves),)
                yield Case(difference, at, plots=plots)


@check("motor", order("native <dcmotor>, Euler, order in the substeps", "MuJoCo's <dcmotor> at the true inductance"))
def substeps(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """First order in the substeps, at the true inductance."""
    counts, families = 2 ** np.arange(4, 8 if quick else 11), []
    for name, motor in motors.items():
        for load in (HELD, FREE, SWINGING):
            timestep = 0.2 * motor.electrical_time_constant
            actuators = [driven_by_voltage(motor, int(count)) for count in counts]
            errors = [_both(load, motor, one, timestep, _voltages(5, 20))[-1].max() for one in actuators]
            families.append(Family(f"{name}, {load.name}", timestep / counts, np.array(errors)))
    title = "Ours against <dcmotor>, Euler"
    yield of_order(1.0, families, title, "electrical substep [s]", "largest difference [relative]")


@check("motor", order("native <dcmotor>, implicitfast, order in the step", "MuJoCo's <dcmotor> at the same step"))
def implicitfast(motors: Mapping[str, Motor], quick: bool) -> Iterator[Case]:
    """Second order in the step."""
    divisors, families = 2 ** np.arange(5, 9 if quick else 11), []
    for name, motor in motors.items():
        for load in (FREE, SWINGING):
            steps = motor.electrical_time_constant / divisors
            errors = []
            for divisor, timestep in zip(divisors, steps, strict=True):
                actuator, volts = driven_by_voltage(exact_inductance(motor, timestep)), _voltages(int(divisor), 10)
                errors.append(_both(load, motor, actuator, timestep, volts, "implicitfast")[-1].max())
            families.append(Family(f"{name}, {load.name}", steps, np.array(errors)))
    title = "Ours against <dcmotor>, implicitfast"
    yield of_order(2.0, families, title, "step [s]", "largest difference [relative]")


@check("motor", Oracle("RK4, locked rotor", "exponential of the RL circuit", 1e-12))
def rk4_check(quick: bool) -> Iterator[Case]:
    """Our current under RK4 against the exponential, on a locked rotor at 1 V; tolerance 1e-12 of the current.

    The native motor's error at the same steps is shown beside it and is no part of the verdict.
    """
    motor = Motor()
    shares = np.array([0.1, 0.3, 1.0]) if quick else np.geomspace(0.1, 1.0, 9)
    ours: list[float] = []
    native: list[float] = []
    for share in shares:
        timestep = float(share) * motor.electrical_time_constant
        volts = np.ones(math.ceil(3.0 / share))
        exact = (1.0 / motor.resistance) * (1.0 - np.exp(-share * np.arange(1, len(volts) + 1)))
        models = (
            motors_on(HELD, [driven_by_voltage(exact_inductance(motor, timestep))], timestep, "RK4"),
            native_motor_on(HELD, motor, timestep, "RK4"),
        )
        for errors, model in zip((ours, native), models, strict=True):
            errors.append(float(np.abs(drive(model, volts).current[:, 0] / exact - 1.0).max()))
    native_error = (
        f"; <dcmotor> reads {native[0]:.1%} wrong at dt = {shares[0]:g} L/R, {native[-1]:.0%} at {shares[-1]:g} L/R"
    )
    curves = (Curve("ours", shares, np.maximum(ours, 1e-17)), Curve("native <dcmotor>", shares, np.array(native)))
    plot = Plot(
        "Why <dcmotor> is no oracle under RK4: locked rotor, a step of voltage",
        "integration step over L/R [1]",
        "largest error of the current [relative]",
        curves,
        x_log=True,
        y_log=True,
    )
    yield Case(ours, lambda at: f"dt = {shares[at]:.3g} L/R{native_error}", plots=(plot,))


def native_checks(motors: Mapping[str, Motor], quick: bool) -> Iterator[Check]:
    """All comparisons with `<dcmotor>`."""
    yield from same_map(motors, quick)
    yield from substeps(motors, quick)
    yield from implicitfast(motors, quick)
    yield from rk4_check(quick)
