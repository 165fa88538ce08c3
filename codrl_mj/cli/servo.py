"""Servos in `codrl-mj motor show`: flags that make a motor a servo, and the servo's responses."""

import dataclasses
import math
from typing import Literal

import tyro

from codrl_mj.actuators import ActuatorSetting, PwmServo, Servo
from codrl_mj.actuators.firmware import FIRMWARES
from codrl_mj.boundary import Json
from codrl_mj.cli.terminal import format_number, print_table, print_text
from codrl_mj.sizing.servo_response import (
    AMPLITUDE,
    STEP,
    PositionServo,
    ServoResponse,
    max_lifted_load,
)


@dataclasses.dataclass(frozen=True)
class ServoSettings:
    """Values that make the named motor a servo."""

    family: Literal["servo", "pwm_servo"] | None = None
    """Make the motor a servo: `servo` has velocity and current loops, `pwm_servo` turns the
    position error into a duty cycle, as servos of Feetech and Dynamixel do.
    """
    position_p: float | None = None
    """Register P of a pwm_servo."""
    firmware: str | None = None
    """Product line of a pwm_servo, such as feetech-sts or dynamixel-x, which gives register P its
    meaning; for a motor of the catalogue it is known.
    """
    stiffness: float | None = None
    """Position gain of a pwm_servo in torque per error [N*m/rad]."""
    inertia: float | None = None
    """Inertia of the load [kg*m^2] at the servo's output; default: no load."""

    def setting(self, name: str) -> ActuatorSetting:
        """Return the setting of the named actuator with these values."""
        values = {
            "position_p": self.position_p,
            "firmware": self.firmware,
            "stiffness": self.stiffness,
        }
        loop = {key: value for key, value in values.items() if value is not None}
        if self.family is None and not loop:
            return name
        family = {} if self.family is None else {"family": self.family}
        return {"name": name, **family, "loop": loop}


AsServo = tyro.conf.OmitArgPrefixes[ServoSettings]
"""Type of a verb's field for `ServoSettings`, with flags `--family` instead of `--servo.family`."""


def analyze_position_servo(servo: PositionServo, inertia: float | None) -> ServoResponse | None:
    """Return the responses of a servo; None if it controls a speed."""
    from codrl_mj.sizing import analyze_servo

    if isinstance(servo, Servo) and servo.loop.controls != "position":
        return None
    return analyze_servo(servo, inertia)


def position_gain_text(servo: PositionServo) -> str:
    """Return the position gain of a `pwm_servo` in all its units; empty for other servos."""
    if not isinstance(servo, PwmServo):
        return ""
    gain, register = servo.loop.position_gain, servo.loop.register_p
    text = f"position gain: {gain:.4g} of the voltage per rad, {servo.stiffness:.4g} N*m/rad"
    if register is None:
        return text
    law = FIRMWARES[servo.loop.firmware]
    return f"{text}, P = {register:.4g} of {servo.loop.firmware}. Source of this law: {law.source}"


def print_servo(servo: PositionServo, response: ServoResponse | None) -> dict[str, Json]:
    """Print the responses of a servo; return them as a report."""
    print_text(position_gain_text(servo))
    if response is None:
        return {}
    rows = servo_rows(servo, response)
    load = f"with a load of {response.inertia:.3g} kg*m^2" if response.inertia else "without a load"
    cells = [(name, format_number(value, 3), unit) for name, value, unit in rows]
    print_table(f"The servo {load}", ("number", "value", "unit"), cells, right=("value",))
    values: dict[str, Json] = {name: value for name, value, _ in rows}
    units: dict[str, Json] = {name: unit for name, _, unit in rows}
    return {"servo": {"units": units, "inertia": response.inertia, **values}}


def servo_rows(servo: PositionServo, response: ServoResponse) -> list[tuple[str, float, str]]:
    """Return the names, values and units of a servo's responses."""
    half = 0.5 * response.max_torque
    lifted = max_lifted_load(servo, response)
    # Friction that depends on the load leaves no single number.
    load = [] if math.isnan(lifted) else [("largest load that it lifts", lifted, "N*m")]
    return [
        (f"rise time, {STEP:g} rad, 10 to 90 %", response.rise_time, "s"),
        ("settled to 2 % in", response.settling_time, "s"),
        ("overshoot", response.overshoot, ""),
        ("error that remains", response.final_error, "rad"),
        ("stiffness", response.stiffness, "N*m/rad"),
        *load,
        ("largest torque at rest, without friction", response.max_torque, "N*m"),
        ("error under half of it, without friction", half / response.stiffness, "rad"),
        (f"bandwidth, {AMPLITUDE:g} rad", response.bandwidth, "Hz"),
    ]
