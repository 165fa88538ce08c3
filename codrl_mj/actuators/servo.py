"""Drive with a velocity loop and, optionally, a position loop, family `servo`.

It is the cascade of industrial drives: a proportional position loop commands a speed, a PI velocity
loop commands a current, and the current loop follows that. A single PD law, u = kp*(q* - q) - kd*w,
corresponds to `velocity_gain` kd, `position_gain` kp/kd and no integral.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import drive, shaft, stability
from codrl_mj.actuators.drive import ARM_FIELDS, Drive
from codrl_mj.actuators.model import Command, Inputs
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.shaft import Shaft, StepAverages
from codrl_mj.fields import Checked, choice, real


@dataclasses.dataclass(frozen=True)
class ServoLoop(Checked):
    """Outer loops of a servo, as seen at the output shaft: a hinge, or the wheel on a slide.

    Raises:
        ValueError: a field is out of bounds.
    """

    controls: str = choice("position", "position", "velocity")
    """Controlled quantity, which is also the quantity of the commands."""
    servo_rate: float = real(1e3, above=0.0, unit="Hz")
    """Sample rate [Hz] of these loops, > 0; it must divide the drive's `sample_rate`, and be a
    multiple or a divisor of the mechanical step's rate.
    """
    position_gain: float = real(20.0, above=0.0, unit="1/s")
    """Commanded speed [rad/s] for a position error of 1 rad, > 0."""
    velocity_gain: float = real(0.1, above=0.0, unit="N*m*s/rad")
    """Torque [N*m] for a speed error of 1 rad/s, > 0. For a bandwidth f, use 2*pi*f times the total
    inertia at the output, including the rotor's.
    """
    velocity_integral_gain: float = real(0.0, minimum=0.0, unit="1/s")
    """Torque that a speed error of 1 rad/s adds in a second, relative to `velocity_gain` [1/s], >=
    0. The integral stops while the current is at its limit.
    """
    velocity_feed_forward: float = real(0.0, minimum=0.0, unit="")
    """Share of the target position's speed that is added to the commanded speed, >= 0; useful if
    the target changes at every mechanical step.
    """
    inertia_feed_forward: float = real(0.0, minimum=0.0, unit="kg*m^2")
    """Torque [N*m] for an acceleration of 1 rad/s^2 of a commanded speed, >= 0; useful if the
    command changes at every mechanical step.
    """
    max_velocity: float = real(math.inf, above=0.0, unit="rad/s", infinite=True)
    """Largest speed [rad/s] that is commanded to the velocity loop, > 0."""
    max_torque: float = real(math.inf, above=0.0, unit="N*m", infinite=True)
    """Largest torque [N*m] that the velocity loop commands, > 0, in addition to the limit by the
    drive's `max_current`.
    """
    max_position: float = real(math.pi, above=0.0, unit="rad")
    """Largest position [rad] that an agent can command, > 0."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        unused = "inertia_feed_forward" if self.controls == "position" else "velocity_feed_forward"
        if getattr(self, unused) != 0.0:
            raise ValueError(
                f"ServoLoop.{unused} = {getattr(self, unused):g}: must be 0 if controls ="
                f" {self.controls!r}, which does not use it"
            )


class State(NamedTuple):
    """State of the servo: first the entries of a drive's state, then those of the outer loops."""

    current: float
    integral: float
    pending: float
    winding_rise: float
    housing_rise: float
    acceleration: float
    speed: float
    external_acceleration: float
    expected_time: float
    velocity_integral: float
    """Integral of the velocity loop: a torque [N*m] at the rotor."""
    target: float
    """Target of the last step at the rotor [rad] or [rad/s]."""
    commanded_torque: float
    """Torque [N*m] at the rotor that the loops commanded last."""
    steps_to_sample: float
    """Mechanical steps until the next sample of the outer loops, if these are slower than the
    steps.
    """


class Signals(NamedTuple):
    """Signals after a step."""

    current: float
    """Mean current [A] over the step."""
    reference_current: float
    """Reference current [A] of the current loop at the end of the step, within its limits."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Temperature [degC] of the winding at the end of the step."""
    error: float
    """Target minus actual value at the output shaft [rad] or [rad/s], at the beginning of the step.
    """
    saturated: float
    """1 if any of the following three signals is 1."""
    voltage_saturated: float
    """1 if the voltage reached the supply's limit at any time of the step."""
    current_saturated: float
    """1 if the command exceeded `max_current` or `max_torque`."""
    temperature_saturated: float
    """1 if `max_temperature` limited the current to less than `max_current`."""
    electrical_power: float
    """Mean of voltage times current at the winding's terminals [W]."""
    copper_loss: float
    """Mean heat [W] in the winding."""


