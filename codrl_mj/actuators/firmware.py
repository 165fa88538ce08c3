"""Position laws in the firmware of servos: what a value of the gain register P means.

Manufacturers do not publish the law of their loops in physical units, with one exception. The other
values were measured with an oscilloscope on the bridge. Only the register P has a known law.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

TURN = 2.0 * math.pi
"""Angle [rad] of a turn."""


class Firmware(NamedTuple):
    """Law of a product line."""

    factory_p: Mapping[str, float]
    """Beginning of the name of a motor in the catalogue -> its register P as delivered."""
    gain_per_p: float
    """Duty cycle for a position error of 1 rad and P = 1 [1/rad]."""
    max_duty: float
    """Largest duty cycle."""
    encoder_counts: float
    """Counts per turn of the output shaft."""
    source: str
    """Where these values are from, and what contradicts them."""


FIRMWARES: dict[str, Firmware] = {
    "feetech-sts": Firmware(
        {"feetech-sts": 32.0},
        0.166,
        0.97,
        4096.0,
        "Rhoban/bam: bam/feetech/actuator.py, measured on an STS3215 of 7.4 V with an oscilloscope;"
        " P = 32 and 4096 counts from Feetech's memory table. The law of D and I is not published.",
    ),
    "dynamixel-x": Firmware(
        {"dynamixel-xm": 800.0, "dynamixel-xl430": 640.0, "dynamixel-xc330": 1100.0},
        4096.0 / TURN / 128.0 / 885.0,
        1.0,
        4096.0,
        "ROBOTIS e-manual, XM430-W210 and XL430-W250, Position PID Gain (80 to 84) and PWM Limit"
        " (36): P/128 per count, in units of 1/885 of the voltage. Rhoban/bam has the same number,"
        " 0.00575504, for the XC330-M288. P = 800, 640 and 1100 from the pages of each motor.",
    ),
    "dynamixel-xl330": Firmware(
        {"dynamixel-xl330": 400.0},
        0.00246,
        1.0,
        4096.0,
        "Rhoban/bam: bam/xl330/actuator.py, measured with an oscilloscope; P = 400 from the ROBOTIS"
        " e-manual, XL330-M288-T. The law of dynamixel-x would give 2.3 times as much.",
    ),
    "dynamixel-mx": Firmware(
        {"dynamixel-mx": 32.0},
        0.158,
        0.9625,
        4096.0,
        "Rhoban/bam: bam/dynamixel/actuator.py, measured on an MX-64 and an MX-106 with an"
        " oscilloscope, with firmware for protocol 1. Firmware for protocol 2 has P = 850 and the"
        " law of dynamixel-x.",
    ),
    "dynamixel-xl320": Firmware(
        {"dynamixel-xl320": 32.0},
        0.05048199,
        1.0,
        1023.0 / 300.0 * 360.0,
        "Rhoban/bam: bam/dynamixel/actuator.py, measured with an oscilloscope; 1024 counts over 300"
        " degrees from the ROBOTIS e-manual, XL-320.",
    ),
}
"""Product line -> its law."""


def find_firmware(motor: str) -> tuple[str, float] | None:
    """Return the product line of a motor of the catalogue and its register P as delivered.

    None if the name belongs to no known product line.
    """
    for name, firmware in FIRMWARES.items():
        for beginning, factory_p in firmware.factory_p.items():
            if motor.startswith(beginning):
                return name, factory_p
    return None
