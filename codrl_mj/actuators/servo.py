"""A drive with a velocity loop, and if need be a position loop, around its current loop: family `servo`.

The cascade of industrial drives: a position loop P asks a velocity loop PI for a speed, that asks
the current loop for a current. P and PD in one, u = kp*(q* - q) - kd*w, are `velocity_gain` kd,
`position_gain` kp/kd and no integral.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import drive, shaft, stability
from codrl_mj.actuators.drive import ARM, Drive
from codrl_mj.actuators.model import Command, Inputs
from codrl_mj.actuators.shaft import StepAverages, Shaft
from codrl_mj.fields import Checked, choice, real


@dataclasses.dataclass(frozen=True)
class ServoLoop(Checked):
    """The outer loops of a servo, all as seen at the output shaft: at a hinge's joint, or the wheel that moves a slide.

    Raises:
        ValueError: a field is out of bounds.
    """

    controls: str = choice("position", "position", "velocity")
    """What it is asked for."""
    servo_rate: float = real(1e3, above=0.0, unit="Hz")
    """Samples a second of these loops [Hz], > 0; the drive's `sample_rate` must be a multiple of
    it, and it or the mechanical step's rate one of the other.
    """
    position_gain: float = real(20.0, above=0.0, unit="1/s")
    """Speed [rad/s] for an error of 1 rad, > 0."""
    velocity_gain: float = real(0.1, above=0.0, unit="N*m*s/rad")
    """Torque [N*m] for an error of 1 rad/s, > 0: for a bandwidth f, 2*pi*f times the inertia, the rotor's included."""
    velocity_integral_gain: float = real(0.0, minimum=0.0, unit="1/s")
    """What an error of 1 rad/s adds to the torque in a second, as a share of `velocity_gain` [1/s],
    >= 0. It stands still while the current is at its limit.
    """
    velocity_feed_forward: float = real(0.0, minimum=0.0, unit="")
    """Share of the asked position's own speed that is added to the speed asked for, >= 0: for
    positions that are asked for anew at every mechanical step.
    """
    inertia_feed_forward: float = real(0.0, minimum=0.0, unit="kg*m^2")
    """Torque [N*m] for 1 rad/s^2 of the speed that is asked for from outside, >= 0, likewise."""
    max_velocity: float = real(math.inf, above=0.0, unit="rad/s", infinite=True)
    """Largest speed [rad/s] that is asked of the velocity loop, > 0."""
    max_torque: float = real(math.inf, above=0.0, unit="N*m", infinite=True)
    """Largest torque [N*m] that it asks for, > 0, besides what the drive's `max_current` makes."""
    max_position: float = real(math.pi, above=0.0, unit="rad")
    """Largest position [rad] that an agent can ask for, > 0."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        unused = "inertia_feed_forward" if self.controls == "position" else "velocity_feed_forward"
        if getattr(self, unused) != 0.0:
            raise ValueError(
                f"ServoLoop.{unused} = {getattr(self, unused):g}: must be 0 where controls ="
                f" {self.controls!r}, which has no use for it"
            )


class State(NamedTuple):
    """What the servo remembers: the drive's, and its own."""

    current: float
    integral: float
    pending: float
    winding_rise: float
    housing_rise: float
    acceleration: float
    speed: float
    external_acceleration: float
    due: float
    velocity_integral: float
    """Torque [N*m] at the rotor."""
    target: float
    """What was asked for in the last step, at the rotor [rad] or [rad/s]."""
    asked: float
    """Torque [N*m] at the rotor that the loops asked for last."""
    waiting: float
    """Mechanical steps until they are sampled again, where they are slower than those."""


class Signals(NamedTuple):
    """What can be seen of a step."""

    current: float
    """Mean current [A] over the step."""
    reference_current: float
    """Current asked of the current loop [A], within its limits, in the end."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Of the winding [degC], at the end of the step."""
    error: float
    """What is asked for less what there is, at the output shaft [rad] or [rad/s], at the beginning of the step."""
    saturated: float
    """1 where any of the three that follow is."""
    voltage_saturated: float
    """As a drive's, at some time of the step, and so are the others."""
    current_saturated: float
    """1 where more than `max_current` or `max_torque` was asked for."""
    temperature_saturated: float
    electrical_power: float
    copper_loss: float


