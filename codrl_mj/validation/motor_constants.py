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
from codrl_mj.validation.outcome import Check
from codrl_mj.validation.rotors import FREE, HELD, drive, driven_by_voltage, motors_on
from codrl_mj.validation.worst import worst_of

VOLTAGE = 6.0
"""Supply of every measurement [V]."""


def constants_checks(motors: Mapping[str, Motor]) -> Iterator[Check]:
    """The torque-speed line (stall to regeneration) and the free no-load speed.

    Tolerance 1e-9: the measurements wait for 40 electrical (no load: 40 mechanical) time constants, exp(-40) = 4e-18,
    and an Euler step has the circuit's own fixed point.

    Args:
        motors: by name; those without a back-EMF have no no-load speed and are measured at rest alone.
    """
    shares = np.array([-0.5, 0.0, 0.5, 1.0, 1.5])  # of the no-load speed: reversed, stall, driving, no load, dragged
    names = ("reversed", "stall", "driving", "no load", "regenerating")
    found, plots = [], []
    for name, motor in motors.items():
        timestep = 0.2 * motor.electrical_time_constant
        spins = motor.back_emf_constant > 0
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius if spins else 0.0  # of the joint
        model = motors_on(HELD, [driven_by_voltage(motor)] * len(shares), timestep)
        speeds = np.tile(shares * top, (200, 1))
        run = drive(model, np.full(len(speeds), VOLTAGE), speeds)
        line = motor.torque_constant / motor.arm_radius * VOLTAGE / motor.resistance * (1.0 - shares * spins)
        torque, stall = run.torque[-1], float(np.abs(line).max())
        found += [
            (float(error), f"{name}, {where}")
            for error, where in zip(np.abs(torque - line) / stall, names, strict=True)
        ]
        power = VOLTAGE * run.current[-1]
        drawn = VOLTAGE**2 / motor.resistance * (1.0 - shares * spins)
        share = np.abs(power - drawn) / np.abs(drawn).max()
        found += [(float(error), f"{name}, power, {where}") for error, where in zip(share, names, strict=True)]
        curves = (Curve("MuJoCo", shares * top, torque), Curve("kT (u - kE omega)/R", shares * top, line, True))
        plots.append(Plot(f"Torque over speed at {VOLTAGE:g} V, {name}", "speed [rad/s]", "torque [N m]", curves))
    worst, where = worst_of(found)
    oracle = "u = R i + kE omega, torque = kT i in steady state"
    name = "torque-speed line and power, stall to regeneration"
    yield Check(name, oracle, len(found), worst, 1e-9, where, group="motor", plots=tuple(plots[:1]))

    found = []
    for name, motor in motors.items():
        if motor.back_emf_constant == 0:
            continue
        product = motor.torque_constant * motor.back_emf_constant / motor.arm_radius**2
        mechanical = FREE.inertia * motor.resistance / product
        timestep = 0.05 * min(motor.electrical_time_constant, mechanical)
        steps = int(40 * (2 * motor.electrical_time_constant + mechanical) / timestep)
        run = drive(motors_on(FREE, [driven_by_voltage(motor)], timestep), np.full(min(steps, 40_000), VOLTAGE))
        top = VOLTAGE / motor.back_emf_constant * motor.arm_radius
        found.append((abs(float(run.speed[-1, 0]) / top - 1.0), f"{name}: {run.speed[-1, 0]:.6g} rad/s"))
        found.append((abs(float(run.current[-1, 0])) * motor.resistance / VOLTAGE, f"{name}: current without load"))
    if found:
        worst, where = worst_of(found)
        yield Check("no-load speed and current", "u/kE, and none", len(found), worst, 1e-9, where, group="motor")


def voltage_limit_check(loops: Mapping[str, Loop]) -> Check | None:
    """Stall torque at the loop's own voltage limit, in both directions, under a command far beyond it.

    A loop asked for 1000 times its stall current saturates whatever its gains, so that the torque must be kT*u_max/R.
    The tolerance, 1e-9, is that of the other constants.

    Args:
        loops: by name; those without a limit, or without a gain, never saturate and are left out.

    Returns:
        The check, or None where no loop saturates.
    """
    found = []
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
            found.append((error, f"{name}, {torque:.6g} N m at {sign * gains.max_voltage:g} V"))
    if not found:
        return None
    worst, where = worst_of(found)
    return Check("stall torque at the voltage limit", "kT u_max/R", len(found), worst, 1e-9, where, group="motor")
