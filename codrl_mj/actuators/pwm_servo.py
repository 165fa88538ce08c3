"""Servo without a current loop, family `pwm_servo`: hobby servos and bus servos.

The firmware compares the target angle with the measured one. The error, times a gain, is the duty
cycle of a bridge: the share of the supply's voltage that the motor gets. The current follows from
the winding and the back-EMF, and nothing controls it. Feetech's servos and those of Dynamixel in
position mode work like this.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import drive, noise, shaft, stability
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.firmware import FIRMWARES, find_firmware
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.geared import Geared
from codrl_mj.actuators.model import Command, Inputs, UnstableError
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.shaft import Shaft, TemperatureRises
from codrl_mj.fields import Checked, choice, optional_nested, real

HISTORY = 8
"""Number of commands that are on their way at the same time, at most."""
SLACK = 1e-3
"""Share of a step by which times may be off and still count as equal. Times in float32 need it."""
MAX_PIECES = 64
"""Largest number of pieces with a constant speed between two samples of the servo."""


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


class State(NamedTuple):
    """State of the servo."""

    current: float
    """Motor current [A]."""
    winding_rise: float
    """Temperature difference [K] between winding and housing."""
    housing_rise: float
    """Temperature difference [K] between housing and surroundings."""
    acceleration: float
    """Acceleration [rad/s^2] that the motor's torque gave the rotor in the last step."""
    speed: float
    """Speed [rad/s] of the rotor at the beginning of the last step."""
    external_acceleration: float
    """Estimated acceleration [rad/s^2] of the rotor by everything but the motor in the last step.
    """
    expected_time: float
    """Time [s] at which the next step should begin; 0 before the first step."""
    target: float
    """Target [rad] of the loop at the output shaft, on its way to the command."""
    target_velocity: float
    """Speed [rad/s] of the target."""
    error: float
    """Position error [rad] at the last sample."""
    integral: float
    """Duty cycle of the integral part."""
    duty: float
    """Duty cycle since the last sample."""
    steps_to_sample: float
    """Mechanical steps until the next sample, if samples are rarer than steps."""
    sent: float
    """Number of commands that have been sent."""
    c1: float
    """Last command [rad] at the output shaft; the following entries are the older ones."""
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float
    c8: float


class Signals(NamedTuple):
    """Signals after a step."""

    current: float
    """Mean current [A] over the step; times kT it is the torque of the motor."""
    duty: float
    """Mean duty cycle over the step, from -1 to 1."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Temperature [degC] of the winding at the end of the step."""
    target: float
    """Target [rad] of the loop at the output shaft at the end of the step."""
    error: float
    """Command that is in force minus position [rad] at the beginning of the step."""
    saturated: float
    """1 if any of the following two signals is 1."""
    voltage_saturated: float
    """1 if the duty cycle reached `max_duty` in at least one sample."""
    temperature_saturated: float
    """1 if the servo is switched off because its winding is hotter than `max_temperature`."""
    electrical_power: float
    """Mean of voltage times current at the winding's terminals [W]."""
    copper_loss: float
    """Mean heat [W] in the winding."""


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


class Sample(NamedTuple):
    """Result of a sample of the position loop."""

    duty: float
    """Duty cycle."""
    error: float
    """Position error [rad]."""
    integral: float
    """Duty cycle of the integral part."""
    saturated: float
    """1 if the duty cycle is limited."""


class Driven(NamedTuple):
    """Winding after some time of a constant duty cycle and speed."""

    current: float
    """Current [A] at the end."""
    mean: float
    """Mean current [A]."""
    mean_square: float
    """Mean squared current [A^2]."""


class Averages(NamedTuple):
    """Rotor and winding after a period, and averages over it."""

    current: float
    """Current [A] at the end."""
    speed: float
    """Speed [rad/s] of the rotor at the end."""
    mean: float
    """Mean current [A]."""
    mean_square: float
    """Mean squared current [A^2]."""
    torque: float
    """Torque [N*m] that the gear delivers, converted to the rotor's side."""


