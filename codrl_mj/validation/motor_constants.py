"""What a datasheet promises: stall, no-load and regeneration, measured inside MuJoCo.

In steady state u = R*i + kE*omega and torque = kT*i: a straight line of torque over speed through the stall torque
kT*u/R and the no-load speed u/kE, beyond which the current changes sign and power flows back into the supply.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from codrl_mj.actuators import Motor
from codrl_mj.pages.plots import Curve, Plot
from codrl_mj.validation.motor_loops import Loop
from codrl_mj.validation.rotors import FREE, HELD, drive, driven_by_voltage, motors_on
from codrl_mj.validation.table import Case, Check, Oracle, check

VOLTAGE = 6.0
"""Supply of every measurement [V]."""


TOLERANCE = 1e-9
_LINE = "u = R i + kE omega, torque = kT i in steady state"


@check("motor", Oracle("torque-speed line and power, stall to regeneration", _LINE, TOLERANCE))
def torque_speed_line(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """The torque-speed line, stall to regeneration; without a back-EMF it is measured at rest alone.

    Tolerance 1e-9: the measurements wait for 40 electrical (no load: 40 mechanical) time constants, exp(-40) = 4e-18,
    and an Euler step has the circuit's own fixed point.
    """
    shares = np.array([-0.5, 0.0, 0.5, 1.0, 1.5])  # of the no-load speed: reversed, stall, driving, no load, dragged
    names = ("reversed", "stall", "driving", "no load", "regenerating")
    for name, motor in motors.items():
        timestep = 0.2 * motor.electrical_time_constant
        spins = motor.back_emf_constant > 0
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius if spins else 0.0  # of the joint
        model = motors_on(HELD, [driven_by_voltage(motor)] * len(shares), timestep)
        speeds = np.tile(shares * top, (200, 1))
        run = drive(model, np.full(len(speeds), VOLTAGE), speeds)
        line = motor.torque_constant / motor.arm_radius * VOLTAGE / motor.resistance * (1.0 - shares * spins)
        torque, stall = run.torque[-1], float(np.abs(line).max())
        power = VOLTAGE * run.current[-1]
        drawn = VOLTAGE**2 / motor.resistance * (1.0 - shares * spins)
        where = [f"{name}, {part}{at}" for part in ("", "power, ") for at in names]
        gaps = np.append(np.abs(torque - line) / stall, np.abs(power - drawn) / np.abs(drawn).max())
        curves = (Curve("MuJoCo", shares * top, torque), Curve("kT (u - kE omega)/R", shares * top, line, True))
        plot = Plot(f"Torque over speed at {VOLTAGE:g} V, {name}", "speed [rad/s]", "torque [N m]", curves)
        yield Case(gaps, where.__getitem__, plots=(plot,) if name == next(iter(motors)) else ())


@check("motor", Oracle("no-load speed and current", "u/kE, and none", TOLERANCE))
def no_load(motors: Mapping[str, Motor]) -> Iterator[Case]:
    """The free no-load speed of those that have one."""
    for name, motor in motors.items():
        if motor.back_emf_constant == 0:
            continue
        product = motor.torque_constant * motor.back_emf_constant / motor.arm_radius**2
        mechanical = FREE.inertia * motor.resistance / product
        timestep = 0.05 * min(motor.electrical_time_constant, mechanical)
        steps = int(40 * (2 * motor.electrical_time_constant + mechanical) / timestep)
        run = drive(motors_on(FREE, [driven_by_voltage(motor)], timestep), np.full(min(steps, 40_000), VOLTAGE))
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius
        yield Case(abs(run.speed[-1, 0] / top - 1.0), f"{name}: {run.speed[-1, 0]:.6g} rad/s")
        yield Case(abs(run.current[-1, 0]) * motor.resistance / VOLTAGE, f"{name}: current without load")


@check("motor", Oracle("stall torque at the voltage limit", "kT u_max/R", TOLERANCE))
def voltage_limit(loops: Mapping[str, Loop]) -> Iterator[Case]:
    """Stall torque at the loop's own voltage limit, in both directions, under a command far beyond it.

    A loop asked for 1000 times its stall current saturates whatever its gains, so that the torque must be kT*u_max/R.
    Loops without a limit, or without a gain, never do and are left out. The tolerance is that of the other constants.
    """
    for name, loop in loops.items():
        motor, gains = loop.actuator.motor, loop.actuator.controller
        if not math.isfinite(gains.max_voltage) or not gains.kp + gains.ki + gains.kff > 0:
            continue
        steps = math.ceil(40 * motor.electrical_time_constant / loop.timestep) + 40
        stall = motor.torque_constant * gains.max_voltage / motor.resistance
        for sign in (1.0, -1.0):
            controls = np.full(steps, 1000.0 * sign * stall)
            torque = drive(motors_on(HELD, [loop.actuator], loop.timestep), controls, np.zeros(steps)).torque[-1, 0]
            error = abs(float(torque) * motor.arm_radius / (sign * stall) - 1.0)
            yield Case(error, f"{name}, {torque:.6g} N m at {sign * gains.max_voltage:g} V")


def constants_checks(loops: Mapping[str, Loop]) -> Iterator[Check]:
    """All checks of constants."""
    yield from voltage_limit(loops)
    motors = {name: loop.actuator.motor for name, loop in loops.items()}
    yield from torque_speed_line(motors)
    yield from no_load(motors)
