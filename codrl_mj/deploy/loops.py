"""Parameters of the control loops that a policy commands, for the board that closes them.

The loops are the current loops of a drive and of the paper's actuator, and the loops of a servo.
"""

import contextlib
from typing import cast

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive, Servo, sampled
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.boundary import JsonObject
from codrl_mj.envs.config import EnvConfig


def loop_parameters(env: EnvConfig) -> JsonObject | None:
    """Return the parameters of the loop that all motors share; None if a board cannot close it.

    The actuators must be a `codrl_mj.actuators.Drive`, a `Servo`, or the paper's `DCMotorActuator`.
    Gains that are designed from the winding are those at 25 degC. The parameters are the current
    for a command of 1, limits [A] and [V], gains, and the sample rate [Hz].
    """
    first = env.actuators[0]
    actions = ("position", "velocity") if type(first) is Servo else ("force", "current")
    # A subclass may have another loop, so the types must be equal.
    if type(first) not in (Drive, Servo, DCMotorActuator) or any(
        actuator != first for actuator in env.actuators
    ):
        return None
    if env.action not in actions:
        return None
    looped = cast(Drive | DCMotorActuator, first)
    motor = looped.motor
    commands_force = env.action == "force"
    shared = {
        "unit": "N or N*m" if commands_force else "A",
        "amperes": looped.arm_radius / motor.torque_constant if commands_force else 1.0,
        "most": None,
        # An infinite limit could not be written as a constant in C.
        "voltage": min(looped.voltage_limit, 1e30),
        "servo": None,
    }
    if isinstance(looped, DCMotorActuator):
        # The paper's loop is sampled at the engine's step, which only the model knows.
        with contextlib.closing(env.build()) as instance:
            model = getattr(instance.unwrapped, "model", None)
        return (
            None
            if model is None
            else shared
            | _paper_loop(looped, float(model.opt.timestep) / looped.controller.substeps)
        )
    loop = looped.controller
    # Gains of zero stand for gains that are designed from the bandwidth.
    kp, ki = loop.kp, loop.ki / loop.sample_rate
    if loop.kp == 0.0 and loop.ki == 0.0:
        bandwidth = 2.0 * np.pi * (loop.bandwidth or DEFAULT_BANDWIDTH * loop.sample_rate)
        kp, ki = sampled.designed_gains(
            motor.resistance, motor.inductance, 1.0 / loop.sample_rate, bandwidth
        )
    return shared | {
        "kind": "sampled",
        "sag": looped.supply_resistance,
        "rate": loop.sample_rate,
        "most": loop.max_current if np.isfinite(loop.max_current) else None,
        "kp": kp,
        "ki": ki,
        "tracking": ki / (kp + ki) if kp + ki > 0.0 else 0.0,
        "back_emf": motor.back_emf_constant if loop.bemf_compensation else 0.0,
        "anti_windup": loop.anti_windup,
        "delayed": loop.delayed,
        "servo": _outer_loops(looped) if isinstance(looped, Servo) else None,
    }


def _paper_loop(actuator: DCMotorActuator, period: float) -> JsonObject:
    """Return the parameters of `actuators.electrical_step` at a period [s].

    A limit of None means that there is no limit.
    """
    loop, supply = actuator.controller, actuator.supply
    limits = {"voltage": actuator.voltage_limit, "most_voltage": loop.max_voltage}
    # With a resistance the limit sags from the supply's open-circuit voltage.
    if supply is not None and supply.resistance:
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


def _outer_loops(servo: Servo) -> JsonObject:
    """Return the parameters of a servo's position and velocity loops, referred to the rotor.

    They are those of `codrl_mj.actuators.servo.demand`. A limit of None means that there is no
    limit.
    """
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
