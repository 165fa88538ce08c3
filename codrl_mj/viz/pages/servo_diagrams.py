"""Diagrams of a position servo: a step, the error under a load, and the bandwidth."""

import math

import numpy as np

from codrl_mj.actuators import PwmServo
from codrl_mj.plots import Curve, Plot
from codrl_mj.sizing.servo_response import (
    AMPLITUDE,
    FREQUENCIES,
    STEP,
    PositionServo,
    ServoResponse,
)


def servo_plots(servo: PositionServo, response: ServoResponse) -> list[Plot]:
    """Return the step response, the error under a load, and gain and phase over the frequency."""
    step = response.step
    span = step.time <= max(2.0 * np.nan_to_num(response.settling_time, nan=0.75), 0.1)
    time = 1e3 * step.time[span]
    load = f"load of {response.inertia:.3g} kg·m²" if response.inertia else "no load"
    positions = (
        Curve("position", time, step.position[span]),
        Curve("command", time[[0, -1]], np.full(2, STEP), reference=True),
    )
    answers = "frequency [Hz]"
    return [
        Plot(f"Step of {STEP:g} rad, {load}", "time [ms]", "position [rad]", positions),
        Plot("Current", "time [ms]", "current [A]", (Curve("current", time, step.current[span]),)),
        Plot("Voltage", "time [ms]", "voltage [V]", (Curve("voltage", time, step.voltage[span]),)),
        _sag(servo, response),
        Plot(
            f"Sines of {AMPLITUDE:g} rad, {load}",
            answers,
            "gain [dB]",
            (
                Curve("position / command", FREQUENCIES, 20.0 * np.log10(response.gains)),
                Curve("-3 dB", FREQUENCIES[[0, -1]], np.full(2, -3.01), reference=True),
            ),
            x_log=True,
        ),
        Plot(
            "Phase",
            answers,
            "phase [°]",
            (Curve("position / command", FREQUENCIES, np.degrees(response.phases)),),
            x_log=True,
        ),
    ]


def _sag(servo: PositionServo, response: ServoResponse) -> Plot:
    """Return the error under a steady load; between lifting and lowering it, friction holds it."""
    torques = np.linspace(0.0, 0.98 * response.max_torque, 60)
    errors = steady_errors(servo, response, torques)
    friction, efficiency = servo.additions.friction, servo.motor.gear_efficiency
    curves = [Curve("without friction", torques, errors)]
    if friction > 0.0 or efficiency < 1.0:
        lifting, lowering = (torques + friction) / efficiency, (torques - friction) * efficiency
        possible = lifting < response.max_torque
        lifted = steady_errors(servo, response, lifting[possible])
        lowered = steady_errors(servo, response, np.abs(lowering)) * np.sign(lowering)
        curves += [
            Curve("lifting the load", torques[possible], lifted, colour=1, dashed=True),
            Curve("lowering the load", torques, lowered, colour=2, dashed=True),
        ]
    title = "Sag: error that carries a load"
    return Plot(title, "load [N·m]", "error [rad]", tuple(curves))


def steady_errors(servo: PositionServo, response: ServoResponse, torques: np.ndarray) -> np.ndarray:
    """Return the errors [rad] at which a servo without friction carries torques [N*m] >= 0."""
    if math.isinf(response.stiffness):
        return np.zeros_like(torques)
    if not isinstance(servo, PwmServo):
        return torques / response.stiffness
    motor, sag = servo.motor, servo.supply_resistance
    currents = torques * servo.arm_radius / motor.torque_constant
    # d*V - R*i - d^2*r*i = 0, solved for the smaller duty cycle d without cancellation.
    voltage = servo.voltage_limit
    root = np.sqrt(np.maximum(voltage**2 - 4.0 * sag * motor.resistance * currents**2, 0.0))
    duty: np.ndarray = 2.0 * motor.resistance * currents / (voltage + root)
    return duty / servo.loop.position_gain
