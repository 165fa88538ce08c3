"""The loops behind a policy as numbers, for a controller that closes them: the drive's, the servo's, the paper's."""

import contextlib
from typing import Any

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive, Servo, sampled
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.envs.config import EnvConfig


def current_loop(env: EnvConfig) -> dict[str, Any] | None:
    """The numbers of the loop that all motors share; None where there is none to be computed on a board.

    Those of a `codrl_mj.actuators.Drive` at 25 degC, whose gains are computed as it computes them,
    of a `Servo`, or of the paper's `DCMotorActuator`. Amperes for a command, limits [A] and [V], gains,
    and the rate of its samples [Hz].
    """
    first: Any = env.actuators[0]
    asked = ("position", "velocity") if type(first) is Servo else ("force", "current")
    if type(first) not in (Drive, Servo, DCMotorActuator) or any(
        one != first for one in env.actuators
    ):
        return None
    if env.action not in asked:
        return None
    motor, loop = first.motor, first.controller
    forced = env.action == "force"
    shared = {
        "unit": "N or N*m" if forced else "A",
        "amperes": first.arm_radius / motor.torque_constant if forced else 1.0,
        "most": None,
        "voltage": min(first.voltage_limit, 1e30),
        "servo": None,
    }
    if type(first) is DCMotorActuator:
        with contextlib.closing(env.make()) as made:
            model = getattr(made.unwrapped, "model", None)
        return (
            None
            if model is None
            else shared | _paper_loop(first, float(model.opt.timestep) / loop.substeps)
        )
    kp, ki = loop.kp, loop.ki / loop.sample_rate
    if loop.kp == 0.0 and loop.ki == 0.0:
        bandwidth = 2.0 * np.pi * (loop.bandwidth or DEFAULT_BANDWIDTH * loop.sample_rate)
        kp, ki = sampled.designed_gains(
            motor.resistance, motor.inductance, 1.0 / loop.sample_rate, bandwidth
        )
    return shared | {
        "kind": "sampled",
        "sag": first.supply_resistance,
        "rate": loop.sample_rate,
        "most": loop.max_current if np.isfinite(loop.max_current) else None,
        "kp": kp,
        "ki": ki,
        "tracking": ki / (kp + ki) if kp + ki > 0.0 else 0.0,
        "back_emf": motor.back_emf_constant if loop.bemf_compensation else 0.0,
        "anti_windup": loop.anti_windup,
        "delayed": loop.delayed,
        "servo": _outer_loops(first) if type(first) is Servo else None,
    }


def _paper_loop(actuator: DCMotorActuator, period: float) -> dict[str, Any]:
    """The numbers of `codrl_mj.actuators.electrical_step` at its electrical step [s]; None: no limit."""
    loop, supply = actuator.controller, actuator.supply
    limits = {"voltage": actuator.voltage_limit, "most_voltage": loop.max_voltage}
    if (
        supply is not None and supply.resistance
    ):  # it sags from what the supply has without a current
        limits["voltage"] = supply.voltage if np.isfinite(supply.voltage) else loop.max_voltage
    return {name: value if np.isfinite(value) else None for name, value in limits.items()} | {
        "kind": "pid",
        "sag": 0.0 if supply is None or np.isinf(limits["voltage"]) else supply.resistance,
        "rate": 1.0 / period,
        "period": period,
        **{name: getattr(loop, name) for name in ("kp", "ki", "kd", "kff")},
        "back_emf": actuator.motor.back_emf_constant * float(loop.bemf_compensation),
        "leak": 1.0 + loop.integral_leak * period,
        "lag": loop.derivative_time_constant,
    }


def _outer_loops(servo: Servo) -> dict[str, Any]:
    """The numbers of a servo's loops at the rotor, as `codrl_mj.actuators.servo.demand` has them; None: no limit."""
    loop, ratio = servo.loop, servo.motor.gear_ratio
    gain = loop.velocity_gain / ratio**2
    limits = {"fastest": loop.max_velocity * ratio, "most": loop.max_torque / ratio}
    return {name: value if np.isfinite(value) else None for name, value in limits.items()} | {
        "controls": loop.controls,
        "rate": loop.servo_rate,
        "per_command": 1.0 / servo.arm_radius,
        "position_gain": loop.position_gain,
        "gain": gain,
        "integral_gain": loop.velocity_integral_gain * gain / loop.servo_rate,
        "velocity_ahead": loop.velocity_feed_forward,
        "torque_ahead": loop.inertia_feed_forward / ratio**2,
        "constant": servo.motor.torque_constant,
    }