def torque_demand(
    parameters: Any,
    period: float,
    target: float,
    rate: float,
    position: float,
    speed: float,
    integral: float,
) -> tuple[float, float]:
    """One sample of the outer loops, at the rotor: the torque [N*m] asked for, and the integral that would follow.

    The target [rad] or [rad/s] has a rate of change of its own, and the period [s] is that to the
    next sample.
    """
    ratio = parameters.gear_ratio
    gain, fastest = parameters.velocity_gain / (ratio * ratio), parameters.max_velocity * ratio
    if parameters.controls == 0.0:
        wanted = (
            parameters.position_gain * (target - position) + parameters.velocity_feed_forward * rate
        )
        ahead = 0.0
    else:
        wanted, ahead = target, parameters.inertia_feed_forward / (ratio * ratio) * rate
    error = min(max(wanted, -fastest), fastest) - speed
    after = integral + parameters.velocity_integral_gain * gain * error * period
    return gain * error + integral + ahead, after


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance all loops by one mechanical step; between its samples the outer loops see the speed as it is predicted.

    In place of a desired torque the inputs have a position [rad] or a speed [rad/s] of the rotor.
    """
    winding, heat, moving = drive.begin_step(parameters, timestep, state, inputs)
    resistance = shaft.resistance_at(parameters, shaft.temperature_of(parameters, heat))
    target, constant = inputs.desired_torque, parameters.torque_constant
    rate = (target - state.target) / timestep if state.due > 0.0 else 0.0
    count = max(int(timestep * parameters.servo_rate + 0.5), 1)
    every = max(int(1.0 / (timestep * parameters.servo_rate) + 0.5), 1)
    period = timestep / count
    samples = max(int(period * parameters.sample_rate + 0.5), 1)
    most = parameters.max_torque / parameters.gear_ratio
    integral, asked, waiting = state.velocity_integral, state.asked, state.waiting
    position, speed, given = inputs.position, inputs.speed, 0.0
    amperes, volts, torque, power, loss = 0.0, 0.0, 0.0, 0.0, 0.0
    at_volts, at_amperes, too_warm = 0.0, 0.0, 0.0
    for _ in range(count):
        # A servo that is faster than the mechanical step is sampled `count` times within it.
        if waiting <= 0.0 or count > 1:
            asked, grown = torque_demand(
                parameters, period * every, target, rate, position, speed, integral
            )
            waiting = float(every)
        else:
            grown = integral
        wanted = min(max(asked, -most), most) / constant
        given = drive.limit_current(parameters, timestep, heat, resistance, wanted)
        if given == asked / constant or (grown - integral) * asked < 0.0:
            integral = grown  # it does not wind up
        if given != wanted and abs(given) < parameters.max_current:
            too_warm = 1.0
        elif given != asked / constant:
            at_amperes = 1.0
        now = Shaft(moving.inertia, moving.external_acceleration, speed)
        winding, next_speed, means = shaft.advance_motor(
            parameters, resistance, period, samples, winding, now, True, given
        )
        position, speed = position + 0.5 * period * (speed + next_speed), next_speed
        at_volts += means.saturated
        amperes, volts = amperes + means.current / count, volts + means.voltage / count
        torque += means.torque / count
        power, loss = power + means.power / count, loss + means.heat / count
    mean = StepAverages(amperes, volts, torque, at_volts, power, loss)
    after, temperature = drive.end_step(
        parameters, timestep, inputs.time, heat, resistance, winding, moving, mean
    )
    error = (
        target - (inputs.position if parameters.controls == 0.0 else inputs.speed)
    ) / parameters.gear_ratio
    at_volts = 1.0 if at_volts > 0.0 else 0.0
    limits = max(at_volts, at_amperes, too_warm), at_volts, at_amperes, too_warm
    signals = Signals(amperes, given, volts, temperature, error, *limits, power, loss)
    return State(*after, integral, target, asked, waiting - 1.0), torque, signals


@dataclasses.dataclass(frozen=True)
class Servo(Drive):
    """A motor with gear, drive and supply that is asked for positions or speeds.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "servo"
    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {**Drive.SIGNAL_UNITS, "error": "rad or rad/s"}
    is_torque_controlled: ClassVar[bool] = False
    MOTION: ClassVar[bool] = True
    advance: ClassVar = staticmethod(advance)

    loop: ServoLoop = ServoLoop()
    """The loops around the drive's."""

    @property
    def default_velocity_gain(self) -> float:
        """Gain [N*m*s/rad] of an untuned velocity loop: ten times the slope kT*kE/R of the motor, at its output.

        An error of a tenth of the free speed then asks for the stall torque. It is rounded to three
        digits, so that a message has the same number; 0 for a motor without back-EMF.
        """
        motor = self.motor
        slope = (
            motor.torque_constant * motor.back_emf_constant / motor.resistance * motor.gear_ratio**2
        )
        return float(f"{10.0 * slope:.3g}")

    def with_default_gain(self, loop: Mapping[str, Any]) -> "Servo":
        """Return this servo with `default_velocity_gain` if the fields that are given for its loop have no gain.

        Raises:
            ValueError: the motor has no back-EMF, and nothing tells a gain.
        """
        if "velocity_gain" in loop:
            return self
        if not self.default_velocity_gain:
            raise ValueError(
                "loop.velocity_gain is missing: must be given where a motor has no back-EMF; for a"
                " bandwidth f it is 2*pi*f times the inertia at the output, the rotor's included"
            )
        return self.replaced({"loop.velocity_gain": self.default_velocity_gain})

    @property
    def assumed(self) -> str:
        """As `Drive.assumed`, and the velocity gain where it is a default."""
        gain, text = self.loop.velocity_gain, super().assumed
        if gain not in (ServoLoop.velocity_gain, self.default_velocity_gain):
            return text
        told = f"loop.velocity_gain = {gain:g} N*m*s/rad"
        return f"{text}, {told}" if text else f"assumed, for none is given: {told}"

    def commands(self) -> Mapping[str, Command]:
        """A `position` [rad] or [m] within `loop.max_position`; or a `velocity` that is reached without a load."""
        loop, motor, arm = self.loop, self.motor, self.arm_radius
        fixed = dict.fromkeys((*ARM, "loop.controls"), "it would change what an action means")
        if loop.controls == "position":
            limit, unit = loop.max_position * motor.arm_radius, "rad"
        else:
            free = (
                self.voltage_limit / motor.back_emf_constant
                if motor.back_emf_constant
                else math.inf
            )
            limit, unit = min(free * arm, loop.max_velocity * motor.arm_radius), "rad/s"
            if math.isinf(limit):
                raise ValueError(
                    "loop.max_velocity = inf: must be finite where a motor has no back-EMF"
                )
        return {loop.controls: Command(unit, self, 1.0 / arm, limit, fixed)}

    def check(self, timestep: float) -> None:
        """Refuse rates that are no multiples of each other, besides what `Drive.check` refuses.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        super().check(timestep)
        if not _fits(self.loop.servo_rate, self.controller.sample_rate, timestep):
            raise ValueError(
                f"ServoLoop.servo_rate = {self.loop.servo_rate:g}: must be a multiple of the"
                f" mechanical step's rate, {1.0 / timestep:g} Hz, or that a multiple of it, and the"
                f" drive's sample_rate = {self.controller.sample_rate:g} Hz a multiple of both; the"
                " step's own rate always fits"
            )

    @classmethod
    def instability(cls, numbers: np.ndarray, timestep: float) -> np.ndarray:
        """As `Drive.instability`; infinite too where rates do not fit. What it moves is not known here."""
        columns = stability.parameter_columns(cls, numbers)
        fitting = np.array(
            [
                _fits(*each, timestep)
                for each in zip(columns.servo_rate, columns.sample_rate, strict=True)
            ]
        )
        return np.where(fitting, super().instability(numbers, timestep), np.inf)

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """As `Drive.check_shaft`; and warn of a position loop that is faster than the engine moves the joint."""
        super().check_shaft(timestep, inertia, held)
        loop, count = self.loop, round(timestep * self.loop.servo_rate)
        if loop.controls == "position" and count > 1 and timestep * loop.position_gain > 1.0:
            warnings.warn(
                f"loop.position_gain = {loop.position_gain:g}: the servo would be at its target"
                f" within a step of {timestep:g} s, and the engine moves the joint by one speed in"
                " that: it comes later than it should. Shorten the step to"
                f" {1.0 / loop.position_gain:.3g} s",
                stacklevel=2,
            )

    def steps_per_sample(self, timestep: float) -> int:
        """As `ActuatorModel.steps_per_sample`."""
        return max(int(1.0 / (timestep * self.loop.servo_rate) + 0.5), 1)

    def loop_remedy(self, inertia: float) -> str:
        """As `ActuatorModel.loop_remedy`."""
        loop, at_joint = self.loop, inertia * self.motor.gear_ratio**2
        return (
            f"It moves {at_joint:.3g} kg*m^2: for a bandwidth f loop.velocity_gain ="
            f" {loop.velocity_gain:g} is 2*pi*f times that, f well below servo_rate ="
            f" {loop.servo_rate:g} Hz, and position_gain = {loop.position_gain:g} well below"
            " 2*pi*f."
        )


def _fits(servo_rate: float, sample_rate: float, timestep: float) -> bool:
    """Whether the rates [Hz] of servo, drive and mechanical step are multiples of each other."""
    in_step = timestep * servo_rate
    multiples = max(in_step, 1.0 / in_step), sample_rate / max(servo_rate, 1.0 / timestep)
    return all(abs(one - round(one)) <= 1e-6 * one and one >= 0.5 for one in multiples)