def torque_demand(
    parameters: Parameters,
    period: float,
    target: float,
    rate: float,
    position: float,
    speed: float,
    integral: float,
) -> tuple[float, float]:
    """Return the commanded torque [N*m] at the rotor for one sample, and the integral after it.

    The target is a position [rad] or a speed [rad/s], and `rate` is its time derivative. `period`
    is the time [s] to the next sample.
    """
    ratio = parameters.gear_ratio
    gain, max_velocity = parameters.velocity_gain / (ratio * ratio), parameters.max_velocity * ratio
    if parameters.controls == 0.0:
        velocity = (
            parameters.position_gain * (target - position) + parameters.velocity_feed_forward * rate
        )
        feed_forward = 0.0
    else:
        velocity, feed_forward = target, parameters.inertia_feed_forward / (ratio * ratio) * rate
    error = min(max(velocity, -max_velocity), max_velocity) - speed
    integral_after = integral + parameters.velocity_integral_gain * gain * error * period
    return gain * error + integral + feed_forward, integral_after


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance all loops by one mechanical step, and predict the speed at each sample within it.

    `inputs.desired_torque` is a commanded position [rad] or speed [rad/s] of the rotor.
    """
    winding, heat, rotor = drive.begin_step(parameters, timestep, state, inputs)
    resistance = shaft.resistance_at(parameters, shaft.temperature_of(parameters, heat))
    target, constant = inputs.desired_torque, parameters.torque_constant
    rate = (target - state.target) / timestep if state.expected_time > 0.0 else 0.0
    count = max(int(timestep * parameters.servo_rate + 0.5), 1)
    steps_per_sample = max(int(1.0 / (timestep * parameters.servo_rate) + 0.5), 1)
    period = timestep / count
    samples = max(int(period * parameters.sample_rate + 0.5), 1)
    max_torque = parameters.max_torque / parameters.gear_ratio
    integral = state.velocity_integral
    command = state.commanded_torque
    steps_to_sample = state.steps_to_sample
    position, speed, applied = inputs.position, inputs.speed, 0.0
    amperes, volts, torque, power, loss = 0.0, 0.0, 0.0, 0.0, 0.0
    is_voltage_limited, is_current_limited, is_thermal = 0.0, 0.0, 0.0
    for _ in range(count):
        # If the outer loops are faster than the mechanical step, all `count` passes are samples.
        if steps_to_sample <= 0.0 or count > 1:
            command, integral_after = torque_demand(
                parameters, period * steps_per_sample, target, rate, position, speed, integral
            )
            steps_to_sample = float(steps_per_sample)
        else:
            integral_after = integral
        desired = min(max(command, -max_torque), max_torque) / constant
        applied = drive.limit_current(parameters, timestep, heat, resistance, desired)
        # The integral stops while the current is at its limit, unless this moves it off the limit.
        if applied == command / constant or (integral_after - integral) * command < 0.0:
            integral = integral_after
        if applied != desired and abs(applied) < parameters.max_current:
            is_thermal = 1.0
        elif applied != command / constant:
            is_current_limited = 1.0
        shaft_now = Shaft(rotor.inertia, rotor.external_acceleration, speed)
        winding, next_speed, averages = shaft.advance_motor(
            parameters, resistance, period, samples, winding, shaft_now, True, applied
        )
        position, speed = position + 0.5 * period * (speed + next_speed), next_speed
        is_voltage_limited += averages.saturated
        amperes, volts = amperes + averages.current / count, volts + averages.voltage / count
        torque += averages.torque / count
        power, loss = power + averages.power / count, loss + averages.heat / count
    step_averages = StepAverages(amperes, volts, torque, is_voltage_limited, power, loss)
    after, temperature = drive.end_step(
        parameters, timestep, inputs.time, heat, resistance, winding, rotor, step_averages
    )
    error = (
        target - (inputs.position if parameters.controls == 0.0 else inputs.speed)
    ) / parameters.gear_ratio
    is_voltage_limited = 1.0 if is_voltage_limited > 0.0 else 0.0
    limits = (
        max(is_voltage_limited, is_current_limited, is_thermal),
        is_voltage_limited,
        is_current_limited,
        is_thermal,
    )
    signals = Signals(amperes, applied, volts, temperature, error, *limits, power, loss)
    return State(*after, integral, target, command, steps_to_sample - 1.0), torque, signals


@dataclasses.dataclass(frozen=True)
class Servo(Drive):
    """Motor with gear, drive, supply and outer loops: commands are positions or speeds.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "servo"
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {**Drive.SIGNAL_UNITS, "error": "rad or rad/s"}
    is_torque_controlled: ClassVar[bool] = False
    MOTION: ClassVar[bool] = True
    advance: ClassVar = staticmethod(advance)

    loop: ServoLoop = ServoLoop()
    """The loops around the current loop."""

    @property
    def default_velocity_gain(self) -> float:
        """Gain [N*m*s/rad] of an untuned velocity loop: ten times kT*kE/R at the output.

        An error of a tenth of the no-load speed then requests the stall torque. It is rounded to
        three digits; 0 for a motor without a back-EMF.
        """
        motor = self.motor
        slope = (
            motor.torque_constant * motor.back_emf_constant / motor.resistance * motor.gear_ratio**2
        )
        return float(f"{10.0 * slope:.3g}")

    def with_default_gain(self, loop_fields: Mapping[str, object]) -> "Servo":
        """Return this servo with `default_velocity_gain`, unless `loop_fields` set a velocity gain.

        Raises:
            ValueError: the motor has no back-EMF, so there is no default gain.
        """
        if "velocity_gain" in loop_fields:
            return self
        if not self.default_velocity_gain:
            raise ValueError(
                "loop.velocity_gain is missing: it has no default if the motor has no back-EMF. For"
                " a bandwidth f, set 2*pi*f times the inertia at the output, including the rotor's"
            )
        return self.replaced({"loop.velocity_gain": self.default_velocity_gain})

    @property
    def assumed(self) -> str:
        """Assumptions of the drive, and the velocity gain if it is a default."""
        gain, text = self.loop.velocity_gain, super().assumed
        if gain not in (ServoLoop.velocity_gain, self.default_velocity_gain):
            return text
        assumption = f"loop.velocity_gain = {gain:g} N*m*s/rad"
        return f"{text}, {assumption}" if text else f"assumed, because not specified: {assumption}"

    def commands(self) -> Mapping[str, Command]:
        """Return the command `position` [rad] or [m], or `velocity` up to no-load speed."""
        loop, motor, arm = self.loop, self.motor, self.arm_radius
        fixed = dict.fromkeys(
            (*ARM_FIELDS, "loop.controls"), "it would change what an action means"
        )
        if loop.controls == "position":
            limit, unit = loop.max_position * motor.arm_radius, "rad"
        else:
            no_load_speed = (
                self.voltage_limit / motor.back_emf_constant
                if motor.back_emf_constant
                else math.inf
            )
            limit, unit = min(no_load_speed * arm, loop.max_velocity * motor.arm_radius), "rad/s"
            if math.isinf(limit):
                raise ValueError(
                    "loop.max_velocity = inf: must be finite if the motor has no back-EMF"
                )
        return {loop.controls: Command(unit, self, 1.0 / arm, limit, fixed)}

    def check(self, timestep: float) -> None:
        """Raise if the sample rates do not match, or if `Drive.check` raises.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        super().check(timestep)
        if not _rates_match(self.loop.servo_rate, self.controller.sample_rate, timestep):
            raise ValueError(
                f"ServoLoop.servo_rate = {self.loop.servo_rate:g}: must be a multiple or a"
                f" divisor of the mechanical step's rate, {1.0 / timestep:g} Hz, and divide the"
                f" drive's sample_rate = {self.controller.sample_rate:g} Hz; the mechanical step's"
                " rate itself always fits"
            )

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return the instability of the drives; infinity if sample rates do not match.

        The load is not known here, so the outer loops are not included.
        """
        columns = stability.parameter_columns(cls, parameter_values)
        rates_match = np.array(
            [
                _rates_match(*rates, timestep)
                for rates in zip(columns.servo_rate, columns.sample_rate, strict=True)
            ]
        )
        return np.where(rates_match, super().instability(parameter_values, timestep), np.inf)

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Run `Drive.check_shaft`; warn if the position loop is faster than the step."""
        super().check_shaft(timestep, inertia, held)
        loop, count = self.loop, round(timestep * self.loop.servo_rate)
        if loop.controls == "position" and count > 1 and timestep * loop.position_gain > 1.0:
            warnings.warn(
                f"loop.position_gain = {loop.position_gain:g}: the servo would reach its target"
                f" within a step of {timestep:g} s, but the joint moves at one speed"
                " during that step: it arrives late. Shorten the step to"
                f" {1.0 / loop.position_gain:.3g} s",
                stacklevel=2,
            )

    def steps_per_sample(self, timestep: float) -> int:
        """Return the number of mechanical steps per sample of the outer loops, at least 1."""
        return max(int(1.0 / (timestep * self.loop.servo_rate) + 0.5), 1)

    def loop_remedy(self, inertia: float) -> str:
        """Return a remedy for the outer loops' gains; see `ActuatorModel.loop_remedy`."""
        loop, at_joint = self.loop, inertia * self.motor.gear_ratio**2
        cause = f"The inertia at the joint is {at_joint:.3g} kg*m^2."
        if self.motor.rotor_inertia == 0.0:
            cause = (
                f"motor.rotor_inertia = 0: the loops move only the load, {at_joint:.3g} kg*m^2 at"
                " the joint; must be > 0 if the load is light: set it to the rotor's, from the"
                " motor's datasheet."
            )
        return (
            f"{cause} For a bandwidth f, set"
            f" loop.velocity_gain (now {loop.velocity_gain:g}) to 2*pi*f times this inertia, with f"
            f" well below servo_rate = {loop.servo_rate:g} Hz; and set position_gain (now"
            f" {loop.position_gain:g}) well below 2*pi*f."
        )


def _rates_match(servo_rate: float, sample_rate: float, timestep: float) -> bool:
    """Return True if the rates [Hz] of servo, drive and step are multiples of each other."""
    in_step = timestep * servo_rate
    multiples = max(in_step, 1.0 / in_step), sample_rate / max(servo_rate, 1.0 / timestep)
    return all(abs(ratio - round(ratio)) <= 1e-6 * ratio and ratio >= 0.5 for ratio in multiples)
