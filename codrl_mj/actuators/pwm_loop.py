"""Position loop of a servo without a current loop, and the bus that brings its commands.

`codrl_mj.actuators.pwm_servo` has the motor that the loop drives.
"""

import dataclasses
import math
from typing import NamedTuple

from codrl_mj.actuators import noise
from codrl_mj.actuators.firmware import FIRMWARES
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.fields import Checked, choice, real

HISTORY = 8
"""Number of commands that are on their way at the same time, at most."""
SLACK = 1e-3
"""Share of a step by which times may be off and still count as equal. Times in float32 need it."""


@dataclasses.dataclass(frozen=True)
class PwmLoop(Checked):
    """Position loop of a servo that sets a duty cycle, and the bus that brings its commands.

    Angles are those of the output shaft: a hinge, or the wheel on a slide.

    Raises:
        ValueError: a field is out of bounds.
    """

    position_gain: float = real(5.0, above=0.0, unit="1/rad")
    """Duty cycle for a position error of 1 rad, > 0; 1 is the whole voltage of the supply. If you
    specify `position_p` or `stiffness`, the servo computes it.
    """
    position_p: float = real(0.0, minimum=0.0)
    """Position gain as the value of the register P of the `firmware`, >= 0. The servo converts it
    to `position_gain` and sets it to 0.
    """
    stiffness: float = real(0.0, minimum=0.0, unit="N*m/rad")
    """Position gain as the torque [N*m] of the motor at the output for a position error of 1 rad at
    standstill, without the gear's losses, >= 0. The servo converts it to `position_gain` and sets
    it to 0.
    """
    firmware: str = choice("unknown", "unknown", *FIRMWARES)
    """Product line of the servo, which tells the meaning of `position_p`. A motor of the catalogue
    that becomes a servo sets it.
    """
    integral_gain: float = real(0.0, minimum=0.0, unit="1/(rad*s)")
    """Duty cycle that a position error of 1 rad adds in a second, >= 0. The integral stops while
    the duty cycle is at its limit.
    """
    derivative_gain: float = real(0.0, minimum=0.0, unit="s/rad")
    """Duty cycle for a position error that grows by 1 rad/s, >= 0."""
    servo_rate: float = real(1e3, above=0.0, unit="Hz")
    """Sample rate [Hz] of the position loop, > 0; it must be a multiple or a divisor of the
    mechanical step's rate.
    """
    max_duty: float = real(1.0, above=0.0, maximum=1.0)
    """Largest duty cycle, in (0, 1]."""
    start_duty: float = real(0.0, minimum=0.0, maximum=1.0)
    """Smallest duty cycle other than 0, in [0, 1]: a smaller one is raised to it, so that the motor
    overcomes its friction.
    """
    deadband: float = real(0.0, minimum=0.0, unit="rad")
    """Position error [rad] up to which the loop sees none, >= 0."""
    encoder_counts: float = real(0.0, minimum=0.0, unit="1/turn")
    """Counts of the encoder per turn of the output shaft, >= 0; 0: exact positions."""
    max_velocity: float = real(math.inf, above=0.0, unit="rad/s", infinite=True)
    """Largest speed [rad/s] at which the target moves towards the command, > 0."""
    max_acceleration: float = real(math.inf, above=0.0, unit="rad/s^2", infinite=True)
    """Largest acceleration [rad/s^2] of the target, > 0."""
    command_rate: float = real(1e4, above=0.0, unit="Hz")
    """Rate [Hz] at which commands are sent to the servo, > 0; at most one per mechanical step. The
    servo keeps a command until the next one arrives.
    """
    command_delay: float = real(0.0, minimum=0.0, unit="s")
    """Time [s] from sending a command to its arrival, >= 0; at most seven periods of the command
    rate. Until the first command arrives, the servo holds its position.
    """
    command_jitter: float = real(0.0, minimum=0.0, unit="s")
    """Standard deviation [s] of that time from command to command, >= 0; normally distributed, but
    no command arrives before it is sent. A newer command replaces an older one that is still on its
    way.
    """
    max_position: float = real(math.pi, above=0.0, unit="rad")
    """Largest position [rad] that an agent can command, > 0."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.start_duty > self.max_duty:
            raise ValueError(
                f"PwmLoop.start_duty = {self.start_duty:g}: must be <= max_duty = {self.max_duty:g}"
            )
        if self.position_p and self.stiffness:
            raise ValueError(
                f"PwmLoop.position_p = {self.position_p:g} and stiffness = {self.stiffness:g}: are"
                " two values of the same gain; set one of them"
            )
        if self.position_p and self.firmware == "unknown":
            raise ValueError(
                f"PwmLoop.position_p = {self.position_p:g}: the meaning of this register depends on"
                f" the product line; set firmware to one of {', '.join(FIRMWARES)}, or specify"
                " position_gain [duty cycle per rad] or stiffness [N*m/rad] instead"
            )

    @property
    def register_p(self) -> float | None:
        """Value of the register P that gives `position_gain`; None if the firmware is unknown."""
        law = FIRMWARES.get(self.firmware)
        return None if law is None else self.position_gain / law.gain_per_p


class Commands(NamedTuple):
    """The last commands [rad] at the output shaft, the newest first."""

    c1: float
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float
    c8: float


class LoopState(NamedTuple):
    """State of the position loop between two samples; angles are those of the output shaft."""

    target: float
    """Target [rad], on its way to the command."""
    target_velocity: float
    """Speed [rad/s] of the target."""
    error: float
    """Position error [rad] at the last sample."""
    integral: float
    """Duty cycle of the integral part."""
    duty: float
    """Duty cycle since the last sample."""
    saturated: float
    """1 if the duty cycle was limited in at least one sample of the step."""


def command_in_force(
    parameters: Parameters,
    timestep: float,
    commands: Commands,
    newest: int,
    time: float,
    noise_key: float,
) -> float:
    """Return the newest command [rad] that has arrived at a time [s]; else the oldest one."""
    interval = max(1.0 / parameters.command_rate, timestep)
    for age in range(HISTORY):
        number = max(newest - age, 0)
        # A command is sent at the first step that does not begin before its time.
        sent = math.ceil(number * interval / timestep - SLACK) * timestep
        delay = parameters.command_delay
        if parameters.command_jitter > 0.0:
            delay += parameters.command_jitter * noise.standard_normal(noise_key, number, 0)
        if sent + max(delay, 0.0) <= time + SLACK * timestep:
            return commands[age]
    return commands.c8


def advance_target(
    parameters: Parameters, period: float, target: float, velocity: float, command: float
) -> tuple[float, float]:
    """Move the target [rad] towards the command for a period [s]; return it and its speed.

    The speed is the largest from which the target can stop at the command. With the speed v in this
    sample and a*T less in each following one, it comes to a stop after v^2/(2*a) + v*T/2.
    """
    distance, acceleration = command - target, parameters.max_acceleration
    size = min(parameters.max_velocity, abs(distance) / period)
    change = acceleration * period
    if acceleration == math.inf:
        speed = math.copysign(size, distance)
    else:
        half = 0.5 * change
        stopping = math.sqrt(half * half + 2.0 * acceleration * abs(distance)) - half
        speed = math.copysign(min(size, stopping), distance)
        speed = min(max(speed, velocity - change), velocity + change)
    # The last sample has the rest of the way, at up to twice the largest change of speed.
    is_slow = acceleration == math.inf or abs(speed) <= 2.0 * change
    if is_slow and speed * distance >= 0.0 and abs(speed) * period >= abs(distance):
        return command, distance / period
    return target + period * speed, speed


def advance_loop(
    parameters: Parameters,
    period: float,
    loop: LoopState,
    command: float,
    position: float,
    is_first: bool,
) -> LoopState:
    """Return the loop after a sample, for a command and a position [rad] of the output shaft."""
    target, velocity = advance_target(
        parameters, period, loop.target, loop.target_velocity, command
    )
    measured = position
    if parameters.encoder_counts > 0.0:
        count = 2.0 * math.pi / parameters.encoder_counts
        measured = count * math.floor(position / count + 0.5)
    error = target - measured
    if abs(error) <= parameters.deadband:
        error = 0.0
    rate = 0.0 if is_first else (error - loop.error) / period
    integral = loop.integral + parameters.integral_gain * error * period
    unlimited = parameters.position_gain * error + parameters.derivative_gain * rate + integral
    if unlimited != 0.0 and abs(unlimited) < parameters.start_duty:
        unlimited = math.copysign(parameters.start_duty, unlimited)
    duty = min(max(unlimited, -parameters.max_duty), parameters.max_duty)
    is_limited = 1.0 if duty != unlimited else 0.0
    # The integral stops while the duty cycle is at its limit, unless this moves it off the limit.
    if is_limited > 0.0 and (integral - loop.integral) * unlimited > 0.0:
        integral = loop.integral
    saturated = max(loop.saturated, is_limited)
    return LoopState(target, velocity, error, integral, duty, saturated)