def sent_commands(state: State, command: float, position: float, is_new: bool) -> Commands:
    """Return the last commands [rad]; before the first step they are the position."""
    if state.expected_time <= 0.0:
        return Commands(
            command, position, position, position, position, position, position, position
        )
    if is_new:
        return Commands(
            command, state.c1, state.c2, state.c3, state.c4, state.c5, state.c6, state.c7
        )
    return Commands(state.c1, state.c2, state.c3, state.c4, state.c5, state.c6, state.c7, state.c8)


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
    speed = min(parameters.max_velocity, abs(distance) / period)
    if acceleration == math.inf:
        wanted = math.copysign(speed, distance)
    else:
        half = 0.5 * acceleration * period
        stopping = math.sqrt(half * half + 2.0 * acceleration * abs(distance)) - half
        wanted = math.copysign(min(speed, stopping), distance)
        wanted = min(max(wanted, velocity - 2.0 * half), velocity + 2.0 * half)
    # The last sample has the rest of the way, at up to a*T more than the largest change of speed.
    slow = acceleration == math.inf or abs(wanted) <= 2.0 * acceleration * period
    if slow and wanted * distance >= 0.0 and abs(wanted) * period >= abs(distance):
        return command, distance / period
    return target + period * wanted, wanted


def sample_loop(
    parameters: Parameters,
    period: float,
    target: float,
    position: float,
    error_before: float,
    integral: float,
    is_first: bool,
) -> Sample:
    """Return the duty cycle for a target and a position [rad] of the output shaft."""
    measured = position
    if parameters.encoder_counts > 0.0:
        count = 2.0 * math.pi / parameters.encoder_counts
        measured = count * math.floor(position / count + 0.5)
    error = target - measured
    if abs(error) <= parameters.deadband:
        error = 0.0
    rate = 0.0 if is_first else (error - error_before) / period
    integral_after = integral + parameters.integral_gain * error * period
    wanted = parameters.position_gain * error + parameters.derivative_gain * rate + integral_after
    if wanted != 0.0 and abs(wanted) < parameters.start_duty:
        wanted = math.copysign(parameters.start_duty, wanted)
    duty = min(max(wanted, -parameters.max_duty), parameters.max_duty)
    saturated = 1.0 if duty != wanted else 0.0
    # The integral stops while the duty cycle is at its limit, unless this moves it off the limit.
    if saturated > 0.0 and (integral_after - integral) * wanted > 0.0:
        integral_after = integral
    return Sample(duty, error, integral_after, saturated)


def advance_winding(
    parameters: Parameters,
    resistance: float,
    duration: float,
    current: float,
    duty: float,
    speed: float,
) -> Driven:
    """Advance the winding exactly for some time [s] at a constant duty cycle d and speed [rad/s].

    The bridge draws the current d*i from the supply, whose resistance r takes r*d*i of its voltage
    V. The motor gets d*(V - r*d*i), as if the winding had d^2*r more resistance.
    """
    total = resistance + duty * duty * parameters.supply_resistance
    x = total * duration / parameters.inductance
    drop = -math.expm1(-x)
    final = (duty * parameters.supply_voltage - parameters.back_emf_constant * speed) / total
    change = current - final
    mean = final + change * drop / x
    mean_square = final * (final + 2.0 * change * drop / x)
    mean_square += change * change * drop * (2.0 - drop) / (2.0 * x)
    return Driven(current - change * drop, mean, mean_square)


