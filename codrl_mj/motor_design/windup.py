"""Steps of a drive: a small one, and out of a current that the voltage cannot make, by kind of anti-windup."""

import dataclasses
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.motor_design.loop import Response, respond, small_step

ANTI_WINDUPS = ("back_calculation", "clamping", "none")
"""The kinds, as `SampledLoop.anti_windup` names them."""
_UNREACHABLE = 0.02
"""For how long more is asked for than can be made [s]."""
_AFTER = 0.1
"""How long the recovery is looked at [s]."""


class Recovery(NamedTuple):
    """What one kind of anti-windup makes of a current that could not be reached."""

    response: Response
    """The currents and voltages."""
    time: float
    """Until the current stays within 5 % of what can be reached again [s]; NaN where that takes over 0.1 s."""
    undershoot: float
    """How far the current falls below what is asked for, as a share of it."""


class Steps(NamedTuple):
    """Step responses of a drive."""

    small: Response
    """To a current that does not saturate, at standstill."""
    speed: float
    """Of the rotor in the saturated step [rad/s]: half V/kE, or what makes an unreachable current of `max_current`."""
    unreachable: float
    """Current asked for in vain, for 20 ms [A]."""
    reachable: float
    """Current asked for then [A]."""
    recoveries: dict[str, Recovery]
    """By kind of anti-windup."""


def step(drive: Drive) -> Steps:
    """Step a drive's current: small, and out of saturation with each kind of anti-windup.

    In saturation 1.8 times of what the voltage can make at `Steps.speed` is asked for, then 0.4 times of it.

    Raises:
        ValueError: the loop is unstable, the message has the spectral radius and a remedy; or its samples are too few.
    """
    loop = drive.controller
    if loop.sample_rate < 1e3:
        raise ValueError(f"SampledLoop.sample_rate = {loop.sample_rate:g}: must be >= 1000 Hz, to see a step; raise it")
    drive.check(1.0 / loop.sample_rate)
    speed, unreachable = _out_of_reach(drive)
    reachable = 0.4 / 1.8 * unreachable
    spans = (_UNREACHABLE, unreachable), (_AFTER, reachable)
    references = np.concatenate([np.full(round(time * loop.sample_rate), current) for time, current in spans])
    recoveries = {}
    for kind in ANTI_WINDUPS:
        one = dataclasses.replace(drive, controller=dataclasses.replace(loop, anti_windup=kind))
        response = respond(one, references, speed)
        after = response.current[response.time >= _UNREACHABLE - 0.5 / loop.sample_rate]
        recoveries[kind] = Recovery(
            response, response.settling_time(0.05), max(1.0 - float(after.min()) / reachable, 0.0)
        )
    return Steps(small_step(drive), speed, unreachable, reachable, recoveries)


def _out_of_reach(drive: Drive) -> tuple[float, float]:
    """A speed of the rotor [rad/s] and 1.8 times the current [A] that the voltage makes there."""
    motor, voltage, most = drive.motor, drive.voltage_limit, drive.controller.max_current
    if motor.back_emf_constant == 0.0:
        return 0.0, min(1.8 * voltage / motor.resistance, most)
    asked = min(0.9 * voltage / motor.resistance, most)
    return (voltage - motor.resistance * asked / 1.8) / motor.back_emf_constant, asked