def advance_motor(
    parameters: Parameters,
    resistance: float,
    duration: float,
    current: float,
    duty: float,
    speed: float,
    rotor: Shaft,
) -> Averages:
    """Advance winding and rotor for some time [s] at a constant duty cycle.

    The rotor is that at the beginning of the step, and has `speed` now. The time is divided into
    pieces with a constant speed, as in `shaft.advance_motor`.
    """
    viscous = parameters.viscous_friction
    braking = parameters.torque_constant * parameters.back_emf_constant / resistance + viscous
    pieces = min(max(math.ceil(2.0 * duration * braking / rotor.inertia), 1), MAX_PIECES)
    has_losses = parameters.gear_efficiency < 1.0 or parameters.stribeck_friction > 0.0
    mean, mean_square, torque = 0.0, 0.0, 0.0
    piece = duration / pieces
    for _ in range(pieces):
        driven = advance_winding(parameters, resistance, piece, current, duty, speed)
        current, delivered = driven.current, parameters.torque_constant * driven.mean
        if has_losses:
            now = Shaft(rotor.inertia, rotor.external_acceleration, speed)
            delivered -= shaft.friction(parameters, piece, delivered, now)
        mean += driven.mean / pieces
        mean_square += driven.mean_square / pieces
        torque += delivered / pieces
        # The external acceleration includes the viscous friction at the step's initial speed.
        net_torque = delivered - viscous * (speed - rotor.speed)
        speed += piece * (net_torque / rotor.inertia + rotor.external_acceleration)
    return Averages(current, speed, mean, mean_square, torque)


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance bus, target, loop, winding and shaft by one mechanical step.

    `inputs.desired_torque` is a commanded position [rad] of the rotor.
    """
    ratio, is_first = parameters.gear_ratio, state.expected_time <= 0.0
    heat = TemperatureRises(state.winding_rise, state.housing_rise)
    rotor = drive.begin_shaft(parameters, timestep, state, inputs)
    temperature = shaft.temperature_of(parameters, heat)
    resistance = shaft.resistance_at(parameters, temperature)
    is_hot = 1.0 if temperature > parameters.max_temperature else 0.0
    newest = int(inputs.time / max(1.0 / parameters.command_rate, timestep) + SLACK)
    is_new = is_first or newest + 1.0 > state.sent
    sent = newest + 1.0 if is_new else state.sent
    start = inputs.position / ratio
    commands = sent_commands(state, inputs.desired_torque / ratio, start, is_new)
    count = max(int(timestep * parameters.servo_rate + 0.5), 1)
    steps_per_sample = max(int(1.0 / (timestep * parameters.servo_rate) + 0.5), 1)
    period = timestep / count
    target = start if is_first else state.target
    velocity, duty = state.target_velocity, state.duty
    error, integral, steps_to_sample = state.error, state.integral, state.steps_to_sample
    current, position, speed = state.current, start, inputs.speed
    in_force, saturated, mean_duty = start, 0.0, 0.0
    amperes, volts, torque, power, square = 0.0, 0.0, 0.0, 0.0, 0.0
    for index in range(count):
        # If the loop is faster than the mechanical step, all `count` passes are samples.
        if steps_to_sample <= 0.0 or count > 1:
            sample_time = period * steps_per_sample
            command = command_in_force(
                parameters,
                timestep,
                commands,
                newest,
                inputs.time + index * period,
                inputs.noise_key,
            )
            in_force = command if index == 0 else in_force
            target, velocity = advance_target(parameters, sample_time, target, velocity, command)
            sample = sample_loop(
                parameters, sample_time, target, position, error, integral, is_first and index == 0
            )
            duty, error, integral = sample.duty, sample.error, sample.integral
            saturated = max(saturated, sample.saturated)
            steps_to_sample = float(steps_per_sample)
        duty = 0.0 if is_hot > 0.0 else duty
        moved = advance_motor(parameters, resistance, period, current, duty, speed, rotor)
        position += 0.5 * period * (speed + moved.speed) / ratio
        current, speed = moved.current, moved.speed
        lost = duty * duty * parameters.supply_resistance
        amperes, mean_duty = amperes + moved.mean / count, mean_duty + duty / count
        driving = duty * parameters.supply_voltage
        volts += (driving - lost * moved.mean) / count
        power += (driving * moved.mean - lost * moved.mean_square) / count
        torque, square = torque + moved.torque / count, square + moved.mean_square / count
    loss = resistance * square
    if shaft.has_thermal_model(parameters):
        heat = shaft.rises_after(parameters, timestep, heat, loss)
    signals = Signals(
        amperes,
        mean_duty,
        volts,
        shaft.temperature_of(parameters, heat),
        target,
        in_force - start,
        max(saturated, is_hot),
        saturated,
        is_hot,
        power,
        loss,
    )
    after = State(
        current,
        heat.winding,
        heat.housing,
        torque / rotor.inertia,
        inputs.speed,
        rotor.external_acceleration,
        inputs.time + timestep,
        target,
        velocity,
        error,
        integral,
        duty,
        steps_to_sample - 1.0,
        sent,
        commands.c1,
        commands.c2,
        commands.c3,
        commands.c4,
        commands.c5,
        commands.c6,
        commands.c7,
        commands.c8,
    )
    return after, torque, signals


def observe(
    parameters: Parameters,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    signals: Signals,
    inputs: Inputs,  # noqa: ARG001
) -> tuple[float, float]:
    """Return current [A] and duty cycle of the last step, as servos report them."""
    return signals.current, signals.duty


@dataclasses.dataclass(frozen=True)
class PwmServo(Geared):
    """Motor with gear, position loop without a current loop, and supply: commands are positions.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "pwm_servo"
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        "current": "A",
        "duty": "1",
        "voltage": "V",
        "temperature": "degC",
        "target": "rad",
        "error": "rad",
        **dict.fromkeys(("voltage_saturated", "temperature_saturated"), "1"),
        **dict.fromkeys(("electrical_power", "copper_loss"), "W"),
    }
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "duty")
    RANDOM: ClassVar[tuple[str, ...]] = ("loop.command_jitter",)
    INERTIA: ClassVar[bool] = True
    MOTION: ClassVar[bool] = True
    is_torque_controlled: ClassVar[bool] = False
    advance: ClassVar = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: GearMotor = GearMotor()
    """The motor and its gear."""
    loop: PwmLoop = PwmLoop()
    """The position loop and the bus."""
    supply: Supply | None = optional_nested(Supply(voltage=24.0))
    """Supply of the servo; None: 24 V without a resistance."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if math.isinf(self.voltage_limit):
            raise ValueError(
                "PwmServo.supply.voltage = inf: must be finite, because the duty cycle is a share"
                " of it"
            )
        loop, gain = self.loop, 0.0
        if loop.position_p:
            gain = loop.position_p * FIRMWARES[loop.firmware].gain_per_p
        elif loop.stiffness:
            gain = loop.stiffness / self.stall_torque
        if gain:
            # The dataclass is frozen. A single gain remains, so that a later change of another
            # field, such as a drawn voltage, does not change the servo's law.
            converted = dataclasses.replace(loop, position_gain=gain, position_p=0.0, stiffness=0.0)
            vars(self)["loop"] = converted

    @property
    def stall_torque(self) -> float:
        """Torque [N*m] of the motor at the output at standstill and a duty cycle of 1.

        It leaves out the gear's losses and the supply's resistance.
        """
        motor = self.motor
        return motor.torque_constant * self.voltage_limit * motor.gear_ratio / motor.resistance

    @property
    def stiffness(self) -> float:
        """Torque [N*m] of the motor at the output for a position error of 1 rad at standstill."""
        return self.loop.position_gain * self.stall_torque

    @classmethod
    def factory_settings(
        cls, motor: str, loop_fields: Mapping[str, object]
    ) -> dict[str, float | str]:
        """Return the settings of the loop that a motor's name implies; empty if it implies none.

        Args:
            motor: name of a motor of the catalogue, or of a file.
            loop_fields: settings of the loop that the user has specified.
        """
        found = find_firmware(motor)
        name = str(loop_fields.get("firmware", found[0] if found else "unknown"))
        if name not in FIRMWARES:
            return {}
        law = FIRMWARES[name]
        settings: dict[str, float | str] = {
            "firmware": name,
            "max_duty": law.max_duty,
            "encoder_counts": law.encoder_counts,
        }
        is_set = {"position_gain", "position_p", "stiffness"} & loop_fields.keys()
        if found is not None and found[0] == name and not is_set:
            settings["position_p"] = found[1]
        return settings

    @property
    def assumed(self) -> str:
        """Unspecified inertia and gain; see `ActuatorModel.assumed`."""
        missing = {
            f"supply.voltage = {self.voltage_limit:g} V": self.supply is None,
            f"loop.position_gain = {self.loop.position_gain:g}, a default": (
                self.loop.position_gain == PwmLoop.position_gain
            ),
            "motor.rotor_inertia = 0": self.motor.rotor_inertia == 0.0,
        }
        assumptions = [text for text, is_missing in missing.items() if is_missing]
        text = ", ".join(assumptions)
        return f"assumed, because not specified: {text}" if text else ""

    def commands(self) -> Mapping[str, Command]:
        """Return the command `position` [rad] or [m]."""
        reason = "it would change what an action means"
        fixed = dict.fromkeys(drive.ARM_FIELDS, reason) | dict.fromkeys(
            ("loop.position_p", "loop.stiffness", "loop.firmware"),
            "it was converted to loop.position_gain, which can be drawn",
        )
        limit = self.loop.max_position * self.motor.arm_radius
        return {"position": Command("rad", self, 1.0 / self.arm_radius, limit, fixed)}

    def check(self, timestep: float) -> None:
        """Raise if rates do not match the step, or if too many commands are on their way.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        loop = self.loop
        if not bool(_rates_match(np.array(loop.servo_rate), timestep)):
            in_step = timestep * loop.servo_rate
            steps = max(round(in_step), 1) if in_step > 1.0 else 1.0 / round(1.0 / in_step)
            raise ValueError(
                f"PwmLoop.servo_rate = {loop.servo_rate:g}: must be a multiple or a divisor of the"
                f" mechanical step's rate, {1.0 / timestep:g} Hz; the nearest valid rate is"
                f" {steps / timestep:.8g} Hz"
            )
        interval = max(1.0 / loop.command_rate, timestep)
        latest = loop.command_delay + 4.0 * loop.command_jitter
        if latest > (HISTORY - 1) * interval * (1.0 + 1e-9):
            raise ValueError(
                f"PwmLoop.command_delay = {loop.command_delay:g}: with four times command_jitter ="
                f" {loop.command_jitter:g} it must be <= {(HISTORY - 1) * interval:g} s, seven"
                " periods of the commands. Lower command_rate (now"
                f" {min(loop.command_rate, 1.0 / timestep):g} Hz), or delay the commands before the"
                " servo: disturbances={'command_delay': ...}"
            )

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return infinity where `check` raises, else 0: the load is not known here."""
        columns = stability.parameter_columns(cls, parameter_values)
        latest = columns.command_delay + 4.0 * columns.command_jitter
        interval = np.maximum(1.0 / columns.command_rate, timestep)
        valid = latest <= (HISTORY - 1) * interval * (1.0 + 1e-9)
        valid &= _rates_match(columns.servo_rate, timestep)
        valid &= columns.start_duty <= columns.max_duty
        valid &= np.isfinite(columns.supply_voltage)
        return np.where(valid, 0.0, np.inf)

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Raise if the back-EMF makes the speed unstable; warn if it is inaccurate.

        Raises:
            UnstableError: with the number and a remedy.
        """
        motor, loop = self.motor, self.loop
        held = held or math.isinf(motor.load_inertia)
        if 0.0 < motor.load_inertia < math.inf:
            inertia = motor.rotor_inertia + motor.load_inertia / motor.gear_ratio**2
        # As in `Drive.check_shaft`: the share of its speed that the back-EMF takes from the rotor
        # while the speed is held.
        braking = motor.torque_constant * motor.back_emf_constant / motor.resistance
        period = timestep if held else min(timestep, 1.0 / loop.servo_rate)
        pieces = 1 if held else min(max(math.ceil(2.0 * period * braking / inertia), 1), MAX_PIECES)
        share = period / pieces * braking / inertia
        if share <= 0.5:
            return
        text = (
            f"motor.rotor_inertia = {motor.rotor_inertia:g}: the speed is held for"
            f" {period / pieces:g} s, in which the back-EMF changes it by {share:.3g} times its"
            f" value. The inertia at the rotor is {inertia:.3g} kg*m^2: set motor.rotor_inertia"
            f" from the motor's datasheet, or shorten the step to {0.5 * period / share:.2g} s"
        )
        if share >= 2.0:
            raise UnstableError(
                f"{text}; must be < 2, or pass allow_unstable=True to study it as it is"
            )
        warnings.warn(
            f"{text}: above 0.5 the speed is inaccurate, above 1 it oscillates", stacklevel=2
        )

    def steps_per_sample(self, timestep: float) -> int:
        """Return the number of mechanical steps per sample of the loop, at least 1."""
        return max(int(1.0 / (timestep * self.loop.servo_rate) + 0.5), 1)

    def loop_remedy(self, inertia: float) -> str:
        """Return a remedy for the loop's gains; see `ActuatorModel.loop_remedy`."""
        loop, at_joint = self.loop, inertia * self.motor.gear_ratio**2
        return (
            f"The inertia at the joint is {at_joint:.3g} kg*m^2, and the servo pulls it with"
            f" {self.stiffness:.3g} N*m/rad. Lower loop.position_gain (now {loop.position_gain:g})"
            f" or loop.derivative_gain (now {loop.derivative_gain:g}), or set motor.rotor_inertia"
            f" (now {self.motor.rotor_inertia:g}) from the motor's datasheet."
        )


def _rates_match(servo_rate: np.ndarray, timestep: float) -> np.ndarray:
    """Return True where a sample rate [Hz] is a multiple or a divisor of the step's rate."""
    in_step = timestep * servo_rate
    multiple = np.maximum(in_step, 1.0 / in_step)
    matches: np.ndarray = np.abs(multiple - np.round(multiple)) <= 1e-6 * multiple
    return matches
